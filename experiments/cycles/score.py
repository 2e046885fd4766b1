"""Errors of denoised frames against references of two halves: what is measured has none of the references' own noise.

All errors are of c(x) = x / (1 + x). A reference has two halves A and B, whose noise is independent of each other and
of the image I. The square of its error is measured as

    2 (c(I) - c((A + B) / 2))^2 - ((c(I) - c(A))^2 + (c(I) - c(B))^2) / 2:

the halves have twice the noise of their mean, so that what noise adds cancels, and so does to first order what the
curve makes of it (Quenouille's jackknife, 1956; as :func:`jaxdn.color.tonemap_halves`). Of a clip's frames the squares
are averaged first, then in decibels.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.cycles.reference import Reference, compress, decibels
from jaxdn import color
from jaxdn.metrics import flip
from jaxdn.ops.warp import warp

EDGE_SHARE = 0.1
"""Share of the pixels of a frame that are called edges: those whose guides differ most from their neighbours'."""
CHANGED = 0.1
"""A pixel is in a trail where its light is by so much of itself another than that of the same point in the frame
before: a shadow or a highlight came, or went."""
ALIKE = 0.05
"""A point is the same where its albedo, and the logarithm of its depth, differ by at most that much."""


class Scored(NamedTuple):
    """Mean squares over the scored frames of a clip; NaN where there is nothing to measure."""

    error: float
    edges: float
    """The error at edges."""
    inside: float
    """The error elsewhere."""
    temporal: float
    """The error of the change between two frames, at the same pixel."""
    trail: float
    """The error in pixels whose light has just changed (:data:`CHANGED`)."""
    flip: float
    """The mean of FLIP of the tone-mapped images, against the mean of both halves: the reference's noise is in it."""

    def figures(self) -> dict[str, float | None]:
        """By name, rounded: PSNR of all squares in decibels; None where there is nothing to measure."""
        found: dict[str, float | None] = {
            name: None if np.isnan(value) else round(decibels(value), 3)
            for name, value in self._asdict().items()
            if name != "flip"
        }
        return {"psnr": found.pop("error"), **found, "flip": round(self.flip, 5)}


def score(images: Sequence[np.ndarray], references: Sequence[Reference], motion: Sequence[np.ndarray | None]) -> Scored:
    """The errors of images [H, W, 3] of consecutive pairs of frames, in linear light.

    Args:
      images: an even number, of the frames t, t + 1, then s, s + 1 ...
      references: of the same frames.
      motion: [H, W, 2] vectors of each frame, in pixels; None where they are not known: no trail is measured.
    """
    if len(images) % 2 or not len(images) == len(references) == len(motion):
        raise ValueError(
            f"expected pairs of frames, their references and vectors, got {len(images)}, {len(references)} and "
            f"{len(motion)}"
        )
    squares, edges, trails, temporal, flips = [], [], [], [], []
    for first in range(0, len(images), 2):
        pair = [_errors(images[index], references[index]) for index in (first, first + 1)]
        squares += [np.mean(_square(errors), axis=-1) for errors in pair]
        temporal.append(np.mean(_square(pair[1] - pair[0])))
        edges += [find_edges(references[index].guides) for index in (first, first + 1)]
        flips += [_flip(images[index], references[index].image) for index in (first, first + 1)]
        trails.append(squares[-1][find_changed(references[first], references[first + 1], motion[first + 1])])
    errors, at_edges, trail = np.stack(squares), np.stack(edges), np.concatenate(trails)
    inside = float(errors[~at_edges].mean())
    ends = float(errors[at_edges].mean()) if at_edges.any() else np.nan
    return Scored(
        float(errors.mean()),
        ends,
        inside,
        float(np.mean(temporal)),
        float(trail.mean()) if trail.size >= 100 else np.nan,
        float(np.mean(flips)),
    )


def _errors(image: np.ndarray, reference: Reference) -> np.ndarray:
    """[3, H, W, 3] the errors against the mean of both halves, and against each."""
    against = compress(reference.image), compress(reference.first), compress(reference.second)
    return np.asarray(compress(image) - np.stack(against))


def _square(errors: np.ndarray) -> np.ndarray:
    """The square of the error [3, ...] against what the halves converge to; it may be negative."""
    both, first, second = errors
    return np.asarray(2 * both**2 - (first**2 + second**2) / 2)


def find_edges(guides: np.ndarray) -> np.ndarray:
    """[H, W] bool: the :data:`EDGE_SHARE` of the pixels whose albedo, normal and depth [H, W, 7] differ most around."""
    albedo, normal, depth = np.minimum(guides[..., :3], 1.0), guides[..., 3:6], guides[..., 6:]
    features = np.concatenate([albedo, normal, np.log1p(np.maximum(depth, 0.0))], axis=-1)
    padded = np.pad(features, ((1, 1), (1, 1), (0, 0)), mode="edge")
    across = padded[1:-1, 2:] - padded[1:-1, :-2]
    down = padded[2:, 1:-1] - padded[:-2, 1:-1]
    size = np.sqrt(np.sum(across**2 + down**2, axis=-1))
    least = np.quantile(size, 1 - EDGE_SHARE)
    return (size >= least) & (size > 0)


def find_changed(before: Reference, now: Reference, motion: np.ndarray | None) -> np.ndarray:
    """[H, W] bool: points that both frames show, in another light. Without vectors [H, W, 2] none are known."""
    if motion is None:
        return np.zeros(now.image.shape[:2], bool)
    then = np.asarray(warp(jnp.asarray(np.concatenate([before.image, before.guides], axis=-1)), jnp.asarray(motion)))
    albedo, depth = then[..., 3:6], then[..., 9]
    same = np.max(np.abs(albedo - now.guides[..., :3]), axis=-1) <= ALIKE
    same &= np.abs(np.log(np.maximum(depth, 1e-6) / np.maximum(now.guides[..., 6], 1e-6))) <= ALIKE
    light, old = now.image.mean(axis=-1), then[..., :3].mean(axis=-1)
    return same & (np.abs(light - old) > CHANGED * np.maximum(np.maximum(light, old), 1e-3))


def _flip(image: np.ndarray, reference: np.ndarray) -> float:
    """FLIP of what a screen shows."""
    return float(_flip_of_screens(np.asarray(image, np.float32), np.asarray(reference, np.float32)))


@jax.jit
def _flip_of_screens(image: jax.Array, reference: jax.Array) -> jax.Array:
    return flip(color.tonemap(image), color.tonemap(reference))
