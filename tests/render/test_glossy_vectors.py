"""Glossy vectors from the real renderer against virtual images whose places are known."""

import numpy as np
import pytest

from jaxdn.render.buffers.geometry import project
from jaxdn.render.buffers.glossy_vectors import ROUGHEST
from tests.render.render_scenes import grey, shift
from tests.render.vector_scenes import HEIGHT, WIDTH, Places, floor, look, rendered

needs_fast = pytest.mark.needs("llvm")  # only vectorised variants sample lobes

MIRROR = {"type": "conductor"}
LAMP = {
    "type": "sphere",
    "place": shift(0, 8, -3),
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 9.0}},
}
WALL_Z = 4.0
WALL = np.diag([30.0, 30.0, 1.0, 1.0]) @ np.diag([-1.0, 1.0, -1.0, 1.0])
"""A square that looks towards -z."""
SIZE = HEIGHT, WIDTH


def metal(alpha):
    return {"type": "roughconductor", "alpha": alpha, "distribution": "ggx"}


def stage(bsdf, *, wall=(0.0, 0.0, 0.0), mirror=(0.0, 0.0, 0.0), camera=(0.0, 0.0, 0.0), shapes=None):
    """A mirror at y = 0 and a wall in it; each moves by so much in a frame."""

    def moving(step, place):
        return lambda frame: shift(*(np.array(step) * frame)) @ place

    def eye(frame):
        at = np.array(camera) * frame
        return look(at + [0, 2.5, -4], at * 0.5)

    parts = {
        "floor": floor(bsdf) | {"place": moving(mirror, floor()["place"])},
        "wall": {"type": "rectangle", "place": moving(wall, shift(0, 0, WALL_Z) @ WALL), "bsdf": grey(0.5)},
        "lamp": LAMP,
    }
    return Places(parts | (shapes or {}), eye)


@pytest.mark.slow
@needs_fast
@pytest.mark.parametrize(
    "moved",
    [
        {"camera": (0.3, 0.1, 0.2)},
        {"wall": (0.4, 0.2, 0.0)},
        {"wall": (0.0, 0.0, -0.5), "camera": (-0.2, 0.0, 0.1)},
        {"mirror": (0.0, 0.2, 0.0)},
        {"mirror": (0.3, -0.1, 0.2), "wall": (-0.2, 0.1, 0.1), "camera": (0.1, 0.1, 0.0)},
    ],
    ids=lambda moved: "-".join(moved),
)
def test_a_flat_mirror_shows_the_mirrored_world(moved):
    """The virtual image is the wall mirrored at y = 0, wherever that was: no search is needed to know it."""
    scene = stage(MIRROR, **moved)
    found = rendered(scene, light="indirect")
    ground = found.frame.ids[..., 0] == found.view.gbuffer.names.index("floor")
    place, direction = (getattr(found.view.gbuffer, name)[ground] for name in ("position", "direction"))
    reflected = direction * [1, -1, 1]
    steps = {name: np.array(moved.get(name, (0.0, 0.0, 0.0))) for name in ("wall", "mirror")}
    reach = (WALL_Z + steps["wall"][2] - place[:, 2]) / reflected[:, 2]
    # Their poses are those of frame 1; in frame 0 both are where they began.
    wall = place + reach[:, None] * reflected - steps["wall"]
    target = project(wall * [1, -1, 1], scene.camera(0), SIZE)[0]
    expected = target - project(place, scene.camera(1), SIZE)[0]
    vectors = found.frame.glossy_motion[ground]
    pixels = (np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1) + 0.5)[ground]
    seen = np.floor(pixels + expected).astype(int)
    before = rendered(scene, 0, light="indirect").frame.ids[..., 0]
    # Some of the wall was below the mirror.
    inside = np.all((seen >= 0) & (seen < [WIDTH, HEIGHT]), axis=-1) & (wall[:, 1] > 0)
    inside[inside] = before[seen[inside, 1], seen[inside, 0]] == found.view.gbuffer.names.index("floor")
    assert inside.sum() > 0.7 * ground.sum() > 100
    np.testing.assert_allclose(vectors[inside], expected[inside], atol=1e-2)
    surface = found.frame.motion[ground]
    assert np.median(np.abs(expected - surface).max(-1)[inside]) > 0.2
    outside = ~inside & (np.abs(wall[:, 1]) > 1e-3)
    np.testing.assert_array_equal(vectors[outside], surface[outside])


RADIUS, CENTRE = 1.5, np.array([0.0, 1.0, 0.5])


def ball(bsdf):
    place = shift(*CENTRE) @ np.diag([RADIUS, RADIUS, RADIUS, 1.0])
    return {"ball": {"type": "sphere", "place": place, "bsdf": bsdf}}


def seen_in_ball(camera, target):
    """What the camera sees by the ball at targets [n, 2] on the wall behind the camera: points [n, 3]. Float64."""
    eye = camera.to_world[:3, 3]
    scale = 2 * np.tan(np.radians(camera.x_fov) / 2) / WIDTH
    x, y = ((target - np.array([WIDTH / 2, HEIGHT / 2])) * scale).T
    direction = np.stack([-x, -y, np.ones_like(x)], -1) @ camera.to_world[:3, :3].T
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    middle = direction @ (CENTRE - eye)
    inside = RADIUS**2 - np.sum((eye + middle[:, None] * direction - CENTRE) ** 2, axis=-1)
    place = eye + (middle - np.sqrt(np.where(inside > 0, inside, np.nan)))[:, None] * direction
    normal = (place - CENTRE) / RADIUS
    onward = direction - 2 * np.sum(direction * normal, -1, keepdims=True) * normal
    return place + ((BACK - place[:, 2]) / np.where(onward[:, 2] < 0, onward[:, 2], np.nan))[:, None] * onward


BACK = -7.0


@needs_fast
@pytest.mark.parametrize("moved", ["camera", "wall"])
def test_a_curved_mirror_is_followed_to_where_it_showed_the_same(moved):
    """At the vector's target the ball must have shown the same point of the wall behind the camera.

    The tolerance: the search is linear within a pixel. Of F(q) over a ball its second derivative is about F' over the
    ball's radius in pixels (here 14), so half a pixel away it leaves 0.5^2 / 2 / 14 = 0.01 of what one pixel spans; the
    differences over two pixels are off by about as much, and towards the rim, where the sight grazes, all are worse.
    """
    step = np.array([0.5, 0.3, 0.0])
    behind = shift(0, 0, BACK) @ np.diag([60.0, 60.0, 1.0, 1.0])
    back = {
        "type": "rectangle",
        "place": (lambda frame: shift(*(step * frame)) @ behind) if moved == "wall" else behind,
        "bsdf": grey(0.5),
    }
    camera = (0.25, 0.1, 0.0) if moved == "camera" else (0.0, 0.0, 0.0)
    scene = stage(grey(0.2), camera=camera, shapes=ball(MIRROR) | {"back": back})
    found = rendered(scene, light="indirect")
    on_ball = found.frame.ids[..., 0] == found.view.gbuffer.names.index("ball")
    pixels = (np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1) + 0.5)[on_ball]
    shown = seen_in_ball(scene.camera(1), pixels) - (step if moved == "wall" else 0.0)
    # Around the rim a pixel spans much of the world; below, the floor is seen.
    calm = np.isfinite(shown[:, 0]) & (shown[:, 1] > 0) & (np.abs(shown).max(-1) < 12)

    def missed(vectors):
        there = seen_in_ball(scene.camera(0), pixels + vectors)
        beside = seen_in_ball(scene.camera(0), pixels + vectors + [1.0, 0.0])
        span = np.linalg.norm(beside - there, axis=-1)
        return np.linalg.norm(there - shown, axis=-1)[calm] / span[calm]

    error = missed(found.frame.glossy_motion[on_ball])
    surface = missed(found.frame.motion[on_ball])
    assert calm.sum() > 80
    assert np.median(error) < 0.02
    assert np.nanquantile(error, 0.9) < 0.1
    assert np.isfinite(error).mean() > 0.9
    assert np.median(surface) > 10 * np.median(error)


@pytest.mark.slow
@needs_fast
def test_a_rough_mirror_has_the_vectors_of_its_microfacets():
    """Around those of a mirror, the more so the smoother it is; beyond a roughness of 0.6 none."""
    wall = {"wall": (0.4, 0.2, 0.0)}
    plain = rendered(stage(MIRROR, **wall), light="indirect").frame.glossy_motion
    spread = []
    for alpha in (0.02, 0.1):
        frame = rendered(stage(metal(alpha), **wall), light="indirect").frame
        ground = np.abs(plain).max(-1) > 0
        assert np.abs(frame.glossy_motion[ground]).max() > 0
        spread.append(np.median(np.abs(frame.glossy_motion - plain)[ground]))
    assert 0 < spread[0] < spread[1] < 1.0
    rough = rendered(stage(metal(ROUGHEST**2 + 0.02), **wall), light="indirect").frame
    np.testing.assert_array_equal(rough.glossy_motion, rough.motion)


@needs_fast
@pytest.mark.parametrize("bsdf", [grey(0.5), {"type": "dielectric"}])
def test_what_is_diffuse_or_lets_light_through_keeps_its_own_motion(bsdf):
    frame = rendered(stage(bsdf, wall=(0.4, 0.2, 0.0), camera=(0.1, 0, 0)), light="indirect").frame
    ground = frame.roughness[..., 0] == (0 if bsdf["type"] == "dielectric" else 1)
    if bsdf["type"] == "dielectric":  # some of its samples are reflected
        assert np.mean(np.all(frame.glossy_motion == frame.motion, axis=-1)[ground]) > 0.5
    else:
        np.testing.assert_array_equal(frame.glossy_motion, frame.motion)


@needs_fast
def test_what_stands_still_does_not_move():
    assert not np.any(rendered(stage(MIRROR), light="indirect").frame.glossy_motion)


@pytest.mark.slow
@needs_fast
def test_what_a_thing_in_the_mirror_hid_takes_over_the_motion_of_its_image():
    """A board slides in front of the wall: behind its image the mirror shows the wall again, which stands still."""

    def board(frame):
        return shift(0.6 - 0.35 * frame, 0.5, 2.5) @ np.diag([0.5, 0.5, 1.0, 1.0]) @ np.diag([-1.0, 1.0, -1.0, 1.0])

    scene = stage(MIRROR, shapes={"board": {"type": "rectangle", "place": board, "bsdf": grey(0.8)}})
    found = rendered(scene, light="indirect")
    ground = found.frame.ids[..., 0] == found.view.gbuffer.names.index("floor")
    place, direction = (getattr(found.view.gbuffer, name)[ground] for name in ("position", "direction"))
    reflected = direction * [1, -1, 1]
    seen = place + ((2.5 - place[:, 2]) / reflected[:, 2])[:, None] * reflected

    def on_board(frame):
        return np.all(np.abs(seen[:, :2] - board(frame)[:2, 3]) < 0.49, axis=-1) & (place[:, 2] < 2.5)

    now, before = on_board(1), on_board(0)
    assert (now & before).any()
    left = before & ~np.all(np.abs(seen[:, :2] - board(1)[:2, 3]) < 0.51, axis=-1)
    assert left.sum() >= 5
    vectors = found.frame.glossy_motion[ground]
    moved = project((seen + [0.35, 0, 0]) * [1, -1, 1], scene.camera(0), SIZE)[0]
    expected = moved - project(seen * [1, -1, 1], scene.camera(1), SIZE)[0]
    np.testing.assert_allclose(vectors[now], expected[now], atol=1e-2)
    # The board's own image at the pixel as it was then: a little elsewhere on a slanted way, by less than a tenth.
    back = project(seen * [1, -1, 1], scene.camera(0), SIZE)[0]
    ahead = project((seen - [0.35, 0, 0]) * [1, -1, 1], scene.camera(1), SIZE)[0]
    np.testing.assert_allclose(vectors[left], (back - ahead)[left], atol=2e-2)
    calm = ~now & ~before & np.all(np.abs(seen[:, :2] - board(0)[:2, 3]) > 0.6, axis=-1)
    np.testing.assert_array_equal(vectors[calm], 0)
