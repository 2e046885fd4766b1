"""No vectors, or zeros, though something moves: motion is measured. Where nothing moves, nothing changes."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import clips
from jaxdn.core.frame import Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.denoiser import Core, recurrent
from jaxdn.sequence.missing_motion import MEASURED
from jaxdn.sequence.optics import Optics
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import Model
from tests.programs import Channels, layer

HEIGHT, WIDTH, FRAMES = 48, 64, 5
STEP = 2
"""Pixels to the right, that all moves in a frame."""
_PHASES = np.random.default_rng(2).uniform(0, 6, (3, 3))


def passes(frame: int, *, step: float = STEP, mirrored: bool = False) -> Channels:
    """What Blender writes with motion blur on: a wall with a pattern, with noise in its light and its guides."""
    rng = np.random.default_rng(frame)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    columns = (columns[:, ::-1] if mirrored else columns) - step * frame
    albedo = 0.5 + 0.13 * sum(
        np.sin(a * columns[..., None] + b * rows[..., None] + _PHASES[i])
        for i, (a, b) in enumerate(((0.3, 0.1), (-0.1, 0.35), (0.2, 0.25)))
    )
    albedo = albedo + rng.normal(scale=0.01, size=albedo.shape)
    light = albedo * rng.gamma(4, 0.25, albedo.shape)
    normal = np.broadcast_to([0.0, 0.0, 1.0], albedo.shape) + rng.normal(scale=0.01, size=albedo.shape)
    return (
        layer("V.Combined", light, "RGB")
        | layer("V.Denoising Albedo", albedo, "RGB")
        | layer("V.Denoising Normal", normal, "XYZ")
        | layer("V.Vector", np.zeros((HEIGHT, WIDTH, 4)), "XYZW")
    )


def write(folder: Path, make: Callable[[int], Channels] = passes, frames: int = FRAMES) -> Path:
    folder.mkdir()
    for frame in range(frames):
        clips.write_exr(folder / f"s.{frame:04d}.exr", make(frame))
    return folder


@functools.cache
def showing_motion() -> Model:
    """A method whose image is the motion that it is given, or 0 where there is none, 64 added, and 64."""

    def step(params: Any, state: Any, frame: Frame, first: Any, statistics: Any) -> Any:
        blank = jnp.full_like(frame.radiance, 64)
        return state, blank if frame.motion is None else blank.at[..., :2].add(frame.motion), 0

    start = lambda params, frame: jnp.zeros(())  # noqa: E731
    return Model(
        "motion", recurrent(Core(start, step, frozenset({"motion", "albedo", "normal"}), receptive_field=0)), {}
    )


def shown(source: Path, out: Path, **settings: Any) -> tuple[dict[str, np.ndarray | None], list[str]]:
    """The motion in each frame; None where there is none; and what was told."""
    told: list[str] = []
    written = denoise_files([source], out, showing_motion(), Settings(safe=False, **settings), log=told.append)
    found: dict[str, np.ndarray | None] = {}
    for file in written.files:
        motion = read_motion(clips.read_exr(file), "V.Combined")
        found[file.stem] = motion if motion.any() else None
    return found, told


def read_motion(pixels: Channels, name: str) -> np.ndarray:
    """[H, W, 2]; the third channel tells in which unit of light a frame was denoised."""
    red, green, unit = (pixels[f"{name}.{letter}"] for letter in "RGB")
    return np.stack([64 * red / unit - 64, 64 * green / unit - 64], axis=-1)


def is_motion(found: np.ndarray | None, x: float) -> bool:
    """Whether it is x to the right nearly everywhere, but for the border."""
    assert found is not None
    return bool(np.quantile(np.abs(found[6:-6, 6:-6] - [x, 0]).max(axis=-1), 0.95) < 0.3)


def without_vectors(frame: int) -> Channels:
    return {name: values for name, values in passes(frame).items() if "Vector" not in name}


@pytest.mark.parametrize("make", [passes, without_vectors])
def test_motion_is_measured_and_that_is_told(make: Callable[[int], Channels], tmp_path: Path) -> None:
    found, told = shown(write(tmp_path / "in", make), tmp_path / "out")
    assert found.pop("s.0000") is None
    assert len(found) == FRAMES - 1
    assert all(is_motion(motion, -STEP) for motion in found.values())
    assert [line for line in told if "motion is measured" in line] == [MEASURED]


def test_where_nothing_moves_nothing_changes(tmp_path: Path) -> None:
    """In spite of noise; nor where vectors are left out, and for a single frame."""
    still, moving = (write(tmp_path / f"{step}", lambda frame, s=step: passes(frame, step=s)) for step in (0, STEP))  # type: ignore[misc]
    bare = write(tmp_path / "bare", without_vectors)
    for number, (source, settings) in enumerate(
        (
            (still, {}),
            (moving, {"naming": ChannelNaming("none")}),
            (moving / "s.0001.exr", {}),
            (bare, {"naming": ChannelNaming("none")}),
        )
    ):
        found, told = shown(source, tmp_path / f"out-{number}", **settings)
        assert set(found.values()) == {None}
        assert MEASURED not in told


def test_frames_that_are_blurred_again_keep_their_zeros(tmp_path: Path) -> None:
    def with_depth(frame: int) -> Channels:
        return passes(frame) | layer("V.Depth", np.full((HEIGHT, WIDTH, 1), 3.0), "Z")

    found, told = shown(write(tmp_path / "in", with_depth), tmp_path / "out", reblur=Optics(shutter=0.5))
    assert set(found.values()) == {None}
    assert MEASURED not in told


def test_vectors_that_come_later_are_read(tmp_path: Path) -> None:
    def later(frame: int) -> Channels:
        vectors = np.zeros((HEIGHT, WIDTH, 4)) + ([9.0, 0, 0, 0] if frame > 2 else 0.0)
        return passes(frame) | layer("V.Vector", vectors, "XYZW")

    found, _ = shown(write(tmp_path / "in", later), tmp_path / "out")
    assert is_motion(found["s.0002"], -STEP)
    assert is_motion(found["s.0003"], 9)


def test_the_same_is_measured_in_a_part_and_in_a_run_that_goes_on(tmp_path: Path) -> None:
    """To the last bit."""
    source = write(tmp_path / "in")
    whole = tmp_path / "whole"
    shown(source, whole)
    shown(source, tmp_path / "part", frames=range(2, 4))
    for name in ("s.0001.exr", "s.0002.exr", "s.0003.exr"):
        (tmp_path / "again").mkdir(exist_ok=True)
        (tmp_path / "again" / name).write_bytes((whole / name).read_bytes())
    shown(source, tmp_path / "again", skip_existing=True)
    for folder, names in (("part", ["s.0002.exr", "s.0003.exr"]), ("again", [f"s.{i:04d}.exr" for i in range(FRAMES)])):
        assert sorted(path.name for path in (tmp_path / folder).iterdir()) == names
        assert all((tmp_path / folder / name).read_bytes() == (whole / name).read_bytes() for name in names)


@pytest.mark.parametrize("make", [passes, without_vectors])
def test_backwards_it_is_the_motion_to_the_next_frame(make: Callable[[int], Channels], tmp_path: Path) -> None:
    """The first frame has motion in the backward pass alone, the last one in the forward pass, of the other sign."""
    found, told = shown(write(tmp_path / "in", make), tmp_path / "out", bidirectional=True)
    first, last = (found[name] for name in ("s.0000", "s.0004"))
    assert first is not None
    assert last is not None
    assert 0.5 * STEP < np.median(first[..., 0]) < STEP
    assert -STEP < np.median(last[..., 0]) < -0.5 * STEP
    assert told.count(MEASURED) == 1


def test_each_view_of_a_stereo_camera_has_its_own(tmp_path: Path) -> None:
    def both(frame: int) -> Channels:
        channels: Channels = {}
        for view in ("left", "right"):
            there = passes(frame, mirrored=view == "left")
            for letter in "RGB":
                channels[f"{view}.{letter}"] = there[f"V.Combined.{letter}"]
                channels[f"{view}.albedo.{letter}"] = there[f"V.Denoising Albedo.{letter}"]
            channels |= layer(f"{view}.forward", np.zeros((HEIGHT, WIDTH, 2)), "uv")
        return channels

    settings = Settings(safe=False, naming=ChannelNaming("forward-up"))
    told: list[str] = []
    source = write(tmp_path / "in", both, frames=2)
    _, second = denoise_files([source], tmp_path / "out", showing_motion(), settings, log=told.append).files
    pixels = clips.read_exr(second)
    for view, x in (("left", STEP), ("right", -STEP)):
        assert is_motion(read_motion(pixels, view), x)
        assert told.count(f"{view}: {MEASURED}") == 1
