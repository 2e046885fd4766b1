"""Motion of frames whose files have no vectors, or vectors of 0 everywhere, though something moves: it is measured.

Blender writes zeros where motion blur is on. Without vectors a history stays where it is, and what moves leaves trails
or has no history. Each frame is compared with the one before it and with nothing else, so that a run that goes
on, and a part of a shot, measure the same.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from jaxdn.core.frame import Frame
from jaxdn.filters.motion_search import Look, measure_motion, see, something_moves

MEASURED = (
    "something moves, and there are no motion vectors, or they are 0: motion is measured from albedo, normals and "
    "depth; shadows, reflections and what is small and fast are not followed, so render vectors, without motion blur, "
    "where that shows (--motion-convention none: as if nothing moved)"
)
"""What is told, once."""


def fill_motion(
    frames: Iterable[Frame], lacks_motion: Callable[[], bool], log: Callable[[str], None]
) -> Iterator[Frame]:
    """The frames, with motion to the one before where there is none and something moves.

    Of frames that come from the last to the first it is the motion to the frame after, as time is turned around then.
    Where nothing moves, or without albedo and normals, frames stay as they are.

    Args:
      frames: consecutive ones.
      lacks_motion: whether vectors are wanted and none were found in the last frame and in those before.
      log: called with :data:`MEASURED`.
    """
    before: Look | None = None
    for frame in frames:
        if not lacks_motion():
            before = None
        else:
            now = see(frame)
            motion = None if before is None or now is None else _measure(before, now, frame.radiance.shape[:2])
            before = now
            if motion is not None:
                log(MEASURED)
                frame = frame._replace(motion=motion)
        yield frame
        del frame  # so that it is not kept while the next one is read


def _measure(before: Look, now: Look, size: tuple[int, ...]) -> np.ndarray | None:
    """The motion [H, W, 2] between two frames; None where nothing moves, or where they show other things."""
    if before.features.shape != now.features.shape or not something_moves(before.features, now.features):
        return None
    motion = np.asarray(measure_motion(before.features, now.features, now.nearness, size=size).motion)
    return motion if motion.any() else None
