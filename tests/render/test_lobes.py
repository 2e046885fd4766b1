"""Diffuse and specular light apart, hit distances, and what virtual motion needs, from the real renderer."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import jaxdn
from jaxdn import effects
from jaxdn.clips import read_clip
from jaxdn.core.frame import FAR, GUIDES, OF_SAMPLES, ON_REQUEST, present
from jaxdn.data.training.cache import open_cached, read_window
from jaxdn.planning.catalogue import OF_SHADOWS
from jaxdn.render.clip import render_clip
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.settings import RenderSettings
from tests.render.render_scenes import HEIGHT, WALL_Z, WIDTH, Stage, grey, shift, turn

FAST = choose_variant().variant
SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
GAP = 2.5
"""Distance between the two planes."""
USUAL = ON_REQUEST - OF_SHADOWS
"""What a clip of indirect light has on request."""
READER = jaxdn.denoisers.svgf()._replace(reads=frozenset(GUIDES))
"""Reads every buffer."""

needs_fast = pytest.mark.needs("llvm")  # only vectorised variants tell lobes apart

MIRROR = {"type": "conductor"}
METAL = {"type": "roughconductor", "alpha": 0.2, "distribution": "ggx"}
PLASTIC = {"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0, "diffuse_reflectance": {"type": "rgb", "value": 0.6}}
GLOSSY = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": {"type": "rgb", "value": 0.6}}


def everything(frames=1):
    return effects.plan(effects.choose_all_effects(frames), READER)


class Walled(Stage):
    """The stage with a wall of any material."""

    def __init__(self, bsdf, **options):
        super().__init__(wall=False, **options)
        self.bsdf = bsdf

    def rectangles(self):
        """Name -> place, size, material."""
        return {"wall": (shift(0, 0, WALL_Z) @ turn(180), 40.0, self.bsdf)}

    def build(self, frame, width, height):
        import mitsuba as mi

        self._extra = {
            name: {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f(place @ np.diag([size, size, 1, 1])),
                "bsdf": bsdf,
            }
            for name, (place, size, bsdf) in self.rectangles().items()
        }
        return super().build(frame, width, height)


class Gap(Walled):
    """The camera stands 2 in front of the wall; a parallel one may be behind it. All else is behind that."""

    def __init__(self, bsdf, *, opposite=True):
        super().__init__(bsdf, camera=lambda frame: shift(0, 0, WALL_Z - 2.0))
        self.opposite = opposite

    def rectangles(self):
        back = {"back": (shift(0, 0, WALL_Z - GAP), 100.0, grey(0.5))} if self.opposite else {}
        floor = {"floor": (shift(0, 0, -20.0), 1.0, grey(0.5))}
        return {"wall": (shift(0, 0, WALL_Z) @ turn(180), 100.0, self.bsdf), **back, **floor}


def rendered(scene, **options):
    found = render_frame(scene, 0, RenderSettings(**{**SIZE, "plan": everything(), "variant": FAST, **options}))
    return found.frame


@needs_fast
@pytest.mark.parametrize("bsdf", [GLOSSY, METAL, grey(0.5)])
def test_requesting_the_parts_leaves_everything_else_bit_for_bit(bsdf):
    scene = Walled(bsdf)
    whole = rendered(scene)
    assert set(present(whole)) >= USUAL
    usual = render_frame(scene, 0, RenderSettings(**SIZE, variant=FAST)).frame
    assert not set(present(usual)) & ON_REQUEST
    for name in ("radiance", *present(usual)):
        np.testing.assert_array_equal(getattr(usual, name), getattr(whole, name), err_msg=name)


@needs_fast
def test_the_specular_part_is_between_nothing_and_all():
    scene = Walled(GLOSSY)
    frame = rendered(scene, layers=(8, 16))
    assert np.all((frame.specular >= 0) & (frame.specular <= frame.radiance))
    assert np.any((frame.specular > 0) & (frame.specular < frame.radiance))
    assert np.all(frame.specular_reflectance <= frame.reflectance)
    # One sample is either one or the other.
    one = rendered(scene)
    either = (one.specular == 0) | (one.specular == one.radiance)
    assert np.all(either)
    assert np.all((one.hit_distance == 0) | (one.specular_hit_distance == 0))


@needs_fast
def test_a_diffuse_scene_has_no_specular_light():
    frame = rendered(Stage(), layers=(4,))
    assert np.mean(frame.radiance) > 0
    for name in ("specular", "specular_hit_distance", "specular_reflectance"):
        assert not np.any(getattr(frame, name)), name
    assert np.all(frame.hit_distance[frame.ids >= 0] > 0)


@needs_fast
@pytest.mark.parametrize("bsdf", [MIRROR, METAL])
def test_a_metal_has_specular_light_alone(bsdf):
    frame = rendered(Walled(bsdf), layers=(4,))
    wall = frame.ids[..., 0] == np.max(frame.ids)
    assert np.mean(frame.radiance[wall]) > 0
    np.testing.assert_array_equal(frame.specular[wall], frame.radiance[wall])
    np.testing.assert_array_equal(frame.specular_reflectance[wall], frame.reflectance[wall])
    assert not np.any(frame.hit_distance[wall])


@needs_fast
def test_a_mirror_sees_the_parallel_plane_at_its_distance():
    frame = rendered(Gap(MIRROR))
    # The stage's camera has 90 degrees across.
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / (WIDTH / 2)
    y = (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / (WIDTH / 2)
    slant = np.sqrt(1 + x[None, :, None] ** 2 + y[:, None, None] ** 2)
    np.testing.assert_allclose(frame.ray_length, 2.0 * slant, rtol=1e-4)
    # Rays begin a few ten-thousandths in front of the surface, so as not to hit it again.
    np.testing.assert_allclose(frame.specular_hit_distance, GAP * slant, rtol=3e-4)


@needs_fast
def test_a_diffuse_plane_sees_the_parallel_plane_at_two_thirds_of_the_inverse_distance():
    # Directions with a density of cos / pi: the mean of GAP / length = cos is 2/3, its standard deviation 0.236.
    frame = rendered(Gap(grey(0.5)), width=96, height=64)
    assert np.all(frame.hit_distance >= GAP * (1 - 1e-4))
    assert abs(np.mean(GAP / frame.hit_distance) - 2 / 3) < 4 * 0.236 / np.sqrt(96 * 64)


@needs_fast
def test_what_leaves_the_scene_is_far_away():
    frame = rendered(Gap(MIRROR, opposite=False))
    # In the middle the square is reflected, and the lamp above it.
    assert np.all(frame.specular_hit_distance[:, [0, -1]] == FAR)
    assert np.any(frame.specular_hit_distance < 10)


@needs_fast
def test_the_specular_reflectance_of_plastic_is_its_fresnel_reflectance():
    frame = rendered(Gap(PLASTIC))
    cosine = (frame.depth / frame.ray_length).astype(np.float64)
    inside = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
    parallel = (1.5 * cosine - inside) / (1.5 * cosine + inside)
    across = (cosine - 1.5 * inside) / (cosine + 1.5 * inside)
    expected = (parallel**2 + across**2) / 2
    np.testing.assert_allclose(
        frame.specular_reflectance, np.broadcast_to(expected, (*expected.shape[:2], 3)), atol=2e-3
    )


def test_infinity_turns_with_the_camera_and_does_not_move_with_it():
    plan = everything(2)._replace(frames=(tuple(name for name in GUIDES if name not in OF_SAMPLES),) * 2)
    options: dict[str, Any] = {**SIZE, "variant": "scalar_rgb", "plan": plan}
    moved = render_frame(Stage(camera=lambda frame: shift(0.1 * frame, 0, 0)), 1, RenderSettings(**options)).frame
    assert np.max(np.abs(moved.far_motion)) < 1e-5
    assert np.min(np.abs(moved.motion[..., 0])) > 0.1
    turned = render_frame(Stage(camera=lambda frame: turn(3.0 * frame)), 1, RenderSettings(**options)).frame
    np.testing.assert_allclose(turned.far_motion, turned.motion, atol=1e-4)
    assert np.min(np.abs(turned.far_motion[..., 0])) > 0.1
    still = render_frame(Stage(square=lambda frame: shift(frame, 0, 3)), 1, RenderSettings(**options)).frame
    assert not np.any(still.far_motion)


def test_the_scalar_variant_refuses_what_it_cannot_render():
    with pytest.raises(
        ValueError, match="scalar_rgb cannot render glossy_motion, hit_distance, specular, specular_hit_distance"
    ):
        render_frame(Stage(), 0, RenderSettings(**SIZE, variant="scalar_rgb", plan=everything()))


@needs_fast
def test_buffers_of_samples_are_each_frames_own_and_belong_to_one_layer(tmp_path):
    # Both frames show the same: the second one's file holds its noise alone.
    still = replace(effects.choose_effects(["indirect", "specular"], 2), shared_with=(0, 0))
    plan = effects.plan(still, READER)
    scene = Walled(GLOSSY)
    render_clip(
        scene, tmp_path, RenderSettings(**SIZE, layers=(1, 2), reference_spp=2, variant=FAST, plan=plan), frames=2
    )
    clip = read_clip(tmp_path)
    assert set(present(clip.frames)) >= {"specular", "hit_distance", "specular_hit_distance"}
    assert not np.array_equal(clip.frames.specular[0], clip.frames.specular[1])
    assert np.all((clip.frames.specular == 0) | (clip.frames.specular == clip.frames.radiance))
    np.testing.assert_array_equal(clip.frames.albedo[0], clip.frames.albedo[1])
    with pytest.warns(UserWarning, match=r"spp 2: left out hit_distance, specular, .* layer of 1 spp"):
        other = read_clip(tmp_path, spp=2)
    assert not set(present(other.frames)) & OF_SAMPLES

    cached, window = open_cached(tmp_path), (slice(2), slice(8), slice(8))
    np.testing.assert_array_equal(read_window(cached, window).frames.specular, clip.frames.specular[:, :8, :8])
    light = (clip.frames.radiance[:, :8, :8], clip.reference[:, :8, :8])
    assert not set(present(read_window(cached, window, light=light).frames)) & OF_SAMPLES
    assert not set(present(read_window(cached, window, spp=3).frames)) & OF_SAMPLES


def test_only_a_denoiser_that_reads_them_gets_them():
    found = effects.choose_all_effects(1)
    assert not ON_REQUEST & set(effects.plan(found).buffers)
    assert not ON_REQUEST & set(effects.plan(found, jaxdn.denoisers.svgf()).buffers)
    assert set(effects.plan(found, READER).buffers) >= USUAL
    assert set(effects.plan(found, READER, light="reflected").buffers) >= ON_REQUEST
