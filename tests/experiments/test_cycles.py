"""Clips of Cycles: which may be made, in which order, how references and their noise are reckoned. Without Blender."""

import itertools
import os
import stat
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from experiments.cycles import reference
from experiments.cycles.levels import SOME, TRAIN_CLIPS_BETWEEN, Step, levels, steps
from experiments.cycles.record import RECORD, done, read_record, write_record
from experiments.cycles.reference import Reference
from experiments.cycles.sets import HELD_OUT, KINDS, LARGE, SEEDS, WINDOW, clip, kinds_of, rounds

ROOT = Path(__file__).parents[2]
SETS = ("train", "validation", "test")


def test_every_kind_is_a_module_and_every_module_a_kind() -> None:
    modules = {path.stem for path in (ROOT / "experiments/cycles/kinds").glob("*.py")} - {"__init__"}
    assert modules == set(KINDS)
    assert len(KINDS) == len(set(KINDS)) >= 14


def test_no_seed_is_in_two_sets() -> None:
    for one, other in itertools.combinations(SETS, 2):
        assert not set(SEEDS[one]) & set(SEEDS[other])
    assert set(LARGE) < set(SEEDS["test"])


@pytest.mark.parametrize("name", ["train", "validation"])
@pytest.mark.parametrize("kind", HELD_OUT)
def test_held_out_kinds_are_refused_outside_the_test_set(name: str, kind: str) -> None:
    assert kind not in kinds_of(name)
    assert kind in kinds_of("test")
    with pytest.raises(ValueError, match="for tests only"):
        clip(name, kind, SEEDS[name].start)
    with pytest.raises(ValueError, match="for tests only"):
        list(steps((name,), (kind,)))


@pytest.mark.parametrize("name", SETS)
def test_seeds_of_other_sets_are_refused(name: str) -> None:
    for other in set(SETS) - {name}:
        with pytest.raises(ValueError, match=f"seeds of the {name} set are"):
            clip(name, "lamps", SEEDS[other].start)


def test_unknown_kinds_and_sets_are_refused() -> None:
    with pytest.raises(ValueError, match="expected a kind"):
        clip("test", "teapot", 9000)
    with pytest.raises(ValueError, match="expected a set"):
        clip("exam", "lamps", 9000)


def test_both_pixel_filters_have_half_of_every_round_and_of_every_kind() -> None:
    row = next(rounds("test", KINDS))
    assert Counter(one.pixel_filter[0] for one in row) == {"BOX": 8, "BLACKMAN_HARRIS": 8}
    for kind in KINDS:
        filters = Counter(clip("test", kind, seed).pixel_filter for seed in range(9000, 9010))
        assert filters == {("BOX", 1.0): 5, ("BLACKMAN_HARRIS", 1.5): 5}


def test_training_clips_are_windows_at_places_of_their_own_inside_the_picture() -> None:
    clips = [clip("train", "sun", seed) for seed in range(60)]
    for one in clips:
        assert (one.window.width, one.window.height) == WINDOW
        assert 0 <= one.window.left <= one.size[0] - WINDOW[0]
        assert 0 <= one.window.top <= one.size[1] - WINDOW[1]
        assert one.window == clip("train", "sun", one.seed).window
    assert len({one.window for one in clips}) > 50
    assert 15 < sum(one.size == (640, 360) for one in clips) < 45
    assert clip("test", "sun", 9000).window == (0, 0, 320, 180)


def test_the_first_steps_are_one_clip_of_each_kind_of_each_set() -> None:
    first = list(itertools.islice(steps(SETS), 16 + 14 + 14))
    assert [step.clip.set for step in first] == ["test"] * 16 + ["train"] * 14 + ["validation"] * 14
    assert [step.clip.kind for step in first[:16]] == list(KINDS)
    assert {step.level for step in first} == {0}
    assert not {step.clip.kind for step in first[16:]} & set(HELD_OUT)


def test_any_prefix_of_the_training_set_is_balanced() -> None:
    counts: Counter[str] = Counter(dict.fromkeys(kinds_of("train"), 0))
    for step in itertools.islice((step for step in steps(SETS) if step.clip.set == "train"), 200):
        counts[step.clip.kind] += 1
        assert max(counts.values()) - min(counts.values()) <= 1
        assert step.clip.seed in SEEDS["train"]


def test_the_test_set_is_refined_between_training_clips() -> None:
    later = list(itertools.islice(steps(SETS), 44, 44 + 10 * (TRAIN_CLIPS_BETWEEN + 1)))
    others = [i for i, step in enumerate(later) if step.clip.set != "train"]
    assert others == [TRAIN_CLIPS_BETWEEN + i * (TRAIN_CLIPS_BETWEEN + 1) for i in range(10)]
    assert [later[i] for i in others] == [Step(clip("test", kind, 9000), 1) for kind in KINDS[:10]]


def test_steps_of_given_kinds_and_seeds_end() -> None:
    assert list(steps(("train",), ("sun", "fog"), range(3, 5))) == [
        Step(clip("train", kind, seed), 0) for seed in (3, 4) for kind in ("sun", "fog")
    ]
    levels_of_one = [(step.clip.seed, step.level) for step in steps(("test",), ("sun",), range(9000, 9001))]
    assert levels_of_one == [(9000, 0), (9000, 1), (9000, 2), (9000, 3)]
    large = list(steps(("test",), ("sun",), range(9900, 9901)))
    assert [step.level for step in large] == [0, 1, 2]
    assert large[0].clip.size == (1280, 720)


def test_a_step_has_all_that_the_step_before_it_has() -> None:
    for of in (clip("test", "sun", 9000), clip("test", "sun", LARGE.start), clip("train", "sun", 0)):
        for before, after in itertools.pairwise(levels(of)):
            now = {draw.samples: draw for draw in after.draws}
            for draw in before.draws:
                assert draw.images <= now[draw.samples].images
                assert draw.frames <= now[draw.samples].frames
            assert not after.reference_frames or set(before.reference_frames) <= set(after.reference_frames)
            assert after.decibels >= before.decibels
        assert all(frame <= of.frames for level in levels(of) for frame in level.reference_frames)
    assert all(b - a == 1 for a, b in zip(SOME[::2], SOME[1::2], strict=True))


def _drawn(truth: np.ndarray, deviation: np.ndarray, samples: int, rng: np.random.Generator) -> Reference:
    """Two halves of unbiased renders of ``samples`` samples, each sample with a deviation."""
    a, b = (truth + deviation / np.sqrt(samples) * rng.normal(size=truth.shape) for _ in range(2))
    return Reference(a, b, np.zeros((*truth.shape[:2], 7)), samples, 1)


def test_the_noise_of_a_reference_is_the_error_that_it_has() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.05, 4.0, (120, 160, 3))
    drawn = _drawn(truth, 0.05 * truth, 16, rng)
    actual = np.mean((drawn.image / (1 + drawn.image) - truth / (1 + truth)) ** 2)
    assert reference.noise(drawn) == pytest.approx(actual, rel=0.05)


def test_a_firefly_in_one_half_is_not_hidden() -> None:
    truth = np.full((40, 40, 3), 0.5)
    a = truth.copy()
    a[7, 9] = 1000.0
    held = Reference(a, truth, np.zeros((40, 40, 7)), 16, 1)
    actual = np.mean((held.image / (1 + held.image) - truth / (1 + truth)) ** 2)
    assert reference.noise(held) == pytest.approx(actual, rel=1e-6)


def test_added_references_weigh_by_their_samples() -> None:
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.1, 1.0, (8, 9, 3))
    one, other = _drawn(truth, truth, 4, rng), _drawn(truth, truth, 12, rng)
    both = one + other
    np.testing.assert_allclose(both.first, (4 * one.first + 12 * other.first) / 16, rtol=1e-12)
    np.testing.assert_allclose(both.image, (4 * one.image + 12 * other.image) / 16, rtol=1e-12)
    assert (both.samples, both.draws) == (16, 2)


def test_refining_reaches_its_target_with_hardly_more_samples_than_it_needs() -> None:
    rng = np.random.default_rng(2)
    truth = rng.uniform(0.05, 2.0, (60, 80, 3))
    deviation = 0.6 * truth
    held = _drawn(truth, deviation, 16, rng)
    while count := reference.more_samples(held, 50.0, 1e9, 1.0):
        held = held + _drawn(truth, deviation, count, rng)
    assert 49.8 < reference.decibels(reference.noise(held)) < 50.6
    assert reference.more_samples(held, 45.0, 1e9, 1.0) == 0


def test_refining_stops_when_its_time_is_spent() -> None:
    rng = np.random.default_rng(3)
    held = _drawn(np.ones((20, 20, 3)), np.ones((20, 20, 3)), 16, rng)
    assert reference.more_samples(held, 80.0, 10.0, 4.0) == 24  # 4 s bought 16, 6 s buy 24
    assert reference.more_samples(held, 80.0, 10.0, 10.0) == 0
    assert reference.more_samples(held, 80.0, 1e9, 4.0) == 16 * 16


def test_a_reference_file_keeps_image_and_halves(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    held = _drawn(rng.uniform(0, 3, (9, 16, 3)), np.full((9, 16, 3), 0.1), 24, rng)
    held = held._replace(guides=rng.uniform(-1, 1, (9, 16, 7)), draws=3)
    reference.write(tmp_path / "0001.exr", held)
    back = reference.read(tmp_path / "0001.exr")
    np.testing.assert_array_equal(back.image.astype(np.float32), held.image.astype(np.float32))
    np.testing.assert_allclose(back.first - back.second, held.first - held.second, atol=1e-6, rtol=1e-3)
    np.testing.assert_array_equal(back.guides, held.guides.astype(np.float32).astype(np.float64))
    assert (back.samples, back.draws) == (24, 3)


def _finish(folder: Path, step: Step) -> None:
    path = folder / step.clip.set / step.clip.name / RECORD
    path.parent.mkdir(parents=True, exist_ok=True)
    held = Reference(np.ones((2, 2, 3)), np.full((2, 2, 3), 1.01), np.zeros((2, 2, 7)), 8, 1)
    write_record(path, step.clip, step.level, {5: held}, {"1spp-0": [1.0, 3.0]}, {"blender": "5.0.1"})


def test_a_record_says_what_a_clip_is_and_keeps_earlier_times(tmp_path: Path) -> None:
    one = clip("test", "ball", 9003)
    _finish(tmp_path, Step(one, 0))
    path = tmp_path / "test" / one.name / RECORD
    record = read_record(path)
    assert record is not None
    assert (record["kind"], record["seed"], record["resolution"]) == ("ball", 9003, [320, 180])
    assert record["references"]["5"]["samples"] == 16
    assert record["reference_noise_db"] == pytest.approx(-10 * np.log10((1.005 / 2.005 - 0.5) ** 2), abs=0.01)
    assert done(path, 0)
    assert not done(path, 1)
    assert [child.name for child in path.parent.iterdir()] == [RECORD]


def _command(folder: Path, python: Path, *more: str) -> subprocess.CompletedProcess[str]:
    arguments = [
        sys.executable,
        "-m",
        "experiments.cycles",
        "render",
        "-o",
        str(folder),
        "--python",
        str(python),
        *more,
    ]
    return subprocess.run(
        arguments, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )


def test_a_run_skips_what_is_done_and_goes_on_after_a_failure(tmp_path: Path) -> None:
    log = tmp_path / "log"
    broken = tmp_path / "python"
    broken.write_text(f'#!/bin/sh\necho "$5 $6 $7" >> {log}\nexit 3\n')
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    clips = tmp_path / "clips"
    _finish(clips, Step(clip("train", "sun", 3), 0))
    ran = _command(clips, broken, "--set", "train", "--kinds", "sun", "fog", "--seeds", "3-4")
    assert ran.returncode == 1
    assert log.read_text().splitlines() == ["fog 3 0", "sun 4 0", "fog 4 0"]
    assert ran.stdout.count("FAILED, exit code 3") == 3


def test_the_command_line_refuses_what_must_not_be_trained_on(tmp_path: Path) -> None:
    ran = _command(tmp_path, Path("/bin/false"), "--set", "train", "--kinds", "leaves")
    assert ran.returncode == 2
    assert "error: clips of the kind 'leaves' are for tests only" in ran.stderr
    assert "Traceback" not in ran.stderr
    ran = _command(tmp_path, Path("/bin/false"), "--set", "train", "--seeds", "9000-9001")
    assert ran.returncode == 2
    assert "seeds of the train set are 0 to 7999, got 9000" in ran.stderr
    assert not any(tmp_path.iterdir())
