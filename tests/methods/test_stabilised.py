"""The wrapper that gives any denoiser a history: along motion, in programs and tiles, by name, and on moving light."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn.commands.main import main
from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.data.clip.folder import write_clip
from jaxdn.data.exr.exr import read_exr
from jaxdn.denoiser import Core, Denoiser, recurrent
from jaxdn.denoiser.rollout import stream
from jaxdn.denoiser.tiles import GRID, stream_tiled
from jaxdn.denoisers import demodulated, svgf
from jaxdn.export.step import exported_step
from jaxdn.filters.kalman import kalman_blend
from jaxdn.zoo.ready import find_model
from tests.methods.brick_wall import pan
from tests.needs import require

SIZE = (40, 56)


def given_images(params, state, frame):
    """A denoiser whose images are made beforehand: they are in a buffer."""
    return state, frame.direct


GIVEN = Denoiser(lambda key, frame: {}, lambda params, frame: (), given_images, frozenset({"direct"}))
STEADIER = jaxdn.stabilised(GIVEN)


@cache
def compiled(denoiser):
    """Images of params and a clip: compiled once for clips of one size and one set of buffers."""
    return jax.jit(partial(jaxdn.denoise, denoiser))


def steadied(frames):
    """The given images with a history."""
    return np.asarray(compiled(STEADIER)({}, Clip(frames)))


def rolling(rng, count=10, size=SIZE, speed=2, error=0.05, noise=0.5):
    """A bright disc before a wall, with a shadow that moves with it: (frames, truth), images in ``direct``."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    frames, truths = [], []
    for index in range(count):
        x = 12 + speed * index
        disc = (rows - 20) ** 2 + (columns - x) ** 2 < 64
        shadow = (rows - 28) ** 2 / 9 + (columns - x) ** 2 / 81 < 1
        truth = np.where(disc, 0.9, np.where(shadow, 0.15, 0.6))[..., None] * np.array([1.0, 0.9, 0.7])
        motion = np.where(disc[..., None], np.array([-speed, 0.0]), 0.0)
        wide = np.pad(rng.normal(size=truth.shape), ((2, 2), (2, 2), (0, 0)))
        errors = sum(wide[dy : dy + size[0], dx : dx + size[1]] for dy, dx in np.ndindex(5, 5)) / 5
        frames.append(
            Frame(
                (truth * (1 + noise * (rng.exponential(size=truth.shape) - 1))).astype(np.float32),
                direct=np.maximum(truth * (1 + error * errors), 0).astype(np.float32),
                motion=motion.astype(np.float32),
                depth=np.where(disc, 2.0, 5.0)[..., None].astype(np.float32),
                ids=disc[..., None].astype(np.int32),
            )
        )
        truths.append(truth)
    return jax.tree.map(lambda *each: np.stack(each), *frames), np.stack(truths)


@pytest.mark.slow
def test_the_first_frame_is_the_denoisers_and_later_ones_are_the_blend(rng):
    """Of a still image: the same as the filter, called by hand."""
    frames, _ = rolling(rng, 3, speed=0)
    images = steadied(frames)
    np.testing.assert_array_equal(images[0], frames.direct[0])
    past, valid, blend = jnp.zeros((6, *SIZE)), np.zeros(SIZE, bool), jax.jit(partial(kalman_blend, history_max=16))
    for index in range(3):
        frame = frame_at(frames, index)
        exposure = jaxdn.color.exposure(frame.radiance)
        planes = (np.moveaxis(frame.direct, -1, 0), np.moveaxis(frame.radiance, -1, 0))
        past, valid = blend(past, valid, *planes, exposure), np.ones(SIZE, bool)
        np.testing.assert_allclose(images[index], np.moveaxis(np.asarray(past[:3]), 0, -1), rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_what_moves_leaves_no_trail_and_what_stands_still_is_steady(rng):
    """The shadow and what the disc uncovers have the denoiser's own error, the wall far from both a quarter of it."""
    frames, truth = rolling(rng)
    images = steadied(frames)
    errors, own = (images - truth)[-1] ** 2, (frames.direct - truth)[-1] ** 2
    touched = (np.abs(np.diff(truth, axis=0)) > 0).any(axis=(0, 3))
    left = (np.abs(truth[-1] - truth[-3]) > 0).any(axis=-1)
    assert errors[left].mean() < 1.4 * own[left].mean()
    assert errors[~touched].mean() < 0.25 * own[~touched].mean()
    inside = frames.ids[-1, ..., 0] > 0
    assert errors[inside].mean() < 0.5 * own[inside].mean(), "the history moves with the disc"


@pytest.mark.slow
def test_pixels_without_a_measurement_prove_nothing(rng):
    """A still scene, a quarter of whose pixels has samples, or is finite, is as steady as where all are."""
    frames, truth = rolling(rng, speed=0)
    seen = rng.random((*frames.radiance.shape[:3], 1)) < 0.25
    sampled = frames._replace(radiance=frames.radiance * seen, sample_count=seen.astype(np.float32))
    broken = frames._replace(radiance=np.where(seen, frames.radiance, np.nan))
    errors = [np.mean((steadied(each)[-1] - truth[-1]) ** 2) for each in (frames, sampled, broken)]
    assert max(errors[1:]) < 1.3 * errors[0], errors


@pytest.mark.slow
def test_an_albedo_that_comes_or_goes_is_white_where_it_is_absent(rng):
    frames, _ = rolling(rng, 3)
    albedo = rng.uniform(0.2, 1, frames.radiance.shape).astype(np.float32)
    albedo[[0, 2]] = 1.0
    written, absent = stream(STEADIER, {}), stream(STEADIER, {})
    for index in range(3):
        frame = frame_at(frames._replace(albedo=albedo), index)
        expected = written(frame)
        found = absent(frame if index == 1 else frame._replace(albedo=None))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.3, 1.7])
@pytest.mark.parametrize(("guide", "gain"), [("precise", 1.0), ("noisy", 0.0), ("none", 0.0)])
def test_a_pan_over_fine_texture_is_no_worse_than_the_denoiser(speed, guide, gain, rng):
    """By no more than 0.1 dB, also at silhouettes; where the albedo shows the texture it gains at least one."""
    frames, truth = pan(rng, speed, spread=0.3 if guide == "noisy" else 0.0)
    if guide == "none":
        frames = frames._replace(albedo=None)
    images = steadied(frames)[8:]
    alone, truth, edges = frames.direct[8:], truth[8:], np.zeros(truth[8:].shape[:3], bool)
    for axis in (1, 2):
        differ = np.diff(frames.ids[8:, ..., 0], axis=axis) != 0
        edges |= np.insert(differ, 0, False, axis=axis) | np.insert(differ, differ.shape[axis], False, axis=axis)
    for where, least in ((np.ones_like(edges), gain), (edges, 0.0)):
        found, own = (np.mean((each - truth)[where] ** 2) for each in (images, alone))
        assert 10 * np.log10(own / found) > least - 0.1, (where.mean(), 10 * np.log10(own / found))


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [lambda inner: inner, demodulated], ids=["plain", "demodulated"])
def test_tiles_give_the_image_of_the_whole(wrap, rng):
    denoiser = wrap(jaxdn.stabilised(recurrent(_core_of_means())))
    field = denoiser.receptive_field
    side = 2 * (field + 1 + 2 + GRID) + 3 * GRID
    size = (SIZE[0], side + 3 * GRID + 5)
    frames, _ = rolling(rng, 3, size)
    frames = frames._replace(albedo=rng.uniform(0.2, 1, frames.radiance.shape).astype(np.float32))
    tiled, whole = stream_tiled(denoiser, {}, side, size), stream(denoiser, {})
    for index in range(3):
        frame = frame_at(frames, index)
        np.testing.assert_allclose(tiled(frame), whole(frame), rtol=1e-3, atol=1e-4)


def _core_of_means():
    def step(params, state, frame, first, statistics):
        wide = jnp.pad(frame.radiance, ((1, 1), (1, 1), (0, 0)), mode="edge")
        height, width = frame.radiance.shape[:2]
        return state, sum(wide[dy : dy + height, dx : dx + width] for dy, dx in np.ndindex(3, 3)) / 9, 0

    return Core(lambda params, frame: (), step, frozenset(), receptive_field=1)


@pytest.mark.slow
def test_a_program_can_batch_it_and_half_precision_is_widened(rng):
    clips = [Clip(rolling(rng, 3)[0]) for _ in range(2)]
    batch = jax.tree.map(lambda *each: np.stack(each), *clips)
    images = jax.jit(jax.vmap(lambda clip: jaxdn.denoise(STEADIER, {}, clip)))(batch)
    for image, clip in zip(images, clips, strict=True):
        np.testing.assert_allclose(image, steadied(clip.frames), rtol=1e-5, atol=1e-6)
    half = jax.tree.map(lambda x: jnp.asarray(x, jnp.bfloat16) if x.dtype == np.float32 else x, clips[0])
    found = compiled(STEADIER)({}, half)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, images[0], rtol=0.1, atol=0.02)


@pytest.mark.slow
def test_gradients_reach_what_the_denoiser_learns(rng):
    """Finite, and that of the blend with the gains as they are."""
    frames, truth = rolling(rng, 3)

    def step(params, state, frame):
        return state, params["gain"] * frame.direct

    denoiser = jaxdn.stabilised(Denoiser(lambda key, frame: {}, lambda p, f: (), step, frozenset({"direct"})))

    def loss(gain):
        return jnp.mean((jaxdn.denoise(denoiser, {"gain": gain}, Clip(frames)) - truth) ** 2)

    gradient = jax.jit(jax.grad(loss))(jnp.float32(1.5))
    assert np.isfinite(gradient)
    assert gradient > 0, "a smaller gain is nearer to the truth"


@pytest.mark.slow
def test_its_step_can_be_exported(rng):
    frames, _ = rolling(rng, 3)
    denoiser = jaxdn.stabilised(svgf())
    exported = exported_step(denoiser, {}, size=SIZE, buffers=("motion", "depth", "ids"))
    state = {name: jnp.zeros(spec.shape, spec.dtype) for name, spec in exported.inputs.items() if "state" in name}
    function, expected = jax.jit(exported.function), compiled(denoiser)({}, Clip(frames))
    for index in range(3):
        buffers = {name: getattr(frames, name)[index] for name in ("radiance", "motion", "depth", "ids")}
        found = function({**buffers, **state, "first": jnp.asarray(index == 0)})
        state = {name: found["next" + name.removeprefix("state")] for name in state}
        np.testing.assert_allclose(found["image"], expected[index], rtol=1e-3, atol=1e-4)


def test_requests_for_samples_go_through(rng):
    def samples(params, state, frame, most):
        return frame.radiance[..., :1]

    frame = frame_at(rolling(rng, 1)[0], 0)
    denoiser = jaxdn.stabilised(GIVEN._replace(samples=samples))
    np.testing.assert_array_equal(denoiser.samples({}, denoiser.start({}, frame), frame, 8), frame.radiance[..., :1])


def test_it_is_chosen_by_name():
    found = find_model("stabilised:svgf", alpha=0.5)
    assert found.label == "stabilised-svgf"
    assert found.method.name == "svgf"
    assert find_model("stabilised:steady-fast").params.keys() == find_model("steady-fast").params.keys()
    with pytest.raises(ValueError, match="expected a method that denoises after stabilised:"):
        find_model("stabilised:noisy")
    with pytest.raises(ValueError, match="method 'magic': expected one of noisy"):
        find_model("stabilised:magic")
    assert jaxdn.denoisers.stabilised is jaxdn.stabilised


@pytest.mark.slow
def test_files_are_denoised_by_name(rng, tmp_path, capsys):
    frames, _ = rolling(rng, 3)
    write_clip(Clip(frames._replace(direct=None)), tmp_path / "noisy")
    main(["denoise", str(tmp_path / "noisy"), "-o", str(tmp_path / "out"), "--method", "stabilised:svgf", "--no-safe"])
    assert "3 frames denoised by stabilised:svgf" in capsys.readouterr().out
    expected = jaxdn.denoise(jaxdn.stabilised(svgf()), {}, jaxdn.read_clip(tmp_path / "noisy"))
    layers = read_exr(tmp_path / "out" / "frame_0002.exr")
    image = np.stack([layers[f"denoised.{channel}"] for channel in "RGB"], axis=-1)
    np.testing.assert_allclose(image, expected[2], rtol=2e-3, atol=1e-3)


def test_a_history_without_frames_is_refused():
    for wrong in (0, -1, 2.0, True):
        with pytest.raises(ValueError, match="history_max: expected a whole number >= 1, got"):
            jaxdn.stabilised(GIVEN, history_max=wrong)


@pytest.mark.slow
def test_open_image_denoise_is_steadier_with_it(rng):
    """On a still wall: what its images change by from frame to frame falls to less than half."""
    require("pyoidn")
    frames, truth = rolling(rng, 8, speed=0, noise=1.0)
    frames = frames._replace(direct=None)
    alone = np.asarray(jaxdn.denoise(jaxdn.denoisers.oidn(), {}, Clip(frames)))
    steady = np.asarray(jaxdn.denoise(jaxdn.stabilised(jaxdn.denoisers.oidn()), {}, Clip(frames)))
    flicker = [np.mean(np.diff(images[4:], axis=0) ** 2) for images in (alone, steady)]
    assert flicker[1] < flicker[0] / 2
    assert np.mean((steady[-1] - truth[-1]) ** 2) < np.mean((alone[-1] - truth[-1]) ** 2)
