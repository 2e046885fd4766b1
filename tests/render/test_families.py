"""The procedural scenes: reproducible, rigid, well lit, and with the camera inside the room for 120 frames."""

import functools
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from jaxdn.render.families import FAMILIES, furniture, shapes, textures
from jaxdn.render.families.staging import Stage, glass, look_at, matte, rod, scale, shift, shuttle, turn
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.scenes.scene import AnimatedScene, Camera, brightness
from jaxdn.render.settings import RenderSettings
from tests.needs import require_module

NAMES = sorted(FAMILIES)
SEEDS = (0, 1, 7)
pytestmark = pytest.mark.usefixtures("optimised_programs")  # a scene of glitter makes eight large normal maps


@functools.cache
def scene_of(name: str, seed: int) -> Stage:
    """A scene that several tests look at, and none changes: some take a second to make."""
    return FAMILIES[name](seed)


@pytest.fixture
def mitsuba() -> Any:
    """Mitsuba in its scalar variant, which runs everywhere; the variant that was active is put back."""
    mi = require_module("mitsuba")
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield mi
    if before is not None:
        mi.set_variant(before)


def _render(mi: Any, scene: Stage, frame: int, *, max_depth: int | None = None, spp: int = 4) -> np.ndarray:
    """[16, 24, 3] radiance from one sample at a time, so that two depths see the same random numbers."""
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth or scene.max_depth, "rr_depth": 1000})
    built = scene.build(frame, 24, 16)
    return np.mean([np.array(mi.render(built, integrator=integrator, spp=1, seed=s)) for s in range(spp)], axis=0)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "glitter")) for name in NAMES])
def test_a_seed_always_gives_the_same_scene_and_another_seed_another(mitsuba: Any, name: str) -> None:
    scenes = scene_of(name, SEEDS[0]), FAMILIES[name](SEEDS[0]), scene_of(name, SEEDS[1])
    first, again, other = (_render(mitsuba, scene, 5) for scene in scenes)
    assert first.shape == (16, 24, 3)
    assert np.isfinite(first).all()
    assert (first > 0).any(-1).mean() > 0.5  # few paths find an upward lamp
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).mean() > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_indirect_light_is_well_exposed_whatever_the_lamp(mitsuba: Any, name: str) -> None:
    for lamp in ("up", "down", "window"):
        scene = FAMILIES[name](2, lamp=lamp)
        direct = _render(mitsuba, scene, 0, max_depth=2, spp=24)
        indirect = _render(mitsuba, scene, 0, spp=24) - direct
        assert 0.05 < indirect.mean() < 0.7, (name, lamp, indirect.mean())
        assert indirect.min() > -1e-4
        if name != "parlour":  # its bulbs and its sky may be in view
            assert direct.mean() < 2.0
        if lamp == "up" and name not in ("robot", "parlour"):
            assert direct.mean() < 0.3 * indirect.mean(), (name, direct.mean())


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_posed_shapes_exist_and_move_rigidly_and_others_are_static(mitsuba: Any, name: str) -> None:
    scene = scene_of(name, SEEDS[1])
    ids = {shape.id() for shape in scene.build(0, 24, 16).shapes()}
    assert ids == set(scene.parts)
    assert 17 <= len(ids) <= (56 if name == "parlour" else 48)
    poses = [scene.pose(frame) for frame in (0, 1, 2, 60, 61, 120)]
    assert set(poses[0]) <= ids
    assert len(poses[0]) >= 4
    for before, after in pairwise(poses):
        assert set(before) == set(after)
        for part in before:
            ratio = after[part] @ np.linalg.inv(before[part])
            np.testing.assert_allclose(ratio[:3, :3] @ ratio[:3, :3].T, np.eye(3), atol=1e-9, err_msg=part)
            assert np.linalg.det(ratio[:3, :3]) > 0
            np.testing.assert_array_equal(ratio[3], [0, 0, 0, 1])
    for part in poses[0]:
        assert any(not np.allclose(poses[0][part], later[part]) for later in poses[1:]), f"{part} never moves"
    for part in ids - set(poses[0]):
        np.testing.assert_array_equal(scene.parts[part].pose(0), scene.parts[part].pose(77.5))


@pytest.mark.parametrize("name", NAMES)
def test_everything_stays_in_the_room_for_120_frames(name: str) -> None:
    for seed in SEEDS:
        scene = scene_of(name, seed)
        low, high = scene.bounds
        eyes = []
        for frame in range(0, 121):
            to_world, fov, *_ = scene.camera(frame)
            np.testing.assert_allclose(to_world[:3, :3] @ to_world[:3, :3].T, np.eye(3), atol=1e-12)
            assert 30 < fov < 90
            eyes.append(to_world[:3, 3])
            inside = np.minimum(eyes[-1] - low, high - eyes[-1])
            assert inside.min() > 0.05, (seed, frame)
            for part, pose in scene.pose(frame).items():
                inside = np.minimum(pose[:3, 3] - low, high - pose[:3, 3])
                assert inside.min() > -1e-6, (seed, frame, part)
        steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
        if name != "parlour":  # some of its cameras are fixed
            assert steps.min() > 5e-4, "the camera always moves a little"
        assert steps.max() < 0.1, "and never jumps"


@pytest.mark.parametrize("name", NAMES)
def test_objects_move_visibly_and_never_jump(name: str) -> None:
    """The centre of every moving part shifts by less than half a metre a frame, the fastest by more than 2 cm."""
    for seed in SEEDS[:2]:
        scene = scene_of(name, seed)
        poses = [scene.pose(frame) for frame in range(0, 121)]
        steps = np.array([[np.linalg.norm(b[p][:3, 3] - a[p][:3, 3]) for p in a] for a, b in pairwise(poses)])
        assert steps.max() < 0.5
        assert steps.max(axis=0).max() > 0.02


@pytest.mark.slow
def test_a_record_gives_the_same_scene_back() -> None:
    for name in NAMES:
        scene = FAMILIES[name](11, lamp="up")
        assert isinstance(scene, AnimatedScene)
        assert scene.record == {"family": name, "seed": 11, "lamp": "up"}
        again = scene_from_record(scene.record)
        for first, second in ((scene.pose(9.5), again.pose(9.5)), (scene.pose(0), again.pose(0))):
            assert all(np.array_equal(first[part], second[part]) for part in first)
        assert FAMILIES[name](11).record == {"family": name, "seed": 11}


def test_about_a_third_of_the_lamps_shine_upwards() -> None:
    lamps = [Stage("fruit", seed).lamp for seed in range(400)]
    assert 0.22 < lamps.count("up") / 400 < 0.38
    assert {"up", "down", "window"} == set(lamps)


def test_a_wrong_lamp_raises() -> None:
    with pytest.raises(ValueError, match="lamp"):
        FAMILIES["fruit"](0, lamp="candle")


@pytest.mark.parametrize(
    "mesh",
    [
        shapes.apple(),
        shapes.pear(),
        shapes.vase(),
        shapes.dish(),
        shapes.drum(),
        shapes.drum(0.0),
        shapes.soft_box(0.2, 0.4),
        shapes.ring(),
        shapes.roof(),
        shapes.star(),
        shapes.boxes(((0, 0, 0), (1, 2, 3))),
    ],
    ids=lambda mesh: str(len(mesh.vertices)),
)
def test_meshes_are_closed_and_their_normals_point_out(mesh: shapes.Mesh) -> None:
    corners = mesh.vertices[mesh.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(area.sum(0), 0, atol=1e-3 * np.linalg.norm(area, axis=1).sum())
    assert np.einsum("fi,fi->", corners.mean(1), area) > 0, "the volume is positive: faces wind outwards"
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    agree = np.einsum("fi,fi->f", area, mesh.normals[mesh.faces].mean(1))
    assert (agree[np.linalg.norm(area, axis=1) > 1e-4] > 0).mean() > 0.99


def test_a_mesh_file_is_named_by_its_contents() -> None:
    path = shapes.ply_path(shapes.vase())
    assert path == shapes.ply_path(shapes.vase())
    assert path != shapes.ply_path(shapes.vase(0.4))
    with open(path, "rb") as file:
        assert file.read(4) == b"ply\n"


def test_textures_are_reflectances_that_wrap(rng: np.random.Generator) -> None:
    one, two = textures.hsv(0.1, 0.5, 0.9), textures.hsv(0.6, 0.5, 0.5)
    for make in (
        textures.wood,
        textures.tiles,
        textures.bricks,
        textures.wallpaper,
        textures.marble,
        textures.speckled,
    ):
        image = make(rng, one, two)
        assert image.shape == (256, 256, 3)
        assert image.dtype == np.float32
        assert image.min() >= 0.02
        assert image.max() <= 0.92
        assert image.std() > 0.01
    field = textures.noise(rng, 4, octaves=1)
    assert np.abs(field[0] - field[-1]).max() < 0.1, "the last row continues in the first"


def test_each_flake_of_glitter_reflects_in_its_own_direction(mitsuba: Any) -> None:
    """A texel lit from where its normal says is bright to a viewer above it; its neighbours, lit so, are not."""
    material = scene_of("glitter", SEEDS[0]).parts["vase"].material
    assert material.normals is not None
    bsdf, size = mitsuba.load_dict(material.describe()), len(material.normals)

    def value(row: int, column: int, light: np.ndarray) -> float:
        hit = mitsuba.SurfaceInteraction3f()
        hit.n = mitsuba.Normal3f(0, 0, 1)
        hit.sh_frame = mitsuba.Frame3f([1, 0, 0], [0, 1, 0], [0, 0, 1])
        hit.dp_du, hit.dp_dv = mitsuba.Vector3f(1, 0, 0), mitsuba.Vector3f(0, 1, 0)
        hit.wi = mitsuba.Vector3f(0, 0, 1)
        hit.uv = mitsuba.Point2f((column + 0.5) / size / material.repeat[0], (row + 0.5) / size / material.repeat[1])
        return float(np.mean(np.array(bsdf.eval(mitsuba.BSDFContext(), hit, mitsuba.Vector3f(*map(float, light))))))

    own, others = [], []
    for row, column in np.random.default_rng(0).integers(0, size, (200, 2)):
        x, y, z = np.asarray(material.normals[row, column], float)
        if 0.9 < z < 0.999:
            light = np.array([2 * x * z, 2 * y * z, 2 * z * z - 1])  # mirrored at the normal
            own.append(value(row, column, light))
            others.append(value(row, (column + 1) % size, light))
    assert len(own) > 20
    assert min(own) > 20
    assert np.median(others) < 0.01 * np.median(own)


def test_glitter_is_the_still_life_with_other_materials() -> None:
    scene, again = scene_of("glitter", SEEDS[0]), FAMILIES["glitter"](SEEDS[0])
    flakes = {name: part.material.normals for name, part in scene.parts.items() if part.material.normals is not None}
    assert len(flakes) == 8
    assert set(scene.parts) == set(FAMILIES["fruit"](SEEDS[0], lamp=scene.lamp).parts)
    first, second, *_ = flakes.values()
    assert not np.array_equal(first, second)
    for name, normals in flakes.items():
        np.testing.assert_array_equal(normals, again.parts[name].material.normals)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
        assert 0.5 < np.mean(normals[..., 2] < 1) < 0.7, "exp(-0.88) of the texels have no flake"


def test_a_dimmed_light_gives_less_light_and_its_factor_is_told(mitsuba: Any) -> None:
    stage = Stage("fruit", 0)
    facing = shift(0, 0, -2)
    stage.add("wall", "rectangle", facing @ scale(3), matte((0.5, 0.5, 0.5)))
    black, picture = matte((0.0, 0.0, 0.0)), np.ones((4, 4, 3), np.float32)
    lit = shift(0, 0, 3) @ turn("y", 180)
    stage.add("plain", "rectangle", lit, black, glow=(1.0, 1.0, 1.0), dimmer=lambda frame: 1.0 if frame < 3 else 0.25)
    stage.view = lambda frame: Camera(look_at((0, 0, 1), (0, 0, -2)), 40.0)
    assert brightness(stage, 2) == {"plain": 1.0}
    assert brightness(stage, 3) == {"plain": 0.25}
    bright, dim = (_render(mitsuba, stage, frame).mean() for frame in (2, 3))
    assert bright > 0
    assert dim == pytest.approx(0.25 * bright, rel=1e-5)
    stage.parts["plain"] = stage.parts["plain"]._replace(glow=picture)
    np.testing.assert_allclose(_render(mitsuba, stage, 3).mean(), dim, rtol=0.01, err_msg="a texture of the light")


def test_families_without_dimmers_have_no_changing_light() -> None:
    assert brightness(FAMILIES["pinkroom"](0), 3) == {}


@pytest.mark.slow
def test_parlours_differ_in_light_and_in_the_pace_of_the_camera() -> None:
    """Of 24 seeds some have lights that change within ten frames, and some cameras rest while others turn fast."""
    changing, turns = 0, []
    for seed in range(24):
        scene = FAMILIES["parlour"](seed)
        factors = [scene.brightness(frame) for frame in range(10)]
        changing += any(first != second for first, second in pairwise(factors))
        views = [scene.camera(frame).to_world[:3, 2] for frame in range(10)]
        cosines = [np.clip(first @ second, -1, 1) for first, second in pairwise(views)]
        turns.append(np.degrees(np.arccos(cosines)).max())
    assert 3 <= changing <= 14
    assert np.sum(np.array(turns) < 0.3) >= 4
    assert np.sum(np.array(turns) > 2.0) >= 4


def test_glass_lets_light_through(mitsuba: Any) -> None:
    for thin in (False, True):
        bsdf = mitsuba.load_dict(glass((0.9, 0.8, 0.7), thin=thin).describe())
        assert mitsuba.has_flag(bsdf.flags(), mitsuba.BSDFFlags.Transmission)


def test_furniture_is_valid(rng: np.random.Generator) -> None:
    """Finite vertices, unit normals, faces with an area, and colours from the middles of a palette's cells."""
    meshes = {
        "chair": furniture.chair(rng),
        "table_legs": furniture.table_legs(rng, 0.5, 0.4, 0.7),
        "books": furniture.books(rng, 0.5, 1.4, 0.25, 4),
        "plant": furniture.plant(rng, 1.0),
        "blinds": furniture.blinds(0.6, 1.2, pitch=0.05, tilt=30, upright=False),
        "upright": furniture.blinds(0.6, 1.2, pitch=0.09, tilt=30, upright=True),
        "fan": furniture.fan(4),
        "window": furniture.window_bars(0.6, 0.7, 3, 2, 0.01),
    }
    for name, mesh in meshes.items():
        corners = mesh.vertices[mesh.faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        assert area.min() > 0, name
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6, err_msg=name)
    cells = meshes["books"].uv * furniture.PALETTE - 0.5
    np.testing.assert_allclose(cells, np.round(cells), atol=1e-9)


def test_transforms() -> None:
    np.testing.assert_allclose(turn("y", 90) @ [0, 0, 1, 1], [1, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn("x", 90) @ [0, 1, 0, 1], [0, 0, 1, 1], atol=1e-12)
    camera = look_at((0, 1, 2), (0, 1, -3))
    np.testing.assert_allclose(camera @ [0, 0, 5, 1], [0, 1, -3, 1], atol=1e-12)
    np.testing.assert_allclose(camera @ [1, 0, 0, 0], [-1, 0, 0, 0], atol=1e-12)
    placed = rod((1, 2, 3), (2, 4, 5), 0.1)
    np.testing.assert_allclose(placed @ [0, 1, 0, 1], [2, 4, 5, 1], atol=1e-12)
    assert np.linalg.det(placed) == pytest.approx(0.01 * 3)
    assert [shuttle(frame, 8) for frame in (0, 2, 4, 8)] == [1, 0, -1, 1]


@pytest.mark.parametrize("name", ["pinkroom", "parlour"])
def test_a_later_part_is_the_same_scene_from_there_on(name: str) -> None:
    whole, later = (scene_from_record({"family": name, "seed": 2, **start}) for start in ({}, {"start": 7}))
    assert later.record == {"family": name, "seed": 2, "start": 7}
    assert isinstance(later, AnimatedScene)
    for frame in (0, 2.5):
        np.testing.assert_array_equal(later.camera(frame).to_world, whole.camera(7 + frame).to_world)
        poses, wanted = later.pose(frame), whole.pose(7 + frame)
        assert poses.keys() == wanted.keys()
        assert all(np.array_equal(poses[shape], wanted[shape]) for shape in poses)
        assert brightness(later, frame) == brightness(whole, 7 + frame)
    assert any(np.any(later.pose(0)[shape] != whole.pose(0)[shape]) for shape in whole.pose(0))
    with pytest.raises(ValueError, match="start: expected a frame"):
        scene_from_record({"family": name, "seed": 2, "start": -1})


@pytest.mark.slow
def test_a_later_part_is_rendered_with_its_motion(mitsuba: Any) -> None:
    """Also in its first frame nothing has moved, as in every clip."""
    from jaxdn.render.frame import render_frame

    whole, later = (scene_from_record({"family": "dash", "seed": 2, **start}) for start in ({}, {"start": 3}))
    size: Any = {"width": 12, "height": 8, "variant": "scalar_rgb"}
    wanted, found = (
        render_frame(whole, 4, RenderSettings(**size)).frame,
        render_frame(later, 1, RenderSettings(**size)).frame,
    )
    for buffer in ("depth", "normal", "albedo", "motion", "visible"):
        np.testing.assert_array_equal(getattr(found, buffer), getattr(wanted, buffer), err_msg=buffer)
    assert np.abs(found.motion).max() > 0.5
    assert not render_frame(later, 0, RenderSettings(**size)).frame.motion.any()
