"""3x3 convolution with gradients that are fast inside a scan, and computed for a whole batch at once.

A convolution is linear in the image and in the kernel, and its gradients are of the same kind: that by the image is
the convolution of the cotangent with the turned kernel; that by the kernel is a sum over pixels, linear in the image
and in the cotangent, whose own gradients are convolutions again. A backend is therefore two functions, and all
derivatives follow (:func:`_differentiable`).

XLA:CPU runs plain NHWC/HWIO convolutions fast, but not those of automatic differentiation inside ``lax.scan`` (28 times
slower in a test with two layers, jax 0.10). The ``"blocked"`` implementation has the gradient by the kernel as a few
matrix products, and in double precision the convolution too. The ``"onednn"`` implementation runs all in oneDNN.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from jaxdn.ops.convolution import onednn
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.onednn import library

Product = Callable[[jax.Array, jax.Array], jax.Array]

_LAYOUT = ("NHWC", "HWIO", "NHWC")
_BLOCK_BYTES = 4 << 20
"""Patches are gathered in blocks of about this size: they stay in the cache, and a 720p frame takes little memory."""
_BORDER = ((0, 0), (1, 1), (1, 1), (0, 0))


@operation
def convolve(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Convolve ``x`` [N, H, W, Ci] with ``kernel`` [3, 3, Ci, Co], stride 1, zeros outside: [N, H, W, Co].

    The reference is XLA's own convolution with automatic gradients.
    """
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=_LAYOUT)


def _differentiable(name: str, forward: Product, kernel_gradient: Product) -> Product:
    """A convolution with all derivatives, and with images of a batch side by side.

    ``jax.custom_vjp`` would do for the derivatives, but not for batches: the gradient of a mapped loss computes the
    kernel's gradient for each example, and adds them up. A primitive is batched before it is differentiated. Images
    that share a kernel become one longer array of images, so the kernel's gradient is one product of all of them.

    Args:
      name: of the backend.
      forward: (x [N, H, W, Ci], kernel [3, 3, Ci, Co]) -> [N, H, W, Co].
      kernel_gradient: (x, cotangent [N, H, W, Co]) -> ``sum_p x(p + offset) cotangent(p)``, [3, 3, Ci, Co].
    """
    product = _primitive(
        f"{name}_convolution", forward, lambda x, kernel: (*x.shape[:3], kernel.shape[3]), _batch_of_images
    )
    gradient = _primitive(
        f"{name}_kernel_gradient", kernel_gradient, lambda x, y: (3, 3, x.shape[3], y.shape[3]), _map_one_by_one
    )
    ad.defbilinear(
        product,
        lambda cotangent, x, kernel: product.bind(cotangent, _turn_kernel(kernel)),
        lambda cotangent, x, kernel: gradient.bind(x, cotangent),
    )
    ad.defbilinear(
        gradient,
        lambda cotangent, x, y: product.bind(y, _turn_kernel(cotangent)),
        lambda cotangent, x, y: product.bind(x, cotangent),
    )
    return product.bind


def _primitive(name: str, compute: Product, shape: Callable[[Any, Any], tuple[int, ...]], batch: Any) -> Primitive:
    """An operation of two arrays of one type."""
    made = Primitive(name)
    made.def_impl(jax.jit(compute))
    made.def_abstract_eval(lambda x, y: x.update(shape=shape(x, y), weak_type=False))
    mlir.register_lowering(made, mlir.lower_fun(compute, multiple_results=False))
    batching.primitive_batchers[made] = lambda arguments, axes: batch(made, arguments, axes)
    return made


def _turn_kernel(kernel: jax.Array) -> jax.Array:
    return jnp.flip(kernel, (0, 1)).swapaxes(2, 3)


def _batch_of_images(product: Primitive, arguments: Any, axes: Any) -> tuple[jax.Array, int]:
    (x, kernel), (axis, kernels) = arguments, axes
    if kernels is not None:
        return _map_one_by_one(product, arguments, axes)
    x = jnp.moveaxis(x, axis, 0)
    out = product.bind(x.reshape(-1, *x.shape[2:]), kernel)
    return out.reshape(*x.shape[:2], *out.shape[1:]), 0


def _map_one_by_one(product: Primitive, arguments: Any, axes: Any) -> tuple[jax.Array, int]:
    """One plain product per example: XLA:CPU has no fast path for batched ones.

    The loop is not unrolled: it takes about the same time and a third of the compilation time.
    """
    batched = [jnp.moveaxis(x, axis, 0) for x, axis in zip(arguments, axes, strict=True) if axis is not None]

    def one(examples: list[jax.Array]) -> jax.Array:
        rest = iter(examples)
        return product.bind(*(x if axis is None else next(rest) for x, axis in zip(arguments, axes, strict=True)))

    return lax.map(one, batched), 0


def _gather_patches(image: jax.Array, first: jax.Array | int, rows: int) -> jax.Array:
    """The 3x3 neighbourhoods of ``rows`` rows of a padded image: [N * rows * W, 9 * C], row-major taps."""
    width = image.shape[2] - 2
    block = lax.dynamic_slice_in_dim(image, first, rows + 2, 1)
    taps = [block[:, i : i + rows, j : j + width] for i in range(3) for j in range(3)]
    return jnp.concatenate(taps, axis=-1).reshape(-1, 9 * image.shape[3])


def _rows_per_block(image: jax.Array) -> int:
    """How many rows of patches make a block."""
    count, rows, width, channels = image.shape
    while rows % 2 == 0 and count * rows * width * 9 * channels * image.dtype.itemsize > _BLOCK_BYTES:
        rows //= 2
    return rows


def _forward(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """XLA's convolution; matrix products in double precision, for which XLA:CPU has nothing but plain loops.

    With the channels of a U-Net these take ten times as long.
    """
    if x.dtype != jnp.float64:
        return convolve(x, kernel, implementation="reference")
    count, height, width, _ = x.shape
    padded, flat, rows = jnp.pad(x, _BORDER), kernel.reshape(-1, kernel.shape[3]), _rows_per_block(x)

    def block(first: jax.Array | int) -> jax.Array:
        return (_gather_patches(padded, first, rows) @ flat).reshape(count, rows, width, -1)

    if rows == height:
        return block(0)
    blocks = lax.map(block, jnp.arange(0, height, rows))
    return blocks.swapaxes(0, 1).reshape(count, height, width, -1)


def _kernel_gradient(x: jax.Array, cotangent: jax.Array) -> jax.Array:
    """``sum_p x(p + offset) cotangent(p)`` with patches of the side with fewer channels."""
    height, inputs, outputs = x.shape[1], x.shape[3], cotangent.shape[3]
    around_output = outputs <= inputs
    thin, wide = (cotangent, x) if around_output else (x, cotangent)
    padded = jnp.pad(thin, _BORDER)
    exact = jnp.promote_types(x.dtype, jnp.float32)  # a sum over all pixels needs more digits than bfloat16 has
    rows = _rows_per_block(thin)

    def block(first: jax.Array | int) -> jax.Array:
        flat = lax.dynamic_slice_in_dim(wide, first, rows, 1).reshape(-1, wide.shape[3])
        return lax.dot_general(
            flat, _gather_patches(padded, first, rows), (((0,), (0,)), ((), ())), preferred_element_type=exact
        )

    if rows == height:
        total = block(0)
    else:
        empty = jnp.zeros((wide.shape[3], 9 * thin.shape[3]), exact)
        total, _ = lax.scan(lambda sum, index: (sum + block(index * rows), None), empty, jnp.arange(height // rows))
    total = total.astype(x.dtype).reshape(wide.shape[3], 3, 3, thin.shape[3])
    if around_output:  # offsets of the cotangent's patches have the opposite sign
        return jnp.flip(total, (1, 2)).transpose(1, 2, 0, 3)
    return total.transpose(1, 2, 3, 0)


_blocked = _differentiable("blocked", _forward, _kernel_gradient)
_by_onednn = _differentiable("onednn", onednn.forward, onednn.kernel_gradient)


@convolve.implementation("blocked", platforms=("cpu",))
def _convolve_blocked(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """XLA's convolution with gradients that are plain convolutions and blocked matrix products."""
    return _blocked(x, kernel)


@convolve.implementation("onednn", dtypes=(jnp.float32,), unavailable=library.unavailable)
def _convolve_by_onednn(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Value and gradients in oneDNN, which runs other types no faster than XLA."""
    return _by_onednn(x, kernel)


@convolve.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for inputs, outputs in ((2, 3), (3, 2)):
        yield Example((rng.normal(size=(2, height, width, inputs)), rng.normal(size=(3, 3, inputs, outputs))))
