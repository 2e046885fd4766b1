"""Where samples go, and images with any number of samples per pixel, combined from stored independent layers.

Layers of 1, 2, 4, ... samples give every number of samples up to their sum: n samples are the layers of n's binary
digits, each weighted by its number of samples (Hasselgren et al. 2020, "Neural Temporal Adaptive Sampling and
Denoising", sec. 2.2).
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.checks import check_image, check_option
from jaxdn.ops.scales import crop, fill_holes, pad


def from_layers(
    layers: Mapping[int, jax.Array], counts: jax.Array, *, reference: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """The image [H, W, 3] with ``counts`` [H, W, 1] samples per pixel, and the actual counts.

    ``layers`` maps powers of two to independent images [H, W, 3] of that many samples. Counts are rounded and clamped
    to the layers' sum; a pixel without samples is 0. With the ``reference`` [H, W, 3], what the layers converge to, the
    image has a gradient with respect to the counts (:func:`more_samples`), that of a pixel without samples as if it
    were filled from its neighbours (:func:`jaxdn.ops.scales.fill_holes`), as denoisers fill it. Without, no gradient
    flows into them. Raises ValueError unless the layers are 1, 2, 4, ... without a gap.
    """
    expected = [1 << bit for bit in range(len(layers))]
    if sorted(layers) != expected or not layers:
        raise ValueError(f"layers: expected independent layers of 1, 2, 4, ... samples, got {sorted(layers)}.")
    given = lax.stop_gradient(counts)
    whole = jnp.clip(jnp.round(jnp.where(jnp.isfinite(given), given, 0.0)), 0, sum(layers)).astype(jnp.int32)
    total = jnp.zeros_like(layers[1])
    for samples in expected:
        total = total + jnp.where((whole & samples) > 0, samples * layers[samples], 0.0)
    taken = whole.astype(total.dtype)
    image = total / jnp.maximum(taken, 1.0)
    if reference is None:
        return image, taken
    seen = taken > 0
    filled = lax.stop_gradient(
        crop(fill_holes(pad(image, _BLOCK), pad(seen, _BLOCK)), (image.shape[0], image.shape[1]))
    )
    none = more_samples(filled, taken, counts, reference) - filled
    return jnp.where(seen, more_samples(image, taken, counts, reference), none), taken


@jax.custom_vjp
def more_samples(image: jax.Array, taken: jax.Array, counts: jax.Array, reference: jax.Array) -> jax.Array:
    """``image`` [H, W, 3], with the slope of an image by its number of samples.

    ds further samples without noise turn the image I of s samples into ``(s I + ds R) / (s + ds)``, R the reference:
    ``dI/ds = (R - I) / s``, with s at least 1. This is how Kuznetsov et al. 2018, "Deep Adaptive Sampling for Low
    Sample Count Rendering", are read here; their text was not at hand. In another reading noise falls as
    ``1 / sqrt(s)``, and the slope is half of this. No gradient flows into ``reference``.

    Args:
      image: of ``taken`` samples [H, W, 1].
      taken: whole numbers.
      counts: [H, W, 1] the samples that were asked for, which get the gradient.
      reference: what the image converges to.
    """
    return image


def _more_samples(*given: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    return given[0], given


def _of_samples(given: tuple[jax.Array, ...], slope: jax.Array) -> tuple[jax.Array, ...]:
    image, taken, counts, reference = given
    by_count = slope * (reference - image) / jnp.maximum(taken, 1.0)
    asked = jnp.sum(by_count, axis=-1, keepdims=True).astype(counts.dtype)
    return slope, jnp.zeros_like(taken), asked, jnp.zeros_like(reference)


more_samples.defvjp(_more_samples, _of_samples)


_BLOCK = 4
"""Pixels of the largest blocks that are filled."""


def check_budget(budget: float, *, least: int, most: int) -> None:
    """Raise ValueError for a mean number of samples that is not within the fewest and the most of a pixel."""
    if not (least <= budget <= most and budget > 0):
        raise ValueError(
            f"budget: expected a mean number of samples above 0 from {least} to {most}, the fewest and the most that a "
            f"pixel can have, got {budget:g}. A clip has as many as all its layers: `jaxdn render --layers 1 2 4 8`."
        )


def sample_map(logits: jax.Array, budget: float, *, least: int = 0, most: int, rounding: str = "exact") -> jax.Array:
    """Whole numbers of samples [H, W, 1] from ``least`` to ``most``, ``budget`` in the mean: a softmax over the image.

    ``logits`` [H, W, 1]: samples are in proportion to their exponentials; what is not finite counts as 0, and what is
    more than 60 below the largest as 60 below it.
    With M pixels, ``M budget softmax(logits)`` (Hasselgren et al. 2020, eq. 2) is scaled, until its clamped values
    have the mean ``budget``. Then

    * ``rounding="exact"``: they are rounded down, and the samples that are left go to the largest remainders: their
      sum is ``round(M budget)``;
    * ``rounding="nearest"``: they are not scaled, only clamped and rounded, as in the paper: about that sum.

    The gradient is that of the softmax, times the scale; none flows where a number is clamped, and rounding passes it
    on unchanged. Raises ValueError for a budget that is not within ``least`` and ``most``.
    """
    check_image(logits, "logits", channels=1)
    check_option(rounding, "rounding", ("exact", "nearest"))
    check_budget(budget, least=least, most=most)
    logits = jnp.asarray(logits)
    logits = jnp.where(jnp.isfinite(logits), logits, 0.0).astype(jnp.promote_types(logits.dtype, jnp.float32))
    logits = jnp.maximum(logits, lax.stop_gradient(jnp.max(logits)) - _REACH)
    pixels = logits.size
    shares = pixels * budget * jax.nn.softmax(logits.reshape(-1)).reshape(logits.shape)
    if rounding == "nearest":
        wanted = jnp.clip(shares, least, most)
        return wanted + lax.stop_gradient(jnp.round(wanted) - wanted)
    total = round(pixels * budget)
    wanted = jnp.clip(shares * _scale(lax.stop_gradient(shares), total, least, most), least, most)
    return wanted + lax.stop_gradient(_whole(wanted, total, most) - wanted)


_REACH = 60.0
"""Logits that are lower by more than this count as lower by this: their shares would be 0, which no factor changes."""
_HALVINGS = 36


def _scale(shares: jax.Array, total: int, least: int, most: int) -> jax.Array:
    """The factor for which ``clip(factor * shares, least, most)`` has the sum ``total``; its logarithm is bisected."""

    def halve(_: int, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        few = jnp.sum(jnp.clip(jnp.exp(middle) * shares, least, most)) < total
        return jnp.where(few, middle, low), jnp.where(few, high, middle)

    # A clamp may leave nearly the whole budget to the smallest shares.
    limit = jnp.full((), _REACH + 20.0, shares.dtype)
    low, high = lax.fori_loop(0, _HALVINGS, halve, (-limit, limit))
    return jnp.exp(0.5 * (low + high))


def _whole(wanted: jax.Array, total: int, most: int) -> jax.Array:
    """``wanted`` [H, W, 1] rounded down, and up where the remainders are largest, so that the sum is ``total``."""
    # A little less than wanted: a sum of rounding errors must not exceed the total.
    down = jnp.floor(wanted * (1.0 - 1e-6))
    left = total - jnp.sum(down.astype(jnp.int32))
    remainders = jnp.where(down < most, wanted - down, -1.0).reshape(-1)
    # Equal remainders are spread over the image: multiples of the golden ratio lie evenly.
    scattered = jnp.arange(remainders.size, dtype=jnp.uint32) * jnp.uint32(2654435769)
    order = jnp.lexsort((scattered, -remainders))
    ranks = jnp.zeros(order.shape, jnp.int32).at[order].set(jnp.arange(order.size, dtype=jnp.int32))
    return down + (ranks < left).reshape(wanted.shape)
