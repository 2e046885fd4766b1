"""Metrics against float64 NumPy, scikit-image's SSIM and the FLIP authors' own evaluator."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn import metrics
from jaxdn.metrics.flip import flip_map
from tests.gradients import check_gradients
from tests.needs import require_module

SHAPE = (3, 14, 17, 3)

METRICS = {
    name: jax.jit(getattr(metrics, name))
    for name in ("mse", "l1", "relative_mse", "psnr", "ssim", "flip", "temporal_psnr")
}
IDENTICAL = {"psnr": np.inf, "temporal_psnr": np.inf, "ssim": 1.0}
"""What each gives for two identical images; 0 where it is not named."""
temporal_psnr = METRICS["temporal_psnr"]
psnr, ssim, flip, mse, l1 = (METRICS[name] for name in ("psnr", "ssim", "flip", "mse", "l1"))
unbiased_mse, unbiased_psnr = jax.jit(metrics.unbiased_mse), jax.jit(metrics.unbiased_psnr)
psnr_of_means = jax.jit(partial(metrics.psnr, average="mse"))
flips = jax.jit(flip_map)


def pair(rng: np.random.Generator, shape: tuple[int, ...] = SHAPE) -> tuple[np.ndarray, np.ndarray]:
    reference = rng.random(shape)
    image = np.clip(reference + 0.2 * rng.standard_normal(shape), 0, 1)
    return image.astype(np.float32), reference.astype(np.float32)


def some(rng: np.random.Generator, shape: tuple[int, ...] = SHAPE) -> np.ndarray:
    return rng.random((*shape[:-1], 1)) < 0.3


def psnr_reference(x: np.ndarray, y: np.ndarray) -> float:
    return -10 * np.log10(np.mean((x.astype(np.float64) - y) ** 2))


@pytest.mark.parametrize("clip", [True, False])
def test_means(clip: bool, rng: np.random.Generator) -> None:
    x, y = pair(rng) if clip else pair(rng, SHAPE[1:])
    error = x.astype(np.float64) - y
    np.testing.assert_allclose(mse(x, y), np.mean(error**2), rtol=1e-5)
    np.testing.assert_allclose(l1(x, y), np.mean(np.abs(error)), rtol=1e-5)
    expected = np.mean(error**2 / (y.astype(np.float64) ** 2 + 0.01))
    np.testing.assert_allclose(METRICS["relative_mse"](x, y), expected, rtol=1e-5)


def test_means_under_a_mask_are_over_its_pixels(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    mask = some(rng)
    inside = mask[..., 0]
    error = x[inside].astype(np.float64) - y[inside]
    np.testing.assert_allclose(mse(x, y, mask=mask), np.mean(error**2), rtol=1e-5)
    np.testing.assert_allclose(l1(x, y, mask=mask), np.mean(np.abs(error)), rtol=1e-5)
    expected = np.mean(error**2 / (y[inside].astype(np.float64) ** 2 + 0.01))
    np.testing.assert_allclose(METRICS["relative_mse"](x, y, mask=mask), expected, rtol=1e-5)
    np.testing.assert_allclose(mse(x, y, mask=mask.astype(np.float32)), np.mean(error**2), rtol=1e-5)


def test_psnr_of_a_clip_is_the_mean_of_its_frames(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    x[1] = y[1] + 0.01
    frames = [psnr_reference(a, b) for a, b in zip(x, y, strict=True)]
    np.testing.assert_allclose(psnr(x, y), np.mean(frames), rtol=1e-5)
    np.testing.assert_allclose(psnr_of_means(x, y), psnr_reference(x, y), rtol=1e-5)
    np.testing.assert_allclose(psnr(x[0], y[0]), frames[0], rtol=1e-5)
    # the logarithm is concave: the mean of the PSNRs is the larger
    assert psnr(x, y) > psnr_of_means(x, y)


def test_psnr_under_a_mask_leaves_empty_frames_out(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    mask = some(rng)
    mask[1] = False
    expected = np.mean([psnr_reference(x[i][mask[i, ..., 0]], y[i][mask[i, ..., 0]]) for i in (0, 2)])
    np.testing.assert_allclose(psnr(x, y, mask=mask), expected, rtol=1e-5)


def test_peak_255_is_48_decibels_more(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    np.testing.assert_allclose(
        jax.jit(partial(metrics.psnr, peak=255.0))(x, y) - psnr(x, y), 20 * np.log10(255), rtol=1e-5
    )
    np.testing.assert_allclose(20 * np.log10(255), 48.1308, atol=1e-4)


def test_temporal_psnr(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    dx, dy = np.diff(x.astype(np.float64), axis=0), np.diff(y.astype(np.float64), axis=0)
    expected = np.mean([psnr_reference(a, b) for a, b in zip(dx, dy, strict=True)])
    np.testing.assert_allclose(temporal_psnr(x, y), expected, rtol=1e-5)
    mask = some(rng)
    inside = mask[1:, ..., 0]
    expected = np.mean([psnr_reference(a[m], b[m]) for a, b, m in zip(dx, dy, inside, strict=True)])
    np.testing.assert_allclose(temporal_psnr(x, y, mask=mask), expected, rtol=1e-5)


def test_temporal_psnr_is_infinite_without_change(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    still = [np.repeat(a[:1], 3, axis=0) for a in (x, y)]
    assert temporal_psnr(*still) == np.inf
    assert temporal_psnr(x[:1], y[:1]) == np.inf


def structural_similarity(x: np.ndarray, y: np.ndarray, **options) -> float:
    skimage = require_module("skimage.metrics")  # the oracle
    return skimage.structural_similarity(
        x, y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1, **options
    )


@pytest.mark.parametrize("kind", ["noise", "smooth", "offset"])
def test_ssim_is_that_of_scikit_image(kind: str, rng: np.random.Generator) -> None:
    x, y = pair(rng, (14, 17, 3))
    if kind == "smooth":
        y = np.linspace(0.9, 1.0, y.size).reshape(y.shape).astype(np.float32)
        x = y - np.float32(0.02) * x
    if kind == "offset":
        x = y * np.float32(0.5)
    expected = structural_similarity(x.astype(np.float64), y.astype(np.float64))
    np.testing.assert_allclose(ssim(x, y), expected, atol=2e-6 if kind != "smooth" else 2e-5)


def test_ssim_of_a_clip_and_under_a_mask(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    mask = some(rng)
    pairs = list(zip(x.astype(np.float64), y.astype(np.float64), strict=True))
    np.testing.assert_allclose(ssim(x, y), np.mean([structural_similarity(a, b) for a, b in pairs]), atol=2e-6)
    maps = np.stack([structural_similarity(a, b, full=True)[1] for a, b in pairs])[:, 5:-5, 5:-5]
    expected = maps[mask[:, 5:-5, 5:-5, 0]].mean()
    np.testing.assert_allclose(ssim(x, y, mask=mask), expected, atol=2e-6)


def test_ssim_of_a_small_image_uses_the_largest_odd_window(rng: np.random.Generator) -> None:
    x, y = pair(rng, (6, 5, 3))
    axis = np.arange(-2, 3)
    g = np.exp(-(axis**2) / 4.5)
    weights = np.outer(g, g) / g.sum() ** 2

    def local(image: np.ndarray) -> np.ndarray:
        windows = np.lib.stride_tricks.sliding_window_view(image, (5, 5), axis=(0, 1))
        return np.einsum("hwcij,ij->hwc", windows, weights)

    a, b = x.astype(np.float64), y.astype(np.float64)
    ma, mb = local(a), local(b)
    va, vb, vab = local(a * a) - ma**2, local(b * b) - mb**2, local(a * b) - ma * mb
    expected = (2 * ma * mb + 1e-4) * (2 * vab + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    np.testing.assert_allclose(ssim(x, y), expected.mean(), atol=2e-6)
    one_pixel = ssim(x[:1, :1], y[:1, :1])
    assert np.isfinite(one_pixel)


def evaluator_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    evaluator = require_module("flip_evaluator")  # the oracle, by the authors
    return evaluator.evaluate(reference, image, "LDR", applyMagma=False)[0].reshape(*image.shape[:2], 1)


@pytest.mark.parametrize("kind", ["noise", "edges", "colors", "faint"])
def test_flip_is_that_of_its_authors(kind: str, rng: np.random.Generator) -> None:
    x, y = pair(rng, (14, 17, 3))
    if kind == "edges":
        x, y = np.zeros_like(x), np.zeros_like(x)
        x[:, 8:], y[7:] = 1, 1
    if kind == "colors":
        x, y = np.zeros_like(x), np.zeros_like(x)
        x[..., 1], y[..., 2] = 1, 1
    if kind == "faint":
        x = y + np.float32(0.001)
        x = np.minimum(x, 1)
    # Next to black, FLIP raises small numbers to small powers, and the evaluator computes in float32 as well.
    expected, tolerance = evaluator_map(x, y), {"edges": 3e-3, "faint": 2e-4}.get(kind, 2e-5)
    np.testing.assert_allclose(flips(x, y), expected, atol=tolerance)
    np.testing.assert_allclose(flips(x, y).mean(), expected.mean(), atol=1e-4)


def test_flip_of_a_clip_and_under_a_mask(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    mask = some(rng)
    maps = np.stack([evaluator_map(a, b) for a, b in zip(x, y, strict=True)])
    np.testing.assert_allclose(flip(x, y), maps.mean(), atol=1e-5)
    np.testing.assert_allclose(flip(x, y, mask=mask), maps[mask].mean(), atol=1e-5)


def test_flip_of_green_and_blue_is_the_largest(rng: np.random.Generator) -> None:
    green, blue = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    green[..., 1], blue[..., 2] = 1, 1
    np.testing.assert_allclose(flip(green, blue), 1.0, atol=1e-4)
    x, y = pair(rng, (14, 17, 3))
    np.testing.assert_allclose(flips(x, y), flips(y, x), atol=1e-6)


@pytest.mark.parametrize("name", METRICS)
def test_identical_images(name: str, rng: np.random.Generator) -> None:
    _, y = pair(rng)
    y[0] = 0
    np.testing.assert_allclose(METRICS[name](y, y), IDENTICAL.get(name, 0.0), atol=1e-6)


@pytest.mark.parametrize("name", METRICS)
def test_masks_of_everything_and_of_nothing(name: str, rng: np.random.Generator) -> None:
    x, y = pair(rng)
    everything = np.ones((*SHAPE[:-1], 1), bool)
    np.testing.assert_allclose(METRICS[name](x, y, mask=everything), METRICS[name](x, y), rtol=1e-5)
    assert METRICS[name](x, y, mask=~everything) == IDENTICAL.get(name, 0.0)


@pytest.mark.parametrize("name", METRICS)
def test_gradients_are_finite_on_identical_images_and_behind_a_mask(name: str, rng: np.random.Generator) -> None:
    x, y = pair(rng)
    x[0] = y[0]
    y[1] = x[1] = 0
    mask = some(rng)
    counts = mask.copy()
    if name == "temporal_psnr":  # the earlier pixel of a difference counts where the later does
        counts[:-1] |= mask[1:]
    outside = ~np.broadcast_to(counts, x.shape)
    neighbours = name in ("ssim", "flip")
    if not neighbours:
        x[outside] = np.nan
    # fewer taps to compile
    options = {"pixels_per_degree": 8.0} if name == "flip" else {}
    slope = jax.jit(jax.grad(lambda x: getattr(metrics, name)(x, y, mask=mask, **options)))(x)
    assert np.all(np.isfinite(slope))
    if not neighbours:
        assert np.all(np.asarray(slope)[outside] == 0)


@pytest.mark.parametrize("name", METRICS)
def test_what_is_not_finite_shows(name: str, rng: np.random.Generator) -> None:
    x, y = pair(rng)
    x[1, 7, 8, 0] = np.nan
    assert np.isnan(METRICS[name](x, y))


@pytest.mark.parametrize("name", METRICS)
def test_derivatives(name: str, x64: None, rng: np.random.Generator) -> None:
    y = rng.uniform(0.2, 0.8, (2, 5, 6, 3))
    x = y + rng.uniform(0.05, 0.15, y.shape)
    options = {"pixels_per_degree": 8.0} if name == "flip" else {}
    metric = jax.jit(lambda x, y: getattr(metrics, name)(x, y, **options))
    check_gradients(metric, (x, y), eps=1e-6, rtol=1e-4, atol=1e-5)


@given(st.integers(0, 2**31), st.floats(0, 10))
def test_mse_is_at_least_l1_squared(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.normal(0, 1, (4, 5, 3)) * np.array([spread, 1.0]).reshape(2, 1, 1, 1)).astype(np.float32)
    assert mse(x, y) >= l1(x, y) ** 2 * (1 - 1e-5)


@given(st.integers(0, 2**31))
def test_symmetry_and_range(seed: int) -> None:
    x, y = pair(np.random.default_rng(seed))
    for metric in (mse, l1, psnr, ssim, flip):
        np.testing.assert_allclose(metric(x, y), metric(y, x), rtol=1e-4)
    assert -1 <= ssim(x, y) <= 1
    assert 0 <= flip(x, y) <= 1


def test_half_precision_images_are_measured_in_single(rng: np.random.Generator) -> None:
    x, y = (a.astype(np.float16) for a in pair(rng, (300, 300, 3)))
    result = mse(x, y, mask=np.ones((300, 300, 1), bool))
    assert result.dtype == jnp.float32
    np.testing.assert_allclose(result, np.mean((x.astype(np.float64) - y) ** 2), rtol=1e-5)


def test_shapes_are_checked(rng: np.random.Generator) -> None:
    x, y = pair(rng)
    with pytest.raises(ValueError, match="same size"):
        metrics.mse(x, y[:, :5])
    with pytest.raises(ValueError, match="channels"):
        metrics.l1(x, y[..., :1])
    with pytest.raises(ValueError, match="T, H, W, C"):
        metrics.temporal_psnr(x[0], y[0])
    with pytest.raises(ValueError, match="mask"):
        metrics.mse(x, y, mask=np.ones(SHAPE, bool))
    with pytest.raises(ValueError, match="3 channels"):
        metrics.flip(x[..., :1], y[..., :1])
    with pytest.raises(ValueError, match="average"):
        metrics.psnr(x, y, average="median")


def test_relative_mse_survives_a_firefly_in_the_reference():
    reference = np.full((4, 4, 3), 1e30, np.float32)
    assert METRICS["relative_mse"](np.zeros_like(reference), reference) == pytest.approx(1.0)
    slope = jax.jit(jax.grad(metrics.relative_mse))(np.zeros_like(reference), reference)
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize("extreme", [1e36, np.finfo(np.float32).max])
def test_relative_mse_has_a_finite_gradient_up_to_the_largest_number(extreme):
    image = np.full((2, 2, 3), 0.5, np.float32)
    image[0, 0] = extreme
    reference = np.full((2, 2, 3), 0.01, np.float32)
    assert np.isfinite(jax.jit(jax.grad(metrics.relative_mse))(image, reference)).all()
    assert METRICS["relative_mse"](image, reference) == np.inf, "it is not flattered"


# Without the noise of the reference.


def halves(rng: np.random.Generator, *, error: float, noise: float, shape: tuple[int, ...]) -> list[np.ndarray]:
    """An image ``error`` off the truth (RMS), and two references whose mean has the noise ``noise`` (RMS)."""
    truth = rng.uniform(0.3, 0.7, shape)
    offsets = (error, noise * 2**0.5, noise * 2**0.5)
    return [(truth + size * rng.standard_normal(shape)).astype(np.float32) for size in offsets]


@pytest.mark.parametrize("shape", [(180, 320, 3), (4, 90, 160, 3)])
def test_errors_without_the_references_noise_are_the_true_ones(shape):
    # As much noise in the reference as error in the image: the plain PSNR is 3 dB off.
    image, first, second = halves(np.random.default_rng(1), error=0.02, noise=0.02, shape=shape)
    true = -20 * np.log10(0.02)
    assert true - float(psnr(image, (first + second) / 2)) > 2.9
    assert abs(float(unbiased_psnr(image, first, second)) - true) < 0.1
    of_bytes = jax.jit(partial(metrics.unbiased_psnr, peak=255.0))(image, first, second)
    np.testing.assert_allclose(of_bytes, true + 48.13, atol=0.1)


def test_unbiased_mse_is_the_mean_product_inside_the_mask(rng):
    image, first, second = halves(rng, error=0.1, noise=0.1, shape=SHAPE)
    mask = rng.random((*SHAPE[:-1], 1)) < 0.5
    broken = [np.where(mask, each, np.float32(np.nan)) for each in (image, first, second)]
    x, a, b = (np.asarray(each, np.float64)[mask[..., 0]] for each in (image, first, second))
    found = unbiased_mse(*broken, mask=mask)
    np.testing.assert_allclose(found, np.mean((x - a) * (x - b)), rtol=1e-5)
    assert float(unbiased_mse(*broken, mask=np.zeros_like(mask))) == 0
    check_gradients(lambda x: metrics.unbiased_mse(x, first, second), (image,), rtol=1e-2)


def test_two_references_that_are_one_give_the_plain_error(rng):
    image, reference = pair(rng)
    np.testing.assert_allclose(unbiased_mse(image, reference, reference), mse(image, reference), rtol=1e-6)
    one = unbiased_psnr(image, reference, reference)
    np.testing.assert_allclose(one, psnr_of_means(image, reference), rtol=1e-6)


def test_an_image_that_is_as_good_as_can_be_told_is_infinitely_good():
    image = np.full((4, 4, 3), 0.5, np.float32)
    assert float(unbiased_psnr(image, image + 0.1, image - 0.1)) == np.inf


def test_a_second_reference_of_another_size_is_refused(rng):
    image, reference = pair(rng)
    with pytest.raises(ValueError, match="same size"):
        metrics.unbiased_mse(image, reference, reference[:, 1:])
