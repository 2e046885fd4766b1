"""Tiled inference: large frames in overlapping tiles, with the images of whole frames and the memory of a tile.

A tile is denoised with a halo of all that decides about its pixels: the denoiser's receptive field, and as far as this
frame's vectors fetch the history from. The halo is thrown away. The statistics of the whole frame are measured before
(:mod:`jaxdn.denoiser.statistics`). Tiles begin at multiples of :data:`GRID`, which all blocks of pixels that methods
work on divide, and their sizes have the same remainder by it as the frame's: one compiled program serves all, and what
is padded at the frame's border is padded likewise.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import BUFFERS, Frame, only, present
from jaxdn.denoiser import Denoiser, Params, State, stages_of
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.runtime.malloc import trim_malloc

GRID = 32
"""Tiles begin at multiples of this."""


class Span(NamedTuple):
    """A tile along one axis, in pixels."""

    start: int
    stop: int
    keep_start: int
    """Of the pixels without the halo."""
    keep_stop: int


def split_axis(length: int, side: int, halo: int) -> list[Span]:
    """Spans of one size, at most ``side``, that cover ``length`` pixels; what is kept of them lies side by side.

    At least ``halo`` pixels lie between what is kept and a tile's end that is not the frame's. Raises ValueError for
    tiles too small for their halos.
    """
    if length <= side:
        return [Span(0, length, 0, length)]
    size = _fit(length, side)
    if size < 2 * (halo + GRID):
        raise ValueError(
            f"tiles: expected sides of {2 * (halo + GRID) + GRID} pixels or more, as {halo} around a pixel decide "
            f"about it; got room for {side}."
        )
    spans = [Span(0, size, 0, size - halo)]
    while spans[-1].stop < length:
        keep_start = spans[-1].keep_stop
        start = min((keep_start - halo) // GRID * GRID, length - size)
        stop = start + size
        spans.append(Span(start, stop, keep_start, length if stop == length else stop - halo))
    return spans


def _fit(length: int, side: int) -> int:
    """The size of tiles of at most ``side`` pixels along an axis that is longer."""
    return side - (side - length) % GRID


def map_tiles(
    function: Callable[[Any], Any], given: Any, size: tuple[int, int], *, side: int, halo: int
) -> tuple[Any, list[Any]]:
    """A function of images, tile by tile.

    Args:
      function: (``given``, cut to a tile) -> a pytree of images [h, w, ...] of the tile, which are joined, and anything
        else of it.
      given: a pytree of NumPy arrays [H, W, ...]. Arrays of other sizes are no images: every tile gets them as they
        are, and of those among the results the last tile's is kept.
      size: H and W.
      side: of the tiles, at most, in pixels.
      halo: how far around a pixel its value is decided.

    Returns the joined images, NumPy arrays [H, W, ...], and the other results.
    """
    joined: Any = None
    others = []
    for rows, columns in _cross(*(split_axis(length, side, halo) for length in size)):
        images, other = function(jax.tree.map(lambda x, r=rows, c=columns: _cut(x, size, r, c), given))
        tile = rows.stop - rows.start, columns.stop - columns.start
        if joined is None:
            joined = jax.tree.map(
                lambda x, t=tile: np.empty((*size, *x.shape[2:]), x.dtype) if _is_image(x, t) else x, images
            )
        joined = jax.tree.map(lambda to, x, t=tile, r=rows, c=columns: _paste(to, x, t, r, c), joined, images)
        others.append(other)
        # The C library would keep the buffers of every tile.
        trim_malloc()
    return joined, others


def _cross(rows: Sequence[Span], columns: Sequence[Span]) -> Iterator[tuple[Span, Span]]:
    return ((row, column) for row in rows for column in columns)


def _is_image(array: Any, size: tuple[int, int]) -> bool:
    return bool(np.shape(array)[:2] == size)


def _cut(array: Any, size: tuple[int, int], rows: Span, columns: Span) -> Any:
    if not _is_image(array, size):
        return array
    # Copied: a view of a NumPy array would be copied to a new buffer at every use.
    return np.ascontiguousarray(array[rows.start : rows.stop, columns.start : columns.stop])


def _paste(target: Any, array: Any, tile: tuple[int, int], rows: Span, columns: Span) -> Any:
    """The joined image with what is kept of a tile's, or the tile's array if it is no image."""
    if not _is_image(array, tile):
        return np.asarray(array)
    kept = np.asarray(array)[
        rows.keep_start - rows.start : rows.keep_stop - rows.start,
        columns.keep_start - columns.start : columns.keep_stop - columns.start,
    ]
    target[rows.keep_start : rows.keep_stop, columns.keep_start : columns.keep_stop] = kept
    return target


@functools.partial(jax.jit, static_argnums=0)
def _measure_tile(denoiser: Denoiser, frame: Frame) -> tuple[FrameStatistics, jax.Array]:
    statistics, _, replaced = stages_of(denoiser).prepare(frame)
    return statistics, jnp.asarray(replaced, jnp.int32)


@functools.partial(jax.jit, static_argnums=0)
def _step_tile(
    denoiser: Denoiser, params: Params, state: State, frame: Frame, first: jax.Array, statistics: FrameStatistics
) -> tuple[State, jax.Array, jax.Array | int]:
    stages = stages_of(denoiser)
    return stages.step(params, state, stages.prepare(frame)[1], first, statistics)


def stream_tiled(denoiser: Denoiser, params: Params, side: int, size: tuple[int, int]) -> "TiledStream":
    """As :func:`jaxdn.stream`, for frames of ``size`` (height, width), in tiles of at most ``side`` pixels.

    The images are those of whole frames, up to rounding. A vector may fetch the history from at most half a tile's side
    less the receptive field; pixels whose vector is longer begin anew. Raises ValueError for a denoiser that cannot be
    tiled, because its receptive field is not known or because it requests samples, and for tiles that are too small.
    """
    if denoiser.samples is not None:
        raise ValueError(
            "tiles: expected a denoiser that requests no samples, got one that does; denoise whole frames."
        )
    if denoiser.receptive_field is None:
        raise ValueError(
            "tiles: expected a denoiser whose receptive_field is known, got None; give its radius in pixels "
            "(Denoiser.receptive_field, of a core Core.receptive_field), or denoise whole frames."
        )
    for length in size:
        split_axis(length, side, denoiser.receptive_field + _TAPS_AROUND)
    return TiledStream(denoiser, params, side, denoiser.receptive_field)


class TiledStream:
    """Frames in, images out, one at a time; made by :func:`stream_tiled`. State and images are NumPy arrays."""

    def __init__(self, denoiser: Denoiser, params: Params, side: int, receptive_field: int) -> None:
        self._denoiser, self._params, self._receptive_field = denoiser, params, receptive_field
        self.side = side
        """Of a tile, at most."""
        self._state: State = None
        self._first = True
        self.programs: set[tuple[str, ...]] = set()
        """The sets of buffers, without radiance, that a step was compiled for."""
        self.sanitized = 0
        """Values of frames and histories that had to be replaced; of histories, in every tile that sees them."""
        self.beyond_halo = 0
        """Pixels of the last frame whose vector was too long for the tiles."""

    def __call__(self, frame: Frame) -> np.ndarray:
        """Denoise the next frame [H, W, C]; returns [H, W, 3]."""
        frame = jax.tree.map(np.asarray, only(frame, self._denoiser.reads))
        height, width = frame.radiance.shape[:2]
        new = present(frame) not in self.programs
        self.programs.add(present(frame))
        statistics = self._measure(frame, (height, width))
        if self._state is None:
            # The first step does not look at it.
            start = functools.partial(stages_of(self._denoiser).start, self._params)
            self._state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(start, frame))
        history_halo, self.beyond_halo = find_history_halo(frame, self._limit((height, width)))
        first = jnp.asarray(self._first)

        def step(given: tuple[State, Frame]) -> tuple[tuple[State, jax.Array], Any]:
            nonlocal new
            arguments = (self._denoiser, self._params, *given, first, statistics)
            if new:  # compiled before it runs: compiling takes 200 MiB, which would be kept meanwhile
                _step_tile.lower(*arguments).compile()
                trim_malloc()
                new = False
            state, image, invalid = _step_tile(*arguments)
            return (state, image), invalid

        halo = self._receptive_field + history_halo
        (self._state, image), invalid = map_tiles(
            step, (self._state, frame), (height, width), side=self.side, halo=halo
        )
        self.sanitized += sum(map(int, invalid))
        self._first = False
        return image

    def _limit(self, size: tuple[int, int]) -> int:
        """How far away history may be fetched, in pixels: :func:`split_axis` has room for such halos."""
        sizes = [_fit(length, self.side) for length in size if length > self.side]
        return min(sizes) // 2 - GRID - self._receptive_field if sizes else max(size) + _TAPS_AROUND

    def _measure(self, frame: Frame, size: tuple[int, int]) -> FrameStatistics:
        """The statistics of a frame, tile by tile; values that are replaced are counted."""
        sums = []
        for rows, columns in itertools.product(*(_split_for_measuring(length, self.side) for length in size)):
            tile = jax.tree.map(lambda x, r=rows, c=columns: x[r, c], frame)
            statistics, replaced = _measure_tile(self._denoiser, tile)
            self.sanitized += int(replaced)
            sums.append(statistics)
        total = functools.reduce(lambda one, other: jax.tree.map(jnp.add, one, other), sums)
        return total._replace(height=jnp.asarray(size[0], total.height.dtype))


def _split_for_measuring(length: int, side: int) -> list[slice]:
    """Slices of about ``side`` pixels that lie side by side and begin at multiples of :data:`GRID`.

    Less than :data:`GRID` pixels at the end go with the last slice: alone they would be measured as blocks of that
    size, which the whole frame does not have.
    """
    step = max(side // GRID, 1) * GRID
    starts = range(0, max(length - GRID + 1, 1), step)
    return [slice(start, stop) for start, stop in itertools.pairwise([*starts, length])]


_TAPS_AROUND = 3
"""Pixels around a target that are fetched with it."""


def find_history_halo(frame: Frame, limit: int) -> tuple[int, int]:
    """How far away history is fetched, in pixels, if no farther than ``limit``; and how many pixels would need more.

    Vectors that leave the frame fetch nothing.
    """
    height, width = frame.radiance.shape[:2]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    farthest, beyond = _TAPS_AROUND, np.zeros((height, width), bool)
    for name, buffer in BUFFERS.items():
        vectors = getattr(frame, name) if buffer.kind == "vector" else None
        if vectors is None:
            continue
        x, y = np.asarray(vectors[..., 0], np.float32), np.asarray(vectors[..., 1], np.float32)
        with np.errstate(invalid="ignore"):
            length = np.maximum(np.abs(x), np.abs(y)) + _TAPS_AROUND
            inside = (columns + x > -1) & (columns + x < width) & (rows + y > -1) & (rows + y < height)
            beyond |= inside & (length > limit)
            farthest = max(farthest, int(np.ceil(np.max(length, initial=0.0, where=inside & (length <= limit)))))
    return farthest, int(beyond.sum())
