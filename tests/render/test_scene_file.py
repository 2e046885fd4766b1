"""Animated scene files: Mitsuba renders what the keys describe, and errors name their place."""

import json
import subprocess
import sys

import numpy as np
import pytest

from jaxdn.data.exr.exr import write_exr
from jaxdn.render.scenes.animation import RigidKeys, make_rotation, slerp
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.scenes.scene_file import SceneFile
from tests.needs import require_module

mi = require_module("mitsuba")

OLD = """<scene version="0.6.0">
  <default name="angle" value="50"/>
  <integrator type="path"><integer name="maxDepth" value="6"/></integrator>
  <sensor type="perspective">
    <float name="fov" value="$angle"/>
    <transform name="toWorld"><lookat origin="0, 1, 6" target="0, 1, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
  </sensor>
  <bsdf type="diffuse" id="grey">
    <texture name="reflectance" type="bitmap"><string name="filename" value="wall.png"/></texture>
  </bsdf>
  <shape type="rectangle" id="Wall">
    <transform name="toWorld"><scale value="4"/><translate x="0" y="1" z="-1"/></transform><ref id="grey"/>
  </shape>
  <shape type="cube" id="Box">
    <transform name="toWorld"><scale value="0.5"/><translate x="-1" y="1" z="1"/></transform><ref id="grey"/>
  </shape>
  <shape type="sphere">
    <point name="center" x="0" y="5" z="5"/><float name="radius" value="0.5"/>
    <emitter type="area"><rgb name="radiance" value="20, 20, 20"/></emitter>
  </shape>
</scene>"""

ANIMATION = {
    "frames": 5,
    "shapes": {
        "Box": {
            "pivot": [-1, 1, 1],
            "keys": [{"frame": 0}, {"frame": 4, "translation": [2, 0, 0], "axis": [0, 0, 1], "angle": 90}],
        }
    },
    "inserted": [
        {"id": "ball", "type": "sphere", "size": 0.5, "keys": [{"frame": 0, "translation": [0, 2, 1]}]},
        {"id": "bar", "type": "cylinder", "size": [0.2, 0.2, 1], "bsdf": {"type": "roughconductor", "alpha": 0.2}},
    ],
}  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def scalar():
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield
    if before:
        mi.set_variant(before)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "scene.xml").write_text(OLD)
    mi.Bitmap(np.full((2, 2, 3), 128, np.uint8)).write(str(tmp_path / "wall.png"))
    return tmp_path


def animated(folder, animation):
    path = folder / "motion.json"
    path.write_text(json.dumps(animation))
    return SceneFile(folder / "scene.xml", path)


def shape_at(scene, frame, x, y):
    """Id of the shape at a pixel centre of the 24x16 image."""
    built = scene.build(frame, 24, 16)
    ray, _ = built.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f((x + 0.5) / 24, (y + 0.5) / 16), mi.Point2f(0.5))
    hit = built.ray_intersect(ray)
    return hit.shape.id() if hit.is_valid() else None


def pixel_of(scene, frame, point):
    """Projection of a world point by the camera that the scene states."""
    camera = scene.camera(frame)
    x, y, z, _ = np.linalg.inv(camera.to_world) @ [*point, 1]
    scale = 0.5 * 24 / np.tan(np.radians(camera.x_fov) / 2)
    return 12 - scale * x / z - 0.5, 8 - scale * y / z - 0.5


def test_a_still_scene(folder):
    scene = SceneFile(folder / "scene.xml")
    assert isinstance(scene, AnimatedScene)
    assert (scene.frames, scene.max_depth, scene.name) == (1, 6, folder.name)
    assert scene.pose(0) == scene.pose(3) == {}
    camera = scene.camera(0)
    assert camera.x_fov == pytest.approx(50)
    np.testing.assert_allclose(camera.to_world[:3, 3], [0, 1, 6], atol=1e-6)
    np.testing.assert_allclose(camera.to_world[:3, 2], [0, 0, -1], atol=1e-6)
    built = scene.build(0, 24, 16)
    assert {shape.id() for shape in built.shapes()} == {"Wall", "Box", "shape_2"}
    image = np.array(mi.render(built, spp=2, seed=1))
    assert image.shape == (16, 24, 3)
    assert np.isfinite(image).all()
    assert image.mean() > 0.01


def test_shapes_move_as_keyed(folder):
    scene = animated(folder, ANIMATION)
    assert scene.frames == 5
    for frame, x in ((0, -1), (2, 0), (4, 1)):
        column, row = pixel_of(scene, frame, (x, 1, 1.5))
        assert shape_at(scene, frame, round(column), round(row)) == "Box"
        center = scene.pose(frame)["Box"] @ [-1, 1, 1, 1]
        np.testing.assert_allclose(center[:3], [x, 1, 1], atol=1e-12)
    np.testing.assert_allclose(scene.pose(2)["Box"][:3, :3], make_rotation(np.array([0, 0, 1]), 45), atol=1e-12)
    column, row = pixel_of(scene, 0, (-1, 1, 1.5))
    assert shape_at(scene, 4, round(column), round(row)) == "Wall"
    # Outside the keys nothing moves.
    np.testing.assert_array_equal(scene.pose(9)["Box"], scene.pose(4)["Box"])


def test_the_pose_is_the_motion_of_mitsubas_surface(folder):
    scene = animated(folder, ANIMATION)
    vertices = []
    for frame in (1, 3):
        box = next(shape for shape in scene.build(frame, 24, 16).shapes() if shape.id() == "Box")
        vertices.append(np.array(mi.traverse(box)["vertex_positions"], np.float64).reshape(-1, 3))
    moved = scene.pose(3)["Box"] @ np.linalg.inv(scene.pose(1)["Box"])
    np.testing.assert_allclose(vertices[0] @ moved[:3, :3].T + moved[:3, 3], vertices[1], atol=1e-5)


def test_inserted_shapes_fill_their_box(folder):
    scene = animated(folder, ANIMATION)
    shapes = {shape.id(): shape for shape in scene.build(0, 24, 16).shapes()}
    for name, low, high in (
        ("ball", [-0.25, 1.75, 0.75], [0.25, 2.25, 1.25]),
        ("bar", [-0.1, -0.1, -0.5], [0.1, 0.1, 0.5]),
    ):
        box = shapes[name].bbox()
        np.testing.assert_allclose(np.array([box.min, box.max]), [low, high], atol=1e-5)
    assert "roughconductor" in str(shapes["bar"].bsdf()).lower()


def test_the_camera_follows_its_keys(folder):
    keys = [
        {"frame": 0, "origin": [0, 1, 6], "target": [0, 1, 0], "fov": 50},
        {"frame": 4, "origin": [1, 1, 6], "target": [1, 1, 0], "fov": 30},
    ]
    scene = animated(folder, {"frames": 5, "camera": keys})
    camera = scene.camera(2)
    assert camera.x_fov == pytest.approx(40)
    np.testing.assert_allclose(camera.to_world[:3, 3], [0.5, 1, 6])
    sensor = scene.build(2, 24, 16).sensors()[0]
    np.testing.assert_allclose(np.array(sensor.world_transform().matrix), camera.to_world, atol=1e-6)
    assert mi.traverse(sensor)["x_fov"] == pytest.approx(40)
    column, row = pixel_of(scene, 2, (-1, 1, 1.5))
    assert shape_at(scene, 2, round(column), round(row)) == "Box"


def test_the_record_builds_the_same_scene(folder, monkeypatch):
    monkeypatch.chdir(folder)
    scene = animated(folder, ANIMATION)
    assert scene.record["file"] == "scene.xml"
    again = SceneFile.from_record(json.loads(json.dumps(scene.record)))
    assert again.record == scene.record
    images = [np.array(mi.render(each.build(3, 24, 16), spp=1, seed=3)) for each in (scene, again)]
    np.testing.assert_array_equal(*images)


def test_a_scene_may_lie_on_another_drive(folder, monkeypatch):
    def refuse(path):
        raise ValueError("path is on mount 'D:', start on mount 'C:'")

    monkeypatch.setattr("os.path.relpath", refuse)
    assert SceneFile(folder / "scene.xml").record["file"] == (folder / "scene.xml").resolve().as_posix()


def test_an_animation_next_to_the_scene_is_found(folder):
    (folder / "scene.json").write_text(json.dumps({"frames": 7}))
    assert SceneFile(folder / "scene.xml").frames == 7


def test_turns_longer_than_half_a_circle():
    keys = RigidKeys([{"frame": 0}, {"frame": 8, "axis": [0, 0, 2], "angle": 720}], np.zeros(3))
    np.testing.assert_allclose(keys(1)[:3, :3], make_rotation(np.array([0, 0, 1]), 90), atol=1e-12)
    np.testing.assert_allclose(keys(6)[:3, :3], make_rotation(np.array([0, 0, 1]), 180), atol=1e-12)


@pytest.mark.parametrize("angle", [270, 720])
def test_a_turn_begins_after_a_rest_about_its_own_axis(angle):
    keys = RigidKeys([{"frame": 0}, {"frame": 5}, {"frame": 15, "axis": [0, 0, 1], "angle": angle}], np.zeros(3))
    np.testing.assert_array_equal(keys(3), np.eye(4))
    for frame in range(5, 16):
        turned = make_rotation(np.array([0, 0, 1]), angle * (frame - 5) / 10)
        np.testing.assert_allclose(keys(frame)[:3, :3], turned, atol=1e-12)


def test_a_rest_lies_between_turns_about_two_axes():
    turns = [
        {"frame": 0, "axis": [1, 0, 0], "angle": 270},
        {"frame": 10},
        {"frame": 20, "axis": [0, 0, 1], "angle": 270},
    ]
    keys = RigidKeys(turns, np.zeros(3))
    np.testing.assert_allclose(keys(5)[:3, :3], make_rotation(np.array([1, 0, 0]), 135), atol=1e-12)
    np.testing.assert_allclose(keys(15)[:3, :3], make_rotation(np.array([0, 0, 1]), 135), atol=1e-12)


@pytest.mark.parametrize("angle", [1e-7, 30.0, 179.999, 180.0])
def test_slerp_turns_evenly_about_one_axis(angle):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    first = make_rotation(np.array([1.0, 0.0, 0.0]), 70)
    second = first @ make_rotation(axis, angle)
    np.testing.assert_allclose(slerp(first, second, 1.0), second, atol=1e-7)
    half = slerp(first, second, 0.5)
    np.testing.assert_allclose(half @ (first.T @ half), second, atol=1e-7)


MOVE = [{"frame": 0}]
WRONG = {
    "unknown shape": ({"shapes": {"Bok": {"keys": MOVE}}}, "no shape 'Bok'; near: Box"),
    "unknown key": ({"frame": 3}, "unknown key 'frame'"),
    "unknown key of a key": (
        {"shapes": {"Box": {"keys": [{"frame": 0, "rotate": 3}]}}},
        "keys.0.: unknown key 'rotate'",
    ),
    "frames": ({"frames": 0}, "frames: expected a whole number"),
    "order": ({"shapes": {"Box": {"keys": [{"frame": 2}, {"frame": 2}]}}}, "later one than 2"),
    "no keys": ({"shapes": {"Box": {"keys": []}}}, "at least one key"),
    "axis": ({"shapes": {"Box": {"keys": [{"frame": 0, "axis": [0, 0, 0]}]}}}, "axis: expected a direction"),
    "camera": ({"camera": [{"frame": 0, "origin": [0, 0, 1]}]}, "target: expected 3 finite numbers"),
    "undefined camera": ({"camera": [{"frame": 0, "origin": [0, 9, 0], "target": [0, 0, 0]}]}, "off the up direction"),
    "scaled camera": ({"camera": [{"frame": 0, "matrix": (2 * np.eye(4)).tolist()}]}, "rotation and a translation"),
    "fov": ({"camera": [{"frame": 0, "origin": [0, 0, 1], "target": [0, 0, 0], "fov": 180}]}, "fov: expected degrees"),
    "twice": ({"inserted": [{"id": "Box", "type": "cube"}]}, "id: expected a new name"),
    "primitive": ({"inserted": [{"id": "b", "type": "torus"}]}, "type: expected one of sphere"),
    "egg": ({"inserted": [{"id": "b", "type": "sphere", "size": [1, 2, 1]}]}, "for a sphere all the same"),
    "color": ({"inserted": [{"id": "b", "type": "cube", "color": [1, 2, 0]}]}, "color: expected three numbers"),
}


@pytest.mark.parametrize(("animation", "words"), WRONG.values(), ids=WRONG)
def test_user_errors_are_named(folder, animation, words):
    with pytest.raises(ValueError, match=words):
        animated(folder, animation)


def test_numbers_must_be_finite(folder):
    path = folder / "motion.json"
    for text, words in (
        ('{"frames": NaN}', "NaN"),
        ('{"camera": [{"frame": 1e999}]}', "finite"),
        ("{", "expected JSON"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=words):
            SceneFile(folder / "scene.xml", path)


def test_missing_files(folder, tmp_path):
    with pytest.raises(ValueError, match="could not read"):
        SceneFile(folder / "nowhere.xml")
    with pytest.raises(ValueError, match="found none"):
        SceneFile(folder / "scene.xml", folder / "nowhere.json")
    (folder / "wall.png").unlink()
    with pytest.raises(ValueError, match=r"wall\.png"):
        SceneFile(folder / "scene.xml")
    (folder / "list.xml").write_text('<shape version="3.0.0" type="sphere"/>')
    with pytest.raises(ValueError, match="<scene>"):
        SceneFile(folder / "list.xml")
    for text, words in (
        ("<scene", "start element"),
        ("<list/>", "missing version"),
        ('<scene version="3.0.0"><shape type="sphere"><ref id="chrome"/></shape></scene>', '"chrome"'),
        ('<scene version="3.0.0"><include filename="walls.xml"/></scene>', r"walls\.xml"),
    ):
        (folder / "list.xml").write_text(text)
        with pytest.raises(ValueError, match=rf"list\.xml: expected a Mitsuba scene.*{words}"):
            SceneFile(folder / "list.xml")


def test_a_scene_without_a_camera_needs_keys(folder):
    start, end = OLD.index("  <sensor"), OLD.index("  <bsdf")
    (folder / "scene.xml").write_text(OLD[:start] + OLD[end:])
    with pytest.raises(ValueError, match="perspective sensor"):
        SceneFile(folder / "scene.xml")
    key = {"frame": 0, "origin": [0, 1, 6], "target": [0, 1, 0]}
    with pytest.raises(ValueError, match="fov"):
        animated(folder, {"camera": [key]})
    assert animated(folder, {"camera": [{**key, "fov": 40}]}).camera(0).x_fov == 40


def test_includes_are_followed(folder):
    start, end = OLD.index('  <shape type="cube"'), OLD.index('  <shape type="sphere"')
    (folder / "box.xml").write_text(f'<scene version="0.6.0">{OLD[start:end]}</scene>')
    (folder / "scene.xml").write_text(OLD[:start] + '<include filename="box.xml"/>' + OLD[end:])
    assert (
        shape_at(animated(folder, ANIMATION), 4, *map(round, pixel_of(SceneFile(folder / "scene.xml"), 0, (1, 1, 1.5))))
        == "Box"
    )


def test_a_scene_opens_before_a_variant_was_chosen(tmp_path):
    # Found by rendering a room from the command line: other tests choose a variant first, a user does not.
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/></sensor>'
        '<shape type="sphere" id="ball"/></scene>'
    )
    code = f"from jaxdn.render.scenes.scene_file import SceneFile; print(SceneFile({str(path)!r}).frames)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "1", done.stderr


def test_a_picture_of_light_is_read_on_one_core(tmp_path):
    """Mitsuba reads EXR files by threads besides its own, of which there are none on one core: it waited for ever."""
    sky = np.random.default_rng(0).uniform(0, 1, (64, 128)).astype(np.float32)
    write_exr(tmp_path / "sky.exr", dict.fromkeys("RGB", sky))
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><sensor type="perspective"><float name="fov" value="40"/></sensor>'
        '<shape type="sphere" id="ball"/>'
        '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    )
    code = f"""
import os
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from jaxdn.render.scenes.scene_file import SceneFile
print(len(SceneFile({str(path)!r}).build(0, 8, 6).emitters()))"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=100)
    assert done.stdout.strip() == "1", done.stderr


def test_a_thin_lens_of_the_file_or_of_the_animation_is_the_cameras(folder):
    path = folder / "scene.xml"
    lens = '<sensor type="thinlens"><float name="aperture_radius" value="0.1"/><float name="focus_distance" value="4"/>'
    path.write_text(OLD.replace('<sensor type="perspective">', lens.replace("_r", "R").replace("_d", "D")))
    file = SceneFile(path)
    assert file.camera(0)[1:] == pytest.approx((50.0, 0.1, 4.0))
    sensor = file.build(0, 8, 6).sensors()[0]
    assert sensor.needs_aperture_sample()
    assert mi.traverse(sensor)["focus_distance"] == pytest.approx(4.0)
    own = {"lens": {"aperture_radius": 0.3, "focus_distance": 2.0}, "shutter": 0.5}
    keys = {"camera": [{"frame": 0, "origin": [0, 1, 6], "target": [0, 1, 0]}]}
    moved = animated(folder, {**own, **keys, "fog": {"density": 0.2, "albedo": [0.5, 0.6, 0.7]}})
    assert moved.camera(0)[1:] == pytest.approx((50.0, 0.3, 2.0))
    assert moved.shutter == 0.5
    assert moved.record["animation"]["shutter"] == 0.5
    medium = moved.build(0, 8, 6).sensors()[0].get_medium()
    assert mi.traverse(medium)["sigma_t.value.value"] == pytest.approx(0.2)
    for wrong in ({"lens": {"aperture_radius": 0.3}}, {"fog": {"density": -1, "albedo": [0, 0, 0]}}, {"shutter": 2}):
        with pytest.raises(ValueError, match=f"animation {next(iter(wrong))}"):
            animated(folder, wrong)
