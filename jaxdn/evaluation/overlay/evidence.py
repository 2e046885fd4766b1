"""What single images tell: their noise, single bright pixels, guides that hold something else or stand upside down."""

import numpy as np

from jaxdn.color import LUMINANCE

_NOISE = np.outer((1, -2, 1), (1, -2, 1)) / 6.0
"""A second difference in both directions: straight edges and slopes leave nothing, noise keeps its variance
(Immerkaer 1996)."""
BRIGHT = 10.0
"""A firefly is so many times brighter than the third brightest of its 3x3 pixels and the frame's median together."""
FLIPS = {"upside down": (-1, 1), "mirrored": (1, -1), "turned by 180 degrees": (-1, -1)}
"""How a guide may lie, and the steps along rows and columns that turn it back."""


def luminance(image: np.ndarray) -> np.ndarray:
    """[H, W] of linear Rec.709 [H, W, 3]."""
    return np.asarray(image, np.float64) @ np.asarray(LUMINANCE)


def box_mean(image: np.ndarray, radius: int) -> np.ndarray:
    """Means over windows of 2 radius + 1 pixels a side, of what of them is in the image [H, W] or [H, W, C]."""
    for axis in (0, 1):
        length = image.shape[axis]
        widths = [(0, 0)] * image.ndim
        widths[axis] = (1, 0)
        sums = np.pad(np.cumsum(image, axis=axis, dtype=np.float64), widths)
        last = np.minimum(np.arange(length) + radius + 1, length)
        first = np.maximum(np.arange(length) - radius, 0)
        count = (last - first).reshape([-1 if each == axis else 1 for each in range(image.ndim)])
        image = (np.take(sums, last, axis) - np.take(sums, first, axis)) / count
    return image


def second_difference(image: np.ndarray) -> np.ndarray:
    """[H, W, C] what neither edges nor slopes explain, with the variance of the noise; mirrored at the border."""
    padded = np.pad(image.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="reflect")
    height, width = image.shape[:2]
    return sum(
        (tap * padded[y : y + height, x : x + width] for (y, x), tap in np.ndenumerate(_NOISE)),
        start=np.zeros(image.shape),
    )


def noise_map(image: np.ndarray) -> np.ndarray:
    """[H, W] the standard deviation of the noise around each pixel, the mean over the channels."""
    return np.sqrt(box_mean(np.mean(second_difference(image) ** 2, axis=-1), 3))


def relative_noise(radiance: np.ndarray) -> np.ndarray:
    """[H, W] the noise as a share of the light around, for radiance [H, W, 3]."""
    light = box_mean(luminance(radiance), 3)
    return noise_map(radiance) / (light + 0.05 * lit_level(radiance) + 1e-12)


def lit_level(radiance: np.ndarray) -> float:
    """The median luminance where there is light; 0 for a black frame."""
    light = luminance(radiance)
    return float(np.median(light[light > 0])) if (light > 0).any() else 0.0


def fireflies(radiance: np.ndarray) -> np.ndarray:
    """[H, W] bool, single pixels, or two side by side, far brighter than the others of their 3x3 and than the frame."""
    light = luminance(radiance)
    height, width = light.shape
    padded = np.pad(light, 1, mode="reflect")
    around = np.stack([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)])
    return light > BRIGHT * (np.partition(around, 6, axis=0)[6] + lit_level(radiance)) + 1e-12


def normal_figures(normal: np.ndarray) -> dict[str, float]:
    """Shares of the surfaces' pixels [H, W, 3]: unit vectors; vectors stored as colours; with a negative component."""
    surface = np.any(normal != 0, axis=-1)
    if not surface.any():
        return {}
    vectors = normal[surface].astype(np.float64)
    decoded = np.linalg.norm(2 * vectors - 1, axis=-1)
    return {
        "unit normals": float(np.mean(np.abs(np.linalg.norm(vectors, axis=-1) - 1) < 0.1)),
        "encoded normals": float(np.mean((np.abs(decoded - 1) < 0.1) & (vectors.min(axis=-1) >= 0))),
        "negative normals": float(np.mean(vectors.min(axis=-1) < -0.01)),
    }


def orientation_figures(guide: np.ndarray, radiance: np.ndarray) -> dict[str, float]:
    """How well the edges of a guide [H, W, C] lie on those of the beauty, as it is and as it might be turned.

    Correlations of the sizes of gradients. Guides of the right way have the largest as they are.
    """
    level = lit_level(radiance)
    wanted = _edges(np.log(np.maximum(luminance(radiance), 0)[..., None] + 0.1 * level + 1e-12))
    turns = {"as it is": (1, 1), **FLIPS}
    edges = _edges(guide)
    if edges.std() < 1e-6 or wanted.std() < 1e-6:
        return {}
    return {name: float(np.corrcoef(edges[::y, ::x].ravel(), wanted.ravel())[0, 1]) for name, (y, x) in turns.items()}


def _edges(image: np.ndarray) -> np.ndarray:
    """[H, W] the size of the gradient of an image whose noise is smoothed; strong edges count little more."""
    smooth = box_mean(np.clip(np.nan_to_num(image), -1e4, 1e4), 1)
    along = np.gradient(smooth, axis=(0, 1))
    return box_mean(np.sqrt(sum(np.sum(each**2, axis=-1) for each in along)), 1) ** 0.5
