"""Temporal reprojection: the history of every pixel, from the taps of the previous frame that show the same surface.

A plain bilinear warp mixes all four taps. Here each is accepted or rejected, and the accepted ones are renormalised;
where none is, the 3x3 pixels around the target are tried on request (Schied et al. 2017). What is fetched and with
which weights does not depend on the history's values, so that training needs only the adjoint of a weighted sum.
Fetches run by tiles: at 720p, fetching the taps of all pixels at once takes twice as long.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.core.frame import Frame
from jaxdn.filters.surface_test import (
    ExpectedSurface,
    Guides,
    expect_surface,
    guides_of,
    keep_shared,
    pack,
    same_surface,
    unpack,
)
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.dispatch.row_tiles import evaluate_sparsely, map_row_tiles
from jaxdn.ops.motion import find_targets
from jaxdn.ops.warp import attach_mean_gradient, gather_windows, locate_cells

if TYPE_CHECKING:
    from jaxtyping import Array, Bool, Float, Int

WEIGHT_MIN = 0.01
"""Minimum sum of accepted bilinear weights that counts as history."""
_TILE_PIXELS = 5_000
"""Approximate number of pixels in a tile."""


_Position = tuple[jax.Array, jax.Array]
"""x and y [H, W], in pixels."""


class Reprojection(NamedTuple):
    """The history where it is now; no history where its surface was not visible before."""

    history: Float[Array, "H W C"]
    """[H, W, C] the renormalised mean of the accepted taps; 0 where there is none."""
    valid: Bool[Array, "H W 1"]
    """[H, W, 1] bool."""
    invalid: Int[Array, ""]
    """How many pixels of the history were not finite or negative."""


def reproject(
    history: Float[Array, "H W C"],
    before: Guides,
    frame: Frame,
    first: Bool[Array, ""],
    *,
    depth_tolerance: float = 0.02,
    normal_threshold: float = 0.9,
    search_neighbours: bool = False,
    implementation: str | None = None,
) -> Reprojection:
    """Fetch ``history`` [H, W, C] >= 0 of the previous frame at ``p + motion(p)``, from taps of the same surface.

    Of the four taps of a bilinear fetch, those that show another id, depth or normal are left out, and the weights of
    the others are renormalised (Schied et al. 2017).

    Args:
      history: pixels with a value that is not finite or negative are no taps.
      before: the guides of the previous frame.
      frame: the current frame; no motion is zero motion.
      first: bool scalar, there is no history.
      depth_tolerance: see :func:`jaxdn.filters.surface_test.expect_surface`.
      normal_threshold: see :func:`jaxdn.filters.surface_test.same_surface`.
      search_neighbours: see :func:`reproject_along`.
      implementation: "reference" or "numba"; None is the fastest.
    """
    expected = expect_surface(frame, before, depth_tolerance=depth_tolerance)
    before = keep_shared(before, guides_of(frame))
    return reproject_along(
        history,
        before,
        frame.motion,
        expected,
        first,
        normal_threshold=normal_threshold,
        search_neighbours=search_neighbours,
        implementation=implementation,
    )


def reproject_along(
    history: jax.Array,
    before: Guides,
    motion: jax.Array | None,
    expected: ExpectedSurface,
    first: jax.Array,
    *,
    normal_threshold: float,
    search_neighbours: bool,
    implementation: str | None = None,
) -> Reprojection:
    """The same along any vectors [H, W, 2], for taps that show what is ``expected``.

    Taps outside the image are rejected; where the vector is not finite there is no history; no gradient flows into the
    vectors. With ``search_neighbours``, a pixel all of whose taps are rejected gets the mean of the accepted ones among
    the 3x3 pixels around its target.
    """
    x, y, inside = _find_targets(history, motion, first)
    rules = _Rules(motion is not None, normal_threshold, search_neighbours)
    mean, valid, invalid = _average_taps(
        _Request(history, before, (x, y), inside, expected), rules=rules, implementation=implementation
    )
    return Reprojection(mean, valid[..., None], jnp.where(first, 0, invalid))


class _Rules(NamedTuple):
    """How taps are chosen."""

    moving: bool
    normal_threshold: float
    search_neighbours: bool


class _Request(NamedTuple):
    """What they are chosen from."""

    history: jax.Array
    """[H, W, C]."""
    before: Guides
    at: _Position
    inside: jax.Array
    """[H, W] bool, the target is in the image."""
    expected: ExpectedSurface


_Output = tuple[jax.Array, jax.Array, jax.Array]
"""The mean [H, W, C] of the accepted taps; bool [H, W], whether there is one; int32, pixels that are not sound."""


@operation(name="reproject")
def _average_taps(given: _Request, *, rules: _Rules) -> _Output:
    """The mean of each target's accepted taps [H, W, C], where there is one [H, W], and how many pixels are invalid."""
    history, before, at, inside, expected = given
    valid_history = jnp.all(jnp.isfinite(history) & (history >= 0), axis=-1, keepdims=True)
    history = jnp.where(valid_history, history, 0.0)
    packed = lax.stop_gradient(pack(jnp.concatenate([history, valid_history.astype(history.dtype)], axis=-1), before))

    def accepted(tap: jax.Array, expected: ExpectedSurface) -> jax.Array:
        whole, guides = unpack(tap, before)
        return (whole[..., -1] > 0) & same_surface(guides, expected, normal_threshold=rules.normal_threshold)

    if rules.moving:
        mean, valid = _average_cells(history, packed, at, inside, expected, accepted)
    else:
        valid = inside & accepted(packed, expected)
        mean = jnp.where(valid[..., None], history, 0.0)
    if rules.search_neighbours:
        missing = inside & ~valid
        search = history, packed, missing, expected, accepted
        more, found = _search_target(at, *search) if rules.moving else _search_pixel(*search)
        mean, valid = jnp.where(found[..., None], more, mean), valid | found
    return mean, valid, jnp.sum(~valid_history, dtype=jnp.int32)


@numba_call.implements(_average_taps)
def _average_taps_by_numba(given: _Request, *, rules: _Rules) -> _Output:
    from jaxdn.filters.numba_reproject import reproject

    history, before, at, inside, expected = given
    tested = before._replace(
        depth=None if expected.depth is None or expected.tolerance is None else before.depth,
        normal=None if expected.normal is None else before.normal,
        ids=None if expected.ids is None else before.ids,
    )
    arrays = [history, *tested, *at, inside, expected.depth, expected.tolerance, expected.normal, expected.ids]
    lanes = tuple(range(history.shape[2]))
    numbers = np.float32(rules.normal_threshold), np.float32(WEIGHT_MIN), rules.search_neighbours, lanes
    size = history.shape[:2]
    mean, valid, invalid = numba_call.call(reproject, [history.shape, size, size[:1]], arrays, *numbers, rows=size[0])
    return mean, valid > 0, jnp.sum(invalid.astype(jnp.int32), dtype=jnp.int32)


def _find_targets(
    history: jax.Array, motion: jax.Array | None, first: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where every pixel's history is: positions x and y [H, W] within the image, and bool [H, W], whether it has one.

    Less than a pixel outside there are taps of the outermost pixels alone, as at their centres.
    """
    height, width, _ = history.shape
    vector = jnp.zeros((height, width, 2), history.dtype) if motion is None else lax.stop_gradient(motion)
    known = jnp.all(jnp.isfinite(vector), axis=-1)
    x, y = find_targets(jnp.where(known[..., None], vector, 0.0))
    inside = known & (x > -1) & (x < width) & (y > -1) & (y < height) & ~first
    return jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1), inside


_Accepted = Callable[[jax.Array, ExpectedSurface], jax.Array]
"""(tap [..., C], what it must show [...]) -> bool [...]."""


def _average_cells(
    history: jax.Array,
    packed: jax.Array,
    at: _Position,
    inside: jax.Array,
    expected: ExpectedSurface,
    accepted: _Accepted,
) -> tuple[jax.Array, jax.Array]:
    """The mean [H, W, C] of the accepted taps of each target's cell, and bool [H, W], whether there is one."""
    cell = locate_cells(*at, *history.shape[:2])

    def tile(part: tuple[tuple[jax.Array, ...], jax.Array, ExpectedSurface]) -> tuple[jax.Array, jax.Array, jax.Array]:
        (left, top, fx, fy), inside, expected = part
        taps = gather_windows(packed, top, left, 2)
        shares = ((wy * wx)[..., 0] for wy in (1 - fy, fy) for wx in (1 - fx, fx))
        weights = [
            jnp.where(inside & accepted(taps[..., index, :], expected), share, 0.0)
            for index, share in enumerate(shares)
        ]
        return _mean(taps, weights, history.shape[-1], least=WEIGHT_MIN)

    # The weights are for the gradient; where none is taken, they are not computed.
    mean, valid, weights = map_row_tiles(tile, (cell, inside, expected), pixels=_TILE_PIXELS)
    return attach_mean_gradient(mean, history, cell[1], cell[0], weights), valid


def _search_target(
    at: _Position,
    history: jax.Array,
    packed: jax.Array,
    missing: jax.Array,
    expected: ExpectedSurface,
    accepted: _Accepted,
) -> tuple[jax.Array, jax.Array]:
    """The same for ``missing`` pixels alone, of the 3x3 pixels around their targets, which count alike."""
    height, width, channels = history.shape
    column, row = (jnp.floor(position + 0.5).astype(jnp.int32) for position in at)
    # At the border the window lies inside the image, and the pixels of it that are too far away do not count.
    top, left = jnp.clip(row - 1, 0, max(height - 3, 0)), jnp.clip(column - 1, 0, max(width - 3, 0))

    def search(part: tuple[tuple[jax.Array, ...], ExpectedSurface]) -> tuple[jax.Array, jax.Array, jax.Array]:
        (row, column, top, left), expected = part
        taps = gather_windows(packed, top, left, 3)
        weights = []
        for index, (dy, dx) in enumerate(np.ndindex(3, 3)):
            y, x = top + dy, left + dx
            near = (jnp.abs(y - row) <= 1) & (jnp.abs(x - column) <= 1) & (y < height) & (x < width)
            weights.append((near & accepted(taps[..., index, :], expected)).astype(history.dtype))
        return _mean(taps, weights, channels, least=1.0)

    mean, found, weights = evaluate_sparsely(search, missing, ((row, column, top, left), expected))
    return attach_mean_gradient(mean, history, top, left, weights), found


def _search_pixel(
    history: jax.Array, packed: jax.Array, missing: jax.Array, expected: ExpectedSurface, accepted: _Accepted
) -> tuple[jax.Array, jax.Array]:
    """The same where nothing moves: around the pixels themselves, without a gather."""
    height, width, _ = history.shape

    def shifted(image: jax.Array, dy: int, dx: int) -> jax.Array:
        wide = jnp.pad(image, ((1, 1), (1, 1), (0, 0)))
        return wide[dy : dy + height, dx : dx + width]

    def search(history: jax.Array) -> tuple[jax.Array, jax.Array]:
        total, count = jnp.zeros_like(history), jnp.zeros((height, width), history.dtype)
        for dy, dx in np.ndindex(3, 3):  # beyond the border there are zeros, which are not accepted
            taken = missing & accepted(shifted(packed, dy, dx), expected)
            total = total + jnp.where(taken[..., None], shifted(history, dy, dx), 0.0)
            count = count + taken
        found = count > 0
        return total / jnp.where(found, count, 1.0)[..., None], found

    def nothing(history: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros_like(history), jnp.zeros((height, width), bool)

    return lax.cond(jnp.any(missing), search, nothing, history)


def _mean(
    taps: jax.Array, weights: list[jax.Array], channels: int, *, least: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The weighted mean of the first ``channels`` of taps [..., n, C], whether there is one, and its weights [..., n].

    There is none, but 0, where the n weights [...] sum to less than ``least``.
    """
    total = functools.reduce(jnp.add, weights)
    valid = total >= least
    weights = [jnp.where(valid, weight / jnp.where(valid, total, 1.0), 0.0) for weight in weights]
    parts = [weight[..., None] * taps[..., index, :channels] for index, weight in enumerate(weights)]
    return functools.reduce(jnp.add, parts), valid, jnp.stack(weights, axis=-1)


@_average_taps.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    def draw(*values: float) -> Any:
        return rng.choice(values, (height, width))

    history: Any = rng.random((height, width, 8)) * (rng.random((height, width, 1)) > 0.1)
    history[height // 2, width // 2, 3] = np.nan
    normals: Any = [rng.normal(size=(height, width, 3)).round() for _ in range(2)]
    before = Guides(*(draw(1.0, 3.0)[..., None], normals[0], draw(-1, 0, 1).astype(np.int32)[..., None]))
    expected = ExpectedSurface(draw(1.0, 3.0), draw(0.02, 0.5), normals[1], draw(-1, 0, 1).astype(np.int32))
    rows, columns = np.mgrid[:height, :width]
    x = np.clip(columns + draw(-2.5, -1.0, 0.0, 0.3), 0, width - 1)
    y = np.clip(rows + draw(-2.5, -1.0, 0.0, 0.3), 0, height - 1)
    inside: Any = rng.random((height, width)) > 0.1
    for search_neighbours in (False, True):
        rules = _Rules(moving=True, normal_threshold=0.9, search_neighbours=search_neighbours)
        yield Example((_Request(history, before, (x, y), inside, expected),), {"rules": rules})
