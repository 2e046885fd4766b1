"""Sub-pixel jitter: where the rays go, what the guides and the motion say of it, and what taa makes of it."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn import Clip, effects
from jaxdn.clips import ClipError
from jaxdn.core.frame import Frame
from jaxdn.data.clip.folder import read_record
from jaxdn.effects import plan
from jaxdn.render.buffers.geometry import project
from jaxdn.render.clip import render_clip
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.scenes.scene import Camera
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing import jitter
from jaxdn.sequence.render_jobs import ClipSource, plan_jobs
from tests.render.render_scenes import HEIGHT, SQUARE_Z, WIDTH, Stage, shift, turn

SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}
FAST = choose_variant().variant
pytestmark = pytest.mark.needs("llvm")


def test_offsets_repeat_and_spread_over_the_pixel():
    offsets = np.array([jitter.get_frame_offset(frame) for frame in range(jitter.PERIOD)])
    assert jitter.get_frame_offset(jitter.PERIOD) == jitter.get_frame_offset(0)
    # The first numbers of the Halton sequence in the bases 2 and 3.
    np.testing.assert_allclose(offsets[:4] + 0.5, [(1 / 2, 1 / 3), (1 / 4, 2 / 3), (3 / 4, 1 / 9), (1 / 8, 4 / 9)])
    assert np.all(np.abs(offsets) < 0.5)
    assert np.all(np.abs(offsets.mean(axis=0)) < 0.07)
    columns, rows = (np.sort(np.floor((offsets[:, axis] + 0.5) * 8)) for axis in (0, 1))
    np.testing.assert_array_equal(columns, np.arange(8))  # one in each eighth
    assert len(np.unique(rows)) >= 6


@pytest.mark.parametrize("variant", sorted({FAST, "scalar_rgb"}))
def test_rays_go_through_the_offset_point(variant):
    use_variant(variant)
    from jaxdn.render.tracing.camera_rays import make_camera_rays

    point = (0.3, -0.2)
    plain, moved = Stage().build(0, WIDTH, HEIGHT), jitter.shift_principal_point(Stage().build(0, WIDTH, HEIGHT), point)
    for column, row in ((0, 0), (5, 11), (WIDTH - 1, HEIGHT - 1)):
        wanted = make_camera_rays(plain.sensors()[0], column + point[0], row + point[1]).d
        found = make_camera_rays(moved.sensors()[0], column, row).d
        np.testing.assert_allclose(np.ravel(found), np.ravel(wanted), atol=2e-7)


@pytest.mark.parametrize("frame", [0, 3])
def test_guides_are_those_of_the_offset_points(frame):
    camera = shift(0.1, 0.2, 0.0) @ turn(10)
    found = render_frame(Stage(camera=lambda frame: camera), frame, RenderSettings(variant=FAST, jitter=True, **SIZE))
    assert found.view is not None
    seen = found.view.gbuffer.ids[..., 0] >= 0
    pixels, _ = project(found.view.gbuffer.position, Camera(camera, 90.0), (HEIGHT, WIDTH))
    centres = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1) + 0.5
    where = (pixels - centres)[seen]
    np.testing.assert_allclose(where, np.broadcast_to(jitter.get_frame_offset(frame), where.shape), atol=1e-3)


def test_a_camera_at_rest_has_no_motion():
    found = render_frame(Stage(), 3, RenderSettings(variant=FAST, jitter=True, **SIZE)).frame
    np.testing.assert_array_equal(found.motion, 0)
    np.testing.assert_array_equal(found.dual_motion, 0)


def test_motion_is_that_of_the_point_without_the_offsets():
    step = 0.4
    stage = Stage(square=lambda frame: shift(step * frame, 0, SQUARE_Z))
    found = render_frame(stage, 2, RenderSettings(variant=FAST, jitter=True, **SIZE))
    assert found.view is not None
    assert found.frame.motion is not None
    on_square = found.view.gbuffer.ids[..., 0] == found.view.gbuffer.names.index("square")
    pixels = step * WIDTH / 2 / SQUARE_Z  # +x is to the left of the image
    wanted = np.broadcast_to([pixels, 0.0], (int(on_square.sum()), 2))
    np.testing.assert_allclose(np.asarray(found.frame.motion)[on_square], wanted, atol=1e-5)


def test_a_clip_goes_on_as_it_would_have_been_and_with_the_same_setting_alone(tmp_path):
    stage = Stage(square=lambda frame: shift(0.2 * frame, 0, SQUARE_Z))
    options: dict[str, Any] = {**SIZE, "variant": FAST, "reference_spp": 3, "jitter": True}
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    render_clip(stage, whole, RenderSettings(**options), frames=3)
    render_clip(stage, parts, RenderSettings(**options), frames=2)
    with pytest.raises(ClipError, match="jitter: True there, False wanted"):
        render_clip(stage, parts, RenderSettings(**{**options, "jitter": False}), frames=3)
    render_clip(stage, parts, RenderSettings(**options), frames=3)
    assert (parts / "frame_0002.exr").read_bytes() == (whole / "frame_0002.exr").read_bytes()
    assert read_record(parts)["jitter"] is True


FINE = 8
TURNED = shift(0.07, 0.03, SQUARE_Z) @ turn(20)


def of_whole_pixels(image: Any) -> np.ndarray:
    return np.asarray(image).reshape(HEIGHT, FINE, WIDTH, FINE, 3).mean(axis=(1, 3))


def deviation(image: Any, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.asarray(image) - truth) ** 2)))


def test_the_reference_is_the_mean_over_the_pixel():
    lamp = {"type": "sphere", "center": [0.1, 0.2, 3], "radius": 0.8}
    lamp["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    options: dict[str, Any] = {"variant": FAST, "reference_spp": 2 * jitter.POSITIONS}
    dense = render_frame(
        Stage(shapes={"shining": lamp}), 0, RenderSettings(width=FINE * WIDTH, height=FINE * HEIGHT, variant=FAST)
    )
    truth = of_whole_pixels(dense.frame.emission)
    centres, whole = (
        render_frame(Stage(shapes={"shining": lamp}), 0, RenderSettings(jitter=on, **SIZE, **options)).frame.emission
        for on in (False, True)
    )
    assert deviation(whole, truth) < 0.15 * deviation(centres, truth)


@pytest.mark.slow
def test_taa_gathers_the_whole_pixel():
    """Of surfaces without light and noise, so that the error is that of edges alone."""
    stage = Stage(square=lambda frame: TURNED)
    dense = render_frame(stage, 0, RenderSettings(width=FINE * WIDTH, height=FINE * HEIGHT, variant=FAST, max_depth=1))
    truth = of_whole_pixels(dense.frame.albedo)
    taa = jaxdn.denoisers.taa(gamma=4.0)
    errors = []
    for on in (False, True):
        seen = [
            render_frame(stage, frame, RenderSettings(jitter=on, variant=FAST, max_depth=1, **SIZE)).frame
            for frame in range(24)
        ]
        radiance, depth = (np.stack([getattr(one, name) for one in seen]) for name in ("albedo", "depth"))
        clip = Clip(Frame(radiance=jnp.asarray(radiance), depth=jnp.asarray(depth)))
        errors.append(deviation(jaxdn.denoise(taa, {}, clip)[-1], truth))
    assert errors[1] < 0.4 * errors[0]


def test_every_frame_of_a_plan_sees_its_own_points_and_nothing_found_through_centres():
    names = ["indirect", "camera-motion", "moving-reflection", "moving-shadow", "glossy"]
    reader = jaxdn.denoisers.trmv()
    found = replace(effects.choose_effects(names, 3), shared_with=(0, 0, 0))
    with_centres, without = plan(found, reader, light="reflected"), plan(found, reader, light="reflected", jitter=True)
    assert set(with_centres.buffers) - set(without.buffers) == {"shadow_motion", "glossy_motion"}
    assert (with_centres.shared_with, without.shared_with) == ((0, 0, 0), (0, 1, 2))
    with pytest.raises(ValueError, match="made for jitter; pass jitter=True"):
        render_frame(
            Stage(), 0, RenderSettings(jitter=True, plan=with_centres, light="reflected", variant=FAST, **SIZE)
        )


def test_jitter_that_the_variant_has_itself_is_refused():
    with pytest.raises(ValueError, match="scalar_rgb spreads its samples over the pixels itself; leave it out"):
        render_frame(Stage(), 0, RenderSettings(jitter=True, variant="scalar_rgb", **SIZE))


def test_the_command_says_what_jitter_leaves_out(tmp_path, capsys):
    settings = RenderSettings(reference_spp=2, jitter=True, **SIZE)
    jobs = plan_jobs(ClipSource("fruit", frames=2, effects="all", denoiser="asvgf"), tmp_path, settings)
    assert "with jitter there is no luminance_gradient: left out" in capsys.readouterr().out
    assert jobs[0].settings.jitter
    assert jobs[0].settings.plan is not None
    assert "luminance_gradient" not in jobs[0].settings.plan.frames[0]
