"""How much of each candidate is in the result, decided when the candidates are there to be compared.

A network at half resolution sees how the candidates differ from the prior, and what the new frame's noisy light says
about each difference: the slope of its regression on that, which is 1 where the light is the candidate's and 0 where it
is the prior's, and the slope's standard error.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.denoiser import Params
from jaxdn.filters.kalman import box_sum
from jaxdn.methods.combiner.candidates import CANDIDATES
from jaxdn.ops.scales import add_planes, crop, halve_planes, join_pixels, to_planes, upsample

RADII = (1, 3)
"""Of the windows over which the slopes are measured, in blocks of 2x2 pixels."""
_MOST_RESIDUAL = 3.0
"""Residuals of noisy light that count, as shares of the prior's light plus middle grey: one firefly is no evidence."""
_LEAST_SQUARE = 1e-5
"""Mean square of a difference of two images, at the exposure of the network, below which there is none."""
_SLOPE_RANGE = -1.0, 2.0
_MULTIPLE = 16
"""Height and width of the network's input are multiples of it."""
RECEPTIVE_FIELD = 2 * max(RADII) + 2
"""Radius in pixels of what :func:`assemble_evidence` sees."""
INITIAL_LOGITS = {
    "prior": 0.0,
    "correction": -2.0,
    "prior mean": 1.0,
    "last result": 1.0,
}
"""The logits of the candidates before training."""
_SMALL = 0.2
"""Factor of the head's kernel before training: shares begin nearly the same everywhere."""


def count_inputs() -> tuple[int, ...]:
    """Channels of the groups that :func:`assemble_evidence` makes of all candidates."""
    others = len(CANDIDATES) - 1
    return 4 * len(CANDIDATES), 2 * len(RADII) * others + 1, 4 * 2 + 3


def assemble_evidence(
    candidates: Sequence[jax.Array],
    noisy: jax.Array,
    albedo: jax.Array,
    normal: jax.Array,
    number: jax.Array,
    gain: jax.Array,
) -> tuple[jax.Array, ...]:
    """The groups of the network's input [h, w, C], by blocks of 2x2 pixels, padded by the edge to multiples of 16.

    ``candidates`` [3, H, W] are linear radiance, the prior first. ``noisy``, ``albedo`` and
    ``normal`` are [3, H, W]; ``number`` [H, W] is the effective number of samples, in frames. H and W are even.
    Differences are those of ``x / (1 + x)`` at the exposure ``gain``, linear about the prior, so that noise has no bias
    in them.
    """
    prior, *others = (jnp.maximum(each, 0.0) for each in candidates)
    slant = gain / jnp.square(1.0 + gain * prior)
    residual = slant * (jnp.maximum(noisy, 0.0) - prior)
    most = _MOST_RESIDUAL * slant * (prior + 0.2 / gain)
    residual = jnp.clip(residual, -most, most)
    level = color.luminance_of_planes(color.compress(gain * prior))
    fine, evidence = [level], []
    for each in others:
        seen = color.luminance_of_planes(color.compress(gain * each))
        fine.append(4.0 * (seen - level))
        difference = jnp.clip(slant * (each - prior), -most, most)
        both, own = add_planes(difference * residual), add_planes(difference**2)
        products = halve_planes(jnp.stack([both, own, both**2]))
        for radius in RADII:
            both, own, spread = box_sum(products, radius)
            own = own + (2.0 * radius + 1.0) ** 2 * _LEAST_SQUARE
            evidence += [jnp.clip(both / own, *_SLOPE_RANGE), jnp.minimum(0.5 * jnp.sqrt(spread + 1e-12) / own, 2.0)]
    square = halve_planes(add_planes(residual**2)[None] / 3.0)
    noise = box_sum(square, RADII[0])[0] / (2.0 * RADII[0] + 1.0) ** 2
    evidence.append(jnp.minimum(4.0 * jnp.sqrt(noise + 1e-12), 2.0))
    facts = [color.luminance_of_planes(albedo), 1.0 / (1.0 + number)]
    groups = (
        [("blocks", plane[None]) for plane in fine],
        [("planes", plane[None]) for plane in evidence],
        [*(("blocks", plane[None]) for plane in facts), ("means", normal)],
    )
    return tuple(join_pixels(group, multiple=_MULTIPLE) for group in groups)


def begin(params: Params) -> Params:
    """The network's parameters before training, from those that were drawn: the shares of :data:`INITIAL_LOGITS`."""
    logits = jnp.asarray([INITIAL_LOGITS[name] for name in CANDIDATES], jnp.float32)
    head = {"kernel": _SMALL * params["head_0"]["kernel"], "bias": logits}
    return {**params, "head_0": head}


def split_shares(head: jax.Array, size: tuple[int, int]) -> jax.Array:
    """[4, H, W] the share of each candidate, which add up to 1, of the network's output [h, w, 4].

    Blocks of 2x2 pixels have one logit a candidate, enlarged: where candidates differ much, as in a shadow that moves,
    shares that each pixel of a block has of its own show as a grid.
    """
    logits = upsample(crop(head, (size[0] // 2, size[1] // 2)))
    return jax.nn.softmax(to_planes(logits), axis=0)
