"""Exported steps run by others: ONNX Runtime, StableHLO without its Python code, and the example in C++."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export as jax_export
from jax import lax

import jaxdn
from jaxdn.clips import write_clip
from jaxdn.commands import main
from jaxdn.commands.export import export
from jaxdn.core.frame import BUFFERS, Clip, frame_at, written_out
from jaxdn.data.exr.exr import read_exr
from jaxdn.denoiser.rollout import stream
from jaxdn.export.formats import onnx_model
from jaxdn.export.step import ExportedStep, exported_step
from jaxdn.zoo.ready import find_model
from tests.needs import require, require_module
from tests.training.test_training import make_clip

require("onnx")
onnxruntime = require_module("onnxruntime")

EXAMPLE = Path(__file__).parents[2] / "examples/cpp/denoise.cpp"


def moving_clip(frames, size):
    """Every buffer that shipped methods read, with motion between pixels and a sky."""
    clip = make_clip(0, frames=frames, size=size)
    reads = find_model("steady-balanced").denoiser.reads | find_model("ntd-small").denoiser.reads
    full = written_out(clip.frames, reads)
    rows, columns = np.mgrid[:size, :size].astype(np.float32)
    motion = np.stack([0.3 + 0.02 * columns, -0.7 + 0.01 * rows], axis=-1)
    sky = (rows < 3)[..., None]
    depth = np.where(sky, 1e6, 2.0 + 0.03 * rows[..., None]).astype(np.float32)
    ids = np.where(sky, -1, (columns[..., None] > size // 2).astype(np.int32)).astype(np.int32)
    every = {"motion": motion, "dual_motion": motion, "depth": depth, "previous_depth": depth, "ids": ids}
    return Clip(full._replace(**{name: np.stack([one] * frames) for name, one in every.items()}), clip.reference)


def run_onnx(file, frames, count):
    """The images of an exported step, and how many values it sanitized."""
    options = onnxruntime.SessionOptions()
    options.log_severity_level, options.intra_op_num_threads = 3, 2
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    types = {"tensor(float)": np.float32, "tensor(int32)": np.int32, "tensor(bool)": bool}
    lengths = dict(zip(("height", "width"), frames.radiance.shape[1:3], strict=True))
    state, images = {}, []
    for one in session.get_inputs():
        if one.name.startswith("state"):
            state[one.name] = np.zeros([lengths.get(size, size) for size in one.shape], types[one.type])
    names = [one.name for one in session.get_outputs()]
    for index in range(count):
        frame = frame_at(frames, index)
        given = {
            one.name: np.asarray(getattr(frame, one.name)).astype(types[one.type])
            for one in session.get_inputs()
            if one.name in BUFFERS
        }
        found = dict(zip(names, session.run(None, {**given, **state, "first": np.asarray(index == 0)}), strict=True))
        state = {name: found["next" + name.removeprefix("state")] for name in state}
        images.append(found["image"])
    return np.stack(images)


def expected(name, frames, count):
    method = find_model(name)
    step = stream(method.denoiser, method.params)
    return np.stack([step(frame_at(frames, index)) for index in range(count)])


def assert_same(images, wanted):
    """Within 1e-3; of a pixel in a thousand a tap may be accepted by one program and rejected by the other."""
    apart = np.max(np.abs(images - wanted) / (np.abs(wanted) + 1e-2), axis=-1)
    assert np.mean(apart > 1e-3) < 1e-3, f"{np.sum(apart > 1e-3)} pixels differ, by up to {apart.max():.1e}"
    assert np.sqrt(np.mean((images - wanted) ** 2) / np.mean(wanted**2)) < 1e-3


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("taa", (20, 33)),
        slow("svgf", (20, 33)),
        slow("svgf-fitted", (32,)),
        slow("steady-balanced", (64,)),  # compiling it takes long
        slow("ntd-small", (32, 48)),  # as ntd-large, whose network is wider
    ],
)
def test_onnx_gives_the_same_images_at_any_size(name, sizes, tmp_path):
    done = export(name, tmp_path, format="onnx")
    for size in sizes:
        frames = moving_clip(3, size).frames
        assert_same(run_onnx(done.files[0], frames, 3), expected(name, frames, 3))


@pytest.mark.slow
def test_onnx_for_one_size_pads_in_the_model(tmp_path):
    frames = jax.tree.map(lambda buffer: buffer[:, :20, :28], moving_clip(3, 32).frames)
    done = export("ntd-small", tmp_path, format="onnx", size=(20, 28))
    assert done.step.multiple is None
    assert_same(run_onnx(done.files[0], frames, 3), expected("ntd-small", frames, 3))


def test_absent_buffers_are_no_inputs(tmp_path):
    done = export("taa", tmp_path, format="onnx", buffers=["motion"])
    assert list(done.step.inputs) == ["radiance", "motion", "state.history", "first"]
    frames = moving_clip(2, 20).frames._replace(depth=None)
    assert_same(run_onnx(done.files[0], frames, 2), expected("taa", frames, 2))


def test_the_number_of_samples_is_an_input_where_it_is_asked_for(tmp_path):
    """Frames that were rendered in the usual way do not say it."""
    denoiser = jaxdn.stabilised(jaxdn.denoisers.taa())
    assert "sample_count" in denoiser.reads
    assert "sample_count" not in exported_step(denoiser, {}, size=(16, 16)).inputs
    asked = exported_step(denoiser, {}, size=(16, 16), buffers=["sample_count", "motion"])
    assert list(asked.inputs)[:3] == ["radiance", "motion", "sample_count"]


@pytest.mark.slow
def test_stablehlo_runs_without_the_denoiser(tmp_path):
    frames = moving_clip(3, 20).frames
    (file,) = export("taa", tmp_path, format="stablehlo").files
    step, state = jax_export.deserialize(bytearray(file.read_bytes())), np.zeros((20, 20, 4), np.float32)
    assert {"cpu", "cuda"} <= set(step.platforms)
    images = []
    for index in range(3):
        frame = frame_at(frames, index)
        buffers = {"radiance": frame.radiance, "depth": frame.depth, "motion": frame.motion}
        found = step.call({**buffers, "state.history": state, "first": np.asarray(index == 0)})
        state = found["next.history"]
        images.append(found["image"])
    assert_same(np.stack(images), expected("taa", frames, 3))


RULES = {
    "log1p": lambda x: jnp.log1p(1e-6 * x),
    "powers": lambda x: x**0 + x**3 + 1 / (1 + x**2) + (1 + x) ** -2,
    "truth": lambda x: jnp.where(x[:, :1] > 0.5, x > 0.2, x > 0.7) | jnp.any(x > 2) & jnp.all(x < 2),
    "rank of a sum": lambda x: jnp.cumsum((9 * x[:, 0]).astype(jnp.int32)),
    "product": lambda x: jnp.einsum("nt,nkt->nk", x, jnp.stack([x, x + 1], 1)),
    "convolution": lambda x: lax.conv_general_dilated(
        x[None, ..., None], jnp.arange(18.0).reshape(3, 3, 1, 2), (2, 1), ((1, 1), (0, 2)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    ),
    "unstacked": lambda x: sum(jnp.unstack(jnp.stack([x, x + 1, x * x], 1), axis=1)),
    "rows": lambda x: x[jnp.clip((x[:, 0] * 9).astype(jnp.int32), 0, x.shape[0] - 1)],
    "elements": lambda x: x.at[(x[:, 0] * 3).astype(jnp.int32), 1].get(mode="clip"),
    "slice": lambda x: lax.dynamic_slice(x, ((x[0, 0] * 40).astype(jnp.int32), 1), (2, 2)),
    "dropped": lambda x: jnp.zeros(4).at[jnp.arange(x.shape[0])].set(x[:, 0], mode="drop"),
    "backwards": lambda x: lax.scan(lambda sum, row: (sum + row[0], sum * row - x[0]), 1.0, x, reverse=True)[1],
    "branches": lambda x: lax.cond(x[0, 0] > 0.5, lambda: x[1:] + 1, lambda: x[:-1]),
    "sizes": lambda x: jnp.ones((x.shape[0] // 3, -(-x.shape[1] // 4))) * (x.shape[0] % 5),
}  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
def test_each_rule_computes_what_jax_does(rule, rng):
    def function(inputs):
        return {"image": RULES[rule](inputs["radiance"])}

    size = jax_export.symbolic_shape("h, w", constraints=["h >= 4", "w >= 4"])
    inputs = {"radiance": jax.ShapeDtypeStruct(size, np.float32)}
    program = jax.make_jaxpr(lambda radiance: [function({"radiance": radiance})["image"]])(inputs["radiance"])
    model = onnx_model(ExportedStep(function, inputs, program, ("image",), 1), rule)
    x = jnp.asarray(rng.random((8, 6), np.float32))
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(session.run(None, {"radiance": np.asarray(x)})[0], RULES[rule](x), rtol=1e-5, atol=1e-30)


def fails(capsys, *arguments):
    """A user error in this process, as another one needs seconds to begin; returns its message."""
    with pytest.raises(SystemExit) as ended:
        main.main(["export", *map(str, arguments)])
    told = capsys.readouterr().err
    assert ended.value.code == 2, told
    assert "Traceback" not in told
    return " ".join(told.split())


@pytest.mark.slow
def test_a_method_whose_step_needs_a_size_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"^asvgf: the step is not the same for all sizes; give --width and --height"):
        export("asvgf", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_cannot_be_exported_is_an_error_that_says_what_to_do(tmp_path, capsys):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "jaxdn.commands.main", "export", "taa", "-o", out, "--buffers", "albedo"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert "expected some of depth, motion" in " ".join(done.stderr.split())
    assert "give the other too" in fails(capsys, "taa", "-o", out, "--width", "64")
    assert "at least 16" in fails(capsys, "taa", "-o", out, "--width", "8", "--height", "8")
    assert "one that denoises" in fails(capsys, "noisy", "-o", out)
    assert "give --width and --height" in fails(capsys, "asvgf", "-o", out)
    message = fails(capsys, "asvgf", "-o", out, "--width", "24", "--height", "24")
    assert "operations that have a translation" in message
    assert "--format stablehlo" in message
    assert not out.exists()


def compiled(folder):
    """The example."""
    require("headers of ONNX Runtime", "g++", "headers of OpenEXR")  # CI has no headers of the first
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", "OpenEXR"], capture_output=True, text=True, check=True)
    library = next((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"))
    for name in ("libonnxruntime.so", "libonnxruntime.so.1"):
        (folder / name).symlink_to(library)
    program = folder / "denoise"
    source = ["g++", "-std=c++17", "-O1", str(EXAMPLE), "-o", str(program)]
    subprocess.run([*source, *flags.stdout.split(), f"-L{folder}", "-lonnxruntime"], check=True)
    return program


@pytest.mark.slow
def test_the_example_in_cpp_gives_the_same_images(tmp_path):
    program = compiled(tmp_path)
    write_clip(moving_clip(3, 32), tmp_path / "clip")
    files = sorted((tmp_path / "clip").glob("*.exr"))
    (model,) = export("ntd-small", tmp_path, format="onnx").files
    out = tmp_path / "out"
    out.mkdir()
    environment = os.environ | {"LD_LIBRARY_PATH": str(tmp_path)}
    subprocess.run([program, model, "noisy_1spp", out, *files], check=True, env=environment)
    images = [np.stack([read_exr(out / file.name)[letter] for letter in "RGB"], axis=-1) for file in files]
    assert_same(np.stack(images), expected("ntd-small", jaxdn.read_clip(tmp_path / "clip").frames, 3))
    missing = subprocess.run(
        [program, model, "", out, files[0]], env=environment, capture_output=True, text=True, check=False
    )
    assert missing.returncode == 2
    assert "no channel R" in missing.stderr
