"""The parts of the Blender add-on that know nothing of Blender: commands, progress, files, processes, the zip."""

import json
import os
import re
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest
import tyro

import jaxdn
from examples.blender import build
from examples.blender.jaxdn_denoise import passes
from examples.blender.jaxdn_denoise.background import Background
from examples.blender.jaxdn_denoise.command import (
    denoise_command,
    explain_failure,
    install_commands,
    python_of,
    read_progress,
)
from examples.blender.jaxdn_denoise.frames import find_rendered, find_results, without_gaps
from jaxdn.commands.arguments import COMMANDS
from jaxdn.commands.progress import reporter
from jaxdn.core.options import numbers
from jaxdn.data.foreign.shots import find_shots


def test_the_command_line_is_one_that_jaxdn_reads(tmp_path):
    words = denoise_command(
        "python", tmp_path / "a_####.exr", tmp_path / "out", [3, 1, 2, 7], method="svgf", safe=False, layer="Room 2"
    )
    assert words[:5] == ["python", "-u", "-m", "jaxdn.commands.main", "denoise"]
    read = tyro.cli(COMMANDS, args=words[4:])
    assert read.clips == [tmp_path / "a_####.exr"]
    assert (read.out, read.method, read.safe, read.bidirectional, read.layer) == (
        tmp_path / "out", "svgf", False, False, "Room 2",
    )  # fmt: skip
    assert numbers(read.frames, "--frames") == [1, 2, 3, 7]
    usual = tyro.cli(COMMANDS, args=denoise_command("p", Path("a.exr"), Path("o"), [-2, 1], bidirectional=True)[4:])
    assert (usual.method, usual.safe, usual.bidirectional, usual.frames) == ("auto", True, True, None)


def test_progress_is_read_from_what_jaxdn_prints(capsys):
    with reporter("svgf") as report:
        for done in (1, 2, 4):
            report.on_frame(Path(f"out/frame {done}.exr"), done, 4)
        report.log("frame 3 of another kind")
    shares = [read_progress(line) for line in capsys.readouterr().out.splitlines()]
    assert [share for share in shares if share is not None] == [0.25, 0.5, 1.0]
    assert (read_progress("Progress: 40%"), read_progress("  Progress: 12.5 % done")) == (0.4, 0.125)
    assert read_progress("no Progress: 40%") is None


def test_a_failure_is_told_in_jaxdns_words():
    lines = ["frame 1 of 2: a.exr, 1 s", "jaxdn: a.exr: expected frames, got", "none.", ""]
    assert explain_failure(2, lines) == "a.exr: expected frames, got none."
    lacking = explain_failure(1, ["ModuleNotFoundError: No module named 'tyro'"])
    assert lacking.startswith("This Python has no tyro, which jaxdn needs. Name another")
    assert explain_failure(3, ["one", "two", ""]) == "two (exit code 3)"
    assert explain_failure(-9, []) == "It printed nothing. (exit code -9)"


def test_a_python_without_jaxdn_is_named_as_that():
    command = [sys.executable, "-I", "-S", "-m", "jaxdn.commands.main"]  # without site-packages
    run = Background([command])
    run.wait()
    lines, code = run.poll()
    assert code == 1
    assert explain_failure(code, lines).startswith("This Python has no jaxdn.")


def _rendered(folder, frames, name="a_{:04d}.exr"):
    for frame in frames:
        (folder / name.format(frame)).write_bytes(b"")
    return find_rendered(lambda frame: str(folder / name.format(frame)), range(1, 9))


@pytest.mark.parametrize("name", ["a_{:04d}.exr", "{:04d}.exr", "v2 shot.{:02d}.exr"])
def test_the_pattern_finds_the_frames(tmp_path, name):
    (tmp_path / "other_0001.exr").write_bytes(b"")
    found = _rendered(tmp_path, (2, 3, 5), name)
    assert list(found.files) == [2, 3, 5]
    (shot,) = find_shots(found.pattern)
    assert shot.numbers == (2, 3, 5)
    assert shot.files == tuple(found.files.values())


def test_files_that_cannot_be_denoised_are_told_apart(tmp_path):
    with pytest.raises(ValueError, match="found none; render the animation first"):
        _rendered(tmp_path, ())
    with pytest.raises(ValueError, match=r"a_11111\.png: expected OpenEXR MultiLayer files"):
        _rendered(tmp_path, (1,), "a_{:04d}.png")
    with pytest.raises(ValueError, match="put _ between them"):
        _rendered(tmp_path, (1,), "shot2{:04d}.exr")
    with pytest.raises(ValueError, match="number of the frame in the file's name alone"):
        find_rendered(lambda frame: f"/{frame}/still.exr", range(1, 3))


def test_results_are_found_and_gaps_are_filled(tmp_path):
    rendered = _rendered(tmp_path, (2, 3, 5))
    (tmp_path / "out").mkdir()
    for frame in (2, 5):
        (tmp_path / "out" / f"a_{frame:04d}.exr").write_bytes(b"")
    results = find_results(rendered, tmp_path / "out")
    assert list(results) == [2, 5]
    assert [path.name for path in without_gaps(results)] == ["a_0002.exr"] * 3 + ["a_0005.exr"]


def _scene(**more):
    """Attributes as a scene of Blender has them, of a new file."""
    output = SimpleNamespace(file_format="PNG", color_depth="8", **more)
    off = dict.fromkeys(("use_pass_z", "use_pass_vector", "use_pass_object_index"), False)
    layers = [SimpleNamespace(**off, use=use, cycles=SimpleNamespace(denoising_store_passes=False)) for use in (1, 0)]
    render = SimpleNamespace(engine="BLENDER_EEVEE", image_settings=output)
    render.use_motion_blur = render.use_compositing = render.use_sequencer = True
    cycles = SimpleNamespace(samples=64, use_adaptive_sampling=True, use_denoising=True, use_animated_seed=False)
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    return SimpleNamespace(render=render, cycles=cycles, view_layers=layers)


def test_the_passes_are_listed_and_set():
    scene = _scene()
    wanted = [setting for setting in (*passes.SCENE, *passes.LAYER) if not setting.optional]
    assert passes.unset(scene) == wanted
    passes.set_all(scene)
    assert passes.unset(scene) == []
    assert scene.cycles.samples == 64
    assert [layer.use_pass_vector for layer in scene.view_layers] == [True, False]  # the other is not rendered
    scene.render.use_motion_blur = True
    assert [setting.name for setting in passes.unset(scene)] == ["Motion Blur off"]
    newer = _scene(media_type="IMAGE")
    passes.set_all(newer)
    assert newer.render.image_settings.media_type == "MULTI_LAYER_IMAGE"


def test_lines_come_while_the_command_runs_and_the_next_one_follows():
    first = "import time; print('one'); time.sleep(1); print('two')"
    run = Background([[sys.executable, "-c", first], [sys.executable, "-c", "import sys; print('last'); sys.exit(3)"]])
    lines: list[str] = []
    while not lines:
        lines += run.poll()[0]
        time.sleep(0.02)
    assert lines == ["one"]  # through a pipe, and before the end
    assert run.poll()[1] is None
    run.wait()
    assert run.poll() == (["two", "last"], 3)
    failed = Background([[sys.executable, "-c", "raise SystemExit(4)"], [sys.executable, "-c", "print('never')"]])
    failed.wait()
    assert failed.poll() == ([], 4)


def test_a_command_is_cancelled_at_once():
    run = Background([[sys.executable, "-c", "import time; print('begun'); time.sleep(600)"], ["never"]])
    while not run.poll()[0]:
        time.sleep(0.02)
    run.cancel()
    run.wait(60)
    lines, code = run.poll()
    assert run.cancelled
    assert lines == []
    assert code not in (0, None)


def test_a_command_that_cannot_start_says_why(tmp_path):
    run = Background([[str(tmp_path / "no python")]])
    run.wait()
    (line,), code = run.poll()
    assert code == 127
    assert line.startswith(str(tmp_path / "no python"))


@pytest.mark.slow
def test_an_environment_is_made_and_a_wheel_installed(tmp_path):
    wheel = tmp_path / "thing-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("thing.py", "print('installed')\n")
        archive.writestr("thing-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n")
        archive.writestr("thing-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr("thing-1.0.dist-info/RECORD", "")
    environment = tmp_path / "an environment"
    run = Background(install_commands(sys.executable, environment, str(wheel)))
    run.wait()
    lines, code = run.poll()
    assert code == 0, lines
    done = subprocess.run([python_of(environment), "-c", "import thing"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "installed"


def test_the_zip_has_the_manifest_and_every_module(tmp_path):
    built = build.build(tmp_path / "a")
    assert built.name == f"jaxdn_denoise-{jaxdn.__version__}.zip"
    with zipfile.ZipFile(built) as archive:
        names = set(archive.namelist())
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert names == {path.name for path in build.SOURCE.iterdir() if path.is_file()}
    assert manifest["version"] == jaxdn.__version__
    assert manifest["id"] == build.SOURCE.name
    assert manifest["type"] == "add-on"
    done = subprocess.run([sys.executable, build.__file__, "-o", tmp_path / "b"], capture_output=True, check=True)
    assert Path(os.fsdecode(done.stdout).strip()).read_bytes() == built.read_bytes()


def test_the_panels_settings_are_those_of_the_script():
    """The tutorial's script for ``blender -b`` sets the same, and the number of samples besides."""
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "blender_passes.py").read_text("utf-8")
    found = dict(re.findall(r"^ *(?:scene\.|layer\.)([\w.]+) = ([^#\n]+?)(?:  #.*)?$", text, flags=re.M))
    found |= {f"render.image_settings.{k}": v for k, v in re.findall(r"^ *settings\.(\w+) = (\S+)$", text, flags=re.M)}
    values = {path: {"True": True, "False": False}.get(value) for path, value in found.items()}
    values = {path: json.loads(found[path]) if value is None else value for path, value in values.items()}
    assert values == {s.path: s.value for s in (*passes.SCENE, *passes.LAYER)} | {"cycles.samples": 4}
