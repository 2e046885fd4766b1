"""One pass of a denoiser through consecutive frames, whole or in parts as memory allows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.clip.folder import frame_path
from jaxdn.data.clip.frames import StoredFrame, doubling_layers
from jaxdn.data.exr.exr import read_windows
from jaxdn.denoiser.rollout import Layers, Stream, stream
from jaxdn.denoiser.sanitize import sanitize_image
from jaxdn.denoiser.tiles import TiledStream, map_tiles, stream_tiled
from jaxdn.sequence.memory_budget import GIB, memory_of_machine, needed, side_within
from jaxdn.sequence.safe_blend import REACH, Combined, Judged, combine, judge
from jaxdn.zoo.ready import Candidate

_combine = jax.jit(combine, static_argnames="blind")
_judge = jax.jit(judge)


class Safe(NamedTuple):
    """What decided about an image."""

    judged: Judged
    kept: float
    """How much of the noisy frame was kept, pixel by pixel, in the mean."""
    blind: bool
    """No guide tells of textures."""


class Pass:
    """A denoiser on its way through consecutive frames; gives the image [H, W, 3] of each.

    With ``limit`` bytes of memory, by default half of the machine's, frames that need more are denoised in parts.
    """

    def __init__(
        self, source: Path, method: Candidate, *, limit: float | None = None, log: Callable[[str], None]
    ) -> None:
        self._source, self._method, self._limit, self._log = source, method, limit, log
        self._step: Stream | TiledStream | None = None
        self._told = 0

    def __call__(self, stored: StoredFrame) -> np.ndarray:
        """The image of the next frame. Raises ValueError where a limit that was given cannot be kept."""
        if self._method.denoiser is None:
            return np.asarray(light_of(stored.frame.radiance))
        if self._step is None:
            self._step = self._chosen(*stored.frame.radiance.shape[:2])
        if isinstance(self._step, Stream):
            return np.asarray(self._step(stored.frame, self._layers(stored)))
        image = self._step(stored.frame)
        if self._step.beyond_halo > self._told:
            self._told = self._step.beyond_halo
            self._log(f"{self._told} pixels move too far for the parts and begin anew; give more --max-memory")
        return image

    @property
    def denoises(self) -> bool:
        """Whether there is a denoiser."""
        return self._method.denoiser is not None

    @property
    def programs(self) -> set[tuple[str, ...]]:
        """The sets of buffers that a step was compiled for."""
        return set() if self._step is None else self._step.programs

    @property
    def sanitized(self) -> int:
        """Invalid values that were replaced."""
        return 0 if self._step is None else self._step.sanitized

    def safe(self, frame: Frame, image: np.ndarray) -> tuple[np.ndarray, Safe]:
        """The image of a frame with what is no noise as it was (:mod:`jaxdn.sequence.safe_blend`), and what decided."""
        noisy = np.asarray(frame.radiance)
        blind = frame.albedo is None and frame.reflectance is None
        found = self._combined(noisy, image, blind=blind)
        judged: Judged = jax.device_get(_judge(found))
        image = np.asarray(found.image)
        if judged.distrust > 0:
            image = image + np.float32(judged.distrust) * (np.asarray(light_of(noisy)) - image)
        return image, Safe(judged, float(np.mean(found.share)), blind)

    def _combined(self, noisy: np.ndarray, image: np.ndarray, *, blind: bool) -> Combined:
        if not isinstance(self._step, TiledStream):
            return _combine(noisy, image, blind=blind)
        level = jnp.asarray(np.mean(image, dtype=np.float64), jnp.float32)
        found, _ = map_tiles(
            lambda given: (_combine(*given, level, blind=blind), None),
            (noisy, image),
            image.shape[:2],
            side=self._step.side,
            margin=REACH,
        )
        return found

    def _layers(self, stored: StoredFrame) -> Layers:
        """The independent layers of a frame, for a method that requests samples."""
        assert self._method.denoiser is not None
        if self._method.denoiser.samples is None:
            return None
        return {count: stored.layers[count] for count in doubling_layers(stored.layers, self._source)}

    def _chosen(self, height: int, width: int) -> Stream | TiledStream:
        denoiser, params = self._method.denoiser, self._method.params
        assert denoiser is not None
        limit = memory_of_machine() / 2 if self._limit is None else self._limit
        file = frame_path(self._source, 0) if self._source.is_dir() else self._source
        size = height, width, len(read_windows(file)[1])
        side = side_within(limit, *size)
        if side is None:
            return stream(denoiser, params)
        whole = f"whole frames of {width} x {height} need about {needed(*size) / GIB:.1f} GiB"
        try:
            step = stream_tiled(denoiser, params, side, (height, width))
        except ValueError as error:
            if self._limit is not None:
                raise ValueError(f"--max-memory {limit / GIB:g}: {whole}; {error}") from None
            self._log(f"{whole}, more than half of this machine's memory, and cannot be parted: {error}")
            return stream(denoiser, params)
        self._log(f"in parts of at most {side} x {side} pixels: {whole} (--max-memory)")
        return step


def light_of(radiance: np.ndarray | None) -> Any:
    """Radiance that can be added: non-finite or negative values become 0, an absent part is 0."""
    return 0.0 if radiance is None else np.asarray(sanitize_image(radiance), np.float32)
