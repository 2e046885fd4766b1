"""Media, and those that only absorb light, such as coloured glass: Beer's law along every segment of a path.

Between two surfaces the transmittance of a homogeneous medium is ``exp(-sigma_t d)``, with its extinction ``sigma_t``
for red, green and blue and the distance ``d``. Media that scatter light (fog, smoke) have a tracer of their own
(:mod:`jaxdn.render.tracing.volume_path_tracer`).
"""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np


def list_media(scene: Any) -> list[tuple[str, Any]]:
    """The media of a loaded scene: those inside and around shapes, with the shape's name, and that of ``"camera"``."""
    sides: list[tuple[str, tuple[Any, ...]]] = [
        (shape.id(), (shape.interior_medium(), shape.exterior_medium())) for shape in scene.shapes()
    ]
    sides.append(("camera", (scene.sensors()[0].get_medium(),)))
    return [(name, medium) for name, media in sides for medium in media if medium is not None]


def absorbs(medium: Any) -> bool:
    """Whether a medium is homogeneous and scatters nothing."""
    albedo = [value for key, value in mi.traverse(medium) if key.startswith("albedo")]
    return bool(medium.is_homogeneous()) and bool(albedo) and not any(np.any(np.array(value)) for value in albedo)


def compute_transmittance(medium: Any, distance: Any, active: Any) -> Any:
    """The share of light that is left after a distance in a medium, for arrays of media; no medium leaves all."""
    point = dr.zeros(mi.MediumInteraction3f, dr.width(distance))
    extinction = medium.get_scattering_coefficients(point, active)[2]
    # A ray that meets nothing has an infinite length: no extinction times that is not a number.
    return dr.exp(-mi.Spectrum(extinction) * dr.minimum(distance, dr.largest(mi.Float)))


def find_medium_behind(hit: Any, medium: Any, direction: Any) -> Any:
    """The medium of rays that leave a surface, for arrays of hits; ``medium`` is the one in front of it."""
    return dr.select(hit.is_medium_transition(), hit.target_medium(direction), medium)
