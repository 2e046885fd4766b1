"""A new method is one new file, a new buffer one declaration: everything else finds them without further edits."""

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import jaxdn
from jaxdn.clips import read_exr, write_clip
from jaxdn.commands import main
from jaxdn.methods import registry
from jaxdn.zoo.weights import describe
from tests.hard_cases.cases import CASES
from tests.hard_cases.functions import list_denoisers
from tests.hard_cases.table import rows
from tests.training.test_training import make_clip

TOY_METHOD = '''"""Half of the frame, half of the history, times a learned gain: a toy."""

from dataclasses import dataclass
from typing import Annotated

import jax.numpy as jnp

from jaxdn.denoiser import Core, recurrent
from jaxdn.methods.registry import method
from jaxdn.recipes.objectives import Objective
from jaxdn.core.options import Range
from jaxdn.recipes.recipe import Recipe


@dataclass(frozen=True)
class Options:
    gain: Annotated[float, Range(0, 2)] = 1.0


def last_frame(images, clip, progress):
    return jnp.mean(jnp.abs(images[-1] - clip.reference[-1]))


@method(Options, title="A toy", recipes={"usual": Recipe(Objective("last frame", last_frame), decay=False)})
def toy(options):
    """A toy."""

    def init(key, frame):
        return {"gain": jnp.float32(options.gain)}

    def start(params, frame):
        return jnp.zeros_like(frame.radiance)

    def step(params, state, frame, first, statistics):
        image = params["gain"] * jnp.where(first, frame.radiance, 0.5 * (frame.radiance + state))
        return image, image, 0

    return recurrent(Core(start, step, frozenset(), init))
'''


@pytest.fixture
def toy(tmp_path: Path) -> Iterator[None]:
    """The toy method's file in a temporary folder, imported, which enters it in the table."""
    assert len(TOY_METHOD.splitlines()) <= 40
    path = tmp_path / "toy_method.py"
    path.write_text(TOY_METHOD)
    spec = importlib.util.spec_from_file_location("toy_method", path)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["toy_method"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield
    registry._METHODS.pop("toy")
    sys.modules.pop("toy_method")


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    """Two small clips."""
    for seed in range(2):
        write_clip(make_clip(seed), tmp_path / "clips" / f"clip-{seed}")
    return tmp_path / "clips"


@pytest.mark.slow
def test_a_new_method_is_trained_denoises_and_is_compared(toy, clips, tmp_path, capsys):
    run = tmp_path / "run"
    main.main(
        ["train", str(clips), "-o", str(run), "--method", "toy", "--set", "gain=0.5"]
        + ["--steps", "2", "--batch", "1", "--crop", "16", "--frames", "3"]
    )
    weights = run / "weights.safetensors"
    assert describe(weights)["options"] == {"gain": 0.5}
    assert describe(weights)["recipe"]["objective"] == "last frame"
    _, params = jaxdn.load_weights(weights)
    assert np.asarray(params["gain"]) != 0.5  # two updates moved it
    main.main(["denoise", str(clips / "clip-0"), "-o", str(tmp_path / "out"), "--method", str(weights), "--no-safe"])
    found = read_exr(tmp_path / "out" / "frame_0000.exr")
    noisy = jaxdn.read_clip(clips / "clip-0").frames.radiance[0]
    expected = float(params["gain"]) * np.where(np.isfinite(noisy), noisy, 0)
    np.testing.assert_allclose(found["denoised.R"], expected[..., 0], rtol=1e-3, atol=1e-6)
    main.main(["compare", str(clips), "-o", str(tmp_path / "report"), "--methods", "noisy", str(weights)])
    scores = json.loads((tmp_path / "report" / "metrics.json").read_text())
    assert scores["methods"] == ["noisy", "run"]
    capsys.readouterr()
    with pytest.raises(SystemExit) as stopped:
        main.main(["train", str(clips), "-o", str(tmp_path / "no"), "--method", "toy", "--set", "gains=1"])
    assert stopped.value.code == 2
    assert "gain" in capsys.readouterr().err


@pytest.mark.slow
def test_a_new_method_appears_in_the_hard_cases_and_the_chart(toy):
    function = next(function for function in list_denoisers() if function.name == "toy")
    cases = [CASES["radiance not a number"], CASES["every pixel off screen"]]
    table_rows = list(rows(cases, [function]))
    assert len(table_rows) == 8
    assert {row.verdict for row in table_rows} == {"green"}

    from experiments.speed.chart.ways import chosen, ways

    assert any(way.family == "toy" for way in ways(chosen()))


SCRIPT = """
import sys
import jax, numpy as np
import jaxdn
from jaxdn.clips import training_batches, write_clip
from jaxdn.commands import inspect
from jaxdn.core.frame import BUFFERS, Frame, present, written_out
from jaxdn.denoiser.sanitize import sanitize
from tests.hard_cases.inputs import good

folder = sys.argv[1]
assert jaxdn.__file__.startswith(sys.argv[2]), jaxdn.__file__
clip = good(frames=4, height=24, width=24).clip
toy = np.random.default_rng(0).normal(size=(4, 24, 24, 2)).astype(np.float32)
assert np.isfinite(clip.frames.toy).all()  # the hard cases have it
clip = clip._replace(frames=clip.frames._replace(toy=toy, motion=toy))
for seed in range(3):
    write_clip(clip, f"{folder}/clip-{seed}")
np.testing.assert_array_equal(jaxdn.read_clip(f"{folder}/clip-0").frames.toy, toy)  # stored
batches = training_batches(folder, batch=4, crop=16, frames=3, seed=1)
for batch in (next(batches) for _ in range(4)):
    found = batch.frames.toy
    assert found.shape == (4, 3, 16, 16, 2)  # cropped
    np.testing.assert_array_equal(found, batch.frames.motion)  # flipped and turned as motion is
assert not np.array_equal(found[0], found[1])
broken = Frame(clip.frames.radiance[0], toy=np.where(toy[0] > 2, np.nan, toy[0]))
mended, count = sanitize(broken)
lost = (toy[0] > 2).any(-1)
assert count == lost.sum() > 0 and np.isnan(np.asarray(mended.toy)[lost]).all()  # sanitized
assert present(written_out(Frame(clip.frames.radiance), ["toy"])) == ("toy",)
assert inspect.list_channels(("toy",)) == ["toy.X", "toy.Y"] and BUFFERS["toy"].bytes == 8  # inspected
print("found everywhere")
"""


@pytest.mark.slow
def test_a_new_buffer_is_one_declaration(tmp_path):
    """Stored, cropped, flipped, sanitized and inspected, in a copy of the package with one field more."""
    home = Path(__file__).parents[1]
    shutil.copytree(home / "jaxdn", tmp_path / "jaxdn", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(home / "tests" / "hard_cases", tmp_path / "tests" / "hard_cases")
    vocabulary = tmp_path / "jaxdn" / "core" / "frame.py"
    marker = "    emission: Annotated"
    declaration = '    toy: Annotated[Array, Buffer(2, "vector", "motion")] = None\n    """[H, W, 2] px, a toy."""\n'
    source = vocabulary.read_text()
    assert marker in source
    vocabulary.write_text(source.replace(marker, declaration + marker))
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "clips"), str(tmp_path)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "found everywhere", done.stderr
