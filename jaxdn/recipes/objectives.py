"""Training objectives as functions ``(images, clip, progress) -> loss``.

``images`` [T, H, W, 3] are a clip's denoised frames in linear radiance, ``clip`` has the frames and a reference without
invalid values, and ``progress`` in [0, 1] is the fraction of updates done (traced, so that all phases of training run
in one compiled program).
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color, losses
from jaxdn.core.frame import Clip, Frame
from jaxdn.ops.motion import occlusion_mask

Loss = Callable[[jax.Array, Clip, jax.Array], jax.Array]


class Objective(NamedTuple):
    """A loss and its name in the record of a run."""

    name: str
    loss: Loss
    reads: frozenset[str] = frozenset()
    """Buffers that the loss needs, whatever the denoiser reads."""


def indirect_illumination(*, occlusion: bool = True) -> Objective:
    """``spatial + temporal + motion-occlusion`` on compressed radiance (Zeng et al. 2021, eq. 5 and 6).

    All frames except the last are used, which is left for validation; a clip of one frame is trained on. Radiance is
    compressed by ``log(1 + x)^(1/2.2)``: in linear radiance one firefly would outweigh a frame. The motion-occlusion
    loss is added in the second half of training (C in the paper; ``occlusion=False`` is A and B).
    """

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        trained = slice(0, max(1, images.shape[0] - 1))
        denoised, wanted = color.compress(images[trained]), color.compress(clip.reference[trained])
        total = losses.spatial(denoised, wanted) + losses.temporal(denoised, wanted)
        if not occlusion:
            return total
        share = jnp.where(progress >= 0.5, 1.0, 0.0)
        return total + share * losses.occlusion(denoised, wanted, disocclusions(clip.frames)[trained])

    reads = frozenset({"motion", "dual_motion"} if occlusion else ())
    return Objective("indirect illumination" if occlusion else "indirect illumination without occlusion", loss, reads)


def unbiased_illumination(*, hidden: float = 1.0, squared_from: float = 0.6) -> Objective:
    """The same three terms, with the mean square in the last part of training, and for all frames.

    Until ``squared_from`` of the updates are done, the terms are L1 on compressed radiance, which is robust while the
    weights are far from good; then they are squares that the noise of the target does not bias
    (:func:`jaxdn.losses.unbiased`), so that images end as bright as they should be. The occlusion term has the weight
    ``hidden`` from the first update on. Its mask has all pixels that the previous frame did not see
    (``Frame.visible``); a mask of the pixels whose dual vectors differ from the traditional ones has less than half of
    these.
    """

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        masks = hidden_pixels(clip.frames)

        def terms(pair: tuple[jax.Array, jax.Array], squared: bool) -> jax.Array:
            total = losses.spatial(*pair, squared=squared) + losses.temporal(*pair, squared=squared)
            return total + hidden * losses.occlusion(*pair, masks, squared=squared) if hidden else total

        robust = terms((color.compress(images), color.compress(clip.reference)), False)
        mean = _SQUARES * terms(losses.unbiased(images, clip.reference), True)
        return jnp.where(progress >= squared_from, mean, robust)

    reads = frozenset({"visible"} if hidden else ())
    return Objective(f"unbiased illumination, hidden {hidden:g}, squares from {squared_from:g}", loss, reads)


def pyramid_illumination(*, temporal: float = 1.0, logarithm: bool = False) -> Objective:
    """L1 in the bands of a Laplacian pyramid of each frame's error and of the error of the frames' differences.

    Errors are linear in the target (:func:`jaxdn.losses.unbiased`): robust as L1, and nearly without its bias.

    With ``logarithm``, half of the logarithm of that, clip by clip, as decibels are: a clip's gradient is then relative
    to its error. Otherwise clips with much of it, or with much noise in their references, outweigh smooth surfaces in
    soft light, where small errors are seen best.
    """

    def distance(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        denoised, wanted = losses.unbiased(images, clip.reference)
        total = losses.pyramid(denoised, wanted)
        if images.shape[0] == 1:
            return total
        return total + temporal * losses.pyramid(denoised[1:] - denoised[:-1], wanted[1:] - wanted[:-1])

    name = f"pyramid illumination, changes {temporal:g}"
    if not logarithm:
        return Objective(name, distance)

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        return 0.5 * jnp.log(distance(images, clip, progress) + _NO_ERROR)

    return Objective(f"logarithm of {name}", loss)


def squared_illumination(*, temporal: float = 1.0) -> Objective:
    """Half of the logarithm of the mean square of each frame's error, and of that of the frames' differences.

    Errors are those of ``x / (1 + x)``, linear in the target (:func:`jaxdn.losses.unbiased`): what PSNR measures, whose
    squares count few pixels with large errors, edges of lamps and silhouettes, as much as all others.
    """

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        denoised, wanted = losses.unbiased(images, clip.reference, curve="reinhard")
        total = losses.spatial(denoised, wanted, squared=True)
        if images.shape[0] > 1:
            total += temporal * losses.temporal(denoised, wanted, squared=True)
        return 0.5 * jnp.log(total + _NO_SQUARE)

    return Objective(f"logarithm of squared illumination, changes {temporal:g}", loss)


def recurrent_illumination(*, operator: Literal["difference", "hfen"] = "hfen") -> Objective:
    """``0.8 spatial + 0.1 gradient + 0.1 temporal`` on compressed radiance, later frames more (Chaitanya et al. 2017).

    The k-th frame before the last has the weight ``exp(-k^2 / 8)``: 1, 0.88, 0.61, 0.32, 0.14, 0.04, 0.01 for seven
    frames. All terms are L1; ``operator`` is that of :func:`jaxdn.losses.gradient`. The first frame has no temporal
    term. The paper's compression is another power; this one is that of Hasselgren et al. 2020.
    """

    def one(image: jax.Array, wanted: jax.Array, before: jax.Array, wanted_before: jax.Array) -> jax.Array:
        changes = jnp.stack([before, image]), jnp.stack([wanted_before, wanted])
        frame = image[None], wanted[None]
        structure = losses.gradient(*frame, operator=operator)
        return 0.8 * losses.spatial(*frame) + 0.1 * structure + 0.1 * losses.temporal(*changes)

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        pair = color.compress(images), color.compress(clip.reference)
        before = (jnp.concatenate([each[:1], each[:-1]]) for each in pair)
        age = jnp.arange(images.shape[0] - 1.0, -1.0, -1.0)
        return jnp.mean(jnp.exp(-age * age / 8.0) * jax.vmap(one)(*pair, *before))

    return Objective(f"recurrent illumination, {operator}", loss)


def compressed_illumination() -> Objective:
    """``spatial`` of every frame on compressed radiance: for methods without a history."""

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        return losses.spatial(color.compress(images), color.compress(clip.reference))

    return Objective("compressed illumination", loss)


def last_frames() -> Objective:
    """``spatial`` of the last frame ``+ temporal`` of the last two, on compressed radiance.

    Hasselgren et al. 2020, eq. 4. The frames before have a gradient only by what they leave behind.
    """

    def loss(images: jax.Array, clip: Clip, progress: jax.Array) -> jax.Array:
        denoised, wanted = color.compress(images[-2:]), color.compress(clip.reference[-2:])
        return losses.spatial(denoised[-1:], wanted[-1:]) + losses.temporal(denoised, wanted)

    return Objective("last frames", loss)


_NO_SQUARE = 1e-6
"""Mean square of errors below which less is worth little."""
_NO_ERROR = 1e-3
"""Added to a distance before its logarithm, about that of two images of 8 bits."""
_SQUARES = 8.0
"""The gradient of squares is then that of absolute values at an error of 1/16."""


def hidden_pixels(frames: Frame) -> jax.Array:
    """1 where the previous frame did not see the point, else 0, [T, H, W, 1]; 0 without ``visible``."""
    if frames.visible is None:
        return jnp.zeros_like(frames.radiance[..., :1])
    return 1.0 - frames.visible.astype(frames.radiance.dtype)


def disocclusions(frames: Frame) -> jax.Array:
    """The masks ``[T, H, W, 1]`` of the occlusion loss: where the dual vector differs from the traditional one.

    Without motion vectors or without dual ones, nothing is disoccluded and the mask is zero.
    """
    if frames.motion is None or frames.dual_motion is None:
        return jnp.zeros_like(frames.radiance[..., :1])
    return jax.vmap(occlusion_mask)(frames.motion, frames.dual_motion)
