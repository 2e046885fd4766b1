"""Packed training sets: codes against their definitions, the size of the file, damage, and batches."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxdn import clips
from jaxdn.clips import ClipError, training_batches
from jaxdn.core.frame import BUFFERS, FAR, Frame
from jaxdn.data.training import compact
from jaxdn.data.training.cache import read_array, read_window
from jaxdn.data.training.light_samples import sample_light
from jaxdn.data.training.open_clips import open_clips
from jaxdn.data.training.pack import open_pack, write_pack
from jaxdn.data.training.windows import Packing
from jaxdn.denoisers import svgf
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.training.validation import load_validation

SIDE, FRAMES, DRAWS = 20, 4, 3
SMALL = Packing(crop=8, frames=3)
EVERYTHING = (slice(None),) * 3


def write_clip(home: Path, seed: int, *, count: int = FRAMES, draws: int = DRAWS) -> None:
    """A clip of every kind of value that must survive: missing normals, FAR, vectors that are equal or not finite."""
    rng = np.random.default_rng(seed)
    home.mkdir(parents=True)

    def image(channels: int) -> np.ndarray:
        return rng.random((SIDE, SIDE, channels), np.float32)

    for t in range(count):
        normal = image(3) - 0.5
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        miss = image(1) < 0.2
        motion = 20 * image(2) - 10
        motion[image(1)[..., 0] < 0.1] = np.nan
        frame = Frame(
            radiance=image(3),
            albedo=image(3),
            normal=np.where(miss, 0, normal),
            depth=np.where(miss, FAR, 10 * image(1)).astype(np.float32),
            roughness=image(1),
            motion=motion,
            dual_motion=np.where(image(1) < 0.3, motion + 3, motion),
            visible=image(1) > 0.1,
            direct=image(3),
            emission=image(3),
            reflectance=image(3),
        )
        samples = rng.exponential(1.0, (draws, SIDE, SIDE, 6)).astype(np.float32) if draws else None
        light = {"reference": 5 * image(3), "reference_half": 5 * image(3), "draws": samples}
        clips.write_frame(clips.frame_path(home, t), frame, layers={1: image(3)}, **light)
    record = {"frames": count, "width": SIDE, "height": SIDE, "layers": [1], "reference_spp": 16}
    clips.finish_record(record, home)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("packs") / "clips"
    for seed in range(3):
        write_clip(home / f"clip{seed}", seed)
    return home


@pytest.fixture(scope="module")
def packed(folder: Path) -> Path:
    """Whole frames of all clips."""
    path = folder.parent / "whole.pack"
    write_pack(path, open_clips(folder), size=2**22, packing=Packing(crop=SIDE, draws=DRAWS))
    return path


lights = arrays(np.float32, (7, 3), elements=st.floats(0, 2.0**17, width=32))


@given(lights)
def test_rgb9e5_is_the_extension_s_definition(light: np.ndarray) -> None:
    codes = compact.encode_light(light)
    for code, pixel in zip(codes, light.astype(np.float64), strict=True):
        clamped = np.minimum(pixel, 65408.0)
        largest = clamped.max()
        exponent = max(-16, int(np.floor(np.log2(largest))) if largest > 0 else -16) + 16
        if np.floor(largest / 2.0 ** (exponent - 24) + 0.5) == 512:
            exponent += 1
        expected = [int(np.floor(value / 2.0 ** (exponent - 24) + 0.5)) for value in clamped]
        assert [int(code) >> shift & 511 for shift in (0, 9, 18)] == expected
        assert int(code) >> 27 == exponent


@given(lights, st.sampled_from([7, 9]))
def test_light_is_within_its_bound_and_exact_in_half_precision(light: np.ndarray, bits: int) -> None:
    codes = compact.encode_light(light, bits)
    found = compact.decode_light(codes, bits)
    wanted = np.minimum(light, 2.0**16 * (1 - 2.0**-bits))
    bound = np.maximum(2.0**-bits * wanted.max(axis=-1, keepdims=True), 2.0 ** -(16 + bits))
    assert (np.abs(found - wanted) <= bound).all()
    np.testing.assert_array_equal(compact.encode_light(found, bits), codes)


def test_light_without_a_value_is_dark() -> None:
    broken = np.array([[np.nan, 1, -1], [np.inf, 2, 0]], np.float32)
    np.testing.assert_array_equal(compact.decode_light(compact.encode_light(broken)), [[0, 1, 0], [0, 2, 0]])


@given(arrays(np.float64, (9, 3), elements=st.floats(-1, 1)))
def test_directions_are_within_a_quarter_of_a_degree(values: np.ndarray) -> None:
    values = values[np.linalg.norm(values, axis=-1) > 1e-3]
    found = compact.decode_direction(compact.encode_direction(values)).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 1, atol=1e-3)
    cross = np.linalg.norm(np.cross(found, values), axis=-1)
    assert (np.degrees(np.arctan2(cross, (found * values).sum(-1))) < 0.26).all()


def test_axes_and_no_direction_are_exact() -> None:
    values = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))]).astype(np.float32)
    np.testing.assert_array_equal(compact.decode_direction(compact.encode_direction(values)), values)
    broken = np.array([[np.nan, 0, 1], [np.inf, 0, 0]], np.float32)
    np.testing.assert_array_equal(compact.decode_direction(compact.encode_direction(broken)), 0)


@given(arrays(np.float32, 9, elements=st.floats(2.0**-30, 9e5, width=32)))
def test_distances_are_within_their_bound(values: np.ndarray) -> None:
    found = compact.decode_distance(compact.encode_distance(values))
    assert (np.abs(found - values) <= 2.0**-11 * values).all()
    special = np.array([0, FAR, np.inf, 1e9, np.nan, -1], np.float32)
    np.testing.assert_array_equal(compact.decode_distance(compact.encode_distance(special)), [0, FAR, FAR, FAR, 0, 0])


@given(arrays(np.float32, 9, elements=st.floats(-511, 511, width=32)))
def test_vectors_and_fractions_are_within_their_bounds(values: np.ndarray) -> None:
    assert (np.abs(compact.decode_vector(compact.encode_vector(values)) - values) <= 1 / 128).all()
    lost = np.array([np.nan, np.inf, -600], np.float32)
    assert np.isnan(compact.decode_vector(compact.encode_vector(lost))).all()
    fractions = np.abs(values) / 511
    assert (np.abs(compact.decode_fraction(compact.encode_fraction(fractions)) - fractions) < 1 / 500).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("slopes", [(), (-2,), (-2, -3)])
def test_compression_loses_nothing(dtype: type, slopes: tuple[int, ...], rng: np.random.Generator) -> None:
    for codes in (rng.integers(0, np.iinfo(dtype).max, (3, 5, 4, 2)), np.zeros((3, 5, 4, 2)), np.ones((1, 1, 1, 1))):
        codes = codes.astype(dtype)
        way, data = compact.compress(codes, slopes)
        np.testing.assert_array_equal(compact.decompress(way, data, dtype, codes.shape, slopes), codes)


def test_every_array_comes_back_within_its_bound(folder: Path, packed: Path) -> None:
    originals = {clip.path.name: clip for clip in open_clips(folder)}
    windows = open_pack(packed)
    assert sorted(window.path.name[5:] for window in windows) == sorted(originals)
    for window in windows:
        clip = originals[window.path.name[5:]]
        assert window.shape == clip.shape
        assert (window.half_spp, window.draws, window.layers) == (8, DRAWS, (1,))
        assert window.arrays == clip.arrays
        for name in clip.arrays - {"draws", "noisy_1spp"}:
            found, wanted = (read_array(each, name, EVERYTHING) for each in (window, clip))
            kind = BUFFERS[name].kind if name in BUFFERS else "light"
            bound = {"light": 5 * 2.0**-9, "fraction": 1 / 500, "direction": 0.005, "vector": 1 / 128}.get(kind, 0)
            bound = 2.0**-11 * wanted if kind == "distance" else bound
            assert (np.isfinite(found) == np.isfinite(wanted)).all(), name
            assert (np.abs(np.float32(np.nan_to_num(found)) - np.nan_to_num(wanted)) <= bound).all(), name
        draws, wanted = (read_array(each, "draws", EVERYTHING) for each in (window, clip))
        assert (np.abs(draws - wanted) <= 2.0**-7 * wanted.max()).all()
        np.testing.assert_array_equal(read_array(window, "noisy_1spp", EVERYTHING), draws[:, 0, ..., :3])


def test_what_must_be_exact_is(folder: Path, packed: Path) -> None:
    originals = {clip.path.name: clip for clip in open_clips(folder)}
    for window in open_pack(packed):
        found = read_window(window, EVERYTHING).frames
        wanted = read_window(originals[window.path.name[5:]], EVERYTHING).frames
        np.testing.assert_array_equal(found.visible, wanted.visible)
        np.testing.assert_array_equal(found.depth == FAR, wanted.depth == FAR)
        np.testing.assert_array_equal((found.normal == 0).all(-1), (wanted.normal == 0).all(-1))
        np.testing.assert_array_equal(np.isnan(found.motion), np.isnan(wanted.motion))
        np.testing.assert_array_equal(found.motion == found.dual_motion, wanted.motion == wanted.dual_motion)


def test_batches_are_those_of_the_clips(folder: Path, packed: Path, tmp_path: Path) -> None:
    order = [folder / window.path.name[5:] for window in open_pack(packed)]
    options = {"batch": 4, "crop": 16, "frames": 3, "seed": 5, "spp": (8,), "variation": NO_AUGMENTATION}
    buffers = {"albedo", "depth", "motion", "dual_motion", "visible"}
    one, other = (next(training_batches(place, buffers=buffers, **options)) for place in (order, [packed]))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2.5 * 5 * 2.0**-9), one, other)
    mixed = next(training_batches([packed, folder], batch=2, crop=16, frames=3, seed=0, spp=(1, 3, 8)))
    assert mixed.reference.shape == (2, 3, 16, 16, 3)


@pytest.mark.slow
def test_indirect_light_alone_and_no_single_samples(folder: Path, tmp_path: Path) -> None:
    sources = open_clips(folder)
    write_pack(tmp_path / "a.pack", sources, size=2**19, packing=SMALL._replace(direct=False, half=False))
    window = open_pack(tmp_path / "a.pack")[0]
    assert {"direct", "emission", "reference_half"}.isdisjoint(window.arrays)
    assert window.half_spp == 0
    light = sample_light(window, EVERYTHING, 2, np.random.default_rng(0), beauty=True)
    np.testing.assert_array_equal(light.reference, read_array(window, "reference", EVERYTHING))
    whole = Packing(crop=SIDE, draws=0, buffers=("albedo",))
    write_pack(tmp_path / "b.pack", sources, size=2**22, packing=whole)
    held_out = load_validation(svgf(), [tmp_path / "b.pack", folder])
    assert len(held_out) == 6
    assert held_out[0].clip.frames.albedo.shape == held_out[0].clip.reference.shape == (FRAMES, SIDE, SIDE, 3)
    packed, read = (sorted(float(np.mean(each.halves[1])) for each in some) for some in (held_out[:3], held_out[3:]))
    np.testing.assert_allclose(packed, read, rtol=1e-2)
    with pytest.raises(ClipError, match=r"0000-clip\d: 2 samples a pixel are not available"):
        load_validation(svgf(), [tmp_path / "b.pack"], spp=2)


@pytest.mark.slow
def test_the_size_is_kept_and_used_fairly_and_the_same_each_time(folder: Path, tmp_path: Path) -> None:
    sources, counts = open_clips(folder), []
    for kib in (20, 45, 90):
        written = write_pack(tmp_path / "a.pack", sources, size=1024 * kib, packing=SMALL)
        data = (tmp_path / "a.pack").read_bytes()
        assert 1024 * (kib - 12) < len(data) == written.size <= 1024 * kib
        windows = [window.path.name[5:] for window in open_pack(tmp_path / "a.pack")]
        per_clip = [windows.count(clip.path.name) for clip in sources]
        assert max(per_clip) - min(per_clip) <= 1
        assert sum(per_clip) == written.windows
        counts.append(written.windows)
    assert counts == sorted(counts)
    write_pack(tmp_path / "b.pack", sources, size=1024 * 90, packing=SMALL)
    assert (tmp_path / "b.pack").read_bytes() == data
    write_pack(tmp_path / "b.pack", sources, size=1024 * 90, packing=SMALL._replace(seed=1))
    assert (tmp_path / "b.pack").read_bytes() != data


def test_damaged_files_are_refused_and_leave_no_cache(packed: Path, tmp_path: Path, rng: np.random.Generator) -> None:
    data, file = packed.read_bytes(), tmp_path / "broken.pack"
    broken = [data[:40], data[:-1], data + b"x"]
    for place in rng.integers(8, len(data), 5):
        broken.append(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
    for contents in broken:
        file.write_bytes(contents)
        with pytest.raises(ClipError, match=r"broken\.pack: the file is damaged or incomplete.*pack it again"):
            open_pack(file)
    for contents in (b"", b"hello", b"jaxdnpk0" + data[8:]):
        file.write_bytes(contents)
        with pytest.raises(ClipError, match=r"broken\.pack: this is not a training set"):
            training_batches(file, batch=1, crop=8, seed=0)
    assert os.listdir(tmp_path / ".cache") == []
    file.write_bytes(data)
    assert len(open_pack(file)) == 3
    with pytest.raises(ClipError, match=r"none\.pack: there is no such file"):
        open_pack(tmp_path / "none.pack")


def test_clips_that_lack_what_is_asked_for_are_named(folder: Path, tmp_path: Path) -> None:
    def refused(match: str, size: int = 2**20, **changes: object) -> None:
        with pytest.raises(ValueError, match=match):
            write_pack(tmp_path / "a.pack", open_clips(folder), size=size, packing=SMALL._replace(**changes))
        assert not list(tmp_path.iterdir())

    refused(r"clip0: expected at least 21 x 21 pixels for the crop, got 20 x 20", crop=21)
    refused(r"clip0: expected 4 single samples, got 3", draws=4)
    refused(r"a\.pack: expected room for one window of 8 x 8 pixels, which takes .* MiB", size=2**10)
    refused(r"buffers: expected some of albedo.*, got albdo", buffers=("albdo",))
    refused(r"frames: expected at least 1, got 0", frames=0)


@pytest.mark.slow
def test_the_command_packs_and_fails_plainly(folder: Path, tmp_path: Path) -> None:
    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "jaxdn.commands.main", "pack", *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    out = tmp_path / "packs" / "train.pack"
    options = ("-o", out, "--crop", "8", "--frames", "3", "--buffers", "albedo", "motion")
    done = run(folder, *options, "--mib", "0.05")
    assert done.returncode == 0, done.stderr
    assert "windows of 3 clips" in done.stdout
    assert out.stat().st_size <= 0.05 * 2**20
    assert next(training_batches(out, batch=2, crop=8, frames=3, seed=0)).frames.normal is None
    out.unlink()
    for problem, arguments in {
        "expected room for one window": (folder, *options, "--mib", "0.001"),
        "found none": (tmp_path, *options, "--mib", "1"),
    }.items():
        done = run(*arguments)
        assert done.returncode == 2
        assert problem in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr
        assert os.listdir(out.parent) == [".cache"]
