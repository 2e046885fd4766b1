"""``steady`` with fewer levels, for tests in double precision, which has no compiled loops.

Each level is the same filter with taps farther apart: with one at full resolution and one at half, in place of two and
four, everything that is done to light is done, by less than half of the program.
"""

import pytest

from jaxdn.denoiser import Denoiser
from jaxdn.methods.steady import levels, method

TINY = ((4,), (4,), (4,), (4,), (4,))


def short_steady(monkeypatch: pytest.MonkeyPatch) -> Denoiser:
    """A small one, whose levels are few while the test runs."""
    for module in (levels, method):
        monkeypatch.setattr(module, "LEVELS", 1)
    monkeypatch.setitem(method.QUALITIES, "balanced", method.Quality(TINY, full_levels=1))
    return method.steady(quality="balanced")
