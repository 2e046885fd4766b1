"""oneDNN's 3x3 convolutions and their gradients, called from inside a jitted program on CPUs.

XLA:CPU has no fast gradient of a convolution by its kernel, and its convolutions reach two thirds of the machine's
peak. The library: :mod:`jaxdn.ops.onednn.library`. :mod:`jaxdn.ops.convolution.api` makes one differentiable operation
of the two functions.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.ops.onednn import library as dnnl

_ONE, _ZERO = dnnl.Dims(1, 1), dnnl.Dims(0, 0)


class _Convolution:
    """One direction of a convolution of one shape, created once; called with addresses.

    The library chooses the layout of the kernel; every call converts to or from it (a few microseconds).

    Args:
      direction: "forward" or "kernel gradient".
      count: images N.
      height: of the images.
      width: of the images.
      inputs: channels of the convolution's input.
      outputs: channels of its output.
    """

    def __init__(self, direction: str, count: int, height: int, width: int, inputs: int, outputs: int) -> None:
        x, y = (dnnl.describe_images(count, height, width, channels) for channels in (inputs, outputs))
        ours, dims = dnnl.describe_kernels(3, inputs, outputs)
        free = dnnl.create("dnnl_memory_desc_create_with_tag", 4, dims, dnnl.FLOAT32, dnnl.ANY_LAYOUT)
        window = (_ONE, _ZERO, _ONE, _ONE)  # stride, dilation, zeros before and after
        cpu, ours_alone = dnnl.engine()[0], dnnl.attributes()
        forward = dnnl.create(
            "dnnl_convolution_forward_primitive_desc_create",
            *(cpu, dnnl.TRAINING, dnnl.DIRECT, x, free, None, y, *window, ours_alone),
        )
        description, query = forward, dnnl.ASK_WEIGHTS
        roles = dnnl.SOURCE, dnnl.WEIGHTS, dnnl.DESTINATION
        backward = direction == "kernel gradient"
        if backward:
            description = dnnl.create(
                "dnnl_convolution_backward_weights_primitive_desc_create",
                *(cpu, dnnl.DIRECT, x, free, None, y, *window, forward, ours_alone),
            )
            query = dnnl.ASK_WEIGHTS_GRADIENT
            roles = dnnl.SOURCE, dnnl.WEIGHTS_GRADIENT, dnnl.DESTINATION_GRADIENT
        theirs = dnnl.query(description, query)
        # Memory without an address: it is set at every call.
        self._given = [dnnl.create_memory(each) for each in (x, ours, y)]
        inside = dnnl.create_memory(theirs, dnnl.OWN_MEMORY)
        first, kernel, last = self._given
        convolve = dnnl.Primitive(description, (roles[0], first), (roles[1], inside), (roles[2], last))
        pair = (theirs, ours) if backward else (ours, theirs)
        ends = (inside, kernel) if backward else (kernel, inside)
        convert = dnnl.Primitive(dnnl.reorder(*pair), (dnnl.SOURCE, ends[0]), (dnnl.DESTINATION, ends[1]))
        self._work = [convolve, convert] if backward else [convert, convolve]

    def __call__(self, first: int, kernel: int, last: int) -> None:
        """Addresses of x, of the kernel or its gradient, and of y."""
        for memory, place in zip(self._given, (first, kernel, last), strict=True):
            dnnl.set_address(memory, place)
        for primitive in self._work:
            primitive()


_made_once = functools.cache(_Convolution)
"""Never freed, as jax keeps the programs that call them; each takes the memory of one kernel."""


def _forward(context: Any, out: Any, x: Any, kernel: Any) -> None:
    _run("forward", x, kernel, out)


def _kernel_gradient(context: Any, out: Any, x: Any, cotangent: Any) -> None:
    _run("kernel gradient", x, out, cotangent)


def _run(direction: str, x: Any, kernel: Any, y: Any) -> None:
    buffers = [np.asarray(each) for each in (x, kernel, y)]
    run = _made_once(direction, *buffers[0].shape, buffers[2].shape[-1])
    with dnnl.LOCK:
        run(*map(dnnl.address_of, buffers))


def _program(callback: Callable[..., None], shape: Sequence[int], *arguments: jax.Array) -> jax.Array:
    return buffer_callback(callback, jax.ShapeDtypeStruct(tuple(shape), jnp.float32))(*arguments)


def forward(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """``x`` [N, H, W, Ci] convolved with ``kernel`` [3, 3, Ci, Co], float32, stride 1, zeros outside."""
    return _program(_forward, (*x.shape[:3], kernel.shape[3]), x, kernel)


def kernel_gradient(x: jax.Array, cotangent: jax.Array) -> jax.Array:
    """The gradient by the kernel, ``sum_p x(p + offset) cotangent(p)``: [3, 3, Ci, Co]."""
    return _program(_kernel_gradient, (3, 3, x.shape[3], cotangent.shape[3]), x, cotangent)
