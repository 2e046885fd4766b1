"""Single samples of indirect and direct light: stored, cached, and drawn anew for each element."""

from pathlib import Path

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.clips import ClipError, training_batches
from jaxdn.core.frame import Frame
from jaxdn.data.training.cache import open_cached
from jaxdn.data.training.light_samples import check_samples, sample_light
from jaxdn.recipes.augmentation import NO_AUGMENTATION

COUNT, FRAMES, SIDE = 4, 3, 6
EVERYTHING = (slice(None),) * 3


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One clip: draw k has indirect light 2^k and direct light 100; the reference 7 (half: 5), direct 3, emission 2."""
    home = tmp_path / "clips" / "one"
    home.mkdir(parents=True)
    flat = np.ones((SIDE, SIDE, 3), np.float32)
    draws = np.stack([np.concatenate([2.0**k * flat, 100 * flat], -1) for k in range(COUNT)])
    for t in range(FRAMES):
        frame = Frame(radiance=flat, direct=3 * flat, emission=2 * flat)
        light = {"reference": 7 * flat, "reference_half": 5 * flat, "draws": draws}
        clips.write_frame(clips.frame_path(home, t), frame, layers={1: 50 * flat, 16: 60 * flat}, **light)
    record = {"frames": FRAMES, "width": SIDE, "height": SIDE, "layers": [1, 16], "reference_spp": 24}
    clips.finish_record(record, home)
    return tmp_path / "clips"


def test_draws_come_back_from_the_file(folder: Path) -> None:
    stored = clips.read_frame(clips.frame_path(folder / "one", 1))
    assert stored.draws.shape == (COUNT, SIDE, SIDE, 6)
    np.testing.assert_array_equal(stored.draws[:, 0, 0, 0], [1, 2, 4, 8])
    np.testing.assert_array_equal(stored.draws[..., 3:], 100)
    assert stored.frame.direct[0, 0, 0] == 3


def test_some_samples_are_a_mean_of_different_draws(folder: Path) -> None:
    clip, rng = open_cached(folder / "one"), np.random.default_rng(0)
    single = {float(sample_light(clip, EVERYTHING, 1, rng).noisy[0, 0, 0, 0]) for _ in range(40)}
    assert single == {1.0, 2.0, 4.0, 8.0}
    pairs = {float(2 * sample_light(clip, EVERYTHING, 2, rng).noisy[0, 0, 0, 0]) for _ in range(60)}
    assert pairs == {3.0, 5.0, 6.0, 9.0, 10.0, 12.0}  # never the same draw twice
    window = (slice(1, 3), slice(2, 5), slice(0, 4))
    light = sample_light(clip, window, 4, rng)
    assert light.noisy.shape == light.reference.shape == (2, 3, 4, 3)
    np.testing.assert_array_equal(light.noisy, 15 / 4)
    np.testing.assert_array_equal(light.reference, 7)


def test_all_light_has_noisy_direct_light_and_emission(folder: Path) -> None:
    light = sample_light(open_cached(folder / "one"), EVERYTHING, 4, np.random.default_rng(0), beauty=True)
    np.testing.assert_array_equal(light.noisy, 15 / 4 + 100 + 2)
    np.testing.assert_array_equal(light.reference, 7 + 3 + 2)


def test_half_of_the_reference_is_a_clean_input_with_the_other_half_as_its_target(folder: Path) -> None:
    clip, rng = open_cached(folder / "one"), np.random.default_rng(0)
    light = sample_light(clip, EVERYTHING, 12, rng)
    np.testing.assert_array_equal(light.noisy, 5)
    np.testing.assert_allclose(light.reference, 9)  # the mean of both is 7
    np.testing.assert_array_equal(sample_light(clip, EVERYTHING, 16, rng).noisy, 60)
    for spp in (1, 4, 12, 16):
        check_samples(clip, spp)
    with pytest.raises(ClipError, match=r"single samples give 1 to 4, or 12 \(half of the reference\)"):
        check_samples(clip, 5)


def test_batches_draw_new_noise_for_each_element(folder: Path) -> None:
    stream = training_batches(folder, batch=32, crop=4, frames=2, seed=0, spp=(1, 12))
    batch = next(stream)
    noisy, wanted = batch.frames.radiance[:, 0, 0, 0, 0], batch.reference[:, 0, 0, 0, 0]
    assert set(noisy) == {1.0, 2.0, 4.0, 8.0, 5.0}
    np.testing.assert_allclose(wanted[noisy == 5], 9)
    np.testing.assert_allclose(wanted[noisy != 5], 7)
    whole = next(
        training_batches(folder, batch=8, crop=4, frames=2, seed=0, variation=NO_AUGMENTATION._replace(beauty=1.0))
    )
    np.testing.assert_array_equal(whole.reference, 12)
    assert whole.frames.direct is not None
    with pytest.raises(ClipError, match="5 samples a pixel are not available"):
        training_batches(folder, batch=1, crop=4, frames=2, seed=0, spp=5)


@pytest.fixture
def filtered(tmp_path: Path) -> Path:
    """A clip with filtered pixels: of the image of n samples, light is n, emission 10 n, and the albedo 1 / (1 + n)."""
    home = tmp_path / "filtered" / "one"
    home.mkdir(parents=True)
    flat = np.ones((SIDE, SIDE, 3), np.float32)

    def guides(samples: int) -> dict[str, np.ndarray]:
        return {"albedo": flat / (1 + samples), "emission": 10.0 * samples * flat}

    for t in range(FRAMES):
        frame = Frame(radiance=flat, normal=flat, depth=flat[..., :1], **guides(1))
        layers = {n: n * flat for n in (1, 2, 4)}
        light = {"reference": 64 * flat, "reference_half": 63 * flat}
        own = {n: guides(n) | {"normal": flat * (n == 1)} for n in layers}
        own[2]["normal"] = own[4]["normal"] = np.broadcast_to(np.float32([0, 0, 1]), flat.shape)
        path = clips.frame_path(home, t)
        reference_guides = guides(64) | {"normal": flat}
        clips.write_frame(path, frame, layers=layers, layer_guides=own, reference_guides=reference_guides, **light)
    record = {"frames": FRAMES, "width": SIDE, "height": SIDE, "layers": [1, 2, 4], "reference_spp": 64}
    clips.finish_record({**record, "pixel_filter": "box"}, home)
    return tmp_path / "filtered"


@pytest.mark.parametrize("beauty", [False, True])
@pytest.mark.parametrize(
    ("spp", "weights"), [(1, {1: 1}), (2, {2: 1}), (4, {4: 1}), (5, {1: 1 / 5, 4: 4 / 5}), (32, {})]
)
def test_guides_and_emission_of_filtered_pixels_are_those_of_the_same_samples(
    spp: int, weights: dict[int, float], beauty: bool, filtered: Path
) -> None:
    source = {"batch": 1, "crop": SIDE, "frames": FRAMES, "seed": 0, "spp": spp, "threads": 0, "augment": False}
    variation = NO_AUGMENTATION._replace(beauty=float(beauty))
    batch = next(training_batches(filtered, buffers=("albedo", "normal"), variation=variation, **source))
    light = sum(share * n for n, share in weights.items()) if weights else 63.0
    emission = sum(share * 10 * n for n, share in weights.items()) if weights else 640.0
    albedo = sum(share / (1 + n) for n, share in weights.items()) if weights else 1 / 65
    reference = 64.0 if weights else 65.0  # the other half
    np.testing.assert_allclose(batch.frames.radiance, light + beauty * emission, rtol=1e-3)
    np.testing.assert_allclose(batch.reference, reference + beauty * 640, rtol=1e-3)
    np.testing.assert_allclose(batch.frames.albedo, albedo, rtol=1e-3)
    assert batch.frames.depth is None


def test_other_clips_have_the_same_guides_at_every_sample_count(folder: Path) -> None:
    assert not open_cached(folder / "one").filtered
