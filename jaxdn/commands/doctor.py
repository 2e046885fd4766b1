"""``jaxdn doctor``: what this machine computes, denoises, trains and renders with, and what to install for more."""

import os
import platform
from collections.abc import Iterator
from importlib.util import find_spec
from typing import NamedTuple

import jax
from rich.table import Table

import jaxdn
import jaxdn.networks.recurrent  # declares operations
from jaxdn.methods.registry import methods
from jaxdn.networks.backends import BACKENDS
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import OPERATIONS, REFERENCE, VARIABLE, default_implementation
from jaxdn.ops.onednn import library
from jaxdn.render.mitsuba.variant import choose_variant, has_cuda
from jaxdn.runtime.optional import OPTIONAL_DEPENDENCIES, find_version, install
from jaxdn.runtime.terminal import plain_console

_EXTRA_OF = {"onednn-bfloat16": "onednn", "onednn-float32": "onednn", "onnxruntime": "onnx", "onednn": "onednn"}
"""Backend -> the extra that brings it."""


class Diagnosis(NamedTuple):
    """One thing that was looked at."""

    what: str
    found: str
    advice: str = ""
    """What to do for more; empty where nothing is missing."""


def doctor() -> list[Diagnosis]:
    """Print the findings as a table, and return them."""
    found = list(_findings())
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for column in ("what", "found", "advice"):
        table.add_column(column, overflow="fold")
    for finding in found:
        table.add_row(*finding, style="yellow" if finding.advice else None)
    plain_console().print(table)
    return found


def _findings() -> Iterator[Diagnosis]:
    yield Diagnosis("jaxdn", f"{jaxdn.__version__}, Python {platform.python_version()}, {os.cpu_count()} cores")
    yield _device()
    for backend in BACKENDS.values():
        if backend.available() and backend.faster():
            yield Diagnosis(f"backend for {backend.purpose}", backend.name)
        elif backend.available():
            yield Diagnosis(f"backend for {backend.purpose}", f"XLA: {backend.name} is slower on this CPU")
        elif backend.name == "onednn-bfloat16" and library.available():
            yield Diagnosis(f"backend for {backend.purpose}", "no onednn-bfloat16: this CPU does not compute with it")
        elif jax.default_backend() == "cpu":
            yield Diagnosis(
                f"backend for {backend.purpose}", "XLA alone", f"faster: {install(_EXTRA_OF[backend.name])}"
            )
        else:
            yield Diagnosis(f"backend for {backend.purpose}", "XLA, as on every GPU")
    yield from _operations()
    yield _packages("training", "train")
    yield _packages("Open Image Denoise", "oidn")
    yield _renderer()


def _device() -> Diagnosis:
    """What jax computes on."""
    backend = jax.default_backend()
    names = ", ".join(dict.fromkeys(device.device_kind for device in jax.devices()))
    found = f"jax {jax.__version__} on {backend} ({names})"
    if backend == "cpu" and has_cuda():
        return Diagnosis("device", found, "an NVIDIA GPU is there too: pip install 'jax[cuda13]' or 'jax[cuda12]'")
    return Diagnosis("device", found)


def _operations() -> Iterator[Diagnosis]:
    """The implementation that each operation of the methods has here, and what would be faster."""
    methods()  # imports the modules that declare them, but for the networks
    chosen: dict[str, list[str]] = {}
    for name, operation in sorted(OPERATIONS.items()):
        fastest, differentiable = (one.name for one in operation.automatic())
        label = fastest if fastest == differentiable else f"{fastest}, gradients by {differentiable}"
        chosen.setdefault(label, []).append(name)
    for label, names in chosen.items():
        yield Diagnosis(f"operations: {label}", ", ".join(names))
    if default_implementation() == REFERENCE:
        yield Diagnosis(VARIABLE, REFERENCE, "filters are twice as fast without it")
    elif jax.default_backend() == "cpu" and (reason := numba_call.unavailable()):
        yield Diagnosis("filters", "XLA alone", f"twice as fast; numba {reason}")


def _packages(what: str, extra: str) -> Diagnosis:
    missing = [module for module in OPTIONAL_DEPENDENCIES[extra].modules if find_spec(module) is None]
    if missing:
        return Diagnosis(what, f"without {', '.join(missing)}", f"to use it: {install(extra)}")
    return Diagnosis(what, ", ".join(f"{name} {find_version(name)}" for name in OPTIONAL_DEPENDENCIES[extra].packages))


def _renderer() -> Diagnosis:
    """Mitsuba, its variant, and the LLVM library that it needs."""
    if find_spec("mitsuba") is None:
        return _packages("rendering", "render")
    choice = choose_variant()
    found = f"mitsuba {find_version('mitsuba')}, {choice.variant}"
    reason, _, advice = choice.reason.partition(". ")
    return Diagnosis("rendering", f"{found}: {reason}", advice)
