"""Effects are found exactly, planned as data, and absent effects are neither rendered nor stored nor compiled."""

import ast
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxdn
from experiments.speed.small_rooms import CASES, FRAMES
from jaxdn import effects
from jaxdn.commands import inspect as command
from jaxdn.core.frame import BUFFERS, ON_REQUEST, Frame
from jaxdn.effects import EFFECTS, Effect, Effects, Light, Moment, SceneProperties, Surface

SIZE = {"width": 24, "height": 16}
PLANNING = Path(effects.__file__).parent / "planning"


@pytest.mark.parametrize("name", CASES)
def test_exactly_the_effects_of_a_scene_are_found(name, tmp_path):
    case = CASES[name]
    found = effects.inspect(case.write(tmp_path), **SIZE)
    assert set(found) == case.effects, found.why
    assert set(found.uncertain) == case.uncertain


def test_effects_are_found_per_frame(tmp_path):
    found = effects.inspect(CASES["moving: ball, later"].write(tmp_path), **SIZE)
    moving = ["object-motion" in frame for frame in found.frames]
    assert moving == [False, False, True, True]
    assert found.shared_with == (0, 0, 2, 3)


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
    from jaxdn.render.mitsuba.variant import use_variant

    use_variant()
    import mitsuba as mi

    case = CASES["moving: ball"]
    path = case.write(tmp_path)
    scene = mi.load_file(str(path), optimize=False)
    assert set(effects.inspect(scene, {"frames": FRAMES, **case.animation}, **SIZE)) == case.effects
    assert set(effects.inspect(scene, path.with_suffix(".json"), **SIZE)) == case.effects
    assert set(effects.inspect(scene, **SIZE)) == {"indirect"}


def test_a_constant_animation_has_constant_poses(tmp_path):
    from jaxdn.render.scenes.scene_file import SceneFile

    scene = SceneFile(CASES["moving: nothing moves"].write(tmp_path))
    poses = [scene.pose(frame)["ball"] for frame in (0, 0.3, 1, 2, 3)]
    cameras = [scene.camera(frame).to_world for frame in (0, 0.3, 1, 2, 3)]
    assert all(np.array_equal(poses[0], pose) for pose in poses)
    assert all(np.array_equal(cameras[0], camera) for camera in cameras)


def test_what_is_uncertain_counts_as_present():
    scene = SceneProperties((Surface("wall"),), (Light("lamp"),), (Moment(),), uncertain={"glossy": "not readable"})
    found = effects.inspect(scene)
    assert "glossy" in found
    assert found.uncertain["glossy"] == "not readable"
    assert "roughness" in effects.plan(found).buffers


def test_a_new_effect_needs_no_change_of_the_planner(monkeypatch):
    # A later method reads a buffer that an effect produces; the planner finds both in the data.
    glow = Effect(
        "fluorescence",
        "Light comes back in another colour.",
        lambda scene, moment: "",
        frozenset({"luminance_gradient"}),
        depth=3,
        integrator="spectral",
    )
    monkeypatch.setattr("jaxdn.planning.plan.EFFECTS", (*EFFECTS, glow))
    found = Effects(("fluorescence",), {}, {}, (frozenset({"fluorescence"}),), (0,), max_depth=9)
    reader = jaxdn.denoisers.svgf()._replace(reads=frozenset({"luminance_gradient"}))
    made = effects.plan(found, reader)
    assert (made.buffers, made.indirect, made.max_depth, made.integrator) == (
        ("direct", "luminance_gradient"), True, 9, "spectral"
    )  # fmt: skip
    assert "luminance_gradient" not in effects.plan(found, jaxdn.denoisers.svgf()).buffers


def test_the_planner_names_no_effect():
    names = {effect.name for effect in EFFECTS}
    for file in ("plan.py", "detected_effects.py"):
        tree = ast.parse((PLANNING / file).read_text())
        texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        # "emission" is an effect, and a buffer that is added to every image.
        assert texts & names <= {"emission"}, file


def test_planning_imports_no_upper_layer():
    code = (
        "import sys; import jaxdn.planning.plan, jaxdn.planning.detected_effects; "
        "print([name for name in sys.modules if name.startswith(('jaxdn.clips', 'jaxdn.render'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    rooms = [*PLANNING.glob("*.py"), PLANNING.parent / "effects.py", *(PLANNING.parent / "render").rglob("*.py")]
    for path in rooms:
        if path.name != "__init__.py":  # the packages load their names on first use
            assert 'import_module("jaxdn' not in path.read_text(), path


def test_a_plan_is_what_the_scene_has_and_the_denoiser_reads():
    found = effects.choose_effects(["camera-motion", "disocclusion", "glossy", "indirect"], 3)
    svgf, ntd = jaxdn.denoisers.svgf(), jaxdn.denoisers.ntd(size="small")
    assert command.motion(effects.plan(found, svgf)) == "traditional"
    assert command.motion(effects.plan(found, ntd)) == "dual"
    assert "roughness" not in effects.plan(found, svgf).buffers
    assert "roughness" in effects.plan(found).buffers
    assert set(effects.plan(found, ntd).buffers) <= ntd.reads | {"direct", "emission"}


def test_a_plan_round_trips_through_its_record():
    made = effects.plan(effects.choose_effects(["glossy", "indirect"], 3), max_depth=5)
    assert effects.plan_from_record(json.loads(json.dumps(made.record()))) == made
    with pytest.raises(ValueError, match=r"expected the entries .*held, got integrator"):
        effects.plan_from_record({"integrator": "path"})


def test_every_entry_of_a_plan_is_used():
    # What is only for readers follows from these, and is printed by `jaxdn inspect`.
    assert set(effects.Plan._fields) == {"integrator", "max_depth", "indirect", "effects", "frames", "shared_with"}


def test_chosen_effects_do_not_say_that_nothing_changes():
    assert effects.choose_effects(["indirect"], 3).shared_with == (0, 1, 2)


def test_unknown_effects_raise_with_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown 'fog'; expected auto, all or camera-motion, .*media"):
        effects.choose_effects(["fog"], 1)


@pytest.mark.parametrize("scene", ["nowhere", "nowhere.xml", 7])
def test_an_invalid_scene_is_refused(scene):
    with pytest.raises(ValueError, match="scene"):
        effects.inspect(scene)


def test_every_effect_has_a_description():
    assert len({effect.name for effect in EFFECTS}) == 15
    for effect in EFFECTS:
        assert effect.sentence.endswith(".")
        assert effect.buffers <= set(Frame._fields)


def test_left_out_buffers_are_relative_to_rendering_without_a_plan():
    nothing = effects.plan(effects.choose_effects([], 1))
    assert command.bytes_a_pixel(command.EVERYTHING) == 88
    assert set(command.left_out(nothing)) == {name for effect in EFFECTS for name in effect.buffers} - ON_REQUEST
    assert command.bytes_a_pixel(nothing) == 18 + sum(BUFFERS[name].bytes for name in nothing.buffers)
    assert command.list_channels(("normal", "ids")) == ["normal.X", "normal.Y", "normal.Z", "ids.Y"]


@pytest.mark.parametrize("name", ["svgf", "ntd", "ntd-small"])
def test_a_plan_is_made_for_a_method_with_or_without_weights(name):
    assert command.find_denoiser(name).reads


def test_several_denoisers_read_what_each_of_them_reads():
    apart = [command.find_denoiser(name).reads for name in ("taa", "relax", "asvgf")]
    assert command.find_denoiser("taa,relax,asvgf").reads == frozenset().union(*apart) != apart[1]
    assert command.find_denoiser("noisy,taa").reads == apart[0]
    with pytest.raises(ValueError, match="magic"):
        command.find_denoiser("svgf,magic")


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="magic"):
        command.find_denoiser("magic")


@pytest.mark.slow
def test_only_json_is_printed(tmp_path):
    path = CASES["a ball: textured roughness"].write(tmp_path)
    done = subprocess.run(
        [sys.executable, "-m", "jaxdn.commands.main", "inspect", str(path), "--json", "--denoiser", "svgf"],
        capture_output=True,
        text=True,
        check=True,
    )
    said = json.loads(done.stdout)
    assert set(said) == {"effects", "plan", "uncertain"}
    assert set(said["effects"]) == {"indirect", "glossy", "specular"}
    assert said["plan"]["motion"] == "none"
    assert 0 < said["plan"]["remaining"] < 1
    assert len(said["plan"]["buffers"]) + said["plan"]["buffers_left_out"] == 13
    assert said["uncertain"] == []


@pytest.mark.slow
def test_a_user_error_ends_with_one_message(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "jaxdn.commands.main", "inspect", str(tmp_path / "none.xml"), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "none.xml" in done.stderr
    assert "Traceback" not in done.stderr


def test_effects_cannot_be_changed_by_accident():
    found = effects.choose_all_effects(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.names = ()
    assert len(found) == len(EFFECTS)
