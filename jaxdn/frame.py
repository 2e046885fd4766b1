"""The vocabulary: what a renderer gives for one frame, what a clip is, what a denoiser is.

``None`` is the neutral element: a buffer that is ``None`` means *this effect is absent*, and every consumer treats it
exactly as the neutral value written out (no motion is zero motion, no albedo is white, no roughness is 1, no normal and
no depth is 0). Because ``None`` is part of the pytree's structure, jit specialises on it and an absent effect leaves no
trace in the compiled program.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

RADIANCE_MAX = 65504.0
"""Radiance is clamped to the largest float16 on entry."""

FAR = 1e6
"""View-space depth stored where the camera ray left the scene: large and finite, so that differences stay finite."""

Buffer = Any
"""A jax or NumPy array, or None where the effect is absent."""


class Frame(NamedTuple):
    """What a renderer gives for one frame; every buffer is ``[H, W, C]`` and all but ``radiance`` may be ``None``."""

    radiance: Buffer
    """[H, W, 3] noisy radiance to denoise (for ``ntd``: the indirect part), linear Rec.709, >= 0."""
    albedo: Buffer = None
    """[H, W, 3] first-hit diffuse reflectance in [0, 1]; neutral: 1."""
    normal: Buffer = None
    """[H, W, 3] unit world-space shading normal, zero where the ray left the scene; neutral: 0."""
    depth: Buffer = None
    """[H, W, 1] view-space z along the optical axis, > 0, ``FAR`` on a miss; neutral: 0."""
    roughness: Buffer = None
    """[H, W, 1] linear roughness r, GGX alpha = r * r; neutral: 1."""
    motion: Buffer = None
    """[H, W, 2] (x, y) px, y down, previous minus current; not finite where there is no history; neutral: 0."""
    dual_motion: Buffer = None
    """[H, W, 2] px, as ``motion`` but disoccluded pixels borrow their occluder's; neutral: ``motion``."""
    visible: Buffer = None
    """[H, W, 1] bool, the point was seen in the previous frame; neutral: true."""
    previous_depth: Buffer = None
    """[H, W, 1] view-space z that the point had in the previous frame; neutral: ``depth``."""
    ids: Buffer = None
    """[H, W, 1] int32 shape id, -1 for nothing."""
    direct: Buffer = None
    """[H, W, 3] directly reflected light; neutral: 0."""
    emission: Buffer = None
    """[H, W, 3] light emitted towards the camera; neutral: 0."""


class Clip(NamedTuple):
    """Consecutive frames and, where it is known, what their ``radiance`` converges to."""

    frames: Frame
    """A Frame whose buffers have ``T`` in front."""
    reference: Buffer = None
    """[T, H, W, 3] the noise-free radiance."""


class Denoiser(NamedTuple):
    """The one interface: four values, three of them pure functions; a clip is a scan over ``step``."""

    init: Callable[[jax.Array, Frame], Any]
    """(key, frame) -> params; ``{}`` for a filter without weights."""
    start: Callable[[Any, Frame], Any]
    """(params, frame) -> state before the first frame."""
    step: Callable[[Any, Any, Frame], tuple[Any, jax.Array]]
    """(params, state, frame) -> (state, image [H, W, 3] >= 0)."""
    reads: frozenset[str]
    """Names of the Frame buffers that it can make use of."""


def frame_at(frames: Frame, index: int | jax.Array) -> Frame:
    """The frame at one index of a clip's frames (the leading axis of every buffer that is there)."""
    return jax.tree.map(lambda buffer: buffer[index], frames)


def only(frame: Frame, reads: frozenset[str]) -> Frame:
    """The same frame with every buffer dropped that is not in ``reads`` (``radiance`` always stays)."""
    kept = {"radiance", *reads}
    dropped: dict[str, Any] = {name: None for name in Frame._fields if name not in kept}
    return frame._replace(**dropped)


def written_out(frame: Frame, names: Iterable[str]) -> Frame:
    """The same frame (or a clip's frames) with the neutral value in place of every ``None`` among ``names``.

    What comes out gives the same image, at a higher cost: for where frames with and without an effect have to be
    stacked. ``ids`` are -1 where they are unknown. NumPy arrays in, NumPy arrays out.
    """
    light = frame.radiance
    numbers = np if isinstance(light, np.ndarray) else jnp
    one = light[..., :1]

    def neutral(name: str) -> Any:
        if name == "dual_motion":
            return filled["motion"] if filled["motion"] is not None else numbers.zeros_like(light[..., :2])
        if name == "previous_depth":
            return filled["depth"] if filled["depth"] is not None else numbers.zeros_like(one)
        if name in ("albedo", "roughness"):
            return numbers.ones_like(light if name == "albedo" else one)
        if name == "visible":
            return numbers.ones(one.shape, bool)
        if name == "ids":
            return numbers.full(one.shape, -1, numbers.int32)
        size = {"motion": 2, "depth": 1}.get(name, 3)
        return numbers.zeros_like(light[..., :size])

    filled = frame._asdict()
    for name in Frame._fields[1:]:  # in this order: motion comes before the dual one, depth before the previous one
        if name in set(names) and filled[name] is None:
            filled[name] = neutral(name)
    return Frame(**filled)


def _working_dtype(buffer: jax.Array) -> jax.Array:
    """Half precisions and integers become float32; float64 stays."""
    return jnp.asarray(buffer, jnp.promote_types(buffer.dtype, jnp.float32))


def repair(frame: Frame) -> tuple[Frame, jax.Array]:
    """Make a frame safe to compute on; returns it with the number of values that had to be replaced (int32).

    Radiance, direct and emission: not finite or negative -> 0, then at most ``RADIANCE_MAX``. Albedo and roughness:
    not finite -> 1, then [0, 1]. Normals: not finite or shorter than 1e-6 -> 0, else unit length. Depths: NaN or
    negative -> 0, above 1e9 -> 1e9. Motion vectors: not finite -> NaN in both components, which means *no history
    there* (0 would be a legal vector). Half-precision buffers are widened to float32. Never raises on contents.
    """
    replaced: dict[tuple[int, ...], jax.Array] = {}

    def count(bad: jax.Array) -> None:
        # Summed up to one array for each shape: every reduction to a number is a pass over memory of its own.
        flags = jnp.asarray(bad, jnp.int32)
        replaced[bad.shape] = replaced[bad.shape] + flags if bad.shape in replaced else flags

    def light(buffer: Any) -> Any:
        if buffer is None:
            return None
        buffer = _working_dtype(buffer)
        bad = ~(jnp.isfinite(buffer) & (buffer >= 0))
        count(bad | (buffer > RADIANCE_MAX))
        return jnp.minimum(jnp.where(bad, 0.0, buffer), RADIANCE_MAX)

    def fraction(buffer: jax.Array | None) -> jax.Array | None:
        if buffer is None:
            return None
        buffer = _working_dtype(buffer)
        count(~((buffer >= 0) & (buffer <= 1)))
        return jnp.clip(jnp.where(jnp.isfinite(buffer), buffer, 1.0), 0.0, 1.0)

    def direction(buffer: jax.Array | None) -> jax.Array | None:
        if buffer is None:
            return None
        buffer = _working_dtype(buffer)
        # Written out for three components: XLA:CPU takes four times as long for reductions over so short an axis.
        sizes = [jnp.abs(buffer[..., i : i + 1]) for i in range(3)]
        largest = jnp.maximum(jnp.maximum(sizes[0], sizes[1]), sizes[2])
        usable = jnp.isfinite(largest) & (largest > 1e-6)
        count(~jnp.isfinite(buffer))
        # XLA may multiply by the divisor's reciprocal, which must not be subnormal.
        divisor = jnp.where(usable, jnp.minimum(largest, float(jnp.finfo(buffer.dtype).max) / 8), 1.0)
        x, y, z = (jnp.where(usable, size, 1.0) / divisor for size in sizes)
        unit = jnp.where(usable, buffer, 1.0) / divisor / jnp.sqrt(x * x + y * y + z * z)
        return jnp.where(usable, unit, 0.0)

    def distance(buffer: jax.Array | None) -> jax.Array | None:
        if buffer is None:
            return None
        buffer = _working_dtype(buffer)
        bad = ~(buffer >= 0)
        count(bad | (buffer > 1e9))
        return jnp.minimum(jnp.where(bad, 0.0, buffer), 1e9)

    def vector(buffer: jax.Array | None) -> jax.Array | None:
        if buffer is None:
            return None
        buffer = _working_dtype(buffer)
        known = jnp.all(jnp.isfinite(buffer), axis=-1, keepdims=True)
        count(~known)
        return jnp.where(known, buffer, jnp.nan)

    repaired = frame._replace(
        radiance=light(frame.radiance),
        albedo=fraction(frame.albedo),
        normal=direction(frame.normal),
        depth=distance(frame.depth),
        roughness=fraction(frame.roughness),
        motion=vector(frame.motion),
        dual_motion=vector(frame.dual_motion),
        previous_depth=distance(frame.previous_depth),
        direct=light(frame.direct),
        emission=light(frame.emission),
    )
    # Where double precision is enabled a sum of int32 is int64, which no scan takes back as the int32 it began with.
    counts = jnp.stack([jnp.sum(flags, dtype=jnp.int32) for flags in replaced.values()])
    return repaired, jnp.sum(counts, dtype=jnp.int32)


def repair_image(image: jax.Array) -> jax.Array:
    """A warped history made safe: not finite or negative -> 0, at most ``RADIANCE_MAX``."""
    bad = ~(jnp.isfinite(image) & (image >= 0))
    return jnp.minimum(jnp.where(bad, 0.0, image), RADIANCE_MAX)
