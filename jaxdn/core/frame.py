"""Frames and clips: the buffers that a renderer gives for one frame, and the one table of all buffers.

``None`` is the neutral element: a buffer that is ``None`` means *this effect is absent*, and every consumer treats it
exactly as the explicit neutral value (no motion is zero motion, no albedo is white, no roughness is 1, no normal and
no depth is 0). Because ``None`` is part of the pytree's structure, jit specialises on it, and an absent effect adds
nothing to the compiled program.

A buffer is declared once, as a field of :class:`Frame` annotated with its :class:`Buffer`. Sanitizing, files, caches,
augmentation, byte counts and the hard cases of the tests all follow from :data:`BUFFERS`.
"""

from collections.abc import Iterable
from typing import Annotated, Any, Literal, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np

RADIANCE_MAX = 65504.0
"""Radiance is clamped to the largest float16 on entry."""

FAR = 1e6
"""View-space depth stored where the camera ray left the scene: large and finite, so that differences stay finite."""

Array = jax.Array | Any
"""A jax or NumPy array, or None where the effect is absent. Type checkers offer what jax arrays have."""

Kind = Literal["light", "signed", "fraction", "direction", "distance", "vector", "count", "flag", "id"]
"""The kind of values in a buffer; it decides how they are sanitized, stored and transformed:

* ``light``: radiance >= 0; ``signed``: a difference of radiances, of either sign;
* ``fraction``: in [0, 1]; ``count``: a number of samples >= 0;
* ``direction``: unit vectors in world space, or 0; ``vector``: motion in the image plane, in pixels;
* ``distance``: lengths >= 0 in scene units; ``flag``: bool; ``id``: int32, -1 for nothing."""

_STORED = {"light": "half", "fraction": "half", "direction": "half", "flag": "flag", "id": "id"}
_DTYPES = {"flag": np.dtype(bool), "id": np.dtype(np.int32)}


UNNUMBERED = 2**31 - 1
"""The id of all surfaces that have no number; numbers of files end below."""


class Buffer(NamedTuple):
    """One row of the table: everything that the other modules need to know about a buffer."""

    channels: int
    kind: Kind
    neutral: float | str = 0.0
    """The meaning of ``None``: a number, or the name of a buffer declared before this one, whose values it takes."""
    on_request: bool = False
    """Rendered only for a denoiser that reads it, as few do."""
    of_samples: bool = False
    """It describes the very samples that ``radiance`` is the mean of: another noisy image has another one."""
    averaged: bool = False
    """Where a renderer filters its pixels, it is a mean over the samples of the pixel, as noisy as ``radiance``; the
    other buffers are point samples."""

    @property
    def stored(self) -> Literal["half", "single", "flag", "id"]:
        """Its format in files: float16, float32, bool (as float16) or an integer (as uint32, plus one)."""
        return _STORED.get(self.kind, "single")  # type: ignore[return-value]

    @property
    def dtype(self) -> np.dtype:
        """Its dtype in a Frame that was read from files."""
        return _DTYPES.get(self.kind, np.dtype(np.float32))

    @property
    def letters(self) -> str:
        """The last letter of each of its channels' names in files."""
        if self.channels == 3:
            return "XYZ" if self.kind == "direction" else "RGB"
        return {2: "XY", 1: "Z" if self.kind == "distance" else "Y"}[self.channels]

    @property
    def bytes(self) -> int:
        """Bytes per pixel in files, before compression."""
        return self.channels * {"half": 2, "flag": 2, "single": 4, "id": 4}[self.stored]


class Frame(NamedTuple):
    """What a renderer gives for one frame; every buffer is ``[H, W, C]`` and all but ``radiance`` may be ``None``.

    A buffer that a renderer makes at a lower resolution (A-SVGF's one sample in 3x3 pixels) is scattered to full size,
    with its neutral value elsewhere.
    """

    radiance: Annotated[Array, Buffer(3, "light")]
    """[H, W, 3] noisy radiance to denoise, linear Rec.709, >= 0: indirect light, or all light."""
    albedo: Annotated[Array, Buffer(3, "fraction", 1.0, averaged=True)] = None
    """[H, W, 3] first-hit diffuse reflectance in [0, 1]; neutral: 1."""
    normal: Annotated[Array, Buffer(3, "direction", averaged=True)] = None
    """[H, W, 3] unit world-space shading normal, zero where the ray left the scene; neutral: 0."""
    depth: Annotated[Array, Buffer(1, "distance")] = None
    """[H, W, 1] view-space z along the optical axis, > 0, ``FAR`` on a miss; neutral: 0."""
    roughness: Annotated[Array, Buffer(1, "fraction", 1.0, averaged=True)] = None
    """[H, W, 1] linear roughness r, GGX alpha = r * r; neutral: 1."""
    motion: Annotated[Array, Buffer(2, "vector")] = None
    """[H, W, 2] (x, y) px, y down, previous minus current; not finite where there is no history; neutral: 0."""
    dual_motion: Annotated[Array, Buffer(2, "vector", "motion")] = None
    """[H, W, 2] px, as ``motion`` but disoccluded pixels take over their occluder's; neutral: ``motion``."""
    visible: Annotated[Array, Buffer(1, "flag", 1.0)] = None
    """[H, W, 1] bool, the point was seen in the previous frame; neutral: true."""
    previous_depth: Annotated[Array, Buffer(1, "distance", "depth")] = None
    """[H, W, 1] view-space z that the point had in the previous frame; neutral: ``depth``."""
    ids: Annotated[Array, Buffer(1, "id", UNNUMBERED)] = None
    """[H, W, 1] int32 shape id, -1 where the ray left the scene; neutral: :data:`UNNUMBERED`, all is one surface."""
    direct: Annotated[Array, Buffer(3, "light", averaged=True)] = None
    """[H, W, 3] directly reflected light; neutral: 0."""
    emission: Annotated[Array, Buffer(3, "light", averaged=True)] = None
    """[H, W, 3] light emitted towards the camera; neutral: 0."""
    specular: Annotated[Array, Buffer(3, "light", on_request=True, of_samples=True)] = None
    """[H, W, 3] the part of ``radiance`` whose last reflection was specular; the rest is diffuse; neutral: 0."""
    reflectance: Annotated[Array, Buffer(3, "fraction", "albedo", averaged=True)] = None
    """[H, W, 3] share of uniform incident light that the surface reflects to the camera; neutral: ``albedo``."""
    specular_reflectance: Annotated[Array, Buffer(3, "fraction", on_request=True, averaged=True)] = None
    """[H, W, 3] the specular lobes' part of ``reflectance``; neutral: 0."""
    hit_distance: Annotated[Array, Buffer(1, "distance", on_request=True, of_samples=True)] = None
    """[H, W, 1] length of the path's segment after the first hit, the mean over diffuse samples; ``FAR`` where it left
    the scene; 0 (neutral) means unknown."""
    specular_hit_distance: Annotated[Array, Buffer(1, "distance", on_request=True, of_samples=True)] = None
    """[H, W, 1] the same for specular samples; 0 (neutral) means unknown."""
    ray_length: Annotated[Array, Buffer(1, "distance", "depth", on_request=True)] = None
    """[H, W, 1] length of the camera ray up to the surface, ``FAR`` on a miss; neutral: ``depth``."""
    far_motion: Annotated[Array, Buffer(2, "vector", "motion", on_request=True)] = None
    """[H, W, 2] px, where what is infinitely far away in the pixel's direction lay in the previous frame; neutral:
    ``motion``."""
    sample_count: Annotated[Array, Buffer(1, "count", 1.0)] = None
    """[H, W, 1] samples that ``radiance`` is the mean of; neutral: 1."""
    luminance_gradient: Annotated[Array, Buffer(2, "signed")] = None
    """[H, W, 2] change of a replayed sample's luminance since the previous frame, and the larger of both luminances;
    0 (neutral) where nothing was replayed (Schied et al. 2018)."""
    shadowed: Annotated[Array, Buffer(3, "light", on_request=True, of_samples=True)] = None
    """[H, W, 3] the part of ``radiance`` that comes straight from sampled points of lights, by diffuse reflection;
    neutral: 0."""
    unshadowed: Annotated[Array, Buffer(3, "light", "shadowed", on_request=True, of_samples=True)] = None
    """[H, W, 3] what ``shadowed`` would be if nothing stood in the light's way; neutral: ``shadowed``."""
    shadow_motion: Annotated[Array, Buffer(2, "vector", "motion", on_request=True, of_samples=True)] = None
    """[H, W, 2] px, where the shadow on this point, or its edge, lay in the previous frame; neutral: ``motion``."""
    glossy_motion: Annotated[Array, Buffer(2, "vector", "motion", on_request=True, of_samples=True)] = None
    """[H, W, 2] px, where the reflection seen at this point lay in the previous frame; neutral: ``motion``."""


def _table() -> dict[str, Buffer]:
    hints = get_type_hints(Frame, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in Frame._fields}


BUFFERS: dict[str, Buffer] = _table()
"""Every buffer of a Frame by its name, in the order of the fields; ``radiance`` comes first."""

GUIDES: tuple[str, ...] = Frame._fields[1:]
"""The buffers that may be ``None``: all but ``radiance``."""


ON_REQUEST: frozenset[str] = frozenset(name for name, buffer in BUFFERS.items() if buffer.on_request)
"""The buffers that are rendered only for a denoiser that reads them."""

OF_SAMPLES: frozenset[str] = frozenset(name for name, buffer in BUFFERS.items() if buffer.of_samples)
"""The buffers that belong to one noisy image, and not to another of the same frame."""

AVERAGED: tuple[str, ...] = tuple(name for name, buffer in BUFFERS.items() if buffer.averaged)
"""The buffers that are means over the samples of a pixel where pixels are filtered."""


class Clip(NamedTuple):
    """Consecutive frames and, where known, what their ``radiance`` converges to."""

    frames: Frame
    """A Frame whose buffers have a leading axis ``T``."""
    reference: Array = None
    """[T, H, W, 3] the noise-free radiance."""
    layers: dict[int, Array] | None = None
    """Samples per pixel (powers of two) -> [T, H, W, 3] independent noisy radiance, for denoisers that request samples
    (:attr:`jaxdn.Denoiser.samples`)."""


def frame_at(frames: Frame, index: int | jax.Array) -> Frame:
    """The frame at one index of a clip's frames (the leading axis of every buffer that is present)."""
    return jax.tree.map(lambda buffer: buffer[index], frames)


def present(frame: Frame) -> tuple[str, ...]:
    """The names of the buffers that are present, except ``radiance``, in the order of the table."""
    return tuple(name for name in GUIDES if getattr(frame, name) is not None)


def only(frame: Frame, reads: frozenset[str]) -> Frame:
    """The same frame with every buffer dropped that is not in ``reads`` (``radiance`` always stays)."""
    dropped: dict[str, Any] = {name: None for name in GUIDES if name not in reads}
    return frame._replace(**dropped)


def written_out(frame: Frame, names: Iterable[str]) -> Frame:
    """The same frame (or a clip's frames) with the neutral value in place of every ``None`` among ``names``.

    The result gives the same image at a higher cost; it is needed where frames with and without an effect are stacked.
    NumPy arrays in, NumPy arrays out.
    """
    wanted = set(names)
    light = frame.radiance
    numbers = np if isinstance(light, np.ndarray) else jnp
    filled = frame._asdict()
    for name in GUIDES:  # in this order: a buffer that gives another's neutral value comes first
        if name in wanted and filled[name] is None:
            filled[name] = _neutral(name, filled, light, numbers)
    return Frame(**filled)


def _neutral(name: str, filled: dict[str, Array], light: Array, numbers: Any) -> Array:
    buffer = BUFFERS[name]
    value = buffer.neutral
    while isinstance(value, str):
        if filled[value] is not None:
            return filled[value]
        value = BUFFERS[value].neutral
    return numbers.full((*light.shape[:-1], buffer.channels), value, _DTYPES.get(buffer.kind, light.dtype))
