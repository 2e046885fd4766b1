"""No result is worse than its input: noise is measured, and what is none of it comes back. Real files."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import clips, color
from jaxdn.core.frame import Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.read import open_frames
from jaxdn.metrics import psnr
from jaxdn.ops.sampling import allot_evenly
from jaxdn.render import ClipJob, render_clips
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.frame_denoiser import Fallback, FrameDenoiser
from jaxdn.sequence.james_stein import Confidence
from jaxdn.sequence.missing_motion import MEASURED
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.segment import explain_fallback
from jaxdn.sequence.settings import Settings
from tests.sharing import make_once, share_model

SIZE = (48, 64)


def picture(frame: int) -> np.ndarray:
    """A wall with a soft shadow and a bright box with sharp edges that moves, without noise; no guides tell of them."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    wall = 0.4 + 0.3 / (1 + np.exp(-(columns - 30) / 6))
    left = 8 + 3 * frame
    inside = np.clip(columns - left, 0, 1) * np.clip(left + 16 - columns, 0, 1) * np.clip(rows - 11.5, 0, 1)
    return ((wall + 0.8 * inside * (rows < 34))[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


def write(folder: Path, samples: int | None, frames: int = 3) -> Path:
    """Frames of the picture with the noise of so many samples; None: without."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for frame in range(frames):
        light = picture(frame)
        if samples is not None:
            light = (light * rng.gamma(samples, 1 / samples, light.shape)).astype(np.float32)
        clips.write_exr(folder / f"a.{frame:04d}.exr", dict(zip("RGB", np.moveaxis(light, -1, 0), strict=True)))
    return folder


def read(path: Path) -> np.ndarray:
    return np.stack([clips.read_exr(path)[letter] for letter in "RGB"], axis=-1)


def decibels(files: list[Path]) -> list[float]:
    mapped = [(color.tonemap(read(file)), color.tonemap(picture(frame))) for frame, file in enumerate(files)]
    return [float(psnr(*pair)) for pair in mapped]


def denoise(source: Path, out: Path, **settings: Any) -> tuple[list[Path], list[str]]:
    told: list[str] = []
    written = denoise_files([source], out, share_model("svgf"), Settings(**settings), log=told.append)
    return written.files, told


@pytest.mark.slow
def test_a_clean_render_comes_back(tmp_path: Path) -> None:
    source = write(tmp_path / "in", None)
    plain, _ = denoise(source, tmp_path / "plain", safe=False)
    assert max(decibels(plain)) < 40
    safe, told = denoise(source, tmp_path / "safe")
    assert min(decibels(safe)) > 50
    line = next(line for line in told if line.startswith("a.0000.exr: noise is about 0."))
    assert line.endswith("100% of the frame is kept (--no-safe: nothing)")


@pytest.mark.parametrize("samples", [1, 16, 64, 256])
def test_no_frame_is_worse_than_it_was(tmp_path: Path, samples: int) -> None:
    source = write(tmp_path / "in", samples)
    before = decibels([source / f"a.{frame:04d}.exr" for frame in range(3)])
    plain, safe = (decibels(denoise(source, tmp_path / str(on), safe=on)[0]) for on in (False, True))
    assert all(now > then for now, then in zip(safe, before, strict=True))
    assert all(now > then - 0.02 for now, then in zip(safe, plain, strict=True))


def test_pixels_without_samples_keep_nothing(rng: np.random.Generator) -> None:
    """There the image is the denoiser's; what little noise there is elsewhere has most of the frame kept."""
    truth = picture(0)
    seen = np.asarray(allot_evenly(0.5, *SIZE, 0))
    frame = Frame((truth * rng.gamma(400, 1 / 400, truth.shape) * seen).astype(np.float32), sample_count=seen)
    denoiser = FrameDenoiser(share_model("taa"), Path("shot"), channels=lambda: 3, log=lambda line: None)
    denoiser(StoredFrame(frame))
    image, fallback = denoiser.blend_fallback(frame, 0.9 * truth)
    assert fallback.kept > 0.2
    unseen = seen[..., 0] == 0
    np.testing.assert_allclose(image[unseen], 0.9 * truth[unseen], rtol=0.15)


def test_a_frame_with_little_noise_that_is_kept_blames_no_guides() -> None:
    """As of a Cycles frame with noise of 1.2 %: nothing is lost, and little to gain."""
    confidence = jax.device_get(Confidence(*jnp.array([0.012, 0.004, 0.0, 1.0])))
    line = explain_fallback(Path("a.exr"), Fallback(confidence, 1.0, texture_unknown=False))
    assert line.startswith("a.exr: with noise of 1.2% of the light, the denoised image is estimated to be no better")
    assert "albedo" not in line


def test_guides_that_do_not_belong_to_the_frame_are_told(tmp_path: Path) -> None:
    """An albedo of other colours than the picture's: what the denoiser makes of it is not taken."""
    source = write(tmp_path / "in", 256)
    rng = np.random.default_rng(1)
    for file in sorted(source.iterdir()):
        there = clips.read_exr(file)
        blocks = np.kron(rng.uniform(0.05, 1.0, (6, 8)), np.ones((8, 8))).astype(np.float32)
        clips.write_exr(file, {**there, **{f"albedo.{letter}": blocks for letter in "RGB"}})
    plain, _ = denoise(source, tmp_path / "plain", safe=False)
    safe, told = denoise(source, tmp_path / "safe")
    assert min(decibels(safe)) > min(decibels(plain)) + 6
    assert decibels(safe) == decibels(sorted(source.iterdir()))
    first, more = [line for line in told if line != MEASURED][-2:]  # other blocks in every frame: something moves
    assert "a.0000.exr: the denoised image differs by" in first
    assert "albedo, normals or depth may not belong to this frame; 100% of the result is the frame as it came" in first
    assert more == "likewise 2 more, up to a.0002.exr"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_once(tmp_path_factory, "rendered-safe", render_files) / "files"


def render_files(folder: Path) -> None:
    """A clip with wallpaper, pictures and thin edges at 64 samples, all light, as files of another renderer."""
    scene = {"family": "pinkroom", "seed": 5}
    job = ClipJob(
        scene, str(folder / "clip"), 2, RenderSettings(width=128, height=128, layers=(64,), reference_spp=512)
    )
    render_clips([job], workers=1, progress=False)
    for index, stored in enumerate(open_frames(folder / "clip", spp=64)[1]):
        frame = stored.frame
        rest = np.asarray(frame.direct) + (0.0 if frame.emission is None else np.asarray(frame.emission))
        assert stored.reference is not None
        buffers = {
            "": np.asarray(frame.radiance) + rest,
            "reference.": stored.reference + rest,
            "albedo.": frame.albedo,
            "normal.": frame.normal,
            "depth.": frame.depth,
            "motion.": frame.motion,
        }
        channels = {
            f"{layer}{letter}": np.ascontiguousarray(np.asarray(buffer)[..., i], np.float32)
            for layer, buffer in buffers.items()
            for i, letter in enumerate({"normal.": "XYZ", "depth.": "Z", "motion.": "XY"}.get(layer, "RGB"))
        }
        (folder / "files").mkdir(exist_ok=True)
        clips.write_exr(folder / "files" / f"a.{index:04d}.exr", channels)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["svgf", "steady-balanced"])
@pytest.mark.parametrize("guides", ["all", "none", "turned"])
@pytest.mark.parametrize("beauty", ["", "reference."])
def test_no_rendered_frame_is_worse_than_it_was(
    rendered: Path, tmp_path: Path, method: str, guides: str, beauty: str
) -> None:
    """With all guides, by its light alone, and with guides of another picture; at 64 samples and at 512."""
    for file in sorted(rendered.iterdir()):
        there = clips.read_exr(file)
        light = {letter: there[f"{beauty}{letter}"] for letter in "RGB"}
        rest = {name: value for name, value in there.items() if "." in name and not name.startswith("reference")}
        turned = {name: np.ascontiguousarray(value[::-1, ::-1]) for name, value in rest.items()}
        (tmp_path / "in").mkdir(exist_ok=True)
        clips.write_exr(tmp_path / "in" / file.name, light | {"all": rest, "none": {}, "turned": turned}[guides])
    convention = None if guides == "none" else "previous-current"
    files = denoise_files(
        [tmp_path / "in"], tmp_path / "out", share_model(method), Settings(naming=ChannelNaming(convention))
    ).files
    for file in files:
        there = clips.read_exr(rendered / file.name)
        noisy, wanted = (
            color.tonemap(np.stack([there[f"{layer}{letter}"] for letter in "RGB"], axis=-1))
            for layer in (beauty, "reference.")
        )
        after = float(psnr(color.tonemap(read(file)), wanted))
        assert after > min(float(psnr(noisy, wanted)), 40) - 0.3
