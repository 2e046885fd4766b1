"""``jaxdn doctor --warm`` leaves programs that `jaxdn denoise` finds."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from jaxdn.clips import write_exr

SIZE = ["--width", "64", "--height", "48"]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    usual = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment = {**usual, "JAXDN_CACHE_DIR": str(folder)}
    command = [sys.executable, "-m", "jaxdn.commands.main", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def steps(folder: Path) -> list[str]:
    """The kept programs of a denoiser's step and of the safe blend, by their keys."""
    found = [file.name for file in folder.glob("programs-*/*") if file.name.endswith("-cache")]
    return sorted(name for name in found if name.startswith(("jit__step", "jit__start", "jit_combine")))


def test_denoise_finds_what_doctor_compiled(tmp_path: Path) -> None:
    """Of files of that size with those passes."""
    warmed = run(tmp_path / "kept", "doctor", "--warm", "--method", "taa", *SIZE)
    assert warmed.returncode == 0, warmed.stderr
    assert "taa is compiled for 64 x 48" in warmed.stdout
    kept = steps(tmp_path / "kept")
    assert {name.rpartition("-")[0].rpartition("-")[0] for name in kept} == {"jit__start", "jit__step", "jit_combine"}
    rng = np.random.default_rng(0)
    channels = {"Combined": "RGB", "Denoising Albedo": "RGB", "Denoising Normal": "XYZ", "Depth": "Z", "Vector": "XYZW"}
    names = [f"ViewLayer.{name}.{letter}" for name, letters in channels.items() for letter in letters]
    write_exr(tmp_path / "a.0001.exr", {name: rng.uniform(0.1, 1, (48, 64)).astype(np.float32) for name in names})
    done = run(
        tmp_path / "kept", "denoise", str(tmp_path / "a.0001.exr"), "-o", str(tmp_path / "out"), "--method", "taa"
    )
    assert done.returncode == 0, done.stderr
    assert steps(tmp_path / "kept") == kept


def test_what_cannot_be_compiled_is_told(tmp_path: Path) -> None:
    for arguments, message in (
        (["--width", "0"], "--width, --height: expected at least 1 pixel, got 0 x 1080"),
        (["--method", "nothing"], "method 'nothing': expected one of"),
    ):
        done = run(tmp_path, "doctor", "--warm", *arguments)
        assert done.returncode == 2
        assert message in " ".join(done.stderr.split())
        assert "Traceback" not in done.stderr
