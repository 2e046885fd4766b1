"""What makes a camera's first hits random: a lens of finite size, a shutter that stays open, and fog.

In an animation file (:mod:`jaxdn.render.scenes.animation`) and in the record of a family's scene these are entries of
the top level:

    {"lens": {"aperture_radius": 0.05, "focus_distance": 2.5}, "shutter": 0.5,
     "fog": {"density": 0.1, "albedo": [0.9, 0.9, 0.95]}}

Lengths are in scene units. The shutter's time is a share of the time between two frames, and the frame's own time is
in its middle. Fog fills the scene around the camera: it takes away ``1 - exp(-density d)`` of the light over a distance
``d``, scatters the share ``albedo`` of that, evenly to all sides, and absorbs the rest.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.scenes.scene import Camera


class Lens(NamedTuple):
    """A thin lens."""

    aperture_radius: float
    focus_distance: float
    """Along the optical axis, up to the plane that is sharp."""

    def fit(self, camera: Camera) -> Camera:
        """A camera with this lens."""
        return camera._replace(aperture_radius=self.aperture_radius, focus_distance=self.focus_distance)


class Fog(NamedTuple):
    """A homogeneous medium around the camera."""

    density: float
    """Extinction per unit of length."""
    albedo: tuple[float, float, float]
    """Share of the extinction that is scattering, for red, green and blue."""


class SceneOptics(NamedTuple):
    """The lens, the shutter and the fog of a scene; none of them by default."""

    lens: Lens | None = None
    shutter: float = 0.0
    """Time for which it is open, in frames."""
    fog: Fog | None = None

    def record(self) -> dict[str, Any]:
        """The entries that :func:`read_optics` reads."""
        entries: dict[str, Any] = {}
        if self.lens is not None:
            entries["lens"] = self.lens._asdict()
        if self.shutter:
            entries["shutter"] = self.shutter
        if self.fog is not None:
            entries["fog"] = {"density": self.fog.density, "albedo": list(self.fog.albedo)}
        return entries

    def focus(self, camera: Camera) -> Camera:
        """A camera with the lens."""
        return camera if self.lens is None else self.lens.fit(camera)


ENTRIES = SceneOptics._fields


def read_optics(entries: Mapping[str, Any], where: str) -> SceneOptics:
    """The optics of an animation or a record, which has other entries besides; ``where`` names it in errors.

    Raises ValueError for values that are out of range or no numbers.
    """
    lens, fog, shutter = entries.get("lens"), entries.get("fog"), entries.get("shutter", 0.0)
    if not _is_number(shutter) or not 0 <= shutter <= 1:
        raise ValueError(f"{where} shutter: expected a share of a frame's time from 0 to 1, got {shutter!r}.")
    return SceneOptics(
        None if lens is None else _read_lens(lens, f"{where} lens"),
        float(shutter),
        None if fog is None else _read_fog(fog, f"{where} fog"),
    )


def _read_lens(lens: Any, where: str) -> Lens:
    if not isinstance(lens, Mapping) or set(lens) != set(Lens._fields):
        raise ValueError(f"{where}: expected the entries {', '.join(Lens._fields)}, got {lens!r}.")
    for name in Lens._fields:
        if not _is_number(lens[name]) or not lens[name] > 0:
            raise ValueError(f"{where} {name}: expected a length above 0, got {lens[name]!r}.")
    return Lens(*(float(lens[name]) for name in Lens._fields))


def _read_fog(fog: Any, where: str) -> Fog:
    if not isinstance(fog, Mapping) or set(fog) != set(Fog._fields):
        raise ValueError(f"{where}: expected the entries {', '.join(Fog._fields)}, got {fog!r}.")
    if not _is_number(fog["density"]) or not fog["density"] > 0:
        raise ValueError(f"{where} density: expected a number above 0, got {fog['density']!r}.")
    albedo = fog["albedo"]
    numbers = isinstance(albedo, list | tuple) and len(albedo) == 3 and all(map(_is_number, albedo))
    if not numbers or not all(0 <= share <= 1 for share in albedo):
        raise ValueError(f"{where} albedo: expected three numbers from 0 to 1, got {albedo!r}.")
    return Fog(float(fog["density"]), (float(albedo[0]), float(albedo[1]), float(albedo[2])))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def describe_optics(camera: Camera, fog: Fog | None = None) -> dict[str, Any]:
    """The entries of a sensor's dictionary for Mitsuba that follow from its camera's lens, and from fog around it."""
    entries: dict[str, Any] = {"type": "perspective"}
    if camera.aperture_radius > 0:
        sizes = {"aperture_radius": float(camera.aperture_radius), "focus_distance": float(camera.focus_distance)}
        entries = {"type": "thinlens", **sizes}
    if fog is not None:
        scattered = {"type": "rgb", "value": list(fog.albedo)}
        entries["medium"] = {"type": "homogeneous", "albedo": scattered, "sigma_t": fog.density}
    return entries


def get_shutter(scene: Any) -> float:
    """The time for which the shutter of an animated scene is open, in frames; 0 for scenes that have none."""
    return float(getattr(scene, "shutter", 0.0))
