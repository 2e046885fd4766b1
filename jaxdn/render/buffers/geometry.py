"""Motion vectors, visibility and previous depths from G-buffers, cameras and poses. NumPy only.

All in float64: a vector is the difference of two projections, each hundreds of pixels large. Pixel coordinates here
have the centre of the first pixel at (0.5, 0.5) and y down; vectors are previous minus current, so the history of pixel
``p`` lies at ``p + motion(p)``.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxdn.core.frame import FAR
from jaxdn.render.buffers.gbuffer import GBuffer
from jaxdn.render.scenes.scene import Camera

SAME_NORMAL = 0.9
"""Minimum cosine between normals of the same surface."""
SAME_PLANE = 0.005
"""Maximum distance from the surface's plane, as a fraction of the depth."""
_BEHIND = 1e-6


class View(NamedTuple):
    """The geometry of one frame."""

    gbuffer: GBuffer
    camera: Camera
    pose: Mapping[str, np.ndarray]


class Motion(NamedTuple):
    """The image motion between two frames; see :class:`jaxdn.Frame`."""

    motion: np.ndarray
    """[H, W, 2] float64 px, previous minus current; NaN where the point was behind the previous camera."""
    forward_motion: np.ndarray | None
    """[H, W, 2] float64 px, on the previous frame's pixels: their points' displacement, current minus previous."""
    visible: np.ndarray | None
    """[H, W, 1] bool, the point was seen in the previous frame."""
    previous_depth: np.ndarray
    """[H, W, 1] float32 view-space z of the point in the previous frame, ``FAR`` for the sky."""


def project(points: np.ndarray, camera: Camera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """World points [..., 3], or homogeneous [..., 4], to pixels [..., 2] and view-space z [..., 1].

    A homogeneous coordinate of 0 makes a direction at infinity. Mitsuba's camera looks along +z with +x to the left:
    ``u = 1/2 - cot(fov/2)/2 x/z``, ``v = 1/2 - (W/H) cot(fov/2)/2 y/z``. Pixels are NaN where z <= 1e-6, behind the
    camera. ``size`` is (height, width).
    """
    height, width = size
    inverse = np.linalg.inv(np.asarray(camera.to_world, np.float64))
    planes = _to_planes(points)
    local = inverse[:3, : len(planes)] @ planes.reshape(len(planes), -1)
    if len(planes) == 3:
        local += inverse[:3, 3:]
    local = local.reshape(3, *points.shape[:-1])
    z = local[2]
    scale = 0.5 * width / np.tan(np.radians(camera.x_fov) / 2)
    with np.errstate(invalid="ignore"):
        pixels = -scale * local[:2] / np.where(z > _BEHIND, z, np.nan)
    pixels[0] += width / 2
    pixels[1] += height / 2
    return np.moveaxis(pixels, 0, -1), z[..., None]


def compute_relative_poses(
    names: tuple[str, ...], start: Mapping[str, np.ndarray], end: Mapping[str, np.ndarray]
) -> np.ndarray:
    """[N + 1, 4, 4] motions that carry a point of each shape from pose ``start`` to pose ``end``.

    Exactly the identity for a shape whose pose is the same or absent, and, as the last entry (id -1), for the sky.
    """
    motions = np.tile(np.eye(4), (len(names) + 1, 1, 1))
    for index, name in enumerate(names):
        if (name in start) != (name in end):
            raise ValueError(f"pose: shape {name!r} has a pose in one frame but not in the next.")
        if name in start and not np.array_equal(start[name], end[name]):
            motions[index] = np.asarray(end[name], np.float64) @ np.linalg.inv(np.asarray(start[name], np.float64))
    return motions


def compute_motion(current: View, previous: View, *, disocclusion: bool = True) -> Motion:
    """Compute the motion of the current frame's pixels into the previous frame, and the other way round.

    Without ``disocclusion`` the latter, and what was visible, are not computed and None.

    Traditional motion is ``P'(T^-1 X) - P(X)`` (X the world position, T the shape's rigid motion, P and P' the two
    projections), and for the sky the projections of its direction: it rotates with the camera and has no translation.
    Where neither camera nor shape moved it is exactly 0.

    A point counts as seen before if the *nearest* pixel of the previous frame shows the same shape, with normals within
    ``SAME_NORMAL`` and within ``SAME_PLANE`` of z of the point's plane. Where that pixel is sky while the point is not,
    nothing can have covered it, so a match in any of the four surrounding pixels is enough.
    Raises ValueError if the two frames differ in size or shapes.
    """
    now, before = current.gbuffer, previous.gbuffer
    if now.names != before.names or now.ids.shape != before.ids.shape:
        raise ValueError("motion: expected two frames of one size with the same shapes; none may appear or disappear.")
    size = now.ids.shape[:2]
    back = _find_moves(now, compute_relative_poses(now.names, current.pose, previous.pose))
    fixed = is_same_camera(current.camera, previous.camera)

    points = _make_homogeneous(now)
    old_points = _carry(points, back)
    target, z = project(old_points, previous.camera, size)
    motion = target - project(points, current.camera, size)[0]
    if fixed:
        motion[_find_still(size, back)] = 0.0
    sky = now.ids < 0
    previous_depth = np.where(sky, FAR, np.maximum(z, 0.0)).astype(np.float32)
    if not disocclusion:
        return Motion(motion, None, None, previous_depth)

    there = _find_moves(before, compute_relative_poses(now.names, previous.pose, current.pose))
    old_surface = _make_homogeneous(before)
    moved, _ = project(_carry(old_surface, there), current.camera, size)
    forward = moved - project(old_surface, previous.camera, size)[0]
    if fixed:
        forward[_find_still(size, there)] = 0.0

    normals = _carry(now.normal.astype(np.float64), back)
    return Motion(motion, forward, _find_visible(now, before, motion, old_points, normals, z), previous_depth)


def _find_visible(
    now: GBuffer, before: GBuffer, motion: np.ndarray, points: np.ndarray, normals: np.ndarray, z: np.ndarray
) -> np.ndarray:
    """[H, W, 1] bool, the points that the previous frame shows.

    ``points`` and what follows are as in :func:`_compare_surfaces`.
    """
    size, sky = now.ids.shape[:2], now.ids < 0
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    shown = (now.ids, points, normals / np.where(lengths > 0, lengths, 1.0), z)
    # In float32 from the pixel index: this must be the same pixel as the stored vector gives.
    pixels = np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), axis=-1).astype(np.float32)
    landing = pixels + motion.astype(np.float32) + np.float32(0.5)
    # The image's border belongs to the outermost pixel.
    tap = np.where(landing == [size[1], size[0]], landing - 1, np.floor(landing))
    seen, nearest = _compare_surfaces(before, tap, *shown)
    on_sky = ((nearest == -1) & ~sky)[..., 0]
    of_those = [each[on_sky] for each in shown]
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
        tap = np.floor(landing[on_sky] - np.float32(0.5)) + corner
        seen[on_sky] |= _compare_surfaces(before, tap, *of_those)[0]
    return seen


class _Moves(NamedTuple):
    """The motion of what some pixels show, the identity for all others."""

    pixels: np.ndarray
    """[n] flat indices of the pixels that show something that moves."""
    motions: np.ndarray
    """[n, 4, 4]"""


def _find_moves(gbuffer: GBuffer, motions: np.ndarray) -> _Moves:
    """The motion of what every pixel shows, from those of the shapes.

    An image in mirrors with the reflections M = M_1 ... M_k moves by ``M' T M^-1``, where T is the motion of the thing
    and M' are the reflections at the moved mirrors, ``B M_i B^-1`` with the mirror's motion B.
    """
    images, shapes = gbuffer.replaced, gbuffer.ids.reshape(-1)
    moves = ~is_unmoved(motions)
    if images is None:
        pixels = np.flatnonzero(moves[shapes])
        return _Moves(pixels, motions[shapes[pixels]])
    moved = moves[images.shapes] | np.any(moves[images.mirrors], axis=-1)
    now = then = np.broadcast_to(np.eye(4), (int(moved.sum()), 4, 4))
    for index in range(images.mirrors.shape[1]):
        plane, motion = images.planes[moved, index], motions[images.mirrors[moved, index]]
        now, then = now @ plane, then @ motion @ plane @ np.linalg.inv(motion)
    whole = then @ motions[images.shapes[moved]] @ np.linalg.inv(now)
    plain = np.ones(len(shapes), bool)
    plain[images.pixels] = False
    pixels = np.flatnonzero(plain)
    pixels = pixels[moves[shapes[pixels]]]
    return _Moves(np.concatenate([pixels, images.pixels[moved]]), np.concatenate([motions[shapes[pixels]], whole]))


def _carry(points: np.ndarray, moves: _Moves) -> np.ndarray:
    """Homogeneous points [H, W, 4], or directions [H, W, 3], of all pixels after their motion."""
    found = points.copy()
    row, column = np.unravel_index(moves.pixels, points.shape[:2])
    size = points.shape[-1]
    found[row, column] = np.einsum("nij,nj->ni", moves.motions[:, :size, :size], points[row, column])
    return found


def _find_still(size: tuple[int, int], moves: _Moves) -> np.ndarray:
    """[H, W] bool, the pixels that show nothing that moves."""
    found = np.ones(size, bool)
    found.reshape(-1)[moves.pixels] = False
    return found


def compute_ray_length(view: View) -> np.ndarray:
    """[H, W, 1] float32 length of the camera rays up to the surfaces, ``FAR`` on a miss."""
    camera = np.asarray(view.camera.to_world, np.float64)[:3, 3]
    length = np.linalg.norm(view.gbuffer.position - camera, axis=-1, keepdims=True)
    return np.where(view.gbuffer.ids >= 0, length, FAR).astype(np.float32)


def compute_far_motion(current: View, previous: View) -> np.ndarray:
    """[H, W, 2] float64 px, motion as in :func:`compute_motion` of what is infinitely far away in every pixel.

    It turns with the camera and does not move with it; NaN where the direction was behind the previous camera.
    """
    direction = current.gbuffer.direction
    size = direction.shape[:2]
    if is_same_camera(current.camera, previous.camera):
        return np.zeros((*size, 2))
    points = np.concatenate([direction, np.zeros((*size, 1))], axis=-1)
    return project(points, previous.camera, size)[0] - project(points, current.camera, size)[0]


def is_same_camera(first: Camera, second: Camera) -> bool:
    """Whether two cameras see exactly the same."""
    return first.x_fov == second.x_fov and np.array_equal(first.to_world, second.to_world)


def is_unmoved(motions: np.ndarray) -> np.ndarray:
    """Whether each of the motions [..., 4, 4] is none: [...] bool."""
    return np.all(motions == np.eye(4), axis=(-2, -1))


def _to_planes(points: np.ndarray) -> np.ndarray:
    """Points [..., C] as planes [C, ...]: as they lie in memory if they are those of a G-buffer."""
    return np.moveaxis(points, -1, 0)


def _make_homogeneous(gbuffer: GBuffer) -> np.ndarray:
    """World positions with 1, directions of the sky with 0: [H, W, 4] float64."""
    surface = gbuffer.ids[..., 0] >= 0
    planes = np.empty((4, *surface.shape))
    planes[:3] = np.where(surface, _to_planes(gbuffer.position), _to_planes(gbuffer.direction))
    planes[3] = surface
    return np.moveaxis(planes, 0, -1)


def _compare_surfaces(
    before: GBuffer, tap: np.ndarray, ids: np.ndarray, points: np.ndarray, normals: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether the previous frame's pixel ``tap`` shows the same point [..., 1], and the id it shows (-2: none).

    Args:
      before: G-buffer of the previous frame.
      tap: [..., 2] (column, row) in the previous frame.
      ids: [..., 1] of the current points.
      points: [..., 4] the current points in the previous frame's world.
      normals: [..., 3] the current normals there.
      z: [..., 1] view-space depths of the points in the previous frame.
    """
    height, width = before.ids.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (tap >= 0) & (tap <= [width - 1, height - 1])
    inside = np.all(inside, axis=-1, keepdims=True)
    column, row = np.moveaxis(np.where(inside, tap, 0.0).astype(int), -1, 0)
    there = np.where(inside, before.ids[row, column], -2)
    cosine = np.sum(normals * before.normal[row, column], axis=-1, keepdims=True)
    offset = np.sum(normals * (points[..., :3] - before.position[row, column]), axis=-1, keepdims=True)
    same_surface = (cosine > SAME_NORMAL) & (np.abs(offset) <= SAME_PLANE * z)
    return (there == ids) & (same_surface | (ids < 0)), there
