"""The filter by affinities and its gradient for GPUs: one kernel each, where XLA starts a hundred.

The same sums as in :mod:`jaxdn.ops.affinity.filter`, gathered: every thread has one pixel, keeps what it adds up in
registers, and walks over the 25 taps. Kernels are written in Pallas and compiled by Triton, which the jax project will
drop some day: without it, XLA does the work.
"""

import functools
import warnings
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.ops.dispatch.operation import platform

_BLOCK = 64
"""Pixels of a row that one block of threads has."""
_RADIUS = 2
_SPAN = 2 * _RADIUS + 1

Planes = list[jax.Array]


@functools.cache
def _installed() -> bool:
    try:
        return find_spec("jax.experimental.pallas.triton") is not None
    except ModuleNotFoundError:  # without Pallas altogether
        return False


def unavailable() -> str:
    """Why programs cannot call these kernels, and what to do; empty if they can."""
    if platform() != "gpu":
        return f"runs on GPUs, and the program is for {platform()!r}"
    return "" if _installed() else "needs jax.experimental.pallas.triton, which this version of jax lacks"


def sum_taps(guides: jax.Array, mass: jax.Array, *, step: int) -> jax.Array:
    """[C, H, W] the sum over all taps of h exp(-d) times ``mass`` [C, H, W].

    ``guides`` [F + 3, H, W]: features, and the slanted guide with its slopes. Taps beyond the border do not count.
    """

    def kernel(guides: Any, mass: Any, out: Any) -> None:
        row, column = _place(step)
        here = _load(guides, row, column)

        def tap(index: jax.Array, sums: Planes) -> Planes:
            dy, dx = _offset(index, step)
            weight = _spline(index) * jnp.exp(-_distance(here, _load(guides, row + dy, column + dx), dy, dx)[0])
            there = _load(mass, row + dy, column + dx)
            return [old + weight * one for old, one in zip(sums, there, strict=True)]

        nothing = [jnp.zeros((_BLOCK,), jnp.float32)] * out.shape[0]
        _store(out, lax.fori_loop(0, _SPAN**2, tap, nothing))

    return _call(kernel, [guides, mass], mass.shape[0], step=step)


def gather_gradients(
    guides: jax.Array,
    confidence: jax.Array,
    image: jax.Array,
    gains: jax.Array,
    level: jax.Array,
    *,
    step: int,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """By the image [C, H, W], by its confidence [H, W] and by the guides [F + 3, H, W].

    ``gains`` [C, H, W] is the cotangent over the sum of weights, ``level`` [H, W] its product with the result.
    """
    channels, count = image.shape[0], guides.shape[0]

    def kernel(guides: Any, light: Any, gains: Any, out: Any) -> None:
        row, column = _place(step)
        here, (*x, trust), (*g, own) = (_load(each, row, column) for each in (guides, light, gains))

        def tap(index: jax.Array, sums: Planes) -> Planes:
            dy, dx = _offset(index, step)
            there, (*others, other_trust), (*given, other_level) = (
                _load(each, row + dy, column + dx) for each in (guides, light, gains)
            )
            distance, residual = _distance(here, there, dy, dx)
            weight = _spline(index) * jnp.exp(-distance)
            p_takes, q_takes = _dot(g, others) - own, _dot(given, x) - other_level
            by_distance = -2.0 * weight * (other_trust * p_takes + trust * q_takes)
            by_residual = by_distance * residual
            by_image = [old + weight * trust * gain for old, gain in zip(sums, given, strict=False)]
            by_trust, *by_guides = sums[channels:]
            features = [
                old + by_distance * (one - other)
                for old, one, other in zip(by_guides[:-3], here[:-3], there[:-3], strict=True)
            ]
            z, slope_x, slope_y = by_guides[-3:]
            right, down = (0.5 * by_residual * each.astype(jnp.float32) for each in (dx, dy))
            slanted = [z - by_residual, slope_x - right, slope_y - down]
            return [*by_image, by_trust + weight * q_takes, *features, *slanted]

        nothing = [jnp.zeros((_BLOCK,), jnp.float32)] * out.shape[0]
        _store(out, lax.fori_loop(0, _SPAN**2, tap, nothing))

    light, taken = jnp.concatenate([image, confidence[None]]), jnp.concatenate([gains, level[None]])
    found = _call(kernel, [guides, light, taken], channels + 1 + count, step=step)
    return found[:channels], found[channels], found[channels + 1 :]


def _call(kernel: Callable[..., None], arrays: Sequence[jax.Array], channels: int, *, step: int) -> jax.Array:
    """[channels, H, W] what a kernel stores, given arrays [?, H, W] with zeros around, as far as taps reach."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    _, height, width = arrays[0].shape
    margin, beyond = _RADIUS * step, -width % _BLOCK
    wide = [jnp.pad(each, ((0, 0), (margin, margin), (margin, margin + beyond))) for each in arrays]
    shape = jax.ShapeDtypeStruct((channels, height, width + beyond), jnp.float32)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*Triton.*", category=DeprecationWarning)
        found = pallas.pallas_call(
            kernel,
            out_shape=shape,
            grid=(height, (width + beyond) // _BLOCK),
            compiler_params=triton.CompilerParams(num_warps=_BLOCK // 32, num_stages=1),
            # Tests compare the same kernels where there is no GPU.
            interpret=jax.default_backend() != "gpu",
        )(*wide)
    return found[..., :width]


def _place(step: int) -> tuple[jax.Array, jax.Array]:
    """Row and first column of a block's pixels, in arrays with a margin."""
    from jax.experimental import pallas

    return pallas.program_id(0) + _RADIUS * step, pallas.program_id(1) * _BLOCK + _RADIUS * step


def _load(planes: Any, row: jax.Array, column: jax.Array) -> Planes:
    from jax.experimental import pallas

    return [planes[index, row, pallas.ds(column, _BLOCK)] for index in range(planes.shape[0])]


def _store(out: Any, planes: Planes) -> None:
    from jax.experimental import pallas

    row, column = pallas.program_id(0), pallas.program_id(1) * _BLOCK
    for index, plane in enumerate(planes):
        out[index, row, pallas.ds(column, _BLOCK)] = plane


def _offset(index: jax.Array, step: int) -> tuple[jax.Array, jax.Array]:
    """(y, x) in pixels."""
    return step * (lax.div(index, _SPAN) - _RADIUS), step * (lax.rem(index, _SPAN) - _RADIUS)


def _spline(index: jax.Array) -> jax.Array:
    """h of a tap: :data:`jaxdn.ops.affinity.filter.SPLINE` as the quadratic through its three values."""
    dy, dx = (jnp.abs(offset).astype(jnp.float32) for offset in _offset(index, 1))
    return (0.375 - dy * (0.09375 + 0.03125 * dy)) * (0.375 - dx * (0.09375 + 0.03125 * dx))


def _distance(here: Planes, there: Planes, dy: jax.Array, dx: jax.Array) -> tuple[jax.Array, jax.Array]:
    """d, and the residual of the slanted guide."""
    (z, slope_x, slope_y), (other_z, other_x, other_y) = here[-3:], there[-3:]
    along = dx.astype(jnp.float32) * (slope_x + other_x) + dy.astype(jnp.float32) * (slope_y + other_y)
    residual = other_z - z - 0.5 * along
    total = residual * residual
    for one, other in zip(here[:-3], there[:-3], strict=True):
        total = total + (one - other) * (one - other)
    return total, residual


def _dot(one: Planes, other: Planes) -> jax.Array:
    return functools.reduce(jnp.add, [a * b for a, b in zip(one, other, strict=True)])
