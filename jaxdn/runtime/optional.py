"""The packages that not everybody needs, and how to install them. jaxdn itself is on no package index."""

from importlib import metadata
from typing import NamedTuple


class DependencyGroup(NamedTuple):
    """One extra of pyproject.toml."""

    packages: tuple[str, ...]
    """What pip installs."""
    modules: tuple[str, ...]
    """The top-level modules that these packages bring."""


OPTIONAL_DEPENDENCIES: dict[str, DependencyGroup] = {
    "render": DependencyGroup(("mitsuba",), ("mitsuba", "drjit")),
    "train": DependencyGroup(
        ("optax", "orbax-checkpoint", "grain", "matplotlib"), ("optax", "orbax", "grain", "matplotlib")
    ),
    "onnx": DependencyGroup(("onnxruntime", "onnx"), ("onnxruntime", "onnx")),
    "onednn": DependencyGroup(("onednn-cpu-gomp",), ()),
    "oidn": DependencyGroup(("pyoidn",), ("pyoidn",)),
    "farm": DependencyGroup(("distributed",), ("distributed", "dask")),
    "bench": DependencyGroup(("torch",), ("torch",)),
}


def install(extra: str) -> str:
    """The command that installs the packages of an extra."""
    return f"pip install {' '.join(OPTIONAL_DEPENDENCIES[extra].packages)}"


def find_group(module: str) -> str | None:
    """The extra that brings a top-level module; None if none does."""
    return next((name for name, extra in OPTIONAL_DEPENDENCIES.items() if module in extra.modules), None)


def find_version(package: str) -> str:
    """The version of a package that is there; "unknown" of one that was built here, and not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
