"""Entries that only ``ntd`` has: its network in PyTorch, and with widths without trained weights."""

from collections.abc import Iterator

from experiments.speed import peers
from experiments.speed.chart.way import Way, way
from experiments.speed.timing import Call
from experiments.speed.works import steps
from jaxdn import candidates
from jaxdn.denoiser import Params
from jaxdn.frame import Frame
from jaxdn.networks import Widths
from jaxdn.weights import load_weights, shipped_names

UNTRAINED: dict[str, Widths] = {
    "ntd medium": ((24, 24), (48, 48), (48, 48), (64, 64), (80, 80)),
    "ntd tiny": ((8,), (16, 16), (24, 24), (32, 32), (32, 32)),
}
"""Widths without trained weights: their time can be measured, their quality cannot."""


def untrained() -> Iterator[Way]:
    """Networks of other widths with random weights: only time."""
    for name, widths in UNTRAINED.items():
        made = way(candidates.untrained(steps.METHOD, size=widths), scored=False)
        family = "untrained widths"
        yield made._replace(name=name, family=family, variant="untrained", group=family)


def pytorch() -> Iterator[Way]:
    """The network of the shipped weights in PyTorch: the same image, so only time.

    Only at the large size, as PyTorch compiles again for each size.
    """
    missing = peers.missing()
    for weights, options in steps.METHOD.variants.items():
        if weights not in shipped_names():
            continue
        _, params = load_weights(weights)
        for compiled in (False, True):
            if ("torch-compiled" if compiled else "torch") in missing:
                continue

            def timed(
                frame: Frame, size: str = options["size"], params: Params = params, compiled: bool = compiled
            ) -> Call:
                return steps.pytorch(size, params, frame, compiled=compiled)

            variant = "compiled" if compiled else "eager"
            name = f"{weights} in PyTorch, {variant}"
            yield Way(name, "PyTorch", variant, "motion", timed, None, weights, small=False)
