"""How far the learned networks deviate from laws that filters obey (:mod:`experiments.stability.laws`)."""

from collections.abc import Iterator
from typing import NamedTuple

from experiments.stability.laws import deviations
from jaxdn.zoo.ready import candidate, filters
from jaxdn.zoo.weights import shipped_names
from tests.hard_cases.inputs import good

FRAMES, HEIGHT, WIDTH = 8, 64, 96
"""Multiples of 16: padding at one side is not tested here."""


class Law(NamedTuple):
    """One change of the input, and how far a method is from changing its output equally."""

    law: str
    method: str
    difference: float
    """RMS of the difference, both tone-mapped, over the RMS of the image."""
    error: float
    """RMS of (denoised clip - reference) over the same, to compare the difference with."""


def measured() -> Iterator[Law]:
    """Every law for every network that has shipped weights, and for the filters to compare with."""
    clip = good(frames=FRAMES, height=HEIGHT, width=WIDTH).clip
    for name in (*shipped_names(), *filters()):
        one = candidate(name)
        assert one.denoiser is not None
        found = deviations(one.denoiser, one.params, clip)
        error = found.pop("error")
        yield from (Law(law, name, difference, error) for law, difference in found.items())
