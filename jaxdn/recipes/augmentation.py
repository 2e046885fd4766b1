"""Variations of training clips that leave light transport true: what the world does not prescribe, a network must not
learn.

Light scales with the lamps, channels do not know each other, the axes of the world point anywhere, and a renderer may
not write every buffer. Each element of a training stream is varied anew; the eight symmetries of the image come before
(:mod:`jaxdn.data.training.symmetries`).
"""

from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import BUFFERS, RADIANCE_MAX, Clip, Frame, present, written_out
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
    as fast as the image is wide, a lamp is switched (:func:`_draw_shadow`). Without it a network learns that histories
    are right whenever surfaces are, and the light of a lamp that was switched off fades slowly."""

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


class Draw(NamedTuple):
    """The random numbers of one variation; of a batch, stacked."""

    gain: Any
    """[3] factors of light's channels, without :attr:`Augmentation.level`."""
    order: Any
    """[3] int: where each channel comes from."""
    rotation: Any
    """[3, 3] of normals, as rows."""
    absent: Any
    """[groups] bool: which of :data:`GROUPS` are missing."""
    shadow: Any
    """[8] of the shadow that crosses: how dark in the exponent (0: none), the x and y of its direction over its
    softness, its speed over it, frame, row and column that it passes, and the side that is dark (1, -1)."""


class DrawnClip(NamedTuple):
    """A clip and what it is to be varied by where it is trained on: on a device, in the jitted update."""

    clip: Clip
    """Images in half precision where files have it: that is what goes to the device."""
    draw: Draw


def draw_variation(variation: Augmentation, shape: Sequence[int], rng: np.random.Generator) -> Draw:
    """Everything but ``beauty``, drawn for a clip of so many frames, rows and columns."""
    # Everything is drawn, whatever is varied: one variation must not change the numbers of the next.
    brighter, tints = rng.uniform(-1, 1), rng.uniform(-1, 1, 3)
    order, rotation = rng.permutation(3), _rotation(rng.standard_normal(4))
    absent = rng.random(len(GROUPS)) < variation.missing
    shaded, shadow = rng.random() < variation.shadow, _draw_shadow(shape, rng)
    gain = variation.exposure**brighter * variation.tint**tints
    return Draw(
        gain.astype(np.float32),
        (order if variation.channels else np.arange(3)).astype(np.int32),
        rotation if variation.rotation else np.eye(3, dtype=np.float32),
        absent,
        shadow if shaded else np.zeros(8, np.float32),
    )


def vary_clip(clip: Clip, draw: Draw, variation: Augmentation) -> Clip:
    """The clip ``[T, H, W, C]`` varied as drawn, in single precision: NumPy arrays, or those of jax, also under jit.

    All its frames are varied alike, but for a shadow that crosses them. An absent buffer has its neutral value, which
    denoisers treat as they treat ``None``, so that elements of one batch can be stacked.
    """
    numbers: Any = np if isinstance(clip.frames.radiance, np.ndarray) else jnp
    clip = jax.tree.map(lambda image: image.astype(np.float32) if image.dtype == np.float16 else image, clip)
    levels = variation.level and clip.reference is not None
    gain = draw.gain * _leveling(clip.reference, numbers) if levels else draw.gain
    gain = gain[None, None, None]
    if variation.shadow:
        gain = gain * _shade(clip.frames.radiance.shape[:-1], draw.shadow, numbers)

    def light(image: Any) -> Any:
        return (image[..., draw.order] * gain).astype(np.float32)

    changed: dict[str, Any] = {}
    for name in ("radiance", *present(clip.frames)):
        buffer, image = BUFFERS[name], getattr(clip.frames, name)
        if buffer.kind == "light":
            changed[name] = light(image)
        elif buffer.kind == "fraction" and buffer.channels == 3 and variation.channels:
            changed[name] = image[..., draw.order]
        elif buffer.kind == "direction" and variation.rotation:
            # Not a matrix product, which GPUs round to 10 bits.
            changed[name] = sum(image[..., row : row + 1] * draw.rotation[None, None, None, row] for row in range(3))
    frames = clip.frames._replace(**changed)
    return Clip(
        _drop(frames, draw.absent, numbers) if variation.missing else frames,
        None if clip.reference is None else light(clip.reference),
        None if clip.layers is None else {count: light(image) for count, image in clip.layers.items()},
    )


def augment_clip(clip: Clip, variation: Augmentation, rng: np.random.Generator) -> Clip:
    """The clip (NumPy arrays ``[T, H, W, C]``) with everything but ``beauty`` drawn from ``rng``."""
    return vary_clip(clip, draw_variation(variation, clip.frames.radiance.shape[:-1], rng), variation)


def _drop(frames: Frame, absent: Any, numbers: Any) -> Frame:
    """Frames without the groups of buffers that are absent."""
    there = set(present(frames))
    for group, gone in zip(GROUPS, absent, strict=True):
        names = there & set(group)
        if not names or (numbers is np and not gone):
            continue
        neutral = written_out(frames._replace(**dict.fromkeys(names)), names)
        chosen = {name: numbers.where(gone, getattr(neutral, name), getattr(frames, name)) for name in names}
        frames = frames._replace(**chosen)
    return frames


def _draw_shadow(shape: Sequence[int], rng: np.random.Generator) -> np.ndarray:
    """A shadow that leaves of the light between 1/2 and 1/1000, as :attr:`Draw.shadow` has it.

    Its edge is a straight line of any direction, 2 to 32 pixels soft, that reaches a random point of the image in a
    random frame, at 1 pixel a frame or up to as many as the image is wide, with the dark before it or behind it.
    """
    frames, height, width = shape
    size = max(height, width)
    dark = np.log(rng.uniform(2, 1000) if rng.random() < 0.5 else rng.uniform(2, 8))
    angle, softness = rng.uniform(0, 2 * np.pi), 2.0 ** rng.uniform(1, 5)
    speed = max(size, 2.0) ** rng.uniform(0, 1)
    when, row, column = rng.uniform(0, frames), rng.uniform(0, height), rng.uniform(0, width)
    side = 1.0 if rng.random() < 0.5 else -1.0
    direction = np.cos(angle) / softness, np.sin(angle) / softness
    return np.array([dark, *direction, speed / softness, when, row, column, side], np.float32)


def _shade(shape: tuple[int, ...], shadow: Any, numbers: Any) -> Any:
    """[T, H, W, 1]: what a shadow leaves of the light."""
    dark, x, y, speed, when, row, column, side = (shadow[index] for index in range(8))
    time, rows, columns = (axis.astype(np.float32) for axis in np.ogrid[tuple(slice(size) for size in shape)])
    ahead = x * (columns - column) + y * (rows - row) - speed * (time - when)
    covered = 0.5 - 0.5 * numbers.tanh(side * ahead)
    return numbers.exp(-dark * covered)[..., None]


def _leveling(reference: Any, numbers: Any) -> Any:
    """The factor that makes light [T, H, W, 3] as bright as all others."""
    light = numbers.clip(reference, 0.0, RADIANCE_MAX).mean((0, 3))
    means = [
        light[y : y + 16, x : x + 16].mean() for y in range(0, len(light), 16) for x in range(0, len(light[0]), 16)
    ]
    found = numbers.stack(means)
    lit = found > 0
    logarithms = numbers.where(lit, numbers.log(numbers.where(lit, found, 1.0)), 0.0)
    middle = numbers.exp(logarithms.sum() / numbers.maximum(lit.sum(), 1))
    return numbers.where(lit.any(), numbers.clip(0.18 / middle, 1e-3, 1e3), 1.0).astype(np.float32)


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
