"""Motion blur: the times of the shutter, which sample takes which, and what moving edges become."""

from typing import Any

import numpy as np
import pytest

from jaxdn.render.clip import render_clip
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.shutter import TIMES, choose_samples, list_times
from tests.render.render_scenes import SQUARE_Z, Stage, shift
from tests.render.test_pixel_filters import SCALE, SIZE, SLIDE, check_shares, coverage, measured_coverage

FAST = choose_variant().variant
VARIANTS = sorted({FAST, "scalar_rgb"})
SHUTTER = 0.5
SPEED = 4.0
"""Of the square to the left of the image, in scene units a frame."""


def test_times_are_even_and_unbiased():
    every = np.array([list_times(3, SHUTTER, seed) for seed in range(400)])
    assert every.shape == (400, TIMES)
    assert np.all((every >= 3 - SHUTTER / 2) & (every < 3 + SHUTTER / 2))
    np.testing.assert_allclose(np.diff(every, axis=1), SHUTTER / TIMES, rtol=1e-9)
    begins = (every[:, 0] - 3 + SHUTTER / 2) * TIMES / SHUTTER  # uniform in [0, 1)
    assert abs(begins.mean() - 0.5) < 4 * np.sqrt(1 / 12 / 400)
    np.testing.assert_allclose(begins.var(), 1 / 12, rtol=0.2)


@pytest.mark.parametrize("count", [1, 2, 4, 8, 64, 100])
def test_every_sample_takes_one_time_and_neighbours_spread(count):
    pixels, first = 500, count - 1
    time_of = np.full((pixels, count), -1)
    for time in range(TIMES):
        pixel, sample = choose_samples(SampleStream(1, 2, NOISY), time, pixels, first, count)
        assert np.all(time_of[pixel, sample - first] == -1)
        time_of[pixel, sample - first] = time
    assert np.all(time_of >= 0)
    if count <= TIMES and TIMES % count == 0:  # one in each of `count` equal parts of the shutter's time
        parts = np.sort(time_of * count // TIMES, axis=1)
        np.testing.assert_array_equal(parts, np.broadcast_to(np.arange(count), parts.shape))
    shares = np.bincount(time_of[:, 0], minlength=TIMES) / pixels
    assert np.all(np.abs(shares - 1 / TIMES) < 4.5 * np.sqrt(1 / TIMES / pixels))


def moving_stage() -> Stage:
    stage = Stage(square=lambda frame: shift(SLIDE + SPEED * (frame - 1), 0, SQUARE_Z))
    stage.shutter = SHUTTER
    return stage


def coverage_while_open(times: np.ndarray) -> np.ndarray:
    """The mean over times, of which frame 1 is the middle."""
    return np.mean([coverage(across=-SPEED * SCALE * (time - 1)) for time in times], axis=0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_moving_edges_cover_what_the_geometry_says(variant):
    count = 128 if variant == "scalar_rgb" else 4096
    options: dict[str, Any] = {"pixel_filter": "box", "max_depth": 1, "variant": variant, **SIZE}
    found = render_frame(moving_stage(), 1, RenderSettings(layers=(count,), **options))
    wanted = coverage_while_open(np.array(list_times(1, SHUTTER, 0)))
    check_shares(measured_coverage(found.frame), wanted, count)
    whole = coverage_while_open(1 + SHUTTER * ((np.arange(4000) + 0.5) / 4000 - 0.5))
    assert np.max(np.abs(wanted - whole)) < 0.5 / TIMES + 1e-3  # an edge passes at a time up to half a step away
    assert np.max(np.abs(wanted - coverage())) > 0.25


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_vectors_lie_between_the_middles_of_frames_and_every_image_is_blurred():
    options: dict[str, Any] = {"pixel_filter": "box", "variant": FAST, "light": "reflected", **SIZE}
    stage = moving_stage()
    found = render_frame(stage, 1, RenderSettings(layers=(1, 4), reference_spp=2048, **options))
    assert found.view is not None
    on_square = found.view.gbuffer.ids[..., 0] == found.view.gbuffer.names.index("square")
    # +x is to the left of the image: the square was further to the right.
    wanted = np.broadcast_to([SPEED * SCALE, 0.0], (int(on_square.sum()), 2))
    np.testing.assert_allclose(np.asarray(found.frame.motion)[on_square], wanted, atol=1e-4)
    wanted = coverage_while_open(np.array(list_times(1, SHUTTER, 0)))
    clean = measured_coverage(found.frame._replace(albedo=found.reference_guides["albedo"]))
    check_shares(clean, wanted, 2048)
    # The light of a frame with a shutter is the mean of the light at its times.
    still = Stage(square=lambda frame: shift(SLIDE + SPEED * (frame - 1), 0, SQUARE_Z))
    moments = [
        render_frame(_At(still, time), 0, RenderSettings(layers=(1,), reference_spp=128, seed=index, **options))
        for index, time in enumerate(list_times(1, SHUTTER, 0))
    ]
    mean = np.mean([one.reference for one in moments], axis=0)
    assert found.reference is not None
    np.testing.assert_allclose(found.reference.mean(), mean.mean(), rtol=0.02)


class _At(Stage):
    """A scene that stands still at one time of another."""

    def __init__(self, scene: Stage, time: float) -> None:
        super().__init__()
        self._scene, self._time = scene, time

    def build(self, frame, width, height):
        return self._scene.build(self._time, width, height)


@pytest.mark.slow
def test_a_shutter_needs_filtered_pixels_and_stays_in_records(tmp_path):
    record = {"family": "fruit", "seed": 0, "shutter": 0.4}
    scene = scene_from_record(record)
    assert scene.record == record
    assert scene_from_record({**record, "start": 2}).shutter == 0.4
    with pytest.raises(ValueError, match="motion blur needs filtered pixels"):
        render_frame(scene, 0, RenderSettings(**SIZE))
    for wrong in (-0.1, 1.5, True, "long"):
        with pytest.raises(ValueError, match="shutter: expected a share"):
            scene_from_record({**record, "shutter": wrong})


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_a_blurred_clip_is_resumed_to_the_same_frames(tmp_path):
    options: dict[str, Any] = {"pixel_filter": "box", "variant": FAST, "max_depth": 2, "reference_spp": 2, **SIZE}
    stage = moving_stage()
    render_clip(stage, tmp_path / "whole", RenderSettings(**options), frames=2)
    render_clip(stage, tmp_path / "parts", RenderSettings(**options), frames=1)
    render_clip(stage, tmp_path / "parts", RenderSettings(**options), frames=2)
    for name in ("frame_0000.exr", "frame_0001.exr"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes()
