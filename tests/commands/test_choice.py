"""``jaxdn denoise`` without ``--method``: it takes what is best for the frames at hand, and says so."""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import numpy as np
import pytest

from jaxdn.clips import read_exr, write_clip, write_exr
from jaxdn.commands import main
from jaxdn.commands.arguments import Denoise
from jaxdn.commands.denoise import _choose_method
from jaxdn.core.frame import Clip, Frame
from jaxdn.zoo.ready import BEST_ELSEWHERE, DEFAULT_MODEL
from tests.needs import require


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """One noisy frame as Blender writes it."""
    rng = np.random.default_rng(0)
    names = {"Combined": "RGB", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ"}
    pixels = {f"ViewLayer.{name}.{c}": rng.random((32, 32), np.float32) for name, cs in names.items() for c in cs}
    (tmp_path / "shot").mkdir()
    write_exr(tmp_path / "shot" / "0001.exr", pixels)
    return tmp_path / "shot"


def _denoise(source: Path, out: Path, *options: str) -> np.ndarray:
    main.main(["denoise", str(source), "-o", str(out), "--no-safe", *options])
    (file,) = out.glob("*.exr")
    channels = read_exr(file)
    return next(values for name, values in sorted(channels.items()) if name.endswith(("Combined.R", "denoised.R")))


@pytest.mark.slow
def test_frames_of_other_renderers_are_denoised_by_what_is_best_there(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    require("pyoidn")
    chosen = _denoise(shot, tmp_path / "chosen")
    assert f"method: {BEST_ELSEWHERE} (" in capsys.readouterr().out
    np.testing.assert_array_equal(chosen, _denoise(shot, tmp_path / "named", "--method", BEST_ELSEWHERE))


@pytest.mark.slow
def test_without_its_package_our_own_is_used_and_the_package_named(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    find_spec = importlib.util.find_spec

    def without(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name == "pyoidn" else find_spec(name, package)

    monkeypatch.setattr(importlib.util, "find_spec", without)
    chosen = _denoise(shot, tmp_path / "chosen")
    said = capsys.readouterr().out
    assert f"method: {DEFAULT_MODEL} (" in said
    assert "pip install pyoidn" in said
    np.testing.assert_array_equal(chosen, _denoise(shot, tmp_path / "named", "--method", DEFAULT_MODEL))


@pytest.mark.slow
def test_our_own_clips_are_for_our_own_method(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    light = np.random.default_rng(1).random((1, 32, 32, 3), np.float32)
    write_clip(Clip(Frame(light)), tmp_path / "clip", record={"pixel_filter": "centre"})
    _denoise(tmp_path / "clip", tmp_path / "own")
    assert f"method: {DEFAULT_MODEL} (" in capsys.readouterr().out


def test_a_backend_that_is_named_does_not_choose_another_method(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    require("pyoidn")
    options = Denoise([shot], tmp_path / "out", implementation="reference")
    assert _choose_method(options, of_scene=False).method == BEST_ELSEWHERE
    assert f"method: {BEST_ELSEWHERE} (" in capsys.readouterr().out


@pytest.mark.slow
def test_our_clips_with_filtered_pixels_are_as_other_renderers_frames(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    require("pyoidn")
    light = np.random.default_rng(1).random((1, 32, 32, 3), np.float32)
    write_clip(Clip(Frame(light)), tmp_path / "clip", record={"pixel_filter": "box"})
    _denoise(tmp_path / "clip", tmp_path / "own")
    assert f"method: {BEST_ELSEWHERE} (" in capsys.readouterr().out


@pytest.mark.slow
def test_a_method_that_is_named_is_not_explained(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _denoise(shot, tmp_path / "out", "--method", "svgf")
    assert "method:" not in capsys.readouterr().out
