"""Functions of Python called from inside a jitted program on CPUs, by names that stay the same between processes.

jax's own callbacks put an address of this process into the program, so that jax leaves such programs out of its
persistent cache. Here one handler of XLA's foreign function interface stands for all functions. A program holds the
name of the function that it calls, and can be kept; the function is declared under that name while it is traced, which
happens in every process before a program is looked up.

The handler's C structures: ``xla/ffi/api/c_api.h``, in the folder that ``jax.ffi.include_dir()`` names. Where a version
of jax has others, or refuses the handler, its own callbacks are used, and programs are compiled in every process.
"""

import atexit
import contextlib
import ctypes
import functools
import hashlib
import math
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import ml_dtypes
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

Work = Callable[..., None]
"""Gets the list of results to fill, and then what is read, all as NumPy arrays of the program's own memory."""

_TARGET = "jaxdn_host_call"
_METADATA, _UNKNOWN_ERROR = 1, 2
_KNOWN_VERSIONS = ((0, 3), (0, 4), (0, 5))
"""Of the interface, whose structures are those below: jax 0.10 has (0, 3), jax 0.12 has (0, 5)."""
_DTYPES = {
    1: np.bool_, 2: np.int8, 3: np.int16, 4: np.int32, 5: np.int64, 6: np.uint8, 7: np.uint16, 8: np.uint32,
    9: np.uint64, 10: np.float16, 11: np.float32, 12: np.float64, 16: ml_dtypes.bfloat16,
}  # fmt: skip
"""The interface's numbers of dtypes."""
_WORK: dict[str, Work] = {}
_here = threading.local()
_calling: set[int] = set()
"""The threads that are in a call."""
_PAUSE, _QUIET = 5e-3, 4
"""Seconds between looks at what still runs as the process ends, and how many in a row have to find nothing."""
_PATIENCE = 10.0
"""Seconds that arrays are waited for: one that waits for another process, which has gone, is never computed."""


def call_host(
    name: str | None, work: Work, kinds: Sequence[jax.ShapeDtypeStruct], *arrays: jax.Array
) -> list[jax.Array]:
    """Arrays of these ``kinds``, filled by ``work``; one after the other under ``jax.vmap``.

    An exception of ``work`` ends the program with an error that holds its name and message.

    Args:
      name: the same in every process, and another one for everything that ``work`` does otherwise: a second
        declaration replaces the first (:func:`name_of`). None: there is no such name; the program cannot be kept.
      work: see :data:`Work`; pure.
      kinds: of the results.
      arrays: what is read.
    """
    _end_with_process()
    if name is None or not _register():
        return list(buffer_callback(functools.partial(_as_callback, work), kinds, vmap_method="sequential")(*arrays))
    _WORK[name] = work
    return list(jax.ffi.ffi_call(_TARGET, list(kinds), vmap_method="sequential")(*arrays, name=name))


def name_of(function: Callable[..., Any], *constants: Any) -> str | None:
    """A name for a function of a module with these constants: numbers, text, arrays and tuples of them.

    None for a function that another one has made, as what it holds is not known.
    """
    module, name = (getattr(function, part, "") for part in ("__module__", "__qualname__"))
    if not name or "<" in name:
        return None
    return f"{module}.{name}:{hashlib.sha256(_describe(constants).encode()).hexdigest()[:32]}"


def _describe(constant: Any) -> str:
    """Text that differs where constants do; the text of a large array leaves out most of it."""
    if isinstance(constant, (tuple, list)):
        return f"{type(constant).__name__}({','.join(map(_describe, constant))})"
    if isinstance(constant, (np.ndarray, np.generic)):
        return f"{constant.dtype}{constant.shape}{constant.tobytes().hex()}"
    return repr(constant)


def _as_callback(work: Work, context: Any, results: Sequence[Any], *arrays: Any) -> None:
    work([np.asarray(result) for result in results], *map(np.asarray, arrays))


class _Extension(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("type", ctypes.c_int), ("next", ctypes.c_void_p))


class _Version(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    )


class _Metadata(ctypes.Structure):
    _fields_ = (("size", ctypes.c_size_t), ("version", _Version), ("traits", ctypes.c_uint32))


class _MetadataExtension(ctypes.Structure):
    _fields_ = (("base", _Extension), ("metadata", ctypes.POINTER(_Metadata)))


class _ErrorArguments(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    )


_CreateError = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))


class _Api(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("create_error", _CreateError),
    )


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )


class _Buffers(ctypes.Structure):
    """Arguments, or results."""

    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("number", ctypes.c_int64),
        ("types", ctypes.POINTER(ctypes.c_int)),
        ("places", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    )


class _Text(ctypes.Structure):
    _fields_ = (("start", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Attributes(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("number", ctypes.c_int64),
        ("types", ctypes.POINTER(ctypes.c_int)),
        ("names", ctypes.c_void_p),
        ("places", ctypes.POINTER(ctypes.POINTER(_Text))),
    )


class _CallFrame(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("api", ctypes.POINTER(_Api)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
        ("attributes", _Attributes),
    )


_Handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))


@_Handler
def _handle(pointer: Any) -> int | None:
    """What XLA calls: once to ask for the version of the interface, then for every call of a program."""
    frame, thread = pointer.contents, threading.get_ident()
    if frame.extension and frame.extension.contents.type == _METADATA:
        extension = ctypes.cast(frame.extension, ctypes.POINTER(_MetadataExtension)).contents
        version = extension.metadata.contents.version
        version.major, version.minor = _version()
        return None
    _calling.add(thread)
    try:
        _keep_thread()
        work = _WORK[_name_of(frame.attributes)]
        results, arrays = (
            [_array_of(buffers.places[i].contents) for i in range(buffers.number)]
            for buffers in (frame.results, frame.arguments)
        )
        for array in arrays:  # what a program reads may be read again
            array.flags.writeable = False
        work(results, *arrays)
    except BaseException as error:  # nothing may leave a function that C calls
        # As in jax's own callbacks, jaxdn.runtime.interrupt finds Ctrl-C by the end of the message.
        message = f"{type(error).__name__}: {error}".encode(errors="backslashreplace")
        given = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, message, _UNKNOWN_ERROR)
        return frame.api.contents.create_error(ctypes.byref(given))
    finally:
        _calling.discard(thread)
    return None


@functools.cache
def _end_with_process() -> None:
    """Have :func:`_finish` called before jax's own functions for the end of the process."""
    atexit.register(_finish)


def _finish() -> None:
    """Keep XLA's client for ever, and wait for calls that have begun and, for a while, for arrays.

    As a process ends, jax deletes the client, which waits for all programs and keeps Python's lock meanwhile: one that
    nobody has waited for, and that has a call to make, would never end. Those not yet begun end with the process.
    """
    with contextlib.suppress(RuntimeError):  # there is no CPU among jax's platforms
        client = jax.local_devices(backend="cpu")[0].client
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(client))
    end = time.monotonic() + _PATIENCE
    quiet = 0 if _is_busy(end) else _QUIET
    while quiet < _QUIET:
        time.sleep(_PAUSE)
        quiet = 0 if _is_busy(end) else quiet + 1


def _is_busy(end: float) -> bool:
    """Whether there are calls, or, until ``end`` by ``time.monotonic()``, arrays that are not computed yet."""
    if _calling or time.monotonic() > end:
        return bool(_calling)
    return not all(array.is_ready() for array in jax.live_arrays())


def _keep_thread() -> None:
    """Let Python remember this thread: else it forgets XLA's threads after each call, and takes a call's time to begin.

    It counts how often a thread has come in without leaving, and this once is never taken back.
    """
    if not hasattr(_here, "known"):
        ctypes.pythonapi.PyGILState_Ensure()
        _here.known = True


def _name_of(attributes: _Attributes) -> str:
    """The one attribute that calls have."""
    text = attributes.places[0].contents
    return ctypes.string_at(text.start, text.length).decode()


def _array_of(buffer: _Buffer) -> np.ndarray:
    """The memory of a buffer, which the program keeps as long as the call lasts."""
    shape, dtype = tuple(buffer.dims[i] for i in range(buffer.rank)), np.dtype(_DTYPES[buffer.dtype])
    size = dtype.itemsize * math.prod(shape)
    if not size:
        return np.empty(shape, dtype)
    return np.ndarray(shape, dtype, (ctypes.c_char * size).from_address(buffer.data))


@functools.cache
def _version() -> tuple[int, int]:
    """Of the interface that this jax was built with, as its header says."""
    header = (Path(jax.ffi.include_dir()) / "xla" / "ffi" / "api" / "c_api.h").read_text("utf-8")
    numbers = [int(line.split()[2]) for line in header.splitlines() if line.startswith("#define XLA_FFI_API_M")]
    return numbers[0], numbers[1]


@functools.cache
def _register() -> bool:
    """Whether XLA takes the handler."""
    try:
        if _version() not in _KNOWN_VERSIONS:
            return False
        jax.ffi.register_ffi_target(_TARGET, jax.ffi.pycapsule(_handle), platform="cpu")
    except (OSError, IndexError, ValueError, RuntimeError):
        return False
    return True
