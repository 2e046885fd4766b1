"""Edge-stopped averages over a sparse stencil: the a-trous wavelet filter and its relatives.

The weight of a tap q at pixel p is its stencil weight h times edge-stopping weights that the caller chooses (Dammertz
et al., "Edge-Avoiding A-Trous Wavelet Transform for fast Global Illumination Filtering", 2010; Schied et al. 2017).

Arrays here are planar, ``[C, H, W]``; the work is done strip by strip (:mod:`jaxdn.filters.stencil_tiles`).
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.filters.edge_stopping import Weight
from jaxdn.filters.stencil_tiles import pad_guides, plan_tiles, weighted_sums

B3_SPLINE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
GAUSSIAN = np.array([0.279, 0.442, 0.279])
"""Three taps of a Gaussian: a third of the 5 x 5 taps' work, and half of their reach."""


def stencil(radius: int, *, kernel: np.ndarray | None = None) -> np.ndarray:
    """Rows of (dy, dx, h) of a square stencil, the centre first; ``kernel`` is 1-D and separable, ``None`` all ones."""
    line = np.ones(2 * radius + 1) if kernel is None else kernel
    taps = [
        (dy, dx, line[dy + radius] * line[dx + radius])
        for dy in range(-radius, radius + 1)
        for dx in range(-radius, radius + 1)
    ]
    return np.array(sorted(taps, key=lambda tap: tap[0] != 0 or tap[1] != 0))


def edge_average(
    values: jax.Array,
    hit: jax.Array | None,
    weights: Sequence[Weight],
    taps: np.ndarray,
    *,
    step: int | jax.Array = 1,
    step_max: int = 1,
    variance: jax.Array | None = None,
    needed: jax.Array | None = None,
    with_total: bool = False,
) -> tuple[jax.Array, jax.Array | None]:
    """Weighted mean of ``values`` [C, H, W] over ``taps``, and the variance of this mean.

    Taps outside the image or without a surface have weight 0, the centre has exactly h. A pixel without taps, or whose
    weights sum to less than 1e-10, gives 0.

    Args:
      values: planes to average.
      hit: [H, W] bool, a surface is seen; other pixels are never taps. Or numbers in [0, 1]: how much each
        pixel counts. None: all count.
      weights: edge-stopping weights, see :mod:`jaxdn.filters.edge_stopping`.
      taps: rows of (dy, dx, h), see :func:`stencil`.
      step: spacing of the taps; it may be traced, so that all levels share one compiled loop, up to ``step_max``.
      step_max: the largest ``step``.
      variance: [H, W], becomes ``sum w^2 variance / (sum w)^2``.
      needed: [H, W] bool, strips of the image without a needed pixel are skipped and come back as 0.
      with_total: the mean gets another plane, the sum of weights.
    """
    _, height, width = values.shape
    planes = values.shape[0] + with_total
    dtype = values.dtype
    tiles = plan_tiles(height, width, taps, step_max=step_max)
    inside = jnp.ones((height, width), dtype) if hit is None else hit.astype(dtype)
    # Masked pixels enter as zeros in the sums and in the sum of weights.
    summed = [tiles.pad(plane * inside) for plane in values]
    spread = None if variance is None else tiles.pad(variance * inside)
    guides, inside = pad_guides(tiles, weights), tiles.pad(inside)

    def strip(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        sums = weighted_sums(tiles, top, taps, step, weights, guides, summed, inside, spread)
        mean, filtered = sums.mean()
        return jnp.stack([*mean, *([sums.total] if with_total else [])]), filtered

    def skipped(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        nothing = jnp.zeros((planes, tiles.rows, width), dtype)
        return nothing, None if spread is None else jnp.zeros((tiles.rows, width), dtype)

    wanted = None if needed is None else tiles.pad_rows(needed)

    def one(top: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        if wanted is None:
            return strip(top)
        return lax.cond(jnp.any(tiles.row(top, wanted)), strip, skipped, top)

    if tiles.strips == 1:
        return one(jnp.zeros((), jnp.int32))
    mean, filtered = lax.map(one, tiles.rows * jnp.arange(tiles.strips, dtype=jnp.int32))
    mean = mean.transpose(1, 0, 2, 3).reshape(planes, -1, width)[:, :height]
    return mean, None if filtered is None else filtered.reshape(-1, width)[:height]
