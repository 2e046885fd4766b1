"""The packages that not everybody needs, and how to install them. jaxdn itself is on no package index."""

from typing import NamedTuple


class Extra(NamedTuple):
    """One extra of pyproject.toml."""

    packages: tuple[str, ...]
    """What pip installs."""
    modules: tuple[str, ...]
    """The top-level modules that these packages bring."""


EXTRAS: dict[str, Extra] = {
    "render": Extra(("mitsuba",), ("mitsuba", "drjit")),
    "train": Extra(("optax", "orbax-checkpoint", "grain", "matplotlib"), ("optax", "orbax", "grain", "matplotlib")),
    "onnx": Extra(("onnxruntime", "onnx"), ("onnxruntime", "onnx")),
    "onednn": Extra(("onednn-cpu-gomp",), ()),
    "bench": Extra(("torch", "pyoidn"), ("torch", "pyoidn")),
}


def install(extra: str) -> str:
    """The command that installs the packages of an extra."""
    return f"pip install {' '.join(EXTRAS[extra].packages)}"


def extra_of(module: str) -> str | None:
    """The extra that brings a top-level module; None if none does."""
    return next((name for name, extra in EXTRAS.items() if module in extra.modules), None)
