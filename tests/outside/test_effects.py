"""Effects are found exactly, planned as data, and what a scene lacks is neither rendered nor stored nor compiled."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

import jaxdn
from experiments.speed.small_rooms import CASES, FRAMES
from jaxdn import effects
from jaxdn.effects import EFFECTS, Facts, Light, Moment, Surface
from jaxdn.frame import Frame

SIZE = {"width": 24, "height": 16}


@pytest.mark.parametrize("name", CASES)
def test_just_the_effects_that_a_scene_has_are_found(name, tmp_path):
    case = CASES[name]
    found = effects.inspect(case.write(tmp_path), **SIZE)
    assert set(found) == case.effects, found.why
    assert set(found.uncertain) == case.uncertain


def test_effects_are_found_per_frame(tmp_path):
    found = effects.inspect(CASES["moving: ball, later"].write(tmp_path), **SIZE)
    moving = ["object-motion" in frame for frame in found.frames]
    assert moving == [False, False, True, True]
    assert found.held == (0, 0, 2, 3)


def test_the_first_frame_has_the_motion_of_the_second(tmp_path):
    # Nothing has moved yet, but a step compiled for one frame alone would cost more than it saves.
    found = effects.inspect(CASES["moving: ball"].write(tmp_path), **SIZE)
    assert "object-motion" in found.frames[0]
    assert effects.plan(found).programs() == 1


def test_two_sets_of_effects_are_two_programs(tmp_path):
    found = effects.inspect(CASES["moving: ball, later"].write(tmp_path), **SIZE)
    assert effects.plan(found).programs() == 2
    assert effects.plan(found).programs(frozenset({"albedo"})) == 1


def test_a_loaded_scene_is_inspected_with_its_animation(tmp_path):
    from jaxdn.render.variant import use_variant

    use_variant()
    import mitsuba as mi

    case = CASES["moving: ball"]
    path = case.write(tmp_path)
    scene = mi.load_file(str(path), optimize=False)
    assert set(effects.inspect(scene, {"frames": FRAMES, **case.animation}, **SIZE)) == case.effects
    assert set(effects.inspect(scene, path.with_suffix(".json"), **SIZE)) == case.effects
    assert set(effects.inspect(scene, **SIZE)) == {"indirect"}


def test_an_animation_that_rests_does_not_tremble(tmp_path):
    from jaxdn.render.scene_file import SceneFile

    scene = SceneFile(CASES["moving: nothing moves"].write(tmp_path))
    poses = [scene.pose(frame)["ball"] for frame in (0, 0.3, 1, 2, 3)]
    cameras = [scene.camera(frame).to_world for frame in (0, 0.3, 1, 2, 3)]
    assert all(np.array_equal(poses[0], pose) for pose in poses)
    assert all(np.array_equal(cameras[0], camera) for camera in cameras)


def test_what_is_uncertain_counts_as_present():
    facts = Facts((Surface("wall"),), (Light("lamp"),), (Moment(),), uncertain={"glossy": "who knows"})
    found = effects.inspect(facts)
    assert "glossy" in found
    assert found.uncertain["glossy"] == "who knows"
    assert "roughness" in effects.plan(found).buffers


def test_a_new_effect_needs_no_change_of_the_planner(monkeypatch):
    # A later method reads a buffer that moving shadows produce: the planner takes it from the data.
    taught = tuple(
        effect._replace(buffers=effect.buffers | {"ids", "gradient"}) if effect.name == "moving-shadow" else effect
        for effect in EFFECTS
    )
    monkeypatch.setattr(effects.planning, "EFFECTS", taught)
    found = effects.chosen(["moving-shadow"], 2)
    reader = jaxdn.denoisers.svgf()._replace(reads=frozenset({"gradient"}))
    assert effects.plan(found, reader).gradient_samples
    assert not effects.plan(found, jaxdn.denoisers.svgf()).gradient_samples


def test_a_plan_is_what_the_scene_has_and_the_denoiser_reads():
    found = effects.chosen(["camera-motion", "disocclusion", "glossy", "indirect"], 3)
    svgf, ntd = jaxdn.denoisers.svgf(), jaxdn.denoisers.ntd(size="small")
    assert effects.plan(found, svgf).motion == "traditional"
    assert effects.plan(found, ntd).motion == "dual"
    assert "roughness" not in effects.plan(found, svgf).buffers
    assert "roughness" in effects.plan(found).buffers
    assert set(effects.plan(found, ntd).buffers) <= ntd.reads | {"direct", "emission"}


def test_a_plan_survives_its_record():
    made = effects.plan(effects.chosen(["glossy", "indirect"], 3), max_depth=5, bound=0.01, remaining=0.002)
    assert effects.plan_from_record(json.loads(json.dumps(made.record()))) == made
    with pytest.raises(ValueError, match="expected the entries"):
        effects.plan_from_record({"integrator": "path"})


def test_unknown_effects_are_refused_with_those_there_are():
    with pytest.raises(ValueError, match=r"unknown 'fog'; expected auto, all or camera-motion, .*media"):
        effects.chosen(["fog"], 1)


@pytest.mark.parametrize("scene", ["nowhere", "nowhere.xml", 7])
def test_what_is_no_scene_is_refused(scene):
    with pytest.raises(ValueError, match="scene"):
        effects.inspect(scene)


def test_every_effect_says_what_it_is():
    assert len({effect.name for effect in EFFECTS}) == 13
    for effect in EFFECTS:
        assert effect.sentence.endswith(".")
        assert effect.buffers <= set(Frame._fields)
        assert bool(effect.neutral) == bool(effect.buffers)


def test_json_is_all_that_is_printed(tmp_path):
    path = CASES["a ball: textured roughness"].write(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "jaxdn.cli", "inspect", str(path), "--json", "--denoiser", "svgf"],
        capture_output=True,
        text=True,
        check=True,
    )
    said = json.loads(done.stdout)
    assert set(said) == {"effects", "plan", "uncertain"}
    assert set(said["effects"]) == {"indirect", "glossy"}
    assert said["plan"]["motion"] == "none"
    assert said["uncertain"] == []


def test_a_mistake_ends_with_one_message(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxdn.cli", "inspect", str(tmp_path / "none.xml"), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "none.xml" in done.stderr
    assert "Traceback" not in done.stderr


def test_effects_cannot_be_changed_by_accident():
    found = effects.everything(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.names = ()
    assert len(found) == len(EFFECTS)
