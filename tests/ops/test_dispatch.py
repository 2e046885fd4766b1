"""How one of an operation's implementations is chosen: by platform, dtype, transformation, name and default."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn.methods.registry import method_named
from jaxdn.ops.dispatch.operation import OPERATIONS, operation, portable

pytestmark = pytest.mark.usefixtures("cpu")

ONE = jnp.ones(3, jnp.float32)


@pytest.fixture
def cpu(monkeypatch):
    """These tests are about the choice and not about this machine."""
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")


@pytest.fixture
def scaled():
    """An operation that multiplies by a constant of the program; each implementation adds a number of its own."""

    @operation(name="scaled")
    def scaled(x, *, by):
        return by * x

    @scaled.implementation("gpu", platforms=("gpu",), unavailable=lambda: "runs on GPUs")
    def _(x, *, by):
        return by * x + 1

    @scaled.implementation("inference", platforms=("cpu",), dtypes=(jnp.float32,), differentiable=False)
    def _(x, *, by):
        return jax.lax.stop_gradient(by * x + 2)

    @scaled.implementation("tiles", platforms=("cpu",))
    def _(x, *, by):
        return by * x + x * 3

    yield scaled
    del OPERATIONS["scaled"]


def test_none_is_the_first_that_is_meant_for_the_platform_and_takes_the_dtype(scaled):
    np.testing.assert_array_equal(scaled(ONE, by=2), 4)
    np.testing.assert_array_equal(jax.jit(lambda x: scaled(x, by=2))(ONE), 4)
    np.testing.assert_array_equal(scaled(ONE.astype(jnp.bfloat16), by=2), 5)
    with portable():
        np.testing.assert_array_equal(scaled(ONE, by=2), 2)


def test_gradients_and_batches_are_those_of_the_next_that_has_a_gradient(scaled):
    value, slope = jax.value_and_grad(lambda x: scaled(x, by=2).sum())(ONE)
    assert value == 15
    np.testing.assert_array_equal(slope, 5)
    np.testing.assert_array_equal(jax.vmap(lambda x: scaled(x, by=2))(jnp.stack([ONE, ONE])), 5)

    def looped(x):
        return jax.lax.scan(lambda total, _: (scaled(total, by=2), None), x, length=2)[0]

    np.testing.assert_array_equal(jax.jit(looped)(ONE), 10)
    np.testing.assert_array_equal(jax.jit(jax.grad(lambda x: looped(x).sum()))(ONE), 25)


def test_a_name_gives_the_value_and_lends_the_gradient_of_the_reference_if_it_has_none(scaled):
    for name, expected, slope in (("reference", 2, 2), ("inference", 4, 2), ("tiles", 5, 5)):
        value, found = jax.value_and_grad(lambda x, name=name: scaled(x, by=2, implementation=name).sum())(ONE)
        assert value == 3 * expected
        np.testing.assert_array_equal(found, slope)
        batch = jax.vmap(lambda x, name=name: scaled(x, by=2, implementation=name))(jnp.stack([ONE, ONE]))
        np.testing.assert_array_equal(batch, expected)


def test_a_name_that_does_not_fit_is_an_error_that_says_which_do(scaled):
    with pytest.raises(ValueError, match=r"scaled: expected None or one of 'reference', 'gpu', .*, got 'fast'"):
        scaled(ONE, by=2, implementation="fast")
    with pytest.raises(ValueError, match=r"gpu.* runs on GPUs\. These can: 'reference', 'inference', 'tiles'"):
        scaled(ONE, by=2, implementation="gpu")
    with pytest.raises(ValueError, match=r"inference.* takes float32, got bfloat16\. These can: 'reference', 'tiles'"):
        scaled(ONE.astype(jnp.bfloat16), by=2, implementation="inference")


def test_the_default_of_a_block_is_a_part_of_the_key_of_compiled_programs(scaled):
    traced = []

    @jax.jit
    def program(x):
        traced.append(1)
        return scaled(x, by=2)

    for _ in range(2):
        np.testing.assert_array_equal(program(ONE), 4)
        with jaxdn.implementation("reference"):
            np.testing.assert_array_equal(program(ONE), 2)
            with jaxdn.implementation("auto"):
                np.testing.assert_array_equal(program(ONE), 4)
            np.testing.assert_array_equal(scaled(ONE, by=2, implementation="tiles"), 5)
    assert len(traced) <= 3  # a default that is not set is another one than "auto"


def test_the_default_of_a_process(scaled, monkeypatch):
    monkeypatch.setenv("JAXDN_IMPLEMENTATION", "reference")
    np.testing.assert_array_equal(scaled(ONE, by=2), 2)
    assert method_named("ntd").backend("training") is None
    with jaxdn.implementation("auto"):
        np.testing.assert_array_equal(scaled(ONE, by=2), 4)
    monkeypatch.setenv("JAXDN_IMPLEMENTATION", "numba")
    with pytest.raises(ValueError, match="JAXDN_IMPLEMENTATION: expected one of auto, reference, got 'numba'"):
        scaled(ONE, by=2)
    with pytest.raises(ValueError, match="implementation: expected one of auto, reference, got 'fast'"):
        jaxdn.implementation("fast")


def test_a_name_is_taken_once(scaled):
    with pytest.raises(ValueError, match="operation scaled: expected a new name"):
        operation(name="scaled")(lambda x: x)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "code", "words"), [("reference", 0, "operations: reference"), ("fast", 2, "got 'fast'")]
)
def test_doctor_lists_operations_by_implementation(value, code, words, monkeypatch):
    monkeypatch.setenv("JAXDN_IMPLEMENTATION", value)
    done = subprocess.run(
        [sys.executable, "-m", "jaxdn.commands.main", "doctor"], capture_output=True, text=True, check=False
    )
    assert done.returncode == code, done.stderr
    assert words in " ".join((done.stdout + done.stderr).split())
    assert "Traceback" not in done.stderr
