"""Validation: the error without the noise of the references, from folders and from packed sets."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import color, metrics
from jaxdn.clips import write_clip
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser import Core, recurrent
from jaxdn.training.validation import ValidationClip, load_validation, make_validation
from tests.training.test_training import make_clip


def identity():
    def step(params, state, frame, first, statistics):
        return params["gain"] * frame.radiance, params["gain"] * frame.radiance, jnp.zeros((), jnp.int32)

    return recurrent(Core(lambda params, frame: frame.radiance, step, frozenset(), lambda key, frame: {}))


def held_out(rng, *, error, noise):
    """A clip whose image is off by ``error``, with references of so large a noise in each half."""
    truth = rng.uniform(0.2, 0.6, (4, 64, 64, 3))
    image = truth + error * rng.choice([-1.0, 1.0], truth.shape)
    # Of a gamma distribution, as rendered light: never negative, and skewed.
    shape = (truth / noise) ** 2
    halves = [rng.gamma(shape, truth / shape) for _ in range(2)]
    clip = Clip(Frame(jnp.asarray(image, jnp.float32)), jnp.asarray(np.mean(halves, axis=0), jnp.float32))
    return truth, ValidationClip(clip, (jnp.asarray(halves[0], jnp.float32), jnp.asarray(halves[1], jnp.float32)))


@pytest.mark.parametrize("noise", [0.02, 0.06])
def test_it_is_the_error_of_the_image_whatever_the_noise_of_the_references(noise, rng):
    truth, held = held_out(rng, error=0.02, noise=noise)
    image = color.tonemap(held.clip.frames.radiance)
    true = float(metrics.psnr(image, color.tonemap(jnp.asarray(truth, jnp.float32)), average="mse"))
    score = make_validation(identity(), [held])({"gain": jnp.float32(1.0)})
    np.testing.assert_allclose(score, true, atol=0.3)
    if noise > 0.05:
        assert float(metrics.psnr(image, color.tonemap(held.clip.reference))) < true - 3


def test_without_halves_it_is_the_plain_one_and_without_clips_none(rng):
    _, held = held_out(rng, error=0.02, noise=0.05)
    found = make_validation(identity(), [held._replace(halves=None)])({"gain": jnp.float32(1.0)})
    image, reference = (color.tonemap(each) for each in (held.clip.frames.radiance, held.clip.reference))
    np.testing.assert_allclose(found, -10 * np.log10(np.mean((image - reference) ** 2)), rtol=1e-5)
    assert np.isnan(make_validation(identity(), [])({"gain": jnp.float32(1.0)}))


def test_an_estimate_below_zero_counts_as_60_db(rng):
    _, held = held_out(rng, error=0.0, noise=0.05)
    first, _ = held.halves
    opposite = held._replace(halves=(first, 2 * held.clip.frames.radiance - first))
    assert make_validation(identity(), [opposite])({"gain": jnp.float32(1.0)}) == 60.0


def test_clips_are_opened_as_those_to_train_on(tmp_path):
    """Values of a reference that are no light count as 0, with a warning; one of them made the whole score NaN."""
    clip = make_clip(0, frames=2, size=16)
    reference = np.array(clip.reference)
    reference[0, 3, 4] = np.nan
    write_clip(clip._replace(reference=reference), tmp_path / "clip")
    with pytest.warns(UserWarning, match="3 values of the reference are not finite or negative; they count as 0"):
        (loaded,) = load_validation(identity(), [tmp_path])
    expected = np.where(np.isfinite(reference), reference, 0).astype(np.float16)
    np.testing.assert_array_equal(loaded.clip.reference, expected.astype(np.float32))
    assert loaded.halves is None
    assert np.isfinite(make_validation(identity(), [loaded])({"gain": jnp.float32(1.0)}))
