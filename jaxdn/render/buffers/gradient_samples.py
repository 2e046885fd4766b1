"""Gradient samples: a few points of the previous frame, shaded again with the random numbers that they had there.

One pixel of every stratum of 3x3 pixels of the previous frame is carried along with its surface into the current frame,
and its path is traced in both. Where neither light nor surface has changed, both paths are the same and so is their
light: the difference is free of noise (Schied et al. 2018). These are extra paths, one in nine pixels for each
of the two frames; the noisy image itself is left as it is.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxdn.color import LUMINANCE
from jaxdn.render.buffers.frame_pair import FramePair, carry
from jaxdn.render.buffers.geometry import SAME_PLANE, View, compute_relative_poses, is_same_camera, is_unmoved, project
from jaxdn.render.tracing.radiance import ReplayedPaths
from jaxdn.render.tracing.seeds import SampleStream, tea

STRATUM = 3
"""Pixels along one side of a stratum."""
Replay = Callable[..., ReplayedPaths]
""":func:`jaxdn.render.tracing.vectorised_path_tracer.replay`, or that of the scalar path tracer."""


class GradientPoints(NamedTuple):
    """Points of the previous frame, one for each stratum that saw a surface there, and where they are now."""

    pixel: np.ndarray
    """[n] index of the pixel in the previous frame."""
    target: np.ndarray
    """[n, 2] (x, y) in the current frame; pixel centres are at 0.5."""
    position: np.ndarray
    """[n, 3] where the point is in the world of the current frame."""
    depth: np.ndarray
    """[n] view-space z there."""


def compute_luminance_gradient(replay: Replay, frames: FramePair, *, max_depth: int, with_direct: bool) -> np.ndarray:
    """Compute this buffer [H, W, 2]: change of the samples' luminance, and the larger luminance of both frames.

    It is scattered to the pixels that the points have reached, at most one in each stratum, and 0 elsewhere: where
    nothing landed, or something else is seen now. If no sample at all has changed the whole buffer is 0, which is its
    neutral value and means the same.

    Args:
      replay: of the tracer.
      frames: the two frames, and the sample of the previous frame's noisy image that is replayed.
      max_depth: path length.
      with_direct: the noisy image holds all reflected light, not the indirect light alone.
    """
    previous, current = frames.previous, frames.current
    height, width = current.view.gbuffer.ids.shape[:2]
    points = pick_points(previous.view, current.view, frames.noise)
    if not len(points.pixel):
        return np.zeros((height, width, 2), np.float32)
    start = np.stack([points.pixel % width, points.pixel // width], -1) + 0.5
    numbers = frames.noise._replace(frame=frames.noise.frame - 1), frames.sample
    of_light = {"max_depth": max_depth, "with_direct": with_direct}
    old = replay(previous.scene, *numbers, start, points.pixel, **of_light)
    new = replay(current.scene, *numbers, points.target, points.pixel, **of_light)
    # Through the same point the ray hits this point, unless something is in between now.
    seen = np.linalg.norm(new.position - points.position, axis=-1) <= SAME_PLANE * points.depth
    first, second = old.light @ LUMINANCE, new.light @ LUMINANCE
    samples = np.stack([second - first, np.maximum(first, second)], -1)
    return scatter_samples(samples[seen], points.target[seen], points.depth[seen], (height, width))


def pick_points(previous: View, current: View, stream: SampleStream) -> GradientPoints:
    """Pick one pixel of each stratum of the previous frame, at random among those that see a surface.

    Those that are off screen in the current frame, which ``stream`` belongs to, are left out.
    """
    then = previous.gbuffer
    size = then.ids.shape[:2]
    pixel = _pick_in_strata(then.ids[..., 0] >= 0, stream)
    row, column = np.divmod(pixel, size[1])
    motion = compute_relative_poses(then.names, previous.pose, current.pose)[then.ids[row, column, 0]]
    position = carry(motion, then.position[row, column])
    target, depth = project(position, current.camera, size)
    # Rounding must not move what stands still: a ray elsewhere would hit another triangle, texel or edge.
    still = is_unmoved(motion) & is_same_camera(previous.camera, current.camera)
    target = np.where(still[:, None], np.stack([column, row], -1) + 0.5, target)
    with np.errstate(invalid="ignore"):
        inside = np.all((target >= 0) & (target < [size[1], size[0]]), axis=-1)
    return GradientPoints(pixel[inside], target[inside], position[inside], depth[inside, 0])


def _pick_in_strata(surface: np.ndarray, stream: SampleStream) -> np.ndarray:
    """The indices of pixels, one for each stratum of the mask ``surface`` [H, W] that has a true one."""
    height, width = surface.shape
    index = np.arange(height * width, dtype=np.int64)
    score = tea(index, np.full_like(index, tea(stream.frame, stream.seed)[0]))[0].reshape(height, width)
    wide = np.pad(np.where(surface, score, -1), ((0, -height % STRATUM), (0, -width % STRATUM)), constant_values=-1)
    rows, columns = (size // STRATUM for size in wide.shape)
    strata = wide.reshape(rows, STRATUM, columns, STRATUM).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    place = np.argmax(strata, axis=-1)
    row = STRATUM * np.arange(rows)[:, None] + place // STRATUM
    column = STRATUM * np.arange(columns) + place % STRATUM
    return (row * width + column)[strata.max(axis=-1) >= 0]


def scatter_samples(samples: np.ndarray, target: np.ndarray, depth: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Scatter samples [n, 2] to ``target`` [n, 2] of a buffer [H, W, 2]; in each stratum the nearest one is kept.

    All 0 if no sample has changed.
    """
    buffer = np.zeros((*size, 2), np.float32)
    if not np.any(samples[:, 0]):
        return buffer
    column, row = np.floor(target).astype(int).T
    stratum = row // STRATUM * (size[1] // STRATUM + 1) + column // STRATUM
    order = np.lexsort((np.arange(len(depth)), depth, stratum))
    chosen = order[np.unique(stratum[order], return_index=True)[1]]
    buffer[row[chosen], column[chosen]] = samples[chosen]
    return buffer
