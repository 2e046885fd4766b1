"""What choices in training bring: every row changes one thing, and clips in another form are what they are called."""

from pathlib import Path

import numpy as np
import pytest

from experiments.papers.learning import BRANCHES, LADDER, Settings, main, rows
from experiments.papers.other_clips import every_other, half_reference, three_of_four, without_draws
from experiments.papers.weights import STAGES
from jaxdn import clips
from jaxdn.clips.cache import open_cached
from jaxdn.clips.noise_floor import read_halves
from jaxdn.frame import Frame
from jaxdn.methods.table import method_named
from jaxdn.weights import shipped_names


def test_every_row_changes_its_own_and_what_it_stands_on():
    found = rows()
    assert list(found) == [row.name for row in (*LADDER, *BRANCHES)]
    method = method_named("ntd")
    for row, options, recipe in found.values():
        method.made(options)  # raises if an option does not exist
        recipe.check()
        assert not row.on or row.on in found
        assert options.items() >= dict(row.options).items()
    last, first = found[LADDER[-1].name], found[LADDER[0].name]
    assert found["materials seen"][1] == last[1] | {"guides": "materials"}
    assert found["as in version 0.1, for the time of guided kernels"][1:] == first[1:]


def test_stages_of_the_shipped_weights_exist():
    named = [stage.name for stage in STAGES]
    assert set(shipped_names()) <= set(named)
    for stage in STAGES:
        method = method_named(stage.method)
        method.made(stage.options)
        method.recipe_named(stage.recipe)
        assert not stage.start or stage.start in named[: named.index(stage.name)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three clips: reference 0.2, its first half 0.1, two draws."""
    for number in range(3):
        home, flat = tmp_path / "clips" / f"room-{number}", np.ones((8, 8, 3), np.float32)
        home.mkdir(parents=True)
        light = {"reference": 0.2 * flat, "reference_half": 0.1 * flat, "draws": np.ones((2, 8, 8, 6), np.float32)}
        clips.write_frame(clips.frame_path(home, 0), Frame(0.5 * flat), layers={1: 0.5 * flat}, **light)
        record = {"frames": 1, "width": 8, "height": 8, "layers": [1], "draws": 2, "reference_spp": 32}
        clips.finish_record(record, home)
    return tmp_path / "clips"


def test_clips_in_another_form(folder: Path, tmp_path: Path):
    without_draws(folder, tmp_path / "still")
    still = open_cached(tmp_path / "still" / "room-0")
    assert (still.draws, still.half_spp) == (0, 16)
    half_reference(folder, tmp_path / "half")
    half = open_cached(tmp_path / "half" / "room-1")
    assert (half.draws, half.reference_spp, half.half_spp) == (2, 16, 0)
    assert read_halves(half.path) is None
    np.testing.assert_allclose(clips.read_clip(half.path).reference, 0.1, rtol=1e-3)
    every_other(folder, tmp_path / "fewer")
    assert [clip.name for clip in clips.find_clips(tmp_path / "fewer")] == ["room-0", "room-2"]
    three_of_four(folder, tmp_path / "most")
    assert [clip.name for clip in clips.find_clips(tmp_path / "most")] == ["room-1", "room-2"]


def test_unknown_rows_are_named(folder: Path):
    with pytest.raises(ValueError, match=r"--rows: expected some of .*guided kernels.*; got guided kernel"):
        main(Settings(folder, folder, folder, rows=["guided kernel"]))
