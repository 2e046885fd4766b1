"""Glints: a microfacet distribution of single flakes, counted with hashes and filterable over any footprint.

A smooth distribution D(h) is replaced by what a footprint really contains: the number of its flakes with a normal near
h, relative to the expected number (Jakob et al. 2014, "Discrete Stochastic Microfacet Models"). As in Wang et al. 2018
("Fast Global Illumination with Discrete Stochastic Microfacets Using a Filterable Model") directions and places are
counted apart. Half vectors are divided into bins of equal probability under D, and each bin has ``flakes`` flakes in
every tile of the surface, whose places are independent and uniform. The number in a part of the tile with the area A
is then ~ Binomial(flakes, A), and is found by halving: of n flakes, Binomial(n, 1/2) lie in the left half, which is
the number of ones among n hashed bits.

So nothing is stored, the same cell has the same flakes in every frame, counts of four cells add up to that of their
parent, and a footprint of a tile or more has the smooth distribution itself: there is no threshold above which a
smooth model takes over.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.checks import check_image, check_option, check_same_size
from jaxdn.materials.microfacets import LOBES, Lobe, alpha_of, cosine_and_sine, distribution

LEVELS = 12
"""The smallest footprint is 2^-LEVELS of a tile wide."""
FLAKES = 256
"""Flakes in a tile, for each bin of directions."""
BINS = 15
"""Bins of half vectors along each of two axes; with an odd number the normal lies in the middle of a bin."""


def glint_distribution(
    half: jax.Array,
    position: jax.Array,
    footprint: jax.Array,
    roughness: jax.Array,
    *,
    lobe: Lobe = "ggx",
    flakes: int = FLAKES,
    bins: int = BINS,
    seed: int | jax.Array = 0,
) -> jax.Array:
    """``D(h) count / E[count]`` [H, W, 1] in 1/sr, for D(h) of :func:`jaxdn.materials.microfacets.distribution`.

    The footprint is a square cell of a quadtree over the tile, linear between the two levels of nearest size. The mean
    over the cells of a level is D(h), exactly; it is 0 where a cell has no flake in the bin of h. Differentiable in the
    half vector and the roughness within a bin, and in the footprint. Raises ValueError for inconsistent shapes, and
    for numbers of flakes and bins below 1.

    Args:
      half: [H, W, 3] half vectors in the frame of the surface, whose normal is z; of any length.
      position: [H, W, 2] on the surface, in tiles; every tile has flakes of its own.
      footprint: [H, W, 1] width of the pixel's footprint, in tiles.
      roughness: [H, W, 1] linear roughness in [0, 1] of the smooth distribution.
      lobe: "ggx" or "beckmann".
      flakes: in a tile, for each bin.
      bins: of half vectors, along each of two axes.
      seed: of the population of flakes, below 2^32.
    """
    check_image(position, "position", channels=2)
    check_image(footprint, "footprint", channels=1)
    for name, image in (("position", position), ("footprint", footprint)):
        check_same_size(half, image, ("half", name))
    _check_population(flakes, bins)
    smooth = distribution(half, roughness, lobe=lobe)
    square = jax.lax.stop_gradient(_to_square(half, roughness, lobe))
    row, column = (_bin(square[..., axis], bins) for axis in (0, 1))
    node = _hash(_tile(position, seed), row * np.uint32(bins) + column)
    exact = footprint[..., 0].astype(smooth.dtype)
    level = -jnp.log2(jnp.clip(exact, 2.0**-LEVELS, 1.0))
    return smooth * _relative_count(node, _cells(position), level, flakes)[..., None]


def flake_normals(
    size: int,
    roughness: jax.Array,
    *,
    lobe: Lobe = "ggx",
    flakes: int = FLAKES,
    bins: int = BINS,
    seed: int | jax.Array = 0,
) -> jax.Array:
    """A normal map [size, size, 3] of the tile at the origin: the normal of one flake in every texel.

    The flakes are those that :func:`glint_distribution` counts in cells as large as a texel; of several in a texel one
    is drawn, and a texel without any has the surface's own normal (0, 0, 1). Row i, column j lie at the position
    ((j + 0.5) / size, (i + 0.5) / size). Differentiable in the roughness. Raises ValueError unless the size is a power
    of two, and for numbers of flakes and bins below 1.

    Args:
      size: texels along each side, a power of two.
      roughness: scalar, linear roughness in [0, 1] of the smooth distribution.
      lobe: "ggx" or "beckmann".
      flakes: in the tile, for each bin.
      bins: of half vectors, along each of two axes.
      seed: of the population of flakes, below 2^32.
    """
    if size < 1 or size & (size - 1):
        raise ValueError(f"size: expected a power of two, got {size}.")
    check_option(lobe, "lobe", LOBES)
    _check_population(flakes, bins)
    tile = _hash(_tile(jnp.zeros((2,), jnp.float32), seed), np.uint32(0x7E1E))
    counts = _counts(size, flakes, bins, seed)  # [bins^2, size, size]
    texel = _hash(tile, jnp.arange(size * size, dtype=jnp.uint32).reshape(size, size))
    chosen, first, second = (_uniform(_hash(texel, np.uint32(word))) for word in range(3))
    until = jnp.cumsum(counts, axis=0)
    number = jnp.floor(chosen * until[-1])  # of the flake that is drawn, among those in the texel
    drawn = jnp.minimum(jnp.sum(until <= number[None], axis=0), bins * bins - 1)
    square = jnp.stack([(drawn // bins + first) / bins, (drawn % bins + second) / bins], axis=-1) * 2 - 1
    normal = _from_square(square, jnp.asarray(roughness), lobe)
    return jnp.where((until[-1] > 0)[..., None], normal, jnp.asarray([0.0, 0.0, 1.0], normal.dtype)[None, None])


def _check_population(flakes: int, bins: int) -> None:
    for name, number in (("flakes", flakes), ("bins", bins)):
        if number < 1:
            raise ValueError(f"{name}: expected a number of at least 1, got {number}.")


# Counting: a binary tree over the tile, halved in x and y in turn.


def _relative_count(node: jax.Array, cells: jax.Array, level: jax.Array, flakes: int) -> jax.Array:
    """Count over expected count [H, W] at a fractional level.

    Args:
      node: [H, W] hash of the tile and the bin.
      cells: [H, W, 2] cell of the finest level.
      level: [H, W] in [0, LEVELS].
      flakes: of the bin in the tile.
    """

    def halve(carry: tuple[jax.Array, jax.Array], step: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        node, count = carry
        axis, depth = step % 2, LEVELS - 1 - step // 2
        upper = (jnp.where(axis == 0, cells[..., 0], cells[..., 1]) >> depth.astype(jnp.uint32)) & np.uint32(1)
        below = _ones(node, count, flakes)
        count = jnp.where(upper == 1, count - below, below)
        return (_hash(node, upper), count), count

    start = (node, jnp.full(node.shape, flakes, jnp.int32))
    _, counts = jax.lax.scan(halve, start, jnp.arange(2 * LEVELS))
    counts = jnp.concatenate([start[1][None], counts[1::2]])  # [LEVELS + 1, H, W]
    index = jnp.arange(LEVELS + 1, dtype=level.dtype)[:, None, None]
    weight = jnp.maximum(0.0, 1.0 - jnp.abs(level[None] - index))
    return jnp.sum(weight * counts * 4.0**index, axis=0) / flakes


def _counts(size: int, flakes: int, bins: int, seed: int | jax.Array) -> jax.Array:
    """[bins^2, size, size] flakes in every cell of the tile at the origin: what ``_relative_count`` finds, at once."""
    tile = _tile(jnp.zeros((2,), jnp.float32), seed)
    node = _hash(tile, jnp.arange(bins * bins, dtype=jnp.uint32))[:, None, None]
    count = jnp.full(node.shape, flakes, jnp.int32)
    for step in range(2 * (size.bit_length() - 1)):
        axis = 2 - step % 2  # x are the columns
        below = _ones(node, count, flakes)
        shape = tuple(2 * length if at == axis else length for at, length in enumerate(node.shape))
        count = jnp.stack([below, count - below], axis + 1).reshape(shape)
        node = jnp.stack([_hash(node, np.uint32(half)) for half in (0, 1)], axis + 1).reshape(shape)
    return count


def _ones(node: jax.Array, count: jax.Array, most: int) -> jax.Array:
    """Binomial(count, 1/2) for counts up to ``most``: the ones among the first ``count`` hashed bits of a node."""
    words = np.arange(-(-most // 32)).reshape(-1, *[1] * node.ndim)
    taken = jnp.clip(count[None] - 32 * words, 0, 32).astype(jnp.uint32)
    # A shift by all 32 bits is not defined.
    mask = jnp.where(taken == 32, np.uint32(0xFFFFFFFF), (np.uint32(1) << (taken & np.uint32(31))) - np.uint32(1))
    bits = _hash(node[None], (2 + words).astype(np.uint32))
    return jnp.sum(jax.lax.population_count(bits & mask).astype(jnp.int32), axis=0, dtype=jnp.int32)


def _hash(node: jax.Array, index: jax.Array | np.ndarray | np.uint32) -> jax.Array:
    """The hash of a node's child, uint32; two rounds of MurmurHash3's finaliser (Appleby 2011)."""
    return _mix(node ^ _mix(jnp.asarray(index, jnp.uint32) + np.uint32(0x9E3779B9)))


def _mix(bits: jax.Array) -> jax.Array:
    bits = (bits ^ (bits >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return bits ^ (bits >> np.uint32(16))


def _uniform(bits: jax.Array) -> jax.Array:
    """In [0, 1), of the upper 24 bits: float32 has no more."""
    return (bits >> np.uint32(8)).astype(jnp.float32) * np.float32(2.0**-24)


def _tile(position: jax.Array, seed: int | jax.Array) -> jax.Array:
    """The hash [...] of the tile that a position [..., 2] lies in."""
    # Beyond, float32 has no integer for every tile, and int32 none at all.
    corner = jnp.clip(jnp.floor(position), -(2.0**30), 2.0**30).astype(jnp.int32).astype(jnp.uint32)
    start = _hash(jnp.full(position.shape[:-1], jnp.asarray(seed, jnp.uint32)), np.uint32(0))
    return _hash(_hash(start, corner[..., 0]), corner[..., 1])


def _cells(position: jax.Array) -> jax.Array:
    """[..., 2] the cell of the finest level within the tile, uint32."""
    inside = position.astype(jnp.promote_types(position.dtype, jnp.float32))
    inside = inside - jnp.floor(inside)
    return jnp.clip(jnp.floor(inside * 2**LEVELS), 0, 2**LEVELS - 1).astype(jnp.uint32)


# Directions: the half vectors under D, mapped to the square [-1, 1]^2 with equal probability everywhere.


def _to_square(half: jax.Array, roughness: jax.Array, lobe: Lobe) -> jax.Array:
    """[..., 2]: the angle by its distribution function, then the disk to the square (Shirley and Chiu 1997).

    A share u of the flakes is inclined less than h: ``tan^2 / (alpha^2 + tan^2)`` of GGX, ``1 - exp(-tan^2 / alpha^2)``
    of Beckmann (Walter et al. 2007, eq. 35 and 28). The radius on the disk is its root.
    """
    cosine, sine = cosine_and_sine(half)
    alpha = alpha_of(roughness)
    cosine = jnp.maximum(cosine, 1e-6)
    if lobe == "ggx":
        radius = sine / jnp.sqrt((alpha * cosine) ** 2 + sine**2)
    else:
        radius = jnp.sqrt(-jnp.expm1(-((sine / (alpha * cosine)) ** 2)))
    radius, x, y = radius[..., 0], half[..., 0].astype(radius.dtype), half[..., 1].astype(radius.dtype)
    larger, smaller = jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.minimum(jnp.abs(x), jnp.abs(y))
    other = radius * (4 / jnp.pi) * jnp.arctan(smaller / jnp.where(larger == 0, 1.0, larger))
    wide = jnp.abs(x) >= jnp.abs(y)
    a, b = jnp.where(wide, radius, other), jnp.where(wide, other, radius)
    return jnp.stack([jnp.copysign(a, x), jnp.copysign(b, y)], axis=-1)


def _from_square(square: jax.Array, roughness: jax.Array, lobe: Lobe) -> jax.Array:
    """The unit half vectors [..., 3] of points [..., 2]: the inverse of ``_to_square``."""
    a, b = square[..., 0], square[..., 1]
    wide = jnp.abs(a) >= jnp.abs(b)
    radius, other = jnp.where(wide, jnp.abs(a), jnp.abs(b)), jnp.where(wide, jnp.abs(b), jnp.abs(a))
    angle = (jnp.pi / 4) * other / jnp.where(radius == 0, 1.0, radius)
    along, across = jnp.cos(angle), jnp.sin(angle)
    share = jnp.minimum(radius, 0.9999) ** 2  # at 1 the normal would lie in the surface
    slope = share / (1 - share) if lobe == "ggx" else -jnp.log1p(-share)
    tangent = alpha_of(roughness) * jnp.sqrt(slope)
    x = jnp.copysign(jnp.where(wide, along, across) * tangent, a)
    y = jnp.copysign(jnp.where(wide, across, along) * tangent, b)
    return jnp.stack([x, y, jnp.ones_like(x)], axis=-1) / jnp.sqrt(1 + tangent**2)[..., None]


def _bin(coordinate: jax.Array, bins: int) -> jax.Array:
    """The bin of a coordinate in [-1, 1], uint32."""
    return jnp.clip(jnp.floor((coordinate + 1) / 2 * bins), 0, bins - 1).astype(jnp.uint32)
