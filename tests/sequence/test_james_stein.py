"""What is kept of a noisy image: against NumPy, and for noise, lost detail and their mixtures."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.sequence.james_stein import (
    AROUND,
    BLOCK,
    BLURRED,
    BOUND,
    BRIGHTER,
    CLEAN,
    DOUBT,
    GAINS,
    LAMP,
    LITTLE,
    MANY,
    MOST_DOUBT,
    MUCH,
    NONE,
    QUIET,
    QUIETER,
    RADII,
    SLOPE,
    combine,
    measure_confidence,
)

SIZE = (48, 64)
mixed = jax.jit(combine)


def mse(image, truth):
    return float(np.mean((np.asarray(image) - truth) ** 2))


def box(height, width):
    """A grey wall and a brighter box with slanted sides: the edges are lost in its blurred version."""
    rows, columns = np.mgrid[:height, :width]
    inside = np.clip((columns - 16 - 0.3 * rows), 0, 1) * np.clip(height - 12 - rows, 0, 1)
    truth = np.repeat((0.5 + inside)[..., None], 3, axis=-1).astype(np.float32)
    blurred = truth
    for axis in (0, 1):
        blurred = sum(np.roll(blurred, step, axis) for step in range(-2, 3)) / 5
    return truth, blurred.astype(np.float32)


def spline(image, step):
    """The B3 spline with holes, pixel by pixel."""
    height, width = image.shape[:2]
    taps = {-2: 1 / 16, -1: 4 / 16, 0: 6 / 16, 1: 4 / 16, 2: 1 / 16}
    wide = np.pad(image, ((2 * step, 2 * step), (2 * step, 2 * step), (0, 0)), mode="symmetric")
    found = np.zeros_like(image)
    for y, x in np.ndindex(height, width):
        found[y, x] = sum(
            one * other * wide[y + (2 + i) * step, x + (2 + j) * step]
            for i, one in taps.items()
            for j, other in taps.items()
        )
    return found


def window(image, radius):
    height, width = image.shape
    return np.array(
        [
            [
                image[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].mean()
                for x in range(width)
            ]
            for y in range(height)
        ]
    )


def near(blocks, y, x):
    """The blocks among which the quietest is sought."""
    return blocks[max(y - QUIET, 0) : y + QUIET + 1, max(x - QUIET, 0) : x + QUIET + 1]


def falling(x, low, high):
    part = np.clip((high - x) / (high - low), 0, 1)
    return part * part * (3 - 2 * part)


def reference(noisy, denoised):
    """Image, share of the noisy pixel and noise, in float64."""
    noisy, denoised = np.asarray(noisy, np.float64), np.asarray(denoised, np.float64)
    light = denoised.mean(axis=-1, keepdims=True)
    level = np.median(light)
    light = light + 0.05 * level
    change = (noisy - denoised) / light
    height, width = change.shape[:2]
    size = np.pad(np.abs(change).mean(axis=-1), 1, mode="edge")
    median = [[np.median(size[y : y + 3, x : x + 3]) for x in range(width)] for y in range(height)]
    bound = np.maximum(median, BOUND)[..., None]
    common = (np.abs(change) <= bound).all(axis=-1)
    change = np.clip(change, -bound, bound)
    wide = np.pad(change, ((1, 1), (1, 1), (0, 0)), mode="reflect")
    curved = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = wide[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]
        behind = wide[1 - dy : 1 - dy + height, 1 - dx : 1 - dx + width]
        curved.append(np.mean((ahead - 2 * change + behind) ** 2, axis=-1) / 6)
    smooth, whole = [change], (noisy - denoised) / light
    for band in range(4):
        smooth.append(spline(smooth[-1], 2**band))
        whole = spline(whole, 2**band)
    bands = [*(one - other for one, other in pairwise(smooth)), smooth[-1]]
    squares = [np.mean(band**2, axis=-1) for band in bands]
    by_scale = (window(squares[0], 7) - SLOPE * window(squares[1], 7)) / (GAINS[0] - SLOPE * GAINS[1])
    by_direction = 1.1 * np.min([window(one, 7) for one in curved], axis=0)
    variance = np.clip(by_scale, by_direction / 2, by_direction)
    blocks = np.min(
        [c.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3)) for c in curved], axis=0
    )
    bright = light[..., 0].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean(axis=(1, 3))
    quiet = falling(np.sqrt(blocks), *CLEAN)
    sampled = np.where(bright > LAMP * level, 1 - quiet, 1)
    known = sampled > 0.5
    number = window(known.astype(float), AROUND)
    share = window(quiet * known, AROUND) / np.where(number > 0, number, 1)
    few = np.pad(falling(np.sqrt(blocks), *NONE) * falling(share, *MANY), 1)
    touched = [[few[y : y + 3, x : x + 3].max() for x in range(width // BLOCK)] for y in range(height // BLOCK)]
    counted = np.where(sampled == 1, blocks + np.array(touched) * LITTLE[1] ** 2, 1e9)
    around = [
        [
            (near(counted, y, x) * np.maximum(near(bright, y, x) / bright[y, x], 1) ** 2).min()
            for x in range(width // BLOCK)
        ]
        for y in range(height // BLOCK)
    ]
    darker = [
        [
            np.where(near(bright, y, x) <= BRIGHTER * bright[y, x], near(counted, y, x), 1e9).min()
            for x in range(width // BLOCK)
        ]
        for y in range(height // BLOCK)
    ]
    quietest, darkest = (
        1.88 * np.asarray(jax.image.resize(np.array(each), (height, width), "linear")) for each in (around, darker)
    )
    blurred = 1 - falling(window(squares[2], 7) / (GAINS[2] * by_direction), *BLURRED)
    texture = np.maximum(blurred, falling(darkest / by_direction, *QUIETER))
    little = texture * falling(np.sqrt(by_direction), *LITTLE)
    variance = little * np.minimum(variance, quietest) + (1 - little) * variance
    cut = window(np.mean((whole - smooth[-1]) ** 2, axis=-1), RADII[-1])
    kept, weights = 0, []
    for band, square, gain, doubt, radius in zip(bands, squares, GAINS, DOUBT, RADII, strict=True):
        energy, fourth = window(square, radius), window(square**2, radius)
        number = np.maximum((2 * radius + 1) ** 2 * energy**2 / fourth, 1)
        noise = gain * (variance if radius == 7 else window(variance, radius))
        noise = noise + (cut if band is bands[-1] else 0)
        weights.append(np.clip(1 - (1 + np.minimum(doubt / np.sqrt(number), MOST_DOUBT)) * noise / energy, 0, 1))
        if band is bands[-1]:
            weights[-1] *= falling(np.sqrt(variance), *MUCH)
        kept = kept + weights[-1][..., None] * band
    share = np.asarray(jax.image.resize(share, (height, width), "linear"))
    clean = 1 - falling(share, *MANY)
    # of the pixel itself, each band has the square of what a line of it has
    line = [1.0]
    taps = np.array([1.0])
    for band in range(4):
        hollow = np.zeros(4 * 2**band + 1)
        hollow[:: 2**band] = np.array([1, 4, 6, 4, 1]) / 16
        taps = np.convolve(taps, hollow)
        line.append(taps[len(taps) // 2] ** 2)
    centers = [*(one - other for one, other in pairwise(line)), line[-1]]
    own = sum(weight * center for weight, center in zip(weights, centers, strict=True))
    kept = kept + clean[..., None] * (change - kept)
    own = own + clean * (1 - own)
    return denoised + light * np.where(common[..., None], kept, 0), np.where(common, own, 0), np.sqrt(variance)


@pytest.mark.parametrize("deviation", [0.005, 0.015, 0.05, 0.25, 0.4, 0.8])
def test_the_mixture_is_that_of_numpy(rng, deviation):
    truth, blurred = (image[:32, :40] for image in box(32, 40))
    noisy = (truth * rng.gamma(deviation**-2, deviation**2, truth.shape)).astype(np.float32)
    noisy[5, 7] = 9.0
    truth[8:16, 16:32] = blurred[8:16, 16:32] = noisy[8:16, 16:32] = 6.0  # a lamp
    image, share, noise = reference(noisy, blurred)
    found = mixed(noisy, blurred)
    np.testing.assert_allclose(found.noise[..., 0], noise, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found.noisy_weight[..., 0], share, atol=1e-3)
    np.testing.assert_allclose(found.image, image, atol=1e-3)


def test_what_has_no_noise_comes_back(rng):
    truth, blurred = box(*SIZE)
    assert mse(blurred, truth) > 1e-3
    assert mse(mixed(truth, blurred).image, truth) < 1e-6


@pytest.mark.parametrize("samples", [1, 4, 16, 64, 256])
def test_the_mixture_is_not_worse_than_either(rng, samples):
    """Of exponential noise, the mean of so many samples; at few of them nothing is lost, at many detail comes back."""
    truth, blurred = box(*SIZE)
    noisy = (truth * rng.gamma(samples, 1 / samples, truth.shape)).astype(np.float32)
    image = mixed(noisy, blurred).image
    assert mse(image, truth) < 1.01 * min(mse(noisy, truth), mse(blurred, truth))
    if samples >= 64:
        assert mse(image, truth) < 0.6 * min(mse(noisy, truth), mse(blurred, truth))


def speckled(rng, height=96, width=128):
    """A wall with a texture of single pixels on half of it, which is lost in the denoised version."""
    wall = np.full((height, width, 3), 0.5, np.float32)
    truth = wall.copy()
    truth[:, : width // 2] *= rng.choice([0.7, 1.3], (height, width // 2, 1)).astype(np.float32)
    return truth, wall


@pytest.mark.slow
def test_texture_of_single_pixels_comes_back_where_blocks_without_noise_are_near(rng):
    """It looks like noise; the wall beside it has none. Of a sky beside it, that says nothing."""
    truth, wall = speckled(rng)
    image, near = mixed(truth, wall).image, np.s_[:, 60:64]
    np.testing.assert_array_equal(image[:, 64:], truth[:, 64:])
    assert mse(image[near], truth[near]) < 0.1 * mse(wall[near], truth[near])
    textured = np.arange(truth.shape[1])[None, :, None] < 64
    sky = np.broadcast_to(textured, truth[..., :1].shape)
    assert mse(mixed(truth, wall, surface=sky).image[:, :64], truth[:, :64]) > 0.5 * mse(wall[:, :64], truth[:, :64])


@pytest.mark.parametrize(("light", "width"), [(3.0, 24), (3.0, 64), (0.4, 16)])
def test_what_shines_in_view_brings_no_noise_back(rng, light, width):
    """A lamp, large or small, and a small screen: neither has noise, and that says nothing of the wall beside it."""
    truth = np.full((96, 160, 3), 0.5, np.float32)
    truth[24:72, 40 : 40 + width] = light
    lit = truth[..., :1] == light
    noisy = np.where(lit, truth, truth * (1 + 0.2 * rng.standard_normal((96, 160, 1)))).astype(np.float32)
    assert mse(mixed(noisy, truth).image, truth) < 0.02 * mse(noisy, truth)


@pytest.mark.parametrize("light", [0.6, 0.9])
def test_a_bright_window_with_little_noise_brings_none_back(rng, light):
    """It is below what a lamp has at least, and motion blur gives it some noise: the wall beside it is no texture."""
    truth = np.full((96, 160, 3), 0.5, np.float32)
    truth[24:72, 40:104] = light
    noise = np.where(truth[..., :1] == light, 0.015, 0.15) * rng.standard_normal((96, 160, 1))
    noisy = (truth * (1 + noise)).astype(np.float32)
    wall = truth[..., 0] == 0.5
    assert mse(mixed(noisy, truth).image[wall], truth[wall]) < 0.05 * mse(noisy[wall], truth[wall])


def test_a_noisy_thing_before_black_stays_denoised(rng):
    """It is far above the median of a frame that a denoiser left a little light everywhere, and is no lamp."""
    truth = np.full((96, 320, 3), 1e-6, np.float32)
    truth[:, 200:] = 0.5
    noisy = (truth * (1 + 0.2 * rng.standard_normal((96, 320, 1)))).astype(np.float32)
    noisy[:, :200] = 0
    inside = np.s_[:, 220:]
    assert mse(mixed(noisy, truth).image[inside], truth[inside]) < 0.01 * mse(noisy[inside], truth[inside])


@pytest.mark.parametrize("sun", [1.0, 4.0])
def test_noise_that_differs_from_place_to_place_does_not_come_back(rng, sun):
    """Quiet blocks beside noisy ones, also where sun is beside shadow: only who blurred lost texture."""
    columns = np.arange(128)[None, :, None] // 16 % 2
    truth = np.broadcast_to(np.where(columns, 0.3, 0.3 * sun), (96, 128, 3)).astype(np.float32)
    noise = np.where(columns, 0.15, 0.06 / sun) * rng.standard_normal((96, 128, 1))
    noisy = (truth * (1 + noise)).astype(np.float32)
    assert mse(mixed(noisy, truth).image, truth) < 0.2 * mse(noisy, truth)


@pytest.mark.parametrize("samples", [0.5, 4, 64])
def test_noise_is_measured_without_bias(rng, samples):
    """Of grey gamma noise, heavy-tailed at few samples; and so far as it is not Winsorized."""
    flat = np.ones((256, 256, 3), np.float32)
    noise = rng.gamma(samples, 1 / samples, (256, 256, 1))
    wanted = np.minimum(noise - 1, 1.05 * BOUND).var() / 1.05**2  # relative to the light and 5 % of its median
    found = mixed((flat * noise).astype(np.float32), flat)
    assert 0.85 < float(np.mean(np.square(found.noise))) / wanted < 1.05


def test_a_bright_speck_in_a_quiet_place_is_a_firefly(rng):
    wall = np.full((64, 64, 3), 0.5, np.float32)
    noisy = wall * (1 + 0.1 * rng.standard_normal((64, 64, 1))).astype(np.float32)
    noisy[20, 20] = 2.0
    image = np.asarray(mixed(noisy, wall).image)
    assert np.abs(image[20, 20] - 0.5).max() < 0.1


@pytest.mark.parametrize(("samples", "trusted"), [(1, True), (16, False), (256, False)])
def test_a_frame_that_lost_more_than_noise_explains_is_not_trusted(rng, samples, trusted):
    """Guides of another picture drew their own pattern into the denoised image; one sample is still worse."""
    truth = np.full((96, 128, 3), 0.5, np.float32)
    pattern = np.kron(rng.uniform(0.3, 1.7, (12, 16, 1)), np.ones((8, 8, 3))).astype(np.float32)
    noisy = (truth * rng.gamma(samples, 1 / samples, truth[..., :1].shape)).astype(np.float32)
    for denoised, expected in ((truth * pattern, trusted), (truth, True)):
        found = mixed(noisy, denoised)
        confidence = measure_confidence(found)
        assert (confidence.doubt < 0.05) if expected else (confidence.doubt > 0.95)
        result = found.image + confidence.fallback * (noisy - found.image)
        best = (
            min(mse(noisy, truth), mse(truth * pattern, truth)) if denoised is not truth else 0.01 * mse(noisy, truth)
        )
        assert mse(result, truth) < 1.01 * best
    assert abs(float(confidence.noise) - samples**-0.5) < 0.15 * samples**-0.5 + 0.01


def test_half_of_a_frame_may_be_clean(rng):
    """Noise on one half is taken away, detail on the other comes back."""
    height, width = 64, 192
    truth, blurred = box(height, width)
    noisy = truth.copy()
    noisy[:, 96:] *= rng.gamma(1.0, 1.0, noisy[:, 96:].shape).astype(np.float32)
    image = np.asarray(mixed(noisy, blurred).image)
    assert mse(image[:, :64], truth[:, :64]) < 1e-3 * mse(blurred[:, :64], truth[:, :64])
    assert mse(image[:, 128:], truth[:, 128:]) < 1.01 * mse(blurred[:, 128:], truth[:, 128:])


@pytest.mark.parametrize("samples", [1, 4])
def test_a_sky_of_most_of_the_frame_costs_no_confidence(rng, samples):
    """The median of the noise counts where there is some: over all of the frame it was 0, and the frame came back."""
    truth = np.full((96, 128, 3), 0.5, np.float32)
    noisy = truth.copy()
    noisy[60:] *= rng.gamma(samples, 1 / samples, noisy[60:].shape[:2] + (1,)).astype(np.float32)
    confidence = measure_confidence(mixed(noisy, truth))
    assert confidence.fallback < 0.01
    assert abs(float(confidence.noise) - samples**-0.5) < 0.2 * samples**-0.5


def test_fireflies_and_invalid_values_do_not_come_back():
    denoised = np.full((*SIZE, 3), 0.5, np.float32)
    noisy = denoised.copy()
    noisy[20, 30], noisy[3, 3, 0], noisy[40, 50] = 200.0, np.nan, np.inf
    found = mixed(noisy, denoised)
    np.testing.assert_allclose(found.image, denoised, atol=1e-6)
    assert np.isfinite(found.noisy_weight).all()


def test_negative_light_of_a_frame_without_noise_comes_back():
    """Colours outside of Rec.709."""
    noisy = np.full((*SIZE, 3), 0.5, np.float32)
    noisy[10:30, 10:40, 0] = -0.3
    np.testing.assert_array_equal(mixed(noisy, np.maximum(noisy, 0)).image, noisy)


@pytest.mark.parametrize("light", [3000.0, 2e6])
@pytest.mark.parametrize("samples", [1, 4, 16])
def test_a_lamp_decides_nothing_elsewhere(rng, samples, light):
    """Whether it is in view or not, and whatever the denoiser made of it."""
    truth, blurred = map(np.array, box(96, 128))
    noisy = (truth * rng.gamma(samples, 1 / samples, truth[..., :1].shape)).astype(np.float32)
    without = np.asarray(mixed(noisy, blurred).image)
    lamp, near = np.s_[4:9, 110:115], np.s_[:64, 64:]
    noisy[lamp] = light
    blurred[lamp] = 0.9 * light
    image = np.asarray(mixed(noisy, blurred).image)
    elsewhere = np.ones(image.shape[:2], bool)
    elsewhere[near] = False
    np.testing.assert_allclose(image[elsewhere], without[elsewhere], rtol=0.01, atol=0.01)
    assert image[lamp].min() > 0.85 * light
    image = np.array(image)
    image[lamp], truth[lamp], noisy[lamp] = 0, 0, 0
    assert mse(image[near], truth[near]) < 0.3 * mse(noisy[near], truth[near])


@pytest.mark.parametrize("unit", [2.0**-30, 2.0**40])
def test_the_unit_of_light_does_not_matter(rng, unit):
    truth, blurred = box(*SIZE)
    noisy = (truth * rng.gamma(16, 1 / 16, truth.shape)).astype(np.float32)
    np.testing.assert_array_equal(mixed(unit * noisy, unit * blurred).image, unit * mixed(noisy, blurred).image)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (3, 2, 3)])
def test_small_and_black_images_stay_finite(shape):
    black = jnp.zeros(shape)
    for noisy in (black, black + 65504.0):
        for denoised in (black, black + 1.0):
            found = mixed(noisy, denoised)
            assert np.isfinite(found.image).all()
            assert np.isfinite(found.noise).all()
            assert np.isfinite(found.lost).all()


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match="noisy and denoised: expected the same size"):
        mixed(jnp.zeros((4, 4, 3)), jnp.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="noisy: expected 3 channels"):
        mixed(jnp.zeros((4, 4, 1)), jnp.zeros((4, 4, 1)))
