"""Shadow vectors from the real renderer against shadows whose places are known."""

from typing import Any

import numpy as np
import pytest

import jaxdn
from jaxdn import effects
from jaxdn.core.frame import GUIDES, OF_SAMPLES, present
from jaxdn.planning.catalogue import OF_SHADOWS
from jaxdn.render.buffers.geometry import project
from jaxdn.render.buffers.shadow_vectors import intersect_plane
from jaxdn.render.frame import render_frame
from jaxdn.render.settings import RenderSettings
from tests.render.render_scenes import grey, shift
from tests.render.vector_scenes import FAST, HEIGHT, WIDTH, Places, floor, look, rendered

needs_fast = pytest.mark.needs("llvm")  # only vectorised variants tell light apart

RADIUS = 0.6
BALL, LAMP = np.array([0.0, 1.5, 0.0]), np.array([0.5, 5.0, 0.3])
STEP = np.array([0.2, 0.0, 0.1])
BRIGHT: dict[str, Any] = {"type": "rgb", "value": 30.0}


def scene(light: dict[str, Any], *, ball=STEP, camera=(0.0, 0.0, 0.0)):
    """A ball over a floor; ``ball`` and ``camera`` move by so much in a frame."""

    def place(frame):
        return shift(*(BALL + np.array(ball) * frame)) @ np.diag([RADIUS, RADIUS, RADIUS, 1.0])

    def eye(frame):
        at = np.array(camera) * frame
        return look(at + [0, 4, -5], at)

    return Places({"floor": floor(), "ball": {"type": "sphere", "place": place, "bsdf": grey(0.5)}, "lamp": light}, eye)


SUN: dict[str, Any] = {"type": "directional", "direction": [0.0, -1.0, 0.0], "irradiance": BRIGHT}
POINT: dict[str, Any] = {"type": "point", "position": LAMP.tolist(), "intensity": BRIGHT}


def moving_lamp(step):
    """A lamp as small as a point, whose shape has a pose."""
    return {
        "type": "sphere",
        "place": lambda frame: shift(*(LAMP + np.array(step) * frame)) @ np.diag([1e-3, 1e-3, 1e-3, 1.0]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1e6}},
    }


def blocker(places, lamp, ball):
    """Where rays from points [n, 3] to a lamp meet a ball, nearest to the points; NaN where they miss. Float64."""
    onward = lamp - places
    onward = onward / np.linalg.norm(onward, axis=-1, keepdims=True)
    middle = np.sum((ball - places) * onward, axis=-1)
    inside = RADIUS**2 - np.sum((places + middle[:, None] * onward - ball) ** 2, axis=-1)
    near = middle - np.sqrt(np.where(inside > 0, inside, np.nan))
    return places + near[:, None] * onward


def on_floor(lamp, point):
    """Where rays from a lamp through points meet y = 0."""
    onward = point - lamp
    return lamp - onward * (lamp[1] / onward[:, 1:2])


@pytest.mark.slow
@needs_fast
@pytest.mark.parametrize(
    ("ball", "lamp_step", "camera"),
    [
        (STEP, (0, 0, 0), (0, 0, 0)),
        ((0, 0, 0), (-0.5, 0.2, 0.1), (0, 0, 0)),
        (STEP, (0.3, 0, -0.2), (0.1, 0.05, 0)),
        ((0.3, 0.2, 0.0), (0, 0, 0), (0.2, 0, 0)),
    ],
)
def test_the_shadow_of_a_ball_is_found_where_it_lay(ball, lamp_step, camera):
    stage = scene(moving_lamp(lamp_step), ball=ball, camera=camera)
    found = rendered(stage)
    view = found.view
    places = view.gbuffer.position.reshape(-1, 3)
    ground = view.gbuffer.ids.ravel() == view.gbuffer.names.index("floor")
    lamps, balls = ([start + np.array(step) * k for k in (0, 1)] for start, step in ((LAMP, lamp_step), (BALL, ball)))

    now = blocker(places, lamps[1], balls[1])
    lay = on_floor(lamps[0], now + balls[0] - balls[1])
    size = HEIGHT, WIDTH
    under = project(lay, stage.camera(0), size)[0] - project(places, stage.camera(1), size)[0]
    then = blocker(places, lamps[0], balls[0])
    lies = on_floor(lamps[1], then + balls[1] - balls[0])
    left = project(places, stage.camera(0), size)[0] - project(lies, stage.camera(1), size)[0]

    vectors = found.frame.shadow_motion.reshape(-1, 2)
    # The lamp has a radius of 1e-3, and rays start a little above surfaces: leave out the shadow's edge itself.
    edge = np.zeros((HEIGHT, WIDTH), bool)
    shadow = (ground & np.isfinite(now[:, 0])).reshape(size)
    for axis in (0, 1):
        for sign in (1, -1):
            edge |= shadow != np.roll(shadow, sign, axis)
    shadowed = shadow.ravel() & ~edge.ravel()
    trail = ground & np.isfinite(then[:, 0]) & np.isnan(now[:, 0]) & ~edge.ravel()
    shown = ~np.isclose(vectors, found.frame.motion.reshape(-1, 2), atol=1e-6).all(-1)
    assert shadowed.sum() > 30
    assert trail.sum() >= 3
    # The ball hides some of the floor where the shadow lay.
    assert (shown & shadowed).sum() >= 0.8 * shadowed.sum()
    np.testing.assert_allclose(vectors[shown & shadowed], under[shown & shadowed], atol=0.02)
    assert (shown & trail).sum() >= 0.5 * trail.sum()
    np.testing.assert_allclose(vectors[shown & trail], left[shown & trail], atol=0.02)
    target = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).reshape(-1, 2) + 0.5 + vectors
    column, row = np.floor(target[shown & trail]).astype(int).T
    before = rendered(stage, 0)
    hidden = before.frame.shadowed.sum(-1) < before.frame.unshadowed.sum(-1)
    assert np.mean(hidden[row, column]) < 0.2  # the trail takes its history from beside the old shadow


@pytest.mark.slow
@needs_fast
def test_under_a_sun_in_the_zenith_the_shadow_moves_as_the_ball_does():
    stage = scene(SUN)
    found = rendered(stage)
    places = found.view.gbuffer.position
    moved = project(places - STEP, stage.camera(0), (HEIGHT, WIDTH))[0]
    expected = moved - project(places, stage.camera(1), (HEIGHT, WIDTH))[0]
    shadow = found.frame.unshadowed.sum(-1) > found.frame.shadowed.sum(-1)
    shadow &= found.frame.ids[..., 0] == found.view.gbuffer.names.index("floor")
    shown = shadow & (np.abs(found.frame.shadow_motion).max(-1) > 0)
    assert shown.sum() > 20
    np.testing.assert_allclose(found.frame.shadow_motion[shown], expected[shown], atol=1e-2)


@pytest.mark.slow
@needs_fast
@pytest.mark.parametrize("light", [SUN, POINT, {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}])
def test_what_stands_still_has_the_surfaces_vectors_exactly(light):
    for camera in ((0, 0, 0), (0.2, 0.1, 0)):
        frame = rendered(scene(light, ball=(0, 0, 0), camera=camera)).frame
        np.testing.assert_array_equal(frame.shadow_motion, frame.motion)


@pytest.mark.slow
@needs_fast
def test_light_without_shadow_is_what_a_scene_without_blocker_shows():
    lit = scene(POINT)
    frame = rendered(lit, 0, layers=(4,)).frame
    lit._shapes = {name: shape for name, shape in lit._shapes.items() if name != "ball"}
    free = rendered(lit, 0, layers=(4,)).frame
    ground = np.isclose(frame.depth, free.depth)[..., 0]
    np.testing.assert_allclose(frame.unshadowed[ground], free.shadowed[ground], rtol=1e-5)
    assert np.all(frame.shadowed <= frame.unshadowed)
    assert np.all(frame.shadowed <= frame.radiance * (1 + 1e-5))
    shadow = ground & (frame.shadowed.sum(-1) == 0)
    assert 30 < shadow.sum() < 0.2 * shadow.size
    # A point light is found by its samples alone: all of the direct light is one or the other.
    whole = render_frame(lit, 0, RenderSettings(width=WIDTH, height=HEIGHT, layers=(4,), variant=FAST)).frame
    np.testing.assert_allclose(free.shadowed, whole.direct, rtol=1e-4, atol=1e-6)


GLOSSY = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": {"type": "rgb", "value": 0.4}}


@pytest.mark.slow
@needs_fast
@pytest.mark.parametrize("bsdf", [grey(0.6), GLOSSY])
def test_noisy_direct_light_has_the_mean_of_direct_light(bsdf):
    stage = scene({**moving_lamp((0, 0, 0)), "place": shift(0.5, 4, 0) @ np.diag([0.5, 0.5, 0.5, 1.0])})
    stage._shapes["lamp"]["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 10.0}}
    stage._shapes["floor"] = floor(bsdf)
    frame = rendered(stage, 0, layers=(64,)).frame
    apart = render_frame(stage, 0, RenderSettings(width=WIDTH, height=HEIGHT, layers=(64,), variant=FAST)).frame
    assert frame.direct is None
    np.testing.assert_allclose(frame.radiance, apart.radiance + apart.direct, rtol=1e-5, atol=1e-6)
    specular = frame.specular.mean() / frame.radiance.mean()
    assert (specular < 1e-6) if bsdf != GLOSSY else (0.02 < specular < 0.9)
    assert np.all(frame.shadowed + frame.specular <= frame.radiance * (1 + 1e-4) + 1e-6)


@needs_fast
def test_a_frame_alone_is_the_same_bit_for_bit():
    stage = scene(moving_lamp((0.1, 0, 0)))
    alone = rendered(stage).frame
    after = rendered(stage, previous=rendered(stage, 0).view).frame
    for name in ("radiance", *present(alone)):
        np.testing.assert_array_equal(getattr(alone, name), getattr(after, name), err_msg=name)
    first = rendered(stage, 0).frame
    assert not np.any(first.shadow_motion)
    assert not np.any(first.glossy_motion)


@needs_fast
def test_the_buffers_leave_everything_else_bit_for_bit():
    stage = scene(moving_lamp((0.1, 0, 0)))
    options: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "light": "reflected", "variant": FAST}
    usual = render_frame(stage, 1, RenderSettings(**options)).frame
    whole = rendered(stage).frame
    assert not set(present(usual)) & OF_SHADOWS
    assert set(present(whole)) >= OF_SHADOWS
    for name in ("radiance", *present(usual)):
        np.testing.assert_array_equal(getattr(usual, name), getattr(whole, name), err_msg=name)


def test_rays_that_do_not_meet_the_plane():
    up, origin = np.array([0.0, 1.0, 0.0]), np.zeros(3)
    near = np.array([0.0, 4.0, 0.0, 1.0])
    np.testing.assert_allclose(intersect_plane(near, np.array([1.0, 2.0, 0.0]), origin, up), [2.0, 0.0, 0.0])
    assert np.isnan(intersect_plane(near, np.array([1.0, 4.0, 0.0]), origin, up)).all()  # grazing
    assert np.isnan(intersect_plane(near, np.array([1.0, 5.0, 0.0]), origin, up)).all()  # away from it
    assert np.isnan(intersect_plane(near, np.array([0.0, -1.0, 0.0]), origin, up)).all()  # behind it
    sun = np.array([0.6, 0.8, 0.0, 0.0])
    np.testing.assert_allclose(intersect_plane(sun, np.array([0.0, 0.8, 1.0]), origin, up), [-0.6, 0.0, 1.0])


def test_they_are_planned_where_something_moves_and_direct_light_is_noisy():
    reader = jaxdn.denoisers.trmv()
    moving = effects.choose_effects(["moving-shadow", "indirect"], 2)
    assert set(effects.plan(moving, reader, light="reflected").buffers) >= OF_SHADOWS
    assert "direct" not in effects.plan(moving, reader, light="reflected").buffers
    assert not OF_SHADOWS & set(effects.plan(moving, reader).buffers)
    assert not OF_SHADOWS & set(effects.plan(moving, jaxdn.denoisers.svgf(), light="reflected").buffers)
    still = effects.choose_effects(["indirect", "glossy"], 2)
    assert not (OF_SHADOWS | {"glossy_motion"}) & set(effects.plan(still, reader, light="reflected").buffers)
    mirrored = effects.choose_effects(["indirect", "moving-reflection"], 2)
    assert "glossy_motion" in effects.plan(mirrored, reader).buffers
    # Direct light alone is to be denoised where it is noisy.
    shadow = effects.choose_effects(["moving-shadow"], 2)
    assert [effects.plan(shadow, reader, light=light).indirect for light in ("indirect", "reflected")] == [False, True]


def test_a_plan_for_other_light_is_refused():
    plan = effects.plan(effects.choose_effects(["indirect"], 1))._replace(frames=(("direct",),))
    with pytest.raises(ValueError, match="light='reflected'"):
        render_frame(scene(SUN), 0, RenderSettings(width=4, height=4, light="reflected", plan=plan))
    with pytest.raises(ValueError, match="draws: expected 0"):
        render_frame(scene(SUN), 0, RenderSettings(width=4, height=4, light="reflected", draws=1))
    with pytest.raises(ValueError, match="light: expected one of"):
        render_frame(scene(SUN), 0, RenderSettings(width=4, height=4, light="direct"))


def test_the_scalar_variant_refuses_them():
    plan = effects.plan(effects.choose_all_effects(1), jaxdn.denoisers.trmv(), light="reflected")
    assert set(plan.buffers) & OF_SAMPLES
    assert set(plan.buffers) <= set(GUIDES)
    with pytest.raises(ValueError, match=r"scalar_rgb cannot render .*shadow_motion"):
        render_frame(
            scene(SUN), 0, RenderSettings(width=4, height=4, variant="scalar_rgb", light="reflected", plan=plan)
        )
