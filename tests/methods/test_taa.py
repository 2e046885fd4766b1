"""TAA against float64 loops; what it must do with old light, with noise, and after another denoiser."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.denoiser import Core, recurrent
from jaxdn.denoisers import svgf, taa
from jaxdn.filters import neighbourhood
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.methods.taa import Options, resolve, sharpen
from tests.gradients import check_gradients
from tests.methods.test_svgf import moving_frames

fetch = jax.jit(warp_cubic)
take_step = jax.jit(resolve, static_argnums=0)

HEIGHT, WIDTH = 7, 9
TO_YCOCG = np.array([[1, 2, 1], [2, 0, -2], [-1, 2, -1]]) / [[4], [4], [4]]


def around(image, y, x):
    """The nine neighbours of a pixel, the nearest pixels beyond the border."""
    rows, columns = (np.clip(np.arange(at - 1, at + 2), 0, size - 1) for at, size in ((y, len(image)), (x, WIDTH)))
    return image[np.ix_(rows, columns)].reshape(9, -1)


def reference_fetch(image, motion):
    """Catmull-Rom as the cubic through two pixels with the slopes of their neighbours, per axis."""
    height, width = image.shape[:2]

    def cubic(p, f):
        before, first, second, after = p
        slope, next_slope = (second - before) / 2, (after - first) / 2
        return (
            (2 * f**3 - 3 * f**2 + 1) * first
            + (f**3 - 2 * f**2 + f) * slope
            + (3 * f**2 - 2 * f**3) * second
            + (f**3 - f**2) * next_slope
        )

    out, inside = np.zeros(image.shape), np.zeros((height, width), bool)
    for y, x in np.ndindex(height, width):
        u, v = x + motion[y, x, 0], y + motion[y, x, 1]
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            continue
        top, left = int(np.floor(v)), int(np.floor(u))
        rows = np.clip(np.arange(top - 1, top + 3), 0, height - 1)
        columns = np.clip(np.arange(left - 1, left + 3), 0, width - 1)
        lines = [cubic(image[row, columns], u - left) for row in rows]
        out[y, x], inside[y, x] = np.maximum(cubic(lines, v - top), 0), True
    return out, inside


def reference_resolve(image, history, frame, *, alpha=0.1, box="variance", gamma=1.0, ramp=True, first=False):
    motion, depth = np.asarray(frame.motion, np.float64), np.asarray(frame.depth, np.float64)
    nearest = np.zeros_like(motion)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        depths, motions = around(depth, y, x)[:, 0], around(motion, y, x)
        chosen = 4 if depths[4] == depths.min() else int(np.argmin(depths))
        nearest[y, x] = motions[chosen]
    past, _ = reference_fetch(history, nearest)
    if first:
        past = np.zeros_like(history)
    out = np.zeros_like(history)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        colors = around(image, y, x) @ TO_YCOCG.T
        center, size = colors.mean(0), gamma * colors.std(0)
        if box == "minmax":
            center, size = (colors.max(0) + colors.min(0)) / 2, (colors.max(0) - colors.min(0)) / 2
        if box == "rounded":
            plus = colors[[1, 3, 4, 5, 7]]
            high, low = (colors.max(0) + plus.max(0)) / 2, (colors.min(0) + plus.min(0)) / 2
            center, size = (high + low) / 2, (high - low) / 2
        offset = TO_YCOCG @ past[y, x, :3] - center
        smallest = 1e-3 * abs(center[0]) + 1e-6
        clipped = center + offset / max(1, np.max(np.abs(offset) / np.maximum(size, smallest)))
        clipped = np.maximum(np.linalg.inv(TO_YCOCG) @ clipped, 0)
        length = min(past[y, x, 3], 1 / alpha) + 1
        share = max(alpha, 1 / length) if ramp else alpha if past[y, x, 3] > 0 else 1.0
        out[y, x] = [*(share * image[y, x] + (1 - share) * clipped), length]
    return out


def moving(rng, dtype=np.float64):
    """An image, a history, and a frame with motion by parts of a pixel, some of it unknown or off screen."""
    image = rng.exponential(size=(HEIGHT, WIDTH, 3))
    history = np.concatenate([rng.exponential(size=(HEIGHT, WIDTH, 3)), rng.integers(0, 9, (HEIGHT, WIDTH, 1))], -1)
    motion = rng.uniform(-2, 2, (HEIGHT, WIDTH, 2))
    motion[2, 3] = np.nan
    motion[4:6, :3] = 0.0
    depth = rng.integers(1, 4, (HEIGHT, WIDTH, 1)) * 1.5
    frame = Frame(image.astype(dtype), motion=motion.astype(dtype), depth=depth.astype(dtype))
    return image.astype(dtype), history.astype(dtype), frame


def run(denoiser, frames, params=None):
    """The last state and all images."""
    step = jax.jit(denoiser.step)
    state, images = jax.jit(denoiser.start)(params or {}, frames[0]), []
    for frame in frames:
        state, image = step(params or {}, state, frame)
        images.append(np.asarray(image))
    return state, images


# The formulas.


def test_the_fetch_matches_a_loop(rng):
    _, history, frame = moving(rng, np.float32)
    found = fetch(history, frame.motion)
    expected, on_screen = reference_fetch(history.astype(np.float64), frame.motion.astype(np.float64))
    assert 0 < on_screen.sum() < on_screen.size
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (4, 2)])
def test_the_fetch_of_small_images(size, rng):
    image = rng.random((*size, 2)).astype(np.float32)
    still = fetch(image, np.zeros((*size, 2)))
    np.testing.assert_array_equal(still, image)
    half = fetch(image, np.full((*size, 2), 0.49))
    np.testing.assert_allclose(half, reference_fetch(image, np.full((*size, 2), 0.49))[0], rtol=1e-4, atol=1e-6)


def test_the_neighbourhood_matches_a_loop(rng):
    @jax.jit
    def measure(image):
        boxes = (neighbourhood.box_around(image, box, 1.5) for box in ("variance", "minmax"))
        return *boxes, neighbourhood.extremes_around(image), neighbourhood.mean_around(image)

    image = rng.exponential(size=(HEIGHT, WIDTH, 3))
    (mean, deviation), (center, half), (low, high), plain = jax.tree.map(np.asarray, measure(image))
    for y, x in np.ndindex(HEIGHT, WIDTH):
        nine = around(image, y, x)
        np.testing.assert_allclose(mean[y, x], nine.mean(0), rtol=1e-5)
        np.testing.assert_allclose(plain[y, x], nine.mean(0), rtol=1e-5)
        np.testing.assert_allclose(deviation[y, x], 1.5 * nine.std(0), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(center[y, x] - half[y, x], nine.min(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(center[y, x] + half[y, x], nine.max(0), rtol=1e-5)
        np.testing.assert_array_equal(low[y, x], nine.min(0).astype(np.float32))
        np.testing.assert_array_equal(high[y, x], nine.max(0).astype(np.float32))


def test_ycocg_is_its_matrix_and_inverts(rng):
    image = rng.exponential(size=(3, 4, 3)).astype(np.float32)
    found = jax.jit(neighbourhood.to_ycocg)(image)
    np.testing.assert_allclose(found, image @ TO_YCOCG.T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(jax.jit(neighbourhood.from_ycocg)(found), image, rtol=1e-5, atol=1e-6)


def test_a_clipped_colour_lies_in_the_box_and_towards_its_centre(rng):
    color, center = rng.normal(size=(2, 50, 1, 3))
    size = rng.uniform(0.1, 1, (50, 1, 3))
    found = np.asarray(jax.jit(neighbourhood.clip_to_box)(color, center, size))
    assert (np.abs(found - center) <= size + 1e-5).all()
    parallel = np.cross(found - center, color - center)
    np.testing.assert_allclose(parallel, 0, atol=1e-5)
    inside = (np.abs(color - center) <= size).all(-1)
    assert 0 < inside.sum() < 50
    np.testing.assert_allclose(found[inside], color[inside], rtol=1e-5, atol=1e-6)


def test_a_pixel_takes_the_motion_of_the_nearest_thing_beside_it():
    motion = np.arange(2 * HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH, 2)
    flat = np.full((HEIGHT, WIDTH, 1), 2.0, np.float32)
    nearest_motion = jax.jit(neighbourhood.nearest_motion)
    np.testing.assert_array_equal(nearest_motion(motion, flat), motion)
    flat[3, 4] = 1.0
    found = np.asarray(nearest_motion(motion, flat))
    np.testing.assert_array_equal(found[2:5, 3:6], np.broadcast_to(motion[3, 4], (3, 3, 2)))
    np.testing.assert_array_equal(found[:2], motion[:2])


@pytest.mark.parametrize(
    "options", [{}, {"box": "minmax", "alpha": 0.3}, {"gamma": 2.0}, {"box": "rounded", "ramp": False}]
)
@pytest.mark.parametrize("first", [False, True])
def test_a_step_matches_a_loop(options, first, rng):
    image, history, frame = moving(rng, np.float32)
    found = np.asarray(take_step(Options(**options), image, history, frame, first)[0])
    expected = reference_resolve(image.astype(float), history.astype(float), frame, first=first, **options)
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)
    if first:
        np.testing.assert_array_equal(found[..., :3], image)


@pytest.mark.slow
def test_gradients_of_a_step(rng, x64):
    image, history, frame = moving(rng)
    frame = frame._replace(motion=np.nan_to_num(frame.motion))

    @jax.jit
    def sharp(image, history):
        found, _ = resolve(Options(), image, history, frame, jnp.asarray(False))
        return sharpen(found[..., :3], 0.3)

    check_gradients(sharp, (jnp.asarray(image), jnp.asarray(history) + 0.1), eps=1e-6)


# The denoiser.


@pytest.mark.parametrize("options", [{}, {"box": "minmax"}, {"sharpening": 1.0}])
def test_a_constant_image_stays(options, rng):
    frames = [frame._replace(radiance=np.full_like(frame.radiance, 0.37)) for frame in moving_frames(rng)]
    for image in run(taa(**options), frames)[1]:
        np.testing.assert_allclose(image, 0.37, rtol=1e-5)


def test_a_still_scene_is_the_mean_of_its_frames_until_the_weight_is_alpha(rng):
    """With a box that excludes nothing: the variance of noise falls as 1 / N."""
    noise = rng.uniform(0.5, 1.5, (12, 20, 30, 3)).astype(np.float32)
    _, images = run(taa(alpha=0.125, gamma=1e3), [Frame(radiance) for radiance in noise])
    for index in range(8):
        np.testing.assert_allclose(images[index], noise[: index + 1].mean(0), rtol=1e-5)
        assert images[index].var() * (index + 1) / noise.var() == pytest.approx(1, rel=0.1)
    np.testing.assert_allclose(images[11], 0.125 * noise[11] + 0.875 * images[10], rtol=1e-5)


def test_old_light_is_gone_at_once_where_there_is_no_noise(rng):
    bright = Frame(np.full((20, 30, 3), 5.0, np.float32))
    dark = Frame(rng.uniform(0.99, 1.01, (20, 30, 3)).astype(np.float32))
    _, images = run(taa(), [bright] * 10 + [dark])
    np.testing.assert_allclose(images[-1], 1.0, atol=0.02)
    _, kept = run(taa(gamma=1e4), [bright] * 10 + [dark])
    assert kept[-1].mean() > 4


def test_what_leaves_the_screen_has_no_history(rng):
    _, history, frame = moving(rng, np.float32)
    away = frame._replace(motion=np.full_like(frame.motion, 100.0))
    found = np.asarray(take_step(Options(), frame.radiance, history, away, False)[0])
    np.testing.assert_array_equal(found[..., :3], frame.radiance)
    np.testing.assert_array_equal(found[..., 3], 1.0)


def test_a_broken_history_is_dropped_and_counted(rng):
    frame = Frame(rng.random((5, 6, 3)).astype(np.float32))
    denoiser = taa()
    state, _ = run(denoiser, [frame])
    history = np.array(state.core.history)
    history[2, 3, 1] = np.nan
    after, image = jax.jit(denoiser.step)({}, state._replace(core=state.core._replace(history=history)), frame)
    assert np.isfinite(image).all()
    assert int(after.sanitized) == 1
    assert np.asarray(after.core.history)[2, 3, 3] == 1.0


def test_none_is_the_neutral_value_written_out(rng):
    frames = [Frame(rng.random((6, 8, 3)).astype(np.float32)) for _ in range(3)]
    written = [
        frame._replace(motion=np.zeros((6, 8, 2), np.float32), depth=np.zeros((6, 8, 1), np.float32))
        for frame in frames
    ]
    denoiser = taa()
    expected = run(denoiser, written)[1]
    for one, two in zip(run(denoiser, frames)[1], expected, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6)
    only_motion = [frame._replace(depth=None) for frame in written]
    np.testing.assert_allclose(run(denoiser, only_motion)[1][-1], expected[-1], rtol=1e-6)


def test_sharpening_changes_the_image_and_not_the_history(rng):
    frames = [Frame(rng.random((8, 9, 3)).astype(np.float32)) for _ in range(3)]
    plain, images = run(taa(), frames)
    sharp, sharper = run(taa(sharpening=0.5), frames)
    np.testing.assert_array_equal(plain.core.history, sharp.core.history)
    low, high = map(np.asarray, jax.jit(neighbourhood.extremes_around)(images[-1]))
    expected = images[-1] + 0.5 * (images[-1] - np.asarray(jax.jit(neighbourhood.mean_around)(images[-1])))
    np.testing.assert_allclose(sharper[-1], np.clip(expected, low, high), rtol=1e-5)
    assert sharper[-1].std() > images[-1].std()


@pytest.mark.slow
def test_after_a_denoiser_it_smooths_that_ones_images(rng):
    frames, before = moving_frames(rng), svgf(levels=1)
    state, images = run(taa(after=before), frames)
    denoised = run(before, frames)[1]
    alone = [frame._replace(radiance=image) for frame, image in zip(frames, denoised, strict=True)]
    for image, expected in zip(images, run(taa(), alone)[1], strict=True):
        np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5)
    assert taa(after=before).reads == before.reads | {"motion", "depth"}
    assert state.core.after.history.shape[-1] == 6 + 3  # the texture of the light, too


def test_after_a_denoiser_its_parameters_samples_and_sanitizing_stay_its_own(rng):
    def step(params, state, frame, first, statistics):
        return state + 1, params["gain"] * frame.radiance, 2

    core = Core(
        lambda params, frame: jnp.zeros(()),
        step,
        frozenset({"albedo"}),
        lambda key, frame: {"gain": jnp.float32(3.0)},
        lambda params, state, frame, first, most: 4 * jnp.ones_like(frame.radiance[..., :1]) + state,
    )
    frame = Frame(rng.random((4, 5, 3)).astype(np.float32))
    frame = frame._replace(radiance=np.where(np.arange(5)[:, None] == 2, np.nan, frame.radiance))
    denoiser = taa(after=recurrent(core), gamma=100.0)  # a box that holds every pixel
    params = denoiser.init(jax.random.key(0), frame)
    assert denoiser.samples is not None
    state, images = run(denoiser, [frame] * 2, params)
    np.testing.assert_allclose(images[-1], 3 * np.nan_to_num(frame.radiance), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(denoiser.samples(params, state, frame, 7), 6)
    # Two frames: 12 values of each, and two that the denoiser before has lost in each.
    assert int(state.sanitized) == 2 * 12 + 2 * 2


def test_options_that_cannot_be_raise():
    with pytest.raises(ValueError, match=r"taa after: expected a Denoiser or None, got 'svgf'"):
        taa(after="svgf")
    with pytest.raises(ValueError, match="box"):
        taa(box="mean")
    with pytest.raises(ValueError, match="alpha"):
        taa(alpha=0.0)
