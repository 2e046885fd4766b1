"""What a user's type checker sees: no error in a script that uses public names, and no ``Any`` among its results."""

import json
import subprocess
import sys
from pathlib import Path

import jaxdn

SCRIPT = """
import jax
import jax.numpy as jnp

import jaxdn
from jaxdn import denoisers, losses, metrics
from jaxdn.core.frame import frame_at

clip = jaxdn.read_clip("data/clip")
denoiser, params = jaxdn.load_weights("steady-balanced")
images = jaxdn.denoise(denoiser, params, clip)
image, state = images[0], denoiser.start(params, frame_at(clip.frames, 0))
motion = jnp.zeros((8, 8, 2))
dual = jaxdn.dual_motion(motion, motion)
warped = jaxdn.warp(image, dual, border="zeros")
mask = jaxdn.occlusion_mask(motion, dual)
kernels = jaxdn.normalize_kernels(jnp.zeros((8, 8, 25)))
filtered = jaxdn.apply_kernels(warped, kernels)
composed = jaxdn.compose_scales(filtered, filtered[::2, ::2], jnp.ones((4, 4, 1)), up="nearest")
shown = jaxdn.color.tonemap(composed)
decibels = metrics.psnr(shown, shown)
error = losses.spatial(images, images)
divided = jaxdn.brdf.demodulate(image, image)
filter = denoisers.svgf(alpha=0.1)
core = jaxdn.Core(start=lambda params, frame: (), step=lambda *given: ((), given[2].radiance, 0), reads=frozenset())
own = jaxdn.recurrent(core)
jaxdn.save_weights("weights.safetensors", params, factory="steady", options={}, record={})
gradient = jax.grad(lambda scale: jnp.sum(jaxdn.warp(scale * image, motion)))(1.0)
"""
RESULTS = [
    "clip",
    "clip.frames",
    "denoiser",
    "images",
    "warped",
    "dual",
    "mask",
    "kernels",
    "filtered",
    "composed",
    "shown",
    "decibels",
    "error",
    "divided",
    "filter",
    "own",
    "params",
]


def _checked(script: str, folder: Path) -> list[dict]:
    (folder / "script.py").write_text(script)
    (folder / "pyrightconfig.json").write_text(
        json.dumps({"typeCheckingMode": "standard", "extraPaths": [str(Path(jaxdn.__file__).parents[1])]})
    )
    command = [sys.executable, "-m", "basedpyright", "--pythonpath", sys.executable, "--outputjson", "script.py"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    return json.loads(done.stdout)["generalDiagnostics"]


def test_a_users_script_has_no_error_and_no_any(tmp_path):
    revealed = "".join(f"reveal_type({each})\n" for each in RESULTS)
    found = _checked(SCRIPT + revealed, tmp_path)
    assert [each["message"] for each in found if each["severity"] in ("error", "warning")] == []
    kinds = {each["message"] for each in found if each["severity"] == "information"}
    assert len(kinds) == len(RESULTS)
    unknown = [kind for kind in kinds if kind.endswith(('"Any"', '"Unknown"'))]
    assert unknown == []


def test_wrong_uses_are_errors(tmp_path):
    wrong = 'jaxdn.warp(image, motion, border="mirror")\njaxdn.wrap(image)\njaxdn.denoise(params, denoiser, clip)\n'
    found = _checked(SCRIPT + wrong, tmp_path)
    assert len([each for each in found if each["severity"] == "error"]) >= 3
