"""All combinations of cases, functions, precisions and directions with their results: one row per cell."""

from collections.abc import Iterable, Iterator, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tests.compiling import AS_USERS, PLAIN
from tests.hard_cases.cases import Case
from tests.hard_cases.functions import Function, gradient_of, narrow_gradient
from tests.hard_cases.inputs import HEIGHT, WIDTH, Inputs, good
from tests.hard_cases.programs import Options, Program, Widening
from tests.hard_cases.widening import widen

PRECISIONS = ("float32", "bfloat16 inputs")
DIRECTIONS = ("forward", "gradient")
ERROR_BOUND = {"single": 2e-3, "half": 0.1}
"""Largest error against the same function in double precision on the same inputs, relative to its largest value.

``half`` is for results in bfloat16.
"""
STEEPEST = 1e9
"""A gradient beyond this counts as infinite."""

_MOST, _LEAST = float(np.finfo(np.float32).max), float(np.finfo(np.float32).tiny)


class Row(NamedTuple):
    """One cell of the table."""

    case: str
    function: str
    kind: str
    """``denoiser`` or ``operation``."""
    precision: str
    direction: str
    finite: bool
    largest: float
    """Largest magnitude of the result."""
    error: float | None
    """Against double precision, where that is finite; None where there is nothing to compare."""
    verdict: str
    """``green``, ``red``, ``input`` where a pure function passes on NaN or infinity, ``none`` without gradients."""
    reason: str
    """The reason of a verdict that is not green."""


def rows(
    cases: Iterable[Case],
    functions: Sequence[Function],
    *,
    precisions: Sequence[str] = PRECISIONS,
    directions: Sequence[str] = DIRECTIONS,
    compared: bool = True,
    compiler_options: Options = AS_USERS,
    pictures: dict[tuple[str, str], np.ndarray] | None = None,
) -> Iterator[Row]:
    """Every cell; one compiled program for each function, direction, size and, where it does not widen, precision.

    A function that widens its bfloat16 inputs before it computes (:mod:`tests.hard_cases.widening`) is one program for
    both precisions: it gets the same numbers as float32, and its gradients are rounded to bfloat16 afterwards.

    Without ``compared`` no program in double precision is made, and no row has an ``error``: for functions that
    sanitize, because double precision tells what others may pass on. ``compiler_options`` are those of the programs in
    single precision, but for gradients of the sizes that one case has, which LLVM does not optimise. ``pictures`` is
    filled with the last image [H, W, 3] that each case and pictured function gives in single precision.
    """
    assert compared or all(function.sanitizes for function in functions)
    cases = list(cases)
    for function in functions:
        params = function.begin()
        wide = _widened(params)
        widening = Widening(function.run)
        for direction in directions:
            forward = direction == "forward"
            if not (forward or function.differentiable):
                yield from _without_gradient(function, cases, precisions)
                continue
            called = function.run if forward else gradient_of(function.run)
            run = Program(called, partial(_options_of_size, compiler_options, forward=forward))
            # The comparison runs once for each case.
            double = Program(called, lambda _: PLAIN)
            for precision in precisions:
                for case in cases:
                    given = _given(case, precision)
                    if widening(params, given.inputs):
                        found = run(params, given.single)
                        found = found if forward else narrow_gradient(found, given.inputs)
                    else:
                        found = run(params, given.inputs)
                    truth = _exact(double, wide, given.double) if compared else None
                    yield _judge(case.name, function, precision, direction, found, truth, given)
                    if pictures is not None and function.pictured and forward and precision == "float32":
                        pictures[case.name, function.name] = np.asarray(found).reshape(-1, *found.shape[-3:])[-1]


def _options_of_size(usual: Options, inputs: Inputs, *, forward: bool) -> Options:
    """Of gradients, those of the usual size alone are compiled as ``usual``: each of the others has one case."""
    return usual if forward or inputs.clip.frames.radiance.shape[1:3] == (HEIGHT, WIDTH) else PLAIN


class _Given(NamedTuple):
    """The inputs of a case in one precision, and what every function has to know of them."""

    inputs: Inputs
    single: Inputs
    """The same numbers with no bfloat16 among them."""
    double: Inputs
    infinite: bool
    brightest: float
    """The largest magnitude of their radiance."""


@cache
def _given(case: Case, precision: str) -> _Given:
    """Made once: no function can change what the next one is given."""
    inputs = cast(case.make(good()), precision)
    for leaf in jax.tree.leaves(inputs):
        leaf.setflags(write=False)
    brightest = float(np.max(np.abs(_leaves(inputs.clip.frames.radiance)), initial=0.0))
    return _Given(inputs, widen(inputs), _widened(inputs), _infinite(inputs), brightest)


def _exact(double: Program, wide: Any, inputs: Inputs) -> Any:
    with jax.enable_x64(True):
        return double(wide, inputs)


def _without_gradient(function: Function, cases: Iterable[Case], precisions: Sequence[str]) -> Iterator[Row]:
    for precision in precisions:
        for case in cases:
            about = (case.name, function.name, function.kind, precision, "gradient")
            yield Row(*about, True, 0.0, None, "none", "no gradient")


def cast(inputs: Inputs, precision: str) -> Inputs:
    """Half-precision inputs, as a file or a GPU gives them."""
    if precision == "float32":
        return inputs

    def half(array: Any) -> Any:
        array = np.asarray(array)
        return array.astype(jnp.bfloat16) if array.dtype == np.float32 else array

    return jax.tree.map(half, inputs)


def _widened(tree: Any) -> Any:
    """Every number in double precision."""

    def widen(array: Any) -> np.ndarray:
        array = np.asarray(array)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            return array
        wide = array.astype(np.float64)
        return np.where(np.abs(wide) < _LEAST, 0.0, wide)  # as the hardware reads them

    return jax.tree.map(widen, tree)


def _leaves(tree: Any) -> np.ndarray:
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    kept = [leaf.astype(np.float64).ravel() for leaf in leaves if leaf.dtype != jax.dtypes.float0]
    return np.concatenate(kept) if kept else np.zeros(0)


def _judge(
    case: str, function: Function, precision: str, direction: str, result: Any, exact: Any, given: _Given
) -> Row:
    found = _leaves(result)
    truth = found if exact is None else _leaves(exact)
    finite = np.isfinite(found)
    representable = np.isfinite(truth) & (np.abs(truth) <= _MOST)
    both = finite & representable
    largest = float(np.max(np.abs(found[finite]), initial=0.0))
    lowest = float(np.min(found[finite], initial=0.0))
    error = None
    # A pure function of infinity saturates at the largest number of its own precision: nothing to compare there.
    if exact is not None and (function.sanitizes or not given.infinite):
        # Below the smallest normal number XLA:CPU rounds to 0, as most hardware does.
        scale = max(float(np.max(np.abs(truth[both]), initial=0.0)), 1e3 * _LEAST)
        size = min(1.0, given.brightest)
        if scale < 1e-9 * size:  # 0 because its terms cancel: equal up to the rounding of the terms
            scale = 1e-4 * size
        error = float(np.max(np.abs(found[both] - truth[both]), initial=0.0)) / scale
    reduced = jax.tree.leaves(result)[0].dtype == jnp.bfloat16
    bound = ERROR_BOUND["half" if reduced else "single"]

    # Not finite in double precision either: it comes from the input or is the true value (an infinite PSNR).
    excused = np.zeros_like(finite) if function.sanitizes else ~representable
    verdict, reason = "green", ""
    if not np.all(finite | excused):
        verdict, reason = "red", f"{int(np.sum(~finite & ~excused))} values are not finite"
    elif direction == "gradient" and largest > STEEPEST and function.sanitizes:
        verdict, reason = "red", f"a gradient of {largest:.1e}"
    elif direction == "forward" and lowest < function.bounds[0] - 1e-6:
        verdict, reason = "red", f"{lowest:.3g} is below {function.bounds[0]:g}"
    elif direction == "forward" and largest > function.bounds[1]:
        verdict, reason = "red", f"{largest:.3g} is above {function.bounds[1]:g}"
    elif direction == "forward" and error is not None and error > bound:
        verdict, reason = "red", f"relative error {error:.1e}"
    elif not np.all(finite):
        verdict, reason = "input", "not finite in double precision either"
    return Row(
        case, function.name, function.kind, precision, direction, bool(np.all(finite)), largest, error, verdict, reason
    )


def _infinite(inputs: Inputs) -> bool:
    """Whether any input of an operation has an infinity."""
    frames = inputs.clip.frames
    read = (frames.radiance, frames.motion, frames.dual_motion, frames.normal, inputs.clip.reference, inputs.logits)
    return any(bool(np.any(np.isinf(np.asarray(array).astype(np.float64)))) for array in read)
