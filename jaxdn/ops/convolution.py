"""3x3 convolution with gradients that are fast inside a scan.

XLA:CPU runs plain NHWC/HWIO convolutions fast, but not those of automatic differentiation inside ``lax.scan`` (28 times
slower in a test with two layers, jax 0.10). The ``"blocked"`` implementation has its own VJP: the gradient by the image
is again a plain convolution, the gradient by the kernel a few matrix products. The ``"onednn"`` implementation runs all
three in oneDNN.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

from jaxdn.ops import onednn
from jaxdn.ops.registry import register, resolve

_LAYOUT = ("NHWC", "HWIO", "NHWC")
_BLOCK_BYTES = 4 << 20
"""Patches are gathered in blocks of about this size: they stay in the cache, and a 720p frame takes little memory."""


def convolve(x: jax.Array, kernel: jax.Array, *, implementation: str | None = None) -> jax.Array:
    """Convolve ``x`` [N, H, W, Ci] with ``kernel`` [3, 3, Ci, Co], stride 1, zeros outside: [N, H, W, Co]."""
    return resolve("convolution", implementation)(x, kernel)


@register("convolution", "reference", preferred_on=("gpu", "tpu"))
def reference(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """XLA's own convolution with automatic gradients."""
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=_LAYOUT)


@jax.custom_vjp
def _blocked(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return reference(x, kernel)


def _forward(x: jax.Array, kernel: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return reference(x, kernel), (x, kernel)


def _backward(residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = residuals
    turned = jnp.flip(kernel, (0, 1)).swapaxes(2, 3)
    return reference(cotangent, turned), _kernel_gradient(x, cotangent)


_blocked.defvjp(_forward, _backward)


def _patches(image: jax.Array, first: jax.Array | int, rows: int) -> jax.Array:
    """The 3x3 neighbourhoods of ``rows`` rows of a padded image: [N * rows * W, 9 * C], row-major taps."""
    width = image.shape[2] - 2
    strip = lax.dynamic_slice_in_dim(image, first, rows + 2, 1)
    taps = [strip[:, i : i + rows, j : j + width] for i in range(3) for j in range(3)]
    return jnp.concatenate(taps, axis=-1).reshape(-1, 9 * image.shape[3])


@custom_vmap
def _kernel_gradient(x: jax.Array, cotangent: jax.Array) -> jax.Array:
    """d loss / d kernel, ``sum_p x(p + offset) cotangent(p)``: patches of the side with fewer channels."""
    count, height, width, inputs = x.shape
    outputs = cotangent.shape[3]
    around_output = outputs <= inputs
    thin, wide = (cotangent, x) if around_output else (x, cotangent)
    padded = jnp.pad(thin, ((0, 0), (1, 1), (1, 1), (0, 0)))
    exact = jnp.promote_types(x.dtype, jnp.float32)  # a sum over all pixels needs more digits than bfloat16 has
    rows = height
    while rows % 2 == 0 and count * rows * width * 9 * thin.shape[3] * x.dtype.itemsize > _BLOCK_BYTES:
        rows //= 2

    def strip(first: jax.Array | int) -> jax.Array:
        flat = lax.dynamic_slice_in_dim(wide, first, rows, 1).reshape(-1, wide.shape[3])
        return lax.dot_general(
            flat, _patches(padded, first, rows), (((0,), (0,)), ((), ())), preferred_element_type=exact
        )

    if rows == height:
        total = strip(0)
    else:
        empty = jnp.zeros((wide.shape[3], 9 * thin.shape[3]), exact)
        total, _ = lax.scan(lambda sum, index: (sum + strip(index * rows), None), empty, jnp.arange(height // rows))
    total = total.astype(x.dtype).reshape(wide.shape[3], 3, 3, thin.shape[3])
    if around_output:  # offsets of the cotangent's patches have the opposite sign
        return jnp.flip(total, (1, 2)).transpose(1, 2, 0, 3)
    return total.transpose(1, 2, 3, 0)


@_kernel_gradient.def_vmap
def _one_by_one(size: int, batched: tuple[bool, bool], x: jax.Array, cotangent: jax.Array) -> tuple[jax.Array, bool]:
    """Under vmap, one plain product per example: XLA:CPU has no fast path for batched ones.

    The loop is not unrolled: it takes about the same time and a third of the compilation time.
    """
    x = x if batched[0] else jnp.broadcast_to(x, (size, *x.shape))
    cotangent = cotangent if batched[1] else jnp.broadcast_to(cotangent, (size, *cotangent.shape))
    return lax.map(lambda pair: _kernel_gradient(*pair), (x, cotangent)), True


@register("convolution", "blocked", preferred_on=("cpu",))
def blocked(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """XLA's convolution with gradients that are plain convolutions and blocked matrix products."""
    return _blocked(x, kernel)


@jax.custom_vjp
def _by_engine(x: jax.Array, kernel: jax.Array) -> jax.Array:
    return onednn.forward(x, kernel)


def _engine_backward(residuals: tuple[jax.Array, jax.Array], cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = residuals
    return onednn.image_gradient(cotangent, kernel), onednn.kernel_gradient(x, cotangent)


_by_engine.defvjp(lambda x, kernel: (onednn.forward(x, kernel), (x, kernel)), _engine_backward)


@register("convolution", "onednn", requires=onednn.check_available)
def engine(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """oneDNN for float32, value and gradients; ``"blocked"`` for other types, which oneDNN does not run fast."""
    if x.dtype == kernel.dtype == jnp.float32:
        return _by_engine(x, kernel)
    return _blocked(x, kernel)
