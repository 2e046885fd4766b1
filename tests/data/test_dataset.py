"""The stream of training batches: contents, reproducibility, resuming, and refused input."""

import os
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxdn import clips
from jaxdn.clips import ClipError, training_batches
from jaxdn.core.frame import BUFFERS, Clip, Frame
from jaxdn.data.training.cache import open_cached, read_window
from jaxdn.recipes.augmentation import Augmentation, vary_clip

HEIGHT, WIDTH = 12, 15


def coordinates(count: int, clip: int) -> np.ndarray:
    """A clip whose values are their own coordinates: (clip, frame, row * 16 + column), exact in half precision."""
    t, y, x = np.mgrid[:count, :HEIGHT, :WIDTH].astype(np.float32)
    return np.stack([np.full_like(t, clip), t, y * 16 + x], axis=-1)


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Three clips of 4, 4 and 9 frames with layers of 1 and 2 samples."""
    for index, count in enumerate((4, 4, 9)):
        home = tmp_path / "clips" / f"clip{index}"
        home.mkdir(parents=True)
        image = coordinates(count, index)
        for t in range(count):
            motion = rng.random((HEIGHT, WIDTH, 2), np.float32)
            frame = Frame(radiance=image[t], motion=motion, depth=image[t, ..., 2:])
            layers = {1: image[t], 2: image[t] + 4}
            clips.write_frame(clips.frame_path(home, t), frame, layers=layers, reference=image[t])
        clips.finish_record({"frames": count, "width": WIDTH, "height": HEIGHT, "layers": [1, 2]}, home)
    return tmp_path / "clips"


def equal(one: Clip, other: Clip) -> bool:
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, one, other)))


def test_elements_are_windows_of_one_clip(folder: Path) -> None:
    stream = training_batches(folder, batch=5, crop=6, frames=3, seed=1, augment=False)
    starts = set()
    for _ in range(6):
        batch = next(stream)
        assert batch.frames.radiance.shape == (5, 3, 6, 6, 3)
        assert batch.frames.radiance.dtype == np.float32
        assert batch.frames.albedo is None
        np.testing.assert_array_equal(batch.reference, batch.frames.radiance)
        np.testing.assert_array_equal(batch.frames.depth, batch.frames.radiance[..., 2:])
        for element in batch.reference:
            assert np.ptp(element[..., 0]) == 0  # one clip
            np.testing.assert_array_equal(np.diff(element[:, 0, 0, 1]), 1)  # consecutive frames
            place = element[0, ..., 2]
            assert np.ptp(element[..., 2], axis=0).max() == 0  # the same crop in all of them
            np.testing.assert_array_equal(np.diff(place, axis=1), 1)
            np.testing.assert_array_equal(np.diff(place, axis=0), 16)
            starts.add((element[0, 0, 0, 0], element[0, 0, 0, 1], place[0, 0]))
    assert {clip for clip, _, _ in starts} == {0, 1, 2}
    assert len(starts) > 20


def test_buffers_of_samples_come_with_their_own_noise(tmp_path: Path, rng: np.random.Generator) -> None:
    """Clips with single samples to draw from: specular light is that of the layer, or it is none."""
    for index in range(2):
        home = tmp_path / f"clip{index}"
        home.mkdir()
        for t in range(3):
            light, draws = rng.random((HEIGHT, WIDTH, 3), np.float32), rng.random((4, HEIGHT, WIDTH, 6), np.float32)
            frame = Frame(radiance=light, specular=light / 2)
            options = {"layers": {1: light}, "reference": light, "draws": draws}
            clips.write_frame(clips.frame_path(home, t), frame, **options)
        clips.finish_record({"frames": 3, "width": WIDTH, "height": HEIGHT, "layers": [1], "draws": 4}, home)
    options = {"batch": 8, "crop": 8, "frames": 2, "seed": 1}
    batch = next(training_batches(tmp_path, **options))
    np.testing.assert_allclose(batch.frames.specular, batch.frames.radiance / 2, rtol=2e-3)
    np.testing.assert_allclose(batch.reference, batch.frames.radiance, rtol=2e-3)
    more = next(training_batches(tmp_path, **options, spp=2))
    assert not np.any(more.frames.specular)
    mixed = next(training_batches(tmp_path, **options, spp=(1, 2)))
    assert 0 < np.any(mixed.frames.specular, axis=(1, 2, 3, 4)).sum() < 8
    drawn = next(training_batches(tmp_path, **options, buffers=()))
    assert drawn.frames.specular is None
    assert np.abs(drawn.reference - drawn.frames.radiance).max() > 0.1


def test_augmented_elements_are_symmetries_of_image_and_motion(folder: Path) -> None:
    batch = next(training_batches(folder, batch=24, crop=6, frames=2, seed=3))
    shapes = set()
    for element in batch.reference[..., 2]:
        down, right = element[0, 1, 0] - element[0, 0, 0], element[0, 0, 1] - element[0, 0, 0]
        shapes.add((down, right))
    assert len(shapes) == 8
    assert (batch.frames.motion < 0).any()  # the clips' own motion is positive
    wide = next(training_batches(folder, batch=16, crop=(4, 8), frames=2, seed=3))
    assert wide.reference.shape == (16, 2, 4, 8, 3)


def test_equal_arguments_give_equal_streams_and_seeds_differ(folder: Path) -> None:
    one, same = (training_batches(folder, batch=2, crop=5, frames=2, seed=7, threads=n) for n in (0, 2))
    other = training_batches(folder, batch=2, crop=5, frames=2, seed=8)
    firsts = [next(one) for _ in range(5)]
    assert all(equal(batch, next(same)) for batch in firsts)
    assert not all(equal(batch, next(other)) for batch in firsts)
    assert not equal(firsts[0], firsts[1])


@pytest.mark.parametrize("threads", [0, 2])
def test_a_restored_stream_resumes_where_it_was(folder: Path, threads: int) -> None:
    def stream() -> clips.training_batches:
        return training_batches(folder, batch=2, crop=5, frames=2, seed=7, threads=threads)

    original = stream()
    for _ in range(9):  # more than one epoch
        next(original)
    state = original.get_state()
    rest = [next(original) for _ in range(6)]
    fresh = stream()
    fresh.set_state(state)
    assert all(equal(batch, next(fresh)) for batch in rest)
    # Back in time within one stream as well.
    original.set_state(state)
    assert equal(rest[0], next(original))


def test_sample_counts_and_buffers_can_be_chosen(folder: Path) -> None:
    batch = next(training_batches(folder, batch=1, crop=5, frames=2, seed=0, spp=2, buffers=("depth", "albedo")))
    np.testing.assert_array_equal(batch.frames.radiance, batch.reference + 4)
    assert batch.frames.motion is None
    np.testing.assert_array_equal(batch.frames.depth, batch.reference[..., 2:])
    mixed = next(training_batches(folder, batch=16, crop=5, frames=2, seed=0, spp=(1, 2)))
    offsets = (mixed.frames.radiance - mixed.reference)[:, 0, 0, 0, 0]
    assert set(offsets) == {0.0, 4.0}


def test_the_cache_holds_the_clip_and_follows_it(folder: Path) -> None:
    home = folder / "clip0"
    everything = (slice(None),) * 3
    for spp in (1, 2, 3):
        expected, found = clips.read_clip(home, spp=spp), read_window(open_cached(home), everything, spp=spp)
        assert equal(expected, found)
    kept = os.listdir(folder / ".cache")
    assert len(kept) == 1
    open_cached(home)
    assert os.listdir(folder / ".cache") == kept
    clips.write_clip(Clip(Frame(radiance=coordinates(2, 9)), coordinates(2, 9)), home)
    assert open_cached(home).shape == (2, HEIGHT, WIDTH)
    np.testing.assert_array_equal(read_window(open_cached(home), everything).reference, coordinates(2, 9))
    assert len(os.listdir(folder / ".cache")) == 1
    assert os.listdir(folder / ".cache") != kept


def test_caches_of_clips_whose_names_begin_alike_stay(folder: Path) -> None:
    (folder / "clip1").rename(folder / "clip0.new")
    longer, shorter = open_cached(folder / "clip0.new"), open_cached(folder / "clip0")
    assert len(os.listdir(folder / ".cache")) == 2
    for clip in (longer, shorter):
        read_window(clip, (slice(None),) * 3)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such rights")
def test_a_cache_can_be_read_by_those_who_can_read_the_clip(folder: Path) -> None:
    open_cached(folder / "clip0")
    (kept,) = (folder / ".cache").iterdir()
    assert kept.stat().st_mode == (folder / "clip0").stat().st_mode


def test_every_buffer_of_the_table_comes_back_from_the_cache(tmp_path: Path, rng: np.random.Generator) -> None:
    shape = (2, 5, 7)
    frames = Frame(**{name: 6e4 * rng.random((*shape, row.channels), np.float32) for name, row in BUFFERS.items()})
    frames = frames._replace(ids=rng.integers(-1, 10**6, (*shape, 1)), visible=rng.random((*shape, 1)) > 0.5)
    clips.write_clip(Clip(frames, frames.radiance), tmp_path / "all")
    expected = clips.read_clip(tmp_path / "all")
    window = (slice(1, 2), slice(0, 4), slice(2, 7))
    found = read_window(open_cached(tmp_path / "all"), window)
    for name, row in BUFFERS.items():
        assert getattr(found.frames, name).dtype == row.dtype, name
        np.testing.assert_array_equal(getattr(found.frames, name), getattr(expected.frames, name)[window], err_msg=name)


def test_independent_layers_are_cropped_and_turned_with_the_rest(folder: Path) -> None:
    expected = clips.read_clip(folder / "clip0", layers=True)
    assert sorted(expected.layers) == [1, 2]
    np.testing.assert_array_equal(expected.layers[2], coordinates(4, 0) + 4)
    assert clips.read_clip(folder / "clip0").layers is None
    window = (slice(1, 3), slice(2, 5), slice(0, 9))
    found = read_window(open_cached(folder / "clip0"), window, layers=True)
    assert equal(found, jax.tree.map(lambda image: image[window], expected))
    assert read_window(open_cached(folder / "clip0"), window).layers is None
    batch = next(training_batches(folder, batch=16, crop=6, frames=2, seed=3, spp=3, layers=True))
    assert {count: layer.shape for count, layer in batch.layers.items()} == dict.fromkeys((1, 2), (16, 2, 6, 6, 3))
    np.testing.assert_array_equal(batch.layers[1], batch.reference)
    np.testing.assert_array_equal(batch.layers[2], batch.reference + 4)
    assert next(training_batches(folder, batch=1, crop=6, frames=2, seed=3)).layers is None


def test_batches_have_the_layers_that_every_clip_has(tmp_path: Path) -> None:
    image = np.ones((4, 4, 3), np.float32)

    def write(name: str, *counts: int) -> None:
        (tmp_path / name).mkdir(exist_ok=True)
        frame = Frame(radiance=image)
        clips.write_frame(
            tmp_path / name / "frame_0000.exr", frame, layers=dict.fromkeys(counts, image), reference=image
        )
        clips.finish_record({"frames": 1, "width": 4, "height": 4, "layers": list(counts)}, tmp_path / name)

    def given() -> set[int]:
        stream = training_batches(tmp_path, batch=2, crop=4, frames=1, seed=0, spp=4, layers=True)
        return set(next(stream).layers)

    write("a", 1, 2, 4, 16)
    write("b", 1, 2, 4)
    assert given() == {1, 2, 4}  # 16 is not usable without 8
    write("b", 1, 4)
    assert given() == {1}
    write("b", 4)
    with pytest.raises(ClipError, match=r"b: expected independent noisy layers of 1, 2, 4, .* got 4; .*--layers"):
        given()
    with pytest.raises(ClipError, match=r"b: expected independent noisy layers"):
        clips.read_clip(tmp_path / "b", spp=4, layers=True)


def test_an_interrupted_clip_is_left_out_and_named(folder: Path) -> None:
    record = clips.read_record(folder / "clip1")
    clips.begin_record(record, folder / "clip1")
    with pytest.warns(UserWarning, match="clip1: rendering this clip was interrupted.*left out"):
        assert clips.find_clips(folder) == [folder / "clip0", folder / "clip2"]
    with pytest.raises(ClipError, match="clip1: rendering this clip was interrupted; run the same command again"):
        clips.find_clips(folder / "clip1")
    for name in ("clip0", "clip2"):
        clips.begin_record(clips.read_record(folder / name), folder / name)
    with pytest.raises(ClipError, match="clip0: rendering this clip was interrupted"):
        clips.find_clips(folder)


def test_a_clip_that_cannot_be_read_leaves_no_cache(folder: Path) -> None:
    file = clips.frame_path(folder / "clip1", 2)
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ClipError, match=r"frame_0002\.exr"):
        training_batches(folder, batch=1, crop=4, frames=2, seed=0)
    assert all(name.startswith("clip0.") for name in os.listdir(folder / ".cache"))
    file.unlink()
    with pytest.raises(ClipError, match=r"frame_0002\.exr"):
        training_batches(folder, batch=1, crop=4, frames=2, seed=0)


def test_a_broken_reference_is_zeroed_and_named_while_noise_is_kept(tmp_path: Path) -> None:
    image = np.ones((2, 4, 4, 3), np.float32)
    broken = image.copy()
    broken[0, 1, 1] = (np.nan, np.inf, -1.0)
    clips.write_clip(Clip(Frame(radiance=broken), broken), tmp_path / "bad")
    clips.write_clip(Clip(Frame(radiance=image), image), tmp_path / "good")
    for _ in range(2):  # from the EXR files and from the cache
        with pytest.warns(UserWarning, match="bad: 3 values of the reference"):
            stream = training_batches(tmp_path, batch=2, crop=4, frames=2, seed=0, augment=False)
    batch = next(stream)
    bad = int(np.argmin(batch.reference.sum(axis=(1, 2, 3, 4))))
    np.testing.assert_array_equal(batch.reference[bad, 0, 1, 1], 0)
    np.testing.assert_array_equal(batch.frames.radiance[bad, 0, 1, 1], [np.nan, np.inf, -1.0])
    np.testing.assert_array_equal(batch.reference[1 - bad], image)


def test_unsuitable_clips_and_arguments_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    def refused(match: str, **changes: object) -> None:
        options = {"batch": 1, "crop": 4, "frames": 2, "seed": 0, **changes}
        with pytest.raises(ValueError, match=match):
            training_batches(folder, **options)

    refused(r"clip0: expected at least 13 x 13 pixels for the crop, got 15 x 12", crop=13)
    refused(r"clip0: expected at least 5 frames, got 4", frames=5)
    refused(r"clip0: 4 samples a pixel are not available", spp=4)
    refused("batch: expected a whole number", batch=0)
    refused("crop: expected a whole number", crop=(4, 0))
    refused("seed: expected", seed=-1)
    refused("spp: expected at least one", spp=())
    image = coordinates(4, 3)
    clips.write_clip(Clip(Frame(radiance=image)), folder / "clip3")
    refused("clip3: there is no reference")
    clips.write_clip(Clip(Frame(radiance=image, albedo=image), image), folder / "clip3")
    refused("clip3: expected the same buffers as in the other clips, but albedo, depth, motion differs")
    with pytest.raises(ClipError, match="found none"):
        training_batches(tmp_path, batch=1, crop=4, seed=0)
    with pytest.raises(ClipError, match="no such folder"):
        training_batches(tmp_path / "nowhere", batch=1, crop=4, seed=0)
    with pytest.raises(ClipError, match="at least one folder"):
        training_batches([], batch=1, crop=4, seed=0)
    several = training_batches([folder / "clip0", folder / "clip1"], batch=2, crop=4, frames=2, seed=0)
    assert set(next(several).reference[..., 0].ravel()) <= {0.0, 1.0}


def test_headers_are_parsed_by_one_thread_at_a_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """CPython 3.11 fails now and then where several threads parse Python at once."""
    load, inside, most = np.load, [], []

    def slow(*arguments: object, **options: object) -> object:
        inside.append(1)
        most.append(len(inside))
        time.sleep(1e-3)
        inside.pop()
        return load(*arguments, **options)

    monkeypatch.setattr(np, "load", slow)
    batches = training_batches(folder, batch=2, crop=5, frames=2, seed=7, threads=4)
    for _ in range(4):
        next(batches)
    assert max(most) == 1


def test_what_is_varied_later_is_what_is_varied_at_once(folder):
    given = {"batch": 8, "crop": 5, "frames": 2, "seed": 7, "variation": Augmentation(missing=0.3, shadow=0.5)}
    at_once, later = training_batches(folder, **given), training_batches(folder, **given, vary_later=True)
    for _ in range(3):
        wanted, drawn = next(at_once), next(later)
        assert drawn.clip.frames.radiance.dtype == drawn.clip.reference.dtype == np.float16
        assert drawn.clip.frames.depth.dtype == np.float32
        vary = jax.vmap(lambda clip, draw: vary_clip(clip, draw, given["variation"]))
        found = jax.jit(vary)(*drawn)
        assert jax.tree.structure(found) == jax.tree.structure(wanted)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4), found, wanted)
    assert at_once.get_state() == later.get_state()
