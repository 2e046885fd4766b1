"""The table of rooms of our own renderer: clips of several seeds in, scores and a file of results out."""

from pathlib import Path

import numpy as np
import pytest

from experiments.cycles import rooms
from experiments.cycles.compare import FIGURES
from experiments.results_page import read_results
from jaxdn import clips
from jaxdn.core.frame import Clip, Frame

SIZE, FRAMES, SAMPLES = (32, 48), 4, 64
LAMP = 0.5
"""The lamp's emitted light, in every pixel of its columns."""


def make_clip(folder: Path, seed: int) -> None:
    """A wall of light 1, its right half a dark lamp; noise of one sample has the deviation of the light."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    wall = np.ones((*SIZE, 3), np.float32)
    wall[:, SIZE[1] // 2 :] = 0.0
    emission = LAMP * (1 - wall)
    guides = {"albedo": 0.5 * np.ones_like(wall), "normal": np.ones_like(wall) * [0, 0, 1], "emission": emission}

    def light(samples: int) -> np.ndarray:
        return wall * rng.gamma(samples, 1 / samples, wall.shape)

    for index in range(FRAMES):
        layers = {count: light(count) for count in (1, 4)}
        halves = [light(SAMPLES // 2) for _ in range(2)]
        still = np.zeros((*SIZE, 2), np.float32)
        clips.write_frame(
            clips.frame_path(folder, index),
            Frame(layers[1], depth=2 * wall[..., :1] + 1, motion=still, **guides),
            layers=layers,
            layer_guides=dict.fromkeys(layers, guides),
            reference=(halves[0] + halves[1]) / 2,
            reference_half=halves[0],
            reference_guides=guides,
        )
    size = {"frames": FRAMES, "width": SIZE[1], "height": SIZE[0], "layers": [1, 4]}
    clips.finish_record({**size, "reference_spp": SAMPLES, "pixel_filter": "box"}, folder)


@pytest.mark.slow
def test_rooms_are_scored_against_the_references_of_all_seeds(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for seed in range(3):
        make_clip(tmp_path / "rooms" / f"hall-{seed}", seed)
    options = rooms.Options(tmp_path / "rooms", tmp_path / "out", ["noisy", "svgf+no-safe"], [4])
    assert rooms.main(options) == 0
    first = capsys.readouterr().out
    assert f"references of {3 * SAMPLES} samples" in first
    assert first.count("hall 4 spp") == 2
    held = rooms.read_references(sorted((tmp_path / "rooms").iterdir()))
    assert np.mean([one.image[:, -5:] for one in held]) == pytest.approx(LAMP, abs=1e-3)  # emitted light is in it
    assert np.std(held[0].image[:, :20]) == pytest.approx((3 * SAMPLES) ** -0.5, rel=0.1)
    (result,) = read_results(tmp_path / "out")
    noisy, filtered = result["rows"]
    names = [column["name"] for column in result["columns"]]
    assert names[-1] == "PSNR, hall"
    # x / (1 + x) of x = 1 with deviation 1/2 in half of the pixels.
    light = np.random.default_rng(9).gamma(4, 1 / 4, 100_000)
    wanted = -10 * np.log10(np.mean((light / (1 + light) - 0.5) ** 2) / 2)
    assert noisy[names.index("PSNR")] == pytest.approx(wanted, abs=0.2)
    assert filtered[names.index("PSNR, hall")] > noisy[names.index("PSNR, hall")] + 6
    assert rooms.main(options) == 0
    assert "hall 4 spp" not in capsys.readouterr().out  # a second run measures nothing again


def test_a_folder_without_rooms_and_clips_through_centres_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--seeds 0"):
        rooms.find_rooms(tmp_path, ["hall"])
    plain = Frame(np.ones((1, *SIZE, 3), np.float32))
    clips.write_clip(Clip(plain), tmp_path / "hall-0")
    with pytest.raises(ValueError, match="filtered pixels and a reference"):
        rooms.read_references([tmp_path / "hall-0"])


def test_rooms_whose_names_begin_alike_are_two(tmp_path: Path) -> None:
    for name in ("living-room-0", "living-room-2-0", "living-room-1"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "clip.json").write_text("{}")
    found = {room: [clip.name for clip in clips] for room, clips in rooms.find_rooms(tmp_path, []).items()}
    assert found == {"living-room": ["living-room-0", "living-room-1"], "living-room-2": ["living-room-2-0"]}


def test_the_table_names_the_rooms_that_were_trained_on() -> None:
    figures = dict.fromkeys(FIGURES, 30.0)
    rows = [{"clip": room, "kind": room, "spp": 4, "method": "noisy", **figures} for room in ("kitchen", "staircase2")]
    options = rooms.Options(Path("rooms"), methods=["noisy"], spp=[4])
    assert "trained on kitchen;" in rooms.table(rows, options)["what"]
    assert "trained on" not in rooms.table(rows[1:], options)["what"]
