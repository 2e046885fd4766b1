"""oneDNN's 3x3 convolutions and their gradients, called from inside a jitted program on CPUs.

XLA:CPU has no fast gradient of a convolution by its kernel, and its convolutions reach two thirds of the machine's
peak. oneDNN (Apache-2.0; the engine under PyTorch on CPUs) is an extra, ``pip install onednn-cpu-gomp``: a
shared library, called through its C interface (version 3) by ctypes, so that no compiler is needed. It reads and
writes XLA's own buffers. :mod:`jaxdn.ops.convolution` makes one differentiable operation of the two functions.
"""

import ctypes
import functools
import threading
from collections.abc import Callable, Sequence
from ctypes import byref, c_int, c_int64, c_size_t, c_void_p
from importlib import metadata
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.extras import install

PACKAGE = "onednn-cpu-gomp"
_LIBRARY = "libdnnl.so.3"

# The C interface's numbers (oneapi/dnnl/dnnl_types.h).
_CPU, _FLOAT32, _ANY_LAYOUT, _IN_ORDER, _TRAINING, _DIRECT = 1, 3, 1, 1, 64, 1
_ASK_WEIGHTS, _ASK_WEIGHTS_GRADIENT, _ASK_SCRATCHPAD = 131, 132, 136
_SOURCE, _DESTINATION, _WEIGHTS = 1, 17, 33
_DESTINATION_GRADIENT, _WEIGHTS_GRADIENT = 145, 161
_SCRATCHPAD, _USER_SCRATCHPAD = 80, 1
_OWN_MEMORY, _NO_MEMORY = c_void_p(-1), c_void_p(None)

_Dims = c_int64 * 12
_ONE, _ZERO = _Dims(1, 1), _Dims(0, 0)


class _Argument(ctypes.Structure):
    _fields_ = (("role", c_int), ("memory", c_void_p))


def _path() -> Any:
    """Where the installed package has its library; None where it is not installed."""
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    return next((file.locate() for file in files if file.name == _LIBRARY), None)


@functools.cache
def _library() -> Any:
    """The C functions; those called at every convolution have declared types, which makes ctypes faster."""
    library = ctypes.CDLL(str(_path()))
    library.dnnl_primitive_desc_query_md.restype = c_void_p
    library.dnnl_primitive_desc_query_md.argtypes = (c_void_p, c_int, c_int)
    library.dnnl_primitive_execute.argtypes = (c_void_p, c_void_p, c_int, c_void_p)
    library.dnnl_memory_set_data_handle.argtypes = (c_void_p, c_void_p)
    return library


def available() -> bool:
    """Whether the library can be loaded and jax computes on the CPU."""
    if jax.default_backend() != "cpu" or _path() is None:
        return False
    try:
        _library()
    except OSError:
        return False
    return True


def check_available() -> None:
    """Raise ValueError, with what to do, where oneDNN cannot run."""
    if jax.default_backend() != "cpu":
        raise ValueError(
            f'implementation: "onednn" runs on the CPU, and jax computes on {jax.default_backend()!r}; '
            "leave it None, or set JAX_PLATFORMS=cpu."
        )
    if not available():
        raise ValueError(f'implementation: "onednn" needs the package {PACKAGE} (Linux, x86-64): {install("onednn")}')


def _call(function: str, *arguments: Any) -> None:
    status = getattr(_library(), function)(*arguments)
    if status:
        raise RuntimeError(f"oneDNN: {function} failed with status {status}.")


def _made(function: str, *arguments: Any) -> c_void_p:
    """What a ``dnnl_..._create`` function puts into its first argument."""
    made = c_void_p()
    _call(function, byref(made), *arguments)
    return made


@functools.cache
def _engine() -> tuple[c_void_p, c_void_p]:
    """The CPU, and a stream of work for it. Neither is ever freed: they live as long as the process."""
    engine = _made("dnnl_engine_create", _CPU, c_size_t(0))
    return engine, _made("dnnl_stream_create", engine, _IN_ORDER)


@functools.cache
def _attributes() -> c_void_p:
    """Primitives get their working memory from us.

    The library's own belongs to the thread that creates a primitive, and XLA calls back from any of its threads: there
    it would be missing, and the primitive would write to address 0.
    """
    attributes = _made("dnnl_primitive_attr_create")
    _call("dnnl_primitive_attr_set_scratchpad_mode", attributes, _USER_SCRATCHPAD)
    return attributes


def _images(count: int, height: int, width: int, channels: int) -> c_void_p:
    """Describes [N, H, W, C] in memory; oneDNN's dimensions are N, C, H, W for any order in memory."""
    strides = _Dims(height * width * channels, 1, width * channels, channels)
    dims = _Dims(count, channels, height, width)
    return _made("dnnl_memory_desc_create_with_strides", 4, dims, _FLOAT32, strides)


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
        engine, self._stream = _engine()
        x, y = _images(count, height, width, inputs), _images(count, height, width, outputs)
        dims = _Dims(outputs, inputs, 3, 3)
        free = _made("dnnl_memory_desc_create_with_tag", 4, dims, _FLOAT32, _ANY_LAYOUT)
        ours = _made(
            "dnnl_memory_desc_create_with_strides",
            *(4, dims, _FLOAT32, _Dims(1, outputs, 3 * inputs * outputs, inputs * outputs)),
        )
        window = (_ONE, _ZERO, _ONE, _ONE)  # stride, dilation, zeros before and after
        forward = _made(
            "dnnl_convolution_forward_primitive_desc_create",
            *(engine, _TRAINING, _DIRECT, x, free, None, y, *window, _attributes()),
        )
        description, query = forward, _ASK_WEIGHTS
        roles = _SOURCE, _WEIGHTS, _DESTINATION
        if direction == "kernel gradient":
            description = _made(
                "dnnl_convolution_backward_weights_primitive_desc_create",
                *(engine, _DIRECT, x, free, None, y, *window, forward, _attributes()),
            )
            query, roles = _ASK_WEIGHTS_GRADIENT, (_SOURCE, _WEIGHTS_GRADIENT, _DESTINATION_GRADIENT)
        theirs = c_void_p(_library().dnnl_primitive_desc_query_md(description, query, 0))
        backward = direction == "kernel gradient"
        reorder = _made(
            "dnnl_reorder_primitive_desc_create",
            *((theirs, engine, ours, engine) if backward else (ours, engine, theirs, engine)),
            _attributes(),
        )
        # Memory without an address: it is set at every call.
        self._given = [_made("dnnl_memory_create", each, engine, _NO_MEMORY) for each in (x, ours, y)]
        inside = _made("dnnl_memory_create", theirs, engine, _OWN_MEMORY)
        first, kernel, last = self._given
        convolve = self._prepared(description, (roles[0], first), (roles[1], inside), (roles[2], last))
        if backward:
            self._work = [convolve, self._prepared(reorder, (_SOURCE, inside), (_DESTINATION, kernel))]
        else:
            self._work = [self._prepared(reorder, (_SOURCE, kernel), (_DESTINATION, inside)), convolve]

    @staticmethod
    def _prepared(description: c_void_p, *arguments: tuple[int, c_void_p]) -> tuple[c_void_p, int, Any]:
        primitive = _made("dnnl_primitive_create", description)
        needed = c_void_p(_library().dnnl_primitive_desc_query_md(description, _ASK_SCRATCHPAD, 0))
        scratchpad = _made("dnnl_memory_create", needed, _engine()[0], _OWN_MEMORY)
        given = [*arguments, (_SCRATCHPAD, scratchpad)]
        return primitive, len(given), (_Argument * len(given))(*[_Argument(*each) for each in given])

    def __call__(self, first: int, kernel: int, last: int) -> None:
        """Addresses of x, of the kernel or its gradient, and of y."""
        for memory, address in zip(self._given, (first, kernel, last), strict=True):
            _call("dnnl_memory_set_data_handle", memory, address)
        for primitive, count, arguments in self._work:
            _call("dnnl_primitive_execute", primitive, self._stream, count, arguments)


_made_once = functools.cache(_Convolution)
"""Never freed, as jax keeps the programs that call them; each takes the memory of one kernel."""

_ALONE = threading.Lock()
"""One convolution at a time: each uses all cores, and convolutions of one shape share their buffers."""


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _forward(context: Any, out: Any, x: Any, kernel: Any) -> None:
    _run("forward", x, kernel, out)


def _kernel_gradient(context: Any, out: Any, x: Any, cotangent: Any) -> None:
    _run("kernel gradient", x, out, cotangent)


def _run(direction: str, x: Any, kernel: Any, y: Any) -> None:
    buffers = [np.asarray(each) for each in (x, kernel, y)]
    run = _made_once(direction, *buffers[0].shape, buffers[2].shape[-1])
    with _ALONE:
        run(*map(_address, buffers))


def _program(callback: Callable[..., None], shape: Sequence[int], *arguments: jax.Array) -> jax.Array:
    return buffer_callback(callback, jax.ShapeDtypeStruct(tuple(shape), jnp.float32))(*arguments)


def forward(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """``x`` [N, H, W, Ci] convolved with ``kernel`` [3, 3, Ci, Co], float32, stride 1, zeros outside."""
    return _program(_forward, (*x.shape[:3], kernel.shape[3]), x, kernel)


def kernel_gradient(x: jax.Array, cotangent: jax.Array) -> jax.Array:
    """The gradient by the kernel, ``sum_p x(p + offset) cotangent(p)``: [3, 3, Ci, Co]."""
    return _program(_kernel_gradient, (3, 3, x.shape[3], cotangent.shape[3]), x, cotangent)
