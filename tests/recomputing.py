"""A program as a compiler may run it: every use of a value computes the value anew, and each time rounds differently.

XLA fuses a cheap operation into each of its users, and the copies need not round alike: in one the product and the sum
are one instruction, in another they are two. A comparison of two almost equal numbers may then be true for one user and
false for the next, within one program. A function withstands that if it is continuous in each comparison by itself.
The random rounding is that of Monte Carlo arithmetic (Parker 1997).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal

_Value = Callable[[], Any]
"""Computes a value anew."""


def evaluate_recomputing(
    function: Callable[..., jax.Array], *arrays: Any, rng: np.random.Generator, rounding: float
) -> np.ndarray:
    """``function(*arrays)``, where each use of a value computes it anew.

    Every computed floating-point number is multiplied by 1 plus ``rounding`` times a normal random number. The time
    grows exponentially with the length of a chain of values that are used twice: for short functions.
    """

    def rounded(value: jax.Array) -> jax.Array:
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return value
        return value * (1.0 + rounding * rng.standard_normal(value.shape)).astype(value.dtype)

    def compute(equation: Any, inputs: Sequence[_Value], index: int) -> Any:
        found = equation.primitive.bind(*(read() for read in inputs), **equation.params)
        return rounded(found[index] if equation.primitive.multiple_results else found)

    def outputs(program: ClosedJaxpr, inputs: Sequence[_Value]) -> list[_Value]:
        known: dict[Any, _Value] = dict(zip(program.jaxpr.invars, inputs, strict=True))
        for name, value in zip(program.jaxpr.constvars, program.consts, strict=True):
            known[name] = lambda value=value: value

        def reads(operands: Sequence[Any]) -> list[_Value]:
            return [(lambda one=one: one.val) if isinstance(one, Literal) else known[one] for one in operands]

        for equation in program.jaxpr.eqns:
            inside = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
            given = reads(equation.invars)
            if inside is not None:
                known.update(zip(equation.outvars, outputs(inside, given), strict=True))
                continue
            for index, name in enumerate(equation.outvars):
                known[name] = lambda equation=equation, given=given, index=index: compute(equation, given, index)
        return reads(program.jaxpr.outvars)

    program = jax.make_jaxpr(function)(*arrays)
    (result,) = outputs(program, [lambda array=array: jnp.asarray(array) for array in jax.tree.leaves(arrays)])
    return np.asarray(result())
