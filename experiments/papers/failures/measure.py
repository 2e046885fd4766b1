"""Where a clip fails temporal denoisers, and for how long: affected pixels, their error, the response in frames."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn import color, metrics
from jaxdn.core.frame import Frame
from jaxdn.ops.motion import on_screen
from jaxdn.ops.warp import warp

CHANGED = 0.25
"""Relative change of luminance from which on a history is wrong."""
GONE = 0.1
"""The share of the old image that counts as gone."""


class Failure(NamedTuple):
    """What a method makes of one clip."""

    psnr: float
    """dB of tone-mapped light over all affected pixels of the frames in which something moves."""
    response: int | None
    """Frames at rest until less than :data:`GONE` of the old image is left of the history; 0: in the first one; None:
    never."""


def affected_pixels(reference: np.ndarray, frames: Frame, *, moving: int) -> np.ndarray:
    """[T, H, W] bool: what the surface showed a frame ago is wrong today; false in frame 0 and after ``moving``.

    A pixel is affected that was hidden (``visible``), or whose reference differs from the last one at the place
    ``motion`` tells by more than :data:`CHANGED` of the larger. Against noise both are means over 3x3 pixels, and most
    of the 3x3 pixels around it must differ.

    Args:
      reference: [T, H, W, 3].
      frames: of the clip; without ``motion`` nothing moves, without ``visible`` nothing was hidden.
      moving: number of the last frame in which something has moved.
    """
    light = _blurred(np.asarray(color.luminance(jnp.asarray(reference)))[..., 0])
    found = np.zeros(light.shape, bool)
    for index in range(1, moving + 1):
        before = jnp.asarray(light[index - 1][..., None])
        if frames.motion is not None:
            before = warp(before, jnp.nan_to_num(jnp.asarray(frames.motion[index])))
        then, now = np.asarray(before)[..., 0], light[index]
        differs = np.abs(now - then) > CHANGED * np.maximum(np.maximum(now, then), 1e-6)
        found[index] = _blurred(differs[None].astype(float))[0] > 0.5
        if frames.visible is not None:
            found[index] |= ~np.asarray(frames.visible[index], bool)[..., 0]
    return found


def _blurred(planes: np.ndarray) -> np.ndarray:
    """[T, H, W] means over 3x3 pixels."""
    wide = np.pad(planes, ((0, 0), (1, 1), (1, 1)), mode="edge")
    height, width = planes.shape[1:]
    return sum(wide[:, y : y + height, x : x + width] for y in range(3) for x in range(3)) / 9  # type: ignore[return-value]


def share_of_old(image: np.ndarray, expected: np.ndarray, old: np.ndarray, new: np.ndarray, where: np.ndarray) -> float:
    """How much of ``old`` is left in ``image`` where ``new`` is right: the s of ``image = expected + s (old - new) +
    noise``. What is ``expected`` without any of it is ``new`` itself, or what a method without a history shows.

    By least squares over the pixels ``where`` [H, W] of linear images [H, W, 3], relative to the brighter of both:
    noise averages out. In tone-mapped light it would not: noise darkens that, as an old shadow does.
    """
    brighter = np.maximum(np.maximum(old, new)[where].mean(-1, keepdims=True), 1e-6)
    away = (old - new)[where] / brighter
    return float(np.sum((image - expected)[where] / brighter * away) / max(np.sum(away * away), 1e-12))


def measure_failure(
    images: np.ndarray, fresh: np.ndarray, reference: np.ndarray, affected: np.ndarray, *, moving: int
) -> Failure:
    """The error in the affected pixels and the response, of images [T, H, W, 3].

    ``fresh`` are those of the same method that began in frame ``moving``, [T - moving, H, W, 3] at least: what of the
    old image it seems to show is its blur, and no history.
    """
    shown, wanted = (np.asarray(color.tonemap(jnp.asarray(each))) for each in (images, reference))
    where = jnp.asarray(affected[..., None], jnp.float32)
    mean = float(metrics.mse(jnp.asarray(shown), jnp.asarray(wanted), mask=where))
    old, new = reference[moving - 1], reference[moving]
    light = [np.asarray(color.luminance(jnp.asarray(each)))[..., 0] for each in (old, new)]
    changed = np.abs(light[0] - light[1]) > CHANGED * np.maximum(np.maximum(*light), 1e-6)
    pairs = zip(images[moving:], fresh, strict=False)
    left = [share_of_old(*pair, old, new, changed) for pair in pairs]
    response = next((index for index, share in enumerate(left) if share < GONE), None)
    return Failure(-10 * np.log10(max(mean, 1e-12)), response)


def count_fallbacks(frames: Frame) -> tuple[int, int]:
    """Hidden pixels of a clip, and those of them whose dual vector would lead out of the image.

    Their dual vector is the traditional one, which leads to their occluder (Zeng et al. 2021, sec. 6.4). Frame 0 has no
    history and does not count.
    """
    if frames.visible is None or frames.motion is None or frames.dual_motion is None:
        return 0, 0
    hidden = ~np.asarray(frames.visible, bool)[..., 0]
    hidden[0] = False
    same = np.all(np.asarray(frames.dual_motion) == np.asarray(frames.motion), axis=-1)
    inside = np.asarray(jax.vmap(on_screen)(jnp.asarray(frames.motion)))[..., 0]
    return int(hidden.sum()), int((hidden & same & inside).sum())
