"""Compiled programs, kept between runs: a farm runs a process a frame, and compiling takes longer than denoising.

jax keeps programs in a folder by all that goes into them, its own version included, but not by the CPU that their code
is for: on a home folder that several machines share, each kind of CPU has a folder of its own.

jax writes a program under its name, and never again where there is a file: what a killed process, a full or a failing
disk leaves would be half a program for good, which every later process compiles anew. So programs get their names when
they are complete, here too (:mod:`jaxdn.runtime.atomic_files`), and take the place of one that cannot be read.
"""

import hashlib
import os
import platform
import sys
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

from jaxdn.runtime.atomic_files import atomic_write, remove_abandoned

VARIABLE = "JAXDN_CACHE_DIR"
"""Environment variable: the folder of what is kept between runs; empty: nothing is kept."""
_NEVER_S = 1e9


def keep_programs() -> Path | None:
    """Let jax find compiled programs in a folder, and write new ones there if it can; returns the folder.

    None: nothing is kept, because no folder can be made or :data:`VARIABLE` is empty, or jax's own variable
    ``JAX_COMPILATION_CACHE_DIR`` says where. Warns of a folder of :data:`VARIABLE` that cannot be made.
    """
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or os.environ.get(VARIABLE) == "":
        return None
    folder = cache_folder() / f"programs-{metadata.version('jaxlib')}-{_describe_cpu()}"
    if not folder.is_absolute() and VARIABLE not in os.environ:  # no home: it would be made where the command runs
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:  # read-only, or no home
        if not folder.is_dir():
            if given := os.environ.get(VARIABLE):
                warnings.warn(
                    f"{VARIABLE}={given}: expected a folder that can be written ({error.strerror}); "
                    "programs are not kept.",
                    stacklevel=2,
                )
            return None
    import jax

    writable = os.access(folder, os.W_OK)
    if writable:
        _write_completely()
        remove_abandoned(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Reading takes milliseconds, also of small programs; without a limit each run writes what is missing.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0 if writable else _NEVER_S)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def _write_completely() -> None:
    """Let jax's store of programs write each file completely or not at all; a jax with another store keeps its own way.

    A store of limited size (``JAX_COMPILATION_CACHE_MAX_SIZE``) has locks, and stays as it is.
    """
    try:
        from jax._src import lru_cache
    except ImportError:
        return
    kind: Any = lru_cache.LRUCache
    in_place, ending = kind.put, getattr(lru_cache, "_CACHE_SUFFIX", None)
    if in_place.__module__ == __name__ or ending is None:  # done before; or files have other names
        return

    def put(store: Any, key: str, value: bytes) -> None:
        if not key or getattr(store, "eviction_enabled", True):
            in_place(store, key, value)
            return
        # Where there is a file already, it could not be read, or another process has compiled the same.
        with atomic_write(Path(str(store.path)) / f"{key}{ending}") as temporary:
            temporary.write_bytes(value)

    kind.put = put


def cache_folder() -> Path:
    """The folder of :data:`VARIABLE`, or the user's own as the system has it."""
    if given := os.environ.get(VARIABLE):
        return Path(given)
    home = Path(os.path.expanduser("~"))
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "jaxdn" / "cache"
    if sys.platform == "darwin":
        return home / "Library" / "Caches" / "jaxdn"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache") / "jaxdn"


def _describe_cpu() -> str:
    """What differs between CPUs that run different code: name and instructions, shortened."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    told = {line.split(":")[0].strip(): line for line in reversed(lines) if ":" in line}  # of the first core
    parts = [told.get(name, "") for name in ("model name", "flags", "Features", "CPU part")]
    return hashlib.sha256("\n".join([platform.machine(), platform.processor(), *parts]).encode()).hexdigest()[:16]
