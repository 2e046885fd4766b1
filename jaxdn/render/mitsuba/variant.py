"""Selects Mitsuba's variant for rendering: the fastest that works on this machine.

``llvm_ad_rgb`` is three to seven times faster than ``scalar_rgb`` but needs an LLVM library, and LLVM 15 and 16 pass
drjit's own check and then abort the whole process at the first kernel with a float minimum. Python cannot
catch that, so a candidate is tried in a separate process. The result is kept for this process and, in the environment,
for its children.
"""

import glob
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from typing import Any, NamedTuple

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
OVERRIDE = "JAXDN_VARIANT"
"""Environment variable with the user's choice."""
_LIBRARY = "DRJIT_LIBLLVM_PATH"
_FOUND = "_JAXDN_VARIANT_FOUND"
_OLDEST_LLVM = 17
LEAST_THREADS = 2
"""Of the renderer, in each process. With one, Mitsuba's loader waits for ever for the pictures of some scenes."""

_PROBE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
import drjit as dr
scene = mi.load_dict({'type': 'scene', 'shape': {'type': 'sphere'}})
hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(dr.arange(mi.Float, 4), 0, -5), mi.Vector3f(0, 0, 1)))
small = dr.minimum(dr.max(mi.Color3f(dr.arange(mi.Float, 9))), .95)
assert abs(dr.sum(small)[0] - 7.6) < 1e-4 and hit.is_valid()[0] and not hit.is_valid()[3]
print('WORKS')
"""

_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
    os.path.join(sys.prefix, "lib", "libLLVM*.so*"),
)


class VariantChoice(NamedTuple):
    """A variant that works, the LLVM library it needs ("" for none), and the reason of the choice."""

    variant: str
    llvm: str
    reason: str


_choice: dict[str | None, VariantChoice] = {}


def list_llvm_candidates() -> list[str]:
    """LLVM libraries to try, newest first; only ``DRJIT_LIBLLVM_PATH`` if the user set it."""
    if os.environ.get(_LIBRARY):
        return [os.environ[_LIBRARY]]
    versions: dict[str, int] = {}
    for path in (path for pattern in _PATTERNS for path in glob.glob(pattern)):
        real = os.path.realpath(path)
        match = re.search(r"libLLVM[-.]?(?:so\.|dylib\.)?(\d+)", os.path.basename(real))
        if match and int(match.group(1)) >= _OLDEST_LLVM:
            versions[real] = int(match.group(1))
    return sorted(versions, key=lambda path: -versions[path])


def _works(variant: str, library: str = "") -> bool:
    """Try a variant in a separate process (a quarter of a second; LLVM 15 and 16 die there with SIGABRT)."""
    environment = dict(os.environ)
    if library:
        environment[_LIBRARY] = library
    try:
        probe = subprocess.run(
            [sys.executable, "-c", _PROBE, variant], env=environment, capture_output=True, text=True, timeout=120
        )
    except subprocess.TimeoutExpired:
        return False
    return probe.returncode == 0 and "WORKS" in probe.stdout


def has_cuda() -> bool:
    """Whether an NVIDIA driver is there."""
    return os.path.exists("/dev/nvidiactl") or os.path.exists("/dev/dxg")


def _find(requested: str | None) -> VariantChoice:
    if requested in (None, "cuda_ad_rgb"):
        if (requested or has_cuda()) and _works("cuda_ad_rgb"):
            return VariantChoice("cuda_ad_rgb", "", "a CUDA device with OptiX was found")
        if requested:
            raise ValueError(f"variant: {requested!r} does not run here (it needs an NVIDIA driver with OptiX).")
    if requested in (None, "llvm_ad_rgb"):
        for library in list_llvm_candidates():
            if _works("llvm_ad_rgb", library):
                return VariantChoice("llvm_ad_rgb", library, f"{library} works")
        if requested:
            raise ValueError(f"variant: {requested!r} does not run here. {advice()}")
    return VariantChoice(
        "scalar_rgb", "", f"no LLVM library works here. {advice()}" if not requested else "it was requested"
    )


def separates_lobes(variant: str) -> bool:
    """Whether a variant can tell diffuse from specular samples: the scalar one uses Mitsuba's own integrators."""
    return not variant.startswith("scalar")


def advice() -> str:
    """What to install to render faster."""
    return (
        "To render three to seven times faster install LLVM 17 or newer (Debian/Ubuntu: apt install libllvm19), or "
        f"set {_LIBRARY} to its libLLVM.so; LLVM 16 and older do not work."
    )


def choose_variant(requested: str | None = None) -> VariantChoice:
    """The variant to render with: ``requested``, else ``JAXDN_VARIANT``, else the fastest that works here.

    A probe runs once per process and choice; child processes find its result in their environment. Raises
    ValueError if the requested variant is unknown or does not run here, and ModuleNotFoundError without Mitsuba.
    """
    if importlib.util.find_spec("mitsuba") is None:  # every probe below would fail, which says nothing about LLVM
        raise ModuleNotFoundError("No module named 'mitsuba'", name="mitsuba")
    requested = requested or os.environ.get(OVERRIDE) or None
    if requested is not None:
        _check_name(requested)
    if requested not in _choice:
        entry = f"{_FOUND}_{requested or 'fastest'}".upper()
        inherited = os.environ.get(entry, "").split("|", 2)
        if len(inherited) == 3:
            _choice[requested] = VariantChoice(inherited[0], inherited[1], inherited[2])
        else:
            _choice[requested] = _find(requested)
            os.environ[entry] = "|".join(_choice[requested])
    return _choice[requested]


def pin_variant() -> str:
    """The variant for other machines, which must not choose each its own: ``JAXDN_VARIANT``, which need not run here,
    else that of :func:`choose_variant`. Raises ValueError if it is unknown.
    """
    variant = os.environ.get(OVERRIDE) or choose_variant().variant
    _check_name(variant)
    return variant


def _check_name(variant: str) -> None:
    if variant not in VARIANTS:
        raise ValueError(f"variant: expected one of {', '.join(VARIANTS)}, got {variant!r}.")


def use_variant(requested: str | None = None) -> str:
    """Switch this thread to the variant of :func:`choose_variant` and return its name.

    On one core the process gets :data:`LEAST_THREADS` threads.
    """
    choice = choose_variant(requested)
    if choice.llvm:
        os.environ[_LIBRARY] = choice.llvm
    mitsuba: Any = importlib.import_module("mitsuba")
    if mitsuba.variant() != choice.variant:
        mitsuba.set_variant(choice.variant)
    drjit: Any = importlib.import_module("drjit")
    if drjit.thread_count() < LEAST_THREADS:
        drjit.set_thread_count(LEAST_THREADS)
    return choice.variant
