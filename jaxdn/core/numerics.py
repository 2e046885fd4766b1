"""Powers and lengths whose values and derivatives stay finite.

Their true derivatives are infinite or undefined at 0, and one such pixel would make the gradient of a whole clip NaN.
Each function states which finite derivative it has instead. *Tiny* below is the smallest normal number of the
dtype (1.2e-38 in float32); an infinite argument counts as the largest finite one. NaN stays NaN:
frames are sanitized before (:func:`jaxdn.denoiser.sanitize.sanitize`).
"""

from functools import partial

import jax
import jax.numpy as jnp


def _largest(x: jax.Array) -> float:
    return float(jnp.finfo(x.dtype).max)


def _tiny(x: jax.Array) -> float:
    return float(jnp.finfo(x.dtype).tiny)


def _finite(x: jax.Array) -> jax.Array:
    """Infinities as the largest numbers; not ``jnp.clip``, which halves the derivative at the largest number itself."""
    return jnp.where(jnp.isinf(x), jnp.copysign(_largest(x), x), x)


def absolute(x: jax.Array) -> jax.Array:
    """``|x|`` with derivative 0 at 0: where prediction and target agree, an L1 loss has no gradient.

    ``jnp.abs`` has derivative 1 there (or 0, depending on the version of jax).
    """
    return x * jax.lax.stop_gradient(jnp.sign(x))


def safe_power(x: jax.Array, exponent: jax.Array | float) -> jax.Array:
    """``x ** exponent`` for exponents in [0, 1]; 0 with derivative 0 for ``x`` below tiny, negative ones included.

    ``exponent`` may be an array of a shape that broadcasts with ``x`` and has a derivative of its own. 0 ** 0 is 0.
    """
    zero = x < _tiny(x)
    power = jnp.where(zero, 1.0, _finite(x)) ** exponent
    return jnp.where(zero, 0.0, power)


def safe_norm(x: jax.Array, *, axis: int = -1) -> jax.Array:
    """Euclidean length over ``axis``, which is kept with size 1; 0 with derivative 0 for a vector shorter than tiny.

    Scaled by the largest component, so that squares of tiny and huge components neither underflow nor overflow.
    A length beyond the largest finite number saturates there, and its derivative stays the unit vector.
    """
    return _norm(_finite(x), axis)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _norm(x: jax.Array, axis: int) -> jax.Array:
    scaled, scale = _scaled(x, axis)
    length = jnp.sqrt(jnp.sum(scaled * scaled, axis=axis, keepdims=True)) * scale
    return jnp.minimum(jnp.where(scale == 0, 0.0, length), _largest(x))


@_norm.defjvp
def _norm_jvp(axis: int, primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    (x,), (change,) = primals, tangents
    scaled, scale = _scaled(x, axis)
    unit = scaled / jnp.sqrt(jnp.sum(scaled * scaled, axis=axis, keepdims=True))
    return _norm(x, axis), jnp.sum(jnp.where(scale == 0, 0.0, unit) * change, axis=axis, keepdims=True)


def _scaled(x: jax.Array, axis: int) -> tuple[jax.Array, jax.Array]:
    """``x`` divided by its largest component, and that component; 1 and 0 for a vector of zeros.

    The scale is at most 1/8 of the largest number: XLA may multiply by its reciprocal, which must not be subnormal.
    """
    scale = jax.lax.stop_gradient(jnp.minimum(jnp.max(jnp.abs(x), axis=axis, keepdims=True), _largest(x) / 8))
    zero = scale < _tiny(x)
    return jnp.where(zero, 1.0, x / jnp.where(zero, 1.0, scale)), jnp.where(zero, 0.0, scale)
