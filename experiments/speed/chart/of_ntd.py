"""Entries that only ``ntd`` has: networks of widths without trained weights."""

from collections.abc import Iterator

from experiments.speed.chart.way import Way, way
from experiments.speed.works import steps
from jaxdn.networks import Widths
from jaxdn.zoo import ready

UNTRAINED: dict[str, Widths] = {
    "ntd medium": ((24, 24), (48, 48), (48, 48), (64, 64), (80, 80)),
    "ntd tiny": ((8,), (16, 16), (24, 24), (32, 32), (32, 32)),
}
"""Widths without trained weights: their time can be measured, their quality cannot."""


def untrained() -> Iterator[Way]:
    """Networks of other widths with random weights: only time."""
    for name, widths in UNTRAINED.items():
        made = way(ready.untrained_model(steps.METHOD, size=widths), scored=False)
        family = "untrained widths"
        yield made._replace(name=name, family=family, variant="untrained", group=family)
