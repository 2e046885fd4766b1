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
    layers: Mapping[int, jax.Array],
    counts: jax.Array,
    *,
    reference: jax.Array | None = None,
    uniform: jax.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """The image [H, W, 3] with ``counts`` [H, W, 1] samples per pixel, and the actual counts.

    ``layers`` maps powers of two to independent images [H, W, 3] of that many samples; the image is in float32, or
    wider where they are. Counts are rounded and clamped to the layers' sum; a pixel without samples is 0. With the
    ``reference`` [H, W, 3], what the layers converge to, the image has a gradient with respect to the counts
    (:func:`more_samples`), that of a pixel without samples as if it were filled from its neighbours
    (:func:`jaxdn.ops.scales.fill_holes`), as denoisers fill it. Without, no gradient flows into them. Raises ValueError
    unless the layers are 1, 2, 4, ... without a gap.

    With ``uniform`` [H, W, 1], random numbers in [0, 1), fractions are rounded stochastically, down to k or up to
    k + 1 (:func:`round_stochastically`), with another gradient: ``(I(k + 1) - I(k)) / (2 P)``, where P is the
    probability of the number that was drawn. The reference does not enter it, but without one there is still none. For
    a loss that is quadratic in each pixel, its mean over the random numbers is that of the mean loss: ``L(k + 1) -
    L(k)`` is the mean of both slopes times the difference of both images. This is exact from one sample on. Below,
    I(0) is what fills the pixel, and what the pixel fills in its neighbours is left out.
    """
    expected = [1 << bit for bit in range(len(layers))]
    if sorted(layers) != expected or not layers:
        raise ValueError(f"layers: expected independent layers of 1, 2, 4, ... samples, got {sorted(layers)}.")
    given = lax.stop_gradient(counts)
    given = jnp.where(jnp.isfinite(given), given, 0.0)
    given = given if uniform is None else _without_errors(given)
    rounded = jnp.round(given) if uniform is None else round_stochastically(given, uniform)
    image, taken = _sum_layers(layers, jnp.clip(rounded, 0, sum(layers)))
    if reference is None:
        return image, taken
    seen = taken > 0
    filled = lax.stop_gradient(
        crop(fill_holes(pad(image, _BLOCK), pad(seen, _BLOCK)), (image.shape[0], image.shape[1]))
    )
    none = more_samples(filled, taken, counts, reference) - filled
    whole = jnp.where(seen, more_samples(image, taken, counts, reference), none)
    if uniform is None:
        return whole, taken
    below = jnp.clip(jnp.floor(given), 0, sum(layers))
    share = jnp.clip(given, 0, sum(layers)) - below
    fewer, more = (_sum_layers(layers, number)[0] for number in (below, jnp.minimum(below + 1, sum(layers))))
    fewer = jnp.where(below > 0, fewer, jnp.where(seen, _fill_alone(image, taken), filled))
    drawn = jnp.where(taken > below, share, 1.0 - share)
    slope = lax.stop_gradient((more - fewer) / jnp.where(share > 0, 2.0 * drawn, 1.0))
    return jnp.where(share > 0, image + slope * (counts - lax.stop_gradient(counts)), whole), taken


def _sum_layers(layers: Mapping[int, jax.Array], counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The image [H, W, 3] of whole ``counts`` [H, W, 1] of samples, and the counts in the image's dtype.

    Layers in half precision are added in float32: a sum of 15 samples in bfloat16 would be off by 0.4 %.
    """
    whole = counts.astype(jnp.int32)
    wide = jnp.promote_types(layers[1].dtype, jnp.float32)
    total = jnp.zeros(layers[1].shape, wide)
    for samples in sorted(layers):
        total = total + jnp.where((whole & samples) > 0, samples * layers[samples].astype(wide), 0.0)
    taken = whole.astype(total.dtype)
    return total / jnp.maximum(taken, 1.0), taken


def _fill_alone(image: jax.Array, taken: jax.Array) -> jax.Array:
    """What would fill each pixel if it alone had no samples: the mean of the others of its 2x2 block, else 4x4, else 0.

    ``image`` [H, W, 3], ``taken`` [H, W, 1].
    """
    size = image.shape[:2]
    known = pad((taken > 0).astype(image.dtype), _BLOCK)
    light = pad(image, _BLOCK) * known
    found = jnp.zeros_like(light)
    for side in (4, 2):
        rows, columns = light.shape[0] // side, light.shape[1] // side
        blocks = (each.reshape(rows, side, columns, side, -1).sum((1, 3)) for each in (light, known))
        total, number = (jnp.repeat(jnp.repeat(each, side, axis=0), side, axis=1) for each in blocks)
        others = number - known
        found = jnp.where(others > 0, (total - light) / jnp.maximum(others, 1.0), found)
    return lax.stop_gradient(crop(found, (size[0], size[1])))


def round_stochastically(counts: jax.Array, uniform: jax.Array) -> jax.Array:
    """Whole numbers whose mean over ``uniform`` in [0, 1) is ``counts``: up with the probability of the fraction.

    Fractions within 0.0001 of a whole number are errors of rounding, and that number.
    """
    counts = _without_errors(counts)
    down = jnp.floor(counts)
    return down + (uniform < counts - down)


def _without_errors(counts: jax.Array) -> jax.Array:
    near = jnp.round(counts)
    return jnp.where(jnp.abs(counts - near) < _ERROR, near, counts)


def draw_random_numbers(height: int, width: int, frame: jax.Array | int) -> jax.Array:
    """Numbers [H, W, 1] in [0, 1) for a frame, for :func:`round_stochastically`; the same on every machine.

    Those of two pixels are independent as far as a hash of their places is; those of one pixel move on by the golden
    ratio from frame to frame, so that a pixel that gets a quarter of a sample gets one in about every fourth frame.
    """
    place = jnp.arange(height * width, dtype=jnp.uint32).reshape(height, width, 1)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        place = (place ^ (place >> shift)) * jnp.uint32(factor)
    place = (place ^ (place >> 16)) + jnp.asarray(frame).astype(jnp.uint32) * jnp.uint32(2654435769)
    return _fraction(place)


def rotate_pattern(height: int, width: int, frame: jax.Array | int) -> jax.Array:
    """Numbers [H, W, 1] in [0, 1) for a frame, in place of :func:`draw_random_numbers`: a fixed pattern that rotates.

    The binary digits of the ordered dither (Bayer 1973), each flipped where the frame's number has a 1, its lowest
    digit the first. With budgets of ``2^-n`` samples a pixel, ``round_stochastically`` gives every pixel one sample in
    each run of ``2^n`` frames that begins at a multiple of it. Of a half, the pixels are a checkerboard in every frame;
    of a quarter, each aligned 2x2 block has one. Every frame has nearly any other budget, too: the dither is of
    65,536 x 65,536 pixels, and only the borders of the frame cut it off.
    """
    rows, columns = (jnp.arange(size, dtype=jnp.uint32) for size in (height, width))
    order = jnp.zeros((height, width), jnp.uint32)
    for bit in range(16):
        row, column = (rows[:, None] >> bit) & 1, (columns[None] >> bit) & 1
        # 0 and 1 on the diagonal, 2 and 3 beside it.
        order = 4 * order + 2 * (row ^ column) + row
    return _fraction(order ^ _reverse_digits(jnp.asarray(frame).astype(jnp.uint32)))[..., None]


def allot_evenly(budget: float, height: int, width: int, frame: jax.Array | int) -> jax.Array:
    """Whole numbers of samples [H, W, 1] of a frame, ``budget`` in the mean and nowhere more than one from it.

    What is not whole goes to other pixels in each frame (:func:`rotate_pattern`).
    """
    return round_stochastically(jnp.full((height, width, 1), budget), rotate_pattern(height, width, frame))


def _reverse_digits(number: jax.Array) -> jax.Array:
    """The 32 binary digits of ``number`` (uint32) in the opposite order."""
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF)):
        number = ((number >> shift) & jnp.uint32(mask)) | ((number & jnp.uint32(mask)) << shift)
    return number


def _fraction(number: jax.Array) -> jax.Array:
    """``number`` (uint32) over 2^32, rounded down to what float32 tells from 1."""
    return (number >> 8).astype(jnp.float32) * 2.0**-24


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
_ERROR = 1e-4
"""How far from a whole number a number of samples is taken for it."""


def check_budget(budget: float, *, least: float, most: int) -> None:
    """Raise ValueError for a mean number of samples that is not within the fewest and the most of a pixel."""
    if not (least <= budget <= most and budget > 0):
        raise ValueError(
            f"budget: expected a mean number of samples above 0 from {least:g} to {most}, the fewest and the most that "
            f"a pixel can have, got {budget:g}. A clip has as many as all its layers: `jaxdn render --layers 1 2 4 8`."
        )


def check_least(least: float, rounding: str) -> None:
    """Raise ValueError for a fraction of a sample where numbers of samples are whole."""
    if rounding != "stochastic" and least != int(least):
        raise ValueError(f"least: expected a whole number of samples, but with rounding 'stochastic', got {least:g}.")


def sample_map(logits: jax.Array, budget: float, *, least: float = 0, most: int, rounding: str = "exact") -> jax.Array:
    """Numbers of samples [H, W, 1] from ``least`` to ``most``, ``budget`` in the mean: a softmax over the image.

    ``logits`` [H, W, 1]: samples are in proportion to their exponentials; what is not finite counts as 0, and what is
    more than 60 below the largest as 60 below it. They are whole but for ``rounding="stochastic"``. With M pixels, ``M
    budget softmax(logits)`` (Hasselgren et al. 2020, eq. 2) is scaled, until its clamped values have the mean
    ``budget``. Then

    * ``rounding="exact"``: they are rounded down, and the samples that are left go to the largest remainders: their
      sum is ``round(M budget)``;
    * ``rounding="nearest"``: they are not scaled, only clamped and rounded, as in the paper: about that sum;
    * ``rounding="stochastic"``: they keep their fractions, for :func:`from_layers` with random numbers: ``budget`` in
      the mean over pixels, and that many samples in the mean over random numbers. Every pixel has ``least``, which may
      be a fraction, and what is left of the budget is placed: so none is out of reach of the gradient.

    The gradient is that of the softmax, times the scale; none flows where a number is clamped, and rounding passes it
    on unchanged. Raises ValueError for a budget that is not within ``least`` and ``most``, and for a ``least`` that is
    not whole where the samples are.
    """
    check_image(logits, "logits", channels=1)
    check_option(rounding, "rounding", ("exact", "nearest", "stochastic"))
    check_budget(budget, least=least, most=most)
    check_least(least, rounding)
    logits = jnp.asarray(logits)
    logits = jnp.where(jnp.isfinite(logits), logits, 0.0).astype(jnp.promote_types(logits.dtype, jnp.float32))
    logits = jnp.maximum(logits, lax.stop_gradient(jnp.max(logits)) - _REACH)
    shares = logits.size * jax.nn.softmax(logits.reshape(-1)).reshape(logits.shape)
    if rounding == "stochastic":
        left = (budget - least) * shares
        scale = _scale(lax.stop_gradient(left), logits.size * (budget - least), 0, most - least)
        return least + jnp.clip(left * scale, 0, most - least)
    shares = budget * shares
    if rounding == "nearest":
        wanted = jnp.clip(shares, least, most)
        return wanted + lax.stop_gradient(jnp.round(wanted) - wanted)
    total = round(logits.size * budget)
    wanted = jnp.clip(shares * _scale(lax.stop_gradient(shares), total, least, most), least, most)
    return wanted + lax.stop_gradient(_whole(wanted, total, most) - wanted)


_REACH = 60.0
"""Logits that are lower by more than this count as lower by this: their shares would be 0, which no factor changes."""
_HALVINGS = 36


def _scale(shares: jax.Array, total: float, least: float, most: float) -> jax.Array:
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
