"""The library oneDNN (Apache-2.0; the engine under PyTorch on CPUs), called through its C interface by ctypes.

It is an extra, ``pip install onednn-cpu-gomp``: a shared library of version 3, so that no compiler is needed. It reads
and writes XLA's own buffers. Layers of networks: :mod:`jaxdn.ops.convolution.onednn` (training),
:mod:`jaxdn.ops.onednn.layers` (inference).
"""

import ctypes
import functools
import threading
from ctypes import byref, c_int, c_int64, c_size_t, c_void_p
from importlib import metadata
from typing import Any

import jax
import numpy as np

from jaxdn.runtime.optional import install

PACKAGE = "onednn-cpu-gomp"
_LIBRARY = "libdnnl.so.3"

# The C interface's numbers (oneapi/dnnl/dnnl_types.h).
BFLOAT16, FLOAT32 = 2, 3
ANY_LAYOUT, ROW = 1, 2
TRAINING, INFERENCE, DIRECT = 64, 96, 1
ASK_WEIGHTS, ASK_WEIGHTS_GRADIENT, ASK_SCRATCHPAD = 131, 132, 136
SOURCE, DESTINATION, WEIGHTS, BIAS, SCRATCHPAD = 1, 17, 33, 41, 80
DESTINATION_GRADIENT, WEIGHTS_GRADIENT = 145, 161
_CPU, _IN_ORDER, _USER_SCRATCHPAD = 1, 1, 1
_LINE = 64
"""Bytes of a cache line."""
_HAS_AVX512, _HAS_BFLOAT16 = 0x20, 0x80
"""Bits of ``dnnl_get_effective_cpu_isa``: of CPUs with AVX-512, and of those with AVX-512 BF16 or AMX."""
OWN_MEMORY, NO_MEMORY = c_void_p(-1), c_void_p(None)

Dims = c_int64 * 12

LOCK = threading.Lock()
"""One layer at a time: each uses all cores, and layers of one shape share their buffers."""


class Argument(ctypes.Structure):
    """An argument of a primitive."""

    _fields_ = (("role", c_int), ("memory", c_void_p))


def _path() -> Any:
    """Where the installed package has its library; None where it is not installed."""
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    return next((file.locate() for file in files if file.name == _LIBRARY), None)


@functools.cache
def library() -> Any:
    """The C functions; those called at every convolution have declared types, which makes ctypes faster."""
    found = ctypes.CDLL(str(_path()))
    found.dnnl_primitive_desc_query_md.restype = c_void_p
    found.dnnl_primitive_desc_query_md.argtypes = (c_void_p, c_int, c_int)
    found.dnnl_primitive_execute.argtypes = (c_void_p, c_void_p, c_int, c_void_p)
    found.dnnl_memory_set_data_handle.argtypes = (c_void_p, c_void_p)
    found.dnnl_memory_desc_get_size.restype = c_size_t
    found.dnnl_memory_desc_get_size.argtypes = (c_void_p,)
    return found


def available() -> bool:
    """Whether the library can be loaded and jax computes on the CPU."""
    if jax.default_backend() != "cpu" or _path() is None:
        return False
    try:
        library()
    except OSError:
        return False
    return True


@functools.cache
def computes_bfloat16() -> bool:
    """Whether the CPU multiplies numbers in bfloat16, as the library sees it."""
    return bool(library().dnnl_get_effective_cpu_isa() & _HAS_BFLOAT16)


def training_is_faster() -> bool:
    """Whether training with oneDNN's convolutions takes less time than in XLA, which it does on CPUs with AVX-512.

    A step takes 0.7 to 1.0 of XLA's time there, and 1.02 to 1.5 times as long with AVX2 alone. False where the library
    cannot be loaded.
    """
    return available() and bool(library().dnnl_get_effective_cpu_isa() & _HAS_AVX512)


def unavailable() -> str:
    """Why oneDNN cannot run here, and what to do; empty if it can."""
    if (backend := jax.default_backend()) != "cpu":
        return f"runs on the CPU, and jax computes on {backend!r}; leave it None, or set JAX_PLATFORMS=cpu"
    return "" if available() else f"needs the package {PACKAGE} (Linux, x86-64): {install('onednn')}"


def call(function: str, *arguments: Any) -> None:
    """Call a C function. Raises RuntimeError where it fails."""
    status = getattr(library(), function)(*arguments)
    if status:
        raise RuntimeError(f"oneDNN: {function} failed with status {status}.")


def create(function: str, *arguments: Any) -> c_void_p:
    """What a ``dnnl_..._create`` function puts into its first argument."""
    place = c_void_p()
    call(function, byref(place), *arguments)
    return place


@functools.cache
def engine() -> tuple[c_void_p, c_void_p]:
    """The CPU, and a stream of work for it. Neither is ever freed: they live as long as the process."""
    cpu = create("dnnl_engine_create", _CPU, c_size_t(0))
    return cpu, create("dnnl_stream_create", cpu, _IN_ORDER)


def new_attributes() -> c_void_p:
    """Attributes of primitives that get their working memory from us.

    The library's own belongs to the thread that creates a primitive, and XLA calls back from any of its threads: there
    it would be missing, and the primitive would write to address 0.
    """
    found = create("dnnl_primitive_attr_create")
    call("dnnl_primitive_attr_set_scratchpad_mode", found, _USER_SCRATCHPAD)
    return found


attributes = functools.cache(new_attributes)
"""The same, of which nothing is changed."""


def describe_images(count: int, height: int, width: int, channels: int, dtype: int = FLOAT32) -> c_void_p:
    """Describes [N, H, W, C] in memory; oneDNN's dimensions are N, C, H, W for any order in memory."""
    strides = Dims(height * width * channels, 1, width * channels, channels)
    dims = Dims(count, channels, height, width)
    return create("dnnl_memory_desc_create_with_strides", 4, dims, dtype, strides)


def describe_kernels(size: int, inputs: int, outputs: int) -> tuple[c_void_p, Any]:
    """Describes [size, size, inputs, outputs] in memory, float32; and oneDNN's dimensions of it."""
    dims = Dims(outputs, inputs, size, size)
    strides = Dims(1, outputs, size * inputs * outputs, inputs * outputs)
    return create("dnnl_memory_desc_create_with_strides", 4, dims, FLOAT32, strides), dims


def query(description: c_void_p, what: int) -> c_void_p:
    """The memory that a primitive wants, by one of the numbers ``ASK_...``."""
    return c_void_p(library().dnnl_primitive_desc_query_md(description, what, 0))


def create_memory(description: c_void_p, place: c_void_p | int = NO_MEMORY) -> c_void_p:
    """Memory at an address, of the library's own, or without an address."""
    return create("dnnl_memory_create", description, engine()[0], c_void_p(place) if isinstance(place, int) else place)


def set_address(given: c_void_p, place: int) -> None:
    """Move memory to an address."""
    call("dnnl_memory_set_data_handle", given, place)


class Primitive:
    """Work for the library: a described primitive and its arguments, by their roles."""

    def __init__(self, description: c_void_p, *given: tuple[int, c_void_p], scratch: c_void_p = OWN_MEMORY) -> None:
        self._primitive, self._stream = create("dnnl_primitive_create", description), engine()[1]
        needed = query(description, ASK_SCRATCHPAD)
        self.scratch_bytes = int(library().dnnl_memory_desc_get_size(needed))
        """Of its working memory, which ``scratch`` places."""
        self.scratch = create_memory(needed, scratch)
        self._count = len(given) + 1
        self._arguments = (Argument * self._count)(*(Argument(*each) for each in (*given, (SCRATCHPAD, self.scratch))))

    def __call__(self) -> None:
        """Do the work."""
        call("dnnl_primitive_execute", self._primitive, self._stream, self._count, self._arguments)


def reorder(source: c_void_p, target: c_void_p) -> c_void_p:
    """Describes the primitive that copies between two layouts or types."""
    cpu = engine()[0]
    return create("dnnl_reorder_primitive_desc_create", source, cpu, target, cpu, attributes())


def allocate_aligned(size: int) -> np.ndarray:
    """New memory of ``size`` bytes that begins at a multiple of 64.

    The library writes large results past the caches, with instructions that end the process at any other address.
    """
    array = np.empty(size + _LINE, np.uint8)
    first = -address_of(array) % _LINE
    return array[first : first + size]


def address_of(array: np.ndarray) -> int:
    """Of an array's first number."""
    return int(array.__array_interface__["data"][0])
