"""A network that says where samples go, shared by the methods that request samples.

It sees what is known before a frame is rendered, one number a pixel comes out, and one softmax over the image turns
these into numbers of samples that keep a budget (:func:`jaxdn.ops.sampling.sample_map`).

Hasselgren et al. 2020, "Neural Temporal Adaptive Sampling and Denoising"; Kuznetsov et al. 2018, "Deep Adaptive
Sampling for Low Sample Count Rendering".
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxdn.core.options import Range
from jaxdn.denoiser import Params
from jaxdn.networks import LARGE, MULTIPLE, Widths
from jaxdn.ops.sampling import check_budget, check_least, sample_map
from jaxdn.ops.scales import crop, pad

SMALL: Widths = ((8,), (16, 16), (24, 24), (32, 32), (32, 32))
"""Half of the widths of the denoiser's: it only has to find where noise will be."""
GRAY = (0.2989, 0.587, 0.114)
"""Weights of red, green and blue (Hasselgren et al. 2020, sec. 2.2)."""


@dataclass(frozen=True)
class Sampling:
    """The options of a method that requests samples."""

    adaptive: bool = True
    """A network says where samples go; or all pixels have the budget."""
    budget: Annotated[float, Range(0, without_low=True)] = 4.0
    """Mean number of samples per pixel."""
    least: Annotated[float, Range(0)] = 1
    """Every pixel has at least this many samples; 0 in the paper. A whole number, but for ``rounding="stochastic"``."""
    rounding: Literal["exact", "nearest", "stochastic"] = "exact"
    """The budget is kept exactly, or about (as in the paper); or the map keeps fractions, which are rounded up with
    their probability when a frame is rendered: for budgets below one sample, with ``least`` 0. See
    :func:`jaxdn.ops.sampling.sample_map`."""
    slope: Literal["mixing", "amplitude"] = "mixing"
    """What one more sample does to the image in training, see :func:`jaxdn.ops.sampling.more_samples`: a sample without
    noise is mixed in, or the noise falls as the root of the number. Fractions have the slope of their two numbers."""

    def __post_init__(self) -> None:
        check_least(self.least, self.rounding)


class Sampler(NamedTuple):
    """Two pure functions."""

    init: Callable[[jax.Array], Params]
    counts: Callable[[Params, Sequence[jax.Array | None], jax.Array, int], jax.Array]
    """(params, features [H, W, c] or None, even: bool scalar, most) -> [H, W, 1] numbers of samples; ``even``: all
    pixels alike."""


Allocation = Callable[[Sampling, jax.Array, int], jax.Array]
"""(options, logits [H, W, 1], most) -> [H, W, 1] numbers of samples."""


def sampler(
    options: Sampling,
    groups: Sequence[int],
    *,
    size: str | Widths,
    initialization: str,
    implementation: str | None,
    allocate: Allocation,
) -> Sampler:
    """The network for feature groups of these channel counts, whose output ``allocate`` turns into numbers."""
    from jaxdn.networks.unet import unet

    widths = {"large": LARGE, "small": SMALL}[size] if isinstance(size, str) else size
    network = unet(groups, (1,), widths=widths, initialization=initialization, implementation=implementation)

    def counts(params: Params, features: Sequence[jax.Array | None], even: jax.Array, most: int) -> jax.Array:
        present = next(group for group in features if group is not None)
        batch = [None if group is None else pad(group, MULTIPLE)[None] for group in features]
        logits = crop(network.apply(params, batch)[0][0], (present.shape[0], present.shape[1])).astype(present.dtype)
        return allocate(options, jnp.where(even, 0.0, logits), most)

    return Sampler(network.init, counts)


def allocate_samples(options: Sampling, logits: jax.Array, most: int) -> jax.Array:
    """The numbers of samples [H, W, 1] for logits [H, W, 1]."""
    return _with_slope(
        options, sample_map(logits, options.budget, least=options.least, most=most, rounding=options.rounding)
    )


def allocate_after_first(options: Sampling, logits: jax.Array, most: int) -> jax.Array:
    """The numbers of samples [H, W, 1] where one is rendered first: that one, and as many pairs as the budget has.

    Stored layers of 1, 2, 4, ... samples hold the first sample in odd numbers alone; in even ones it would be rendered
    for the decision and not be in the image. Raises ValueError as :func:`jaxdn.ops.sampling.sample_map`.
    """
    check_budget(options.budget, least=options.least, most=most)
    most = (most - 1) // 2
    mean = min((options.budget - 1.0) / 2.0, most)
    if not mean:
        return jnp.ones_like(logits)
    pairs = sample_map(logits, mean, least=(options.least - 1) // 2, most=most, rounding=options.rounding)
    return _with_slope(options, 1.0 + 2.0 * pairs)


def _with_slope(options: Sampling, counts: jax.Array) -> jax.Array:
    # The image's slope by its number of samples is that of mixing; if noise falls as 1 / sqrt(s), it is half of it.
    if options.rounding == "stochastic":
        return counts
    return 0.5 * (counts + lax.stop_gradient(counts)) if options.slope == "amplitude" else counts


def gray(image: jax.Array) -> jax.Array:
    """[H, W, 3] -> [H, W, 1]."""
    red, green, blue = GRAY
    return red * image[..., 0:1] + green * image[..., 1:2] + blue * image[..., 2:3]


def motion_feature(motion: jax.Array) -> jax.Array:
    """Motion in pixels [H, W, 2] in (-1, 1), 0 where it is not finite."""
    known = jnp.where(jnp.isfinite(motion), motion, 0.0)
    return known / (1.0 + jnp.abs(known))
