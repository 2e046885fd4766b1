"""``jaxdn doctor --warm`` leaves programs that `jaxdn denoise` finds."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxdn.clips import read_clip, write_exr
from jaxdn.commands import main
from jaxdn.commands.warm import draw_passes
from jaxdn.core.frame import present

SIZE = ["--width", "64", "--height", "48"]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Without the folder of programs that tests share."""
    kept = ("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")
    usual = {name: value for name, value in os.environ.items() if not name.startswith(kept)}
    environment = {**usual, "JAXDN_CACHE_DIR": str(folder)}
    command = [sys.executable, "-m", "jaxdn.commands.main", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def steps(folder: Path) -> list[str]:
    """The kept programs of a denoiser's step and of the safe blend, by their keys."""
    found = [file.name for file in folder.glob("programs-*/*") if file.name.endswith("-cache")]
    return sorted(name for name in found if name.startswith(("jit__step", "jit__start", "jit_combine")))


PASSES = {
    "Combined": "RGB",
    "Denoising Albedo": "RGB",
    "Denoising Normal": "XYZ",
    "Depth": "Z",
    "Vector": "XYZW",
    "IndexOB": "X",
}
"""Blender's, and their components."""


def write_frame(path: Path, *, numbered: bool) -> None:
    """A frame as Blender writes it, whose objects have numbers or have not."""
    rng = np.random.default_rng(0)
    channels = {
        f"ViewLayer.{name}.{letter}": rng.uniform(0.1, 1, (48, 64)).astype(np.float32)
        for name, letters in PASSES.items()
        for letter in letters
    }
    channels["ViewLayer.IndexOB.X"] = rng.integers(0, 3, (48, 64)).astype(np.float32) * numbered
    write_exr(path, channels)


@pytest.mark.parametrize("objects", [1, 2])
def test_no_pass_of_a_drawn_frame_counts_as_missing(tmp_path: Path, objects: int) -> None:
    """All of Blender's, but for the indices of objects that nobody has numbered."""
    write_exr(tmp_path / "a.exr", draw_passes(16, 24, objects, seed=0))
    frame = read_clip(tmp_path / "a.exr").frames
    passes = {"albedo", "normal", "depth", "motion", "dual_motion"} | ({"ids"} if objects > 1 else set())
    assert passes <= set(present(frame))
    assert "ids" in passes or frame.ids is None


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_denoise_finds_what_doctor_compiled(tmp_path: Path) -> None:
    """Of files of that size with Blender's passes, of a method that reads them, whether objects have numbers or not."""
    kept = tmp_path / "kept"
    warmed = run(kept, "doctor", "--warm", "--method", "svgf", *SIZE)
    assert warmed.returncode == 0, warmed.stderr
    assert "svgf is compiled for 64 x 48" in warmed.stdout
    programs = steps(kept)
    names = {name.rpartition("-")[0].rpartition("-")[0] for name in programs}
    assert names == {"jit__start", "jit__step", "jit_combine"}
    for name, numbered in (("plain", False), ("numbered", True)):
        write_frame(tmp_path / f"{name}.0001.exr", numbered=numbered)
        out = str(tmp_path / name)
        done = run(kept, "denoise", str(tmp_path / f"{name}.0001.exr"), "-o", out, "--method", "svgf")
        assert done.returncode == 0, done.stderr
        assert "counts as missing" not in done.stdout
        assert steps(kept) == programs, name


def test_what_cannot_be_compiled_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, message in (
        (["--width", "0"], "--width, --height: expected at least 1 pixel, got 0 x 1080"),
        (["--method", "nothing"], "method 'nothing': expected one of"),
    ):
        with pytest.raises(SystemExit) as ended:
            main.main(["doctor", "--warm", *arguments])
        assert ended.value.code == 2
        told = capsys.readouterr().err
        assert message in " ".join(told.split())
        assert "Traceback" not in told


def test_options_of_warm_alone_are_refused_without_it(capsys) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(["doctor", "--height", "1200"])
    assert ended.value.code == 2
    told = capsys.readouterr()
    assert "--height: expected --warm with it" in " ".join(told.err.split())
    assert told.out == ""
