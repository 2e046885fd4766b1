"""What depth, normals and vectors tell of each other: which surface hides which, and where normals point."""

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from jaxdn.core.frame import FAR
from jaxdn.evaluation.overlay.evidence import box_mean

Space = Literal["camera", "world", "either world"]
"""Of normals: the camera's, a right-handed world's, or a world's that may be left-handed."""
FEWEST_PAIRS = 24
"""Pairs of a hidden and a hiding pixel below which nothing is said about depth."""
_SAME, _OTHER = 0.04, 0.12
"""Features differ by less where vectors bring a surface onto itself, and by more where it was hidden."""
_APART = 1.05
"""Two surfaces are before each other if their depths have at least this ratio."""
_RADIUS = 2
"""Of the windows in which depth is taken for a plane."""
_PLANE = 0.02
"""What a plane may leave of the depth, as a share of it."""
_EVEN = 0.985
"""Length of the mean normal of a window that shows one direction."""
_FOCAL = (0.6, 1.0, 1.5, 2.2, 3.5)
"""Focal lengths in widths of the picture that are tried: 22 to 126 mm of a film of 36 mm."""
_ALIKE = 0.9
"""Cosine of the angle up to which two normals agree."""
_BINS = 5
"""Directions are told apart by so many steps an axis."""
_FEWEST_OF_ONE = 6
"""Pixels of a direction that counts."""
FEWEST_DIRECTIONS = 8
"""Directions below which the handedness of normals is not told."""
_MOST = 20_000
"""Pixels that are looked at."""
AS_GIVEN, MIRRORED = "as given", "mirrored"
TURNS = {AS_GIVEN: (1, 1), "with x turned": (-1, 1), "with y turned": (1, -1), "with x and y turned": (-1, -1)}
"""What normals of camera space may be, and the factors of x and y."""


def occlusion_order(depth: np.ndarray, motion: np.ndarray, change: np.ndarray, tested: np.ndarray) -> float | None:
    """The share of newly visible pixels that are behind what hid them; None where too few are seen.

    A pixel whose vector leads to another surface was hidden there, by the pixel whose vector leads to the same place
    and finds its own surface. What hides is nearer. Of depth that is right, the share is near 1; of 1 / z, and of any
    other depth that falls with the distance, it is near 0.

    Args:
      depth: [H, W].
      motion: [H, W, 2] previous minus current, in pixels.
      change: [H, W] the mean difference of features that the vectors leave.
      tested: [H, W] bool, where depth and motion are known.
    """
    height, width = depth.shape
    rows, columns = np.mgrid[:height, :width]
    row, column = (np.rint(at + motion[..., axis]).astype(np.int64) for at, axis in ((rows, 1), (columns, 0)))
    seen = tested & (depth < FAR) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    place = np.where(seen, row * width + column, 0)
    hiding = np.full(height * width, np.nan)
    own = seen & (change < _SAME)
    hiding[place[own]] = depth[own]
    hidden = seen & (change > _OTHER)
    ratio = depth[hidden] / hiding[place[hidden]]
    ratio = ratio[np.isfinite(ratio) & ((ratio > _APART) | (ratio < 1 / _APART))]
    return float(np.mean(ratio > 1)) if ratio.size >= FEWEST_PAIRS else None


class NormalsAgainstDepth(NamedTuple):
    """How well normals agree with the slopes of the depth."""

    agree: dict[str, float]
    """AS_GIVEN and what they may be instead -> the share of the directions that agrees."""
    agreeing: float
    """Share of the pixels that agrees, when the best of these is assumed ..."""
    away: float
    """... and that agrees but for the sign: these normals point into the surface."""


def compare_normals(
    normal: np.ndarray, depth: np.ndarray, ids: np.ndarray | None, *, space: Space
) -> NormalsAgainstDepth | None:
    """Normals [H, W, 3] against those that follow from depth [H, W]; None where too few directions are seen.

    The focal length is not known: several are tried, with depth along the axis and along the ray. Every direction
    counts alike, however many pixels show it.

    In camera space, x is right and y is up; z may point ahead or back. In world space the camera's orientation is not
    known. So the rotation is found that brings the given normals onto those of the depth (Kabsch 1976). If the best
    matrix with determinant -1 fits better, the normals are mirrored: one axis, or all three, have the wrong sign. Of a
    world that may be left-handed, both are right.
    """
    solid, slopes = _planes(normal, depth, ids)
    at = np.flatnonzero(solid.ravel())
    at = at[:: 1 + at.size // _MOST]
    given = normal.reshape(-1, 3)[at].astype(np.float64)
    given /= np.maximum(np.linalg.norm(given, axis=-1, keepdims=True), 1e-12)
    number = _directions(given)
    count = np.bincount(number, minlength=_BINS**3)
    if np.count_nonzero(count >= _FEWEST_OF_ONE) < FEWEST_DIRECTIONS:
        return None
    weight = np.where(count[number] >= _FEWEST_OF_ONE, 1 / count[number], 0.0)
    weight /= weight.sum()
    best: dict[str, tuple[float, float, float]] = {}
    for wanted in _depth_normals(slopes, at, depth.shape):
        for name, turned in _candidates(given, wanted, weight, space):
            best[name] = max(best.get(name, (0.0, 0.0, 0.0)), _agreement(wanted, turned, weight))
    return NormalsAgainstDepth({name: share for name, (share, _, _) in best.items()}, *max(best.values())[1:])


def _candidates(
    given: np.ndarray, wanted: np.ndarray, weight: np.ndarray, space: Space
) -> Iterator[tuple[str, np.ndarray]]:
    """What the given normals may be, and the normals if they are."""
    if space == "camera":
        for name, turn in TURNS.items():
            yield from ((name, given * (*turn, ahead)) for ahead in (1, -1))
        return
    for start in (weight, np.full(weight.shape, 1 / weight.size)):
        yield AS_GIVEN, _aligned(given, wanted, start, 1.0)
        yield AS_GIVEN if space == "either world" else MIRRORED, _aligned(given, wanted, start, -1.0)


def _planes(normal: np.ndarray, depth: np.ndarray, ids: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """[H, W] where a window shows one plane, and [H, W, 3] of it 1 / depth and its slopes along x and y (down)."""
    height, width = depth.shape
    hit = (depth < FAR) & (depth > 0) & np.isfinite(normal).all(axis=-1)
    near = np.where(hit, 1 / np.where(hit, depth, 1.0).astype(np.float64), 0.0)
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    moments = [box_mean(each, _RADIUS) for each in (near, columns * near, rows * near, near * near)]
    mean, by_x, by_y, square = moments
    spread = ((2 * _RADIUS + 1) ** 2 - 1) / 12
    along_x, along_y = (by_x - columns * mean) / spread, (by_y - rows * mean) / spread
    left = square - mean**2 - spread * (along_x**2 + along_y**2)
    whole = box_mean(hit.astype(np.float64), _RADIUS) > 1 - 1e-6
    even = np.linalg.norm(box_mean(np.where(hit[..., None], normal, 0.0), _RADIUS), axis=-1)
    length = np.linalg.norm(np.nan_to_num(normal), axis=-1)
    solid = whole & (even > _EVEN * length) & (length > 0.5) & (left < (_PLANE * mean) ** 2)
    if ids is not None:
        label = ids.astype(np.float64)
        solid &= box_mean(label**2, _RADIUS) - box_mean(label, _RADIUS) ** 2 < 1e-6 * (1 + label**2)
    for axis, size in ((0, height), (1, width)):  # windows at the border are cut
        index = np.arange(size).reshape((-1, 1) if axis == 0 else (1, -1))
        solid &= (index >= _RADIUS) & (index < size - _RADIUS)
    return solid, np.stack([mean, along_x, along_y], axis=-1)


def _depth_normals(slopes: np.ndarray, at: np.ndarray, size: tuple[int, ...]) -> list[np.ndarray]:
    """[N, 3] unit normals of the depth, x right, y up, z to the camera, for each focal length and kind of depth.

    With w = 1 / z the plane n P = c is n = (-f dw/dx, -f dw/dy, w - x dw/dx - y dw/dy). Of a depth t along the ray,
    1 / z = sqrt(1 + (x^2 + y^2) / f^2) / t.
    """
    height, width = size
    row, column = np.divmod(at, width)
    x, y = column - (width - 1) / 2, (height - 1) / 2 - row
    near, along_x, along_y = slopes.reshape(-1, 3)[at].T
    along_y = -along_y
    found = []
    for focal in np.multiply(_FOCAL, width):
        longer = np.sqrt(1 + (x**2 + y**2) / focal**2)
        for ray in (False, True):
            w, w_x, w_y = near, along_x, along_y
            if ray:
                w_x = along_x * longer + near * x / (focal**2 * longer)
                w_y = along_y * longer + near * y / (focal**2 * longer)
                w = near * longer
            normals = np.stack([-focal * w_x, -focal * w_y, w - x * w_x - y * w_y], axis=-1)
            found.append(normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30))
    return found


def _directions(normals: np.ndarray) -> np.ndarray:
    """[N] the number of each normal's direction."""
    steps = np.clip(((normals + 1) * 0.5 * _BINS).astype(np.int64), 0, _BINS - 1)
    return steps @ np.array([_BINS**2, _BINS, 1])


def _aligned(given: np.ndarray, wanted: np.ndarray, weight: np.ndarray, determinant: float) -> np.ndarray:
    """The given normals after the matrix of this determinant, 1 or -1, that brings most of them onto the wanted."""
    kept, turned = np.ones(weight.shape), given
    for _ in range(5):
        left, _values, right = np.linalg.svd((wanted * (weight * kept)[:, None]).T @ given)
        last = determinant * np.linalg.det(left @ right)
        turned = given @ (left @ np.diag([1.0, 1.0, last]) @ right).T
        kept = np.clip(np.sum(wanted * turned, axis=-1), 0.05, 1.0) ** 4  # what fits badly counts little
    return turned


def _agreement(wanted: np.ndarray, turned: np.ndarray, weight: np.ndarray) -> tuple[float, float, float]:
    """The share of the directions that agrees; of the pixels, the shares that agree and that point away."""
    cosine = np.sum(wanted * turned, axis=-1)
    alike = cosine > _ALIKE
    return float(np.sum(weight * alike)), float(np.mean(alike)), float(np.mean(cosine < -_ALIKE))
