"""Clips of Cycles, rendered by the real Blender at a few pixels: passes, noise, motion, runs that are killed.

Blender's package needs Python 3.11 and an environment of its own, ``.venv-cycles`` (the fixture ``blender``).
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from experiments.cycles.reference import read, read_channels
from experiments.cycles.sets import KINDS

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}

SMALL = """
import sys
from experiments.cycles import levels, sets, shot
sets.Clip.size = (32, 18)
sets.Clip.frames = 4
draws = levels.Draw(1, 2), levels.Draw(4)
first = levels.Draw(1, 2), levels.Draw(4, frames=3)
few = levels.Level(first, (2, 3), 30.0, 5.0), levels.Level(draws, (), 34.0, 20.0)
levels.LEVELS.update(test=few)
"""
"""Clips of 32x18 pixels and four frames, with two levels that take seconds."""


def _run(python: Path, code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    ended = subprocess.run(
        [python, "-c", SMALL + code, *arguments], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    return ended


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_renders_light_guides_and_motion(kind: str, blender: Path, tmp_path: Path) -> None:
    code = """
from pathlib import Path
of = sets.clip("test", sys.argv[1], 9000)
shot.build(of)
for name, seed in (("a", 1), ("b", 2)):
    shot.render(Path(sys.argv[2]) / name / "0002.exr", 2, 4, seed)
shot.render(Path(sys.argv[2]) / "a" / "0003.exr", 3, 4, 1)
sys.stdout.flush(); shot.os._exit(0)
"""
    _run(blender, code, kind, str(tmp_path))
    first, _ = read_channels(tmp_path / "a" / "0002.exr")
    other, _ = read_channels(tmp_path / "b" / "0002.exr")
    later, _ = read_channels(tmp_path / "a" / "0003.exr")
    passes = {name.rsplit(".", 1)[0].removeprefix("ViewLayer.") for name in first}
    wanted = {"Combined", "Depth", "Vector", "Object Index", "Denoising Albedo", "Denoising Normal", "Denoising Depth"}
    assert passes >= wanted
    light, light_b, light_later = (
        np.stack([file[f"ViewLayer.Combined.{c}"] for c in "RGB"], -1) for file in (first, other, later)
    )
    assert light.shape == (18, 32, 3)
    assert light.dtype == np.float32
    assert np.isfinite(light).all()
    assert 0.005 < np.median(light) < 3.0  # neither black nor blown out
    assert np.mean(light != light_b) > 0.3  # another seed, other noise (the sky has none)
    assert np.mean(light != light_later) > 0.3  # another frame, other noise
    albedo = np.stack([first[f"ViewLayer.Denoising Albedo.{c}"] for c in "RGB"], -1)
    assert np.std(albedo) > 0.01
    moved = np.mean([np.abs(first[f"ViewLayer.Vector.{c}"]).mean() for c in "XYZW"])
    if kind == "blur":
        assert moved == 0.0  # Blender writes no vectors with motion blur
    else:
        assert 0.001 < moved < 5.0


CLIP = "shot.render_clip(Path(sys.argv[1]), sets.clip('test', 'ball', 9000), int(sys.argv[2]))"


@pytest.mark.slow
def test_a_clip_is_refined_level_by_level(blender: Path, tmp_path: Path) -> None:
    code = f"from pathlib import Path\n{CLIP}\nsys.stdout.flush(); shot.os._exit(0)"
    folder = tmp_path / "ball"
    _run(blender, code, str(folder), "0")
    first = json.loads((folder / "cycles.json").read_text())
    assert set(first["references"]) == {"2", "3"}
    assert sorted(path.name for path in (folder / "1spp-1").iterdir()) == [f"{i:04d}.exr" for i in range(1, 5)]
    assert sorted(path.name for path in (folder / "4spp-0").iterdir()) == [f"{i:04d}.exr" for i in range(1, 4)]
    noisy = (folder / "4spp-0" / "0002.exr").stat().st_mtime_ns
    coarse = read(folder / "reference" / "0002.exr")
    _run(blender, code, str(folder), "1")
    second = json.loads((folder / "cycles.json").read_text())
    assert set(second["references"]) == {"1", "2", "3", "4"}
    assert sorted(path.name for path in (folder / "4spp-0").iterdir()) == [f"{i:04d}.exr" for i in range(1, 5)]
    assert second["reference_noise_db"] > max(first["reference_noise_db"], 33.0)
    assert (folder / "4spp-0" / "0002.exr").stat().st_mtime_ns == noisy  # kept, not rendered again
    fine = read(folder / "reference" / "0002.exr")
    assert fine.samples > coarse.samples
    assert fine.draws > coarse.draws


@pytest.mark.slow
def test_a_killed_run_leaves_whole_files_and_the_next_one_ends_the_clip(blender: Path, tmp_path: Path) -> None:
    code = f"from pathlib import Path\n{CLIP}\nsys.stdout.flush(); shot.os._exit(0)"
    folder = tmp_path / "ball"
    for wanted in (1, 6, 12):  # killed while noisy frames and references are written
        process = subprocess.Popen([blender, "-c", SMALL + code, str(folder), "0"], cwd=ROOT, env=ENVIRONMENT)
        while process.poll() is None and len(list(folder.glob("*/[0-9]*.exr"))) < wanted:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait()
        for path in folder.glob("*/[0-9]*.exr"):
            channels, _ = read_channels(path)
            assert all(values.shape == (18, 32) for values in channels.values())
    assert not (folder / "cycles.json").exists()
    _run(blender, code, str(folder), "0")
    assert json.loads((folder / "cycles.json").read_text())["level"] == 0
    names = [path.name for path in folder.rglob("*") if path.is_file() and path.parent != folder]
    assert len(names) == 2 * 4 + 3 + 2  # twice 1 sample, 4 samples of three frames, references of two
    assert not [name for name in names if name.startswith(".")]


@pytest.mark.slow
def test_a_clip_of_another_scene_version_is_not_continued(blender: Path, tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    folder.mkdir()
    (folder / "scene.sha256").write_text("0" * 64)
    code = f"from pathlib import Path\n{CLIP}"
    ended = subprocess.run(
        [blender, "-c", SMALL + code, str(folder), "0"],
        cwd=ROOT,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode != 0
    assert "another version of this scene" in ended.stderr
    assert [path.name for path in folder.iterdir()] == ["scene.sha256"]


def test_nothing_outside_imports_bpy() -> None:
    for path in (*ROOT.glob("jaxdn/**/*.py"), *ROOT.glob("experiments/**/*.py")):
        if "experiments/cycles" in str(path) or path.name == "blender_room.py":
            continue
        assert "import bpy" not in path.read_text(), path
    code = "import sys, experiments.cycles.__main__, experiments.cycles.reference; assert 'bpy' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=ENVIRONMENT, check=True)


@pytest.mark.slow
def test_a_window_is_that_part_of_the_picture(blender: Path, tmp_path: Path) -> None:
    code = """
from pathlib import Path
sets.WINDOW = (16, 8)
of = sets.clip("train", "textures", 3)
shot.build(of)
shot.render(Path(sys.argv[1]) / "part.exr", 2, 1, 1)
shot.bpy.context.scene.render.use_border = False
shot.render(Path(sys.argv[1]) / "whole.exr", 2, 1, 1)
print(*of.window, file=sys.stderr)
sys.stdout.flush(); shot.os._exit(0)
"""
    left, top, width, height = map(int, _run(blender, code, str(tmp_path)).stderr.split()[-4:])
    part, whole = (read_channels(tmp_path / f"{name}.exr")[0] for name in ("part", "whole"))
    # The first sample goes through the pixel's centre, whatever its noise.
    name = "ViewLayer.Depth.Z"
    np.testing.assert_allclose(part[name], whole[name][top : top + height, left : left + width], rtol=1e-5)
