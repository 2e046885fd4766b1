"""The command line: messages instead of tracebacks, exit code 2, complete files.

Every kind of run is in a real process once; what is told about wrong arguments, which are many, is not: a process needs
seconds to begin.
"""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from importlib.util import find_spec

import numpy as np
import OpenEXR
import pytest
from safetensors.numpy import load_file

from jaxdn import __version__
from jaxdn.clips import write_clip
from jaxdn.commands import main
from jaxdn.core.frame import Clip, Frame
from jaxdn.methods.ntd import Options
from jaxdn.methods.registry import methods
from jaxdn.zoo.ready import all_names
from jaxdn.zoo.weights import shipped_names
from tests.training.test_training import make_clip


def jaxdn(*arguments, timeout=300):
    return subprocess.run(
        [sys.executable, "-m", "jaxdn.commands.main", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def run_here(*arguments):
    """The same in this process; SystemExit, with the message on stderr, where it fails."""
    main.main([*map(str, arguments)])


def fails(*arguments):
    """Run a command with a user error; returns its message."""
    done = jaxdn(*arguments)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    return " ".join((done.stdout + done.stderr).split())


def told_here(capsys, *arguments):
    """The same in this process, which an error that the command does not catch would leave."""
    with pytest.raises(SystemExit) as ended:
        main.main([*map(str, arguments)])
    shown = capsys.readouterr()
    assert ended.value.code == 2, shown.err
    assert "Traceback" not in shown.out + shown.err
    return " ".join((shown.out + shown.err).split())


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips") / "square"
    source = make_clip(0, frames=3, size=20)
    frames = source.frames._replace(
        direct=np.full_like(source.reference, 0.25), emission=np.full_like(source.reference, 0.5)
    )
    write_clip(Clip(frames, source.reference), folder)
    return folder


def write_shot(file, pixels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, pixels).write(str(file))


@pytest.fixture(scope="module")
def shot(tmp_path_factory):
    """EXR files of another renderer: noise on a checkered wall, whose colours are in a layer with an unknown name."""
    folder, rng = tmp_path_factory.mktemp("shots"), np.random.default_rng(0)
    checks = np.where(np.indices((24, 32)).sum(axis=0) // 3 % 2 == 0, 0.9, 0.1).astype(np.float32)
    for index in range(2):
        pixels = {letter: (checks * rng.exponential(size=checks.shape)).astype(np.float32) for letter in "RGB"}
        pixels |= {f"Paint.{letter}": checks for letter in "RGB"}
        write_shot(folder / f"shot_{index:04d}.exr", pixels)
    return folder


def test_help_of_the_program():
    done = jaxdn("--help")
    assert done.returncode == 0
    assert "jaxdn" in done.stdout


@pytest.mark.parametrize("verb", ["inspect", "render", "train", "denoise", "compare"])
def test_help_shows_examples(verb, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main([verb, "--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert "jaxdn" in shown
    assert "For example" in shown


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_denoise_adds_direct_and_emitted_light_back(clip, tmp_path):
    done = jaxdn("denoise", clip, "-o", tmp_path / "out", "--method", "taa", "--preview")
    assert done.returncode == 0, done.stderr
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"frame_{i:04d}.{kind}" for i in range(3) for kind in ("exr", "png")]
    with OpenEXR.File(str(tmp_path / "out" / "frame_0001.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    for letter in "RGB":
        np.testing.assert_allclose(channels[letter] - channels[f"denoised.{letter}"], 0.75, atol=1e-5)


@pytest.mark.slow
def test_one_frame_becomes_the_file_that_is_named(shot, tmp_path, capsys):
    one, out = shot / "shot_0000.exr", tmp_path / "new" / "clean.exr"
    (tmp_path / "folder.exr").mkdir()
    main.main(["denoise", str(one), "-o", str(out), "--method", "svgf", "--preview"])
    assert sorted(path.name for path in out.parent.iterdir()) == ["clean.exr", "clean.png"]
    assert out.is_file()
    for source, place, words in (
        (shot, tmp_path / "x.exr", "expected a folder for 2 frames"),
        (one, one, "expected another place than the input's"),
        (one, tmp_path / "folder.exr", "expected the name of an EXR file, but there is a folder of that name"),
    ):
        with pytest.raises(SystemExit) as ended:
            main.main(["denoise", str(source), "-o", str(place), "--method", "svgf"])
        assert ended.value.code == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "x.exr").exists()


@pytest.mark.parametrize(
    "options",
    [
        ["--channels", "albedo=Paint"],
        ["--layer", "Room"],
        ["--motion-convention", "uv"],
        ["--aovs", "additive"],
        ["--only-beauty"],
    ],
)
def test_a_clip_of_ours_refuses_what_is_for_files_of_others(clip, tmp_path, capsys, options):
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", str(clip), "-o", str(tmp_path / "out"), "--method", "noisy", *options])
    assert ended.value.code == 2
    shown = capsys.readouterr()
    assert f"{options[0]}: expected files of other renderers, got {clip}, a clip of jaxdn's own" in shown.err
    assert "what is read" not in shown.out
    assert not (tmp_path / "out").exists()


def test_the_help_names_the_shipped_weights(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit):
        main.main(["denoise", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())  # however its lines are broken
    assert f"Shipped weights ({', '.join(shipped_names())})" in text
    assert "unknown name lists all" in text.partition("--method STR")[2].partition("--bidirectional")[0]


def test_short_and_small_clips_name_the_options_that_fit_them(clip, tmp_path, capsys):
    for options, advice in (([], "--frames 3"), (["--frames", "3"], "--crop 20")):
        with pytest.raises(SystemExit):
            main.main(["train", str(clip), "-o", str(tmp_path / "run"), *options])
        assert f"({advice})" in capsys.readouterr().err
        assert advice.split()[0][2:] in main.Train.__dataclass_fields__


@pytest.mark.slow
def test_denoise_plain_exr_files_with_the_shipped_network(tmp_path, capsys):
    rng = np.random.default_rng(0)
    for index in range(2):
        pixels = {letter: rng.exponential(size=(33, 57)).astype(np.float32) for letter in "RGB"}
        pixels["R"][3, 4], pixels["G"][5, 6], pixels["B"][7, 8] = np.nan, np.inf, -3.0
        write_shot(tmp_path / f"shot_{index:04d}.exr", pixels)
    backends = ["reference", *(["onnxruntime"] if find_spec("onnxruntime") else [])]
    reds = []
    for backend in backends:
        out = tmp_path / backend
        command = ["denoise", tmp_path / "shot_*.exr", "-o", out, "--method", "ntd-small", "--implementation", backend]
        if backend == "reference":
            done = jaxdn(*command)
            assert done.returncode == 0, done.stderr
            said = done.stdout
        else:  # here, as a process takes longer to begin than to do this
            run_here(*command)
            said = capsys.readouterr().out
        assert f"({backend}, 1 program compiled)" in said
        assert "4 values sanitized: not usable numbers" in said  # negative light is usable: it comes back
        with OpenEXR.File(str(out / "shot_0001.exr"), separate_channels=True) as file:
            reds.append(file.channels()["R"].pixels)
    assert reds[0].shape == (33, 57)
    assert np.isfinite(reds[0]).all()
    assert reds[0].std() < 0.7  # exponential noise has a standard deviation of 1
    np.testing.assert_allclose(reds[0], reds[-1], rtol=2e-3, atol=2e-3)  # stored in half precision


@pytest.mark.slow
def test_a_layer_named_on_the_command_line_is_the_buffer(shot, tmp_path):
    """Divided by its colours the wall is uniform, and its checks are not blurred; without the layer they would be."""
    checks = np.where(np.indices((24, 32)).sum(axis=0) // 3 % 2 == 0, 0.9, 0.1)
    errors = []
    for name, options in (("without", ()), ("with", ("--channels", "albedo=Paint"))):
        main.main(["denoise", str(shot), "-o", str(tmp_path / name), "--method", "svgf", *options])
        with OpenEXR.File(str(tmp_path / name / "shot_0001.exr"), separate_channels=True) as file:
            errors.append(np.abs(file.channels()["G"].pixels - checks).mean())
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_train_denoise_and_compare_with_new_weights(tmp_path, capsys):
    write_clip(make_clip(0, frames=10, size=20), tmp_path / "clips" / "square")
    few = ("--steps", "2", "--batch", "1", "--crop", "16")
    options = (
        "--variant",
        "ntd-small",
        "--set",
        "size=[[4], [4], [4], [4], [4]]",
        "motion=traditional",
        "kernels=plain",
    )
    recipe = ("--recipe", "paper-loss-without-occlusion")
    train = ("train", tmp_path / "clips", "-o", tmp_path / "mine", *options, *recipe, *few)
    done = jaxdn(*train)
    assert done.returncode == 0, done.stderr
    weights = tmp_path / "mine" / "weights.safetensors"
    assert str(weights) in done.stdout
    kept = json.loads(weights.with_suffix(".json").read_text())
    assert kept["factory"] == "ntd"
    # With all defaults: they may be others in a later version.
    assert kept["options"] == {**asdict(Options()), "size": [[4]] * 5, "motion": "traditional", "kernels": "plain"}
    assert kept["recipe"]["objective"] == "indirect illumination without occlusion"
    assert kept["recipe"]["steps"] == 2
    # From here on in this process, which has imported what they need: other tests start one for each of these verbs.
    run_here(*train)
    assert "all 2 steps are there already" in capsys.readouterr().out
    more = ["--start", weights, "--set", *options[3:], "guides=materials", "--learning-rate", "1e-9", *few]
    run_here("train", tmp_path / "clips", "-o", tmp_path / "more", "--variant", "ntd-small", *more)
    started, grown = (load_file(tmp_path / run / "weights.safetensors") for run in ("mine", "more"))
    for name, before in started.items():
        after = grown[name][:, :, : before.shape[2]] if before.ndim == 4 else grown[name]
        np.testing.assert_allclose(after, before, atol=1e-8)
    run_here("denoise", tmp_path / "clips" / "square", "-o", tmp_path / "out", "--method", weights)
    assert len(list((tmp_path / "out").glob("*.exr"))) == 10
    run_here("compare", tmp_path / "clips", "-o", tmp_path / "report", "--methods", "noisy", weights)
    assert "mine" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_compare_ends_with_a_report(clip, tmp_path):
    done = jaxdn("compare", clip, "-o", tmp_path, "--methods", "noisy", "svgf")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report.html").is_file()
    assert (tmp_path / "metrics.json").is_file()
    assert "svgf" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("denoise", "nowhere", "-o", "out"), "nowhere"),
        (
            ("denoise", "CLIP", "-o", "out", "--method", "magic"),
            f"expected one of {', '.join(all_names())}",
        ),
        (("denoise", "CLIP", "-o", "out", "--method", "ntd"), "expected its weights"),
        (("denoise", "CLIP", "-o", "CLIP", "--method", "svgf"), "another place"),
        (("denoise", "CLIP", "-o", "out", "--method", "svgf", "--spp", "2"), "2 samples a pixel are not available"),
        (("denoise", "CLIP", "-o", "out", "--wrong"), "--wrong"),
        (
            ("denoise", "CLIP", "-o", "out", "--method", "svgf", "--implementation", "onnxruntime"),
            "has no choice, got 'onnxruntime'",
        ),
        (
            ("denoise", "CLIP", "-o", "out", "--method", "svgf", "--budget", "4"),
            "--budget: expected a method that says where",
        ),
        (
            ("denoise", "CLIP", "-o", "out", "--method", "svgf", "--max-memory", "nan"),
            "--max-memory: expected more than 0",
        ),
        (("denoise", "CLIP", "-o", "out", "--method", "svgf", "--max-memory", "0"), "expected more than 0 GiB, got 0"),
        (
            ("denoise", "CLIP", "-o", "out", "--method", "svgf", "--frames"),
            "--frames: expected whole numbers or ranges",
        ),
        (("denoise", "CLIP", "SHOT", "-o", "out", "--channels", "albedo=none"), "or denoise the clip by itself"),
        (("denoise", "CLIPS", "-o", "out", "--method", "svgf"), "square: name such folders"),
        (("denoise", "SHOT", "-o", "out", "--channels", "albedo=Paint", "albedo=none"), "expected albedo once"),
        (("denoise", "SHOT", "-o", "out", "--reblur", "shutter=0.5", "shutter=0.1"), "--reblur: expected shutter once"),
        (("compare", "CLIP", "-o", "out", "--methods"), "--methods: expected at least one, got none"),
        (("inspect",), "expected a scene, a family, a clip, or EXR files to inspect, got none"),
        (("inspect", "SHOT", "--width", "3"), "expected none of --width"),
        (("inspect", "CLIP", "--height", "3"), "expected none of --height"),
        (("pack", "CLIP", "-o", "CLIP", "--mib", "1"), "expected another place than the clips'"),
        (("pack", "CLIP", "-o", "RECORD", "--mib", "1"), "expected another place than the clips'"),
        (("pack", "CLIP", "-o", ".", "--mib", "1"), "expected the name of a file, got a folder"),
        (("pack", "CLIP", "-o", "out", "--mib", "1", "--seed", "-1"), "--seed: expected a whole number >= 0, got -1"),
        (("render", "fruit", "-o", "out", "--seeds"), "--seeds: expected whole numbers >= 0 or ranges"),
        (("render", "fruit", "-o", "out", "--seeds", "1", "0-1"), "--seeds: expected each seed once, got 1 again"),
        (("render", "fruit", "-o", "out", "--threads-per-clip", "1"), "--threads-per-clip: expected at least 2"),
        (("train", "CLIP", "-o", "out", "--set", "size=small", "size=large"), "--set: expected size once"),
        (("compare", "nowhere", "-o", "out", "--methods", "noisy"), "nowhere: there is no such folder"),
        (("compare", ".", "-o", "out", "--methods", "noisy"), "expected a clip (a folder with clip.json)"),
        (("compare", "CLIP", "-o", "out", "--methods", "noisy", "magic"), "expected one of noisy, "),
        (("denoise", "SHOT", "-o", "out", "--method", "svgf", "--channels", "radiance"), "expected name=value"),
        (
            ("denoise", "SHOT", "-o", "out", "--method", "svgf", "--channels", "light=R"),
            "expected buffers among radiance",
        ),
        (
            ("denoise", "SHOT", "-o", "out", "--method", "svgf", "--channels", "albedo=Dyes"),
            "no albedo in layer 'Dyes'",
        ),
        (("denoise", "SHOT", "-o", "out", "--method", "svgf", "--motion-convention", "maya"), "got 'maya'"),
        (("denoise", "SHOT", "-o", "out", "--method", "svgf", "--spp", "2"), "expected spp 1, got 2"),
        (("render", "castle", "-o", "out"), "fruit"),
        (("render", "none.xml", "-o", "out"), "none.xml"),
        (("train", "CLIP", "-o", "out", "--steps", "1"), "expected at least 10 frames, got 3"),
        (("train", "CLIP", "-o", "out", "--method", "magic"), f"expected one of {', '.join(methods())}"),
        (("train", "CLIP", "-o", "out", "--method", "taa"), "expected a method that learns"),
        (("train", "CLIP", "-o", "out", "--variant", "ntd-huge"), "expected a variant out of ntd-large, ntd-small"),
        (
            ("train", "CLIP", "-o", "out", "--recipe", "wild"),
            "paper-loss-without-occlusion, paper, paper-without-occlusion, got 'wild'",
        ),
        (("train", "CLIP", "-o", "out", "--set", "motoin=dual"), "expected options out of size, motion,"),
        (("train", "CLIP", "-o", "out", "--set", "motion=wild"), "motion: expected one of 'dual', 'traditional'"),
        (("train", "CLIP", "-o", "out", "--set", "motion"), "--set 'motion': expected name=value"),
    ],
)
def test_user_errors_give_plain_messages(clip, shot, tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    places = {"CLIP": clip, "SHOT": shot, "CLIPS": clip.parent, "RECORD": clip / "clip.json"}
    before = sorted(path.name for path in clip.iterdir())
    assert told in told_here(capsys, *(places.get(word, word) for word in arguments))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]  # no incomplete file, hidden or not
    assert sorted(path.name for path in clip.iterdir()) == before


def test_wrong_arguments_end_a_process_with_a_message(clip, tmp_path):
    assert f"expected one of {', '.join(all_names())}" in fails("denoise", clip, "-o", tmp_path, "--method", "magic")


@pytest.mark.slow
def test_a_truncated_frame_names_the_file(clip, tmp_path, capsys):
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    for path in clip.iterdir():
        (damaged / path.name).write_bytes(path.read_bytes())
    frame = damaged / "frame_0001.exr"
    frame.write_bytes(frame.read_bytes()[:2000])
    assert "frame_0001.exr" in told_here(capsys, "denoise", damaged, "-o", tmp_path / "out", "--method", "svgf")
    assert not (tmp_path / "out" / "frame_0001.exr").exists()


def test_sizes_that_differ_are_refused(clip, tmp_path, capsys):
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for path in clip.iterdir():
        (mixed / path.name).write_bytes(path.read_bytes())
    small = make_clip(1, frames=1, size=16)
    write_clip(Clip(Frame(radiance=small.frames.radiance)), tmp_path / "small")
    (mixed / "frame_0002.exr").write_bytes((tmp_path / "small" / "frame_0000.exr").read_bytes())
    assert "frame_0002.exr" in told_here(capsys, "denoise", mixed, "-o", tmp_path / "out", "--method", "svgf")


def test_the_package_runs_as_the_command():
    done = subprocess.run([sys.executable, "-m", "jaxdn", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, f"jaxdn {__version__}\n"), done.stderr


def test_the_compilers_alarm_is_silenced_before_jax_reads_the_setting():
    # The alarm itself comes after two minutes of compiling.
    lines = "import os, sys; from jaxdn.commands import main; main.main(['--version'])"
    code = f"{lines}; print('jax' in sys.modules, os.environ['TF_CPP_MIN_LOG_LEVEL'])"
    environment = {name: value for name, value in os.environ.items() if name != "TF_CPP_MIN_LOG_LEVEL"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.stdout.splitlines()[1:] == ["False 3"], done.stderr
