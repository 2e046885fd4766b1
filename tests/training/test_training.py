"""Training: the loss, the step, its two phases, invalid data, and recipes."""

import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import color, losses
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser import Core, recurrent
from jaxdn.denoiser.rollout import denoise
from jaxdn.denoisers import ntd
from jaxdn.methods.registry import method_named
from jaxdn.ops.motion import occlusion_mask
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.objectives import unbiased_illumination
from jaxdn.training.step import clip_loss, init_state, make_train_step

TINY = ((4,), (4,), (4,), (4,), (4,))
RECIPE = method_named("ntd").recipe_named("paper-loss")._replace(steps=8, batch=2, crop=16, frames=4)


def make_clip(seed, *, frames=4, size=16):
    """A noisy moving ramp, with a strip that is disoccluded according to the dual vectors."""
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0.1, 1.0, size, dtype=np.float32)[None, None, :, None] * np.ones((frames, size, size, 3))
    reference = (ramp + 0.1 * np.arange(frames)[:, None, None, None]).astype(np.float32)
    motion = np.zeros((frames, size, size, 2), np.float32)
    dual = motion.copy()
    dual[1:, 4:8, 4:6] = (3.0, 0.0)
    return Clip(
        Frame(
            radiance=(reference * rng.exponential(size=reference.shape)).astype(np.float32),
            albedo=np.full_like(reference, 0.5),
            normal=np.broadcast_to(np.float32([0, 0, 1]), reference.shape),
            depth=np.full((frames, size, size, 1), 2.0, np.float32),
            motion=motion,
            dual_motion=dual,
        ),
        reference,
    )


def gain(seconds=0.0):
    """The frame times a learned number: compiles at once, and the loop is the same. A frame may take some seconds."""

    def pause(value):
        time.sleep(seconds)
        return np.zeros_like(value)

    def step(params, state, frame, first, statistics):
        image = params["gain"] * frame.radiance
        if seconds:
            given = jax.lax.stop_gradient(image[0, 0, 0])
            image += jax.pure_callback(pause, jax.ShapeDtypeStruct((), given.dtype), given, vmap_method="broadcast_all")
        return image, image, 0

    return recurrent(
        Core(lambda params, frame: frame.radiance, step, frozenset(), lambda key, frame: {"gain": jnp.float32(0.5)})
    )


def batch_of(*clips):
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *clips)


@pytest.fixture(scope="module")
def denoiser():
    return ntd(size=TINY)


@pytest.fixture(scope="module")
def step(denoiser):
    return make_train_step(denoiser, RECIPE)


@pytest.fixture
def state(denoiser):
    return init_state(denoiser, RECIPE, batch_of(make_clip(0), make_clip(1)))


@pytest.fixture(scope="module")
def plain():
    """A network that compiles sooner, and its weights, where one without kernels shows the same."""
    denoiser = ntd(size=TINY, prediction="direct")
    return denoiser, init_state(denoiser, RECIPE, batch_of(make_clip(0))).params


@pytest.mark.slow
def test_the_loss_is_the_papers_sum_on_all_frames_but_the_last(denoiser, state):
    clip = make_clip(0)
    images = denoise(denoiser, state.params, clip)
    masks = jax.vmap(occlusion_mask)(clip.frames.motion, clip.frames.dual_motion)[:3]
    ours, wanted = color.compress(images[:3]), color.compress(clip.reference[:3])
    without = losses.spatial(ours, wanted) + losses.temporal(ours, wanted)
    joined = losses.occlusion(ours, wanted, masks)
    assert joined > 0
    for progress, weight in ((0.0, 0.0), (0.49, 0.0), (0.5, 1.0), (1.0, 1.0)):
        loss, _ = clip_loss(denoiser, state.params, clip, RECIPE.objective, progress=progress)
        np.testing.assert_allclose(loss, without + weight * joined, rtol=1e-5)


@pytest.mark.slow
def test_the_last_frame_gives_no_gradient(plain):
    denoiser, given = plain
    clip = make_clip(0)
    changed = clip._replace(reference=clip.reference.copy())
    changed.reference[-1] *= 3.0
    gradient = jax.jit(jax.grad(lambda params, clip: clip_loss(denoiser, params, clip, RECIPE.objective)[0]))
    for one, other in zip(
        jax.tree.leaves(gradient(given, clip)), jax.tree.leaves(gradient(given, changed)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_a_step_learns_and_compiles_once_over_both_phases(step, state):
    batch = batch_of(make_clip(0), make_clip(1))
    reports = []
    for _ in range(RECIPE.steps):
        state, report = step(state, batch)
        reports.append(report)
    assert step._cache_size() == 1
    assert reports[3].loss < reports[0].loss
    # The occlusion loss is added after half of the steps, which raises the loss.
    assert reports[4].loss > reports[3].loss
    assert int(state.skipped) == 0
    assert int(state.step) == RECIPE.steps


@pytest.mark.slow
def test_rematerialised_gradients_are_the_same(plain):
    denoiser, given = plain
    clip = make_clip(3)

    def gradient(rematerialize):
        def loss(params):
            return clip_loss(denoiser, params, clip, RECIPE.objective, rematerialize=rematerialize)[0]

        return jax.jit(jax.grad(loss))(given)

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), gradient(False), gradient(True))


def valid(state):
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.params, state.optimizer)))


POISONS = [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e38]


@pytest.mark.slow
@pytest.mark.parametrize("buffer", ["radiance", "albedo", "normal", "depth", "motion", "dual_motion", "reference"])
def test_a_poisoned_buffer_never_makes_an_invalid_weight_and_training_continues(step, state, buffer):
    batch = batch_of(make_clip(0), make_clip(1))
    before = jax.tree.map(np.array, state.params)
    for poison in POISONS:
        if buffer == "reference":
            poisoned = batch._replace(reference=batch.reference.at[:, 1, 3:9].set(poison))
        else:
            values = getattr(batch.frames, buffer).at[:, 1, 3:9].set(poison)
            poisoned = batch._replace(frames=batch.frames._replace(**{buffer: values}))
        state, report = step(state, poisoned)
        assert np.isfinite(report.loss), poison
        assert valid(state), poison
    assert int(state.skipped) == 0
    changed = [np.any(new != old) for new, old in zip(*map(jax.tree.leaves, (state.params, before)), strict=True)]
    assert any(changed)


@pytest.mark.slow
def test_a_black_batch_is_trained_on(step, state):
    batch = batch_of(make_clip(0), make_clip(1))
    black = jax.tree.map(jnp.zeros_like, batch)
    state, _ = step(state, black)
    state, report = step(state, black)
    assert np.isfinite(report.loss)
    assert np.isfinite(report.gradient_norm)
    assert valid(state)
    assert int(state.skipped) == 0
    state, _ = step(state, batch)
    assert valid(state)


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_changes_nothing(denoiser, step, state):
    before = jax.tree.map(np.array, state.params)
    broken = state._replace(params=jax.tree.map(jnp.copy, state.params))
    first = jax.tree.leaves(broken.params)[0]
    broken = broken._replace(
        params=jax.tree.map(
            lambda leaf: leaf.at[(0,) * leaf.ndim].set(jnp.nan) if leaf is first else leaf, broken.params
        )
    )
    after, _ = step(broken, batch_of(make_clip(0), make_clip(1)))
    assert int(after.skipped) == 1
    jax.tree.map(
        lambda new, old: np.testing.assert_array_equal(new[np.isfinite(new)], old[np.isfinite(new)]),
        jax.tree.map(np.array, after.params),
        before,
    )


@pytest.mark.slow
def test_without_motion_nothing_is_disoccluded(denoiser, state):
    clip = make_clip(0)
    still = clip._replace(frames=clip.frames._replace(motion=None, dual_motion=None))
    loss_of = jax.jit(lambda progress: clip_loss(denoiser, state.params, still, RECIPE.objective, progress=progress)[0])
    with_occlusion, without = loss_of(1.0), loss_of(0.0)
    assert with_occlusion == without


def test_the_papers_recipe_is_constant_adam():
    paper = method_named("ntd").recipe_named("paper")
    assert paper.learning_rate == 1e-4
    assert not paper.decay
    assert paper.clip_norm == 0
    assert paper.variation == NO_AUGMENTATION
    assert paper.average == 0
    assert paper.objective.name == RECIPE.objective.name  # the loss is the paper's own in both


def test_a_recipe_is_kept_as_json():
    kept = json.loads(json.dumps(RECIPE.record(), allow_nan=False))
    assert set(kept) == set(RECIPE._fields)
    assert kept["objective"] == "indirect illumination"
    assert kept["steps"] == 8


@pytest.mark.slow
def test_the_running_mean_follows_the_weights():
    denoiser = gain()
    recipe = RECIPE._replace(average=0.5, decay=False)
    step = make_train_step(denoiser, recipe)
    batch = batch_of(make_clip(0), make_clip(1))
    state = init_state(denoiser, recipe, batch)
    wanted = jax.tree.map(np.array, state.params)
    for count in range(8):
        state, _ = step(state, batch)
        share = min(0.5, (1 + count) / (10 + count))  # less of the mean so far while it is young
        wanted = jax.tree.map(lambda mean, new, share=share: share * mean + (1 - share) * new, wanted, state.params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), state.average, wanted)
    assert any(np.any(a != b) for a, b in zip(*map(jax.tree.leaves, (state.average, state.params)), strict=True))
    newest = make_train_step(denoiser, recipe._replace(average=0.0))
    state, _ = newest(state, batch)
    jax.tree.map(np.testing.assert_array_equal, state.average, state.params)


def test_hidden_pixels_weigh_more_and_squares_come_late():
    clip = make_clip(0)
    visible = np.ones((4, 16, 16, 1), bool)
    visible[1:, 4:8, 4:6] = False
    seen = clip._replace(frames=clip.frames._replace(visible=visible))
    images = jnp.asarray(clip.reference * 1.1)
    objective = unbiased_illumination(hidden=2.0, squared_from=0.5)
    assert objective.reads == {"visible"}
    ours, wanted = color.compress(images), color.compress(clip.reference)
    masks = 1.0 - visible
    robust = losses.spatial(ours, wanted) + losses.temporal(ours, wanted) + 2 * losses.occlusion(ours, wanted, masks)
    np.testing.assert_allclose(objective.loss(images, seen, jnp.asarray(0.4)), robust, rtol=1e-5)
    pair = losses.unbiased(images, jnp.asarray(clip.reference))
    squares = losses.spatial(*pair, squared=True) + losses.temporal(*pair, squared=True)
    squares += 2 * losses.occlusion(*pair, masks, squared=True)
    np.testing.assert_allclose(objective.loss(images, seen, jnp.asarray(0.5)), 8 * squares, rtol=1e-5)
    # Without the buffer nothing is hidden.
    plain = losses.spatial(ours, wanted) + losses.temporal(ours, wanted)
    np.testing.assert_allclose(objective.loss(images, clip, jnp.asarray(0.0)), plain, rtol=1e-5)
