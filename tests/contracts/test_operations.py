"""Every implementation of every operation against the reference in float64, on the examples that operations declare.

A new implementation is tested by being declared. Whether the references are right is tested elsewhere, against NumPy.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn.networks.recurrent  # declares its operation
import jaxdn.sequence.james_stein  # noqa: F401  (likewise)
from jaxdn.methods.registry import methods
from jaxdn.ops.affinity import pallas_kernels
from jaxdn.ops.dispatch.operation import OPERATIONS, REFERENCE
from tests.needs import NEEDS

methods()  # imports all of them, and what they are made of

SIZE = (5, 7)
OTHER_SIZES = [(1, 1), (18, 33)]
"""Without an inside, and of several cells: not for references, which are compared with themselves in float64."""
EXTRAS = {"onednn-float32": "onednn", "onednn-bfloat16": "bfloat16"}
"""Implementation -> what it needs (:mod:`tests.needs`), where that has another name."""
PAIRS = [
    pytest.param(operation, name, marks=[pytest.mark.needs(need)] if need in NEEDS else [], id=f"{operation}-{name}")
    for operation, one in sorted(OPERATIONS.items())
    for name in one.implementations
    for need in [EXTRAS.get(name, name)]
]


def examples(operation, height, width, dtype):
    """(arguments whose floating arrays are rounded to ``dtype``, options)."""

    def rounded(array):
        return np.asarray(array, dtype if np.issubdtype(np.asarray(array).dtype, np.floating) else None)

    rng = np.random.default_rng([height, width])
    for arguments, options in OPERATIONS[operation].examples(rng, height, width):
        yield jax.tree.map(rounded, arguments), options


def pulled_back(function, arguments, cotangents):
    """The value, and the gradients by all floating arrays for the cotangents, which depend on the value's shapes."""
    leaves, tree = jax.tree.flatten(arguments)
    places = [index for index, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.inexact)]

    def of_floats(*floats):
        given = dict(zip(places, floats, strict=True))
        return function(*jax.tree.unflatten(tree, [given.get(index, leaf) for index, leaf in enumerate(leaves)]))

    value, pull = jax.vjp(of_floats, *(leaves[index] for index in places))
    return value, pull(cotangents(value))


def drawn_like(value):
    """A cotangent: noise of fixed seeds; nothing for whole numbers and truths, which have no gradient."""

    def one(leaf):
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            return np.zeros(leaf.shape, jax.dtypes.float0)
        return jnp.asarray(np.random.default_rng(leaf.size).normal(size=leaf.shape), leaf.dtype)

    return jax.tree.map(one, value)


@functools.cache
def expected(operation, height, width):
    """Value and gradients of the reference in float64 for each example, whose arguments are rounded to float32."""
    found = []
    with jax.enable_x64(True):
        for arguments, options in examples(operation, height, width, np.float32):
            wide = jax.tree.map(lambda a: np.float64(a) if a.dtype == np.float32 else a, arguments)
            run = functools.partial(OPERATIONS[operation], implementation=REFERENCE, **options)
            program = jax.jit(functools.partial(pulled_back, run, cotangents=drawn_like))
            found.append(jax.tree.map(np.asarray, program(wide)))
    return found


def runner(operation, name, options):
    """The implementation as a function of arrays; kernels for a GPU are interpreted where there is none."""
    if name == "pallas" and pallas_kernels.unavailable():
        return functools.partial(OPERATIONS[operation].implementations[name].function, **options)
    return functools.partial(OPERATIONS[operation], implementation=name, **options)


ROUNDING = 2e-6
"""Of the largest gradient of all arguments: what rounding leaves of a gradient of 0, as of a single pixel's weights."""


def assert_close(found, wanted, precision, *, rounding=0.0):
    """Within rounding of the largest value of each array, and within ``rounding`` of the largest of all arrays."""
    floats = [leaf for leaf in jax.tree.leaves(wanted) if np.issubdtype(leaf.dtype, np.floating)]
    largest = max(np.abs(leaf).max(initial=0.0) for leaf in floats)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        if other.dtype == jax.dtypes.float0:
            continue
        if not np.issubdtype(other.dtype, np.floating):
            np.testing.assert_array_equal(one, other)
            continue
        error = 1e-4 if precision is None else 6 * float(jnp.finfo(precision).eps)
        least = max(0.1 * error * np.abs(other).max(initial=0.0), rounding * largest, 1e-7)
        np.testing.assert_allclose(one, other, rtol=error, atol=least)


@pytest.mark.slow
@pytest.mark.parametrize(("operation", "name"), PAIRS)
def test_value_and_gradient_are_those_of_the_reference(operation, name):
    """Gradients of an implementation that computes more coarsely are those of the reference, and not coarse."""
    assert_equals_reference(operation, name, SIZE)


@pytest.mark.slow
@pytest.mark.parametrize("size", OTHER_SIZES, ids=str)
@pytest.mark.parametrize(("operation", "name"), [pair for pair in PAIRS if pair.values[1] != REFERENCE])
def test_value_and_gradient_at_other_sizes_are_those_of_the_reference(operation, name, size):
    assert_equals_reference(operation, name, size)


def assert_equals_reference(operation, name, size):
    """Value and gradient of an implementation for all examples of one size."""
    precision = OPERATIONS[operation].implementations[name].precision
    pairs = zip(examples(operation, *size, np.float32), expected(operation, *size), strict=True)
    for (arguments, options), (value, gradients) in pairs:
        run = runner(operation, name, options)
        found, slopes = jax.jit(functools.partial(pulled_back, run, cotangents=drawn_like))(arguments)
        assert_close(found, value, precision)
        assert_close(slopes, gradients, None, rounding=ROUNDING)


@pytest.mark.parametrize(("operation", "name"), PAIRS)
def test_a_batch_is_its_examples_one_by_one(operation, name):
    """``jax.vmap`` of the named implementation, and of the one that None selects, in a scan."""
    precision = OPERATIONS[operation].implementations[name].precision
    arguments, options = next(examples(operation, *SIZE, np.float32))
    value, _ = expected(operation, *SIZE)[0]
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf[..., ::-1] if leaf.ndim else leaf]), arguments)
    found = jax.jit(jax.vmap(runner(operation, name, options)))(*batch)
    assert_close(jax.tree.map(lambda leaf: np.asarray(leaf)[0], found), value, precision)
    if name == REFERENCE:
        run = jax.vmap(functools.partial(OPERATIONS[operation], **options))
        looped = jax.jit(lambda *batch: jax.lax.scan(lambda carry, _: (carry, run(*batch)), 0, length=2)[1])(*batch)
        assert_close(jax.tree.map(lambda leaf: np.asarray(leaf)[1, 0], looped), value, None)


def test_every_operation_declares_examples():
    for name, operation in OPERATIONS.items():
        assert list(operation.examples(np.random.default_rng(0), 6, 7)), name
        assert operation.__doc__, name


@pytest.mark.parametrize(("operation", "name"), PAIRS)
def test_a_name_means_that_implementation_or_an_error(operation, name):
    one = OPERATIONS[operation].implementations[name]
    arguments, options = next(examples(operation, *SIZE, np.float64))
    if not one.dtypes:
        return
    with jax.enable_x64(True), pytest.raises(ValueError, match=f"\"{name}\" takes float32, got float64.*'reference'"):
        OPERATIONS[operation](*arguments, implementation=name, **options)
