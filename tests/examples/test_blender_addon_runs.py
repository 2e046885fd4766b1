"""The Blender add-on in the real Blender: installed from its zip, on frames of Cycles, with the real jaxdn."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from examples.blender import build
from examples.blender.jaxdn_denoise import passes
from experiments.cycles.reference import read_channels

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With spaces and an umlaut, as users have them."""
    folder = tmp_path_factory.mktemp("add-on") / "Ein Märchen"
    folder.mkdir()
    return folder


@pytest.fixture(scope="module")
def told(blender, folder):
    """What the script saw inside of Blender."""
    archive = build.build(folder)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "BLENDER_USER_RESOURCES": str(folder / "user")}
    script = Path(__file__).with_name("in_blender.py")
    done = subprocess.run(
        [blender, script, archive, sys.executable, folder],
        env=environment, capture_output=True, text=True, encoding="utf-8", check=False,
    )  # fmt: skip
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def _beauty(path):
    channels, _ = read_channels(path)
    name = next((name for name in channels if name.endswith("Combined.R")), "R")
    return np.stack([channels[f"{name[:-1]}{letter}"] for letter in "RGB"], -1)


def test_blenders_own_checker_takes_the_zip(blender, tmp_path):
    code = "import bpy, pathlib; print(pathlib.Path(bpy.utils.system_resource('SCRIPTS')))"
    scripts = subprocess.run([blender, "-c", code], capture_output=True, text=True, check=True).stdout.split("\n")[0]
    checker = Path(scripts) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    done = subprocess.run([blender, checker, "validate", build.build(tmp_path)], capture_output=True, check=False)
    assert done.returncode == 0, done.stdout


def test_the_button_sets_everything(told):
    paths = {setting.path for setting in (*passes.SCENE, *passes.LAYER)}
    assert set(told["unset"]) <= paths
    assert {"render.engine", "use_pass_vector", "render.image_settings.file_format"} <= set(told["unset"])
    assert told["unset after"] == []


def test_what_is_missing_is_said_before_anything_runs(told):
    assert "which is not saved yet; save it first" in told["not saved"]
    assert "found none; render the animation first" in told["not rendered"]
    assert "expected another folder" in told["same folder"]


def test_failures_of_the_process_are_shown(told):
    assert Path(told["blender's own python"]).name.startswith("python")
    assert "This Python has no " in told["no jaxdn"]
    assert "press Install" in told["no jaxdn"]
    assert "nothing like it" in told["unknown method"]
    assert "Traceback" not in told["unknown method"]
    assert any("nothing like it" in row for row in told["panel with an error"])


def test_the_panel_shows_steps_and_progress(told):
    assert sum(row.startswith("label") for row in told["panel before"]) == len(told["unset"])
    assert "operator jaxdn.set_passes" in told["panel before"]
    assert any(row.startswith("progress") for row in told["panel while it runs"])
    assert "operator jaxdn.cancel" in told["panel while it runs"]
    assert told["shares"][0] == 0
    assert told["shares"][-1] == 1
    assert told["error"] == ""
    assert told["message"].startswith("3 of 3 frames in ")
    assert not any(row.startswith("progress") for row in told["panel after"])
    assert "cancelled" in told["cancelled"]


def test_the_compositor_and_the_sequencer_show_the_denoised_frame(told, folder):
    assert told["links"] == [["jaxdn", "Combined", "GROUP_OUTPUT"]]
    noisy, denoised = (_beauty(folder / name / "shot_0006.exr") for name in ("noisy", "denoised"))
    neighbour = _beauty(folder / "denoised" / "shot_0005.exr")
    assert np.abs(denoised - noisy).max() > 0.01
    assert np.abs(denoised - neighbour).max() > 0.01
    np.testing.assert_array_equal(_beauty(folder / "composited.exr"), denoised)
    np.testing.assert_allclose(_beauty(folder / "sequenced.exr"), denoised, rtol=2e-3, atol=2e-3)  # through half floats


def test_a_second_time_takes_the_same_node_and_strip(told):
    assert told["nodes"] == ["BLUR", "GROUP_OUTPUT", "IMAGE", "R_LAYERS"]
    assert told["links again"] == [["BLUR", "GROUP_OUTPUT"], ["IMAGE", "BLUR"]]
    assert told["strips"] == [["jaxdn", 5, 8]]


def test_nothing_is_left_when_it_is_switched_off(told):
    assert told["left behind"] is False
