"""SVGF against a float64 reference written pixel by pixel, and what must hold for any filter of its kind."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import FAR, Clip, Frame, frame_at
from jaxdn.denoiser.rollout import denoise
from jaxdn.filters.atrous import B3_SPLINE, edge_average, stencil
from jaxdn.filters.cascade import cascade
from jaxdn.filters.edge_stopping import Weight, depth_weight, luminance_weight
from jaxdn.methods.registry import methods
from jaxdn.methods.svgf import svgf
from tests.gradients import check_gradients

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
HEIGHT, WIDTH = 10, 12
DENOISER = svgf(sigma_normal=128.0, levels=3)
START, STEP = jax.jit(DENOISER.start), jax.jit(DENOISER.step)
LEARNING = svgf(levels=3)


def moving_frames(rng, count=3, dtype=np.float32):
    """A slanted plane behind a box that slides to the right while the camera pans by parts of a pixel; sky above."""
    frames = []
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    for index in range(count):
        ids = np.zeros((HEIGHT, WIDTH), np.int32)
        depth = 6 + 0.3 * x + 0.1 * y
        normal = np.broadcast_to(np.array([0.0, 0.6, -0.8]), (HEIGHT, WIDTH, 3)).copy()
        motion = np.broadcast_to(np.array([0.4, -0.3]), (HEIGHT, WIDTH, 2)).copy()
        previous = depth + 0.3 * 0.4 - 0.1 * 0.3
        left = 2 + index
        box = (x >= left) & (x < left + 5) & (y >= 4) & (y < 8)
        ids[box], depth[box], previous[box] = 3, 3.0, 3.05
        normal[box] = np.array([0.05, 0.0, -1.0]) / np.hypot(0.05, 1.0)
        motion[box] = np.array([-1.25, 0.5])
        sky = y < 1
        ids[sky], depth[sky], previous[sky], normal[sky] = -1, FAR, FAR, 0.0
        motion[2, 3] = np.nan
        buffers = {
            "radiance": rng.gamma(0.5, 1.0, (HEIGHT, WIDTH, 3)),
            "albedo": np.where(rng.random((HEIGHT, WIDTH, 3)) < 0.1, 0.0, rng.uniform(0.1, 1.0, (HEIGHT, WIDTH, 3))),
            "normal": normal,
            "depth": depth[..., None],
            "previous_depth": previous[..., None],
            "motion": motion,
        }
        frames.append(Frame(**{k: v.astype(dtype) for k, v in buffers.items()}, ids=ids[..., None]))
    return frames


# The reference: plain loops, float64, written from the equations.


def reference_slopes(depth, ids):
    out = np.zeros((*depth.shape, 2))
    height, width = depth.shape
    for y in range(height):
        for x in range(width):
            for axis, (dy, dx) in enumerate(((0, 1), (1, 0))):
                found = []
                for sign in (1, -1):
                    v, u = y + sign * dy, x + sign * dx
                    if 0 <= v < height and 0 <= u < width and ids[v, u] == ids[y, x]:
                        found.append(sign * (depth[v, u] - depth[y, x]))
                out[y, x, axis] = min(found, key=abs) if found else 0.0
    return out


def reference_average(values, taps, p, geometry, step=1, light=None, variance=None):
    """Mean of values [H,W,C] at p = (y, x) and the variance of the mean; geometry = (hit, depth, slopes, normal)."""
    hit, depth, slopes, normal = geometry
    height, width = depth.shape
    y, x = p
    total, weights, spread = 0.0, 0.0, 0.0
    for dy, dx, h in taps:
        v, u = y + int(dy) * step, x + int(dx) * step
        if not (0 <= v < height and 0 <= u < width) or not hit[v, u]:
            continue
        w = h
        if (dy, dx) != (0, 0):
            offset = np.array([dx, dy]) * step
            eps = 1e-3 * depth[p] * np.hypot(*offset) / height
            w *= np.exp(-abs(depth[p] - depth[v, u]) / (abs(slopes[p] @ offset) + eps))
            w *= max(0.0, normal[p] @ normal[v, u]) ** 128
            if light is not None:
                w *= np.exp(-abs(light[0][p] - light[0][v, u]) / (4 * light[1][p] + 1e-4))
        total, weights = total + w * values[v, u], weights + w
        spread += 0 if variance is None else w * w * variance[v, u]
    return total / weights, spread / weights**2


def reference_blur(variance):
    wide = np.pad(variance, 1, mode="edge")
    kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16
    return sum(
        kernel[i, j] * wide[i : i + variance.shape[0], j : j + variance.shape[1]] for i in range(3) for j in range(3)
    )


def reference_history(past, frame, p, expected_tolerance):
    """Mean of the accepted taps of past = (history, depth, normal, ids) for pixel p, or None."""
    history, depth, normal, ids = past
    height, width = depth.shape
    y, x = p
    m = frame.motion[p].astype(np.float64)
    if not np.isfinite(m).all():
        return None

    def accepted(v, u):
        if not (0 <= v < height and 0 <= u < width):
            return False
        expected, tolerance = expected_tolerance
        close = abs(depth[v, u] - expected[p]) <= tolerance[p]
        return close and normal[v, u] @ frame.normal[p] > 0.9 and ids[v, u] == frame.ids[p][0]

    row, column = y + m[1], x + m[0]
    top, left = int(np.floor(row)), int(np.floor(column))
    total, weights = np.zeros(9), 0.0
    for v in (top, top + 1):
        for u in (left, left + 1):
            share = (1 - abs(row - v)) * (1 - abs(column - u))
            if accepted(v, u):
                total, weights = total + share * history[v, u], weights + share
    if weights >= 0.01:
        return total / weights
    near = int(np.floor(row + 0.5)), int(np.floor(column + 0.5))
    found = [
        history[near[0] + i, near[1] + j] for i in (-1, 0, 1) for j in (-1, 0, 1) if accepted(near[0] + i, near[1] + j)
    ]
    return np.mean(found, axis=0) if found else None


def reference_step(past, frame, levels=3, *, published=False):
    """One frame; ``published``: a constant weight, the variance alone from neighbours, light divided by the albedo."""
    frame = Frame(*(None if b is None else np.asarray(b, np.float64) for b in frame))
    ids, depth = frame.ids[..., 0], frame.depth[..., 0]
    hit = (ids >= 0) & (depth < FAR)
    slopes = reference_slopes(depth, ids)
    geometry = (hit, depth, slopes, frame.normal)
    expected = frame.previous_depth[..., 0]
    tolerance = 0.02 * expected + 2 * np.abs(slopes).sum(-1)
    divisor = ((frame.albedo**4 + 0.15**4) / (1 + 0.15**4)) ** 0.25
    incident = frame.radiance / divisor
    light = incident @ LUMINANCE
    left = np.minimum(frame.albedo / divisor, 1.0)
    left = (left + 0.3) / (left.max(-1, keepdims=True) + 0.3)
    if published:
        divisor, left = np.where(frame.albedo > 0.01, frame.albedo, 1.0), np.ones_like(left)
        incident = frame.radiance / divisor
        light = incident @ LUMINANCE
    history = np.zeros((HEIGHT, WIDTH, 9))
    for p in np.ndindex(HEIGHT, WIDTH):
        fetched = None if past is None else reference_history(past, frame, p, (expected, tolerance))
        now = np.concatenate([incident[p], [light[p], light[p] ** 2]])
        if fetched is None:
            history[p] = [*now, 1.0, *left[p]]
        else:
            length = min(fetched[5] + 1, 32)
            share = 0.2 if published else max(0.2, 1 / length)
            mean, texture = (1 - share) * fetched[:5] + share * now, (1 - share) * fetched[6:] + share * left[p]
            history[p] = [*mean, length, *texture]
    # The history's light had the mean texture; that of this frame is filtered.
    mean_texture, kept_moments = history[..., 6:].copy(), history[..., 3:5].copy()
    grey = (left @ LUMINANCE + 0.01) / (mean_texture @ LUMINANCE + 0.01)
    history[..., :3] *= (left + 0.01) / (mean_texture + 0.01)
    history[..., 3] *= grey
    history[..., 4] *= grey**2
    color = np.concatenate([history[..., :3], left], axis=-1)
    variance = np.maximum(history[..., 4] - history[..., 3] ** 2, 0)
    seven = [(dy, dx, 1.0) for dy in range(-3, 4) for dx in range(-3, 4)]
    for p in np.ndindex(HEIGHT, WIDTH):
        if history[p][5] < 4 and hit[p]:
            mean, _ = reference_average(np.concatenate([history[..., :5], left], axis=-1), seven, p, geometry)
            if published:
                variance[p] = max(0, mean[4] - mean[3] ** 2)
                continue
            color[p][:3] = mean[:3] * (left[p] + 0.01) / (mean[5:] + 0.01)
            grey = (left[p] @ LUMINANCE + 0.01) / (mean[5:] @ LUMINANCE + 0.01)
            variance[p] = max(0, mean[4] - mean[3] ** 2) * 4 / history[p][5] * grey**2
    spline = np.array([1, 4, 6, 4, 1]) / 16
    taps = [(i - 2, j - 2, spline[i] * spline[j]) for i in range(5) for j in range(5)]
    for level in range(levels):
        guide = np.sqrt(np.maximum(reference_blur(variance), 1e-10))
        levels_light = color[..., :3] @ LUMINANCE
        filtered, spread = color.copy(), variance.copy()
        for p in np.ndindex(HEIGHT, WIDTH):
            if hit[p]:
                filtered[p], spread[p] = reference_average(
                    color, taps, p, geometry, 2**level, (levels_light, guide), variance
                )
        # A pixel that sees nothing has no variance of its own; the blur of the next level may look at it.
        color, variance = filtered, spread
        if level == 0:
            feedback = color
    color, feedback = (one[..., :3] * (left + 0.01) / (one[..., 3:] + 0.01) for one in (color, feedback))
    image = np.where(hit[..., None], color * divisor, frame.radiance)
    feedback = feedback * (mean_texture + 0.01) / (left + 0.01)
    kept = np.concatenate([feedback, kept_moments, history[..., 5:]], axis=-1)
    return (kept, depth, frame.normal, ids), image, hit


def test_four_frames_match_the_reference(rng):
    frames = moving_frames(rng, 4)
    state, past = START({}, frames[0]), None
    lengths = []
    for frame in frames:
        state, image = STEP({}, state, frame)
        past, expected, hit = reference_step(past, frame)
        np.testing.assert_allclose(image, expected, rtol=2e-3, atol=2e-4)
        history = np.asarray(state.core.history)[hit]
        np.testing.assert_allclose(history, past[0][hit], rtol=2e-3, atol=2e-4)
        lengths.append(history[:, 5])
    # The clip exercises what it should: short and long histories, and their mixtures.
    assert (lengths[0] == 1).all()
    assert (lengths[2] == 1).any()
    assert (lengths[2] == 3).any()
    assert (lengths[3] == 4).any()  # from there on the variance is that over time


def test_pixels_without_a_surface_pass_through(rng):
    frame = moving_frames(rng, 1)[0]
    _, image = STEP({}, START({}, frame), frame)
    # Divided by the albedo and multiplied by it again, which rounds twice; untouched where nothing is divided.
    np.testing.assert_allclose(image[0], frame.radiance[0], rtol=2 * float(np.finfo(np.float32).eps))
    plain = frame._replace(albedo=None)
    _, image = STEP({}, START({}, plain), plain)
    np.testing.assert_array_equal(image[0], frame.radiance[0])


def test_a_constant_image_stays(rng):
    frame = moving_frames(rng, 1)[0]
    frame = frame._replace(radiance=frame.albedo * 0 + np.float32(0.37), albedo=np.full_like(frame.albedo, 0.6))
    state = START({}, frame)
    for _ in range(3):
        state, image = STEP({}, state, frame)
        np.testing.assert_allclose(image, 0.37, rtol=1e-5)


@pytest.mark.parametrize("levels", [5, 0])
def test_colours_of_a_texture_do_not_run(rng, levels):
    """Even light on a checkerboard of purple, white and red: green does not flow from white to purple.

    Nor in the mean around pixels whose history is short, which is all that is left without levels.
    """
    frame = moving_frames(rng, 1)[0]
    squares = np.float32([[0.26, 0.002, 0.36], [0.8, 0.8, 0.8], [0.5, 0.01, 0.02], [0.4, 0.6, 0.5]])
    albedo = squares[np.indices((HEIGHT, WIDTH)).sum(0) % 4]
    frame = Frame(radiance=0.4 * albedo, albedo=albedo, reflectance=albedo + np.float32(1e-4))
    denoiser = svgf(sigma_normal=128.0, levels=levels, feedback_level=min(levels, 1))
    state, step = denoiser.start({}, frame), jax.jit(denoiser.step)
    for _ in range(3):
        state, image = step({}, state, frame)
    np.testing.assert_allclose(image, frame.radiance, atol=0.01)


def test_static_history_counts_up_and_is_the_mean_while_it_does(rng):
    denoiser = svgf(levels=1, feedback_level=0, history_max=6, demodulate="none")
    step = jax.jit(denoiser.step)
    noise = rng.gamma(0.5, 1.0, (8, 6, 7, 3)).astype(np.float32)
    state = denoiser.start({}, Frame(noise[0]))
    for index, radiance in enumerate(noise):
        state, _ = step({}, state, Frame(radiance))
        length = min(index + 1, 6)
        np.testing.assert_array_equal(state.core.history[..., 5], length)
        if index < 5:  # 1/N is still at least alpha
            seen = noise[: index + 1].astype(np.float64)
            np.testing.assert_allclose(state.core.history[..., :3], seen.mean(0), rtol=1e-5)
            light = seen @ LUMINANCE
            moments = np.stack([light.mean(0), (light**2).mean(0)], -1)
            np.testing.assert_allclose(state.core.history[..., 3:5], moments, rtol=1e-5)
    assert int(state.age) == 8


def test_variance_of_white_noise_after_one_level():
    """All weights open: the 5x5 B3 kernel leaves (70/256)^2 = 0.0747681 of the variance, and the mean."""
    values = jnp.ones((3, 15, 17))
    mean, variance = edge_average(values, None, [], stencil(2, kernel=B3_SPLINE), variance=jnp.full((15, 17), 2.0))
    np.testing.assert_allclose(mean, 1.0, rtol=1e-6)
    np.testing.assert_allclose(variance[2:-2, 2:-2], 2.0 * 0.0747681, rtol=1e-5)
    assert float(variance[0, 0]) > 2.0 * 0.0747681  # half the taps at the border


def test_strips_do_not_show(rng, monkeypatch):
    values = rng.random((2, 19, 11)).astype(np.float32)
    depth = (3 + rng.random((19, 11, 1))).astype(np.float32)
    needed = np.zeros((19, 11), bool)
    needed[9, 4] = True

    def average(**given):
        """Compiled at each call: it has the strips of that moment."""

        def run(values, depth, given):
            weights = [depth_weight(depth, None, sigma=1.0, height=len(depth))]
            return edge_average(values, None, weights, stencil(3), **given)[0]

        return np.asarray(jax.jit(run)(values, depth, given))

    whole = average()
    monkeypatch.setattr("jaxdn.filters.stencil_tiles._STRIP_PIXELS", 1)
    strips, some = average(), average(needed=needed)
    np.testing.assert_allclose(strips, whole, rtol=1e-6)
    np.testing.assert_allclose(some[:, 8:16], whole[:, 8:16], rtol=1e-6)
    np.testing.assert_array_equal(some[:, 16:], 0)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False], ids=["with-background", "surfaces-alone"])
def test_strips_of_a_cascade_do_not_show(rng, monkeypatch, masked):
    """Nor in its gradient; the last strip has rows below the image."""
    color = jnp.asarray(rng.random((5, 21, 11)), jnp.float32)
    depth = jnp.asarray(3 + rng.random((21, 11, 1)), jnp.float32)
    hit = jnp.asarray(rng.random((21, 11)) > 0.2) if masked else None
    options = {"levels": 3, "sigma_luminance": 2.0, "feedback_level": 1}

    def filtered(color):
        weights = [depth_weight(depth, None, sigma=1.0, height=len(depth))]
        taps = stencil(2, kernel=B3_SPLINE)
        return jnp.stack(cascade(color, color[0] ** 2, hit, lambda level: weights, taps, **options))

    def with_slope(color, away):
        image, pull = jax.vjp(filtered, color)
        return image, pull(away)[0]

    away = jnp.asarray(rng.random(jax.eval_shape(filtered, color).shape), jnp.float32)
    whole, slope = jax.jit(lambda *given: with_slope(*given))(color, away)
    monkeypatch.setattr("jaxdn.filters.stencil_tiles._STRIP_PIXELS", 1)
    strips, slope_of_strips = jax.jit(lambda *given: with_slope(*given))(color, away)
    np.testing.assert_allclose(strips, whole, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(slope_of_strips, slope, rtol=1e-4, atol=1e-5)
    if masked:
        np.testing.assert_array_equal(strips[0][:, ~hit], 0)


def test_the_first_frame_reads_no_history_and_no_motion(rng):
    frame = moving_frames(rng, 1)[0]
    clean = START({}, frame)
    poisoned = clean._replace(core=jax.tree.map(lambda leaf: leaf * np.nan, clean.core))
    elsewhere = frame._replace(motion=np.full_like(frame.motion, 3.3))
    expected_state, expected = STEP({}, clean, frame)
    for state, given in ((poisoned, frame), (clean, elsewhere)):
        after, image = STEP({}, state, given)
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_array_equal(after.core.history, expected_state.core.history)


def test_broken_history_is_dropped_where_it_is_broken(rng):
    frames = moving_frames(rng, 2)
    state, _ = STEP({}, START({}, frames[0]), frames[0])
    broken = state._replace(core=state.core._replace(history=state.core.history.at[6, 4, 1].set(np.nan)))
    after, image = STEP({}, broken, frames[1])
    assert np.isfinite(image).all()
    assert np.isfinite(after.core.history).all()
    assert int(after.sanitized) > int(STEP({}, state, frames[1])[0].sanitized)


NEUTRAL = {"albedo": 1.0, "motion": 0.0, "depth": 0.0, "normal": 0.0}


def neutral(frame, names, *, written):
    """The frame with these buffers absent, or with the same said by their neutral values."""
    values = dict.fromkeys(names)
    if written:
        values = {name: np.full_like(getattr(frame, name), NEUTRAL.get(name, 0.0)) for name in names}
        if "previous_depth" in names and "depth" not in names:
            values["previous_depth"] = frame.depth
    return frame._replace(**values)


@pytest.mark.parametrize("names", [("motion", "previous_depth"), (*NEUTRAL, "previous_depth")], ids=["motion", "all"])
def test_none_is_the_neutral_value_written_out(rng, names):
    frames = moving_frames(rng, 2)
    images = []
    for written in (True, False):
        given = [neutral(frame, names, written=written) for frame in frames]
        state = START({}, given[0])
        for frame in given:
            state, image = STEP({}, state, frame)
        images.append(image)
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name", [*NEUTRAL, "previous_depth"])
def test_an_absent_buffer_leaves_no_operation(rng, name):
    frame = moving_frames(rng, 1)[0]
    if name == "depth":
        frame = frame._replace(previous_depth=None)
    sizes = []
    for written in (True, False):
        given = neutral(frame, (name,), written=written)
        lowered = jax.jit(DENOISER.step).lower({}, START({}, given), given)
        sizes.append(len(lowered.as_text().splitlines()))
    assert sizes[1] < sizes[0]


POISON = [np.nan, np.inf, -np.inf, 1e30, -1.0]


@pytest.mark.slow
def test_poison_stays_local_and_leaves(rng):
    """One bad pixel in each buffer: finite everywhere, changed within the footprint only, gone when history ran out.

    The footprint of 1 level after a 7x7 estimate is 3 + 2 + 1 px, of the history one pixel more a frame. With
    ``history_max`` the poisoned frame's share falls by 1 - alpha a frame; where the renderer repeats the same data the
    first-moment history forgets 1e-4 of the clamped value only after 60 frames, so the test shortens alpha to 1.
    """
    denoiser = svgf(levels=1, alpha=1.0, alpha_moments=1.0)
    step = jax.jit(denoiser.step)
    size = 24
    radiance = rng.gamma(0.5, 1.0, (size, size, 3)).astype(np.float32)
    ones = np.ones((size, size, 1), np.float32)
    clean = Frame(
        radiance,
        albedo=np.full((size, size, 3), 0.5, np.float32),
        normal=ones * np.array([[[0, 0, 1]]], np.float32),
        depth=5 * ones,
        previous_depth=5 * ones,
        motion=np.zeros((size, size, 2), np.float32),
    )

    def run(frames):
        state, images = denoiser.start({}, clean), []
        for frame in frames:
            state, image = step({}, state, frame)
            images.append(np.asarray(image))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
        return images

    expected = run([clean] * 8)
    rows, columns = np.mgrid[:size, :size]
    for name in ("radiance", "albedo", "normal", "depth", "previous_depth", "motion"):
        for value in POISON:
            bad = np.array(getattr(clean, name))
            bad[12, 12, 0] = value
            images = run([clean, clean._replace(**{name: bad}), *[clean] * 6])
            for index, (image, truth) in enumerate(zip(images, expected, strict=True)):
                assert np.isfinite(image).all()
                assert (image >= 0).all()
                reach = 6 + max(0, index - 1)
                outside = np.maximum(abs(rows - 12), abs(columns - 12)) > reach
                np.testing.assert_allclose(image[outside], truth[outside], rtol=1e-5, err_msg=f"{name} {value} {index}")
            # N is back at 4 five frames later: nothing tells the clips apart.
            np.testing.assert_allclose(images[7], expected[7], rtol=1e-4, atol=1e-5, err_msg=f"{name} {value}")


@pytest.mark.slow
def test_a_clip_is_one_program_and_vmap_is_a_loop(rng):
    frames = jax.tree.map(lambda *b: np.stack(b), *moving_frames(rng, 4))
    traced = 0

    def body(state, frame):
        nonlocal traced
        traced += 1
        return DENOISER.step({}, state, frame)

    start = START({}, jax.tree.map(lambda b: b[0], frames))
    _, images = jax.jit(lambda s, f: jax.lax.scan(body, s, f))(start, frames)
    assert traced == 1
    state = start
    for index in range(4):
        state, image = STEP({}, state, jax.tree.map(lambda b, i=index: b[i], frames))
        np.testing.assert_allclose(images[index], image, rtol=1e-4, atol=1e-5)

    pair = jax.tree.map(lambda b: b[:2], frames)
    starts = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    _, both = jax.jit(jax.vmap(DENOISER.step, in_axes=({}, 0, 0)))({}, starts, pair)
    for index in range(2):
        _, alone = STEP({}, state, jax.tree.map(lambda b, i=index: b[i], pair))
        np.testing.assert_allclose(both[index], alone, rtol=1e-4, atol=1e-5)


def clip_of(frames, dtype=np.float32):
    stacked = jax.tree.map(lambda *each: np.stack(each), *[frame._replace(motion=None) for frame in frames])
    return Clip(jax.tree.map(lambda a: a.astype(dtype) if a.dtype.kind == "f" else a, stacked))


@functools.cache
def compiled_denoise(denoiser):
    """Images of params and a clip."""
    return jax.jit(functools.partial(denoise, denoiser))


@pytest.mark.slow
def test_a_lamp_that_reflects_nothing_stays_bright(rng):
    """Its reflectance is 0: averaged with the wall's, that texture would make the lamp black."""
    lamp = np.zeros((24, 32, 1), bool)
    lamp[8:16, 10:20] = True
    light = np.where(lamp, 5.0, 0.4 * rng.gamma(2.0, 0.5, (24, 32, 3))).astype(np.float32)
    ids = lamp.astype(np.int32)
    reflectance = np.where(lamp, 0.0, 0.8 * np.ones(3)).astype(np.float32)
    for name in ("svgf", "asvgf", "relax", "reblur", "trmv"):
        frame = Frame(light, reflectance=reflectance, ids=ids)
        denoiser = methods()[name].factory()
        step = jax.jit(lambda frame, denoiser=denoiser: denoiser.step({}, denoiser.start({}, frame), frame)[1])
        inside = np.asarray(step(frame))[10:14, 13:17]
        assert inside.min() > 0.3, (name, inside.min())  # black: 0.003


@pytest.mark.slow
def test_params_before_training_change_nothing(rng):
    clip, denoiser = clip_of(moving_frames(rng)), LEARNING
    params = denoiser.init(jax.random.key(0), moving_frames(rng, 1)[0])
    assert params["sigma_normal"].shape == (3,)
    image, plain = (compiled_denoise(denoiser)(given, clip) for given in (params, {}))
    np.testing.assert_allclose(image, plain, rtol=2e-5, atol=1e-6)


@pytest.mark.slow
def test_params_are_the_options_that_they_stand_for(rng):
    clip = clip_of(moving_frames(rng))
    factors = {"alpha": 3.0, "sigma_depth": 2.0, "sigma_normal": 0.5, "sigma_luminance": 0.25}
    params = {name: jnp.log(jnp.full(() if name == "alpha" else (3,), factor)) for name, factor in factors.items()}
    found = compiled_denoise(LEARNING)(params, clip)
    alpha = 3 * 0.2 / (3 * 0.2 + 0.8)  # odds three times as high
    wanted = svgf(levels=3, alpha=alpha, sigma_depth=2.0, sigma_normal=8.0, sigma_luminance=1.0)
    np.testing.assert_allclose(found, compiled_denoise(wanted)({}, clip), rtol=2e-5, atol=1e-6)


def test_every_level_has_its_own_params(rng):
    clip = clip_of(moving_frames(rng))
    run, begun = compiled_denoise(LEARNING), LEARNING.init(jax.random.key(0), frame_at(clip.frames, 0))
    plain = run({}, clip)
    for name in ("sigma_depth", "sigma_normal", "sigma_luminance"):
        for level in range(3):
            # The other params as they begin, which changes nothing: then all of them share a program.
            image = run(begun | {name: jnp.zeros(3).at[level].set(1.0)}, clip)
            assert float(jnp.max(jnp.abs(image - plain))) > 1e-4, (name, level)


@pytest.mark.slow
def test_gradients_of_params(rng, x64):
    clip = clip_of(moving_frames(rng), np.float64)
    denoiser = svgf(levels=2)
    params = denoiser.init(jax.random.key(0), frame_at(clip.frames, 0))
    mean = jax.jit(lambda params: jnp.mean(denoise(denoiser, params, clip)))
    check_gradients(mean, (params,), eps=1e-5)


@pytest.mark.slow
def test_gradients_are_finite(rng):
    denoiser = svgf(levels=2)
    frames = moving_frames(rng, 2)
    black = [frame._replace(radiance=frame.radiance * (frame.ids != 3)) for frame in frames]
    names = ("radiance", "albedo", "normal", "depth", "previous_depth")

    stacked = jax.tree.map(lambda *each: jnp.stack(each), *black)

    def loss(given):
        # A scan, as in `denoise`: the step is compiled once for both frames.
        clip = stacked._replace(**given)
        images = jax.lax.scan(functools.partial(denoiser.step, {}), denoiser.start({}, black[0]), clip)[1]
        return jnp.sum(images[-1] ** 2)

    gradient = jax.jit(jax.grad(loss))({name: getattr(stacked, name) for name in names})
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert all(float(jnp.abs(each).max()) > 0 for each in gradient["radiance"])


def test_double_precision_stays_double(x64, rng):
    frame = moving_frames(rng, 1, np.float64)[0]
    frame = jax.tree.map(jnp.asarray, frame)
    denoiser = svgf(levels=1)
    state, image = jax.eval_shape(lambda f: denoiser.step({}, denoiser.start({}, f), f), frame)
    assert image.dtype == state.core.history.dtype == jnp.float64


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"alpha": 0.0}, "alpha"),
        ({"levels": 11}, "levels"),
        ({"feedback_level": 6}, "feedback_level"),
        ({"sigma_depth": 0.0}, "sigma_depth"),
        ({"history_max": 0}, "history_max"),
    ],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        svgf(**options)


def test_the_smallest_sums_of_weights_that_count_spoil_no_gradient():
    # A row of pixels without a surface, below one that they are unlike; the square of the sum squared would underflow.
    totals = np.geomspace(1.01e-10, 1e-6, 64)
    light = jnp.asarray(np.stack([-np.log(totals), np.zeros(64)]), jnp.float32)
    hit = jnp.zeros((2, 64), bool).at[1].set(True)

    @jax.jit
    def spread(variance, light):
        weight = Weight(light[None], light[None], lambda there, here, offset: jnp.abs(there[0] - here[0]))
        taps = np.array([[0, 0, 1.0], [1, 0, 1.0]])
        return edge_average(variance[None], hit, [weight], taps, variance=variance)[1][0].sum()

    slopes = jax.grad(spread, (0, 1))(jnp.ones((2, 64)), light)
    np.testing.assert_allclose(slopes[0], [[0.0] * 64, [1.0] * 64], rtol=1e-5)
    np.testing.assert_allclose(slopes[1], 0.0, atol=1e-5)


@pytest.mark.slow
def test_a_pixel_without_a_surface_among_strangers_spoils_no_gradient(rng):
    """Its neighbours weigh 1e-20 together, the square of which, 0 in single precision, divided the variance."""
    values = jnp.asarray(rng.uniform(1, 2, (3, 5, 5)), jnp.float32)
    hit = jnp.ones((5, 5), bool).at[2, 2].set(False)
    depth = depth_weight(jnp.full((5, 5, 1), 2.0), None, sigma=1.0, height=5)
    level = values[0].at[2, 2].add(46.0)

    def spread(values, level):
        light = luminance_weight(level, jnp.full((5, 5), 1 - 1e-4, jnp.float32), sigma=1.0)  # exp(-|difference|)
        mean, variance = edge_average(values, hit, [depth, light], stencil(1), variance=values[1])
        return jnp.sum(mean) + jnp.sum(variance)

    value, slopes = jax.value_and_grad(spread, (0, 1))(values, level)
    assert jnp.isfinite(value)
    assert all(jnp.isfinite(slope).all() for slope in slopes)


@pytest.mark.slow
def test_guides_that_come_and_go_are_not_tested_against_other_guides(rng):
    """Depth and normals (4 layers) in one frame, normals and ids (4 layers too) in the next: normals are shared."""
    frame = moving_frames(rng, 1)[0]._replace(motion=None, previous_depth=None, depth=None, ids=None)
    near = np.full((HEIGHT, WIDTH, 1), 2.0, np.float32)
    frames = [frame._replace(depth=near), frame._replace(ids=np.full((HEIGHT, WIDTH, 1), 7, np.int32)), frame]
    # Of histories alone: what is filtered after them does not change their length.
    denoiser, lengths = svgf(demodulate="none", levels=0, feedback_level=0, short_history=0), []
    step, state = jax.jit(denoiser.step), denoiser.start({}, frames[0])
    for each in frames:
        state, _ = step({}, state, each)
        lengths.append(state.core.history[..., 5])
    np.testing.assert_array_equal(lengths[1], 2)  # every pixel has found its history
    np.testing.assert_array_equal(lengths[2], 3)
