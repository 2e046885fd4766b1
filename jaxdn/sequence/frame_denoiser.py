"""A denoiser on its way through consecutive frames: whole, or in tiles of the same image where memory asks for them."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import FAR, Array, Frame
from jaxdn.data.clip.frames import StoredFrame, doubling_layers
from jaxdn.denoiser.rollout import Layers, Stream, stream
from jaxdn.denoiser.tiles import GRID, TiledStream, map_tiles, stream_tiled
from jaxdn.sequence.james_stein import REACH, Confidence, JamesStein, combine, measure_confidence, measure_level
from jaxdn.sequence.light_range import DRIFT, bound_light, choose_exponent, find_lamps, restore_lamps, restore_light
from jaxdn.zoo.ready import Model

GIB = 2**30
PROGRAM = 0.6 * GIB
"""Bytes of the program itself, with XLA and what it compiles."""
HELD = 140
"""Bytes a pixel of what is there however a frame is denoised: its buffers, the state before and after, the image."""
CHANNEL = 8
"""Bytes a pixel of each channel of a file while it is written."""
STEP = 1100
"""Bytes a pixel of what is denoised at once, a window or the whole frame. All four are upper bounds for the shipped
methods on two cores, by ``python -m experiments.stability.memory``."""

_combine = jax.jit(combine)
_measure_confidence = jax.jit(measure_confidence)


class Fallback(NamedTuple):
    """What decided how much of the noisy image is in a result."""

    confidence: Confidence
    kept: float
    """How much of the noisy frame was kept, pixel by pixel, in the mean."""
    texture_unknown: bool
    """No guide tells of textures."""


class FrameDenoiser:
    """Gives the image [H, W, 3] of each of consecutive frames.

    With ``limit`` bytes of memory, by default half of the machine's, frames that need more are denoised in tiles.
    """

    def __init__(
        self,
        method: Model,
        source: Path,
        *,
        channels: Callable[[], int],
        limit: float | None = None,
        blends: bool = False,
        log: Callable[[str], None],
    ) -> None:
        """``source`` is named in errors, ``channels`` counts those of its files, ``log`` is called with lines.

        ``blends``: :meth:`blend_fallback` will be called, whose programs are made while the first frame is computed.
        """
        self._method, self._source, self._count_channels = method, source, channels
        self._limit, self._blends, self._log = limit, blends, log
        self._step: Stream | TiledStream | None = None
        self._room: bool | None = None
        self._lost_pixels = 0
        self._exponent: int | None = None  # of the unit in which this step's history is
        self._lamps = np.zeros((0, 0, 1), bool)  # of the last frame
        self._programs: set[tuple[str, ...]] = set()  # of the steps before this one
        self._sanitized = 0

    def __call__(self, stored: StoredFrame) -> np.ndarray:
        """The image of the next frame. Raises ValueError where a limit that was given cannot be kept."""
        noisy = np.asarray(stored.frame.radiance)
        if self._method.denoiser is None:
            return np.asarray(light_of(noisy))
        exponent = self._follow_light(noisy)
        self._lamps = find_lamps(noisy, exponent)
        image = self._denoise(bound_light(stored, exponent, self._lamps), stored.frame)
        return restore_light(image, noisy, exponent, self._lamps)

    def _denoise(self, stored: StoredFrame, came: Frame) -> np.ndarray:
        """The image of a bounded frame; ``came``: as it was."""
        step = self._prepare(stored.frame)
        if isinstance(step, Stream):
            computed = step(stored.frame, self._layers(stored))
            if self._blends:
                self._blends = False
                compile_blend(came)
            return np.asarray(computed)
        image = step(stored.frame)
        if step.beyond_halo > self._lost_pixels:
            self._lost_pixels = step.beyond_halo
            self._log(f"{self._lost_pixels} pixels move too far for the tiles and begin anew; give more --max-memory")
        return image

    def _follow_light(self, radiance: np.ndarray) -> int:
        """The exponent for the next frame; where it is another one, the history ends, as it is in another unit."""
        exponent = choose_exponent(radiance, self._exponent)
        if self._exponent is not None and exponent != self._exponent and self._step is not None:
            self._log(f"the light changes by more than a factor of {2**DRIFT}: there the history begins anew")
            self._programs, self._sanitized = self.programs, self.sanitized
            self._step = None
        self._exponent = exponent
        return 0 if exponent is None else exponent

    def is_tiled(self, frame: Frame) -> bool:
        """Whether frames like this one are denoised in tiles. Raises as the call does."""
        return self.denoises and isinstance(self._prepare(frame), TiledStream)

    def leaves_room(self, frame: Frame) -> bool:
        """Whether memory is enough for three frames like this one: one is read, one denoised and one written.

        It is asked once; later frames of the sequence get the same answer.
        """
        if self._room is None:
            size = *frame.radiance.shape[:2], self._count_channels()
            self._room = estimate_bytes(*size) + _beside_step(*size) - PROGRAM <= self._limit_bytes()
        return self._room

    @property
    def denoises(self) -> bool:
        """Whether there is a denoiser."""
        return self._method.denoiser is not None

    @property
    def reads_motion(self) -> bool:
        """Whether the denoiser follows motion vectors."""
        return self._method.denoiser is not None and "motion" in self._method.denoiser.reads

    @property
    def receptive_field(self) -> int | None:
        """How many pixels around a pixel decide about it; None: unknown."""
        return None if self._method.denoiser is None else self._method.denoiser.receptive_field

    @property
    def programs(self) -> set[tuple[str, ...]]:
        """The sets of buffers that a step was compiled for."""
        return self._programs | (set() if self._step is None else self._step.programs)

    @property
    def sanitized(self) -> int:
        """Invalid values that were replaced."""
        return self._sanitized + (0 if self._step is None else self._step.sanitized)

    def blend_fallback(self, frame: Frame, image: np.ndarray) -> tuple[np.ndarray, Fallback]:
        """The image of the last frame with what is no noise as it was, and why (:mod:`jaxdn.sequence.james_stein`).

        Pixels without samples have nothing to keep.
        """
        noisy = np.asarray(frame.radiance)
        if frame.sample_count is not None:
            noisy = np.where(np.asarray(frame.sample_count) > 0, noisy, np.float32(np.nan))
        combined = self._combine(noisy, image, None if frame.depth is None else np.asarray(frame.depth) < FAR)
        confidence: Confidence = jax.device_get(_measure_confidence(combined))
        image = np.asarray(combined.image)
        if confidence.fallback > 0:
            kept = np.where(np.isfinite(noisy), noisy, image)
            image = image + np.float32(confidence.fallback) * (kept - image)
        image = restore_lamps(image, noisy, self._lamps)
        texture_unknown = frame.albedo is None and frame.reflectance is None
        return image, Fallback(confidence, float(np.mean(np.asarray(combined.noisy_weight))), texture_unknown)

    def _combine(self, noisy: np.ndarray, image: np.ndarray, surface: np.ndarray | None) -> JamesStein:
        if not isinstance(self._step, TiledStream):
            return _combine(noisy, image, surface=surface)
        level = measure_level(jnp.asarray(image))
        combined, _ = map_tiles(
            lambda given: (_combine(given[0], given[1], level, given[2]), None),
            (noisy, image, surface),
            image.shape[:2],
            side=max(self._step.side, 2 * (REACH + GRID) + GRID),  # a method may look less far
            halo=REACH,
        )
        return combined

    def _layers(self, stored: StoredFrame) -> Layers:
        """The independent layers of a frame, for a method that requests samples."""
        assert self._method.denoiser is not None
        if self._method.denoiser.samples is None:
            return None
        return {count: stored.layers[count] for count in doubling_layers(stored.layers, self._source)}

    def _prepare(self, frame: Frame) -> Stream | TiledStream:
        if self._step is None:
            self._step = self._choose_step(*frame.radiance.shape[:2])
        return self._step

    def _limit_bytes(self) -> float:
        return measure_machine_memory() / 2 if self._limit is None else self._limit

    def _choose_step(self, height: int, width: int) -> Stream | TiledStream:
        denoiser, params = self._method.denoiser, self._method.params
        assert denoiser is not None
        limit = self._limit_bytes()
        size = height, width, self._count_channels()
        side = choose_tile_side(limit, *size)
        if side is None:
            return stream(denoiser, params)
        whole = f"whole frames of {width} x {height} need about {estimate_bytes(*size) / GIB:.1f} GiB"
        try:
            step = stream_tiled(denoiser, params, side, (height, width))
        except ValueError as error:
            if self._limit is not None:
                raise ValueError(f"--max-memory {limit / GIB:g}: {whole}; {error}") from None
            self._log(f"{whole}, more than half of this machine's memory, and cannot be tiled: {error}")
            return stream(denoiser, params)
        self._log(f"in tiles of at most {side} x {side} pixels: {whole} (--max-memory)")
        return step


def compile_blend(frame: Frame) -> None:
    """Make the programs of :meth:`FrameDenoiser.blend_fallback` for such a frame, so that its call finds them.

    Tracing takes a tenth of a second, while the threads of a program that has been started leave a core idle.
    """
    height, width = frame.radiance.shape[:2]

    def like(dtype: Any, channels: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((height, width, channels), dtype)

    surface = None if frame.depth is None else like(np.bool_, 1)
    images = like(frame.radiance.dtype, 3), like(np.float32, 3)
    combined = _combine.lower(*images, surface=surface)
    combined.compile()
    _measure_confidence.lower(combined.out_info).compile()


def light_of(radiance: Array) -> Any:
    """Radiance that can be added: values that are not finite become 0, an absent part is 0."""
    return 0.0 if radiance is None else np.where(np.isfinite(radiance), radiance, 0).astype(np.float32)


def measure_machine_memory() -> float:
    """Bytes of memory of this machine; infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):  # not on Unix
        return math.inf


def estimate_bytes(height: int, width: int, channels: int) -> float:
    """Bytes that denoising whole frames needs, of files with so many channels."""
    return _beside_step(height, width, channels) + STEP * height * width


def choose_tile_side(limit: float, height: int, width: int, channels: int) -> int | None:
    """The side of square tiles with which frames are denoised within ``limit`` bytes; None: whole frames fit.

    It is 0 where even what tiles leave out does not fit.
    """
    if estimate_bytes(height, width, channels) <= limit:
        return None
    left = limit - _beside_step(height, width, channels)
    return int(math.sqrt(max(left, 0) / STEP)) // GRID * GRID


def _beside_step(height: int, width: int, channels: int) -> float:
    return PROGRAM + (HELD + CHANNEL * channels) * height * width
