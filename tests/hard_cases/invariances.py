"""How far the learned networks deviate from invariances of filters (:mod:`experiments.stability.invariances`)."""

from collections.abc import Iterator
from typing import NamedTuple

from experiments.stability.invariances import measure_deviations as measure
from jaxdn.zoo.ready import filter_names, find_model
from jaxdn.zoo.weights import shipped_names
from tests.hard_cases.inputs import good

FRAMES, HEIGHT, WIDTH = 8, 64, 96
"""Multiples of 16: padding at one side is not tested here."""


class Deviation(NamedTuple):
    """How far a method is from changing its output as its input was changed."""

    change: str
    method: str
    difference: float
    """RMS of the difference, both tone-mapped, over the RMS of the image."""
    error: float
    """RMS of (denoised clip - reference) over the same, to compare the difference with."""


def measure_deviations() -> Iterator[Deviation]:
    """Every invariance for every network that has shipped weights, and for the filters to compare with."""
    clip = good(frames=FRAMES, height=HEIGHT, width=WIDTH).clip
    for name in (*shipped_names(), *filter_names()):
        one = find_model(name)
        assert one.denoiser is not None
        found = measure(one.denoiser, one.params, clip)
        error = found.pop("error")
        yield from (Deviation(change, name, difference, error) for change, difference in found.items())
