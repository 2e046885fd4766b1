"""Large frames in parts: the same image, and the memory of a window instead of that of the frame.

A window is denoised with all around it that decides about its pixels: the method's reach, and as far as this frame's
vectors fetch the history from. Only what lies farther inside is kept. What a method measures of whole frames is
measured before (:mod:`jaxdn.denoiser.statistics`). Windows begin at multiples of :data:`GRID`, which all blocks of
pixels that methods work on are parts of, and have the same rest of the division by it as the frame: one compiled
program serves all, and what is padded at the frame's border is padded likewise.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import BUFFERS, Frame, only, present
from jaxdn.denoiser import Denoiser, Params, RecurrentStep
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.runtime.malloc import trim_malloc

GRID = 32
"""Windows begin at multiples of this."""


class Window(NamedTuple):
    """A window along one axis, in pixels."""

    start: int
    stop: int
    first: int
    """Of the pixels that are kept."""
    last: int
    """The one after them."""


def split_axis(length: int, side: int, margin: int) -> list[Window]:
    """Windows of one size, at most ``side``, that cover ``length`` pixels; what is kept of them lies side by side.

    At least ``margin`` pixels lie between what is kept and a window's end that is not the frame's. Raises ValueError
    for windows too small for their margins.
    """
    if length <= side:
        return [Window(0, length, 0, length)]
    size = side - (side - length) % GRID
    if size < 2 * (margin + GRID):
        raise ValueError(
            f"parts need sides of {2 * (margin + GRID) + GRID} pixels or more, as {margin} around a pixel decide about "
            f"it; there is room for {side}."
        )
    found = [Window(0, size, 0, size - margin)]
    while found[-1].stop < length:
        first = found[-1].last
        start = min((first - margin) // GRID * GRID, length - size)
        stop = start + size
        found.append(Window(start, stop, first, length if stop == length else stop - margin))
    return found


def map_tiles(
    function: Callable[[Any], Any], given: Any, size: tuple[int, int], *, side: int, margin: int
) -> tuple[Any, list[Any]]:
    """A function of pictures, window by window.

    Args:
      function: (``given``, cut to a window) -> a pytree of pictures [h, w, ...] of the window, which are joined, and
        anything else of it.
      given: a pytree of NumPy arrays [H, W, ...].
      size: H and W.
      side: of the windows, at most, in pixels.
      margin: how far around a pixel its value is decided.

    Returns the joined pictures, NumPy arrays [H, W, ...], and the other results.
    """
    whole: Any = None
    others = []
    for rows, columns in _crossed(*(split_axis(length, side, margin) for length in size)):
        # Copied: a view of a NumPy array would be copied to a new buffer at every use.
        cut = jax.tree.map(
            lambda x, r=rows, c=columns: np.ascontiguousarray(x[r.start : r.stop, c.start : c.stop]), given
        )
        pictures, other = function(cut)
        if whole is None:
            whole = jax.tree.map(lambda x: np.empty((*size, *x.shape[2:]), x.dtype), pictures)
        _paste(whole, pictures, rows, columns)
        others.append(other)
        # The C library would keep the buffers of every window.
        trim_malloc()
    return whole, others


def _crossed(rows: Sequence[Window], columns: Sequence[Window]) -> Iterator[tuple[Window, Window]]:
    return ((row, column) for row in rows for column in columns)


def _paste(whole: Any, pictures: Any, rows: Window, columns: Window) -> None:
    """Put what is kept of a window into the joined pictures."""

    def one(target: np.ndarray, picture: Any) -> None:
        inside = np.asarray(picture)[
            rows.first - rows.start : rows.last - rows.start,
            columns.first - columns.start : columns.last - columns.start,
        ]
        target[rows.first : rows.last, columns.first : columns.last] = inside

    jax.tree.map(one, whole, pictures)


@functools.partial(jax.jit, static_argnums=0)
def _measure(step: RecurrentStep, frame: Frame) -> tuple[FrameStatistics | None, jax.Array]:
    _, whole, replaced = step.measured(frame)
    return whole, replaced


@functools.partial(jax.jit, static_argnums=0)
def _part(
    step: RecurrentStep, params: Params, state: Any, frame: Frame, first: jax.Array, whole: FrameStatistics | None
) -> tuple[Any, jax.Array, Any]:
    return step.part(params, state, step.measured(frame)[0], first, whole)


def stream_tiled(denoiser: Denoiser, params: Params, side: int, size: tuple[int, int]) -> "TiledStream":
    """As :func:`jaxdn.stream`, for frames of ``size`` (height, width), in windows of at most ``side`` pixels.

    The images are those of whole frames, up to rounding. A vector may fetch the history from at most half a window's
    side less the method's reach; pixels whose vector is longer begin anew. Raises ValueError for a denoiser that cannot
    be parted, because its reach is not known or because it requests samples, and for windows that are too small.
    """
    step = denoiser.step
    if not isinstance(step, RecurrentStep) or step.core.reach is None or denoiser.samples is not None:
        raise ValueError("this method cannot denoise a frame in parts; take another, or smaller frames.")
    for length in size:
        split_axis(length, side, step.core.reach + _AROUND)
    return TiledStream(step, params, side, step.core.reach)


class TiledStream:
    """Frames in, images out, one at a time; made by :func:`stream_tiled`. State and images are NumPy arrays."""

    def __init__(self, step: RecurrentStep, params: Params, side: int, reach: int) -> None:
        self._step, self._params, self._reach = step, params, reach
        self.side = side
        """Of a window, at most."""
        self._state: Any = None
        self._first = True
        self.programs: set[tuple[str, ...]] = set()
        """The sets of buffers, without radiance, that a step was compiled for."""
        self.sanitized = 0
        """Values of frames and histories that had to be replaced; of histories, in every window that sees them."""
        self.beyond_halo = 0
        """Pixels of the last frame whose vector was too long for the windows."""

    def __call__(self, frame: Frame) -> np.ndarray:
        """Denoise the next frame [H, W, C]; returns [H, W, 3]."""
        frame = jax.tree.map(np.asarray, only(frame, self._step.core.reads))
        height, width = frame.radiance.shape[:2]
        new = present(frame) not in self.programs
        self.programs.add(present(frame))
        whole = self._measured(frame, (height, width))
        if self._state is None:
            start = functools.partial(self._step.core.start, self._params)
            self._state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(start, frame))
        room = (self.side - GRID) // 2 - GRID - self._reach
        farthest, self.beyond_halo = find_history_halo(frame, room)
        first = jnp.asarray(self._first)

        def step(given: tuple[Any, Frame]) -> tuple[tuple[Any, jax.Array], Any]:
            nonlocal new
            arguments = (self._step, self._params, *given, first, whole)
            if new:  # compiled before it runs: compiling takes 200 MiB, which would be kept meanwhile
                _part.lower(*arguments).compile()
                trim_malloc()
                new = False
            state, image, lost = _part(*arguments)
            return (state, image), lost

        (self._state, image), lost = map_tiles(
            step, (self._state, frame), (height, width), side=self.side, margin=self._reach + farthest
        )
        self.sanitized += sum(int(each) for each in lost)
        self._first = False
        return image

    def _measured(self, frame: Frame, size: tuple[int, int]) -> FrameStatistics | None:
        """What is measured of a frame, window by window; values that are replaced are counted."""
        total: Any = None
        for row in range(0, size[0], step := max(self.side // GRID, 1) * GRID):
            for column in range(0, size[1], step):
                part = jax.tree.map(lambda x, r=row, c=column: x[r : r + step, c : c + step], frame)
                sums, replaced = _measure(self._step, part)
                self.sanitized += int(replaced)
                total = sums if total is None else jax.tree.map(jnp.add, total, sums)
        return None if total is None else total._replace(height=jnp.asarray(size[0], total.height.dtype))


_AROUND = 3
"""Pixels around a target that are fetched with it."""


def find_history_halo(frame: Frame, most: int) -> tuple[int, int]:
    """How far away history is fetched, in pixels, if no farther than ``most``; and how many pixels would need more.

    Vectors that leave the frame fetch nothing.
    """
    height, width = frame.radiance.shape[:2]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    farthest, beyond = _AROUND, np.zeros((height, width), bool)
    for name, buffer in BUFFERS.items():
        vectors = getattr(frame, name) if buffer.kind == "vector" else None
        if vectors is None:
            continue
        x, y = np.asarray(vectors[..., 0], np.float32), np.asarray(vectors[..., 1], np.float32)
        with np.errstate(invalid="ignore"):
            length = np.maximum(np.abs(x), np.abs(y)) + _AROUND
            inside = (columns + x > -1) & (columns + x < width) & (rows + y > -1) & (rows + y < height)
            beyond |= inside & (length > most)
            farthest = max(farthest, int(np.ceil(np.max(length, initial=0.0, where=inside & (length <= most)))))
    return farthest, int(beyond.sum())
