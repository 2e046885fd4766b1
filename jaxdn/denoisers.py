"""The factories of all methods, by name: ``jaxdn.denoisers.ntd(size="small")`` returns a :class:`jaxdn.Denoiser`.

The factories come from the table of methods (:mod:`jaxdn.methods.registry`); ``NAMES`` lists them. ``demodulated``
and ``stabilised`` wrap any denoiser. The methods are implemented in :mod:`jaxdn.methods`, one file each.
"""

from typing import TYPE_CHECKING, Any

from jaxdn.methods.demodulation import demodulated as demodulated
from jaxdn.methods.registry import methods
from jaxdn.methods.stabilised import stabilised as stabilised

if TYPE_CHECKING:  # what type checkers and editors see; tests/test_house.py compares it with the table of methods
    from jaxdn.methods.arae import arae as arae
    from jaxdn.methods.asvgf import asvgf as asvgf
    from jaxdn.methods.combiner.method import combiner as combiner
    from jaxdn.methods.dasr import dasr as dasr
    from jaxdn.methods.ntasd import ntasd as ntasd
    from jaxdn.methods.ntd import ntd as ntd
    from jaxdn.methods.oidn import oidn as oidn
    from jaxdn.methods.rae import rae as rae
    from jaxdn.methods.steady.method import steady as steady
    from jaxdn.methods.svgf import svgf as svgf
    from jaxdn.methods.taa import taa as taa
    from jaxdn.methods.trmv import trmv as trmv
    from jaxdn.methods.two_lobes.reblur import reblur as reblur
    from jaxdn.methods.two_lobes.relax import relax as relax


def __getattr__(name: str) -> Any:
    known = methods()
    if name == "NAMES":
        return tuple(known)
    if name in known:
        return known[name].factory
    raise AttributeError(
        f"module 'jaxdn.denoisers' has no attribute {name!r}; it has {', '.join(known)}, demodulated, stabilised"
    )


def __dir__() -> list[str]:
    return [*methods(), "demodulated", "stabilised", "NAMES"]
