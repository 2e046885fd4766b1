"""``reblur``: discs that shrink, mirrors that stay sharp, light that changes."""

import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.methods.two_lobes.reblur import reblur
from tests.methods.lobe_scenes import compiled, mirror_frames, run, starting

UNHELD = {"fix_frames": 0, "clamp_sigma": 1e6, "lag_sigma": 1e6, "demodulate": "none"}
"""The two means, neither filled nor clamped."""
DISCS = reblur(pre_radius=0.0, radius=8.0, radius_min=0.5, stable_max=1, **UNHELD)
MEANS = reblur(pre_radius=6.0, radius=0.0, stable_sigma=2.0, **UNHELD)
ROWS, COLUMNS = 48, 64
EDGE = np.where(np.arange(COLUMNS) < COLUMNS // 2, 1.0, 2.0)[None, :, None] * np.ones((ROWS, 1, 3), np.float32)
SPREADS = {"four taps": (4 * np.exp(-0.66) / 2, 1 + 4 * np.exp(-0.66))}
SPREADS["eight taps"] = tuple(
    one + more for one, more in zip(SPREADS["four taps"], (4 * np.exp(-0.165) / 8, 4 * np.exp(-0.165)), strict=True)
)
"""Of a disc of radius 1 whose taps have the weight exp(-0.66 r^2): the weighted sum of x^2, and that of the weights.

Four taps are on the rim, four more at half the radius, and the pixel itself has the weight 1."""


def spread_of(name, radius):
    """The variance in pixels of the kernel of a disc along one axis."""
    squares, weights = SPREADS[name]
    return radius**2 * squares / weights


def spread(image):
    """The variance in pixels of what has blurred the edge, along its normal."""
    slope = np.diff(np.asarray(image, np.float64).mean((0, 2)))[4:-4]
    place = np.arange(len(slope)) - (len(slope) - 1) / 2
    return np.sum(slope * place**2) / np.sum(slope)


def glossy_edge(radiance, specular, hit_distance):
    """A frame of a surface 5 away whose specular light is as wide as diffuse light."""
    one = np.ones((ROWS, COLUMNS, 1))
    buffers = {"specular": specular, "depth": 5 * one, "roughness": one, "specular_hit_distance": hit_distance * one}
    return Frame(radiance.astype(np.float32), **{name: np.asarray(each, np.float32) for name, each in buffers.items()})


def after_edges(denoiser, frames_before, *, turned=0):
    """The state and the image of the edge, seen after as many frames, whose history is the edge itself."""
    frame = Frame(EDGE.astype(np.float32))
    step, state = compiled(denoiser), starting(denoiser)({}, frame)
    state, _ = step({}, state, frame)
    light = state.core.light
    planes = light.diffuse.at[..., :3].set(frame.radiance).at[..., 4:7].set(frame.radiance)
    light = light._replace(diffuse=planes.at[..., 3].set(frames_before))
    state, image = step(
        {}, state._replace(core=state.core._replace(light=light, frame=state.core.frame + turned)), frame
    )
    return state, np.asarray(image)


def test_light_that_doubles_arrives_within_the_slow_historys_length(rng):
    """Within 5 %; a running mean of 30 frames alone takes 89."""
    light = rng.gamma(4.0, 0.25, (60, 24, 24, 3)).astype(np.float32)
    light[30:] *= 2.0
    means = [image.mean() for image in run(reblur(), [Frame(each) for each in light])[1]]
    assert abs(means[29] - 1.0) < 0.05
    assert abs(means[55] - 2.0) < 0.1


@pytest.mark.slow
def test_near_light_is_blurred_least(rng):
    """The sharpness of an edge of light: it is blurred less with a nearer occluder."""
    light = np.where(np.arange(40) < 20, 1.0, 2.0)[None, :, None] * np.ones((40, 1, 3))
    depth = np.full((40, 40, 1), 5.0, np.float32)

    def slope(hit_distance):
        frame = Frame(light.astype(np.float32), depth=depth, hit_distance=np.full_like(depth, hit_distance))
        image = run(reblur(pre_radius=0.0, radius=8.0, fix_frames=0, stable_max=1), [frame])[1][-1]
        return np.mean(image[8:-8, 20] - image[8:-8, 19])

    assert slope(5.0) < 0.5 * slope(0.05)
    np.testing.assert_allclose(slope(5.0), slope(0.0), rtol=1e-4)  # unknown counts as far


@pytest.mark.parametrize("number", [1, 4, 9])
def test_two_discs_shrink_as_the_root_of_the_number_of_frames(number):
    """The second is twice as wide as the first: with radius r their variances add up to that of 5 r^2."""
    _, image = after_edges(DISCS, number - 1)
    expected = spread_of("eight taps", 8.0 / np.sqrt(number)) * 5
    np.testing.assert_allclose(spread(image), expected, rtol=0.1)


def test_the_history_is_the_blurred_image():
    state, image = after_edges(DISCS, 3)
    np.testing.assert_allclose(state.core.light.diffuse[..., :3], image, rtol=1e-6)
    assert np.abs(image - EDGE).max() > 0.1


def test_four_taps_blur_the_frame_before_it_is_accumulated():
    _, image = after_edges(MEANS, 0)
    np.testing.assert_allclose(spread(image), spread_of("four taps", 6.0), rtol=0.1)


@pytest.mark.slow
def test_discs_turn_with_the_frame_the_disc_and_the_kind_of_light():
    """What the taps of one frame miss those of others find: along the edge, their mean is smoother than each."""
    images = np.stack([after_edges(DISCS, 3, turned=turned)[1][..., 0] for turned in range(12)])
    roughness = [np.mean(np.var(each[:, 24:40], axis=0)) for each in (*images, images.mean(0))]
    assert roughness[-1] < 0.2 * np.mean(roughness[:-1])
    light = run(DISCS, [glossy_edge(2.0 * EDGE, EDGE, 5.0)])[0].core.light
    assert np.abs(light.diffuse[..., 0] - light.specular[..., 0]).max() > 0.05


def test_a_luminance_is_steadied_by_what_the_image_shows_around_it(rng):
    """Against NumPy: the kept one within two deviations of 3x3 pixels, with the weight 1 - 1 / N."""
    frame = Frame(rng.uniform(0.5, 1.5, EDGE.shape).astype(np.float32))
    state, _ = run(MEANS, [frame] * 3)
    light = state.core.light
    kept = (rng.uniform(0.0, 2.0, EDGE.shape[:2])).astype(np.float32)
    steadied = state._replace(
        core=state.core._replace(light=light._replace(diffuse=light.diffuse.at[..., 7].set(kept)))
    )
    state, image = compiled(MEANS)({}, steadied, frame)
    held = np.asarray(state.core.light.diffuse[..., :3], np.float64)
    weights = np.array([0.2126, 0.7152, 0.0722])
    level = held @ weights
    near = np.lib.stride_tricks.sliding_window_view(level, (3, 3))
    mean, deviation = near.mean((2, 3)), near.std((2, 3))
    inside = level[1:-1, 1:-1]
    low, high = np.minimum(mean - 2 * deviation, inside), np.maximum(mean + 2 * deviation, inside)
    expected = inside + 0.75 * (np.clip(kept[1:-1, 1:-1], low, high) - inside)
    np.testing.assert_allclose((np.asarray(image) @ weights)[1:-1, 1:-1], expected, rtol=1e-4)


@pytest.mark.slow
def test_what_is_reflected_from_far_is_not_mixed_with_what_is_near():
    """A bright reflection of something near beside a dark one of something far: taps of the other weigh a tenth."""
    light = 2.0 - EDGE

    def leaked(far):
        image = run(DISCS, [glossy_edge(light, light, np.where(light > 0, 5.0, far)[..., :1])])[1][0]
        return float(np.mean(image[:, COLUMNS // 2 : COLUMNS // 2 + 4]))

    assert 0.0 < leaked(45.0) < 0.35 * leaked(5.0)


@pytest.mark.slow
def test_a_mirror_is_not_blurred(rng):
    _, frames = mirror_frames(rng, 1)
    _, images = run(reblur(), frames)
    np.testing.assert_allclose(images[0], frames[0].radiance, rtol=2e-5)


@pytest.mark.parametrize(
    ("options", "word"),
    [({"radius": -1.0}, "radius"), ({"stable_max": 0}, "stable_max"), ({"fast_max": 0}, "fast_max")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        reblur(**options)
