"""Fog: transmittance, light of Mitsuba's own integrator, guides that are as random as the light."""

from typing import Any

import numpy as np
import pytest

from jaxdn.core.frame import FAR
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.open_scene import scene_from_record
from jaxdn.render.settings import RenderSettings
from tests.render.render_scenes import SQUARE_Z, WALL_Z, Stage, shift

FAST = choose_variant().variant
VARIANTS = sorted({FAST, "scalar_rgb"})
SIZE: dict[str, Any] = {"width": 12, "height": 8}
DENSITY = np.array([0.05, 0.1, 0.2])
ALBEDO = np.array([0.9, 0.6, 0.3])
LOW = 1.2
"""The foggy box begins at this depth, and ends behind the square."""


def medium(**options: Any) -> dict[str, Any]:
    colors = {"albedo": ALBEDO, "sigma_t": DENSITY}
    return {
        "type": "homogeneous",
        **{name: {"type": "rgb", "value": value.tolist()} for name, value in colors.items()},
        **options,
    }


class Foggy(Stage):
    """The stage in fog: all of it, or a box of it before the square and the wall."""

    def __init__(self, *, box: bool = False, **options: Any) -> None:
        super().__init__(**options)
        self._box, self._options = box, {"phase": {"type": "hg", "g": 0.3}}

    def build(self, frame, width, height):
        import mitsuba as mi

        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        sensor: dict[str, Any] = {"type": "perspective", "fov": 90.0, "near_clip": 0.01, "film": film}
        place = mi.ScalarTransform4f(shift(0, 0, LOW + 3) @ np.diag([30.0, 30.0, 3.0, 1.0]))
        smoke = {"type": "cube", "to_world": place, "bsdf": {"type": "null"}, "interior": medium(**self._options)}
        around = {} if self._box else {"medium": medium(**self._options)}
        self._extra = {"sensor": {**sensor, **around}, **({"smoke": smoke} if self._box else {})}
        return super().build(frame, width, height)


GLOW = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


@pytest.mark.slow
@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("variant", VARIANTS)
def test_transmittance_is_that_of_beer_and_guides_know_it(variant, box):
    """Of light that the camera sees through fog there remains exp(-sigma d), in each colour."""
    wall = {"type": "rectangle", "emitter": GLOW, "bsdf": {"type": "diffuse", "reflectance": 0.0}}

    class Glowing(Foggy):
        def build(self, frame, width, height):
            import mitsuba as mi

            far = shift(0, 0, WALL_Z) @ np.diag([-40.0, 40.0, 1.0, 1.0])
            far[:3, 2] *= -1
            self._shapes = {"glowing": {**wall, "to_world": mi.ScalarTransform4f(far)}}
            return super().build(frame, width, height)

    count = 128 if variant == "scalar_rgb" else 4096
    settings = RenderSettings(layers=(count,), pixel_filter="box", max_depth=1, variant=variant, **SIZE)
    stage = Glowing(box=box, wall=False, square=lambda frame: shift(100, 0, SQUARE_Z))
    frame = render_frame(stage, 0, settings).frame
    rows, columns = np.meshgrid((np.arange(8) + 0.5 - 4) / 6, (np.arange(12) + 0.5 - 6) / 6, indexing="ij")
    slant = np.sqrt(1 + rows**2 + columns**2)
    distance = (WALL_Z - (LOW if box else 0.01)) * slant
    left = np.exp(-DENSITY * distance[..., None])
    assert frame.emission is not None
    # The distance is drawn for one of the three colours: the weights are at most 3.
    spread = 4.5 * np.sqrt(3 * left / count) + 2e-3
    np.testing.assert_array_less(np.abs(np.asarray(frame.emission) - left), spread)
    # Where fog was met first, the albedo is the fog's and the normal points to the camera.
    share = 1 - left.mean(axis=-1)
    assert frame.albedo is not None
    assert frame.normal is not None
    tolerance = 4.5 * np.sqrt(share * (1 - share) / count) + 2e-3
    met = np.asarray(frame.albedo, np.float64) / ALBEDO
    np.testing.assert_array_less(np.abs(met - share[..., None]), np.repeat(tolerance[..., None], 3, axis=-1))
    back = np.stack([columns, rows, -np.ones_like(rows)], axis=-1) / slant[..., None]  # +x and +y are left and up
    wanted = share[..., None] * back + (1 - share[..., None]) * (0.0, 0.0, -1.0)
    np.testing.assert_allclose(frame.normal, wanted, atol=0.03 + 2 / np.sqrt(count))
    assert frame.depth is not None
    seen = np.asarray(frame.depth)[..., 0]
    assert set(np.round(np.unique(seen), 2)) <= {WALL_Z, FAR}
    expected = (seen == FAR).sum(), share.sum()
    assert abs(expected[0] - expected[1]) < 4.5 * np.sqrt(np.sum(share * (1 - share)))


@pytest.mark.slow
@pytest.mark.needs("llvm")
@pytest.mark.parametrize("box", [False, True])
def test_light_is_that_of_mitsubas_integrator(box):
    import_variant = use_variant(FAST)
    import mitsuba as mi

    from jaxdn.render.tracing.radiance import TraceRequest
    from jaxdn.render.tracing.seeds import SampleStream
    from jaxdn.render.tracing.vectorised_path_tracer import accumulate

    assert import_variant == FAST
    lamp = {"type": "sphere", "center": [1.6, 1.0, 4.0], "radius": 0.4, "emitter": GLOW}
    built = Foggy(box=box, shapes={"bulb": lamp}).build(0, 12, 8)
    integrator = mi.load_dict({"type": "volpath", "max_depth": 4, "rr_depth": 1000})
    theirs, ours = [], []
    for seed in range(12):
        image = mi.render(built, integrator=integrator, spp=512, seed=mi.UInt32(seed))
        theirs.append(np.array(image, np.float64)[..., :3])
        sums = accumulate(
            built, SampleStream(seed, 0, 0), 0, 512, max_depth=4, request=TraceRequest(pixel_filter="box")
        )
        assert sums.bad == 0
        ours.append((sums.emitted + sums.direct + sums.indirect) / 512)
    means = [np.mean(np.stack(images), axis=(1, 2)) for images in (ours, theirs)]  # [seeds, 3]
    difference = means[0].mean(axis=0) - means[1].mean(axis=0)
    error = np.sqrt(sum(mean.var(axis=0, ddof=1) for mean in means) / 12)
    assert np.all(np.abs(difference) < 4.5 * error)
    assert np.all(error < 0.01 * means[1].mean(axis=0))  # a difference of 5 % would be seen


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_a_scalar_frame_in_fog_has_the_same_light():
    options: dict[str, Any] = {"pixel_filter": "box", "light": "reflected", "max_depth": 3, **SIZE}
    fast = render_frame(Foggy(), 0, RenderSettings(reference_spp=4096, variant=FAST, **options))
    slow = [
        render_frame(Foggy(), 0, RenderSettings(layers=(16,), variant="scalar_rgb", seed=seed, **options)).layers[16]
        for seed in range(6)
    ]
    assert fast.reference is not None
    means = np.array([image.mean() for image in slow])
    assert abs(means.mean() - fast.reference.mean()) < 4.5 * means.std(ddof=1) / np.sqrt(6)
    assert means.std(ddof=1) < 0.1 * fast.reference.mean()


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_a_family_in_fog_renders_and_its_record_keeps_it():
    record = {"family": "edge", "seed": 1, "fog": {"density": 0.08, "albedo": [0.9, 0.9, 0.9]}}
    scene = scene_from_record(record)
    assert scene.record == record
    found = render_frame(
        scene, 1, RenderSettings(layers=(1, 16), pixel_filter="box", light="reflected", variant=FAST, **SIZE)
    )
    assert found.bad_samples == 0
    assert found.frame.normal is not None
    assert np.isfinite(found.layers[16]).all()
    assert found.layers[16].mean() > 0
    with pytest.raises(ValueError, match=r"fog .*needs filtered pixels"):
        render_frame(scene, 0, RenderSettings(variant=FAST, **SIZE))
    with pytest.raises(ValueError, match="fog albedo: expected three numbers from 0 to 1"):
        scene_from_record({**record, "fog": {"density": 0.1, "albedo": [2, 0, 0]}})
