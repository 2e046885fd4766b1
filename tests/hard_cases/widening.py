"""Does a function widen its half-precision inputs before it computes anything with them?

Every denoiser does: sanitising, its first step, makes all buffers float32. Its program for bfloat16 inputs is then the
one for float32 inputs behind conversions that are exact, and need not be compiled a second time.
"""

import math
from collections.abc import Mapping, Sequence
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

_MOVES = frozenset({
    *("slice", "dynamic_slice", "squeeze", "reshape", "transpose", "broadcast_in_dim", "rev", "copy", "copy_p"),
    *("is_finite", "scan", "jit", "pjit", "closed_call"),
})  # fmt: skip
"""Primitives that move values or judge them exactly, and those whose inner programs are compared too."""
_RULES = frozenset({"bwd", "fwd_jaxpr_thunk", "jvp_jaxpr_fun", "out_trees", "rule"})
"""Parameters with the rule of a derivative or of batching, which each trace makes anew: those of the same operation."""


def widen(tree: Any) -> Any:
    """Every bfloat16 number in single precision, exactly."""
    return jax.tree.map(lambda leaf: leaf.astype(np.float32) if leaf.dtype == jnp.bfloat16 else leaf, tree)


def widens_first(wide: ClosedJaxpr, narrow: ClosedJaxpr) -> bool:
    """Whether ``narrow``, a trace with bfloat16 inputs, is ``wide``, the same with float32 inputs, after conversions.

    Both are walked in step. Until it is converted to float32 a narrow value may only be moved (sliced, reshaped,
    scanned over ...) or asked whether it is finite: no rounding can then differ. Results have to have the same types.
    False whenever that is not certain.
    """
    return wide.out_avals == narrow.out_avals and _same_closed(wide, narrow)


def _same_closed(wide: ClosedJaxpr, narrow: ClosedJaxpr) -> bool:
    return _same_program(wide.jaxpr, narrow.jaxpr) and _same(wide.consts, narrow.consts)


def _same_program(wide: Jaxpr, narrow: Jaxpr) -> bool:
    twins: dict[Any, Any] = {}  # a variable of narrow -> that of wide
    if len(wide.invars) != len(narrow.invars) or len(wide.constvars) != len(narrow.constvars):
        return False
    twins.update(zip([*narrow.constvars, *narrow.invars], [*wide.constvars, *wide.invars], strict=True))
    remaining = iter(wide.eqns)
    for equation in narrow.eqns:
        if _converts(equation) and _is_twin(twins, equation.invars[0]) and _is_narrow(twins, equation.invars[0]):
            if equation.params["new_dtype"] != twins[equation.invars[0]].aval.dtype:
                return False
            twins[equation.outvars[0]] = twins[equation.invars[0]]
            continue
        other = next(remaining, None)
        if other is None or not _same_equation(twins, other, equation):
            return False
        twins.update(zip(equation.outvars, other.outvars, strict=True))
    results = zip(wide.outvars, narrow.outvars, strict=True)
    return next(remaining, None) is None and all(_same_operand(twins, *pair) for pair in results)


def _converts(equation: Any) -> bool:
    return equation.primitive.name == "convert_element_type"


def _is_twin(twins: Mapping[Any, Any], operand: Any) -> bool:
    return not isinstance(operand, Literal) and operand in twins


def _is_narrow(twins: Mapping[Any, Any], operand: Any) -> bool:
    """Whether a variable has fewer bits than its twin."""
    return operand.aval.dtype == jnp.bfloat16 and twins[operand].aval.dtype == jnp.float32


def _same_operand(twins: Mapping[Any, Any], wide: Any, narrow: Any) -> bool:
    if isinstance(narrow, Literal) or isinstance(wide, Literal):
        return type(narrow) is type(wide) and narrow.aval == wide.aval and _same(narrow.val, wide.val)
    return twins.get(narrow) is wide


def _same_equation(twins: Mapping[Any, Any], wide: Any, narrow: Any) -> bool:
    name = narrow.primitive.name
    if name != wide.primitive.name or len(wide.invars) != len(narrow.invars):
        return False
    if not all(_same_operand(twins, *pair) for pair in zip(wide.invars, narrow.invars, strict=True)):
        return False
    narrowed = any(_is_twin(twins, operand) and _is_narrow(twins, operand) for operand in narrow.invars)
    if narrowed and name not in _MOVES:
        return False
    if wide.params.keys() != narrow.params.keys():
        return False
    return all(_same(wide.params[key], narrow.params[key]) for key in wide.params.keys() - _RULES)


def _same(wide: Any, narrow: Any) -> bool:
    """Whether two parameters of an equation are equal: programs by what they compute, all else by value."""
    if isinstance(wide, ClosedJaxpr):
        return isinstance(narrow, ClosedJaxpr) and _same_closed(wide, narrow)
    if isinstance(wide, Jaxpr):
        return isinstance(narrow, Jaxpr) and _same_program(wide, narrow)
    if isinstance(wide, (np.ndarray, np.generic, jax.Array)):
        return np.array_equal(wide, narrow, equal_nan=jnp.issubdtype(wide.dtype, jnp.floating))
    if isinstance(wide, Sequence) and not isinstance(wide, str):
        return isinstance(narrow, Sequence) and len(wide) == len(narrow) and all(map(_same, wide, narrow))
    if isinstance(wide, FunctionType):  # a callback: each trace makes its own of the same code
        return (
            isinstance(narrow, FunctionType) and wide.__code__ is narrow.__code__ and _same(_held(wide), _held(narrow))
        )
    if isinstance(wide, float) and math.isnan(wide):
        return isinstance(narrow, float) and math.isnan(narrow)
    return bool(wide == narrow)


def _held(function: FunctionType) -> list[Any]:
    """What a function holds besides its code."""
    return [
        function.__defaults__,
        function.__kwdefaults__,
        *(cell.cell_contents for cell in function.__closure__ or ()),
    ]
