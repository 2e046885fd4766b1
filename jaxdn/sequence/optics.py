"""Motion blur and depth of field, put back after sharp frames are denoised (``jaxdn denoise --reblur``).

What the camera does is stated, or said by the file with OpenEXR's standard attributes: ``expTime`` (s) and
``framesPerSecond``, or ``shutterAngle`` (degrees); ``aperture`` (f-number), ``focus`` (m), and
``pinholeFocalLength``, ``effectiveFocalLength`` or ``nominalFocalLength`` (mm) with ``sensorPhotositePitch`` (um) or
``sensorOverallDimensions`` (mm). The filter is :mod:`jaxdn.filters.camera_blur`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.core.options import Range
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming
from jaxdn.data.foreign.layers import stack_channels
from jaxdn.filters.camera_blur import LONGEST, WIDEST, blur_lens, blur_motion, compute_confusion_radius

_ABOVE_0 = Range(0.0, without_low=True)
_FULL_FRAME = 36.0
_STATE = "--reblur shutter=0.5 for motion blur, --reblur fstop=2.8 lens=50 focus=3.2 for depth of field"


@dataclass(frozen=True)
class Optics:
    """What a camera does; None: as the files say, and what they do not say is not done."""

    shutter: Annotated[float, Range(0.0, 1.0)] | None = None
    """The part of the time between two frames that the shutter is open: 0.5 is 180 degrees."""
    fstop: Annotated[float, _ABOVE_0] | None = None
    """The f-number: the focal length divided by the diameter of the lens."""
    lens: Annotated[float, _ABOVE_0] | None = None
    """The focal length in mm."""
    sensor: Annotated[float, _ABOVE_0] | None = None
    """The width of the sensor in mm; usually 36."""
    focus: Annotated[float, _ABOVE_0] | None = None
    """The distance of what is sharp, in units of the scene's depth."""
    metres: Annotated[float, _ABOVE_0] | None = None
    """How many metres a unit of the scene is; usually 1."""


def read_optics(file: ExrFile, given: Optics, *, wraps: bool = False) -> Optics:
    """What is ``given``, else what the file says; a panorama, by its attribute or as it ``wraps``, has no lens.

    Where only the file speaks of a lens, and says half of what depth of field needs, there is none. Raises ValueError
    where such a half is given, and where nothing is said at all.
    """
    told = _read(file.header, _width(file), given.metres or 1.0)
    if file.is_panorama or wraps:
        told = replace(told, fstop=None)
        if given.fstop is not None:
            raise ValueError(f"{file.path}: --reblur fstop: a panorama has no lens; leave it out.")
    stated = {each.name: value for each in fields(given) if (value := getattr(given, each.name)) is not None}
    optics = replace(told, **stated)
    missing = [name for name in ("lens", "focus") if getattr(optics, name) is None]
    if optics.fstop is not None and missing:
        if stated.keys() & {"fstop", "lens", "focus"}:
            raise ValueError(
                f"{file.path}: --reblur fstop={optics.fstop:g}: expected {' and '.join(missing)} too: {_STATE}."
            )
        optics = replace(optics, fstop=None)
    if optics.fstop is None and optics.shutter is None:
        raise ValueError(
            f"{file.path}: --reblur: expected a shutter, or a lens with its focus, and the file names none: {_STATE}."
        )
    return optics


def _read(header: Mapping[str, Any], width: int, metres: float) -> Optics:
    """What a header says, of a picture of so many pixels in a row."""
    exposure, rate, angle = (_number(header, name) for name in ("expTime", "framesPerSecond", "shutterAngle"))
    shutter = exposure * rate if exposure and rate else angle / 360 if angle else None
    lengths = [_number(header, f"{kind}FocalLength") for kind in ("pinhole", "effective", "nominal")]
    pitch, size = _number(header, "sensorPhotositePitch"), header.get("sensorOverallDimensions")
    sensor = pitch * width / 1000 if pitch else None if size is None else float(size[0]) or None
    focus = _number(header, "focus")
    return Optics(
        shutter=None if shutter is None else min(shutter, 1.0),
        fstop=_number(header, "aperture"),
        lens=next((length for length in lengths if length), None),
        sensor=sensor,
        focus=None if focus is None else focus / metres,
    )


def _number(header: Mapping[str, Any], name: str) -> float | None:
    value = header.get(name)
    return float(value) if isinstance(value, int | float | Fraction) and 0 < value < float("inf") else None


class CameraBlur:
    """Blurs the images of consecutive frames."""

    def __init__(
        self, given: Optics, log: Callable[[str], None], naming: ChannelNaming = UNNAMED, *, wraps: bool = False
    ) -> None:
        """``log`` is called with what is done to the first frame, and where something is cut or not done.

        ``naming`` says how the files' vectors are found, ``wraps`` that they are panoramas.
        """
        self._given, self._log, self._naming, self._wraps = given, log, naming, wraps
        self._told: set[str] = set()

    def blur(self, file: ExrFile, frame: Frame, images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Images [H, W, C] by any names, as the camera of the file's frame would have taken them.

        Depth of field comes first, then motion blur. Raises ValueError where buffers are missing, and as
        :func:`read_optics` does.
        """
        optics = read_optics(file, self._given, wraps=self._wraps)
        if frame.depth is not None:
            depth = np.asarray(frame.depth, np.float32)
        elif optics.fstop is None:
            depth = np.ones((*frame.radiance.shape[:2], 1), np.float32)
            self._tell("no depth", "--reblur: there is no depth, so where things cross, the faster one is in front")
        else:
            raise ValueError(f"{file.path}: --reblur fstop: expected depth; name it, --channels depth=LAYER.")
        stacked = np.concatenate(list(images.values()), axis=-1).astype(np.float32)
        if optics.fstop is not None:
            radius = _find_radius(optics, file, depth)
            self._tell_size("lens", f"f/{optics.fstop:g}", 2 * float(radius.max()), 2 * WIDEST)
            stacked = np.asarray(blur_lens(stacked, radius, depth))
        if optics.shutter is not None and (motion := self._read_motion(file, frame)) is not None:
            longest = optics.shutter * float(np.max(np.linalg.norm(motion, axis=-1)))
            self._tell_size("shutter", f"shutter {optics.shutter:g}", longest, LONGEST)
            stacked = np.asarray(blur_motion(stacked, motion, depth, optics.shutter))
        ends = np.cumsum([image.shape[-1] for image in images.values()])
        return dict(zip(images, np.split(stacked, ends[:-1], axis=-1), strict=True))

    def _read_motion(self, file: ExrFile, frame: Frame) -> np.ndarray | None:
        """Vectors [H, W, 2], 0 where they are not known; None where all are 0, as while everything stands still.

        Vectors that were 0 in all frames so far are left out of the frame, so the file is asked. Raises ValueError
        where it has none.
        """
        if frame.motion is not None:
            return np.where(np.isfinite(frame.motion), frame.motion, 0).astype(np.float32)
        channels = self._naming.detect(list(file.windows)).get("motion")
        if channels is None or np.any(np.nan_to_num(stack_channels(file.pixels, channels))):
            raise ValueError(
                f"{file.path}: --reblur shutter: expected motion vectors; render them (Blender: with motion blur off), "
                "or name them, --channels motion=LAYER."
            )
        self._tell("still", f"--reblur: {file.path.name}: all vectors are 0, so nothing is blurred by the shutter")
        return None

    def _tell_size(self, what: str, setting: str, size: float, most: float) -> None:
        spread = f"what is sharp spreads over up to {size:.0f} pixels in the first frame that is blurred"
        self._tell(what, f"--reblur: {setting}: {spread}")
        if size > most:
            self._tell(f"{what} cut", f"--reblur: {setting}: {size:.0f} pixels are cut to {most:.0f}")

    def _tell(self, what: str, line: str) -> None:
        """Log a line, the first of its kind."""
        if what not in self._told:
            self._told.add(what)
            self._log(line)


def _find_radius(optics: Optics, file: ExrFile, depth: np.ndarray) -> np.ndarray:
    """The radius [H, W, 1] of the circles of confusion in pixels, of things in a depth [H, W, 1]."""
    assert optics.fstop is not None
    assert optics.lens is not None
    assert optics.focus is not None
    diameter = optics.lens / optics.fstop / 1000 / (optics.metres or 1.0)
    focal_pixels = optics.lens / (optics.sensor or _FULL_FRAME) * _width(file)
    return np.asarray(
        compute_confusion_radius(jnp.asarray(depth), optics.focus, diameter * focal_pixels / (2 * optics.focus))
    )


def _width(file: ExrFile) -> int:
    """Pixels in a row of the picture."""
    return file.display.right - file.display.left + 1
