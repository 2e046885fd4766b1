"""What choices in training bring: every row changes one thing, and clips in another form are what they are called."""

import contextlib
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.papers import choices, learning
from experiments.papers.equal_time import Settings, folder_name, run
from experiments.papers.other_clips import every_other, half_reference, three_of_four, without_draws
from experiments.papers.weights import STAGES
from jaxdn import clips
from jaxdn.core.frame import Clip, Frame
from jaxdn.data.clip.noise_floor import read_halves
from jaxdn.data.training.cache import open_cached
from jaxdn.denoiser.rollout import denoise
from jaxdn.methods.registry import method_named
from jaxdn.zoo.weights import shipped_names


@pytest.mark.parametrize("study", [learning.study, choices.study])
def test_every_row_changes_its_own_and_what_it_stands_on(study):
    found, method = study().resolved(), method_named(study().method)
    assert list(found) == [row.name for row in study().rows]  # no name twice, nothing before what it stands on
    for row, options, recipe in found.values():
        method.made(options)  # raises if an option does not exist
        recipe.check()
        assert folder_name(row.name) == Path(folder_name(row.name)).name
        assert options.items() >= dict(row.options).items()
        assert recipe == recipe._replace(**row.recipe, decay=False)
        # One noisy image is one of 1 sample, and there is no other to add to it.
        assert row.clips is not without_draws or recipe.spp == (1,)
    assert [row.name for row in study().rows if not row.on] == [study().rows[0].name]


def test_rows_of_ntd_are_a_ladder_and_its_branches():
    found = learning.study().resolved()
    last = found[learning.LADDER[-1].name]
    taken = {"kernels": "guided", "background": "pass", "initialization": "he", "exposure": "measured"}
    assert last[1] == {"size": "small", **taken}
    assert found["materials seen"][1] == last[1] | {"guides": "materials"}
    assert found["materials seen"][2] == last[2]


def _image(clip: Clip) -> np.ndarray:
    denoiser = method_named("steady").factory(quality="balanced")
    params = denoiser.init(jax.random.key(0), jax.tree.map(lambda buffer: buffer[0], clip.frames))
    keys = jax.random.key(1)
    params = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys, jnp.shape(x)), params)
    return np.asarray(denoise(denoiser, params, clip))


@pytest.fixture(scope="module")
def clip() -> Clip:
    """Three frames of two walls, one behind the other, that vary a little, the last in three times the light."""
    rng = np.random.default_rng(0)
    sizes = {"radiance": 3, "albedo": 3, "reflectance": 3, "normal": 3, "roughness": 1, "depth": 1, "motion": 2}
    buffers = {name: rng.random((3, 32, 32, size), np.float32) for name, size in sizes.items()}
    for name in ("albedo", "normal", "roughness"):
        buffers[name] = 0.5 + 0.1 * buffers[name]
    buffers["reflectance"] = np.minimum(buffers["albedo"] + 0.3 * buffers["reflectance"], 1.0)
    buffers["depth"], buffers["motion"] = 2.0 + 0.01 * buffers["depth"], 4.0 * buffers["motion"] - 2.0
    buffers["depth"][:, :, 16:] += 2.0
    buffers["radiance"][:, ::7, ::5] *= 50.0
    buffers["radiance"][2] *= 3.0
    return Clip(Frame(**{name: jnp.asarray(buffer) for name, buffer in buffers.items()}), None)


@pytest.fixture(scope="module")
def as_it_is(clip: Clip) -> np.ndarray:
    return _image(clip)


_REPLACED = {row.name: row for row in choices.DESIGN if row.change is not contextlib.nullcontext}


@pytest.mark.slow  # a program for every row
@pytest.mark.parametrize("name", _REPLACED)
def test_what_a_row_replaces_in_steady_changes_its_image(name: str, clip: Clip, as_it_is: np.ndarray):
    with _REPLACED[name].change():
        found = _image(clip)
    assert np.isfinite(found).all()
    # A program of another shape differs by its rounding, some millionths.
    assert np.abs(found - as_it_is).max() > 1e-3 * np.median(as_it_is)


@pytest.mark.slow
def test_nothing_replaced_is_left_behind(clip: Clip, as_it_is: np.ndarray):
    for row in _REPLACED.values():
        with row.change():
            pass
    np.testing.assert_array_equal(_image(clip), as_it_is)


@pytest.mark.slow  # trains two networks, each in a process of its own
def test_rows_are_trained_for_as_long_scored_and_not_trained_again(folder: Path, tmp_path: Path, capsys):
    wanted = ["as in version 0.1", "guided kernels"]
    settings = Settings(folder, [folder], minutes=0.02, crop=8, batch=1, frames=2, rows=wanted, out=tmp_path / "runs")
    run(learning.study, settings)
    first = capsys.readouterr().out
    lines = [line.split(" | ") for line in first.splitlines() if line.startswith("| ")]
    assert [line[0].strip("| ") for line in lines[1:]] == wanted
    assert [int(line[2]) > 1 for line in lines[1:]] == [True, True]
    scores = json.loads((tmp_path / "runs" / "guided-kernels" / "scores.json").read_text())
    assert scores["seconds"] >= 1.2
    assert list(scores["scores"]) == ["clips"]
    assert list(scores["scores"]["clips"]) == ["1"]
    written = (tmp_path / "runs" / "guided-kernels" / "weights.safetensors").stat().st_mtime_ns
    run(learning.study, settings)
    assert (tmp_path / "runs" / "guided-kernels" / "weights.safetensors").stat().st_mtime_ns == written
    settings.minutes = 1.0
    with pytest.raises(ValueError, match=r"'minutes': 1.0.*'minutes': 0.02.*another --out"):
        run(learning.study, settings)


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
    """Three clips of two frames: reference 0.2, its first half 0.1, two draws, twice as bright in the second frame."""
    for number in range(3):
        home, flat = tmp_path / "clips" / f"room-{number}", np.ones((8, 8, 3), np.float32)
        home.mkdir(parents=True)
        for index in range(2):
            draws = np.full((2, 8, 8, 6), 1.0 + index, np.float32)
            light = {"reference": 0.2 * flat, "reference_half": 0.1 * flat, "draws": draws}
            clips.write_frame(clips.frame_path(home, index), Frame(0.5 * flat), layers={1: 0.5 * flat}, **light)
        record = {"frames": 2, "width": 8, "height": 8, "layers": [1], "draws": 2, "reference_spp": 32}
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
        run(learning.study, Settings(folder, [folder], rows=["guided kernel"]))
