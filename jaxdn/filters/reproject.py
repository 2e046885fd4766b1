"""The history of every pixel, from the taps of the previous frame that show the same surface.

A plain bilinear warp mixes all four taps. Here each is accepted or rejected, and the accepted ones are renormalised;
where none is, the 3x3 pixels around the target are tried on request (Schied et al. 2017). What is fetched and with
which weights does not depend on the history's values, so that training needs only the adjoint of a weighted sum.
Fetches run by strips: at 720p, fetching the taps of all pixels at once takes twice as long.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.core.frame import Frame
from jaxdn.filters.surface_test import Expected, Guides, expected, guides_of, pack, same_surface, shared, unpack
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.inference_path import alone
from jaxdn.ops.dispatch.row_tiles import by_strips, where_needed
from jaxdn.ops.motion import targets
from jaxdn.ops.warp import cells, differentiable_mean, windows

WEIGHT_MIN = 0.01
"""Minimum sum of accepted bilinear weights that counts as history."""
_STRIP = 5_000
"""Approximate number of pixels in a strip."""


_Position = tuple[jax.Array, jax.Array]
"""x and y [H, W], in pixels."""


class Recalled(NamedTuple):
    """What is left of the history."""

    history: jax.Array
    """[H, W, C] the renormalised mean of the accepted taps; 0 where there is none."""
    valid: jax.Array
    """[H, W, 1] bool."""
    broken: jax.Array
    """How many pixels of the history were not finite or negative."""


def recall(
    history: jax.Array,
    before: Guides,
    frame: Frame,
    first: jax.Array,
    *,
    depth_tolerance: float = 0.02,
    normal_threshold: float = 0.9,
    around: bool = False,
) -> Recalled:
    """Fetch ``history`` [H, W, C] >= 0 of the previous frame at ``p + motion(p)``.

    Args:
      history: pixels with a value that is not finite or negative are no taps.
      before: the guides of the previous frame.
      frame: the current frame; no motion is zero motion.
      first: bool scalar, there is no history.
      depth_tolerance: see :func:`jaxdn.filters.surface_test.expected`.
      normal_threshold: see :func:`jaxdn.filters.surface_test.same_surface`.
      around: see :func:`fetch`.
    """
    wanted = expected(frame, before, depth_tolerance=depth_tolerance)
    before = shared(before, guides_of(frame))
    return fetch(history, before, frame.motion, wanted, first, normal_threshold=normal_threshold, around=around)


def fetch(
    history: jax.Array,
    before: Guides,
    motion: jax.Array | None,
    wanted: Expected,
    first: jax.Array,
    *,
    normal_threshold: float,
    around: bool,
) -> Recalled:
    """The same along any vectors [H, W, 2], for taps that show what is ``wanted``.

    Taps outside the image are rejected; where the vector is not finite there is no history; no gradient flows into the
    vectors. With ``around``, a pixel all of whose taps are rejected gets the mean of those among the 3x3 pixels around
    its target that are accepted.
    """
    x, y, inside = _targets(history, motion, first)
    given = _Given(history, before, (x, y), inside, wanted)
    plain = functools.partial(_found, _Rules(motion is not None, normal_threshold, around))
    if numba_call.available() and history.dtype == jnp.float32:
        found = alone(plain, functools.partial(_found_by_compiled, *plain.args))(given)
    else:
        found = plain(given)
    mean, valid, unsound = found
    return Recalled(mean, valid[..., None], jnp.where(first, 0, unsound))


class _Rules(NamedTuple):
    """How taps are chosen."""

    moving: bool
    normal_threshold: float
    around: bool


class _Given(NamedTuple):
    """What they are chosen from."""

    history: jax.Array
    """[H, W, C]."""
    before: Guides
    at: _Position
    inside: jax.Array
    """[H, W] bool, the target is in the image."""
    wanted: Expected


_Found = tuple[jax.Array, jax.Array, jax.Array]
"""The mean [H, W, C] of the accepted taps; bool [H, W], whether there is one; int32, pixels that are not sound."""


def _found(rules: _Rules, given: _Given) -> _Found:
    history, before, at, inside, wanted = given
    sound = jnp.all(jnp.isfinite(history) & (history >= 0), axis=-1, keepdims=True)
    history = jnp.where(sound, history, 0.0)
    packed = lax.stop_gradient(pack(jnp.concatenate([history, sound.astype(history.dtype)], axis=-1), before))

    def accepted(tap: jax.Array, wanted: Expected) -> jax.Array:
        whole, guides = unpack(tap, before)
        return (whole[..., -1] > 0) & same_surface(guides, wanted, normal_threshold=rules.normal_threshold)

    if rules.moving:
        mean, valid = _of_cells(history, packed, at, inside, wanted, accepted)
    else:
        valid = inside & accepted(packed, wanted)
        mean = jnp.where(valid[..., None], history, 0.0)
    if rules.around:
        lost = inside & ~valid
        search = history, packed, lost, wanted, accepted
        more, found = _around(at, *search) if rules.moving else _beside(*search)
        mean, valid = jnp.where(found[..., None], more, mean), valid | found
    return mean, valid, jnp.sum(~sound, dtype=jnp.int32)


def _found_by_compiled(rules: _Rules, given: _Given) -> _Found:
    from jaxdn.filters.numba_reproject import fetched

    history, before, at, inside, wanted = given
    tested = before._replace(
        depth=None if wanted.depth is None or wanted.tolerance is None else before.depth,
        normal=None if wanted.normal is None else before.normal,
        ids=None if wanted.ids is None else before.ids,
    )
    arrays = [history, *tested, *at, inside, wanted.depth, wanted.tolerance, wanted.normal, wanted.ids]
    lanes = tuple(range(history.shape[2]))
    numbers = np.float32(rules.normal_threshold), np.float32(WEIGHT_MIN), rules.around, lanes
    size = history.shape[:2]
    mean, valid, unsound = numba_call.call(fetched, [history.shape, size, size[:1]], arrays, *numbers, rows=size[0])
    return mean, valid > 0, jnp.sum(unsound.astype(jnp.int32), dtype=jnp.int32)


def _targets(history: jax.Array, motion: jax.Array | None, first: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Where every pixel's history is: positions x and y [H, W] within the image, and bool [H, W], whether it has one.

    Less than a pixel outside there are taps of the outermost pixels alone, as at their centres.
    """
    height, width, _ = history.shape
    vector = jnp.zeros((height, width, 2), history.dtype) if motion is None else lax.stop_gradient(motion)
    known = jnp.all(jnp.isfinite(vector), axis=-1)
    x, y = targets(jnp.where(known[..., None], vector, 0.0))
    inside = known & (x > -1) & (x < width) & (y > -1) & (y < height) & ~first
    return jnp.clip(x, 0, width - 1), jnp.clip(y, 0, height - 1), inside


_Accepted = Callable[[jax.Array, Expected], jax.Array]
"""(tap [..., C], what it must show [...]) -> bool [...]."""


def _of_cells(
    history: jax.Array,
    packed: jax.Array,
    at: _Position,
    inside: jax.Array,
    wanted: Expected,
    accepted: _Accepted,
) -> tuple[jax.Array, jax.Array]:
    """The mean [H, W, C] of the accepted taps of each target's cell, and bool [H, W], whether there is one."""
    cell = cells(*at, *history.shape[:2])

    def strip(part: tuple[tuple[jax.Array, ...], jax.Array, Expected]) -> tuple[jax.Array, jax.Array, jax.Array]:
        (left, top, fx, fy), inside, wanted = part
        taps = windows(packed, top, left, 2)
        shares = ((wy * wx)[..., 0] for wy in (1 - fy, fy) for wx in (1 - fx, fx))
        weights = [
            jnp.where(inside & accepted(taps[..., index, :], wanted), share, 0.0) for index, share in enumerate(shares)
        ]
        return _mean(taps, weights, history.shape[-1], least=WEIGHT_MIN)

    # The weights are for the gradient; where none is taken, they are not computed.
    mean, valid, weights = by_strips(strip, (cell, inside, wanted), pixels=_STRIP)
    return differentiable_mean(mean, history, cell[1], cell[0], weights), valid


def _around(
    at: _Position,
    history: jax.Array,
    packed: jax.Array,
    lost: jax.Array,
    wanted: Expected,
    accepted: _Accepted,
) -> tuple[jax.Array, jax.Array]:
    """The same for ``lost`` pixels alone, of the 3x3 pixels around their targets, which count alike."""
    height, width, channels = history.shape
    column, row = (jnp.floor(position + 0.5).astype(jnp.int32) for position in at)
    # At the border the window lies inside the image, and the pixels of it that are too far away do not count.
    top, left = jnp.clip(row - 1, 0, max(height - 3, 0)), jnp.clip(column - 1, 0, max(width - 3, 0))

    def search(part: tuple[tuple[jax.Array, ...], Expected]) -> tuple[jax.Array, jax.Array, jax.Array]:
        (row, column, top, left), wanted = part
        taps = windows(packed, top, left, 3)
        weights = []
        for index, (dy, dx) in enumerate(np.ndindex(3, 3)):
            y, x = top + dy, left + dx
            near = (jnp.abs(y - row) <= 1) & (jnp.abs(x - column) <= 1) & (y < height) & (x < width)
            weights.append((near & accepted(taps[..., index, :], wanted)).astype(history.dtype))
        return _mean(taps, weights, channels, least=1.0)

    mean, found, weights = where_needed(search, lost, ((row, column, top, left), wanted))
    return differentiable_mean(mean, history, top, left, weights), found


def _beside(
    history: jax.Array, packed: jax.Array, lost: jax.Array, wanted: Expected, accepted: _Accepted
) -> tuple[jax.Array, jax.Array]:
    """The same where nothing moves: around the pixels themselves, without a gather."""
    height, width, _ = history.shape

    def shifted(image: jax.Array, dy: int, dx: int) -> jax.Array:
        wide = jnp.pad(image, ((1, 1), (1, 1), (0, 0)))
        return wide[dy : dy + height, dx : dx + width]

    def search(history: jax.Array) -> tuple[jax.Array, jax.Array]:
        total, count = jnp.zeros_like(history), jnp.zeros((height, width), history.dtype)
        for dy, dx in np.ndindex(3, 3):  # beyond the border there are zeros, which are not accepted
            taken = lost & accepted(shifted(packed, dy, dx), wanted)
            total = total + jnp.where(taken[..., None], shifted(history, dy, dx), 0.0)
            count = count + taken
        found = count > 0
        return total / jnp.where(found, count, 1.0)[..., None], found

    def nothing(history: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros_like(history), jnp.zeros((height, width), bool)

    return lax.cond(jnp.any(lost), search, nothing, history)


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
