"""Two passes, forwards and backwards: vectors to the next frame, the blend, and what is left on disk."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.core.frame import FAR, Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.read import open_frames
from jaxdn.filters.time_reversal import LENGTH_MAX, blend, reverse_time, update_history_length
from jaxdn.ops.motion import on_screen
from jaxdn.runtime.scratch import scratch_folder
from jaxdn.sequence.jobs import WARM_UP
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests.programs import PROGRAMS, truth, write_shot
from tests.sequence.test_frames import part_of
from tests.sharing import share_model
from tests.training.test_training import make_clip


def frame_of(index: int, **changes: Any) -> Frame:
    """The scene of the programs' files as a frame of ours."""
    now = truth(index)
    buffers = {"normal": now.normal, "depth": now.depth, "motion": now.motion}
    frame = Frame(now.light.astype(np.float32), **{k: v.astype(np.float32) for k, v in buffers.items()})
    return frame._replace(ids=now.ids.astype(np.int32), **changes)


@pytest.mark.parametrize("dropped", [(), ("ids",), ("normal", "depth"), ("ids", "normal", "depth")])
def test_vectors_to_the_next_frame_follow_from_those_of_the_next_frame(dropped: tuple[str, ...]) -> None:
    """Exactly, with any guide; what the square hides in the next frame has none. Without guides, that is not seen."""
    frames = [frame_of(index)._replace(**dict.fromkeys(dropped)) for index in (0, 1)]
    found = reverse_time(*frames).motion
    now, after = truth(0), truth(1)
    hidden = (after.ids == 1) & (now.ids == 0)
    known = np.isfinite(found).all(axis=-1, keepdims=True)
    if len(dropped) < 3:
        np.testing.assert_array_equal(known, ~hidden)
    np.testing.assert_array_equal(found[known[..., 0] & ~hidden[..., 0]], now.forward[known[..., 0] & ~hidden[..., 0]])
    assert known[~hidden].all()


def test_vectors_between_pixels_lead_to_where_the_point_is() -> None:
    """Of a plane that grows by a tenth: p goes to 1.1 p, which is known to a thousandth of the growth squared."""
    rows, columns = np.mgrid[:20, :24].astype(np.float32)
    there = np.stack([columns, rows], axis=-1)
    light = np.ones((20, 24, 3), np.float32)
    found = reverse_time(Frame(light, motion=np.zeros_like(there)), Frame(light, motion=there / 1.1 - there)).motion
    stays = np.asarray(on_screen(0.1 * there))[..., 0]
    assert np.isfinite(found[stays]).all()
    np.testing.assert_allclose(found[stays], 0.1 * there[stays], atol=0.1)
    assert np.isnan(found[~stays][-1]).all()


def test_without_motion_nothing_moves_and_what_tells_of_the_past_is_left_out() -> None:
    light = np.ones((4, 4, 3), np.float32)
    still = reverse_time(Frame(light, previous_depth=light[..., :1], luminance_gradient=light[..., :2]), Frame(light))
    assert still.motion is None
    assert still.previous_depth is None
    assert still.luminance_gradient is None
    last = reverse_time(frame_of(1, dual_motion=truth(1).motion), None)
    assert last.dual_motion is None
    assert not np.any(last.motion)


def test_broken_vectors_and_depths_stay_local() -> None:
    now, after = frame_of(0), frame_of(1)
    motion, depth = after.motion.copy(), after.depth.copy()
    motion[2, 2], motion[3, 3, 0], depth[4, 4], depth[5, 5] = np.nan, np.inf, np.nan, FAR
    whole, broken = (
        reverse_time(now, after).motion,
        reverse_time(now, after._replace(motion=motion, depth=depth)).motion,
    )
    differs = ~((whole == broken) | (np.isnan(whole) & np.isnan(broken))).all(axis=-1)
    assert differs.sum() <= 4
    assert np.isnan(broken[differs]).all()


@pytest.mark.slow
def test_what_was_seen_longer_counts_more() -> None:
    """The numbers of a square that moves: it and the wall count on, what it uncovers begins anew."""
    state = None
    for index in range(3):
        state = update_history_length(state, frame_of(index))
    number = np.asarray(state.number)
    uncovered = (truth(1).ids == 1) & (truth(2).ids == 0)
    still = (truth(0).ids == truth(1).ids) & (truth(1).ids == truth(2).ids)
    assert np.all(number[uncovered] == 1)
    assert np.all(number[still & ~uncovered] == 3)
    for _ in range(40):
        state = update_history_length(state, frame_of(0)._replace(motion=None))
    assert np.max(state.number) == LENGTH_MAX
    one, two = np.full((1, 1, 3), 1.0), np.full((1, 1, 3), 3.0)
    np.testing.assert_allclose(blend(one, two, np.full((1, 1, 1), 1.0), np.full((1, 1, 1), 3.0)), 2.5)


def test_blenders_file_has_the_vectors_and_others_give_them(tmp_path: Path) -> None:
    """Backwards, frames come last first; Blender's last two components are taken as they are."""
    for name in ("Blender", "Houdini"):
        folder = write_shot(name, tmp_path / name)
        convention = PROGRAMS[name].motion_convention
        _, frames = open_frames(folder, motion_convention=convention, backwards=True)
        last, middle, first = (stored.frame for stored in frames)
        for frame, index in ((last, 2), (middle, 1), (first, 0)):
            np.testing.assert_allclose(frame.albedo, truth(index).albedo, atol=1e-3)
        assert not np.any(last.motion)
        known = np.isfinite(first.motion).all(axis=-1)
        np.testing.assert_allclose(first.motion[known], truth(0).forward[known], atol=1e-5)
        assert known.all() == (name == "Blender")
        assert known.mean() > 0.9


def test_frames_after_the_wanted_ones_are_read_too() -> None:
    def part(numbers: Any, wanted: Any) -> list[range]:
        return part_of(numbers, wanted, both_directions=True)

    assert part(range(50), [25]) == [range(25 - WARM_UP, 25 + WARM_UP + 1)]
    assert part(range(50), [3, 49]) == [range(3 + WARM_UP + 1), range(49 - WARM_UP, 50)]
    assert part(range(50), range(50)) == [range(50)]
    gap = [*range(10), *range(12, 20)]
    assert part(gap, [9]) == [range(10)]
    assert part(gap, [12]) == [range(10, 18)]


def noisy_wall(folder: Path, count: int, seed: int = 0) -> Path:
    """A grey wall of brightness 1 with the noise of one sample in files of another renderer."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    for number in range(count):
        light = rng.exponential(1.0, (32, 32, 3)).astype(np.float32)
        clips.write_exr(folder / f"a.{number:04d}.exr", dict(zip("RGB", np.moveaxis(light, -1, 0), strict=True)))
    return folder


def denoised(source: Path, out: Path, name: str = "svgf", **settings: Any) -> list[np.ndarray]:
    written = denoise_files([source], out, share_model(name), Settings(bidirectional=True, **settings))
    assert not [path for path in out.rglob("*") if ".backwards" in path.name]
    return [np.stack([clips.read_exr(path)[letter] for letter in "RGB"], axis=-1) for path in written.files]


@pytest.mark.slow
def test_the_first_frame_is_as_good_as_the_last_and_time_has_no_direction(tmp_path: Path) -> None:
    source = noisy_wall(tmp_path / "in", 8)
    images = denoised(source, tmp_path / "out")
    errors = [float(np.sqrt(np.mean((image - 1) ** 2))) for image in images]
    once = denoise_files([source], tmp_path / "once", share_model("svgf")).files[0]
    assert errors[0] < 1.3 * errors[-1]
    assert errors[-1] < 1.3 * errors[0]
    assert errors[0] < 0.7 * np.sqrt(np.mean((clips.read_exr(once)["R"] - 1) ** 2))
    mirrored = tmp_path / "mirrored"
    mirrored.mkdir()
    for number in range(8):
        os.link(source / f"a.{7 - number:04d}.exr", mirrored / f"a.{number:04d}.exr")
    for image, other in zip(images, reversed(denoised(mirrored, tmp_path / "back")), strict=True):
        np.testing.assert_allclose(image, other, rtol=2e-3)


@pytest.mark.slow
def test_a_clip_of_ours_and_the_other_ways_to_denoise_go_together(tmp_path: Path) -> None:
    clips.write_clip(make_clip(0, frames=4, size=20), tmp_path / "clip")
    assert len(denoised(tmp_path / "clip", tmp_path / "out", "ntd-small")) == 4
    shot = write_shot("Arnold", tmp_path / "shot")  # data windows differ from frame to frame
    convention = PROGRAMS["Arnold"].motion_convention
    whole = denoised(shot, tmp_path / "whole", naming=ChannelNaming(convention))
    (one,) = denoised(shot, tmp_path / "one", naming=ChannelNaming(convention), frames=[2], aovs="additive")
    np.testing.assert_allclose(one, whole[1], rtol=1e-3, atol=1e-4)


def test_an_error_and_an_interrupt_leave_nothing_behind(tmp_path: Path) -> None:
    source = noisy_wall(tmp_path / "in", 3)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        denoise_files([source], tmp_path / "out", share_model("svgf"), Settings(bidirectional=True), on_frame=stop)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.0000.exr"]
    data = (source / "a.0001.exr").read_bytes()
    (source / "a.0001.exr").write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))  # no header tells
    with pytest.raises(clips.ClipError, match=r"a\.0001"):
        denoise_files([source], tmp_path / "bad", share_model("svgf"), Settings(bidirectional=True, strict=True))
    assert list((tmp_path / "bad").iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_ctrl_c_in_the_backward_pass_leaves_nothing_behind(tmp_path: Path) -> None:
    source, out = noisy_wall(tmp_path / "in", 400), tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "jaxdn.commands.main",
        "denoise",
        source,
        "-o",
        out,
        "--method",
        "taa",
        "--bidirectional",
    ]
    # A shell lets processes that it puts into the background ignore Ctrl-C, and theirs inherit that.
    process = subprocess.Popen(
        [*map(str, command)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    until = time.monotonic() + 240
    while not list(out.glob(".backwards-*/*.npz")) and time.monotonic() < until:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "interrupted" in errors
    assert list(out.iterdir()) == []


def test_any_run_removes_what_a_killed_one_left_and_nothing_of_one_that_lives(tmp_path: Path) -> None:
    source, out = noisy_wall(tmp_path / "in", 2), tmp_path / "out"
    (out / ".backwards-0123").mkdir(parents=True)
    (out / ".backwards-0123" / "0.npz").write_text("")
    with scratch_folder(out, ".other-") as other, scratch_folder(out, ".backwards-") as living:
        (out / ".backwards-4567").mkdir()
        denoise_files([source], out, find_model("noisy"), Settings())
        assert living.is_dir()
        assert other.is_dir()
        assert sorted(path.name for path in out.glob(".backwards-*")) == [living.name, f"{living.name}.lock"]
    (out / ".backwards-89ab").mkdir()
    denoise_files([source], out, find_model("noisy"), Settings(skip_existing=True))
    assert sorted(path.name for path in out.iterdir()) == ["a.0000.exr", "a.0001.exr"]


def test_half_written_frames_of_a_killed_run_are_removed_from_the_folders_of_the_results_alone(tmp_path: Path) -> None:
    source, out = noisy_wall(tmp_path / "in", 1), tmp_path / "out"
    name = ".a.0000.exr.elsewhere.7.1.tmp"
    for folder in (source, out, out / "other"):
        folder.mkdir(exist_ok=True)
        (folder / name).write_text("half")
        os.utime(folder / name, (0, 0))  # older than a day
    denoise_files([source], out, find_model("noisy"), Settings())
    assert sorted(path.name for path in out.iterdir()) == ["a.0000.exr", "other"]
    assert (source / name).exists()
    assert (out / "other" / name).exists()
