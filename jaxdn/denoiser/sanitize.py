"""Sanitizing of frames and histories, the first step of every denoiser.

The sanitizing depends only on the kind of a buffer (:data:`jaxdn.core.frame.BUFFERS`).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxdn.core.frame import BUFFERS, FAR, RADIANCE_MAX, Buffer, Frame

FARTHEST = 1e9
"""Larger distances are replaced by this."""
_FAR_ROUNDED = 999_424.0
"""What bfloat16 holds in place of ``FAR``: from here on there is no surface."""

Sanitized = tuple[jax.Array, jax.Array]
"""The sanitized buffer, and which of its values were replaced (bool)."""


def sanitize(frame: Frame) -> tuple[Frame, jax.Array]:
    """Replace invalid values of a frame; returns it with the number of replaced values (int32).

    By the kind of each buffer:

    * light: not finite or negative -> 0, then at most ``RADIANCE_MAX``; signed: not finite -> 0, then at most that;
    * fraction: not finite -> the neutral value (1 for albedo and roughness), then [0, 1];
    * direction: not finite or shorter than 1e-6 -> 0, else unit length;
    * distance: NaN or negative -> 0, above 1e9 -> 1e9, and ``FAR`` as bfloat16 rounds it -> ``FAR``; count: not finite
      or negative -> 0;
    * vector: not finite -> NaN in both components, which means *no history there* (0 would be a legal vector);
    * flag, id: unchanged.

    Half-precision buffers are widened to float32. Never raises because of values.
    """
    replaced: dict[tuple[int, ...], jax.Array] = {}
    safe = {}
    for name, buffer in BUFFERS.items():
        values = getattr(frame, name)
        if values is None or buffer.kind not in _SANITIZERS:
            continue
        # Half precisions and integers become float32; float64 stays.
        safe[name], bad = _SANITIZERS[buffer.kind](
            jnp.asarray(values, jnp.promote_types(values.dtype, jnp.float32)), buffer
        )
        # Summed to one array per shape first: every reduction to a scalar is a separate pass over memory.
        flags = jnp.asarray(bad, jnp.int32)
        replaced[flags.shape] = replaced[flags.shape] + flags if flags.shape in replaced else flags
    # With double precision enabled a sum of int32 is int64, which does not match the int32 carry of a scan.
    counts = jnp.stack([jnp.sum(flags, dtype=jnp.int32) for flags in replaced.values()])
    return frame._replace(**safe), jnp.sum(counts, dtype=jnp.int32)


def _light(values: jax.Array, buffer: Buffer) -> Sanitized:
    bad = ~(jnp.isfinite(values) & (values >= 0))
    return jnp.minimum(jnp.where(bad, 0.0, values), RADIANCE_MAX), bad | (values > RADIANCE_MAX)


def _signed(values: jax.Array, buffer: Buffer) -> Sanitized:
    bad = ~jnp.isfinite(values)
    return jnp.clip(jnp.where(bad, 0.0, values), -RADIANCE_MAX, RADIANCE_MAX), bad | (jnp.abs(values) > RADIANCE_MAX)


def _fraction(values: jax.Array, buffer: Buffer) -> Sanitized:
    neutral = 1.0 if isinstance(buffer.neutral, str) else buffer.neutral
    bad = ~((values >= 0) & (values <= 1))
    return jnp.clip(jnp.where(jnp.isfinite(values), values, neutral), 0.0, 1.0), bad


def _count(values: jax.Array, buffer: Buffer) -> Sanitized:
    bad = ~(jnp.isfinite(values) & (values >= 0))
    return jnp.where(bad, 0.0, values), bad


def _direction(values: jax.Array, buffer: Buffer) -> Sanitized:
    # Explicit for three components: XLA:CPU takes four times as long for reductions over such a short axis.
    sizes = [jnp.abs(values[..., i : i + 1]) for i in range(3)]
    largest = jnp.maximum(jnp.maximum(sizes[0], sizes[1]), sizes[2])
    usable = jnp.isfinite(largest) & (largest > 1e-6)
    # XLA may multiply by the divisor's reciprocal, which must not be subnormal.
    divisor = jnp.where(usable, jnp.minimum(largest, float(jnp.finfo(values.dtype).max) / 8), 1.0)
    x, y, z = (jnp.where(usable, size, 1.0) / divisor for size in sizes)
    unit = jnp.where(usable, values, 1.0) / divisor / jnp.sqrt(x * x + y * y + z * z)
    return jnp.where(usable, unit, 0.0), ~jnp.isfinite(values)


def _distance(values: jax.Array, buffer: Buffer) -> Sanitized:
    bad = ~(values >= 0)
    known = jnp.where((values >= _FAR_ROUNDED) & (values < FAR), FAR, jnp.where(bad, 0.0, values))
    return jnp.minimum(known, FARTHEST), bad | (values > FARTHEST)


def _vector(values: jax.Array, buffer: Buffer) -> Sanitized:
    known = jnp.all(jnp.isfinite(values), axis=-1, keepdims=True)
    return jnp.where(known, values, jnp.nan), ~known


_SANITIZERS: dict[str, Callable[[jax.Array, Buffer], Sanitized]] = {
    "light": _light,
    "signed": _signed,
    "fraction": _fraction,
    "count": _count,
    "direction": _direction,
    "distance": _distance,
    "vector": _vector,
}


def sanitize_image(image: jax.typing.ArrayLike) -> jax.Array:
    """An image without invalid values: not finite or negative -> 0, at most ``RADIANCE_MAX``."""
    image = jnp.asarray(image)
    bad = ~(jnp.isfinite(image) & (image >= 0))
    return jnp.minimum(jnp.where(bad, 0.0, image), RADIANCE_MAX)
