"""Methods of other packages: one that is installed by pip has its name, one that is not has its address.

The package is a wheel that pip installs, without a network, into a folder of its own.
"""

import functools
import json
import os
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import jaxdn
from jaxdn.clips import read_exr, write_clip
from jaxdn.commands import main
from jaxdn.denoiser.tiles import GRID, stream_tiled
from jaxdn.methods import registry
from jaxdn.methods.registry import method_named, methods
from jaxdn.zoo.ready import find_model
from jaxdn.zoo.weights import describe
from tests.needs import require_module
from tests.training.test_training import make_clip

onnxruntime = require_module("onnxruntime")
FILTER = '''"""Half of the frame and half of the history along the vectors: a filter of three functions."""

from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp

from jaxdn import Denoiser, warp
from jaxdn.core.options import Range
from jaxdn.methods.registry import method


@dataclass(frozen=True)
class Options:
    keep: Annotated[float, Range(0, 1)] = 0.5


@method(Options, title="A filter from outside")
def half_and_half(options):
    """Half and half."""

    def start(params, frame):
        return {"history": frame.radiance}

    def step(params, state, frame):
        motion = jnp.zeros((*frame.radiance.shape[:2], 2)) if frame.motion is None else frame.motion
        image = options.keep * warp(state["history"], motion) + (1 - options.keep) * jnp.nan_to_num(frame.radiance)
        return {"history": image}, image

    return Denoiser(lambda key, frame: {}, start, step, frozenset({"motion"}), receptive_field=1)
'''
LEARNED = '''"""A learned gain."""

from dataclasses import dataclass

import jax.numpy as jnp

from jaxdn import Core, recurrent
from jaxdn.methods.registry import method
from jaxdn.recipes.objectives import Objective
from jaxdn.recipes.recipe import Recipe


@dataclass(frozen=True)
class Options:
    gain: float = 0.5


def last_frame(images, clip, progress):
    return jnp.mean(jnp.abs(images[-1] - clip.reference[-1]))


@method(Options, title="A learned gain", recipes={"usual": Recipe(Objective("last frame", last_frame), decay=False)})
def gain(options):
    """A gain."""

    def step(params, state, frame, first, statistics):
        return state, params["gain"] * frame.radiance, 0

    def init(key, frame):
        return {"gain": jnp.float32(options.gain)}

    return recurrent(Core(lambda params, frame: (), step, frozenset(), init))
'''
SHORT = ["--steps", "2", "--batch", "1", "--crop", "16", "--frames", "3"]


def write_wheel(folder: Path, *, entry_points: bool) -> Path:
    """A wheel of the package ``outsider``, as a build backend would write it."""
    info = "outsider-1.0.dist-info"
    files = {
        "outsider/__init__.py": "",
        "outsider/filters.py": FILTER,
        "outsider/learned.py": LEARNED,
        f"{info}/METADATA": "Metadata-Version: 2.1\nName: outsider\nVersion: 1.0\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    if entry_points:
        names = "half_and_half = outsider.filters:half_and_half\ngain = outsider.learned:gain\n"
        files[f"{info}/entry_points.txt"] = f"[{registry.ENTRY_POINTS}]\n{names}broken = outsider.missing:nothing\n"
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    wheel = folder / "outsider-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return wheel


@pytest.fixture(scope="module")
def sites(tmp_path_factory) -> Callable[..., Path]:
    """A function that gives the folder where pip has installed the package, with entry points or without."""

    @functools.cache
    def site(*, entry_points: bool) -> Path:
        folder = tmp_path_factory.mktemp("package")
        wheel = write_wheel(folder, entry_points=entry_points)
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target"]
        done = subprocess.run([*pip, str(folder / "site"), str(wheel)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return folder / "site"

    return site


@pytest.fixture
def install(sites, monkeypatch) -> Iterator:
    """A function that puts the installed package on the path for this test; returns the folder that it is in."""
    known = dict(registry._METHODS)

    def installed(*, entry_points: bool) -> Path:
        site = sites(entry_points=entry_points)
        monkeypatch.syspath_prepend(site)
        registry._entry_points.cache_clear()
        return site

    yield installed
    registry._METHODS.clear()
    registry._METHODS.update(known)
    registry._entry_points.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == "outsider"]:
        del sys.modules[name]


@pytest.fixture
def clips(tmp_path):
    for seed in range(2):
        write_clip(make_clip(seed), tmp_path / "clips" / f"clip-{seed}")
    return tmp_path / "clips"


def drive(clips: Path, out: Path, filter: str, learned: str) -> None:
    """Every command that takes a method, with a filter and with a learned one."""
    clip = str(clips / "clip-0")
    main.main(["denoise", clip, "-o", str(out / "filtered"), "--method", filter, "--no-safe"])
    found = read_exr(out / "filtered" / "frame_0001.exr")["denoised.G"]
    light = np.nan_to_num(jaxdn.read_clip(clips / "clip-0").frames.radiance)
    # Nothing moves; the history of the first frame is the frame.
    np.testing.assert_allclose(found, (0.5 * (light[0] + light[1]))[..., 1], rtol=1e-3, atol=1e-3)

    main.main(["train", str(clips), "-o", str(out / "run"), "--method", learned, "--set", "gain=0.25", *SHORT])
    weights = out / "run" / "weights.safetensors"
    assert describe(weights)["factory"] == learned
    assert describe(weights)["options"] == {"gain": 0.25}
    _, params = jaxdn.load_weights(weights)
    assert np.asarray(params["gain"]) != 0.25
    main.main(["compare", str(clips), "-o", str(out / "report"), "--methods", "noisy", filter, str(weights)])
    scores = json.loads((out / "report" / "metrics.json").read_text())
    assert scores["methods"] == ["noisy", "half_and_half", "run"]

    main.main(["export", filter, "-o", str(out / "exported"), "--format", "onnx"])
    session = onnxruntime.InferenceSession(str(out / "exported" / "half_and_half.onnx"))
    frame = {"radiance": light[0], "motion": np.zeros((16, 16, 2), np.float32), "first": np.asarray(True)}
    state = {"state.history": np.zeros((16, 16, 3), np.float32)}
    outputs = dict(zip([each.name for each in session.get_outputs()], session.run(None, frame | state), strict=True))
    np.testing.assert_allclose(outputs["image"], light[0], rtol=1e-5)
    np.testing.assert_allclose(outputs["next.history"], light[0], rtol=1e-5)


@pytest.mark.slow
def test_an_installed_package_has_its_methods_by_name(install, clips, tmp_path):
    install(entry_points=True)
    with pytest.warns(UserWarning, match=r"method 'broken' \(outsider.missing:nothing\) cannot be imported"):
        assert {"half_and_half", "gain", "svgf"} <= set(methods())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert method_named("outsider.learned:gain").name == "gain"  # the address of what has a name
        drive(clips, tmp_path / "out", "half_and_half", "gain")


@pytest.mark.slow
def test_a_module_on_the_path_has_its_methods_by_address(install, clips, tmp_path):
    install(entry_points=False)
    assert "half_and_half" not in methods()
    drive(clips, tmp_path / "out", "outsider.filters:half_and_half", "outsider.learned:gain")


def test_its_frames_can_be_denoised_in_tiles(install):
    install(entry_points=False)
    model = find_model("outsider.filters:half_and_half")
    height, width = 24, 2 * (10 + GRID) + 8 * GRID + 5
    rng = np.random.default_rng(0)
    tiled = stream_tiled(model.denoiser, model.params, width - 3 * GRID, (height, width))
    whole = jaxdn.stream(model.denoiser, model.params)
    for _ in range(2):
        light = rng.exponential(size=(height, width, 3)).astype(np.float32)
        frame = jaxdn.Frame(light, motion=np.full((height, width, 2), 2.5, np.float32))
        np.testing.assert_allclose(tiled(frame), whole(frame), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_weights_name_the_address_and_another_process_reads_them(install, clips, tmp_path):
    """A real command, in a process that has never seen the package."""
    site = install(entry_points=False)
    run = tmp_path / "run"
    main.main(["train", str(clips), "-o", str(run), "--method", "outsider.learned:gain", *SHORT])
    command = [
        sys.executable,
        "-m",
        "jaxdn.commands.main",
        "denoise",
        str(clips / "clip-0"),
        "-o",
        str(tmp_path / "out"),
    ]
    command += ["--method", str(run / "weights.safetensors")]
    here = os.pathsep.join([str(Path(jaxdn.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])])
    for path, code in ((f"{site}{os.pathsep}{here}", 0), (here, 2)):
        environment = {**os.environ, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
        assert done.returncode == code, done.stderr
    assert "outsider.learned:gain" in done.stderr
    assert "put its folder on PYTHONPATH" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no.such.module:thing", r"expected a module that can be imported, got No module named 'no'"),
        (
            "jaxdn.methods.svgf:Options",
            r"a function of jaxdn.methods.svgf that .*method decorates, got <class",
        ),
        ("jaxdn.methods.svgf:nothing", r"decorates, got None"),
        (":svgf", r"decorates, got None"),
    ],
)
def test_an_address_without_a_method_says_what_is_wrong(name, message, tmp_path, capsys):
    with pytest.raises(ValueError, match=message):
        method_named(name)
    with pytest.raises(SystemExit) as stopped:
        main.main(["denoise", str(tmp_path), "-o", str(tmp_path / "out"), "--method", name])
    assert stopped.value.code == 2
    assert name in capsys.readouterr().err


def test_a_name_that_another_method_has_is_refused(install, tmp_path, monkeypatch):
    (tmp_path / "twin.py").write_text(FILTER.replace("half_and_half", "svgf"))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"method 'svgf' of twin: expected a name of its own; .*svgf has it"):
        method_named("twin:svgf")
    assert method_named("svgf").factory.__module__ == "jaxdn.methods.svgf"
