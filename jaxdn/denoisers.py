"""The factories of all methods, by name: ``jaxdn.denoisers.ntd(size="small")`` returns a :class:`jaxdn.Denoiser`.

The factories come from the table of methods (:mod:`jaxdn.methods.registry`); :data:`NAMES` lists them. ``demodulated``
wraps any denoiser. The methods are implemented in :mod:`jaxdn.methods`, one file each.
"""

from typing import Any

from jaxdn.methods.demodulation import demodulated as demodulated
from jaxdn.methods.registry import methods


def __getattr__(name: str) -> Any:
    known = methods()
    if name == "NAMES":
        return tuple(known)
    if name in known:
        return known[name].factory
    raise AttributeError(f"module 'jaxdn.denoisers' has no attribute {name!r}; it has {', '.join(known)}, demodulated")


def __dir__() -> list[str]:
    return [*methods(), "demodulated", "NAMES"]
