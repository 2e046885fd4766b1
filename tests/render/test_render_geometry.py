"""Motion vectors against scenes whose motion is known by construction."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import FAR
from jaxdn.ops.motion import dual_motion, occlusion_mask
from jaxdn.render.buffers.gbuffer import GBuffer, trace_gbuffer
from jaxdn.render.buffers.geometry import Motion, View, compute_motion, compute_relative_poses, project
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene import Camera
from tests.render.render_scenes import (
    HEIGHT,
    NEAR,
    PIXEL,
    SQUARE_Z,
    WALL_Z,
    WIDTH,
    Stage,
    fast_variants,
    grey,
    shift,
    turn,
)

COLUMN, ROW = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
CENTRES = np.stack([COLUMN, ROW], axis=-1) + 0.5


@pytest.fixture(params=fast_variants())
def variant(request: pytest.FixtureRequest) -> str:
    return use_variant(request.param)


def view(stage: Stage, frame: int) -> View:
    return View(trace_gbuffer(stage.build(frame, WIDTH, HEIGHT)), stage.camera(frame), stage.pose(frame))


def moved(stage: Stage) -> tuple[View, View, Motion]:
    previous, current = view(stage, 0), view(stage, 1)
    return current, previous, compute_motion(current, previous)


def dual(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """The dual vectors and the mask of disocclusion."""
    traditional = jnp.asarray(motion.motion, jnp.float32)
    result = dual_motion(
        traditional, jnp.asarray(motion.forward_motion, jnp.float32), visible=jnp.asarray(motion.visible[..., 0])
    )
    return np.asarray(result), np.asarray(occlusion_mask(traditional, result))[..., 0] > 0


def tilted(frame: float) -> np.ndarray:
    return shift(0.3 * frame, -0.2 * frame, 0.4 * frame) @ turn(3.0 * frame)


def test_positions_project_onto_their_own_pixel(variant: str) -> None:
    found = view(Stage(camera=tilted), 1)
    hit = found.gbuffer.ids[..., 0] >= 0
    assert hit.any()
    pixels, z = project(found.gbuffer.position, found.camera, (HEIGHT, WIDTH))
    assert np.abs(pixels - CENTRES)[hit].max() < 1e-3
    np.testing.assert_allclose(found.gbuffer.depth[hit], z[hit], rtol=1e-5)


def test_projection_is_mitsubas_own(variant: str) -> None:
    import mitsuba as mi

    scene = Stage(camera=tilted).build(1, WIDTH, HEIGHT)
    sensor = scene.sensors()[0]
    projection: Any = mi.perspective_projection
    to_film = np.array(
        projection([WIDTH, HEIGHT], [WIDTH, HEIGHT], [0, 0], 90.0, NEAR, 1e4).matrix, np.float64
    ).reshape(4, 4)
    to_camera = np.linalg.inv(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4))
    points = np.random.default_rng(0).uniform([-2, -2, 3, 1], [2, 2, 9, 1], (50, 4))
    expected = points @ to_camera.T @ to_film.T
    expected = expected[:, :2] / expected[:, 3:] * [WIDTH, HEIGHT]
    pixels, _ = project(points[:, :3], Camera(tilted(1), 90.0), (HEIGHT, WIDTH))
    np.testing.assert_allclose(pixels, expected, atol=1e-3)


def test_depth_is_along_the_axis_and_ignores_the_near_plane(variant: str) -> None:
    found = view(Stage(), 0).gbuffer
    wall = found.ids[..., 0] == found.names.index("wall")
    square = found.ids[..., 0] == found.names.index("square")
    np.testing.assert_allclose(found.depth[wall], WALL_Z, rtol=1e-5)
    np.testing.assert_allclose(found.depth[square], SQUARE_Z, rtol=1e-5)
    expected = (np.abs(COLUMN + 0.5 - WIDTH / 2) < 3) & (np.abs(ROW + 0.5 - HEIGHT / 2) < 3)
    np.testing.assert_array_equal(square, expected)


def test_a_scene_that_stands_still_has_motion_of_exactly_zero(variant: str) -> None:
    """Two scenes built separately, with a camera at a position that is not round."""
    stage = Stage(camera=lambda frame: tilted(0.7), square=lambda frame: shift(0.1, 0.2, SQUARE_Z) @ turn(20))
    current, _, motion = moved(stage)
    assert np.all(motion.motion == 0)
    assert np.all(motion.forward_motion == 0)
    assert motion.visible.all()
    vectors, mask = dual(motion)
    assert np.all(vectors == 0)
    assert not mask.any()
    np.testing.assert_allclose(motion.previous_depth, current.gbuffer.depth, rtol=1e-5)


@pytest.mark.parametrize("step", [(2, 0), (-3, 0), (0, 2), (1, -2)])
def test_a_square_that_slides_over_a_wall_uncovers_exactly_what_it_covered(variant: str, step: tuple[int, int]) -> None:
    """Image x grows towards world -x and image y towards world -y."""
    right, down = step
    stage = Stage(square=lambda frame: shift(-right * PIXEL * frame, -down * PIXEL * frame, SQUARE_Z))
    current, previous, motion = moved(stage)
    vectors, mask = dual(motion)
    now = current.gbuffer.ids[..., 0] == current.gbuffer.names.index("square")
    before = previous.gbuffer.ids[..., 0] == previous.gbuffer.names.index("square")
    assert now.sum() == before.sum() == 36

    uncovered = before & ~now
    np.testing.assert_array_equal(mask, uncovered)
    np.testing.assert_array_equal(~motion.visible[..., 0], uncovered)
    np.testing.assert_allclose(motion.motion[now], [[-right, -down]] * 36, atol=1e-4)
    assert np.all(motion.motion[~now] == 0)
    # The uncovered pixel takes over its occluder's vector, which points next to the occluder.
    np.testing.assert_allclose(vectors[uncovered], [[-right, -down]] * uncovered.sum(), atol=1e-4)
    target = np.rint(CENTRES - 0.5 + vectors).astype(int)[uncovered]
    assert not before[target[:, 1], target[:, 0]].any()
    assert np.array_equal(vectors[~uncovered], motion.motion[~uncovered].astype(np.float32))


def test_a_camera_that_moves_finds_every_point_again(variant: str) -> None:
    """The previous camera's ray through the place that motion leads to meets the same plane at the same point."""
    current, previous, motion = moved(Stage(camera=tilted))
    to_world = previous.camera.to_world
    target = CENTRES + motion.motion
    scale = WIDTH / 2
    local = np.stack(
        [-(target[..., 0] - WIDTH / 2) / scale, -(target[..., 1] - HEIGHT / 2) / scale, np.ones((HEIGHT, WIDTH))], -1
    )
    ray, origin = local @ to_world[:3, :3].T, to_world[:3, 3]
    for name, height in (("wall", WALL_Z), ("square", SQUARE_Z)):
        shape = current.gbuffer.ids[..., 0] == current.gbuffer.names.index(name)
        assert shape.any()
        point = origin + ray * ((height - origin[2]) / ray[..., 2:])
        assert np.abs(point - current.gbuffer.position)[shape].max() < 1e-3
        seen = shape & motion.visible[..., 0]
        assert seen.sum() > 0.5 * shape.sum()
        np.testing.assert_allclose(motion.previous_depth[..., 0][seen], height - origin[2], rtol=1e-4)


def test_the_sky_turns_with_the_camera_and_has_no_parallax(variant: str) -> None:
    current, _, motion = moved(Stage(wall=False, camera=lambda frame: shift(0.5 * frame, 0, 0)))
    sky = current.gbuffer.ids[..., 0] < 0
    assert sky.any()
    assert np.abs(motion.motion[sky]).max() < 1e-9
    assert np.all(motion.previous_depth[sky] == FAR)
    assert np.all(current.gbuffer.depth[sky] == FAR)

    current, _, motion = moved(Stage(wall=False, camera=lambda frame: turn(5.0 * frame)))
    sky = current.gbuffer.ids[..., 0] < 0
    across = -(CENTRES[..., 0] - WIDTH / 2) / (WIDTH / 2)
    expected = WIDTH / 2 - WIDTH / 2 * np.tan(np.arctan(across) + np.radians(5.0)) - CENTRES[..., 0]
    np.testing.assert_allclose(motion.motion[sky, 0], expected[sky], atol=1e-4)


def flat(ids: list[int], depth: float = 4.0) -> GBuffer:
    """A row of pixels of a plane across the view, id -1 for the sky; 90 degrees of view."""
    count = len(ids)
    across = -(np.arange(count) + 0.5 - count / 2) / (count / 2)
    direction = np.stack([across, np.zeros(count), np.ones(count)], axis=-1)[None]
    number = np.array(ids, np.int32)[None, :, None]
    hit = number >= 0
    return GBuffer(
        albedo=np.ones((1, count, 3), np.float32),
        normal=np.where(hit, [0.0, 0.0, -1.0], 0.0).astype(np.float32),
        depth=np.where(hit, depth, FAR).astype(np.float32),
        roughness=np.ones((1, count, 1), np.float32),
        position=np.where(hit, direction * depth, 0.0),
        direction=direction,
        ids=number,
        names=("a", "b"),
    )


def slide(pixels: float, count: int = 8, depth: float = 4.0) -> np.ndarray:
    """Moves a point at ``depth`` to the right in the image."""
    return shift(-pixels * 2 * depth / count, 0, 0)


def flat_motion(now: list[int], before: list[int], step: float) -> Motion:
    camera = Camera(np.eye(4), 90.0)
    return compute_motion(
        View(flat(now), camera, {"a": slide(step)}),
        View(flat(before), camera, {"a": np.eye(4)}),
    )


def test_a_point_whose_nearest_pixel_was_sky_may_be_proven_seen_by_a_neighbour() -> None:
    """The silhouette was rounded to the other side: pixel 4 came from 3.4, whose nearest pixel, 3, showed sky."""
    rounded = flat_motion([-1, -1, -1, -1, 0, 0, 0, 0], [-1, -1, -1, -1, 0, 0, 0, 0], 0.6)
    assert rounded.visible[0, 4, 0]
    # No neighbour shows it: it was not there before, and the sky's own motion, none here, is what is left.
    spawned = flat_motion([-1, -1, -1, 0, -1, -1, -1, -1], [-1] * 8, 0.6)
    assert not spawned.visible[0, 3, 0]
    assert np.all(spawned.forward_motion == 0)
    assert np.all(dual(spawned)[0][0, 3] == 0)


def test_a_neighbour_proves_nothing_where_another_surface_covered_the_point() -> None:
    """Only the nearest pixel counts there, or the edge of every disocclusion would be missed."""
    covered = flat_motion([1, 1, 1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0, 0, 0], 0.6)
    assert not covered.visible[0, 4, 0]
    assert covered.visible[0, 5:, 0].all()


@pytest.mark.parametrize("change", ["id", "normal", "plane"])
def test_a_point_is_only_seen_before_on_its_own_surface(change: str) -> None:
    camera = Camera(np.eye(4), 90.0)
    now, before = flat([0] * 8), flat([0] * 8)
    if change == "id":
        before = before._replace(ids=np.ones_like(before.ids))
    elif change == "normal":
        before = before._replace(normal=np.broadcast_to(np.array([0.6, 0, -0.8], np.float32), before.normal.shape))
    else:
        before = before._replace(position=before.position + [0, 0, 0.006 * 4.0])
    same = compute_motion(View(now, camera, {}), View(flat([0] * 8), camera, {}))
    other = compute_motion(View(now, camera, {}), View(before, camera, {}))
    assert same.visible.all()
    assert not other.visible.any()


def test_a_point_that_was_behind_the_camera_has_no_history() -> None:
    current = View(flat([0] * 8), Camera(np.eye(4), 90.0), {})
    motion = compute_motion(current, View(flat([0] * 8), Camera(shift(0, 0, 5.0), 90.0), {}))
    assert np.isnan(motion.motion).all()
    assert not motion.visible.any()
    assert np.all(motion.previous_depth == 0)


def test_off_screen_points_were_not_seen() -> None:
    motion = flat_motion([0] * 8, [0] * 8, 3.0)
    np.testing.assert_array_equal(motion.visible[0, :, 0], [False] * 3 + [True] * 5)
    np.testing.assert_allclose(motion.motion[0, :, 0], -3.0, atol=1e-9)


@pytest.mark.parametrize(
    ("start", "end"), [({"a": np.eye(4)}, {}), ({}, {"a": np.eye(4)})], ids=["loses its pose", "gains one"]
)
def test_a_pose_that_appears_or_disappears_raises(start: dict[str, np.ndarray], end: dict[str, np.ndarray]) -> None:
    with pytest.raises(ValueError, match="'a'"):
        compute_relative_poses(("a",), start, end)


def test_shapes_that_appear_or_disappear_raise() -> None:
    camera = Camera(np.eye(4), 90.0)
    with pytest.raises(ValueError, match="none may appear or disappear"):
        compute_motion(View(flat([0]), camera, {}), View(flat([0])._replace(names=("a",)), camera, {}))


@pytest.mark.parametrize(
    ("bsdf", "albedo", "roughness"),
    [
        (grey(0.5), 0.5, 1.0),
        ({"type": "twosided", "b": {"type": "roughconductor", "material": "Au", "alpha": 0.25}}, 0.0, 0.5),
        ({"type": "conductor"}, 0.0, 0.0),
        ({"type": "dielectric"}, 0.0, 0.0),
        ({"type": "principled", "base_color": {"type": "rgb", "value": 0.8}, "roughness": 0.3}, 0.8, 0.3),
        ({"type": "principled", "base_color": {"type": "rgb", "value": 0.8}, "metallic": 0.75}, 0.2, 0.5),
        ({"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": 0.4}}, None, 1.0),
    ],
    ids=["diffuse", "rough gold", "mirror", "glass", "principled", "half metal", "plastic"],
)
def test_albedo_and_roughness_are_those_of_the_lobes(
    variant: str, bsdf: dict[str, object], albedo: float | None, roughness: float
) -> None:
    square = {"type": "sphere", "center": [0, 0, SQUARE_Z], "radius": 1.0, "bsdf": bsdf}
    found = trace_gbuffer(Stage(shapes={"square": square}).build(0, WIDTH, HEIGHT))
    shape = found.ids[..., 0] == found.names.index("square")
    assert shape.any()
    np.testing.assert_allclose(found.roughness[shape], roughness, atol=1e-5)
    assert found.albedo.min() >= 0
    assert found.albedo.max() <= 1
    if albedo is not None:
        np.testing.assert_allclose(found.albedo[shape], albedo, atol=1e-5)
    towards = np.sum(found.normal * found.direction, axis=-1)
    assert towards[found.ids[..., 0] >= 0].max() <= 0
    np.testing.assert_allclose(np.linalg.norm(found.normal[shape], axis=-1), 1, atol=1e-5)


def test_ids_are_places_in_the_sorted_names_whatever_else_is_loaded(variant: str) -> None:
    alive = [Stage().build(0, WIDTH, HEIGHT) for _ in range(2)]
    first, second = trace_gbuffer(alive[1]), trace_gbuffer(Stage().build(0, WIDTH, HEIGHT))
    assert first.names == ("floor", "lamp", "square", "wall")
    np.testing.assert_array_equal(first.ids, second.ids)
    assert first.ids[HEIGHT // 2, WIDTH // 2, 0] == 2
    assert first.ids[0, 0, 0] == 3
