"""``jaxdn denoise --reblur``: the camera is found in files or stated, and what is written is blurred by it."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.data.exr.file import ExrFile
from jaxdn.filters.camera_blur import blur_motion
from jaxdn.sequence.optics import Optics, read_optics
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import NOISY, find_model
from tests.programs import WIDTH, layer, part, truth
from tests.training.test_training import make_clip

CAMERA: dict[str, Any] = {
    "expTime": 0.02,
    "framesPerSecond": Fraction(25),
    "aperture": 2.0,
    "focus": 4.0,
    "nominalFocalLength": 50.0,
    "sensorOverallDimensions": np.array([36, 24], np.float32),
}


def write(folder: Path, *without: str, frames: int = 2, still: int = 0, **attributes: Any) -> Path:
    """A shot with a light layer, alpha, vectors and depth, and attributes; some layers may be left out.

    In its first ``still`` frames all vectors are 0.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(frames):
        now = truth(frame)
        channels = layer("", np.concatenate([now.light, now.alpha], axis=-1), "RGBA")
        channels |= layer("lamp", now.light, "RGB") | layer("albedo", now.albedo, "RGB")
        both = np.concatenate([now.motion * [1, -1], -now.forward * [1, -1]], axis=-1) * (frame >= still)
        channels |= {} if "motion" in without else layer("V.Vector", both, "XYZW")
        channels |= {} if "depth" in without else layer("V.Depth", now.depth, "Z")
        OpenEXR.File([part(channels, **attributes)]).write(str(folder / f"s.{frame:04d}.exr"))
    return folder


def test_the_camera_is_read_from_standard_attributes(tmp_path: Path) -> None:
    file = ExrFile(write(tmp_path, frames=1, **CAMERA) / "s.0000.exr")
    told = read_optics(file, Optics())
    assert told.shutter == pytest.approx(0.5)
    assert told == Optics(shutter=told.shutter, fstop=2.0, lens=50.0, sensor=36.0, focus=4.0)
    assert read_optics(file, Optics(metres=0.01, shutter=0.25)).focus == pytest.approx(400)
    assert read_optics(file, Optics(metres=0.01, shutter=0.25)).shutter == 0.25
    angle = ExrFile(write(tmp_path / "b", frames=1, shutterAngle=90.0, sensorPhotositePitch=1000.0) / "s.0000.exr")
    assert read_optics(angle, Optics()) == Optics(shutter=0.25, sensor=WIDTH)


def test_half_a_lens_is_not_done_where_the_file_says_it_and_refused_where_it_is_stated(tmp_path: Path) -> None:
    file = ExrFile(write(tmp_path, frames=1, aperture=2.0) / "s.0000.exr")
    assert read_optics(file, Optics(shutter=0.5)) == Optics(shutter=0.5)
    assert read_optics(file, Optics(lens=50, focus=3)).fstop == 2
    for half in (Optics(shutter=0.5, fstop=4), Optics(shutter=0.5, lens=50)):
        with pytest.raises(ValueError, match=r"expected (lens and )?focus too"):
            read_optics(file, half)


def test_a_panorama_has_no_lens_by_its_attribute_or_as_it_is_stated(tmp_path: Path) -> None:
    shot = write(tmp_path / "in", frames=1, **CAMERA)
    assert read_optics(ExrFile(shot / "s.0000.exr"), Optics(), wraps=True).fstop is None
    around = write(tmp_path / "around", frames=1, envmap=OpenEXR.ENVMAP_LATLONG, **CAMERA)
    assert read_optics(ExrFile(around / "s.0000.exr"), Optics()).fstop is None
    settings = Settings(reblur=Optics(fstop=2), wrap=True)
    with pytest.raises(ValueError, match="a panorama has no lens"):
        denoise_files([shot], tmp_path / "out", find_model(NOISY), settings)
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.slow
def test_beauty_alpha_and_light_layers_are_blurred_alike_and_the_rest_stays(tmp_path: Path) -> None:
    shot = write(tmp_path / "in")
    lines: list[str] = []
    settings = Settings(reblur=Optics(shutter=0.8), aovs="additive")
    denoise_files([shot], tmp_path / "out", find_model(NOISY), settings, log=lines.append)
    for frame in range(2):
        before, after = (clips.read_exr(tmp_path / side / f"s.{frame:04d}.exr") for side in ("in", "out"))
        now = truth(frame)
        depth, motion = now.depth.astype(np.float32), now.motion.astype(np.float32)
        wanted = np.asarray(blur_motion(np.stack([before[c] for c in "RGBA"], axis=-1), motion, depth, 0.8))
        assert np.abs(wanted[..., :3] - np.stack([before[c] for c in "RGB"], axis=-1)).max() > 0.05
        np.testing.assert_allclose(np.stack([after[c] for c in "RGBA"], axis=-1), wanted, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(after["V.Depth.Z"], before["V.Depth.Z"])
    assert any("--reblur: shutter 0.8: what is sharp spreads over up to 3 pixels" in line for line in lines)


def test_frames_that_stand_still_are_not_blurred_by_the_shutter_and_those_after_them_are(tmp_path: Path) -> None:
    shot = write(tmp_path / "in", frames=3, still=2)
    lines: list[str] = []
    denoise_files([shot], tmp_path / "out", find_model(NOISY), Settings(reblur=Optics(shutter=0.8)), log=lines.append)
    for frame in range(3):
        before, after = (clips.read_exr(tmp_path / side / f"s.{frame:04d}.exr")["G"] for side in ("in", "out"))
        if frame < 2:
            np.testing.assert_array_equal(after, before)
        else:
            assert np.abs(after - before).max() > 0.05
    told = [line for line in lines if line.startswith("--reblur")]
    assert len(told) == 2
    assert "s.0000.exr: all vectors are 0, so nothing is blurred by the shutter" in told[0]
    assert "3 pixels in the first frame that is blurred" in told[1]


@pytest.mark.slow
def test_light_layers_still_add_up(tmp_path: Path) -> None:
    shot = write(tmp_path / "in")
    settings = Settings(reblur=Optics(shutter=1.0), aovs="additive")
    denoise_files([shot], tmp_path / "out", find_model("svgf"), settings)
    for frame in range(2):
        after = clips.read_exr(tmp_path / "out" / f"s.{frame:04d}.exr")
        for letter in "RGB":
            np.testing.assert_allclose(after[f"lamp.{letter}"], after[letter], rtol=1e-3, atol=1e-4)


def test_the_command_takes_a_camera_by_words_and_blurs_what_is_out_of_focus(tmp_path: Path) -> None:
    shot = write(tmp_path / "in")
    camera = ["fstop=5", "lens=50", "focus=1", "sensor=2"]
    main.main(["denoise", str(shot), "-o", str(tmp_path / "out"), "--method", NOISY, "--reblur", *camera])
    plain, blurred = (clips.read_exr(tmp_path / side / "s.0000.exr")["G"] for side in ("in", "out"))
    assert blurred.std() < 0.9 * plain.std()
    np.testing.assert_allclose(blurred.mean(), plain.mean(), rtol=0.05)


@pytest.mark.parametrize(
    ("without", "words", "message"),
    [
        ([], [], "expected a shutter, or a lens with its focus, and the file names none: --reblur shutter=0.5"),
        ([], ["fstop=2"], "expected lens and focus too"),
        ([], ["shutter=180"], "--reblur shutter: expected a number in [0, 1] or None, got 180"),
        ([], ["speed=1"], "expected options out of shutter, fstop"),
        (["motion"], ["shutter=0.5"], "expected motion vectors; render them"),
        (["depth"], ["fstop=2", "lens=50", "focus=2"], "expected depth; name it, --channels depth=LAYER"),
    ],
)
def test_what_is_missing_is_said_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], without: list[str], words: list[str], message: str
) -> None:
    shot = write(tmp_path / "in", *without)
    out = tmp_path / "out"
    with pytest.raises(SystemExit, match="2"):
        main.main(["denoise", str(shot), "-o", str(out), "--method", NOISY, "--reblur", *words])
    assert message in " ".join(capsys.readouterr().err.split())
    assert not list(out.glob("*"))


def test_clips_of_our_own_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clips.write_clip(make_clip(0), tmp_path / "clip")
    with pytest.raises(SystemExit, match="2"):
        main.main(["denoise", str(tmp_path / "clip"), "-o", str(tmp_path / "out"), "--reblur", "shutter=0.5"])
    assert "--reblur: expected files of other renderers" in capsys.readouterr().err
