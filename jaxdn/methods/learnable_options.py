"""Filters that learn: options that training moves within their declared ranges.

A filter's constants (how fast its history follows, how strict its edges are) are options, marked ``LEARNABLE`` or
``LEARNABLE_PER_LEVEL``. Its params hold for each of them one number x, or one for each level of the filter: how far
training has moved the option from its value v. x = 0, and likewise an absent name, leaves it where it is; no x leaves
its range. With a range from l to h, the odds ``(v - l) / (h - v)`` are multiplied by ``exp(x)``; without an upper
end, ``v - l`` is. An option at the end of its range stays there.
"""

import dataclasses
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.options import Range
from jaxdn.denoiser import Params
from jaxdn.recipes.objectives import pyramid_illumination
from jaxdn.recipes.recipe import Recipe

Options = TypeVar("Options")


class Learnable:
    """The mark of an option that training may move."""


LEARNABLE = Learnable()
"""One number."""
LEARNABLE_PER_LEVEL = Learnable()
"""One number for each level of the filter, as many as the option ``levels`` says."""


FITTING = Recipe(pyramid_illumination(), steps=300, learning_rate=0.05, average=0.95)
"""How a filter's options are fitted: few numbers that all pixels share take large steps."""


def zero_offsets(options: Any) -> Params:
    """The params of a filter before training: name -> 0, or [levels] zeros. An option that is None has none."""
    counts = {name: () if mark is LEARNABLE else (options.levels,) for name, (mark, _) in _marked(options).items()}
    return {name: jnp.zeros(shape) for name, shape in counts.items() if 0 not in shape}


def learnable_values(options: Any) -> dict[str, float]:
    """Name -> value of the options that training may move: what the params of a filter are offsets from."""
    return {name: getattr(options, name) for name in _marked(options)}


def apply_offsets(options: Options, params: Params) -> Options:
    """The options with those that ``params`` names as arrays, () or [levels]; the others as they are.

    Raises ValueError for a name that is not an option's that may be moved.
    """
    marked = _marked(options)
    if unknown := [name for name in params if name not in marked]:
        raise ValueError(f"expected params out of {', '.join(marked)}, got {', '.join(map(repr, unknown))}.")
    values = {name: _within(marked[name][1], getattr(options, name), offset) for name, offset in params.items()}
    return dataclasses.replace(options, **values)  # type: ignore[type-var]


def at_level(value: Any, level: Any) -> Any:
    """An option's value at one level, counted from 0; one number is that of all levels."""
    return value[level] if jnp.ndim(value) else value


def _marked(options: Any) -> dict[str, tuple[Learnable, Range]]:
    """Name -> mark and range of the options that may be moved."""
    found = {}
    for name, hint in get_type_hints(type(options), include_extras=True).items():
        if get_origin(hint) is Annotated and getattr(options, name) is not None:
            facts = get_args(hint)[1:]
            marks = [fact for fact in facts if isinstance(fact, Learnable)]
            ranges = [fact for fact in facts if isinstance(fact, Range)]
            if marks:
                found[name] = (marks[0], ranges[0])
    return found


def _within(allowed: Range, value: float, offset: jax.Array) -> jax.Array:
    """``value`` moved by ``offset``."""
    with np.errstate(divide="ignore"):  # at the ends of a range
        above, below = np.log([value - allowed.low, allowed.high - value])
    if allowed.high == float("inf"):
        return allowed.low + jnp.exp(above + offset)
    return allowed.low + (allowed.high - allowed.low) * jax.nn.sigmoid(above - below + offset)
