"""The chart: resuming after an interruption, the Pareto front, equal quality, the page; the whole chart is slow."""

import json
import math
import re
import sys
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro

from experiments.results_page import results_page
from experiments.speed.chart import __main__ as chart
from experiments.speed.chart import render_cost, stacks
from experiments.speed.chart.breakdown import WHOLE, breakdown, subjects
from experiments.speed.chart.energy import find_meter
from experiments.speed.chart.footage import EvaluationClip, noisy_frames
from experiments.speed.chart.page import page
from experiments.speed.chart.record import Measured, record_front
from experiments.speed.chart.render_cost import Cost, fit, mean_cost, measure_cost
from experiments.speed.chart.scores import MEASURES, score
from experiments.speed.chart.store import Store, point_key
from experiments.speed.chart.summary import (
    RENDERER,
    Point,
    equal_quality,
    equal_samples,
    front_table,
    headline,
    pareto,
    points,
)
from experiments.speed.chart.way import way
from experiments.speed.chart.ways import chosen, left_out, registered, select_ways, ways
from experiments.speed.timing import Timing
from experiments.speed.works import scene
from experiments.speed.works.stages import measure_stages
from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.denoiser import Core, recurrent
from jaxdn.denoiser.rollout import denoise
from jaxdn.methods import registry
from jaxdn.methods.registry import method, method_named, methods
from jaxdn.networks.backends import BACKENDS
from jaxdn.render import scene_from_record
from jaxdn.zoo import ready
from jaxdn.zoo.ready import Model, find_model, untrained_model

SIZE, OWN = "1280x720", "64x64"
MOTION = "albedo, motion, normal"
PSNR = MEASURES[0]
TIMING = {"median_ms": 30.0, "min_ms": 29.0, "max_ms": 33.0, "first_ms": 4000.0, "rounds": 3, "peak_mib": 100.0}


def point(name, spp, psnr, milliseconds, family="a"):
    errors = {measure.field: psnr if measure.better > 0 else 1 / psnr for measure in MEASURES}
    return Point(point_key(name, spp), name, family, "plain", "", spp, errors, {SIZE: milliseconds}, {SIZE: 10.0 * spp})


def scores(psnr):
    return {measure.field: psnr if measure.better > 0 else 1 / psnr for measure in MEASURES}


@pytest.fixture
def data():
    """Raw measurements as a run stores them."""
    errors = {point_key(RENDERER, spp): {"room": scores(20 + 3 * math.log2(spp))} for spp in (1, 2, 4, 8)}
    errors |= {point_key("filter", spp): {"room": scores(24.5 + 3 * math.log2(spp))} for spp in (1, 2)}
    cost = {
        "seconds": {
            "fixed": 0.1,
            "sample": 0.5,
            "buffers": {"": 0.0, "albedo, normal": 0.05, MOTION: 0.25},
            "sparse": {},
        }
    }
    return {
        "fingerprint": "0123",
        "settings": {"scored frames": 4},
        "machine": {"processor": "a <fast> one"},
        "clips": {"room": {"shown": 3, "noise_floor": 45.0, "hidden": 0.1}},
        "errors": errors,
        "times": {"filter": {SIZE: TIMING, OWN: TIMING}, "wide net": {SIZE: TIMING}},
        "render": {SIZE: {"room": cost}, OWN: {"room": cost}},
        "breakdown": {},
        "stages": {
            "filter": {
                "reads": MOTION,
                "stages": {"starting": 2000.0, "reading": 60.0, "denoising": 500.0, "writing": 240.0},
            }
        },
        "left_out": {"here": ["A peer is not installed."]},
    }


LABELS = {
    RENDERER: (RENDERER, "plain", ""),
    "filter": ("filter", "plain", MOTION),
    "wide net": ("untrained widths", "untrained", MOTION),
}


def test_the_file_is_complete_after_every_point_and_resumes(tmp_path):
    path = tmp_path / "runs" / "chart.json"
    store = Store(path, {"frames": 4}, {"cores": 2})
    assert not store.kept
    store.put("errors", "a @ 1", {"room": {"psnr": np.float32(20), "disoccluded_psnr": math.nan}})
    assert json.loads(path.read_text())["errors"]["a @ 1"]["room"] == {"psnr": 20.0, "disoccluded_psnr": None}
    again = Store(path, {"frames": 4}, {"cores": 2})
    assert again.kept
    assert again.has("errors", "a @ 1")
    assert not again.has("errors", "a @ 2")
    assert [each.name for each in path.parent.iterdir()] == ["chart.json"]


def test_other_settings_or_another_machine_start_over_and_keep_the_old_file(tmp_path):
    path = tmp_path / "chart.json"
    Store(path, {"frames": 4}, {"cores": 2}).put("errors", "a @ 1", {})
    other = Store(path, {"frames": 4}, {"cores": 64})
    assert not other.kept
    assert not other.has("errors", "a @ 1")
    assert "a @ 1" in json.loads((tmp_path / "chart.before.json").read_text())["errors"]


def test_the_front_has_the_points_that_nothing_else_beats(rng):
    cloud = [
        point(f"m{index}", 1, float(psnr), float(ms)) for index, (psnr, ms) in enumerate(rng.uniform(1, 40, (60, 2)))
    ]
    front = pareto(cloud, PSNR, SIZE, render=True)
    for each in cloud:
        time, psnr = each.milliseconds(SIZE, render=True), each.errors["psnr"]
        beaten = any(other.milliseconds(SIZE, render=True) <= time and other.errors["psnr"] > psnr for other in cloud)
        assert (each in front) == (not beaten)
    assert [each.milliseconds(SIZE, render=True) for each in front] == sorted(
        each.milliseconds(SIZE, render=True) for each in front
    )
    assert pareto(cloud, MEASURES[2], SIZE) == front  # of an error that is lower where PSNR is higher


def test_equal_samples_agree_with_a_line_in_the_logarithm():
    spp = 2.0 ** np.arange(11)
    curve = {int(n): float(18 + 2.7 * np.log2(n)) for n in spp}
    for psnr in np.linspace(18, 45, 50):
        expected = 2 ** np.interp(psnr, list(curve.values()), np.log2(spp))
        assert equal_samples(psnr, curve) == pytest.approx(expected)
    assert equal_samples(17.9, curve) == 0
    assert equal_samples(45.1, curve) == math.inf


def test_a_dip_in_the_curve_counts_for_fewer_samples():
    assert equal_samples(25, {1: 20.0, 2: 26.0, 4: 24.0, 8: 30.0}) == pytest.approx(2 ** (5 / 6))


def test_equal_quality_gives_samples_and_seconds(data):
    found = points(data, LABELS)
    equals = equal_quality(found, Cost(0.1, 0.5, {}))
    assert equals["filter @ 1"].spp == pytest.approx(2**1.5)
    assert equals["filter @ 1"].seconds == pytest.approx(0.1 + 0.5 * 2**1.5)
    assert set(equals) == {"filter @ 1", "filter @ 2"}
    text = front_table(pareto(found, PSNR, SIZE), equals, SIZE, 8, headline(found))
    assert "3 spp, 1.5 s" in text


def test_the_chart_is_read_without_the_noise_of_the_references_where_every_clip_tells(data):
    found = points(data, LABELS)
    assert [each.field for each in headline(found)] == ["unbiased_psnr", "unbiased_temporal_psnr"]
    data["errors"]["filter @ 1"]["room"]["unbiased_psnr"] = None  # NaN, as it is stored
    found = points(data, LABELS)
    assert [each.field for each in headline(found)] == ["psnr", "temporal_psnr"]
    # A reference of 45 dB: the renderer saturates there in plain PSNR, not without that noise.
    for spp in (1, 2, 4, 8):
        data["errors"][point_key(RENDERER, spp)]["room"]["psnr"] = 25.0
    data["errors"]["filter @ 1"]["room"]["unbiased_psnr"] = 24.5
    equals = equal_quality(points(data, LABELS), None)
    assert equals["filter @ 1"].spp == pytest.approx(2**1.5)


@pytest.mark.slow
def test_a_clip_without_halves_has_no_unbiased_errors(rng):
    clip = rng.exponential(0.3, (6, 8, 9, 3)).astype(np.float32)
    noise = [(clip * rng.gamma(50, 1 / 50, clip.shape)).astype(np.float32) for _ in range(2)]
    footage = EvaluationClip(
        "", None, {}, None, {}, (noise[0] + noise[1]) / 2, None, np.zeros((6, 8, 9, 1), bool), 3, 30.0
    )
    plain, known = score(clip, footage), score(clip, footage._replace(halves=tuple(noise)))
    unbiased = [measure.field for measure in MEASURES if measure.field.startswith("unbiased")]
    assert len(unbiased) == 4
    assert all(math.isnan(plain[field]) for field in unbiased)
    assert plain["psnr"] == known["psnr"]
    assert known["unbiased_psnr"] > plain["psnr"] + 3
    assert known["unbiased_mse"] < plain["mse"] / 2
    assert known["unbiased_relative_mse"] < plain["relative_mse"] / 2
    assert known["unbiased_temporal_psnr"] > plain["temporal_psnr"] + 3


def test_points_include_the_time_of_rendering_their_input(data):
    by_key = {each.key: each for each in points(data, LABELS)}
    assert by_key["renderer @ 4"].milliseconds(SIZE, render=True) == pytest.approx(2100)
    assert by_key["filter @ 2"].milliseconds(SIZE, render=True) == pytest.approx(30 + 1350)
    assert by_key["filter @ 2"].milliseconds(SIZE, render=False) == pytest.approx(30)
    assert by_key["wide net"].spp is None
    assert by_key["wide net"].milliseconds(SIZE, render=True) == pytest.approx(30 + 850)


def test_the_page_has_every_point_and_needs_no_network(data):
    found = points(data, LABELS)
    shown = {key: np.full((8, 8, 3), 0.5) for key in ("reference", *data["errors"])}
    text = page(data, found, equal_quality(found, None), (SIZE, OWN), {"room": shown})
    content = json.loads(re.search(r'id="page-data">(.*?)</script>', text, re.S)[1])
    assert [each["key"] for each in content["points"]] == [each.key for each in found]
    assert set(content["pictures"]["room"]) == set(shown)
    table = text[text.index('<section id="points">') :]
    table = table[: table.index("</section>")]
    assert table.count('<th scope="row">') == len(found)
    assert "a &lt;fast&gt; one" in text
    assert "A peer is not installed." in text
    assert not re.search(r'(src|href)="(https?:)?//', text)


def test_stacked_times_go_from_the_scene_to_the_file(data):
    first, steady = stacks.stacks(data, SIZE)
    assert first.name == "filter, first frame"
    assert list(first.parts) == ["rendering", "buffers", "starting", "reading", "denoising", "writing"]
    assert first.parts["rendering"] == pytest.approx(600)
    assert first.parts["buffers"] == pytest.approx(250)
    assert steady.total == pytest.approx(600 + 250 + 60 + 500 + 240)
    assert first.total == pytest.approx(steady.total + 2000)
    widths = [float(found) for found in re.findall(r'<rect [^>]*width="([\d.]+)"', stacks.draw([first, steady]))]
    assert sum(widths[6:]) / sum(widths[:6]) == pytest.approx(steady.total / first.total, abs=1e-3)
    text = page(data, points(data, LABELS), {}, (SIZE, OWN), {"room": {"reference": np.full((8, 8, 3), 0.5)}})
    assert "<td>3650</td>" in text
    data["render"] = {}
    assert list(stacks.stacks(data, SIZE)[1].parts) == ["reading", "denoising", "writing"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="what a child process took is only known on Unix")
@pytest.mark.usefixtures("plain_processes")
def test_stages_are_those_of_real_files():
    taken = measure_stages("taa", (32, 48), frames=3)
    assert all(ms > 0 for ms in taken)
    assert taken.starting > taken.reading + taken.denoising + taken.writing


def test_the_front_is_recorded_for_the_page_of_results(data):
    data["errors"][point_key("filter", 0.5)] = {"room": scores(23)}
    for costs in data["render"][SIZE].values():
        costs["seconds"]["sparse"] = {"0.5": 0.2}
    found = points(data, LABELS)
    front, quality = pareto(found, PSNR, SIZE), headline(found)
    recorded = record_front(front, equal_quality(found, None), quality, Measured(1, OWN, SIZE, 8, ["filter"]))
    assert recorded["command"] == "python -m experiments.speed.chart --methods filter"
    rows = {(row[0], row[1]): row[2:] for row in recorded["rows"]}
    assert rows["`filter`", "0.5"][:3] == [(30 + 200 + 250), 30, 23.0]
    assert rows["the renderer alone", "8"][1] is None
    page = results_page([recorded | {"file": "front.json"}])
    assert "| `filter` | 0.5 | 480 | 30 |" in page


def test_rows_that_are_not_there_are_told(denoisers):
    listed = list(registered(denoisers))
    assert [each.name for each in select_ways(listed, [listed[1].name])] == [listed[1].name]
    assert select_ways(listed, []) == listed
    with pytest.raises(ValueError, match="got nothing such"):
        select_ways(listed, ["nothing such"])


def test_the_fit_gives_back_the_cost():
    cost = Cost(0.3, 0.2, {"albedo": 0.05, "albedo, motion": 0.1}, {"0.25": 0.4})
    light = {spp: cost.at(spp) for spp in (1, 2, 4)}
    found = fit(light, {reads: cost.at(1, reads) - cost.at(1) for reads in cost.buffers}, cost.sparse)
    assert found[:2] == pytest.approx(cost[:2])
    assert found.buffers == pytest.approx(cost.buffers)
    assert found.at(0.25, "albedo") == pytest.approx(0.45)  # as it was measured, not on the line of whole samples
    assert mean_cost([found._asdict(), found._asdict()]) == found


@pytest.mark.slow
def test_frames_with_gaps_are_rendered_to_know_their_cost():
    stage = scene_from_record({"family": "fruit", "seed": 3})
    found = measure_cost(stage, 96, 128, ["albedo"], ["albedo"], None)["seconds"]
    assert set(found["sparse"]) == {"0.25", "0.5"}
    assert all(seconds > 0 for seconds in found["sparse"].values())


def test_a_point_below_one_sample_has_the_cost_of_its_frames_with_gaps(data):
    data["errors"][point_key("filter", 0.5)] = {"room": scores(23)}
    for costs in data["render"][SIZE].values():
        costs["seconds"]["sparse"] = {"0.5": 0.2}
    found = {each.key: each for each in points(data, LABELS)}["filter @ 0.5"]
    assert found.spp == 0.5
    reads = LABELS["filter"][2]
    buffers = next(iter(data["render"][SIZE].values()))["seconds"]["buffers"][reads]
    assert found.render_ms[SIZE] == pytest.approx(1e3 * (0.2 + buffers))


def test_frames_below_one_sample_have_one_in_some_pixels(rng):
    noisy = rng.random((4, 8, 12, 3)).astype(np.float32)
    clip = EvaluationClip("room", None, {}, Frame(noisy), {1: noisy, 2: noisy + 1}, noisy, None, noisy, 0, 50.0)
    frames = noisy_frames(clip, 0.25)
    np.testing.assert_array_equal(frames.sample_count.sum(axis=0), 1)  # each pixel once in four frames
    np.testing.assert_array_equal(frames.radiance, np.where(frames.sample_count > 0, noisy, 0))
    np.testing.assert_array_equal(noisy_frames(clip, 2).radiance, noisy + 1)


def test_energy_counters_wrap(tmp_path):
    assert find_meter(tmp_path) is None
    zone = tmp_path / "intel-rapl:0"
    zone.mkdir()
    (zone / "energy_uj").write_text("9000000\n")
    (zone / "max_energy_range_uj").write_text("10000000\n")
    assert find_meter(tmp_path).joules(lambda: (zone / "energy_uj").write_text("1500000\n")) == pytest.approx(2.5)


@pytest.fixture(scope="module")
def denoisers():
    return chosen()


@pytest.mark.slow
def test_every_registered_method_is_there_with_its_variants(denoisers):
    listed = ways(denoisers)
    found = {each.name: each for each in listed}
    assert len(found) == len(listed)
    for name in ("svgf", "ntd-large", "ntd-small"):
        assert found[name].images is not None
        assert f"{name}, not demodulated" in found
        assert found[f"{name}, effects all"].images is not None
        assert found[f"{name}, still scene"].images is None
        assert "motion" in found[name].reads
        assert "luminance_gradient" not in found[name].reads, "it would be charged for what it does not read"
    assert ("ntd-large, onnxruntime" in found) == BACKENDS["onnxruntime"].available()
    assert found["ntd tiny"].images is None
    assert {each.method.name for each in denoisers} == set(methods()) - {"ntasd", "dasr"}
    told = " ".join(left_out())
    assert all(f"{name} requests samples" in told for name in ("ntasd", "dasr"))


@pytest.mark.slow
def test_quick_measures_the_fastest_of_each_method():
    found = [each.name for each in ways(chosen(quick=True), quick=True)]
    assert {"svgf", "ntd-small"} <= set(found)
    assert "ntd-large" not in found
    assert not [name for name in found if "," in name]


def entered(monkeypatch, factory, name, **columns):
    """A method in the table during one test."""
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    factory.__name__ = name
    return method(NoOptions, title=name, **columns)(factory)


@dataclass(frozen=True)
class NoOptions:
    """None."""


def mean_of_two(samples=None):
    """A denoiser that averages with the frame before, times a gain."""

    def step(params, state, frame, first, statistics):
        image = params["gain"] * jnp.where(first, frame.radiance, 0.5 * (frame.radiance + state))
        return image, image, 0

    def init(key, frame):
        return {"gain": jnp.ones(())}

    return recurrent(Core(lambda params, frame: frame.radiance, step, frozenset(), init, samples))


def test_a_new_method_without_weights_is_only_timed(monkeypatch):
    recipe = method_named("ntd").recipe_named(None)
    entered(monkeypatch, lambda options: mean_of_two(), "newcomer", recipes={"usual": recipe})
    denoisers = [each for each in chosen() if each.label == "newcomer"]
    found = {each.name: each for each in registered(denoisers)}
    assert set(found) == {"newcomer", "newcomer, effects all", "newcomer, still scene"}
    assert all(each.images is None and each.reads == "" for each in found.values())
    frame = frame_at(scene.clip(1, 16, 32).frames, 0)
    np.testing.assert_array_equal(found["newcomer"].timed(frame)(), frame.radiance)
    assert list(subjects(denoisers)) == []


def test_images_are_those_of_a_clip_without_history():
    """The same frames twice: nothing of the first run is left in the second."""
    denoiser = mean_of_two()
    frames = scene.clip(3, 16, 32).frames
    images = way(Model("newcomer", denoiser, {"gain": jnp.ones(())})).images
    found = images(frames)
    np.testing.assert_allclose(found, denoise(denoiser, {"gain": 1.0}, Clip(frames)), rtol=1e-6)
    np.testing.assert_array_equal(images(frames), found)


def test_methods_that_request_samples_are_left_out_with_a_message(monkeypatch):
    def samples(params, state, frame):
        return jnp.ones_like(frame.radiance[..., :1])

    entered(monkeypatch, lambda options: mean_of_two(samples), "sampler")
    assert not [each for each in chosen() if each.label == "sampler"]
    assert [sentence for sentence in left_out() if sentence.startswith("sampler requests samples from the renderer")]


@pytest.mark.slow
def test_steps_with_known_parts_are_broken_down(denoisers):
    names = [subject.name for subject in subjects(denoisers, quick=True)]
    assert names == ["ntd-large, reference", "ntd-small, reference"]
    tiny = {"size": ((4,), (4,), (5,), (5,), (6,))}
    assert not list(subjects([untrained_model(method_named("ntd"), **tiny, prediction="direct")]))
    subject = next(subjects([untrained_model(method_named("ntd"), **tiny)]))
    parts = breakdown(subject, frame_at(scene.clip(2, 16, 32).frames, 1), rounds=2)
    assert list(parts)[-1] == WHOLE
    assert len(parts) == 5


def number_of_programs():
    """Compiled by XLA, in this process, not yet forgotten."""
    return len(jax.local_devices()[0].client.live_executables())


@pytest.mark.slow
@pytest.mark.needs("mitsuba")
def test_a_quick_chart_and_resuming_it(tmp_path, monkeypatch, capsys):
    """From the command line to the page, of a filter, shipped weights and new ones: others differ in their step.

    The parts of a step are those of a test of their own.
    """
    recipe = method_named("ntd").recipe_named(None)
    entered(monkeypatch, lambda options: mean_of_two(), "newcomer", recipes={"usual": recipe})
    drawn = [find_model("taa"), find_model("ntd-small"), untrained_model(method_named("newcomer"))]
    monkeypatch.setattr(ready, "all_models", lambda: drawn)
    monkeypatch.setattr(render_cost, "ROUNDS", 2)
    monkeypatch.setattr(chart, "breakdown", lambda subject, frame, rounds: {WHOLE: Timing(1.0, 1.0, 1.0, 1.0, rounds)})
    programs, breakdowns = [], chart.Run.breakdowns
    monkeypatch.setattr(chart.Run, "breakdowns", lambda run: (programs.append(number_of_programs()), breakdowns(run)))
    out = tmp_path / "chart-quick"
    settings = tyro.cli(chart.Settings, args=["--quick", "--out", str(out)])
    chart.main(settings)
    assert "bare renderer needs" in capsys.readouterr().out
    raw = json.loads((out / "chart.json").read_text())
    assert {f"ntd-small @ {spp}" for spp in (1, 2, 4, 8)} <= set(raw["errors"])
    assert {"renderer @ 1", "renderer @ 16"} <= set(raw["errors"])
    assert set(raw["times"]) == {"taa", "ntd-small", "newcomer"}
    assert not [point for point in raw["errors"] if point.startswith("newcomer")]
    assert set(raw["breakdown"]) == {"ntd-small, reference"}
    assert (out / "chart.html").is_file()
    assert programs[0] < 20, "programs of all methods together are more than a process may hold"
    chart.main(settings)
    assert "resuming the earlier measurements" in capsys.readouterr().out
    assert json.loads((out / "chart.json").read_text()) == raw
