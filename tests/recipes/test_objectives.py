"""Training objectives against NumPy in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import losses
from jaxdn.core.frame import Clip, Frame
from jaxdn.methods.registry import methods
from jaxdn.recipes.objectives import (
    compressed_illumination,
    disocclusions,
    indirect_illumination,
    last_frames,
    pyramid_illumination,
    recurrent_illumination,
    squared_illumination,
)

SHAPE = (5, 6, 7)
OBJECTIVE = indirect_illumination()


@pytest.fixture
def images(rng):
    """Denoised frames with blacks and fireflies."""
    light = rng.exponential(size=(*SHAPE, 3)) * 10.0 ** rng.integers(-4, 3, (*SHAPE, 3))
    return jnp.asarray(np.where(rng.random((*SHAPE, 3)) < 0.1, 0, light), jnp.float32)


@pytest.fixture
def clip(rng):
    """Vectors of which a third differ by more than half a pixel from the dual ones."""
    motion = rng.normal(size=(*SHAPE, 2)).astype(np.float32)
    dual = motion + 5 * (rng.random((*SHAPE, 1)) < 0.3).astype(np.float32)
    frames = Frame(jnp.ones((*SHAPE, 3)), motion=jnp.asarray(motion), dual_motion=jnp.asarray(dual))
    return Clip(frames, jnp.asarray(rng.exponential(size=(*SHAPE, 3)), jnp.float32))


def numpy_compress(x):
    u = np.log1p(np.asarray(x, np.float64))
    toe = 1e-4
    return np.where(u <= toe, toe ** (1 / 2.2) / toe * u, u ** (1 / 2.2))


def numpy_objective(images, clip, *, occlusion):
    """Spatial, temporal and motion-occlusion terms of all frames but the last, each a mean over its elements."""
    trained = max(1, len(images) - 1)
    error = numpy_compress(images[:trained]) - numpy_compress(clip.reference[:trained])
    total = np.abs(error).mean()
    if trained > 1:
        total += np.mean([np.abs(error[t] - error[t - 1]) for t in range(1, trained)])
    if occlusion:
        apart = np.asarray(clip.frames.dual_motion, np.float64) - np.asarray(clip.frames.motion, np.float64)
        masks = (np.linalg.norm(apart, axis=-1, keepdims=True) > 0.5).astype(float)
        lately = [
            sum(weight * masks[t - age if t >= age else t] for age, weight in enumerate((1.0, 0.8, 0.6)))
            for t in range(trained)
        ]
        total += np.abs(error * np.stack(lately)).mean()
    return total


@pytest.mark.parametrize(("progress", "joined"), [(0.0, False), (0.499, False), (0.5, True), (1.0, True)])
def test_it_is_the_papers_sum_and_the_occlusion_term_is_added_in_the_second_half(progress, joined, images, clip):
    found = jax.jit(OBJECTIVE.loss)(images, clip, jnp.asarray(progress))
    expected = numpy_objective(images, clip, occlusion=joined)
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    other = numpy_objective(images, clip, occlusion=not joined)
    assert abs(other - expected) > 0.05 * expected  # the two differ clearly


@pytest.mark.parametrize("progress", [0.0, 1.0])
def test_without_occlusion_the_term_is_never_added(progress, images, clip):
    found = indirect_illumination(occlusion=False).loss(images, clip, jnp.asarray(progress))
    np.testing.assert_allclose(found, numpy_objective(images, clip, occlusion=False), rtol=1e-5)


def test_the_two_objectives_have_different_names():
    assert OBJECTIVE.name != indirect_illumination(occlusion=False).name


def test_the_last_frame_gives_no_gradient_and_all_others_do(images, clip):
    slope_of = jax.jit(jax.grad(OBJECTIVE.loss))  # the same program: operations one by one round otherwise
    slope = np.asarray(slope_of(images, clip, jnp.asarray(1.0)))
    assert np.isfinite(slope).all()
    np.testing.assert_array_equal(slope[-1], 0)
    assert all(np.abs(slope[index]).max() > 0 for index in range(len(slope) - 1))
    changed = clip._replace(reference=clip.reference.at[-1].multiply(7.0))
    np.testing.assert_array_equal(slope_of(images, changed, jnp.asarray(1.0)), slope)


def test_a_clip_of_one_frame_is_trained_on(images, clip):
    one = jax.tree.map(lambda buffer: buffer[:1], clip)
    found, slope = jax.value_and_grad(OBJECTIVE.loss)(images[:1], one, jnp.asarray(1.0))
    np.testing.assert_allclose(found, numpy_objective(images[:1], one, occlusion=True), rtol=1e-5)
    assert np.abs(slope).max() > 0


def test_a_denoised_clip_that_is_its_reference_costs_nothing(clip):
    found, slope = jax.value_and_grad(OBJECTIVE.loss)(clip.reference, clip, jnp.asarray(1.0))
    assert found == 0
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("absent", [("motion",), ("dual_motion",), ("motion", "dual_motion")])
def test_without_vectors_nothing_is_disoccluded(absent, images, clip):
    still = clip._replace(frames=clip.frames._replace(**dict.fromkeys(absent)))
    np.testing.assert_array_equal(disocclusions(still.frames), np.zeros((*SHAPE, 1)))
    found = OBJECTIVE.loss(images, still, jnp.asarray(1.0))
    np.testing.assert_allclose(found, numpy_objective(images, clip, occlusion=False), rtol=1e-5)


def test_both_halves_of_training_are_one_program(images, clip):
    loss = jax.jit(OBJECTIVE.loss)
    for progress in (0.0, 0.25, 0.5, 1.0):
        loss(images, clip, jnp.asarray(progress))
    assert loss._cache_size() == 1


def test_squared_illumination_is_what_psnr_measures_of_frames_and_of_their_changes(images, clip):
    """Of images near their targets: the slope of x / (1 + x) there is that of the image."""
    near = clip._replace(reference=np.maximum(images * 1.001, 0.0))
    found = squared_illumination(temporal=0.5).loss(jnp.maximum(images, 0.0), near, jnp.asarray(0.0))
    image, target = (np.asarray(np.maximum(each, 0.0), np.float64) for each in (images, near.reference))
    error = image / (1 + image) - target / (1 + target)
    expected = np.mean(error**2) + 0.5 * np.mean(np.diff(error, axis=0) ** 2)
    np.testing.assert_allclose(np.exp(2 * found) - 1e-6, expected, rtol=0.05)
    one = jax.tree.map(lambda buffer: buffer[:1], near)
    alone = squared_illumination().loss(jnp.maximum(images[:1], 0.0), one, jnp.asarray(0.0))
    np.testing.assert_allclose(np.exp(2 * alone) - 1e-6, np.mean(error[:1] ** 2), rtol=0.05)
    assert np.all(np.isfinite(jax.grad(squared_illumination().loss)(clip.reference, clip, jnp.asarray(0.0))))


def test_pyramid_illumination_is_the_pyramid_of_frames_and_of_their_changes(images, clip):
    denoised, wanted = losses.unbiased(images, clip.reference)
    frames, changes = (
        losses.pyramid(denoised, wanted),
        losses.pyramid(jnp.diff(denoised, axis=0), jnp.diff(wanted, axis=0)),
    )
    found = pyramid_illumination(temporal=0.5).loss(images, clip, jnp.asarray(0.0))
    np.testing.assert_allclose(found, frames + 0.5 * changes, rtol=1e-6)
    relative = pyramid_illumination(temporal=0.5, logarithm=True)
    assert relative.name == "logarithm of pyramid illumination, changes 0.5"
    logarithm = relative.loss(images, clip, jnp.asarray(0.0))
    np.testing.assert_allclose(logarithm, 0.5 * np.log(float(found) + 1e-3), rtol=1e-5)
    assert np.all(np.isfinite(jax.grad(relative.loss)(clip.reference, clip, jnp.asarray(0.0))))
    one = jax.tree.map(lambda buffer: buffer[:1], clip)
    np.testing.assert_allclose(
        pyramid_illumination().loss(images[:1], one, jnp.asarray(0.0)),
        losses.pyramid(denoised[:1], wanted[:1]),
        rtol=1e-6,
    )


@pytest.mark.parametrize("name", [name for name, method in methods().items() if method.learns])
def test_every_learned_method_names_its_objective(name):
    for recipe in methods()[name].recipes.values():
        assert recipe.objective.name
        assert recipe.record()["objective"] == recipe.objective.name


def test_the_recurrent_objective_weighs_later_frames_more(rng):
    """Against loops over frames, with the Laplacian of Gaussian of `losses.gradient` (tested for itself)."""
    shape = (7, 18, 20, 3)
    images, wanted = (rng.exponential(size=shape).astype(np.float32) for _ in range(2))
    clip = Clip(Frame(jnp.asarray(images)), jnp.asarray(wanted))
    error = numpy_compress(images) - numpy_compress(wanted)
    published = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)
    for operator in ("hfen", "difference"):
        structure_of = jax.jit(functools.partial(losses.gradient, operator=operator))
        total = 0.0
        for t, weight in enumerate(np.exp(-(np.arange(6, -1, -1) ** 2) / 8)):
            assert weight == pytest.approx(published[t], abs=6e-4)
            pair = (jnp.asarray(numpy_compress(each[t : t + 1]), jnp.float32) for each in (images, wanted))
            change = np.abs(error[t] - error[t - 1]).mean() if t else 0.0
            structure = float(structure_of(*pair))
            total += weight * (0.8 * np.abs(error[t]).mean() + 0.1 * structure + 0.1 * change) / 7
        loss = jax.jit(recurrent_illumination(operator=operator).loss)
        found = loss(jnp.asarray(images), clip, jnp.asarray(0.5))
        assert float(found) == pytest.approx(total, rel=1e-4)


def test_the_last_frames_cost_their_error_and_that_of_their_change(images, clip):
    """Hasselgren et al. 2020, eq. 4: of five frames the last one in space, the last two in time; no other."""
    error = numpy_compress(images) - numpy_compress(clip.reference)
    found, slope = jax.value_and_grad(last_frames().loss)(images, clip, jnp.asarray(0.5))
    np.testing.assert_allclose(found, np.abs(error[-1]).mean() + np.abs(error[-1] - error[-2]).mean(), rtol=1e-5)
    np.testing.assert_array_equal(slope[:-2], 0)
    assert np.abs(slope[-2]).max() > 0


def test_single_frames_cost_their_compressed_error(images, clip):
    error = numpy_compress(images) - numpy_compress(clip.reference)
    found = compressed_illumination().loss(images, clip, jnp.asarray(0.5))
    np.testing.assert_allclose(found, np.abs(error).mean(), rtol=1e-5)
