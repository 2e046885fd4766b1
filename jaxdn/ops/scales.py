"""Images at several scales and layouts: padded, halved, doubled, composed of filtered scales, joined as planes.

Filters work on planes ``[C, H, W]``. XLA:CPU does not vectorise what it transposes, and computes what it fuses into
arrays side by side once for each of the channels: a compiled loop keeps both apart.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import Example, operation

if TYPE_CHECKING:
    from jaxtyping import Array, Float

LAYOUTS = ("planes", "pixels", "blocks", "corners", "means")
"""Names of layouts, in the order of their numbers in :mod:`jaxdn.ops.numba_scales`."""

Channels = tuple[str, jax.Array]
"""A layout and an array: ``"planes"`` [C, H, W], ``"pixels"`` [H, W, C], ``"blocks"`` [H/2, W/2, 4C] made as by
:func:`space_to_depth`; or what is averaged over blocks of 2x2 pixels: ``"corners"`` [H, W, 4C] made
likewise, or ``"means"`` [2H, 2W, C]."""


PLANE_LAYOUTS = ("planes", "blocks", "means")
"""Names of what becomes of planes in :func:`join_pixels`, in the order of their numbers in
:mod:`jaxdn.ops.numba_scales`."""

Planes = tuple[str, jax.Array]
"""What becomes of planes, and they: ``"planes"`` [C, h, w] stay as they are. Of [C, H, W], ``"blocks"`` are the pixels
of each block of 2x2 side by side, as :func:`space_to_depth` has them, and ``"means"`` the means of blocks; H is 2h or
2h - 1, likewise W, and the border is repeated."""


def pad(image: jax.Array, multiple: int) -> jax.Array:
    """[H, W, C] with height and width made multiples of ``multiple`` by repeating the last row and column."""
    height, width = image.shape[:2]
    below, right = -height % multiple, -width % multiple
    return jnp.pad(image, ((0, below), (0, right), (0, 0)), mode="edge") if below or right else image


def crop(image: jax.Array, size: Sequence[int]) -> jax.Array:
    """The first rows and columns, ``size`` of them: the inverse of :func:`pad`."""
    return image[: size[0], : size[1]]


def downsample(image: Float[Array, "H W C"], *, down: Literal["mean", "max"] = "mean") -> Float[Array, "H/2 W/2 C"]:
    """Halve [H, W, C] to [H/2, W/2, C] by the mean or the maximum of 2x2 blocks; odd sizes raise ValueError."""
    check_image(image, "image")
    check_option(down, "down", ("mean", "max"))
    image = jnp.asarray(image)
    height, width, channels = image.shape
    _check_even(height, width, "image")
    blocks = image.reshape(height // 2, 2, width // 2, 2, channels)
    corners = [blocks[:, i, :, j] for i in (0, 1) for j in (0, 1)]
    if down == "mean":
        return (corners[0] + corners[1] + corners[2] + corners[3]) * 0.25
    return jnp.maximum(jnp.maximum(corners[0], corners[1]), jnp.maximum(corners[2], corners[3]))


def space_to_depth(image: jax.Array) -> jax.Array:
    """[H, W, C] -> [H/2, W/2, 4C]: the pixels of each 2x2 block side by side, channel by channel.

    Odd sizes raise ValueError.
    """
    check_image(image, "image")
    height, width, channels = image.shape
    _check_even(height, width, "image")
    blocks = image.reshape(height // 2, 2, width // 2, 2, channels)
    return blocks.transpose(0, 2, 4, 1, 3).reshape(height // 2, width // 2, 4 * channels)


def fill_holes(image: jax.Array, known: jax.Array, *, implementation: str | None = None) -> jax.Array:
    """[H, W, C] with the mean of the known pixels of the same 2x2 block, else 4x4 block, where a pixel is not known.

    ``known`` [H, W, 1] is bool. Blocks without a known pixel are 0. Means of the result thus hold nothing of what was
    there. Sizes that are not multiples of 4, or that differ, raise ValueError.
    """
    check_image(image, "image")
    check_same_size(image, known, ("image", "known"))
    if image.shape[0] % 4 or image.shape[1] % 4:
        raise ValueError(
            f"image: expected a height and width that are multiples of 4, got {image.shape[0]} x {image.shape[1]}; "
            "pad by edge and crop the result."
        )
    return _fill_holes(jnp.asarray(image), jnp.asarray(known), implementation=implementation)


@operation(name="fill_holes")
def _fill_holes(image: jax.Array, known: jax.Array) -> jax.Array:
    """:func:`fill_holes` of arrays whose shapes fit."""
    weight = jnp.asarray(known, image.dtype)
    total, means = jnp.where(known, image, 0.0), []
    for level in (1, 2):
        total, weight = downsample(total), downsample(weight)
        mean = total / jnp.where(weight > 0, weight, 1.0)
        for _ in range(level):
            mean = upsample(mean, up="nearest")
        means.append((mean, weight))
    near = upsample(means[0][1], up="nearest") > 0
    return jnp.where(known, image, jnp.where(near, means[0][0], means[1][0]))


@numba_call.implements(_fill_holes)
def _fill_holes_by_numba(image: jax.Array, known: jax.Array) -> jax.Array:
    from jaxdn.ops.numba_scales import fill_rows

    return numba_call.call(fill_rows, [image.shape], [image, known[..., 0]], rows=image.shape[0] // 4)[0]


def upsample(
    image: Float[Array, "H W C"], *, up: Literal["bilinear", "nearest"] = "bilinear"
) -> Float[Array, "2*H 2*W C"]:
    """Double [H, W, C] to [2H, 2W, C]: bilinear with half-pixel centres and edge clamp, or nearest.

    Bilinear at twice the size has two weights only, 0.75 of the pixel that holds the sample and 0.25 of its neighbour,
    so each axis is two interleaved shifted sums (``jax.image.resize`` uses matrix products).
    """
    check_image(image, "image")
    check_option(up, "up", ("bilinear", "nearest"))
    image = jnp.asarray(image)
    if up == "nearest":
        return jnp.repeat(jnp.repeat(image, 2, axis=0), 2, axis=1)
    return _double(_double(image, 0), 1)


def _double(image: jax.Array, axis: int) -> jax.Array:
    """Twice the size along one axis, bilinear, half-pixel centres, edge clamp."""
    size = image.shape[axis]
    first = jax.lax.slice_in_dim(image, 0, 1, axis=axis)
    last = jax.lax.slice_in_dim(image, size - 1, size, axis=axis)
    before = jnp.concatenate([first, jax.lax.slice_in_dim(image, 0, size - 1, axis=axis)], axis)
    after = jnp.concatenate([jax.lax.slice_in_dim(image, 1, size, axis=axis), last], axis)
    halves = jnp.stack([0.75 * image + 0.25 * before, 0.75 * image + 0.25 * after], axis + 1)
    return halves.reshape(*image.shape[:axis], 2 * size, *image.shape[axis + 1 :])


def compose_scales(
    fine: Float[Array, "H W C"],
    coarse: Float[Array, "H/2 W/2 C"],
    alpha: Float[Array, "... 1"],
    *,
    down: Literal["mean", "max"] = "mean",
    up: Literal["bilinear", "nearest"] = "bilinear",
) -> Float[Array, "H W C"]:
    """Replace the low frequencies of ``fine`` [H, W, C] by ``coarse`` [H/2, W/2, C] with weight ``alpha`` in [0, 1].

    With D the 2x2 ``down``-sampling and U the ``up``-sampling of this module:

    - alpha [H/2, W/2, 1] (Zeng et al. 2021, eq. 4): ``fine - U(alpha * D(fine)) + U(alpha * coarse)``
    - alpha [H, W, 1] (Hasselgren et al. 2020, eq. 3): ``fine - alpha * U(D(fine)) + alpha * U(coarse)``

    The result, of fine's shape, is not clamped and may be negative. U is linear, so both forms upsample once. Raises
    ValueError for odd sizes (pad by edge to a multiple of 16 and crop) and for other shapes.

    Args:
      fine: [H, W, C].
      coarse: [H/2, W/2, C].
      alpha: [H/2, W/2, 1] or [H, W, 1].
      down: ``"mean"`` keeps constant images unchanged; ``"max"`` (the paper's) darkens positive ones where alpha > 0.
      up: ``"bilinear"`` or ``"nearest"``.
    """
    for name, array, channels in (("fine", fine, None), ("coarse", coarse, None), ("alpha", alpha, 1)):
        check_image(array, name, channels=channels)
    fine, coarse, alpha = jnp.asarray(fine), jnp.asarray(coarse), jnp.asarray(alpha)
    height, width, channels = fine.shape
    _check_even(height, width, "fine")
    if coarse.shape != (height // 2, width // 2, channels):
        raise ValueError(
            f"coarse: expected half of fine, {(height // 2, width // 2, channels)}, got {coarse.shape}; downsample it."
        )
    correction = coarse - downsample(fine, down=down)
    if alpha.shape[:2] == coarse.shape[:2]:
        return fine + upsample(alpha * correction, up=up)
    if alpha.shape[:2] == fine.shape[:2]:
        return fine + alpha * upsample(correction, up=up)
    raise ValueError(
        f"alpha: expected the size of fine or of coarse, {fine.shape[:2]} or {coarse.shape[:2]}, got {alpha.shape[:2]}."
    )


def _check_even(height: int, width: int, name: str) -> None:
    if height % 2 or width % 2:
        raise ValueError(
            f"{name}: expected an even height and width, got {height} x {width}; "
            "pad by edge to a multiple of 16 and crop the result."
        )


def join_planes(parts: Sequence[Channels], *, implementation: str | None = None) -> jax.Array:
    """[C, H, W] the channels of all parts, in their order; all parts have to be of one size."""
    layouts, arrays = zip(*parts, strict=True)
    return _join_planes(*arrays, layouts=layouts, implementation=implementation)


@operation(name="join_planes")
def _join_planes(*arrays: jax.Array, layouts: tuple[str, ...]) -> jax.Array:
    """The planes of all arrays, one after the other, each converted from its layout."""
    return jnp.concatenate([_TO_PLANES[layout](array) for layout, array in zip(layouts, arrays, strict=True)])


@numba_call.implements(_join_planes)
def _join_planes_by_numba(*arrays: jax.Array, layouts: tuple[str, ...]) -> jax.Array:
    from jaxdn.ops.numba_scales import join_rows

    reference = functools.partial(_join_planes, layouts=layouts, implementation="reference")
    shape = jax.eval_shape(reference, *arrays).shape
    parts = _fill_up(arrays, map(LAYOUTS.index, layouts), _FEW)
    return numba_call.call(join_rows, [shape], parts[:1], parts[1], rows=shape[1])[0]


def join_pixels(parts: Sequence[Planes], *, multiple: int = 1, implementation: str | None = None) -> jax.Array:
    """[h, w, C] the channels of all parts, in their order, padded by the edge to multiples of ``multiple``."""
    layouts, arrays = zip(*parts, strict=True)
    return _join_pixels(*arrays, layouts=layouts, multiple=multiple, implementation=implementation)


@operation(name="join_pixels")
def _join_pixels(*arrays: jax.Array, layouts: tuple[str, ...], multiple: int) -> jax.Array:
    """Pixel by pixel what becomes of the planes, one after the other."""
    parts = [_TO_PIXELS[layout](to_pixels(array)) for layout, array in zip(layouts, arrays, strict=True)]
    return pad(jnp.concatenate(parts, axis=-1), multiple)


@numba_call.implements(_join_pixels)
def _join_pixels_by_numba(*arrays: jax.Array, layouts: tuple[str, ...], multiple: int) -> jax.Array:
    from jaxdn.ops.numba_scales import join_pixel_rows

    reference = functools.partial(_join_pixels, layouts=layouts, multiple=multiple, implementation="reference")
    shape = jax.eval_shape(reference, *arrays).shape
    parts = _fill_up(arrays, map(PLANE_LAYOUTS.index, layouts), _MANY)
    return numba_call.call(join_pixel_rows, [shape], parts[:1], parts[1], rows=shape[0])[0]


_FEW, _MANY = 4, 20
"""Parts of which planes and pixels are joined: with more of them, twice as many, and so on."""


def _fill_up(
    arrays: Sequence[jax.Array], layouts: Iterable[int], multiple: int
) -> tuple[tuple[jax.Array, ...], tuple[int, ...]]:
    """Arrays and their layouts with parts that have nothing at the end, so that there is a ``multiple`` of them.

    A loop is compiled for each number of parts that it is called with, which takes half a second. A first frame of
    ``combiner`` joins three, four, five, eight and seventeen.
    """
    spare = -len(arrays) % multiple
    nothing = jnp.zeros((0, 1, 1), arrays[0].dtype)
    return (*arrays, *[nothing] * spare), (*layouts, *[0] * spare)


def to_planes(image: jax.Array) -> jax.Array:
    """[H, W, C] as [C, H, W]."""
    return image.transpose(2, 0, 1)


def to_pixels(planes: jax.Array) -> jax.Array:
    """[C, H, W] as [H, W, C]."""
    return planes.transpose(1, 2, 0)


def halve_planes(planes: jax.Array) -> jax.Array:
    """[C, H/2, W/2] the means of blocks of 2x2 pixels of planes [C, H, W], H and W even."""
    return 0.25 * (planes[:, ::2, ::2] + planes[:, ::2, 1::2] + planes[:, 1::2, ::2] + planes[:, 1::2, 1::2])


def add_planes(planes: jax.Array) -> jax.Array:
    """[H, W] the sum of planes [C, H, W], one after the other.

    XLA:CPU takes 60 processor ms for a reduction over the first axis of 3 x 720 x 1280 numbers, and 1.2 for additions.
    """
    return functools.reduce(jnp.add, planes)


def _depth_to_space(blocks: jax.Array) -> jax.Array:
    height, width, channels = blocks.shape
    parts = blocks.reshape(height, width, channels // 4, 2, 2).transpose(2, 0, 3, 1, 4)
    return parts.reshape(channels // 4, 2 * height, 2 * width)


def _average_corners(blocks: jax.Array) -> jax.Array:
    return jnp.mean(blocks.reshape(*blocks.shape[:2], -1, 4), axis=-1)


_TO_PLANES = {
    "planes": lambda array: array,
    "pixels": to_planes,
    "blocks": _depth_to_space,
    "corners": lambda array: to_planes(_average_corners(array)),
    "means": lambda array: to_planes(downsample(array)),
}


_TO_PIXELS = {
    "planes": lambda image: image,
    "blocks": lambda image: space_to_depth(pad(image, 2)),
    "means": lambda image: downsample(pad(image, 2)),
}


@_fill_holes.example
def _fill_holes_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    size = height + -height % 4, width + -width % 4
    yield Example((rng.random((*size, 3)), rng.random((*size, 1)) > 0.6))


@_join_planes.example
def _join_planes_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    shapes = {
        "planes": (2, 2 * height, 2 * width),
        "pixels": (2 * height, 2 * width, 3),
        "blocks": (height, width, 8),
        "corners": (2 * height, 2 * width, 4),
        "means": (4 * height, 4 * width, 2),
    }
    yield Example(tuple(map(rng.random, shapes.values())), {"layouts": tuple(shapes)})


@_join_pixels.example
def _join_pixels_example(rng: np.random.Generator, height: int, width: int) -> Iterator[Example]:
    for odd in (0, 1):
        whole = 2 * height - odd, 2 * width - odd
        parts = rng.random((2, height, width)), rng.random((3, *whole)), rng.random((1, *whole))
        yield Example(parts, {"layouts": PLANE_LAYOUTS, "multiple": 1 + 3 * odd})
