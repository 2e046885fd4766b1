"""What path tracers give: sums of samples by kind of light, and what else they are asked for."""

from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.tracing.light_samples import Shadows, make_zero_shadows
from jaxdn.render.tracing.lobes import Lobes, make_zero_lobes
from jaxdn.render.tracing.pixel_filters import PixelFilter
from jaxdn.render.tracing.surfaces import SurfaceRequest, SurfaceSums, make_zero_surfaces

BRIGHTEST = 1e30
"""Samples at least this bright are treated as overflows, as the sum of a few would overflow."""


class RadianceSums(NamedTuple):
    """Sums over samples of the three parts of radiance, each [H, W, 3] float64."""

    emitted: np.ndarray
    direct: np.ndarray
    indirect: np.ndarray
    bad: int
    """Number of samples that were not finite (or beyond ``BRIGHTEST``); they count as black."""
    lobes: Lobes | None = None
    """The same samples by the lobe of their first reflection; None if it was not requested."""
    shadows: Shadows | None = None
    """Their light straight from lights, with and without its shadows; None if it was not requested."""
    surfaces: SurfaceSums | None = None
    """The guides of the same samples; None if they were not requested."""

    def plus(self, other: "RadianceSums") -> "RadianceSums":
        """The sums over both sets of samples."""
        return RadianceSums(
            self.emitted + other.emitted,
            self.direct + other.direct,
            self.indirect + other.indirect,
            self.bad + other.bad,
            None if self.lobes is None or other.lobes is None else self.lobes.plus(other.lobes),
            None if self.shadows is None or other.shadows is None else self.shadows.plus(other.shadows),
            None if self.surfaces is None or other.surfaces is None else self.surfaces.plus(other.surfaces),
        )


class TraceRequest(NamedTuple):
    """Where samples lie in their pixels, and what else than their light is to be told of them."""

    lobes: bool = False
    """Diffuse and specular samples apart (``RadianceSums.lobes``)."""
    shadows: bool = False
    """Light with and without shadows (``RadianceSums.shadows``)."""
    direct: bool = False
    """The lobes' light is all that is reflected, not the indirect light alone."""
    pixel_filter: PixelFilter = "centre"
    """Where the samples lie."""
    surfaces: SurfaceRequest | None = None
    """Guides (``RadianceSums.surfaces``)."""


class ReplayedPaths(NamedTuple):
    """Paths that were traced with the random numbers of others."""

    light: np.ndarray
    """[n, 3] float64 radiance, indirect or all that is reflected; 0 where it was not finite."""
    position: np.ndarray
    """[n, 3] float64 what the camera ray hit; NaN where it hit nothing."""


NOTHING_ELSE = TraceRequest()


def make_zero_radiance(shape: tuple[int, ...], request: TraceRequest = NOTHING_ELSE) -> RadianceSums:
    """The sums over no samples."""
    emitted, direct, indirect = np.zeros((3, *shape, 3))
    lobes = make_zero_lobes(shape) if request.lobes else None
    shadows = make_zero_shadows(shape) if request.shadows else None
    surfaces = None if request.surfaces is None else make_zero_surfaces(shape, request.surfaces)
    return RadianceSums(emitted, direct, indirect, 0, lobes, shadows, surfaces)


def get_film_size(scene: Any) -> tuple[int, int]:
    """(height, width) of the film of a scene's first sensor, in pixels."""
    width, height = (int(size) for size in scene.sensors()[0].film().crop_size())
    return height, width
