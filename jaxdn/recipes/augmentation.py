"""Variations of training clips that leave light transport true: what the world does not prescribe, a network must not
learn.

Light scales with the lamps, channels do not know each other, the axes of the world point anywhere, and a renderer may
not write every buffer. Each element of a training stream is varied anew; the eight symmetries of the image come before
(:mod:`jaxdn.data.training.symmetries`).
"""

from typing import Annotated, Any, NamedTuple, get_type_hints

import numpy as np

from jaxdn.core.frame import BUFFERS, RADIANCE_MAX, Clip, present, written_out
from jaxdn.core.options import Range, check


class Augmentation(NamedTuple):
    """How far an element may be varied; ``NO_AUGMENTATION`` is no variation."""

    level: bool = True
    """All light is first brought to the same brightness, 0.18 in the geometric mean over the reference's blocks of
    16x16 pixels (by a factor of 1000 at most): else a loss hardly sees dark rooms."""
    exposure: Annotated[float, Range(1)] = 4.0
    """All light times a factor from 1 / exposure to exposure (uniform in its logarithm), one per clip."""
    tint: Annotated[float, Range(1)] = 1.5
    """Each channel of light times a factor from 1 / tint to tint."""
    channels: bool = True
    """Red, green and blue in any order, in light and in reflectances alike."""
    rotation: bool = True
    """The world's normals under one random rotation."""
    missing: Annotated[float, Range(0, 1)] = 0.05
    """Probability of each group of buffers (:data:`GROUPS`) to be absent."""
    beauty: Annotated[float, Range(0, 1)] = 0.25
    """Share of elements with all light in place of indirect light, of clips that have single samples of both."""
    shadow: Annotated[float, Range(0, 1)] = 0.0
    """Share of elements whose light changes while the surfaces stay as they are: the edge of a shadow crosses them, or,
    as fast as the image is wide, a lamp is switched (:func:`_shadow`). Without it a network learns that histories are
    right whenever surfaces are, and the light of a lamp that was switched off fades slowly."""

    def check(self) -> None:
        """Raise ValueError, naming the field and what is allowed, for a value out of range."""
        check(self._asdict(), get_type_hints(Augmentation, include_extras=True), of="variation")


NO_AUGMENTATION = Augmentation(False, 1.0, 1.0, False, False, 0.0, 0.0, 0.0)

GROUPS = (
    ("albedo", "reflectance", "specular_reflectance"),
    ("normal",),
    ("depth", "previous_depth"),
    ("roughness",),
    ("motion", "dual_motion"),
)
"""Buffers that a renderer writes together or not at all."""


def augment_clip(clip: Clip, variation: Augmentation, rng: np.random.Generator) -> Clip:
    """The clip (NumPy arrays ``[T, H, W, C]``) with everything but ``beauty`` drawn from ``rng``.

    All its frames are varied alike, but for a shadow that crosses them. An absent buffer has its neutral value, which
    denoisers treat as they treat ``None``, so that elements of one batch can be stacked.
    """
    # Everything is drawn, whatever is varied: one variation must not change the numbers of the next.
    brighter, tints = rng.uniform(-1, 1), rng.uniform(-1, 1, 3)
    order, rotation = rng.permutation(3), _rotation(rng.standard_normal(4))
    absent = rng.random(len(GROUPS)) < variation.missing
    shaded, shadow = rng.random() < variation.shadow, _shadow(clip.frames.radiance.shape[:-1], rng)
    level = _leveling(clip.reference) if variation.level and clip.reference is not None else 1.0
    gain = (level * variation.exposure**brighter * variation.tint**tints).astype(np.float32)
    gain = gain * shadow if shaded else gain
    order = order if variation.channels else np.arange(3)

    def light(image: np.ndarray) -> np.ndarray:
        return image[..., order] * gain

    changed: dict[str, Any] = {}
    for name in ("radiance", *present(clip.frames)):
        buffer, image = BUFFERS[name], getattr(clip.frames, name)
        if buffer.kind == "light":
            changed[name] = light(image)
        elif buffer.kind == "fraction" and buffer.channels == 3:
            changed[name] = image[..., order]
        elif buffer.kind == "direction" and variation.rotation:
            changed[name] = image @ rotation
    dropped = {name for group, gone in zip(GROUPS, absent, strict=True) if gone for name in group}
    dropped &= set(present(clip.frames))
    frames = clip.frames._replace(**changed)._replace(**dict.fromkeys(dropped))
    return Clip(
        written_out(frames, dropped),
        None if clip.reference is None else light(clip.reference),
        None if clip.layers is None else {count: light(image) for count, image in clip.layers.items()},
    )


def _shadow(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """[T, H, W, 1] float32: what a shadow leaves of the light, from 1 down to between 1/2 and 1/1000.

    Its edge is a straight line of any direction, 2 to 32 pixels soft, that reaches a random point of the image in a
    random frame, at 1 pixel a frame or up to as many as the image is wide, with the dark before it or behind it.
    """
    frames, height, width = shape
    size = max(height, width)
    dark = np.log(rng.uniform(2, 1000) if rng.random() < 0.5 else rng.uniform(2, 8))
    angle, softness = rng.uniform(0, 2 * np.pi), 2.0 ** rng.uniform(1, 5)
    speed = max(size, 2.0) ** rng.uniform(0, 1)
    when, row, column = rng.uniform(0, frames), rng.uniform(0, height), rng.uniform(0, width)
    time, rows, columns = np.ogrid[:frames, :height, :width]
    ahead = np.cos(angle) * (columns - column) + np.sin(angle) * (rows - row) - speed * (time - when)
    covered = 0.5 - 0.5 * np.tanh((1.0 if rng.random() < 0.5 else -1.0) * ahead / softness)
    return np.exp(-dark * covered)[..., None].astype(np.float32)


def _leveling(reference: np.ndarray) -> float:
    """The factor that makes light [T, H, W, 3] as bright as all others."""
    light = np.clip(reference, 0.0, RADIANCE_MAX).mean((0, 3), dtype=np.float64)
    means = [
        light[y : y + 16, x : x + 16].mean() for y in range(0, len(light), 16) for x in range(0, len(light[0]), 16)
    ]
    lit = [mean for mean in means if mean > 0]
    return float(np.clip(0.18 / np.exp(np.mean(np.log(lit))), 1e-3, 1e3)) if lit else 1.0


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """[3, 3] float32 rotation; four normal numbers give one that is uniform among all (Shoemake 1992)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ],
        np.float32,
    )
