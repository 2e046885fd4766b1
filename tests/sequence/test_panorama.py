"""Equirectangular panoramas: no seam, where filters and what moves go over the edge."""

import functools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.denoiser import Core, recurrent
from jaxdn.ops.warp import warp
from jaxdn.sequence.panorama import Panorama
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import Model
from tests.data.test_kept import box_blur
from tests.programs import Channels, layer
from tests.training.test_training import make_clip

HEIGHT, WIDTH, SPEED = 32, 64, 5
NAMING = ChannelNaming("previous-current")


def panorama(frame: int, long_way: bool = False) -> Channels:
    """Noise over a picture that turns to the right; its vectors are short, or those over the edge are not."""
    rng = np.random.default_rng(frame)
    columns = (np.arange(WIDTH) - SPEED * frame) % WIDTH
    picture = np.random.default_rng(99).uniform(0.2, 1, (HEIGHT, WIDTH, 3))[:, columns]
    light = picture * rng.gamma(4, 1 / 4, (HEIGHT, WIDTH, 1))
    motion = np.zeros((HEIGHT, WIDTH, 2))
    motion[..., 0] = -SPEED
    if long_way:
        motion[:, :SPEED, 0] += WIDTH
    alpha = rng.binomial(8, 0.5, (HEIGHT, WIDTH, 1)) / 8
    rgba = np.concatenate([light, alpha], axis=-1)
    channels = layer("", rgba, "RGBA") | layer("motion", motion, "XY") | layer("key", 0.5 * light, "RGB")
    return channels | layer("fill", 0.5 * light, "RGB")


def write(folder: Path, frames: int = 4, shift: int = 0, long_way: bool = False, **header: Any) -> Path:
    """The shot, each of its frames rolled by some columns."""
    folder.mkdir()
    about = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    for frame in range(frames):
        rolled = {name: np.roll(pixels, shift, axis=1) for name, pixels in panorama(frame, long_way).items()}
        OpenEXR.File(about, rolled).write(str(folder / f"p.{frame:04d}.exr"))
    return folder


@functools.cache
def follow_motion() -> Model:
    """The smallest denoiser that follows motion: an exponential mean, blurred a little."""

    def step(params: Any, state: Any, frame: Frame, first: Any, statistics: Any) -> Any:
        past = warp(state, frame.motion)
        known = jnp.sum(past, axis=-1, keepdims=True) > 0
        now = jnp.where(known & ~first, 0.7 * past + 0.3 * frame.radiance, frame.radiance)
        return now, now, 0

    start = lambda params, frame: jnp.zeros_like(frame.radiance)  # noqa: E731
    return Model("follow", recurrent(Core(start, step, frozenset({"motion"}), receptive_field=40)), {})


def result(folder: Path, frame: int, letters: str = "RGB") -> np.ndarray:
    there = clips.read_exr(folder / f"p.{frame:04d}.exr")
    return np.stack([there[letter] for letter in letters], axis=-1)


@pytest.mark.parametrize("header", [True, False])
def test_a_filter_goes_over_the_edge(header: bool, tmp_path: Path) -> None:
    stated = {"envmap": OpenEXR.ENVMAP_LATLONG} if header else {}
    source, told = write(tmp_path / "in", 1, **stated), list[str]()
    denoise_files([source], tmp_path / "out", box_blur(), Settings(safe=False, wrap=not header), log=told.append)
    noisy = result(source, 0)
    rows = np.pad(noisy, ((1, 1), (0, 0), (0, 0)), mode="edge")
    rows = (rows[:-2] + rows[1:-1] + rows[2:]) / 3
    round_ = (np.roll(rows, 1, 1) + rows + np.roll(rows, -1, 1)) / 3
    np.testing.assert_allclose(result(tmp_path / "out", 0), round_, rtol=1e-5)
    assert "a panorama: the left edge continues at the right one" in told
    denoise_files([source], tmp_path / "flat", box_blur(), Settings(safe=False))
    assert np.array_equal(result(tmp_path / "flat", 0), result(tmp_path / "out", 0)) == header


@pytest.mark.parametrize("long_way", [False, True])
def test_what_moves_over_the_edge_keeps_its_history(long_way: bool, tmp_path: Path) -> None:
    """All columns are as free of noise as those in the middle."""
    source = write(tmp_path / "in", 4, long_way=long_way)
    settings = Settings(naming=NAMING, safe=False, wrap=True)
    denoise_files([source], tmp_path / "out", follow_motion(), settings)
    expected = result(source, 0)
    for frame in range(1, 4):
        expected = 0.7 * np.roll(expected, SPEED, 1) + 0.3 * result(source, frame)
    np.testing.assert_allclose(result(tmp_path / "out", 3), expected, rtol=1e-4)
    if long_way:  # those vectors point into the picture anyway
        return
    denoise_files([source], tmp_path / "flat", follow_motion(), settings._replace(wrap=False))
    assert np.abs(result(tmp_path / "flat", 3) - expected)[:, :SPEED].max() > 0.05


@pytest.mark.slow
def test_no_column_is_special_for_what_else_is_denoised(tmp_path: Path) -> None:
    """The safe blend, alpha and light layers: a turned panorama gives the turned result."""
    settings = Settings(naming=NAMING, wrap=True, alpha=True, aovs="additive")
    for name, shift in (("a", 0), ("b", 32)):
        write(tmp_path / name, 2, shift, envmap=OpenEXR.ENVMAP_LATLONG)
        denoise_files([tmp_path / name], tmp_path / f"{name}-out", follow_motion(), settings)
    first, second = (clips.read_exr(tmp_path / f"{name}-out" / "p.0001.exr") for name in ("a", "b"))
    for name in [*"RGBA", "key.R", "fill.B"]:
        np.testing.assert_allclose(np.roll(first[name], 32, axis=1), second[name], atol=2e-3)
        assert not np.array_equal(first[name], panorama(1)[name])


def test_vectors_go_the_short_way_and_others_stay() -> None:
    motion = np.array([[[60.0, 1], [-61, 2], [3, -50], [np.nan, 0], [np.inf, 0]] + [[0, 0]] * 59], np.float32)
    wide = Panorama(10).widen_frame(Frame(np.ones((1, 64, 3), np.float32), motion=motion))
    cut = Panorama(10).cut(wide.motion)
    np.testing.assert_array_equal(cut[0, :5], [[-4, 1], [3, 2], [3, -50], [np.nan, 0], [np.inf, 0]])
    assert wide.radiance.shape == (1, 64 + 2 * 32, 3)


def test_a_part_of_a_panorama_and_a_cube_do_not_wrap(tmp_path: Path, capsys: Any) -> None:
    box = lambda right: (np.array([0, 0], np.int32), np.array([right, HEIGHT - 1], np.int32))  # noqa: E731
    part = write(tmp_path / "part", 1, envmap=OpenEXR.ENVMAP_LATLONG, dataWindow=box(63), displayWindow=box(127))
    main.main(["denoise", str(part), "-o", str(tmp_path / "out"), "--method", "noisy"])
    text = " ".join(capsys.readouterr().out.split())
    assert "the left edge does not continue at the right one, as the files have columns 0 to 63 of 0 to 127" in text
    cube = write(tmp_path / "cube", 1, envmap=OpenEXR.ENVMAP_CUBE)
    main.main(["denoise", str(cube), "-o", str(tmp_path / "out"), "--method", "noisy"])
    assert "a panorama: " not in capsys.readouterr().out
    main.main(["denoise", str(cube), "-o", str(tmp_path / "out"), "--method", "noisy", "--wrap"])
    assert "a panorama: " in capsys.readouterr().out
    clips.write_clip(make_clip(0), tmp_path / "clip")
    with pytest.raises(ValueError, match="--wrap: expected files of other renderers"):
        denoise_files([tmp_path / "clip"], tmp_path / "out", box_blur(), Settings(wrap=True))
