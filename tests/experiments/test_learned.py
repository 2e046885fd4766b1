"""The tables of the papers on learned denoisers: on one family and after two updates, and from results made up."""

import dataclasses
import json
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.papers.learned import __main__ as learned
from experiments.papers.learned import (
    curves,
    maps,
    ntasd_budgets,
    ntasd_holdout,
    ntasd_methods,
    ntasd_sizes,
    rae_methods,
    scores,
    small_lights,
    stages,
    zeng_ablation,
    zeng_changes,
    zeng_methods,
)
from experiments.papers.learned.record import record_table
from experiments.results_page import read_results, results_page
from jaxdn import denoisers
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Core, Denoiser, recurrent
from jaxdn.evaluation.report import ClipResult, Results, Scores
from jaxdn.methods import registry
from jaxdn.methods.registry import method, method_named
from jaxdn.methods.sampler import Sampling, allocate_samples
from jaxdn.sequence.render_jobs import render
from jaxdn.zoo.ready import find_model


@dataclass(frozen=True)
class Options(Sampling):
    """What stages give their networks."""

    size: str = "small"
    pattern: str = "random"


def weighted(options: Options) -> Denoiser:
    """Three weights, which compile at once: a gain of each channel; samples go to what is bright."""

    def step(params: Any, state: Any, frame: Frame, first: Any, statistics: Any) -> Any:
        image = params["gain"] * jnp.where(first, frame.radiance, 0.5 * (frame.radiance + state))
        return image, image, 0

    def samples(params: Any, state: Any, frame: Frame, first: Any, most: int) -> jax.Array:
        assert frame.albedo is not None
        logits = frame.albedo[..., :1] if options.adaptive else jnp.zeros_like(frame.albedo[..., :1])
        return allocate_samples(options, jnp.where(first, 0.0, logits), most)

    def init(key: jax.Array, frame: Frame) -> Any:
        return {"gain": jnp.ones((1, 1, 3))}

    return recurrent(
        Core(lambda params, frame: frame.radiance, step, frozenset({"albedo", "sample_count"}), init, samples)
    )


@pytest.mark.slow
def test_the_learned_relatives_are_trained_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Which networks they are, other tests say: here all are one of three weights, with the loss of the paper. Windows
    # are no larger than the clips.
    recipe = method_named("ntasd").recipe_named("paper")._replace(crop=64, batch=2)
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))
    method(Options, title="A gain", recipes={"paper": recipe})(weighted)
    cheap = {name: stage._replace(method="weighted") for name, stage in stages.STAGES.items()}
    monkeypatch.setattr(stages, "STAGES", cheap)
    monkeypatch.setattr(stages, "FAMILIES", ("fruit", "parlour"))
    monkeypatch.setattr(ntasd_holdout, "HELD_OUT", ("parlour",))
    # Shipped weights are a row like any other, and take longer to compile than all others.
    monkeypatch.setattr(learned, "REFERENCES", ("noisy", "svgf"))
    monkeypatch.setattr(scores, "NEAR", "taa")
    monkeypatch.setattr(scores, "near", cache(scores.near.__wrapped__))
    # Of each clip, as many frames as give a network a history after its two, and what these methods read.
    monkeypatch.setattr(stages, "render", lambda source, *how, **more: render(source._replace(frames=3), *how, **more))
    monkeypatch.setattr(small_lights, "FRAMES", 3)
    for module in (stages, curves, small_lights):
        monkeypatch.setattr(module, "LAYERS", (1, 2, 4, 8))
        monkeypatch.setattr(module, "COMPARED", "svgf")
    for module in (stages, small_lights):
        monkeypatch.setattr(module, "TRAINED", "svgf")
    seen = ntasd_holdout.SEEN
    rows = (seen, f"{seen}, only parlour", f"{seen}, without parlour")
    lit = stages.stage_of_budget(ntasd_budgets.CHOSEN, 4)
    tables = {
        "ntasd_holdout": ntasd_holdout.TABLE._replace(rows=rows),
        "small": scores.Table("One", ("ntasd",), lambda found: scores.ordinary(found, ["ntasd"]), no_claims),
        "single": scores.Table("Two", ("svgf",), lambda found: scores.ordinary(found, ["svgf"]), no_claims, spp=1),
        "lights": scores.Table(
            "Three", (lit,), lambda found: scores.ordinary(found, [lit]), no_claims, clips="small lights"
        ),
    }
    monkeypatch.setattr(learned, "TABLES", tables)
    monkeypatch.setattr(curves, "FAMILY", "fruit")
    monkeypatch.setattr(zeng_methods, "ROWS", ("ntasd",))
    settings = stages.Settings(
        clips=1, steps=2, frames=2, size=32, data=tmp_path / "data", out=tmp_path / "runs", workers=1, curve_frames=4
    )
    learned.main(settings)
    text = (tmp_path / "runs" / "report.md").read_text()
    for label in ("ntasd", "parlour"):
        assert re.search(rf"\| {label} \| \d", text), text
    assert re.search(r"\| fruit-2000 \| -?\d\.\d\d, \d+ to \d+ \|", text), text
    for name in ("ntasd-samples", "noise", "svgf"):
        assert (tmp_path / "runs" / "pictures" / "fruit-2000" / f"{name}.png").is_file()
    for folder in ("", "1-samples", "small-lights"):
        assert (tmp_path / "runs" / folder / "report.html").is_file()
    assert re.search(r"## Two, 1 sample a pixel\n\n.*\n.*\n\| svgf \| \d", text), text
    assert re.search(rf"## Three, 4 samples a pixel\n\n.*\n.*\n\| {lit} \| \d", text), text
    trained_on = sorted(folder.name for folder in (tmp_path / "data" / "small-lights" / "train").glob("*-*"))
    assert trained_on == [f"small-lights-{seed}" for seed in range(4)]
    record = json.loads((tmp_path / "data" / "small-lights" / "test" / "small-lights-2000" / "clip.json").read_text())
    assert record["light"] == "reflected"
    assert "visible" in record["plan"]["frames"][1], "errors of disoccluded pixels are not reported"
    drawn = json.loads((tmp_path / "runs" / "curves.json").read_text())
    assert [len(drawn["ntasd"][name]) for name in ("ssim", "mse")] == [4, 4]
    assert min(drawn["ntasd"]["mse"]) > 0
    # The page of results takes what is written for it.
    measurements = tmp_path / "runs" / "measurements"
    page = results_page(read_results(measurements))
    assert f"]({curves.PICTURE})" in page
    assert (measurements / curves.PICTURE).is_file()
    assert "### One, 4 samples a pixel" in page
    assert re.search(r"\| `svgf` \| \*\*\d", page), page
    assert "### Zeng et al. 2021, figure 8: 4 frames" in page
    with_it, without = (
        tmp_path / "runs" / each / "weights.safetensors" for each in ("ntasd-uniform", "ntasd-uniform-without-parlour")
    )
    assert with_it.read_bytes() != without.read_bytes(), "the family was not left out"


def test_every_stage_is_a_network_of_its_method() -> None:
    for name, stage in stages.STAGES.items():
        row = method_named(stage.method)
        objective = stage.objective or row.recipe_named(stage.recipe).objective
        assert stages.objective_of(name) == objective.name
        asking = row.factory(**stage.options).samples is not None
        assert asking == row.has_option("budget"), name


def no_claims(_: Results) -> list[scores.Claim]:
    return []


def results_of(**columns: dict[str, float]) -> Results:
    """Two clips with these scores: label -> field -> value, shifted by a little between the clips."""
    image = np.zeros((4, 5, 3))

    def clip(name: str, shift: float) -> ClipResult:
        own: dict[str, Any] = {
            label: {field: value + shift for field, value in given.items()} for label, given in columns.items()
        }
        nothing = dict.fromkeys(Scores._fields[:10], 0.0)
        shown = {label: Scores(**{**nothing, **given}) for label, given in own.items()}
        frames = {label: {"psnr": [20.0 + shift, 21.0 + shift]} for label in columns}
        return ClipResult(name, 40.0, shown, frames, 0, {"reference": image}, np.zeros((4, 5), bool))

    return Results("made up", {}, {}, list(columns), [clip("parlour-2000", -0.5), clip("mobile-2000", 0.5)], {})


def test_claims_hold_or_not_by_the_numbers() -> None:
    rows = {
        label: {"unbiased_relative_mse": 2.0, "unbiased_psnr": 20.0, "unbiased_temporal_psnr": 20.0}
        for label in ntasd_methods.ROWS
    }
    rows["ntasd"] |= {"unbiased_relative_mse": 1.0, "unbiased_temporal_psnr": 19.0}
    rows["rae"] |= {"unbiased_psnr": 18.5}
    claims = {claim.text: claim for claim in ntasd_methods.claims(results_of(**rows))}
    adaptive = claims["adaptive / uniform sampling, relative MSE"]
    assert (adaptive.ours, adaptive.holds) == ("0.50", True)
    assert not claims["NTASD is steadier than DASR, temporal PSNR"].holds
    assert claims["NTASD is better than RAE, PSNR"].ours == "+1.50 dB"
    direct = claims["direct prediction / kernels, single frames, relative MSE"]
    assert (direct.ours, direct.holds) == ("1.00", False)
    rows["single frames, direct"]["unbiased_relative_mse"] = 2.2  # far from the paper's 1.7
    direct = ntasd_methods.claims(results_of(**rows))[2]
    assert (direct.ours, direct.holds) == ("1.10", False)
    text = scores.claims_table(claims.values())
    assert "| NTASD is steadier than DASR, temporal PSNR | above 0 | -1.00 dB | not here |" in text


def test_half_of_the_distance_that_a_paper_found_is_its_finding() -> None:
    psnr = {"svgf": 24.0, zeng_methods.NTASD: 29.8, "trmv": 29.0, zeng_methods.THEIRS: 30.0}
    claims = zeng_methods.claims(results_of(**{label: {"unbiased_psnr": value} for label, value in psnr.items()}))
    assert [(claim.ours, claim.holds) for claim in claims] == [
        ("+6.00 dB", True),
        ("+0.20 dB", False),
        ("+1.00 dB", True),
    ]


def test_a_table_says_what_of_the_training_is_not_alike() -> None:
    found = results_of(**{row: {"unbiased_psnr": 20.0} for row in zeng_methods.ROWS})
    settings = stages.Settings(steps=70, as_published=True, tables=["zeng_methods"])
    what = record_table(zeng_methods.TABLE, found, settings)["what"]
    assert "but for 70 updates on windows of 5 frames" in what
    assert "Adam's rates: `ntasd, uniform, 1 sample` 0.001, `ntd, 1 sample` 0.0001." in what
    assert "`steady-balanced`: shipped weights" in what
    assert "Adam's rates" not in record_table(zeng_methods.TABLE, found, stages.Settings())["what"]


def test_the_loss_of_a_family_is_that_of_its_own_clips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ntasd_holdout, "HELD_OUT", ("parlour", "mobile"))
    seen = ntasd_holdout.SEEN
    psnr = {f"{seen}, only parlour": 29.2, f"{seen}, without parlour": 29.0, f"{seen}, without mobile": 29.6}
    psnr |= {seen: 30.0, f"{seen}, only mobile": 30.4}
    found = results_of(**{label: {"unbiased_psnr": value} for label, value in psnr.items()})
    assert ntasd_holdout.scores(found)["parlour"] == pytest.approx((28.7, 29.5, 28.5))
    assert "| mobile | 30.90 | 30.50 | 30.10 | 0.80 |" in ntasd_holdout.text(found)
    (claim,) = ntasd_holdout.claims(found)
    assert (claim.ours, claim.holds) == ("0.20 to 0.80 dB", False)
    recorded = record_table(ntasd_holdout.TABLE, found, stages.Settings(tables=["ntasd_holdout"]))
    assert recorded["columns"][0] == {"name": "family", "decimals": 2}
    assert recorded["rows"] == [["parlour", 28.7, 29.5, 28.5, 0.2], ["mobile", 30.9, 30.5, 30.1, 0.8]]
    page = results_page([recorded | {"file": "holdout.json"}])
    assert "| mobile | 30.90 | 30.50 | 30.10 | 0.80 |" in page
    _, _, held = page.partition("## What the papers claim")
    assert re.search(r"loses little to a specialised one \| 0.1 to 0.7 dB \| 0.20 to 0.80 dB \| not here \|", held)


def test_the_ladder_is_climbed_step_by_step() -> None:
    psnr = {ntasd_sizes.LARGE: 25.8, ntasd_sizes.UNIFORM_LARGE: 26.5, ntasd_sizes.TENTH: 25.0}
    psnr |= {ntasd_sizes.FEATURES: 24.8, ntasd_sizes.RAE: 24.0}
    psnr |= dict(zip(ntasd_sizes.LADDER, (20, 24, 25, 25), strict=True))
    given = {
        label: {"unbiased_psnr": float(value), "unbiased_temporal_psnr": 25.0, "ms_per_frame": 10.0}
        for label, value in psnr.items()
    }
    claims = {claim.text: claim for claim in ntasd_sizes.claims(results_of(**given))}
    assert claims["kernels in place of colours, single frames, PSNR"].ours == "+4.00 dB"
    assert claims["the last image, PSNR"].ours == "+1.00 dB"
    assert not claims["the last image, temporal PSNR"].holds
    assert not claims["samples where they pay, PSNR"].holds
    better = claims["the large network is better than a tenth of RAE's weights"]
    assert (better.ours, better.holds) == ("+0.80 dB", True)
    # With samplers: 20 + 21 + 1 and 3 + 10 + 1 ms.
    assert claims["and slower"].paper == "3.0 times"
    assert not claims["and slower"].holds  # 10 ms and 10 ms
    assert claims["a tenth of RAE's weights are better than RAE, PSNR"].ours == "+1.00 dB"
    lost = claims["64 features that recur, PSNR"]
    assert (lost.ours, lost.holds) == ("-0.20 dB", True)
    # A third of the paper's 0.6 dB, and four times as much.
    for psnr_of_large, worth in ((25.2, "+0.20 dB"), (27.4, "+2.40 dB")):
        given[ntasd_sizes.LARGE]["unbiased_psnr"] = psnr_of_large
        claim = ntasd_sizes.claims(results_of(**given))[0]
        assert (claim.ours, claim.holds) == (worth, False)


def test_stages_are_what_the_papers_compare() -> None:
    """Single frames have no history and no sampler; each network has the loss of its paper."""
    for row in ntasd_sizes.LADDER[:2]:
        assert stages.STAGES[row].options["history"] == "none"
        assert stages.STAGES[row].options["adaptive"] is False
    assert stages.STAGES[ntasd_sizes.LADDER[2]].options["adaptive"] is False
    assert "adaptive" not in stages.STAGES[ntasd_sizes.LADDER[3]].options
    tenth = method_named("ntasd").factory(**stages.publish(stages.STAGES[ntasd_sizes.TENTH]).options)
    params = jax.eval_shape(lambda: tenth.init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3)))))
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == pytest.approx(2.6e6 / 10, rel=0.01)
    assert stages.STAGES[ntasd_sizes.FEATURES].options == {"memory": 64, **stages.STAGES["ntasd, uniform"].options}
    zeng = {row: stages.STAGES[row] for row in (zeng_methods.THEIRS, zeng_methods.NTASD)}
    assert zeng_methods.TABLE.spp == zeng[zeng_methods.THEIRS].spp == zeng[zeng_methods.NTASD].options["budget"] == 1
    assert stages.objective_of(zeng_methods.NTASD) == "last frames"
    assert stages.objective_of(zeng_methods.THEIRS) == "indirect illumination"
    recipes = [method_named(zeng[row].method).recipe_named(zeng[row].recipe) for row in zeng]
    assert recipes[0].learning_rate == recipes[1].learning_rate
    assert recipes[0].steps == recipes[1].steps
    # RAE as Hasselgren et al. compare it: the albedo is a guide, nothing is divided. As its own paper has it elsewhere.
    compared, own = (stages.publish(stages.STAGES[row]) for row in ("rae", rae_methods.RAE))
    presets = method_named("rae").presets
    for stage, preset, recipe in ((compared, "hasselgren", "hasselgren"), (own, "paper", "paper")):
        expected = dataclasses.replace(presets[preset], size="small")
        assert (method_named("rae").parse_options(stage.options), stage.recipe) == (expected, recipe)
    # One loss for all networks of the table.
    losses = {row: stages.objective_of(row) for row in ntasd_methods.ROWS}
    assert set(losses.values()) == {"", "last frames"}
    assert losses["svgf"] == losses["noisy"] == ""


def test_budgets_compare_what_differs_in_the_place_of_samples_alone() -> None:
    for budget in stages.BUDGETS:
        chosen, uniform = (
            stages.STAGES[stages.stage_of_budget(kind, budget)]
            for kind in (ntasd_budgets.CHOSEN, ntasd_budgets.UNIFORM)
        )
        assert chosen.clips == uniform.clips == ntasd_budgets.TABLE.clips == "small lights"
        assert chosen.options["pattern"] == "rotating"
        placed = {"pattern": "rotating", "least": budget / 2}
        assert uniform.options | placed == chosen.options | {"adaptive": False}
        assert (chosen.options["budget"], uniform.options["least"], chosen.recipe) == (budget, 0, uniform.recipe)
        if budget in stages.ROTATING:
            rotating = stages.STAGES[stages.stage_of_budget(ntasd_budgets.PATTERN, budget)]
            assert rotating.options == uniform.options | {"pattern": "rotating"}


def test_each_budget_has_its_own_ratio() -> None:
    errors = dict.fromkeys(ntasd_budgets.ROWS, 0.04) | {
        "ntasd, 0.25 samples": 0.02,
        "ntasd, rotating, 0.25 samples": 0.08,
    }
    nothing = {"unbiased_psnr": 20.0, "ms_per_frame": 5.0}
    given = {row: {"unbiased_relative_mse": error} | nothing for row, error in errors.items()}
    given[stages.stage_of_budget(ntasd_budgets.CHOSEN, 1.0)]["ms_per_frame"] = 8.0
    found = results_of(**given)
    claims = {claim.text: (claim.paper, claim.ours, claim.holds) for claim in ntasd_budgets.claims(found)}
    assert claims["chosen / uniform, relative MSE, 0.25 samples"] == ("not stated", "0.50", None)
    assert claims["chosen / rotating, relative MSE, 0.25 samples"] == ("not stated", "0.25", None)
    assert claims["rotating / uniform, relative MSE, 0.25 samples"] == ("not stated", "2.00", None)
    assert claims["time of choosing, 1 sample"] == ("not stated", "3.0 ms a frame", None)
    assert claims["time of choosing, 4 samples"] == ("not stated", "0.0 ms a frame", None)
    assert claims["chosen / uniform, relative MSE, 4 samples"] == ("0.66 to 0.75", "1.00", False)
    assert "| 0.25 | 0.50 | 0.25 | +0.00 dB | 0.0 |" in ntasd_budgets.text(found)
    assert ntasd_budgets.TABLE.heading == "Samples where they pay, by budget"


def test_changes_of_ours_are_added_to_the_papers_settings_one_by_one() -> None:
    paper, *single, every = (stages.STAGES[row] for row in zeng_changes.ROWS)
    assert paper.options == {"preset": "paper", "size": "small"}
    assert len(single) == len(stages.CHANGES) == 4
    changed = [set(one.options.items()) ^ set(paper.options.items()) for one in single]
    assert changed == [{("kernels", "guided")}, {("demodulate", "brdf")}, set(), {("initialization", "he")}]
    assert [one.objective is not None for one in (paper, *single, every)] == [False, False, False, True, False, True]
    assert every.options == paper.options | {"kernels": "guided", "demodulate": "brdf", "initialization": "he"}
    assert {one.recipe for one in (paper, *single, every)} == {"paper-loss"}
    assert scores.objective_of(zeng_changes.ALL) != scores.objective_of(zeng_changes.BASE)


def test_as_published_is_the_preset_with_what_a_stage_is_for() -> None:
    for name, stage in stages.STAGES.items():
        row, made = method_named(stage.method), stages.publish(stage)
        options = row.parse_options(made.options)
        assert options == row.parse_options({"preset": stage.preset} | stage.options), name
        assert options.exposure == row.presets["paper"].exposure != row.options().exposure, name
        recipe = row.recipe_named(made.recipe)
        assert (recipe.decay, recipe.clip_norm, recipe.average) == (False, 0.0, 0.0), name
    assert {name for name, stage in stages.STAGES.items() if stage.preset != "paper"} == {"rae"}
    ntd = method_named("ntd")
    recipes = [ntd.recipe_named(stages.publish(stages.STAGES[row]).recipe) for row in zeng_ablation.ROWS]
    assert [recipe.learning_rate for recipe in recipes] == [1e-4, 1e-4, 1e-4]
    assert recipes[0].record() == recipes[1].record() != recipes[2].record()


def test_the_ablation_adds_dual_vectors_and_then_the_loss() -> None:
    a, b, c = (stages.STAGES[row] for row in zeng_ablation.ROWS)
    assert a.options == b.options | {"motion": "traditional"}
    assert b.options == c.options
    assert (a.recipe, c.recipe) == (b.recipe, "paper-loss")
    psnr = dict(zip(zeng_ablation.ROWS, (20.0, 21.0, 20.5), strict=True))
    found = results_of(**{row: {"disoccluded_psnr": value} for row, value in psnr.items()})
    assert [(claim.ours, claim.holds) for claim in zeng_ablation.claims(found)] == [
        ("+1.00 dB", True),
        ("-0.50 dB", False),
    ]
    psnr[zeng_ablation.C] = 21.09
    found = results_of(**{row: {"disoccluded_psnr": value} for row, value in psnr.items()})
    assert [claim.verdict for claim in zeng_ablation.claims(found)] == ["holds", "chance"]


def test_as_published_filters_have_the_presets_of_their_papers() -> None:
    settings = stages.Settings(as_published=True, out=Path("runs"))
    assert stages.ready("svgf", settings).options == {"preset": "paper"}
    assert stages.ready("svgf", stages.Settings()).options == {}
    assert stages.ready("noisy", settings).denoiser is None
    assert settings.results == Path("runs/as-published")


def test_antialiasing_follows_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    before = find_model("svgf")
    monkeypatch.setattr(stages, "trained", lambda name, settings: before._replace(label=name))
    row = f"rae{stages.AFTERWARDS}"
    plain, published = (stages.ready(row, stages.Settings(as_published=wanted)) for wanted in (False, True))
    assert plain.label == published.label == row
    assert plain.denoiser is not None
    assert plain.denoiser is not before.denoiser
    assert plain.denoiser.reads == denoisers.taa(after=denoisers.svgf()).reads
    assert stages.objective_of(row) == stages.objective_of("rae")


def test_errors_of_a_long_clip_are_given_frame_by_frame() -> None:
    values = {"ssim": [0.0, 0.5, 0.7, 0.9, 0.9], "mse": [1.0, 0.25, 0.25, 0.25, 0.25]}
    text = curves.make_table({"svgf": values})
    assert "| method | | frame 2 | frame 5 | mean from 2 on |" in text
    assert "| svgf | SSIM | 0.5000 | 0.9000 | 0.7500 |" in text
    assert "| svgf | MSE | 0.2500 | 0.2500 | 0.2500 |" in text
    with pytest.raises(ValueError, match="--curve-frames: expected at least 2, or 0 for none, got 1"):
        curves.measure_curves(stages.Settings(curve_frames=1))


def test_curves_over_frames_are_means_over_clips() -> None:
    assert "| rae | 20.00 | 21.00 |" in scores.over_frames(results_of(rae={}), ["rae"])


def test_unknown_tables_raise() -> None:
    with pytest.raises(ValueError, match="--tables: expected some of ntasd_methods"):
        learned.main(stages.Settings(tables=["vae"]))


def test_a_family_is_left_out_by_its_name() -> None:
    folders = [Path("data") / name for name in ("robot-0", "robot-1", "fruit-0", "robots-0")]
    one = stages.Stage("ntasd", {})
    assert [folder.name for folder in stages.clips_of(one._replace(without="robot"), folders)] == [
        "fruit-0",
        "robots-0",
    ]
    own = stages.clips_of(one._replace(only="robot"), folders)
    assert [folder.name for folder in own] == ["robot-0", "robot-1"]
    assert stages.clips_of(one, folders) == folders


def test_ranks_correlate_whatever_their_scale(rng: np.random.Generator) -> None:
    values = rng.normal(size=(20, 20))
    assert maps.correlation(values, np.exp(3 * values)) == pytest.approx(1)
    assert maps.correlation(values, -values) == pytest.approx(-1)
    assert abs(maps.correlation(values, rng.normal(size=(20, 20)))) < 0.2


def test_counts_that_are_nearly_even_correlate_by_those_that_are_not() -> None:
    """Equal counts in the order of their pixels would correlate with everything that brightens from top to bottom."""
    slope = np.arange(400.0).reshape(20, 20)
    assert np.isnan(maps.correlation(np.full((20, 20), 4.0), slope))
    counts = np.full((20, 20), 4.0)
    counts[0, 0], counts[-1, -1] = 5, 3
    assert maps.correlation(counts, slope) == pytest.approx(-0.12, abs=0.01)
