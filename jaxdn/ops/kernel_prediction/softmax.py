"""Filtering with kernels given as logits: the softmax over the taps and the filter combined, tile by tile.

The 25 logits per pixel of a 720p frame are 92 MB. For softmax, filter and each use of the result, XLA:CPU writes and
reads them again, and it recomputes the filter for each of its users, because it fuses it into them. ``"row_tiles"``
processes some rows at a time, so that the weights stay in the cache and the result is computed once. Its gradient
keeps only the arguments and recomputes the weights.

Kernels may be guided: features of the pixels, such as albedo and normals, add a cross-bilateral prior to the logits
(:mod:`jaxdn.ops.kernel_prediction.guide_distances`), so that little light crosses an edge whatever the logits are.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxdn.core.checks import check_image, check_same_size
from jaxdn.ops.dispatch.operation import Example, operation
from jaxdn.ops.kernel_prediction import apply, guide_distances
from jaxdn.ops.kernel_prediction.apply import check_taps

if TYPE_CHECKING:
    from jaxtyping import Array, Float

_TILE_LOGITS = 1_000_000
"""Approximate number of logits in a tile: 15 rows of two kernels at 720p."""


Planes = tuple[jax.Array, ...]
"""Squared distances between features (:func:`~.guide_distances.compute_distances`); empty without features."""


def softmax_filter(
    images: Float[Array, "n H W C"],
    logits: Float[Array, "H W m"],
    *,
    features: Float[Array, "H W F"] | None = None,
    taps: int = 25,
    implementation: str | None = None,
) -> Float[Array, "n H W C"]:
    """Filter images with kernels given as logits: ``apply_kernels(image, normalize_kernels(logits))``, faster.

    images: [n, H, W, C], any colour space. logits: [H, W, m] with m >= n * taps; image i has the ``taps`` = K*K, K odd,
    from ``i * taps`` on; further channels are not read, so a network's head can be passed whole. Returns [n, H, W, C]
    in float32 at least. ``implementation``: "reference" or "row_tiles"; None selects the fastest. Raises ValueError for
    different sizes, too few logits, and taps that are not the square of an odd number.

    ``features`` [H, W, F] guide the kernels of all images: the logit of the tap at pixel q of pixel p gets
    ``- sum_f (features(p)_f - features(q)_f)^2``, a cross-bilateral weight (Eisemann and Durand 2004; Petschnigg et al.
    2004). A feature with standard deviation sigma of a Gaussian weight is divided by ``sqrt(2) sigma`` before. Taps
    beyond the border have the features of the nearest edge pixel, as they have its colour. Learned affinities beside
    predicted kernels: Isik et al. 2021, "Interactive Monte Carlo Denoising using Affinity of Neural Features".
    """
    images, logits = jnp.asarray(images), jnp.asarray(logits)
    check_image(logits, "logits")
    if images.ndim != 4 or images.shape[1:3] != logits.shape[:2]:
        raise ValueError(
            f"images: expected [n, {logits.shape[0]}, {logits.shape[1]}, C] as the logits, got {images.shape}."
        )
    check_taps(taps, "taps")
    if logits.shape[-1] < images.shape[0] * taps:
        raise ValueError(
            f"logits: expected {images.shape[0]} x {taps} channels at least, got {logits.shape[-1]}; "
            "each image has taps of its own."
        )
    dtype = jnp.promote_types(jnp.promote_types(images.dtype, logits.dtype), jnp.float32)
    if features is not None:
        check_image(features, "features")
        check_same_size(logits, features, ("logits", "features"))
        features = jnp.asarray(features, dtype)
    images, logits = images.astype(dtype), logits.astype(dtype)
    return _filter_by_softmax(images, logits, features, taps=taps, implementation=implementation)


def _weights(logits: jax.Array, count: int, taps: int, prior: jax.Array | None) -> list[jax.Array]:
    """Each image's kernels [H, W, taps]; the prior [H, W, taps] is taken off the logits of each."""
    own = [logits[..., index * taps : (index + 1) * taps] for index in range(count)]
    return [jax.nn.softmax(one if prior is None else one - prior, axis=-1) for one in own]


def _prior(features: jax.Array, radius: int) -> jax.Array:
    """Squared distances to the taps [H, W, taps], tap by tap."""
    height, width = features.shape[:2]
    extended = _extend(features[None], radius)[0]
    shifted = [extended[i : i + height, j : j + width] for i, j in apply.tap_offsets(radius)]
    return jnp.stack([jnp.sum(jnp.square(features - one), axis=-1) for one in shifted], axis=-1)


@operation(name="softmax_filter")
def _filter_by_softmax(images: jax.Array, logits: jax.Array, features: jax.Array | None, *, taps: int) -> jax.Array:
    """The softmax, then the filter, with the gradients of the filter's default implementation."""
    prior = None if features is None else _prior(features, _radius(taps))
    kernels_of = _weights(logits, images.shape[0], taps, prior)
    return jnp.stack([apply.apply_kernels(image, one) for image, one in zip(images, kernels_of, strict=True)])


def _rows_per_tile(logits: jax.Array) -> int:
    """Rows in a tile."""
    height, width, depth = logits.shape
    return min(height, max(1, _TILE_LOGITS // (width * depth)))


def _count_tiles(height: int, rows: int) -> int:
    return -(-height // rows)


def _extend(images: jax.Array, radius: int) -> jax.Array:
    return jnp.pad(images, ((0, 0), (radius, radius), (radius, radius), (0, 0)), mode="edge")


def _radius(taps: int) -> int:
    return math.isqrt(taps) // 2


def _slice_rows(planes: Planes, first: jax.Array, rows: int) -> Planes:
    """The rows of each plane that hold the distances of some rows of the image."""
    more = [plane.shape[0] - planes[0].shape[0] for plane in planes]  # the first offset stays in its row
    return tuple(
        lax.dynamic_slice_in_dim(plane, first, rows + extra, 0) for plane, extra in zip(planes, more, strict=True)
    )


def _tile_weights(logits: jax.Array, count: int, taps: int, planes: Planes) -> list[jax.Array]:
    """Each image's kernels [h, w, taps] in a tile."""
    prior = guide_distances.planes_to_taps(planes, logits.shape[0], logits.shape[1], taps) if planes else None
    return _weights(logits, count, taps, prior)


def _filter_tile(extended: jax.Array, logits: jax.Array, planes: Planes, taps: int) -> jax.Array:
    """Filter a tile: extended images [n, h + 2r, w + 2r, C], logits [h, w, m] -> [n, h, w, C]."""
    height, width = logits.shape[:2]
    radius = _radius(taps)
    images = []
    for image, weights in zip(extended, _tile_weights(logits, extended.shape[0], taps, planes), strict=True):
        total = jnp.zeros((height, width, image.shape[-1]), image.dtype)
        for tap, (i, j) in enumerate(apply.tap_offsets(radius)):
            total = total + weights[:, :, tap : tap + 1] * image[i : i + height, j : j + width]
        images.append(total)
    return jnp.stack(images)


def _distances(features: jax.Array | None, taps: int) -> Planes:
    return () if features is None else guide_distances.compute_distances(features, taps)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _by_row_tiles(images: jax.Array, logits: jax.Array, features: jax.Array | None, taps: int) -> jax.Array:
    radius, rows, height = _radius(taps), _rows_per_tile(logits), logits.shape[0]
    extended, planes = _extend(images, radius), _distances(features, taps)

    def tile(index: jax.Array | int, out: jax.Array) -> jax.Array:
        first = jnp.minimum(index * rows, height - rows)  # the last tile may recompute some rows
        part = _filter_tile(
            lax.dynamic_slice_in_dim(extended, first, rows + 2 * radius, 1),
            lax.dynamic_slice_in_dim(logits, first, rows, 0),
            _slice_rows(planes, first, rows),
            taps,
        )
        return lax.dynamic_update_slice_in_dim(out, part, first, 1)

    return lax.fori_loop(0, _count_tiles(height, rows), tile, jnp.zeros_like(images))


_Arguments = tuple[jax.Array, jax.Array, jax.Array | None]


def _forward(
    images: jax.Array, logits: jax.Array, features: jax.Array | None, taps: int
) -> tuple[jax.Array, _Arguments]:
    return _by_row_tiles(images, logits, features, taps), (images, logits, features)


def _gradients(
    extended: jax.Array, logits: jax.Array, planes: Planes, cotangents: jax.Array, taps: int
) -> tuple[jax.Array, jax.Array, Planes]:
    """A tile's gradients by the extended images [n, h + 2r, w + 2r, C], by the logits [h, w, m] and by the planes.

    With w the softmax and d_t = <cotangent, image(p + offset_t)>, the gradient by the logits is
    ``w_t (d_t - sum_s w_s d_s)``; the distances are taken off the logits of every image.
    """
    height, width = logits.shape[:2]
    radius = _radius(taps)
    around = ((2 * radius, 2 * radius), (2 * radius, 2 * radius), (0, 0))
    by_image, by_logits = [], []
    weights_of = _tile_weights(logits, extended.shape[0], taps, planes)
    for image, weights, cotangent in zip(extended, weights_of, cotangents, strict=True):
        inner = []
        for i, j in apply.tap_offsets(radius):
            shifted = image[i : i + height, j : j + width]
            terms = [cotangent[..., c : c + 1] * shifted[..., c : c + 1] for c in range(image.shape[-1])]
            inner.append(sum(terms[1:], terms[0]))
        slopes = jnp.concatenate(inner, axis=-1)
        by_logits.append(weights * (slopes - jnp.sum(weights * slopes, axis=-1, keepdims=True)))
        # Gathered: pixel e of the extended image receives tap t of pixel e - offset_t wherever that exists.
        wide_weights, wide_cotangent = jnp.pad(weights, around), jnp.pad(cotangent, around)
        total = jnp.zeros_like(image)
        for tap, (i, j) in enumerate(apply.tap_offsets(radius)):
            y, x = 2 * radius - i, 2 * radius - j
            weight = wide_weights[y : y + height + 2 * radius, x : x + width + 2 * radius, tap : tap + 1]
            total = total + weight * wide_cotangent[y : y + height + 2 * radius, x : x + width + 2 * radius]
        by_image.append(total)
    by_planes = guide_distances.taps_to_planes(-sum(by_logits[1:], by_logits[0]), taps) if planes else ()
    by_logits.append(jnp.zeros_like(logits[..., taps * len(by_image) :]))
    return jnp.stack(by_image), jnp.concatenate(by_logits, axis=-1), by_planes


def _backward(taps: int, residuals: _Arguments, cotangent: jax.Array) -> _Arguments:
    images, logits, features = residuals
    radius, rows, height = _radius(taps), _rows_per_tile(logits), logits.shape[0]
    extended, undo = jax.vjp(lambda images: _extend(images, radius), images)
    planes = _distances(features, taps)

    def tile(index: jax.Array | int, sums: tuple[jax.Array, jax.Array, Planes]) -> tuple[jax.Array, jax.Array, Planes]:
        by_images, by_logits, by_planes = sums
        first = jnp.minimum(index * rows, height - rows)
        fresh = first + jnp.arange(rows) >= index * rows  # rows that the previous tile has computed count only once
        part_images, part_logits, part_planes = _gradients(
            lax.dynamic_slice_in_dim(extended, first, rows + 2 * radius, 1),
            lax.dynamic_slice_in_dim(logits, first, rows, 0),
            _slice_rows(planes, first, rows),
            jnp.where(fresh[:, None, None], lax.dynamic_slice_in_dim(cotangent, first, rows, 1), 0),
            taps,
        )
        before = lax.dynamic_slice_in_dim(by_images, first, rows + 2 * radius, 1)
        known = lax.dynamic_slice_in_dim(by_logits, first, rows, 0)
        so_far = zip(by_planes, _slice_rows(by_planes, first, rows), part_planes, strict=True)
        return (
            lax.dynamic_update_slice_in_dim(by_images, before + part_images, first, 1),
            lax.dynamic_update_slice_in_dim(by_logits, known + part_logits, first, 0),
            tuple(lax.dynamic_update_slice_in_dim(plane, old + part, first, 0) for plane, old, part in so_far),
        )

    sums = (jnp.zeros_like(extended), jnp.zeros_like(logits), tuple(map(jnp.zeros_like, planes)))
    by_images, by_logits, by_planes = lax.fori_loop(0, _count_tiles(height, rows), tile, sums)
    by_features = None if features is None else guide_distances.features_gradient(features, by_planes, taps)
    return undo(by_images)[0], by_logits, by_features


_by_row_tiles.defvjp(_forward, _backward)


@_filter_by_softmax.implementation("row_tiles", platforms=("cpu",))
def _filter_by_row_tiles(images: jax.Array, logits: jax.Array, features: jax.Array | None, *, taps: int) -> jax.Array:
    """Some rows at a time; the gradients recompute the weights."""
    return _by_row_tiles(images, logits, features, taps)


@_filter_by_softmax.example
def _example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for taps, count, spare, channels in ((9, 2, 1, 0), (25, 1, 0, 7)):
        images, logits = (
            rng.normal(size=(count, height, width, 3)),
            rng.normal(size=(height, width, count * taps + spare)),
        )
        features = rng.normal(size=(height, width, channels)) if channels else None
        yield Example((images, 3 * logits, features), {"taps": taps})
