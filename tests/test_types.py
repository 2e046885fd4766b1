"""What a user's type checker sees: no error in a script that uses public names, and no ``Any`` among its results."""

import inspect
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import jaxdn

SCRIPT = """
import jax
import jax.numpy as jnp

import jaxdn
from jaxdn import denoisers, losses, metrics
from jaxdn.core.frame import frame_at
from jaxdn.recipes.objectives import pyramid_illumination
from jaxdn.recipes.recipe import Recipe
from jaxdn.training.step import init_state

clip = jaxdn.read_clip("data/clip")
denoiser, params = jaxdn.load_weights("steady-balanced")
images = jaxdn.denoise(denoiser, params, clip)
frame = frame_at(clip.frames, 0)
state, image = denoiser.step(params, denoiser.start(params, frame), frame)
streamed = next(jaxdn.stream(denoiser, params).each([frame]))
unrolled = jaxdn.unroll(denoiser, params, clip.frames, rematerialize=True)
decibels = metrics.psnr(images, images, average="mse")
error = losses.spatial(images, images)
shown = jaxdn.color.tonemap(images)
divided = jaxdn.brdf.demodulate(image, image)

motion = jnp.zeros((8, 8, 2))
dual = jaxdn.dual_motion(motion, motion)
warped = jaxdn.warp(image, dual, border="zeros")
mask = jaxdn.occlusion_mask(motion, dual)
kernels = jaxdn.normalize_kernels(jnp.zeros((8, 8, 25)))
filtered = jaxdn.apply_kernels(warped, kernels)
soft = jaxdn.softmax_filter(warped[None], jnp.zeros((8, 8, 25)))
composed = jaxdn.compose_scales(filtered, filtered[::2, ::2], jnp.ones((4, 4, 1)), up="nearest")
gradient = jax.grad(lambda scale: jnp.sum(jaxdn.warp(scale * image, motion)))(1.0)

filter = denoisers.svgf(alpha=0.1)
core = jaxdn.Core(start=lambda params, frame: (), step=lambda *given: ((), given[2].radiance, 0), reads=frozenset())
own = jaxdn.recurrent(core)
batches = jaxdn.training_batches("data/clips", batch=2, crop=64, seed=0)
batch = next(batches)
recipe = Recipe(pyramid_illumination())
training, report = jaxdn.make_train_step(denoiser, recipe)(init_state(denoiser, recipe, batch), batch)
loss = report.loss
jaxdn.save_weights("weights.safetensors", training.params, factory="steady", options={}, record={})
"""
RESULTS = [
    *("clip", "clip.frames", "clip.frames.radiance", "clip.frames.albedo", "clip.reference", "frame", "denoiser"),
    *("params", "images", "image", "streamed", "unrolled", "decibels", "error", "shown", "divided", "dual", "warped"),
    *("mask", "kernels", "filtered", "soft", "composed", "filter", "own", "batch", "training", "report", "loss"),
    *("jaxdn.affinity_filter", "jaxdn.reproject", "jaxdn.stabilised"),
]


NAMES = ("script.py", "wrong.py")
WRONG = """
jaxdn.warp(image, motion, border="mirror")
jaxdn.wrap(image)
jaxdn.denoise(params, denoiser, clip)
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict]]:
    """What pyright says of the script and of wrong uses, by the name of the file: one run reads the packages once."""
    folder = tmp_path_factory.mktemp("types")
    revealed = "".join(f"reveal_type({each})\n" for each in RESULTS)
    (folder / "script.py").write_text(SCRIPT + revealed)
    (folder / "wrong.py").write_text(SCRIPT + WRONG)
    (folder / "pyrightconfig.json").write_text(
        json.dumps({"typeCheckingMode": "standard", "extraPaths": [str(Path(jaxdn.__file__).parents[1])]})
    )
    command = [sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable, "--outputjson"]
    done = subprocess.run([*command, *NAMES], cwd=folder, capture_output=True, text=True, check=False)
    said = json.loads(done.stdout)["generalDiagnostics"]
    return {name: [each for each in said if Path(each["file"]).name == name] for name in NAMES}


@pytest.mark.slow
def test_a_users_script_has_no_error_and_no_any(found):
    said = found["script.py"]
    assert [each["message"] for each in said if each["severity"] in ("error", "warning")] == []
    kinds = {each["message"] for each in said if each["severity"] == "information"}
    assert len(kinds) == len(RESULTS)
    unknown = [kind for kind in kinds if kind.endswith(('"Any"', '"Unknown"'))]
    assert unknown == []


@pytest.mark.slow
def test_wrong_uses_are_errors(found):
    assert len([each for each in found["wrong.py"] if each["severity"] == "error"]) >= 3


def _public_functions() -> list[tuple[str, Any]]:
    """Those of jaxdn, and those that its public rooms declare themselves."""
    found = {name: getattr(jaxdn, name) for name in jaxdn.__all__}
    for room in ("brdf", "color", "losses", "metrics"):
        module = getattr(jaxdn, room)
        own = {name: value for name, value in vars(module).items() if not name.startswith("_")}
        found |= {f"{room}.{name}": value for name, value in own.items() if _module(value) == module.__name__}
    return [(name, each) for name, each in found.items() if inspect.isroutine(each) or hasattr(each, "__wrapped__")]


def _module(value: Any) -> str:
    return getattr(value, "__module__", "")


@pytest.mark.parametrize(("name", "function"), _public_functions())
def test_public_signatures_state_shapes(name, function):
    hints = inspect.signature(function).parameters.values()
    written = [str(hint.annotation) for hint in hints] + [str(inspect.signature(function).return_annotation)]
    bare = [text for text in written if re.search(r"jax\.Array|\bArray\b(?!,)|ndarray", text) and "Float[" not in text]
    assert bare == [], f"{name}: its arrays have no shape, as Float[Array, 'H W 3'] would say"
