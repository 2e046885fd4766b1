"""Scores of images against references of two halves: what is measured is free of the references' own noise."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments.cycles import compare
from experiments.cycles import reference as references
from experiments.cycles.reference import Reference, compress
from experiments.cycles.score import Scored, find_changed, find_edges, score
from experiments.results_page import read_results, readme_block, results_page
from jaxdn.clips import write_exr

SIZE = (96, 128)


def _truth(rng: np.random.Generator) -> np.ndarray:
    """Light with edges, [H, W, 3]."""
    light = np.full((*SIZE, 3), 0.3)
    light[:, 40:] = 1.2
    light[50:70, 20:90] = [0.1, 0.6, 2.0]
    return light * rng.uniform(0.9, 1.1)


def _reference(truth: np.ndarray, deviation: float, rng: np.random.Generator) -> Reference:
    """Two halves whose noise is a share of the light, with guides that have an edge at column 40."""
    halves = [truth * rng.gamma(1 / deviation**2, deviation**2, truth.shape) for _ in range(2)]
    guides = np.zeros((*SIZE, 7))
    guides[..., :3], guides[..., 5], guides[..., 6] = 0.5, 1.0, 4.0
    guides[:, 40:, :3] = 0.2
    return Reference(halves[0], halves[1], guides, 1, 1)


def _mean_square(images: list[np.ndarray], truths: list[np.ndarray]) -> float:
    """Of x / (1 + x)."""
    return float(np.mean([(compress(one) - compress(truth)) ** 2 for one, truth in zip(images, truths, strict=True)]))


def test_scores_do_not_depend_on_the_noise_of_the_reference() -> None:
    rng = np.random.default_rng(0)
    truths = [_truth(rng) for _ in range(8)]
    images = [truth * rng.gamma(1e4, 1e-4, truth.shape) for truth in truths]
    wanted = np.mean(
        [np.mean((compress(image) - compress(truth)) ** 2) for image, truth in zip(images, truths, strict=True)]
    )
    noisy = [_reference(truth, 0.05, rng) for truth in truths]
    own = np.mean(
        [np.mean((compress(held.image) - compress(truth)) ** 2) for held, truth in zip(noisy, truths, strict=True)]
    )
    assert own > 5 * wanted  # a plain error would be that of the reference
    found = score(images, noisy, [None] * 8)
    assert found.error == pytest.approx(wanted, rel=0.15)
    errors = [compress(image) - compress(truth) for image, truth in zip(images, truths, strict=True)]
    changes = np.mean([np.mean((errors[i + 1] - errors[i]) ** 2) for i in range(0, 8, 2)])
    assert found.temporal == pytest.approx(changes, rel=0.2)


def test_edges_and_inside_are_scored_apart() -> None:
    rng = np.random.default_rng(1)
    truth = _truth(rng)
    held = Reference(truth, truth, _reference(truth, 0.05, rng).guides, 1, 1)
    edges = find_edges(held.guides)
    assert edges[:, 39:41].all()
    assert edges.sum() == 2 * SIZE[0]
    image = truth.copy()
    image[:, 39:41] *= 1.5
    found = score([image, image], [held, held], [None, None])
    assert found.inside == 0
    assert found.edges == pytest.approx(np.mean((compress(image) - compress(truth))[:, 39:41] ** 2))
    assert found.temporal == 0


def test_the_trail_of_a_shadow_is_where_the_light_of_a_surface_changes() -> None:
    rng = np.random.default_rng(2)
    guides = _reference(_truth(rng), 0.05, rng).guides
    guides[..., :3] = np.linspace(0.1, 0.9, SIZE[1])[:, None]  # a texture, so that vectors matter
    shifted = np.roll(guides, 3, axis=1)
    light = np.full((*SIZE, 3), 1.0)
    shaded = light.copy()
    shaded[20:40, 60:80] = 0.2
    before, now = Reference(light, light, guides, 1, 1), Reference(shaded, shaded, shifted, 1, 1)
    motion = np.zeros((*SIZE, 2), np.float32)
    motion[..., 0] = -3.0  # previous minus current
    changed = find_changed(before, now, motion)
    assert changed[20:40, 60:80].all()
    assert changed.sum() == 400
    assert not find_changed(before, now, np.full((*SIZE, 2), np.nan, np.float32)).any()
    late = score([light, light], [before, now], [motion, motion])
    assert late.trail == pytest.approx(float((compress(np.array(1.0)) - compress(np.array(0.2))) ** 2), rel=1e-6)
    assert np.isnan(score([light, shaded], [before, before], [motion, motion * 0]).trail)


def test_figures_are_decibels_and_say_what_could_not_be_measured() -> None:
    found = Scored(1e-3, np.nan, 1e-4, 1e-2, np.nan, 0.123456).figures()
    assert found == {"psnr": 30.0, "edges": None, "inside": 40.0, "temporal": 20.0, "trail": None, "flip": 0.12346}


def test_images_must_come_in_pairs() -> None:
    held = _reference(_truth(np.random.default_rng(3)), 0.1, np.random.default_rng(3))
    with pytest.raises(ValueError, match="pairs of frames"):
        score([held.image], [held], [None])


def test_pairs_are_neighbours_and_a_frame_is_in_one_of_them() -> None:
    assert compare._paired([5, 6, 14, 15, 23, 24]) == [5, 6, 14, 15, 23, 24]
    assert compare._paired([1, 3, 4, 5, 6, 9]) == [3, 4, 5, 6]
    assert compare._paired([1, 2, 3]) == [1, 2]


def test_a_folder_without_clips_says_how_to_make_some(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="make cycles"):
        compare.find_done(tmp_path, [])


def write_clip_of_cycles(folder: Path, rng: np.random.Generator) -> None:
    """A clip of four frames of 4 samples, as Cycles names its passes, with references of two of them."""
    truth = np.tile(_truth(rng)[:32, 24:72], (1, 1, 1)).astype(np.float32)
    guides = np.zeros((*truth.shape[:2], 7), np.float32)
    guides[..., :3], guides[..., 5], guides[..., 6] = 0.5, 1.0, 4.0
    (folder / "4spp-0").mkdir(parents=True)
    (folder / "reference").mkdir()
    for number in range(1, 5):
        light = (truth * rng.gamma(4.0, 0.25, truth.shape)).astype(np.float32)
        channels = {f"ViewLayer.Combined.{c}": light[..., i] for i, c in enumerate("RGB")}
        channels |= {f"ViewLayer.Denoising Albedo.{c}": guides[..., i] for i, c in enumerate("RGB")}
        channels |= {f"ViewLayer.Denoising Normal.{c}": guides[..., 3 + i] for i, c in enumerate("XYZ")}
        channels |= {"ViewLayer.Depth.Z": guides[..., 6]}
        channels |= {f"ViewLayer.Vector.{c}": np.zeros_like(guides[..., 0]) for c in "XYZW"}
        write_exr(folder / "4spp-0" / f"{number:04d}.exr", channels)
        if number in (2, 3):
            halves = Reference(truth.astype(float), truth.astype(float), guides.astype(float), 64, 1)
            references.write(folder / "reference" / f"{number:04d}.exr", halves)
    (folder / "cycles.json").write_text('{"kind": "sun", "level": 0}')


def test_sample_counts_of_fewer_frames_are_scored_on_the_pairs_that_they_have(tmp_path: Path) -> None:
    clip = tmp_path / "test" / "sun-9000"
    write_clip_of_cycles(clip, np.random.default_rng(5))
    for spp, frames in ((64, 3), (16, 2)):  # the references are of the frames 2 and 3
        (clip / f"{spp}spp-0").mkdir()
        for number in range(1, frames + 1):
            name = f"{number:04d}.exr"
            (clip / f"{spp}spp-0" / name).write_bytes((clip / "4spp-0" / name).read_bytes())
    assert compare.main(compare.Options(tmp_path / "test", tmp_path / "out", ["noisy"], [4, 16, 64])) == 0
    rows = {row["spp"]: row for row in compare.read_rows(tmp_path / "out", ["sun-9000"])}
    assert rows.keys() == {4, 64}
    assert rows[64]["frames"] == [2, 3]
    assert rows[64]["psnr"] == rows[4]["psnr"]


def test_methods_are_compared_on_files_and_a_second_run_measures_nothing_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_clip_of_cycles(tmp_path / "test" / "sun-9000", np.random.default_rng(4))
    options = compare.Options(tmp_path / "test", tmp_path / "out", ["noisy", "svgf+no-safe"], [4])
    assert compare.main(options) == 0
    first = capsys.readouterr().out
    rows = {row["method"]: row for row in compare.read_rows(tmp_path / "out", ["sun-9000"])}
    assert rows.keys() == {"noisy", "svgf+no-safe"}
    assert rows["svgf+no-safe"]["psnr"] > rows["noisy"]["psnr"] + 3
    assert rows["noisy"]["frames"] == [2, 3]
    assert first.count("sun-9000 4 spp") == 2
    assert len(list((tmp_path / "out/sun-9000/4spp/svgf+no-safe").glob("*.exr"))) == 4
    assert compare.main(options) == 0
    again = capsys.readouterr().out
    assert "sun-9000 4 spp" not in again
    assert "4 samples" in again
    assert "sun" in again
    results = {result["file"]: result for result in read_results(tmp_path / "out")}
    row = results["quality-cycles-test.json"]["rows"][1]
    assert row[:2] == [4, "`svgf+no-safe`"]
    assert row[2] == pytest.approx(rows["svgf+no-safe"]["psnr"], abs=1e-3)
    by_kind = results["quality-cycles-test-kinds.json"]["rows"]
    assert by_kind == [["sun", 4, *(rows[m]["psnr"] for m in options.methods)]]
    page = results_page(list(results.values()))
    assert "1 clip of 1 kind" in page
    assert "Scored: frames 2, 3." in page
    assert "| sun | 4 |" in page
    assert compare.main(replace(options, part="few samples", methods=["noisy"], table=True)) == 0
    results = {result["file"]: result for result in read_results(tmp_path / "out")}
    assert len(results) == 4
    part = results["quality-cycles-test-few-samples.json"]
    assert part["title"] == "Cycles test clips, few samples"
    assert part["command"].endswith("--methods noisy --spp 4 --part 'few samples'")
    assert "readme" in results["quality-cycles-test.json"]
    assert "readme" not in part


def test_the_readme_has_a_few_methods_of_every_sample_count() -> None:
    methods = ["noisy", "combiner-high+no-safe", "combiner-high"]
    figures = dict.fromkeys(compare.FIGURES, 30.0)
    facts = {"clip": "sun-9000", "kind": "sun", "frames": [2, 3], **figures}
    rows = [{"spp": spp, "method": method, **facts} for spp in (1, 4) for method in methods]
    found = compare.means(rows, compare.Options(Path("test"), methods=methods, spp=[1, 4]))
    lines = [line.split("|")[1:3] for line in readme_block([found]).splitlines() if "`" in line and line[0] == "|"]
    shown = [(int(spp), name.strip()) for spp, name in lines]
    assert shown == [(spp, f"`{method}`") for spp in (1, 4) for method in ("noisy", "combiner-high")]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="counts the memory maps that Linux lists")
def test_programs_of_methods_that_are_done_are_let_go(tmp_path: Path) -> None:
    """A process has 65,530 memory maps, and the program of a method takes hundreds."""
    write_clip_of_cycles(tmp_path / "test" / "sun-9000", np.random.default_rng(6))
    maps = []
    for number in range(4):
        compare.main(compare.Options(tmp_path / "test", tmp_path / str(number), ["svgf+no-safe"], [4]))
        maps.append(len(Path("/proc/self/maps").read_text().splitlines()))
    assert maps[-1] - maps[0] < 100
