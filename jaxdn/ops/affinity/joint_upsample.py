"""Joint bilateral upsampling: a coarse image at twice the size, its edges taken from guides at full resolution.

Kopf et al. 2007, "Joint Bilateral Upsampling". Bilinear enlarging carries light across silhouettes, and adding only
what the coarse image changed leaves noise of two to four pixels in the fine one.

The four fine pixels of a block are four planes of the coarse image's size: all work runs along contiguous rows, on CPUs
in tiles that fit into the cache, over a scan of the nine taps (as in :mod:`jaxdn.ops.affinity.filter`).
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.ops.affinity.filter import Guide, affinity, draw_guide
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.dispatch.row_tiles import rows_per_tile

_SPREAD = 3.0
"""Twice the variance of the spatial weights, in pixels of the fine image."""
_TILE_PIXELS = 4096
"""Approximate number of coarse pixels in a tile."""
_NO_WEIGHT = 1e-6

Planes = list[jax.Array]


@operation
def joint_bilateral_upsample(coarse: jax.Array, there: Guide, here: Guide) -> tuple[jax.Array, jax.Array]:
    """The coarse image [C, h, w] as [C, 2h, 2w], and the sum of weights [2h, 2w] in [0, 1].

    Every fine pixel takes the mean of the 3x3 coarse pixels around it, weighted by their distance, confidence and
    affinity as in :mod:`jaxdn.ops.affinity.filter`. ``there`` guides the coarse pixels, ``here`` the fine ones: its
    confidence is not used, and its scales are those of both. The slanted guide of a coarse pixel is that of the upper
    left of its four pixels, and its slopes are those per fine pixel. Where no coarse pixel is alike, the sum of weights
    is 0 and so is the image.
    """
    return _normalize(_sum_taps(coarse, there._replace(scales=here.scales).scaled(), here.scaled()))


@joint_bilateral_upsample.implementation("unrolled", platforms=("gpu",))
def _upsample_unrolled(coarse: jax.Array, there: Guide, here: Guide) -> tuple[jax.Array, jax.Array]:
    """Without a scan: a GPU would start hundreds of small kernels, and scatter in the gradient."""
    return _normalize(_sum_unrolled_taps(coarse, there._replace(scales=here.scales).scaled(), here.scaled()))


def _normalize(totals: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The image and the sum of weights, from the sums of the taps."""
    weight = totals[-1:]
    some = weight > _NO_WEIGHT
    return jnp.where(some, totals[:-1] / jnp.where(some, weight, 1.0), 0.0), jnp.where(some, weight, 0.0)[0]


@numba_call.implements(joint_bilateral_upsample)
def _upsample_by_numba(coarse: jax.Array, there: Guide, here: Guide) -> tuple[jax.Array, jax.Array]:
    from jaxdn.ops.affinity.numba_kernels import upsample_rows

    channels, height, width = coarse.shape
    fine = 2 * height, 2 * width
    arrays = [coarse, *there[:3], here.features, here.slanted, here.factors()]
    numbers = _spatial()[1].reshape(3, 3, 2, 2).astype(np.float32), np.float32(_NO_WEIGHT)
    image, weight = numba_call.call(upsample_rows, [(channels, *fine), fine], arrays, *numbers, rows=fine[0])
    return image, weight


def _sum_unrolled_taps(coarse: jax.Array, there: Guide, here: Guide) -> jax.Array:
    """As :func:`_sum_taps`, without a scan."""
    height, width = coarse.shape[1:]
    guides = jnp.pad(jnp.concatenate([there.features, there.slanted]), ((0, 0), (1, 1), (1, 1)), mode="edge")
    mass = jnp.concatenate([coarse * there.confidence[None], there.confidence[None]])
    mass = jnp.pad(mass, ((0, 0), (1, 1), (1, 1)))
    fine = jnp.concatenate([here.features, here.slanted]).reshape(-1, height, 2, width, 2)
    offsets, spatial = _spatial()
    found = []
    for phase, (row, column) in enumerate(np.ndindex(2, 2)):
        own = list(fine[:, :, row, :, column])
        total = jnp.zeros_like(mass[:, 1:-1, 1:-1])
        for (top, left), offset, near in zip(np.ndindex(3, 3), offsets[:, phase], spatial[:, phase], strict=True):
            at = slice(top, top + height), slice(left, left + width)
            dy, dx = (jnp.asarray(each, coarse.dtype) for each in offset)
            weight = jnp.asarray(near, coarse.dtype) * affinity(own, list(guides[:, *at]), dy, dx)
            total = total + weight[None] * mass[:, *at]
        found.append(total)
    return jnp.stack(found).reshape(2, 2, -1, height, width).transpose(2, 3, 0, 4, 1).reshape(-1, 2 * height, 2 * width)


def _sum_taps(coarse: jax.Array, there: Guide, here: Guide) -> jax.Array:
    """[C + 1, 2h, 2w] the weighted sum of every fine pixel's taps and of their weights."""
    channels, height, width = coarse.shape
    rows = rows_per_tile(height, width, pixels=_TILE_PIXELS)
    count = -(-height // rows)
    below = count * rows - height

    def around(plane: jax.Array) -> jax.Array:
        return jnp.pad(jnp.pad(plane, 1, mode="edge"), ((0, below), (0, 0)))

    def outside(plane: jax.Array) -> jax.Array:
        return jnp.pad(plane, ((1, 1 + below), (1, 1)))

    guides = [around(plane) for plane in (*there.features, *there.slanted)]
    mass = [outside(plane * there.confidence) for plane in coarse] + [outside(there.confidence)]
    fine = jnp.concatenate([here.features, here.slanted]).reshape(-1, height, 2, width, 2).transpose(2, 4, 0, 1, 3)
    blocks = jnp.pad(fine, ((0, 0), (0, 0), (0, 0), (0, below), (0, 0))).reshape(4, -1, height + below, width)
    taps = _taps(coarse.dtype)

    def tile(top: jax.Array | int) -> jax.Array:
        def at(planes: Planes, shift: jax.Array | np.ndarray) -> Planes:
            return [lax.dynamic_slice(plane, (top + 1 + shift[0], 1 + shift[1]), (rows, width)) for plane in planes]

        own = [list(planes) for planes in lax.dynamic_slice_in_dim(blocks, top, rows, 2)]

        def weigh(tap: _Taps) -> Planes:
            other = at(guides, tap.shift)
            return [
                tap.spatial[phase] * affinity(planes, other, *tap.offset[phase]) for phase, planes in enumerate(own)
            ]

        def add(totals: list[Planes], shift: jax.Array, weights: Planes) -> list[Planes]:
            found = at(mass, shift)
            return [
                [old + weight * one for old, one in zip(total, found, strict=True)]
                for total, weight in zip(totals, weights, strict=True)
            ]

        # The weights of one tap are computed while those of the tap before are used, see affinity_filter.
        def body(carry: _Carry, tap: _Taps) -> tuple[_Carry, None]:
            return (add(*carry), tap.shift, weigh(tap)), None

        first = jax.tree.map(lambda each: each[0], taps)
        empty = [[jnp.zeros((rows, width), coarse.dtype)] * len(mass) for _ in own]
        rest = jax.tree.map(lambda each: each[1:], taps)
        carry, _ = lax.scan(body, (empty, first.shift, weigh(first)), rest)
        return jnp.stack([jnp.stack(planes) for planes in add(*carry)])

    found = tile(0)[None] if count == 1 else lax.map(tile, rows * jnp.arange(count, dtype=jnp.int32))
    found = found.reshape(count, 2, 2, channels + 1, rows, width).transpose(3, 0, 4, 1, 5, 2)
    return found.reshape(channels + 1, 2 * count * rows, 2 * width)[:, : 2 * height]


class _Taps(NamedTuple):
    """The taps of a block's four pixels, row by row; stacked."""

    shift: jax.Array
    """[2] int32 (y, x) to the coarse pixel."""
    spatial: jax.Array
    """[4] its spatial weight for each of the four; of the nine taps they sum to 1."""
    offset: jax.Array
    """[4, 2] (y, x) from each of the four to the upper left fine pixel of the coarse one."""


_Carry = tuple[list[Planes], jax.Array, Planes]


def _taps(dtype: jnp.dtype) -> _Taps:
    offset, spatial = _spatial()
    shift = offset[:, 0] // 2  # of the upper left pixel of a block
    return _Taps(jnp.asarray(shift, jnp.int32), jnp.asarray(spatial, dtype), jnp.asarray(offset, dtype))


def _spatial() -> tuple[np.ndarray, np.ndarray]:
    """Of the nine taps of a block's four pixels, row by row: offsets [9, 4, 2] and spatial weights [9, 4]."""
    shift = np.array([(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    offset = 2 * shift[:, None] - np.array(list(np.ndindex(2, 2)))
    # The centre of a coarse pixel lies between its four.
    spatial = np.exp(-np.sum(np.square(offset + 0.5), axis=-1) / _SPREAD)
    return offset, spatial / spatial.sum(axis=0)


@joint_bilateral_upsample.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    here = draw_guide(rng, 2 * height, 2 * width, scales=np.array([0.5, 1.0, 0.7, 0.1, 1.5]))
    yield Example((rng.random((3, height, width)), draw_guide(rng, height, width), here))
