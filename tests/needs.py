"""What tests need besides Python and the package's dependencies, and what happens where it is missing.

:func:`require` skips a test where something is missing, which the summary of pytest lists with its reason. In CI (the
variable ``CI`` is ``true``) it fails instead: a test that does not run there is not noticed for months. It is skipped
in CI too if :data:`NEEDS` says why CI cannot have what it needs, or if the machine could not install it: the variable
``JAXDN_TESTS_WITHOUT`` has its name (``llvm,browser``). The marker ``needs`` calls it for a test or a module.
"""

import importlib
import importlib.util
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge")
"""Programs on the path that Playwright can drive."""
WITH_BPY = Path(__file__).parents[1] / ".venv-cycles" / "bin" / "python"
"""An interpreter of its own: ``bpy`` runs on one version of Python alone."""
LLVM_15 = Path("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1")


class Need(NamedTuple):
    """Something that a test needs."""

    present: Callable[[], bool]
    install: str
    """How to get it."""
    not_in_ci: str = ""
    """Why CI has none; empty: a test that misses it fails there."""


def _package(name: str) -> Callable[[], bool]:
    return lambda: importlib.util.find_spec(name) is not None


def _fast_variant() -> bool:
    if not _package("mitsuba")():
        return False
    from jaxdn.render.mitsuba.variant import choose_variant

    return not choose_variant().variant.startswith("scalar")


def _numba() -> bool:
    from jaxdn.ops.dispatch import numba_call

    return not numba_call.unavailable()


def _onednn() -> bool:
    from jaxdn.ops.onednn import library

    return library.available()


def _bfloat16() -> bool:
    from jaxdn.networks import onednn
    from jaxdn.networks.backends import BACKENDS

    return BACKENDS[onednn.BFLOAT16.backend].available()


def _peak_memory() -> bool:
    from experiments.speed.timing import peak_mib

    return peak_mib(lambda: None) is not None


def _runs(*command: str, given: str = "") -> bool:
    if shutil.which(command[0]) is None:
        return False
    return subprocess.run(command, input=given, capture_output=True, text=True, check=False).returncode == 0


NEEDS = {
    "mitsuba": Need(_package("mitsuba"), "pip install -e '.[render]'"),
    "llvm": Need(_fast_variant, "apt-get install libllvm19 (Mitsuba's vectorised variant; 17 or newer)"),
    "skimage": Need(_package("skimage"), "pip install -e '.[peers]'"),
    "flip_evaluator": Need(_package("flip_evaluator"), "pip install -e '.[peers]'"),
    "onnx": Need(_package("onnx"), "pip install -e '.[onnx]'"),
    "onnxruntime": Need(_package("onnxruntime"), "pip install -e '.[onnx]'"),
    "numpy": Need(_package("numpy"), "pip install -e ."),
    "numba": Need(_numba, "pip install numba, and let jax compute on the CPU"),
    "onednn": Need(_onednn, "pip install -e '.[onednn]'"),
    "bfloat16": Need(_bfloat16, "a CPU with AVX512-BF16 or AMX", "the CPU is whatever the job is given"),
    "peak memory": Need(_peak_memory, "a system that reports the peak of resident memory, such as Linux"),
    "playwright": Need(_package("playwright"), "pip install --group dev"),
    "browser": Need(lambda: any(map(shutil.which, BROWSERS)), "apt-get install chromium"),
    "torch": Need(_package("torch"), "pip install -c constraints.txt torch (a CPU build)"),
    "pyoidn": Need(_package("pyoidn"), "pip install -e '.[oidn]'"),
    "distributed": Need(_package("distributed"), "pip install -e '.[farm]'"),
    "openjd": Need(_package("openjd"), "pip install --group dev"),
    "yaml": Need(_package("yaml"), "pip install --group dev (openjd-cli brings it)"),
    "bash": Need(lambda: shutil.which("bash") is not None, "a Unix system"),
    "node": Need(lambda: shutil.which("node") is not None, "apt-get install nodejs"),
    "g++": Need(lambda: shutil.which("g++") is not None, "apt-get install g++ pkg-config"),
    "headers of OpenEXR": Need(lambda: _runs("pkg-config", "--exists", "OpenEXR"), "apt-get install libopenexr-dev"),
    "headers of ONNX Runtime": Need(
        lambda: _runs("g++", "-E", "-xc++", "-", given="#include <onnxruntime_cxx_api.h>\n"),
        "the archive of an ONNX Runtime release; set CPATH to its folder include",
        "no package of pip or of Debian 12 has them",
    ),
    "bpy": Need(lambda: _runs(str(WITH_BPY), "-c", "import bpy, OpenEXR"), "make .venv-cycles/ready"),
    "fcntl": Need(_package("fcntl"), "a Unix system"),
    "uv with an index": Need(
        lambda: _runs("uv", "pip", "compile", "--quiet", "--no-deps", "-", given="tyro\n"),
        "pip install uv, and a network",
        "whether its machines reach an index of packages is not ours to say",
    ),
    "LLVM 15": Need(LLVM_15.exists, "apt-get install libllvm15", "it aborts the processes that find it"),
}
"""Name -> how a test finds out whether it is there."""


def _has_to_be_there(name: str) -> bool:
    without = [each.strip() for each in os.environ.get("JAXDN_TESTS_WITHOUT", "").split(",")]
    return os.environ.get("CI", "").lower() in ("true", "1") and not NEEDS[name].not_in_ci and name not in without


def require(*names: str) -> None:
    """Skip this test, or this module while it is imported, where one of :data:`NEEDS` is missing; in CI fail."""
    for name in names:
        need = NEEDS[name]
        if need.present():
            continue
        if _has_to_be_there(name):
            pytest.fail(f"CI has no {name}, which it can install: {need.install}", pytrace=False)
        pytest.skip(f"no {name}: {need.install}", allow_module_level=True)


def require_module(name: str) -> ModuleType:
    """The package ``name`` of :data:`NEEDS`, imported; :func:`require` where it is missing."""
    require(name.partition(".")[0])
    return importlib.import_module(name)
