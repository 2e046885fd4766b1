"""Checkpoints with any file truncated, emptied, deleted or with a flipped bit: the previous one is restored."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.training.checkpoint import Checkpoints
from jaxdn.training.step import TrainState


def state(step, *, width=3000):
    params = {"a": {"w": jnp.arange(float(width)) * step, "b": jnp.ones(3)}}
    return TrainState(params, params, {"m": jnp.full(7, float(step))}, jnp.int32(step), jnp.int32(0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder with the checkpoints after 3 and 6 updates."""
    folder = tmp_path_factory.mktemp("whole") / "checkpoints"
    kept = Checkpoints(folder)
    for step in (3, 6):
        kept.save(state(step), {"position": step})
    kept.close()
    return folder


def restored(folder, like=None):
    kept = Checkpoints(folder)
    try:
        return kept.restore(state(0) if like is None else like)
    finally:
        kept.close()


def damaged_copies(whole, place, how):
    """The folder once for each file of the newest checkpoint, with that file damaged."""
    files = sorted(path.relative_to(whole) for path in (whole / "6").rglob("*") if path.is_file())
    for index, file in enumerate(files):
        copy = place / f"{how}-{index}" / "checkpoints"
        shutil.copytree(whole, copy)
        data = bytearray((copy / file).read_bytes())
        if how == "lost":
            (copy / file).unlink()
            yield file, copy
            continue
        if how == "flipped":
            data[len(data) // 2] ^= 16
        (copy / file).write_bytes(data if how == "flipped" else data[: len(data) // 2] if how == "torn" else b"")
        yield file, copy


@pytest.mark.filterwarnings("ignore:checkpoint", "ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("how", ["torn", "empty", "lost", "flipped"])
def test_a_damaged_file_never_restores_other_values(whole, tmp_path, how):
    steps = []
    for file, folder in damaged_copies(whole, tmp_path, how):
        found = restored(folder)
        assert found is not None, file
        step = int(found[0].step)
        jax.tree.map(np.testing.assert_array_equal, found[0], state(step))
        assert found[1] == {"position": step}, file
        assert (folder.parent / "damaged-6").is_dir() == (step == 3)
        steps.append(step)
    assert set(steps) == {3, 6}, "some files are redundant, others are not"


def torn(whole, folder, *steps):
    """A copy in which the largest file, which holds the arrays, of some checkpoints is cut in half."""
    shutil.copytree(whole, folder)
    for step in steps:
        largest = max((folder / str(step)).rglob("*"), key=lambda path: path.stat().st_size if path.is_file() else 0)
        largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    return folder


def test_a_truncated_checkpoint_gives_a_warning_and_the_previous_one_is_restored(whole, tmp_path):
    folder = torn(whole, tmp_path / "checkpoints", 6)
    kept = Checkpoints(folder)
    with pytest.warns(UserWarning, match=r"6 is damaged .* moved to .*damaged-6; .* after 3 updates"):
        found = kept.restore(state(0))
    assert int(found[0].step) == 3
    kept.save(state(6), {"position": 6})
    kept.close()
    found, position = restored(folder)
    jax.tree.map(np.testing.assert_array_equal, found, state(6))
    assert position == {"position": 6}


def test_unreadable_checkpoints_raise_and_are_kept(whole, tmp_path):
    folder = torn(whole, tmp_path / "checkpoints", 3, 6)
    with pytest.raises(ValueError, match=r"none of the checkpoints \(3, 6\).*delete the folder"):
        restored(folder)
    assert sorted(path.name for path in folder.iterdir() if path.name.isdecimal()) == ["3", "6"]


def test_the_checkpoints_of_another_network_are_refused_and_kept(whole, tmp_path):
    folder = torn(whole, tmp_path / "checkpoints")
    with pytest.raises(ValueError, match="give the run another name"):
        restored(folder, like=state(0, width=3001))
    assert (folder / "6").is_dir()


def test_a_run_without_checkpoints_has_none(tmp_path):
    assert restored(tmp_path / "checkpoints") is None
