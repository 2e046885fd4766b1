"""Every denoiser is a factory that returns a :class:`jaxdn.Denoiser`; one system, one file, loaded when it is named.

``svgf`` needs jax alone; those in ``LEARNED`` bring their networks, and with them flax.
"""

import importlib
import sys
import types
from typing import Any

NAMES: tuple[str, ...] = ("ntd", "svgf")
"""The factories; each lives in the module of the same name."""

LEARNED: tuple[str, ...] = ("ntd",)
"""Those of them that have weights."""

__all__ = [*NAMES, "LEARNED", "NAMES"]


class _Room(types.ModuleType):
    """Keeps a factory under its name when its module is imported: Python would bind the module there instead."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in NAMES and isinstance(value, types.ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Room


def __getattr__(name: str) -> Any:
    if name in NAMES:
        return getattr(importlib.import_module(f"{__name__}.{name}"), name)
    raise AttributeError(f"module 'jaxdn.denoisers' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return sorted(__all__)
