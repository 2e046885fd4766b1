"""The first of two passes of ``jaxdn denoise --bidirectional``, from the last frame to the first, and its images."""

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.exr.exr import to_half
from jaxdn.filters.time_reversal import HistoryLength, update_history_length
from jaxdn.filters.time_reversal import blend as blend_directions
from jaxdn.runtime.scratch import scratch_folder

HIDDEN = ".backwards-"
"""How the names of the folders begin in which images wait."""
_HALF_OCTAVES = 15
"""Values below 2 to this power fit into half precision."""


class BackwardImages:
    """The images of the backward pass of consecutive frames, and how they are blended with those of the forward one."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: HistoryLength | None = None

    def keep(self, index: int, image: np.ndarray, number: np.ndarray) -> None:
        """Store the image [H, W, 3] of a frame and for how many frames its points have been seen, [H, W, 1]."""
        # Scaled so that the largest value fits: 2^29 times darker ones are still exact to 11 bits.
        exponent = _HALF_OCTAVES - int(np.frexp(np.max(np.abs(image), initial=0.0))[1])
        half = np.concatenate([np.ldexp(np.asarray(image, np.float32), exponent), number], axis=-1)
        np.savez(self._file(index), images=to_half(half), exponent=exponent)

    def blend(self, index: int, frame: Frame, image: np.ndarray) -> np.ndarray:
        """The image of the forward pass blended with that of the backward one, which is removed.

        To be called for every frame in order; a frame that was not kept only counts as seen.
        """
        self._seen = update_history_length(self._seen, frame)
        file = self._file(index)
        if not file.is_file():
            return image
        with np.load(file) as there:
            stored, exponent = there["images"].astype(np.float32), int(there["exponent"])
        file.unlink()
        other = np.ldexp(stored[..., :3], -exponent)
        return np.asarray(blend_directions(image, other, np.asarray(self._seen.number), stored[..., 3:]))

    def _file(self, index: int) -> Path:
        return self._folder / f"{index}.npz"


@contextmanager
def backward_pass(
    frames: Iterable[tuple[int, StoredFrame]],
    denoise: Callable[[StoredFrame], np.ndarray],
    wanted: Collection[int],
    folder: Path,
) -> Iterator[BackwardImages]:
    """Denoise frames from the last to the first, and give their images for as long as the block lasts.

    They wait in half precision in a hidden folder below ``folder``, 8 bytes a pixel, which is removed however the block
    ends (of a killed process by the next, :mod:`jaxdn.runtime.scratch`). The memory is that of one frame.

    Args:
      frames: indices and frames, with time turned around (:func:`jaxdn.filters.time_reversal.reverse_time`).
      denoise: the image [H, W, 3] of each frame.
      wanted: indices of the frames whose images are kept; the others are for the history.
      folder: created if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with scratch_folder(folder, HIDDEN) as place:
        images = BackwardImages(place)
        state: HistoryLength | None = None
        for index, stored in frames:
            image = denoise(stored)
            state = update_history_length(state, stored.frame)
            if index in wanted:
                images.keep(index, image, np.asarray(state.number))
        yield images
