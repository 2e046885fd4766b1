"""Randomised scenes: the camera stays clear, things are seen, speeds are bounded, and the record is the whole scene."""

import itertools
import json

import numpy as np
import pytest

from jaxdn.data.clip.folder import is_clip, read_record
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.scenes.animation import check_animation
from jaxdn.render.scenes.scene_file import SceneFile
from tests.needs import require_module

mi = require_module("mitsuba")

FRAMES = 6
SEEDS = range(3)


def box(place, size, name, bsdf="grey"):
    return (
        f'<shape type="cube" id="{name}"><transform name="to_world"><scale x="{size[0]}" y="{size[1]}" z="{size[2]}"/>'
        f'<translate x="{place[0]}" y="{place[1]}" z="{place[2]}"/></transform><ref id="{bsdf}"/></shape>'
    )


def room(camera=(0, 1.5, 2.5), fog=""):
    """A closed box of 6 x 3 x 6 with crates, a ball, a lamp at the ceiling and another on a crate."""
    x, y, z = camera
    walls = [
        box((0, -0.1, 0), (3, 0.1, 3), "floor", "wood"),
        box((0, 3.1, 0), (3, 0.1, 3), "ceiling"),
        *(box((side * 3.1, 1.5, 0), (0.1, 1.5, 3), f"wall_{side}") for side in (-1, 1)),
        *(box((0, 1.5, side * 3.1), (3, 1.5, 0.1), f"end_{side}") for side in (-1, 1)),
    ]
    crates = [
        box((-1.5 + index, 0.25, -1.5 + 0.4 * index), (0.2, 0.25, 0.2), f"crate_{index}", "red") for index in range(4)
    ]
    return f"""<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="5"/></integrator>
  <sensor type="perspective"><float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="{x}, {y}, {z}" target="0, 1, 0" up="0, 1, 0"/></transform></sensor>
  <bsdf type="diffuse" id="grey"><rgb name="reflectance" value="0.6, 0.6, 0.6"/></bsdf>
  <bsdf type="twosided" id="wood"><bsdf type="diffuse">
    <texture name="reflectance" type="bitmap"><string name="filename" value="wood.png"/></texture></bsdf></bsdf>
  <bsdf type="roughplastic" id="red"><rgb name="diffuse_reflectance" value="0.7, 0.1, 0.1"/></bsdf>
  {"".join(walls + crates)}
  <shape type="sphere" id="ball"><point name="center" x="1" y="0.4" z="-1"/><float name="radius" value="0.4"/>
    <bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf>{fog}</shape>
  <shape type="rectangle" id="lamp"><transform name="to_world"><rotate x="1" angle="90"/><translate y="2.98"/>
    </transform><emitter type="area"><rgb name="radiance" value="5, 5, 4"/></emitter></shape>
  <shape type="sphere" id="bulb"><point name="center" x="-1.5" y="0.7" z="-1.5"/><float name="radius" value="0.1"/>
    <emitter type="area"><rgb name="radiance" value="20, 10, 5"/></emitter></shape>
</scene>"""


@pytest.fixture(scope="module", autouse=True)
def fast():
    before = mi.variant()
    mi.set_variant(choose_variant().variant)
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("den")
    (folder / "scene.xml").write_text(room())
    codes = np.arange(4 * 4 * 3).reshape(4, 4, 3).astype(np.uint8) * 5
    mi.Bitmap(codes).write(str(folder / "wood.png"))
    return folder


@pytest.fixture(scope="module")
def randomised(folder):
    from jaxdn.render.camera_paths.randomised_scene import randomise_scene

    return [randomise_scene(folder / "scene.xml", seed, FRAMES) for seed in SEEDS]


@pytest.mark.slow
def test_a_seed_always_gives_the_same_animation_and_another_seed_another(randomised, folder):
    from jaxdn.render.camera_paths.randomised_scene import randomise_scene

    again = randomise_scene(folder / "scene.xml", 1, FRAMES)
    assert again.record == randomised[1].record
    assert len({json.dumps(scene.record, sort_keys=True) for scene in randomised}) == len(randomised)
    assert json.loads(json.dumps(again.record)) == again.record


@pytest.mark.slow
def test_cameras_keep_clear_of_everything(randomised, folder):
    empty = SceneFile(folder / "scene.xml").build(0, 4, 4)
    directions = np.random.default_rng(7).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for scene in randomised:
        assert 35 <= scene.camera(0).x_fov <= 80
        for frame in np.linspace(0, FRAMES - 1, 5):
            place = scene.camera(frame).to_world[:3, 3]
            assert np.all(np.abs(place - [0, 1.5, 0]) < [2.95, 1.45, 2.95])
            for direction in directions:
                near = mi.Ray3f(place.tolist(), direction.tolist(), 0.05, 0.0, [])  # of length 0.05
                assert not np.any(empty.ray_test(near))


def test_cameras_move_within_bounds(randomised):
    for scene in randomised:
        cameras = [scene.camera(frame) for frame in range(FRAMES)]
        for first, second in itertools.pairwise(cameras):
            turn = np.degrees(np.arccos(np.clip(first.to_world[:3, 2] @ second.to_world[:3, 2], -1, 1)))
            focal = 64 / np.tan(np.radians(first.x_fov / 2))
            assert focal * np.radians(turn) < 45
            assert np.linalg.norm(second.to_world[:3, 3] - first.to_world[:3, 3]) < 1.5


@pytest.mark.slow
def test_inserted_objects_are_seen_and_moved_ones_of_the_room_are_not_its_lights(randomised):
    from jaxdn.render.buffers.gbuffer import trace_gbuffer

    for scene in randomised:
        inserted = {shape["id"] for shape in scene.record["animation"]["inserted"]}
        seen = set()
        for frame in range(FRAMES):
            found = trace_gbuffer(scene.build(frame, 48, 48))
            seen |= {found.names[index] for index in np.unique(found.ids) if index >= 0}
        assert seen & inserted
        assert not {"lamp", "bulb"} & set(scene.record["animation"].get("shapes", {}))


@pytest.mark.slow
def test_the_record_rebuilds_the_scene_bit_for_bit(randomised):
    record = json.loads(json.dumps(randomised[1].record))
    images = [
        np.array(mi.render(scene.build(1, 12, 12), spp=2, seed=3))
        for scene in (randomised[1], scene_from_record(record))
    ]
    assert images[0].max() > 0
    np.testing.assert_array_equal(*images)


def test_changed_materials_and_tinted_lights(folder):
    from jaxdn.render.scenes.material_overrides import name_materials

    def colors(animation):
        scene = SceneFile.from_record({"file": str(folder / "scene.xml"), "animation": animation})
        bsdfs = dict(name_materials(scene.build(0, 4, 4)))
        values = {name: mi.traverse(bsdf) for name, bsdf in bsdfs.items()}
        texture, red = (np.array(values[name][key]) for name, key in KEYS.items())
        return texture, red.ravel(), float(np.ravel(np.array(values["ball"]["alpha.value"]))[0])

    KEYS = {"wood": "brdf_0.reflectance.data", "red": "diffuse_reflectance.value"}
    before = colors({})
    # A third of a turn permutes the channels; 8-bit codes are permuted exactly.
    changed = colors({"materials": {"wood": {"hue": 120}, "red": {"hue": 120}, "ball": {"roughness": 0.3}}})
    np.testing.assert_array_equal(changed[0], np.roll(before[0], 1, axis=-1))
    np.testing.assert_allclose(changed[1], [0.1, 0.7, 0.1], atol=1e-6)
    assert changed[2] == pytest.approx(0.09)
    grey = colors({"materials": {"red": {"saturation": 0, "tint": [1, 0.5, 0]}}})
    np.testing.assert_allclose(grey[1], [0.3, 0.15, 0], atol=1e-6)
    lights = {"bulb": [{"frame": 0, "scale": [1, 0, 0]}, {"frame": 2, "scale": 1}]}
    scene = SceneFile.from_record({"file": str(folder / "scene.xml"), "animation": {"lights": lights}})
    assert scene.brightness(0) == {"bulb": (1, 0, 0)}
    assert scene.brightness(1) == {"bulb": (1, 0.5, 0.5)}
    assert scene.brightness(2) == {"bulb": 1}
    bulb = next(shape for shape in scene.build(0, 4, 4).shapes() if shape.id() == "bulb")
    np.testing.assert_array_equal(np.ravel(np.array(mi.traverse(bulb.emitter())["radiance.value"])), [20, 0, 0])


@pytest.mark.parametrize(
    ("materials", "message"),
    [
        ([], "expected an object"),
        ({"red": {"colour": 1}}, "unknown key 'colour'"),
        ({"red": {"tint": [1, 2, 0]}}, "no number above 1"),
        ({"red": {"saturation": -1}}, "no number below 0"),
        ({"rde": {"hue": 1}}, "no material 'rde'; near: red"),
    ],
)
def test_wrong_materials_are_refused(folder, materials, message):
    with pytest.raises(ValueError, match=message):
        SceneFile.from_record({"file": str(folder / "scene.xml"), "animation": {"materials": materials}})


def test_a_roughness_of_a_material_without_one_is_refused(folder):
    animation = {"materials": {"grey": {"roughness": 0.5}}}
    scene = SceneFile.from_record({"file": str(folder / "scene.xml"), "animation": animation})
    with pytest.raises(ValueError, match="'grey' roughness: expected a material with a constant roughness"):
        scene.build(0, 4, 4)


@pytest.mark.parametrize("scale", [[1, 2], [1, 1, -1], "bright", True])
def test_a_wrong_scale_of_a_light_is_refused(scale):
    with pytest.raises(ValueError, match="lights 'lamp'"):
        check_animation({"lights": {"lamp": [{"frame": 0, "scale": scale}]}}, [])


def test_motion_to_and_fro_has_its_speed_and_passes_its_place():
    from jaxdn.render.camera_paths.inserted_objects import _bounce_between

    times, places = np.array(_bounce_between(-1.0, 2.0, 0.7, 5.0, 20)).T
    assert np.interp(5.0, times, places) == pytest.approx(0)
    assert places.min() >= -1
    assert places.max() <= 2
    inner = np.abs(np.diff(places) / np.diff(times))
    np.testing.assert_allclose(inner, 0.7)


@pytest.mark.slow
def test_the_command_renders_randomised_scenes_and_does_not_search_again(randomised, folder, tmp_path, monkeypatch):
    from jaxdn.commands.main import main
    from jaxdn.render.camera_paths import randomised_scene

    # Searching has tests above; what counts here is that every seed has its own animation.
    monkeypatch.setattr(randomised_scene, "randomise_scene", lambda path, seed, frames: randomised[seed])

    words = [
        "render",
        str(folder / "scene.xml"),
        "--tour",
        "--seeds",
        "0-1",
        "-o",
        str(tmp_path),
        "--frames",
        str(FRAMES),
    ]
    words += ["--width", "16", "--height", "12", "--reference-spp", "2", "--workers", "1", "--effects", "indirect"]
    main(words)
    clips = [tmp_path / f"{folder.name}-{seed}" for seed in (0, 1)]
    assert all(is_clip(clip) for clip in clips)
    records = [read_record(clip)["scene"] for clip in clips]
    assert records[0] != records[1]
    monkeypatch.setattr(randomised_scene, "randomise_scene", None)  # a second search would fail
    main(words)
    assert [read_record(clip)["scene"] for clip in clips] == records


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["fruit", "--tour"], "leave --tour out for a family"),
        (["{scene}", "--tour", "--animation", "walk.json"], "expected none with --tour"),
        (["nothing.xml", "--tour"], "found no file"),
        (["{scene}", "--tour", "--seeds", "5-2"], "swap its ends"),
        (["{scene}", "--tour", "--seeds", "-3"], "whole numbers"),
        (["{scene}", "--seeds", "one"], "whole numbers >= 0 or ranges such as 0-49"),
    ],
)
def test_the_command_refuses_what_it_cannot_do(folder, tmp_path, capsys, words, message):
    from jaxdn.commands.main import main

    words = [word.format(scene=folder / "scene.xml") for word in words]
    with pytest.raises(SystemExit) as ended:
        main(["render", *words, "-o", str(tmp_path / "out")])
    assert ended.value.code == 2
    if "-3" not in words:  # that one the parser of the command line refuses
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_scene_without_free_space_or_with_smoke_that_varies_is_refused(folder, tmp_path):
    from jaxdn.render.camera_paths.randomised_scene import randomise_scene

    (tmp_path / "wood.png").write_bytes((folder / "wood.png").read_bytes())
    path = tmp_path / "scene.xml"
    path.write_text(room(camera=(0, 1000, 2000)))
    with pytest.raises(ValueError, match=r"expected free space around the scene's camera, found none"):
        randomise_scene(path, 0, 2)
    grid = '<medium type="heterogeneous" name="interior"><volume type="constvolume" name="sigma_t"/></medium>'
    path.write_text(room(fog=grid))
    with pytest.raises(ValueError, match="media that vary in space are not supported"):
        randomise_scene(path, 0, 3)
    with pytest.raises(ValueError, match="tour frames: expected at least 1"):
        randomise_scene(path, 0, 0)
    with pytest.raises(ValueError, match="tour seed: expected at least 0"):
        randomise_scene(path, -1, 2)
