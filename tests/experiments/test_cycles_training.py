"""Clips of Cycles as clips to train on: files as Blender names them, read again by the training stream."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.cycles import reference as references
from experiments.cycles import training
from experiments.cycles.reference import Reference
from jaxdn.clips import training_batches, write_exr
from jaxdn.data.clip.folder import read_frames, read_record

FRAMES, SIZE = 3, (16, 24)


def write_cycles_clip(folder: Path, name: str) -> None:
    """A clip whose image of n samples has the light 1 + n and the albedo n / 20; the reference has the light 0.5."""
    for samples in (1, 4, 16):
        (folder / f"{samples}spp-0").mkdir(parents=True)
        for number in range(1, FRAMES + 1):
            ones = np.ones(SIZE, np.float32)
            channels = {f"ViewLayer.Combined.{c}": (1 + samples) * ones for c in "RGB"}
            channels |= {f"ViewLayer.Denoising Albedo.{c}": samples / 20 * ones for c in "RGB"}
            channels |= {f"ViewLayer.Denoising Normal.{c}": ones * (c == "Z") for c in "XYZ"}
            channels["ViewLayer.Denoising Normal.X"] += np.linspace(0, 0.1, SIZE[1], dtype=np.float32)  # not empty
            channels |= {"ViewLayer.Depth.Z": number * ones}
            channels |= {f"ViewLayer.Vector.{c}": (c == "X") * ones for c in "XYZW"}
            write_exr(folder / f"{samples}spp-0" / f"{number:04d}.exr", channels)
    (folder / "reference").mkdir()
    image = np.full((*SIZE, 3), 0.5)
    guides = np.concatenate([np.full((*SIZE, 3), 1.5), np.broadcast_to([0, 0, 0.5, 2.0], (*SIZE, 4))], axis=-1)
    held = Reference(image + 0.125, image - 0.125, guides, 32, 2)
    for number in range(1, FRAMES + 1):
        references.write(folder / "reference" / f"{number:04d}.exr", held)
    record = {
        "set": name,
        "kind": "sun",
        "seed": 0,
        "level": 0,
        "frames": FRAMES,
        "pixel_filter": ["BLACKMAN_HARRIS", 1.5],
    }
    (folder / "cycles.json").write_text(json.dumps(record))


def test_each_image_keeps_its_own_guides(tmp_path: Path) -> None:
    write_cycles_clip(tmp_path / "train" / "sun-0000", "train")
    out = tmp_path / "clips"
    assert training.main(training.Options(tmp_path / "train", out)) == 0
    record = read_record(out / "sun-0000")
    assert record["layers"] == [1, 4, 16]
    assert record["reference_spp"] == 64
    assert record["pixel_filter"] == "blackman-harris"
    assert record["cycles"]["kind"] == "sun"
    stored = list(read_frames(out / "sun-0000", spp=4))
    assert len(stored) == FRAMES
    for number, one in enumerate(stored, 1):
        np.testing.assert_array_equal(one.frame.radiance, 5.0)
        np.testing.assert_allclose(one.frame.albedo, 0.2, rtol=1e-3)
        np.testing.assert_array_equal(one.frame.depth, number)
        np.testing.assert_array_equal(one.reference, 0.5)
        np.testing.assert_array_equal(one.reference_half, 0.625)
        np.testing.assert_array_equal(one.reference_guides["albedo"], 1.0)  # of lamps it is more: their light
        np.testing.assert_array_equal(one.reference_guides["normal"], np.broadcast_to([0, 0, 1], (*SIZE, 3)))


def test_clips_of_cycles_are_trained_on(tmp_path: Path) -> None:
    write_cycles_clip(tmp_path / "train" / "sun-0000", "train")
    training.main(training.Options(tmp_path / "train", tmp_path / "clips"))
    given = {"batch": 4, "crop": 16, "frames": FRAMES, "seed": 0, "spp": (1, 4, 16), "threads": 0}
    batch = next(training_batches(tmp_path / "clips", buffers=("albedo", "motion"), augment=False, **given))
    light = batch.frames.radiance[:, 0, 0, 0, 0]
    assert set(light.tolist()) <= {2.0, 5.0, 17.0}
    np.testing.assert_allclose(batch.frames.albedo[:, 0, 0, 0, 0], (light - 1) / 20, rtol=1e-3)
    np.testing.assert_array_equal(batch.frames.motion, np.broadcast_to([1, 0], batch.frames.motion.shape))
    np.testing.assert_array_equal(batch.reference, 0.5)


def test_a_clip_that_is_there_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_cycles_clip(tmp_path / "train" / "sun-0000", "train")
    options = training.Options(tmp_path / "train", tmp_path / "clips")
    training.main(options)
    before = (tmp_path / "clips/sun-0000/clip.json").stat().st_mtime_ns
    capsys.readouterr()
    training.main(options)
    assert (tmp_path / "clips/sun-0000/clip.json").stat().st_mtime_ns == before
    assert not capsys.readouterr().out


def test_clips_for_tests_are_refused(tmp_path: Path) -> None:
    write_cycles_clip(tmp_path / "test" / "sun-9000", "test")
    with pytest.raises(ValueError, match="nothing is trained on those"):
        training.main(training.Options(tmp_path / "test", tmp_path / "clips"))
    assert not (tmp_path / "clips").exists()
