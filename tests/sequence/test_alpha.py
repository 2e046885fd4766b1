"""``jaxdn denoise --alpha``: less noise in alpha, nothing that was no noise lost, and light that stays consistent."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.sequence.alpha import AlphaDenoiser
from jaxdn.sequence.optics import Optics
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests.data.test_kept import assert_same_but, box_blur
from tests.programs import Channels, layer
from tests.training.test_training import make_clip

HEIGHT, WIDTH, SAMPLES = 64, 96, 8
COLOUR = np.array([0.9, 0.5, 0.2])
"""Of what is seen, not premultiplied."""


class Veil(NamedTuple):
    """A disc whose edge is out of focus, before nothing."""

    cover: np.ndarray
    """[H, W] true alpha."""
    alpha: np.ndarray
    """[H, W] of a few samples."""
    light: np.ndarray
    """[H, W, 3] premultiplied, with the noise of alpha and of its own."""


def veil(frame: int, softness: float = 20.0) -> Veil:
    rng = np.random.default_rng(frame)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(rows - 32, columns - 40 - 2 * frame)
    cover = np.clip((30 - distance) / softness, 0, 1)
    alpha = cover if softness < 2 else rng.binomial(SAMPLES, cover) / SAMPLES
    gain = rng.gamma(8, 1 / 8, cover.shape)
    return Veil(cover, alpha, (alpha * gain)[..., None] * COLOUR)


def channels(now: Veil, dtype: type = np.float32) -> Channels:
    motion = np.broadcast_to([-2.0, 0.0, -2.0, 0.0], (HEIGHT, WIDTH, 4))
    rgba = np.concatenate([now.light, now.alpha[..., None]], axis=-1)
    return layer("V.Combined", rgba, "RGBA", dtype) | layer("V.Vector", motion, "XYZW") | layer("", rgba, "A", dtype)


def write(folder: Path, frames: int = 4, softness: float = 20.0, dtype: type = np.float32) -> Path:
    folder.mkdir()
    for frame in range(frames):
        clips.write_exr(folder / f"s.{frame:04d}.exr", channels(veil(frame, softness), dtype))
    return folder


@pytest.fixture(scope="module")
def denoised(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shot ``in``, and ``out`` as svgf leaves it."""
    folder = tmp_path_factory.mktemp("alpha")
    denoise_files([write(folder / "in")], folder / "out", find_model("svgf"), Settings(alpha=True))
    return folder


def error(alpha: np.ndarray, now: Veil) -> float:
    return float(np.mean((alpha - now.cover) ** 2))


@pytest.mark.slow
def test_alpha_has_less_noise_and_stays_a_share(denoised: Path) -> None:
    for frame in range(4):
        now, after = veil(frame), clips.read_exr(denoised / "out" / f"s.{frame:04d}.exr")["V.Combined.A"]
        assert after.min() >= 0
        assert after.max() <= 1
        limit = 0.25 if frame == 0 else 0.15
        assert error(after, now) < limit * error(now.alpha, now), frame


def test_opaque_stays_opaque_and_nothing_stays_nothing(denoised: Path) -> None:
    now, after = veil(3), clips.read_exr(denoised / "out" / "s.0003.exr")["V.Combined.A"]
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance = np.hypot(rows - 32, columns - 46)
    assert (now.cover[distance < 5] == 1).all()
    np.testing.assert_allclose(after[distance < 5], 1, atol=0.01)
    assert after[distance > 40].max() < 1e-6


def test_colour_over_alpha_is_that_of_what_is_seen(denoised: Path) -> None:
    """Alpha as it came under denoised light has colours of any brightness."""
    after = clips.read_exr(denoised / "out" / "s.0003.exr")
    light = np.stack([after[f"V.Combined.{letter}"] for letter in "RGB"], axis=-1)
    colour = light / np.maximum(after["V.Combined.A"][..., None], 1e-6)
    visible = light.max(axis=-1) > 1e-3
    assert (colour <= 2.5 * COLOUR)[visible].all()
    kept = light / np.maximum(veil(3).alpha[..., None], 1e-6)
    assert (kept > 2.5 * COLOUR)[visible].any()
    seen = veil(3).cover > 0.2
    wrong = [np.mean(np.abs(one - COLOUR)[seen]) for one in (colour, kept)]
    assert wrong[0] < 0.5 * wrong[1]


def test_everything_else_stays(denoised: Path) -> None:
    changed = tuple(f"V.Combined.{letter}" for letter in "RGBA")
    for file in sorted((denoised / "in").iterdir()):
        assert_same_but(file, denoised / "out" / file.name, changed)


@pytest.mark.parametrize(("softness", "most", "mean"), [(1.0, 0.15, 0.03), (0.1, 0.02, 0.001)])
def test_alpha_without_noise_comes_back(softness: float, most: float, mean: float, tmp_path: Path) -> None:
    """The edge of a sharp object is smooth over a pixel, or not at all."""
    source = write(tmp_path / "in", frames=2, softness=softness)
    denoise_files([source], tmp_path / "out", find_model("noisy"), Settings(alpha=True))
    for frame in range(2):
        now, after = veil(frame, softness), clips.read_exr(tmp_path / "out" / f"s.{frame:04d}.exr")["V.Combined.A"]
        near = np.abs(np.gradient(now.cover)).sum(axis=0) > 0
        assert np.abs(after - now.cover).max() < most
        assert np.abs(after - now.cover)[near].mean() < mean
        np.testing.assert_allclose(after[~near], now.cover[~near], atol=0.01)


def test_light_below_zero_leaves_no_holes() -> None:
    """A pixel filter rings, and a denoised beauty may be just below 0."""
    now = veil(0)
    beauty = (now.cover[..., None] * COLOUR).astype(np.float32)
    beauty[now.cover == 0] = -5e-4
    given = now.light.astype(np.float32)
    given[0, 0], given[5, 5] = np.nan, np.inf
    alpha = AlphaDenoiser(safe=True).denoise(now.alpha, Frame(given), beauty)
    assert np.isfinite(alpha).all()
    assert error(alpha, now) < 0.5 * error(now.alpha, now)


def test_light_that_is_drawn_over_an_edge_has_alpha_under_it(tmp_path: Path) -> None:
    source = write(tmp_path / "in", frames=1, softness=0.1)
    denoise_files([source], tmp_path / "out", box_blur(), Settings(alpha=True, safe=False))
    after = clips.read_exr(tmp_path / "out" / "s.0000.exr")
    light = np.stack([after[f"V.Combined.{letter}"] for letter in "RGB"], axis=-1)
    beyond = (veil(0, 0.1).alpha == 0) & (light.max(axis=-1) > 0)
    assert beyond.sum() > 100
    assert (light / np.maximum(after["V.Combined.A"], 1e-9)[..., None])[beyond].max() < 3.5


@pytest.mark.parametrize("only_beauty", [False, True])
def test_half_and_the_beauty_alone(only_beauty: bool, tmp_path: Path) -> None:
    source = write(tmp_path / "in", frames=1, dtype=np.float16)
    denoise_files([source], tmp_path / "out", box_blur(), Settings(alpha=True, only_beauty=only_beauty))
    after = clips.read_exr(tmp_path / "out" / "s.0000.exr")["A" if only_beauty else "V.Combined.A"]
    assert after.dtype == np.float16
    assert error(after, veil(0)) < 0.6 * error(veil(0).alpha, veil(0))


@pytest.mark.parametrize("settings", [Settings(alpha=True), Settings(reblur=Optics(shutter=0.5))])
def test_alpha_that_is_no_number_is_none_of_its_neighbours(settings: Settings, tmp_path: Path) -> None:
    now = channels(veil(0)) | layer("V.Depth", np.ones((HEIGHT, WIDTH, 1)), "Z")
    now["V.Combined.A"][5, 7], now["V.Combined.A"][20, 30] = np.nan, np.inf
    clips.write_exr(tmp_path / "s.0000.exr", now)
    denoise_files([tmp_path / "s.0000.exr"], tmp_path / "out", find_model("noisy"), settings)
    assert np.isfinite(clips.read_exr(tmp_path / "out" / "s.0000.exr")["V.Combined.A"]).all()


def test_the_option_and_files_without_alpha(tmp_path: Path, capsys: Any) -> None:
    source = write(tmp_path / "in", frames=1)
    arguments = ["-o", str(tmp_path / "out"), "--method", "noisy"]
    main.main(["denoise", str(source), *arguments])
    assert_same_but(source / "s.0000.exr", tmp_path / "out" / "s.0000.exr", ())
    main.main(["denoise", str(source), *arguments, "--alpha"])
    assert_same_but(source / "s.0000.exr", tmp_path / "out" / "s.0000.exr", ("V.Combined.A",))
    clips.write_exr(tmp_path / "a.exr", layer("", veil(0).light, "RGB"))
    main.main(["denoise", str(tmp_path / "a.exr"), *arguments, "--alpha"])
    assert "--alpha: there is no alpha beside the beauty" in capsys.readouterr().out
    clips.write_clip(make_clip(0), tmp_path / "clip")
    with pytest.raises(ValueError, match="--alpha: expected files of other renderers"):
        denoise_files([tmp_path / "clip"], tmp_path / "out", box_blur(), Settings(alpha=True))
