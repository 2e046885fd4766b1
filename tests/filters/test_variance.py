"""Short histories: means over neighbours of the same surface, and over those beside where there are none."""

import jax
import numpy as np
import pytest

from jaxdn.filters import sparse
from jaxdn.filters.edge_stopping import normal_weight
from jaxdn.filters.variance import estimate_variance

HEIGHT, WIDTH, SIGMA, SHORT = 11, 9, 16.0, 4
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def drawn(rng, *, odd=0.3):
    """Colour, moments and lengths of histories, surfaces, and normals of which a share points anywhere."""
    color = rng.exponential(size=(3, HEIGHT, WIDTH))
    first = np.tensordot(LUMINANCE, color, 1)
    length = rng.integers(1, 8, (HEIGHT, WIDTH)).astype(np.float64)
    history = np.concatenate([color, [first, 2 * first**2, length]])
    normal = np.where(rng.random((HEIGHT, WIDTH, 1)) < odd, rng.normal(size=(HEIGHT, WIDTH, 3)), [0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return history, rng.random((HEIGHT, WIDTH)) < 0.85, normal


def around(y, x, reach):
    rows, columns = (
        range(max(y - reach, 0), min(y + reach + 1, HEIGHT)),
        range(max(x - reach, 0), min(x + reach + 1, WIDTH)),
    )
    return [(row, column) for row in rows for column in columns]


def expected(history, hit, normal):
    """The same in float64, pixel by pixel."""
    color, moments, length = history[:3], history[3:5], history[5]
    shown, variance = color.copy(), np.maximum(moments[1] - moments[0] ** 2, 0.0)
    alone = np.zeros((HEIGHT, WIDTH))
    for y, x in np.ndindex(HEIGHT, WIDTH):
        if not hit[y, x] or length[y, x] >= SHORT:
            continue
        taps = [at for at in around(y, x, 3) if hit[at]]
        weights = np.array([1.0 if at == (y, x) else max(normal[at] @ normal[y, x], 0.0) ** SIGMA for at in taps])
        mean = sum(weight * history[:5, at[0], at[1]] for weight, at in zip(weights, taps, strict=True)) / weights.sum()
        shown[:, y, x] = mean[:3]
        variance[y, x] = max(mean[4] - mean[3] ** 2, 0.0) * SHORT / length[y, x]
        alone[y, x] = np.clip(2.0 - weights.sum(), 0.0, 1.0)
    both = np.concatenate([shown, variance[None]])
    mixed = both.copy()
    for y, x in np.argwhere(alone > 0):
        known = {at: 1.0 - alone[at] for at in around(y, x, 1) if hit[at]}
        if sum(known.values()) > 0:
            mean = sum(weight * both[:, at[0], at[1]] for at, weight in known.items()) / sum(known.values())
            mixed[:, y, x] += alone[y, x] * (mean - both[:, y, x])
    return mixed, alone


def estimate(*given, **options):
    """Colour and variance of a history [6, H, W], by normals; a program of its own, as ``sparse`` may be patched."""

    @jax.jit
    def run(history, hit, normal):
        weights = [normal_weight(normal, sigma=SIGMA)]
        return estimate_variance(history, hit, weights, short_history=SHORT, **options)

    return jax.tree.map(np.asarray, run(*given))


@pytest.mark.parametrize("large", [False, True])
def test_means_are_those_of_a_plain_loop(large, rng, x64, monkeypatch):
    if large:
        monkeypatch.setattr(sparse, "_WORTH", 0)
        monkeypatch.setattr(sparse, "_FEW", 1.1)
    history, hit, normal = drawn(rng)
    color, variance = estimate(history, hit, normal)
    wanted, alone = expected(history, hit, normal)
    assert (alone > 0.9).sum() > 5
    np.testing.assert_allclose(color, wanted[:3], rtol=1e-9)
    np.testing.assert_allclose(variance, wanted[3], rtol=1e-7, atol=1e-12)


def lone(sample):
    """Even light, and in it one pixel of another surface with a sample of its own."""
    history = np.ones((6, HEIGHT, WIDTH))
    history[:3, 5, 4], history[3, 5, 4], history[4, 5, 4] = sample, sample, sample**2
    normal = np.broadcast_to([0.0, 0.0, 1.0], (HEIGHT, WIDTH, 3)).copy()
    normal[5, 4] = [0.0, 1.0, 0.0]
    return history, normal


@pytest.mark.parametrize("sample", [0.0, 30.0])
def test_a_pixel_alone_is_no_dot(sample):
    history, normal = lone(sample)
    color, _ = estimate(history, None, normal)
    np.testing.assert_allclose(color, 1.0, rtol=1e-6)
    kept, _ = estimate(history, None, normal, isolated=False)
    np.testing.assert_allclose(kept[:, 5, 4], sample)


def test_pixels_that_are_all_alone_stay_as_they_are(rng):
    history = np.concatenate([rng.exponential(size=(5, 3, 2)), np.ones((1, 3, 2))])
    normal = np.stack([np.eye(3), -np.eye(3)], axis=1)  # [3, 2, 3], no two within 90 degrees
    color, _ = estimate(history, None, normal)
    np.testing.assert_allclose(color, history[:3], rtol=1e-6)
