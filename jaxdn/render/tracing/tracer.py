"""The choice of a path tracer: each variant of Mitsuba has one of two."""

from collections.abc import Callable
from typing import NamedTuple

from jaxdn.render.tracing import scalar_path_tracer, vectorised_path_tracer
from jaxdn.render.tracing.radiance import RadianceSums, ReplayedPaths


class Tracer(NamedTuple):
    """How a variant traces paths; the functions are described in :mod:`.vectorised_path_tracer`."""

    accumulate: Callable[..., RadianceSums]
    accumulate_sets: Callable[..., list[RadianceSums]]
    accumulate_samples: Callable[..., RadianceSums]
    replay: Callable[..., ReplayedPaths]
    jittered: bool
    """It distributes its samples over the pixel."""


def choose_tracer(variant: str) -> Tracer:
    """The path tracer for a variant."""
    if variant.startswith("scalar"):
        scalar = scalar_path_tracer
        return Tracer(scalar.accumulate, scalar.accumulate_sets, scalar.accumulate_samples, scalar.replay, True)
    vectorised = vectorised_path_tracer
    accumulate = vectorised.accumulate, vectorised.accumulate_sets, vectorised.accumulate_samples
    return Tracer(*accumulate, vectorised.replay, False)
