"""The factories of all methods, by name: ``jaxdn.denoisers.ntd(size="small")`` returns a :class:`jaxdn.Denoiser`.

What there is comes from the table (:mod:`jaxdn.methods.table`); :data:`NAMES` lists it. ``demodulated`` wraps any
denoiser. The methods themselves live in :mod:`jaxdn.methods`, a file each.
"""

from typing import Any

from jaxdn.methods.demodulated import demodulated as demodulated
from jaxdn.methods.table import methods


def __getattr__(name: str) -> Any:
    known = methods()
    if name == "NAMES":
        return tuple(known)
    if name in known:
        return known[name].factory
    raise AttributeError(f"module 'jaxdn.denoisers' has no attribute {name!r}; it has {', '.join(known)}, demodulated")


def __dir__() -> list[str]:
    return [*methods(), "demodulated", "NAMES"]
