"""``jaxdn render``: scenes are opened and planned once, and the clips match the options."""

import json
from dataclasses import replace

import pytest

from experiments.speed.small_rooms import CASES
from jaxdn.clips import ClipError
from jaxdn.commands import main
from jaxdn.core.frame import OF_SAMPLES
from jaxdn.data.clip.folder import is_clip, read_record
from jaxdn.render.clip import render_clip
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence import render_jobs as command

SETTINGS = RenderSettings(width=24, height=16, reference_spp=2)


def render(source, out, settings=SETTINGS, **options):
    return command.render(command.ClipSource(str(source), **{"frames": 2, **options}), out, settings, workers=2)


@pytest.fixture
def counted(monkeypatch):
    """The opened and planned scenes, and the jobs that would be rendered."""
    seen = {"opened": 0, "planned": 0, "jobs": []}

    def count(name, what):
        function = getattr(command, name)

        def counting(*arguments, **options):
            seen[what] += 1
            return function(*arguments, **options)

        monkeypatch.setattr(command, name, counting)

    count("SceneFile", "opened")
    count("open_family", "opened")
    count("inspect", "planned")
    monkeypatch.setattr(command, "render_clips", lambda jobs, **options: seen["jobs"].extend(jobs) or [])
    return seen


@pytest.mark.slow
def test_a_scene_file_is_opened_and_planned_once_for_all_seeds(counted, tmp_path, capsys):
    path = CASES["moving: ball"].write(tmp_path)
    render(path, tmp_path / "out", seeds=[3, 5, 8])
    assert (counted["opened"], counted["planned"]) == (1, 1)
    jobs = counted["jobs"]
    name = tmp_path.name
    assert [job.settings.seed for job in jobs] == [3, 5, 8]
    assert [job.folder for job in jobs] == [str(tmp_path / "out" / f"{name}-{seed}") for seed in (3, 5, 8)]
    assert all(job.settings.plan == jobs[0].settings.plan for job in jobs)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("rendering with Mitsuba's ")
    found = "object-motion, disocclusion, indirect, moving-shadow; paths of depth 6"
    assert lines[1:] == [f"{name}-{seed}: {found}" for seed in (3, 5, 8)]


@pytest.mark.slow
def test_every_seed_of_a_family_is_a_different_scene(counted, tmp_path):
    render("fruit", tmp_path, seeds=[0, 1])
    assert (counted["opened"], counted["planned"]) == (2, 2)
    assert [job.scene for job in counted["jobs"]] == [{"family": "fruit", "seed": seed} for seed in (0, 1)]


@pytest.mark.parametrize(("effects", "planned"), [("all", False), ("indirect, glossy", True)])
def test_chosen_effects_are_planned_and_no_others(counted, tmp_path, effects, planned):
    render("fruit", tmp_path, effects=effects)
    assert counted["planned"] == planned
    plan = counted["jobs"][0].settings.plan
    assert (None if plan is None else plan.effects) == (("indirect", "glossy") if planned else None)


@pytest.mark.parametrize(("case", "shared"), [("moving: ball", (0, 1)), ("static grey box", (0, 0))])
def test_frames_are_shared_where_nothing_changes_whatever_is_chosen(counted, tmp_path, case, shared):
    render(CASES[case].write(tmp_path), tmp_path / "out", effects="indirect")
    assert counted["jobs"][0].settings.plan.shared_with == shared


@pytest.mark.needs("llvm")
@pytest.mark.parametrize("effects", ["all", "indirect, specular"])
def test_samples_keep_their_buffers_where_nothing_forbids_it(counted, tmp_path, capsys, effects):
    path = CASES["static grey box"].write(tmp_path)
    render(path, tmp_path / "out", effects=effects, denoiser="relax")
    assert {"specular", "specular_hit_distance"} <= set(counted["jobs"][0].settings.plan.frames[0])
    said = capsys.readouterr().out
    assert "left out" not in said
    assert f"paths of depth {SceneFile(path).max_depth}" in said


@pytest.mark.needs("llvm")
@pytest.mark.parametrize("effects", ["auto", "all", "specular"])
@pytest.mark.parametrize(
    ("optics", "why"),
    [({"fog": {"density": 0.1, "albedo": [0.9, 0.9, 0.9]}}, "in fog"), ({"shutter": 0.5}, "a shutter")],
)
def test_buffers_that_fog_or_a_shutter_forbids_are_said(counted, tmp_path, capsys, optics, why, effects):
    path, animation = CASES["a ball: rough metal"].write(tmp_path), tmp_path / "optics.json"
    animation.write_text(json.dumps({"frames": 2, **optics}))
    filtered = replace(SETTINGS, pixel_filter="blackman-harris", max_depth=3)
    render(path, tmp_path / "out", filtered, effects=effects, denoiser="relax", animation=animation)
    assert not OF_SAMPLES & set(counted["jobs"][0].settings.plan.buffers)
    lines = [line for line in capsys.readouterr().out.splitlines() if why in line]
    assert len(lines) == 1
    assert "there is no " in lines[0]
    assert "specular, specular_hit_distance: left out" in lines[0]


@pytest.mark.parametrize("reference_spp", [0, 4])
def test_what_errors_are_reported_by_is_rendered_with_the_reference_alone(counted, tmp_path, reference_spp):
    path = CASES["moving: ball"].write(tmp_path)
    render(path, tmp_path / "out", replace(SETTINGS, reference_spp=reference_spp), denoiser="taa")
    buffers = counted["jobs"][0].settings.plan.frames[1]
    assert "motion" in buffers
    assert ("visible" in buffers) == (reference_spp > 0)


def test_an_invalid_scene_is_refused_at_once(tmp_path, capsys):
    with pytest.raises(ValueError, match=r"'castle': expected a family \(dash, .*\) or a Mitsuba scene"):
        render("castle", tmp_path)
    assert capsys.readouterr().out == ""


def test_an_animation_of_a_family_is_refused_and_not_ignored(tmp_path):
    with pytest.raises(ValueError, match="expected none for the family 'fruit'"):
        render("fruit", tmp_path / "out", animation=tmp_path / "walk.json")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_clips_are_rendered(tmp_path):
    path = CASES["static grey box"].write(tmp_path)
    folders = render(path, tmp_path / "out", seeds=[0, 1])
    assert all(is_clip(folder) for folder in folders)
    assert [read_record(folder)["seed"] for folder in folders] == [0, 1]


@pytest.mark.parametrize("verb", [["inspect", "edge"], ["render", "edge", "-o", "{out}"]])
@pytest.mark.parametrize("option", ["--width", "--height", "--frames"])
def test_an_empty_size_is_refused_in_words(verb, option, tmp_path, capsys):
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main.main([*(word.format(out=out) for word in verb), option, "0"])
    assert ended.value.code == 2
    assert f"{option[2:]}: expected at least 1, got 0" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [("--reference-spp", "-1", "reference_spp: expected 0 (no reference) or at least 2, got -1"),
     ("--layers", "3", "layers: expected different powers of two"),
     ("--draws", "-1", "draws: expected 0 or more")],
)  # fmt: skip
def test_sample_counts_out_of_range_are_refused_before_planning(option, value, told, counted, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["render", "edge", "-o", str(tmp_path / "out"), option, value])
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
    assert (counted["opened"], counted["planned"]) == (0, 0)


def planned_clip(scene, folder, frames, seed=1, max_depth=3):
    settings = RenderSettings(width=16, height=12, seed=seed, max_depth=max_depth)
    planned = command.plan_clip(scene, settings, frames=frames)
    render_clip(scene, folder, replace(settings, plan=planned.plan), frames=frames)


@pytest.mark.slow
def test_a_clip_gets_more_frames_and_other_settings_are_said_in_words(tmp_path):
    path = CASES["moving: ball"].write(tmp_path)
    scene = SceneFile(path)
    planned_clip(scene, tmp_path / "clip", 2)
    first = (tmp_path / "clip" / "frame_0001.exr").read_bytes()
    planned_clip(scene, tmp_path / "clip", 3)
    assert read_record(tmp_path / "clip")["frames"] == len(read_record(tmp_path / "clip")["plan"]["frames"]) == 3
    assert (tmp_path / "clip" / "frame_0001.exr").read_bytes() == first
    with pytest.raises(ClipError) as refused:
        planned_clip(scene, tmp_path / "clip", 4, seed=2, max_depth=5)
    assert "3 frames there, 4 wanted; max_depth: 3 there, 5 wanted; seed: 1 there, 2 wanted" in str(refused.value)
    assert "{" not in str(refused.value)
    static = SceneFile.from_record({**scene.record, "animation": {"frames": 4}})
    with pytest.raises(ClipError, match=r"buffers of frame 0: .*motion.* there, no more wanted.*animation"):
        planned_clip(static, tmp_path / "clip", 4)


@pytest.mark.parametrize("name", ["x.exr", "x.onnx", "x.mlir", "x.stablehlo"])
@pytest.mark.parametrize("words", [["render", "edge"], ["train", "clips"], ["compare", "clips"], ["export", "svgf"]])
def test_a_folder_is_not_named_like_a_file(words, name, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main([*words, "-o", str(tmp_path / name)])
    assert ended.value.code == 2
    assert "expected a folder" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_folder_is_no_file_that_is_there(tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    with pytest.raises(SystemExit) as ended:
        main.main(["render", "edge", "-o", str(tmp_path / "taken")])
    assert ended.value.code == 2
    assert "expected a folder, got the name of a file" in capsys.readouterr().err
