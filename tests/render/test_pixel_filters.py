"""Pixel filters: their moments, what edges, guides and lenses make of them, in clips as well as in frames."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jaxdn.data.clip.folder import read_frames, read_record
from jaxdn.data.errors import ClipError
from jaxdn.render.clip import render_clip
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.scenes.optics import describe_optics
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.pixel_filters import PIXEL_FILTERS, draw_offsets, evaluate_filter
from tests.render.render_scenes import PIXEL, SQUARE_Z, Stage, shift

FAST = choose_variant().variant
VARIANTS = sorted({FAST, "scalar_rgb"})
FILTERED = [name for name in PIXEL_FILTERS if name != "centre"]
SIZE: dict[str, Any] = {"width": 12, "height": 8}
SQUARE, WALL = 0.5, 0.7
"""Albedos."""
SCALE = 12 / 2 / SQUARE_Z
"""Pixels of a unit of length at the square's depth."""
SLIDE = 0.03
"""Of the square to the left, in scene units."""


def moment(name: Any, order: int) -> float:
    """Of the filter's own density, by the midpoint rule."""
    step = 3.0 / 400_000
    offset = -1.5 + (np.arange(400_000) + 0.5) * step
    weight = evaluate_filter(name, offset)
    return float(np.sum(weight * offset**order) / np.sum(weight))


@pytest.mark.parametrize("name", FILTERED)
def test_offsets_have_the_moments_of_the_filter(name):
    uniform = (np.arange(200_000) + 0.5) / 200_000
    offset = draw_offsets(name, uniform)
    assert abs(offset.mean()) < 1e-12
    for order in (2, 4):
        np.testing.assert_allclose(np.mean(offset**order), moment(name, order), rtol=2e-3)


def test_moments_are_those_of_textbooks():
    assert moment("box", 2) == pytest.approx(1 / 12, rel=2e-5)
    # A Gaussian cut at four standard deviations loses 8 phi(4) / 0.99994 of its variance.
    assert moment("gaussian", 2) == pytest.approx(0.375**2 * (1 - 8 * np.exp(-8) / np.sqrt(2 * np.pi)), rel=1e-4)
    # The integral of u^2 cos(2 pi k u) over [-1/2, 1/2] is (-1)^k / (2 pi^2 k^2).
    cosines = -0.48829 + 0.14128 / 4 - 0.01168 / 9
    assert moment("blackman-harris", 2) == pytest.approx(9 * (1 / 12 + cosines / (2 * np.pi**2 * 0.35875)), rel=1e-6)


@pytest.mark.needs("llvm")
@pytest.mark.parametrize("name", FILTERED)
def test_rays_follow_the_filter(name):
    """Where the camera rays of a pixel meet the film has the mean and the variance of the filter."""
    use_variant(FAST)
    import drjit as dr
    import mitsuba as mi

    from jaxdn.render.buffers.geometry import project
    from jaxdn.render.tracing.camera_rays import sample_camera_rays

    stage, count = Stage(), 1 << 15
    pixel = dr.full(mi.UInt32, 5 * 12 + 7, count)
    ray = sample_camera_rays(stage.build(0, 12, 8), pixel, dr.arange(mi.UInt32, count), (1, 2), name)
    points = np.array(ray.d, np.float64).T
    film = project(points, stage.camera(0), (8, 12))[0] - (7.5, 5.5)
    error = np.sqrt(moment(name, 2) / count)
    assert np.all(np.abs(film.mean(axis=0)) < 4 * error)
    np.testing.assert_allclose(film.var(axis=0), moment(name, 2), rtol=4 * np.sqrt(2 / count))
    assert abs(np.mean(film[:, 0] * film[:, 1])) < 4 * moment(name, 2) / np.sqrt(count)


def moved_stage(**options: Any) -> Stage:
    return Stage(square=lambda frame: shift(SLIDE, 0, SQUARE_Z), **options)


def coverage(across: float = 0.0, down: float = 0.0) -> np.ndarray:
    """[H, W] the share of each pixel's area that the square covers, moved by so many pixels."""
    centre, half = (6 - SLIDE * SCALE + across, 4 + down), 3 * PIXEL * SCALE  # +x points to the left
    columns, rows = (
        np.clip(np.minimum(np.arange(size) + 1, at + half) - np.maximum(np.arange(size), at - half), 0, 1)
        for size, at in zip((12, 8), centre, strict=True)
    )
    return rows[:, None] * columns


def measured_coverage(frame: Any) -> np.ndarray:
    return (WALL - np.asarray(frame.albedo, np.float64)[..., 0]) / (WALL - SQUARE)


def check_shares(found: np.ndarray, wanted: np.ndarray, count: int) -> None:
    """Shares of ``count`` samples are those that were expected, within 4.5 standard deviations."""
    assert np.any((wanted > 0.1) & (wanted < 0.9))
    np.testing.assert_array_less(np.abs(found - wanted), 4.5 * np.sqrt(wanted * (1 - wanted) / count) + 1e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_edges_cover_what_the_geometry_says(variant):
    count = 128 if variant == "scalar_rgb" else 4096
    settings = RenderSettings(layers=(count,), pixel_filter="box", max_depth=1, variant=variant, **SIZE)
    check_shares(measured_coverage(render_frame(moved_stage(), 0, settings).frame), coverage(), count)


class Lensed(Stage):
    """The stage through a lens."""

    def camera(self, frame):
        return super().camera(frame)._replace(aperture_radius=0.4, focus_distance=60.0)

    def build(self, frame, width, height):
        import mitsuba as mi

        self._extra = {
            "sensor": {
                **describe_optics(self.camera(frame)),
                "fov": 90.0,
                "to_world": mi.ScalarTransform4f(self.camera(frame).to_world),
                "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
            }
        }
        return super().build(frame, width, height)


@pytest.mark.parametrize("variant", VARIANTS)
def test_edges_out_of_focus_spread_over_the_circle_of_confusion(variant):
    count = 128 if variant == "scalar_rgb" else 4096
    settings = RenderSettings(layers=(count,), pixel_filter="box", max_depth=1, variant=variant, **SIZE)
    stage = Lensed(square=lambda frame: shift(SLIDE, 0, SQUARE_Z))
    # A point at depth z, seen from a point of the lens at distance a, moves by (W / 2) a (1 / f - 1 / z) on the film.
    radius = 6 * 0.4 * (1 / SQUARE_Z - 1 / 60)
    grid = (np.arange(48) + 0.5) / 24 - 1
    disk = [(x * radius, y * radius) for x in grid for y in grid if x * x + y * y <= 1]
    wanted = np.mean([coverage(*shift) for shift in disk], axis=0)
    check_shares(measured_coverage(render_frame(stage, 0, settings).frame), wanted, count)
    with pytest.raises(ValueError, match="depth of field needs filtered pixels"):
        render_frame(stage, 0, RenderSettings(variant=variant, **SIZE))


@pytest.mark.parametrize("variant", VARIANTS)
def test_guides_and_light_go_through_the_same_points(variant):
    """Of a shining square, every sample shows its light where it shows its surface: the shares are equal."""
    lamp = {"type": "rectangle", "to_world": None, "bsdf": {"type": "diffuse", "reflectance": 0.0}}

    class Shining(Stage):
        def build(self, frame, width, height):
            import mitsuba as mi

            place = mi.ScalarTransform4f(shift(0.4, 0.3, 2.5) @ np.diag([0.5, 0.5, -1.0, 1.0]))
            light = {"type": "area", "radiance": {"type": "rgb", "value": 2.0}}
            self._shapes = {"shining": {**lamp, "to_world": place, "emitter": light}}
            return super().build(frame, width, height)

    settings = RenderSettings(
        layers=(1, 4), reference_spp=6, pixel_filter="blackman-harris", max_depth=2, variant=variant, **SIZE
    )
    found = render_frame(Shining(), 0, settings)
    first = {"emission": found.frame.emission, "albedo": found.frame.albedo, "normal": found.frame.normal}
    images = {1: first, 4: found.layer_guides[4], 6: found.reference_guides}
    for count, guides in images.items():
        shares = np.asarray(guides["emission"])[..., 0] / 2 * count
        np.testing.assert_allclose(shares, np.round(shares), atol=1e-5)
        assert shares.max() == pytest.approx(count)
        lit = np.round(shares) == count
        assert np.all(np.asarray(guides["albedo"])[lit] == 0)
        half = (shares > 0.5) & ~lit
        assert np.any(half) or count == 1
        # Other samples of such a pixel see the wall or the square.
        rest = np.asarray(guides["albedo"])[..., 0] * count / np.maximum(count - np.round(shares), 1)
        assert np.all((rest[half] > SQUARE - 1e-3) & (rest[half] < WALL + 1e-3))


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_light_is_unbiased_and_noise_of_guides_falls_faster_than_that_of_independent_samples():
    options: dict[str, Any] = {**SIZE, "pixel_filter": "gaussian", "variant": FAST, "light": "reflected"}
    frames = [
        render_frame(moved_stage(), 0, RenderSettings(layers=(1, 16), seed=seed, **options)) for seed in range(24)
    ]
    best = render_frame(moved_stage(), 0, RenderSettings(layers=(1,), reference_spp=16384, seed=99, **options))
    light = np.stack([frame.layers[16] for frame in frames]).astype(np.float64)
    assert best.reference is not None
    error = (light.mean(axis=0) - best.reference) / (light.std(axis=0, ddof=1) / np.sqrt(24))
    assert np.mean(error**2) < 1.6  # Student's t of 23 degrees has the variance 23 / 21
    few, many = (
        np.stack([np.asarray(albedo, np.float64) for albedo in guides])
        for guides in ([one.frame.albedo for one in frames], [one.layer_guides[16]["albedo"] for one in frames])
    )
    clean = best.reference_guides["albedo"]
    noise = [np.mean((albedo - clean) ** 2) for albedo in (few, many)]
    share = measured_coverage(best.frame._replace(albedo=clean))
    single = np.mean(share * (1 - share)) * (WALL - SQUARE) ** 2  # of one sample: it sees the square or does not
    np.testing.assert_allclose(noise[0], single, rtol=0.2)
    # Sixteen independent samples would have a sixteenth; those that spread over the pixel have less.
    assert noise[1] < 0.6 * single / 16


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_clip_keeps_the_guides_of_every_image(tmp_path, variant):
    options: dict[str, Any] = {"pixel_filter": "box", "layers": (1, 2), "reference_spp": 2, "max_depth": 2, **SIZE}
    settings = RenderSettings(variant=variant, **options)
    render_clip(moved_stage(), tmp_path, settings, frames=1)
    record = read_record(tmp_path)
    assert record["pixel_filter"] == "box"
    assert record["jittered"] is True
    assert RenderSettings.from_record(record) == settings
    made = render_frame(moved_stage(), 0, settings)
    one, two, three = (next(read_frames(tmp_path, spp=spp)) for spp in (1, 2, 3))
    for name in ("albedo", "normal", "roughness", "direct", "emission"):
        first, second = np.asarray(getattr(made.frame, name)), made.layer_guides[2][name]
        np.testing.assert_allclose(getattr(one.frame, name), first, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(getattr(two.frame, name), second, rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(getattr(three.frame, name), (first + 2 * second) / 3, rtol=2e-3, atol=1e-4)
        np.testing.assert_allclose(three.reference_guides[name], made.reference_guides[name], rtol=1e-3, atol=1e-4)
    assert three.frame.depth is not None
    np.testing.assert_array_equal(one.frame.depth, three.frame.depth)


def test_what_filtered_pixels_exclude():
    for options in ({"jitter": True}, {"see_through": True}, {"draws": 1}):
        with pytest.raises(ValueError, match="pixel_filter"):
            RenderSettings(pixel_filter="box", **options)
    with pytest.raises(ValueError, match="pixel_filter: expected one of"):
        RenderSettings(pixel_filter="mitchell")  # type: ignore[arg-type]


def test_clips_of_earlier_versions_went_through_the_centres(tmp_path):
    settings = RenderSettings(max_depth=2, variant="scalar_rgb", **SIZE)
    render_clip(Stage(), tmp_path, settings, frames=1)
    record = read_record(tmp_path)
    del record["pixel_filter"]
    (tmp_path / "clip.json").write_text(json.dumps(record))
    assert RenderSettings.from_record(record) == settings
    with pytest.raises(ClipError, match="pixel_filter: centre there, box wanted"):
        render_clip(Stage(), tmp_path, replace(settings, pixel_filter="box"), frames=2)
    render_clip(Stage(), tmp_path, settings, frames=2)
    assert read_record(tmp_path)["frames"] == 2
