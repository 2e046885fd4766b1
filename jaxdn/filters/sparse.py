"""Edge-stopped averages of few pixels: the same as :func:`jaxdn.filters.atrous.edge_average`, with time in proportion.

Pixels whose history is short are few but everywhere along the edges of things, so that hardly a strip of the image is
without one. Here the taps of these pixels alone are fetched.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.edge_stopping import TapOffset, Weight
from jaxdn.filters.stencil_tiles import NO_WEIGHT
from jaxdn.ops.dispatch.operation import ANY, platform
from jaxdn.ops.dispatch.row_tiles import evaluate_sparsely

_WORTH = 100_000
"""Pixels of an image from which on the two ways are compiled."""
_FEW = 1 / 4
"""The share of pixels above which fetching the taps one by one takes longer."""


def choose_sparse(needed: jax.Array, few: Callable[[], Any], many: Callable[[], Any]) -> Any:
    """``few()`` where few pixels are ``needed`` [H, W], else ``many()``; both give the same.

    Small images, and portable programs, whose images may be small, have ``many()`` alone.
    """
    if platform() == ANY or needed.size < _WORTH:
        return many()
    return lax.cond(jnp.mean(needed, dtype=jnp.float32) < _FEW, few, many)


def sparse_edge_average(
    values: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    taps: np.ndarray,
    needed: jax.Array,
    *,
    step: jax.Array | int = 1,
) -> jax.Array:
    """Weighted mean of ``values`` [C, H, W] over ``taps``, and the sum of weights, for ``needed`` pixels [H, W]:
    [C + 1, H, W], 0 elsewhere.

    The arguments are those of :func:`jaxdn.filters.atrous.edge_average`; the spacing ``step`` of the taps may be one
    [H, W] for each pixel.
    """
    count, height, width = values.shape
    dtype = values.dtype
    inside = jnp.ones((1, height, width), dtype) if hit is None else hit[None].astype(dtype)
    # Masked pixels enter as zeros, in the sums and in the sum of weights.
    layers = [jnp.where(inside > 0, values, 0.0), inside, *(one.there for one in weights)]
    packed = jnp.concatenate(layers).reshape(-1, height * width).T
    own = [[plane.reshape(-1) for plane in one.here] for one in weights]
    steps = jnp.broadcast_to(jnp.asarray(step, jnp.int32), (height, width))
    vectors = jnp.asarray(taps[:, :2], jnp.int32)
    lengths, shares = (jnp.asarray(each, dtype)[None] for each in (np.hypot(taps[:, 0], taps[:, 1]), taps[:, 2]))
    centre = (taps[:, 0] == 0) & (taps[:, 1] == 0)

    def work(part: tuple[jax.Array, jax.Array]) -> list[jax.Array]:
        place, step = part
        row, column = place // width, place % width
        y, x = (at[:, None] + step[:, None] * vectors[None, :, axis] for axis, at in enumerate((row, column)))
        seen = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        found = packed[jnp.clip(y, 0, height - 1) * width + jnp.clip(x, 0, width - 1)]
        planes = [found[..., index] for index in range(found.shape[-1])]
        wide = step[:, None].astype(dtype)
        x_step, y_step = (wide * vectors[None, :, axis].astype(dtype) for axis in (1, 0))
        offset = TapOffset(x_step, y_step, wide * lengths)
        factor, at = jnp.where(seen, planes[count], 0.0) * shares, count + 1
        for one, here in zip(weights, own, strict=True):
            there = planes[at : at + one.there.shape[0]]
            at += len(there)
            given = there, [plane[place][:, None] for plane in here], offset
            stops = one.factor(*given) if one.factor else jnp.ones((), dtype)
            stops = stops * jnp.exp(-one.exponent(*given)) if one.exponent else stops
            factor = factor * jnp.where(centre[None], 1.0, stops)
        total = jnp.sum(factor, axis=1)
        some = total > NO_WEIGHT
        share = factor / jnp.where(some, total, 1.0)[:, None]
        mean = jnp.where(some[:, None], jnp.einsum("nt,ntc->nc", share, found[..., :count]), 0.0)
        return [*(mean[:, index] for index in range(count)), total]

    places = jnp.arange(height * width, dtype=jnp.int32).reshape(height, width)
    return jnp.stack(evaluate_sparsely(work, needed, (places, steps)))
