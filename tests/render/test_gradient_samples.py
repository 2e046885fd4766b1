"""Replayed samples by the real renderer: exactly nothing where nothing changed, the right amount where light did."""

from typing import Any

import numpy as np
import pytest

from jaxdn import effects
from jaxdn.color import LUMINANCE
from jaxdn.render.buffers.frame_pair import BuiltFrame, FramePair
from jaxdn.render.buffers.gradient_samples import compute_luminance_gradient, pick_points, scatter_samples
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.seeds import NOISY, SampleStream
from jaxdn.render.tracing.tracer import choose_tracer
from tests.needs import require
from tests.render.render_scenes import HEIGHT, PIXEL, SQUARE_Z, WIDTH, Stage, fast_variants, grey, shift

SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "max_depth": 4, "seed": 5}
STRATA = (-(-HEIGHT // 3), -(-WIDTH // 3))


class Lamp(Stage):
    """The stage with a light whose radiance depends on the frame."""

    def __init__(self, *scales: float, **options: Any) -> None:
        super().__init__(**options)
        self._scales = scales

    def build(self, frame: float, width: int, height: int) -> Any:
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": 20.0 * self._scales[int(frame)]}}
        lamp = {"type": "rectangle", "to_world": _placed(shift(0, 3, -2)), "emitter": emitter}
        self._shapes = {"lamp": lamp}
        return super().build(frame, width, height)


def _placed(matrix: np.ndarray) -> Any:
    import mitsuba as mi

    return mi.ScalarTransform4f(matrix)


@pytest.fixture(params=fast_variants())
def variant(request: pytest.FixtureRequest) -> str:
    return use_variant(request.param)


def gradient(scene: Stage, variant: str, frame: int = 1, **settings: Any) -> np.ndarray:
    found = render_frame(scene, frame, RenderSettings(variant=variant, **SIZE | settings)).frame.luminance_gradient
    assert found is not None
    assert found.shape == (HEIGHT, WIDTH, 2)
    assert found.dtype == np.float32
    return found


def test_a_still_scene_under_the_same_light_has_none(variant: str) -> None:
    assert not gradient(Lamp(1, 1), variant).any()
    assert not gradient(Lamp(1, 2), variant, frame=0).any()


def test_twice_the_light_is_half_of_the_larger_luminance(variant: str) -> None:
    delta, size = np.moveaxis(gradient(Lamp(1, 2), variant), -1, 0)
    lit = size > 0
    # One sample for each stratum, of which some found no indirect light.
    assert 0.2 * np.prod(STRATA) < lit.sum() <= np.prod(STRATA)
    np.testing.assert_allclose(delta[lit], 0.5 * size[lit], rtol=1e-5)
    assert not delta[~lit].any()


def test_half_the_light_is_the_same_with_the_other_sign(variant: str) -> None:
    brighter, darker = gradient(Lamp(1, 2), variant), gradient(Lamp(2, 1), variant)
    np.testing.assert_allclose(darker[..., 0], -brighter[..., 0], rtol=1e-5)
    np.testing.assert_allclose(darker[..., 1], brighter[..., 1], rtol=1e-5)


def test_a_light_switched_off_takes_everything(variant: str) -> None:
    delta, size = np.moveaxis(gradient(Lamp(1, 0), variant), -1, 0)
    assert (delta < 0).any()
    np.testing.assert_array_equal(-delta, size)


@pytest.mark.parametrize("max_depth", [2, 4])
def test_of_reflected_light_the_direct_part_is_replayed_too(variant: str, max_depth: int) -> None:
    """Light straight from the lamp reaches nearly every stratum, and with two path lengths there is no other."""
    delta, size = np.moveaxis(gradient(Lamp(1, 2), variant, light="reflected", max_depth=max_depth), -1, 0)
    lit = size > 0
    assert lit.sum() > 0.8 * np.prod(STRATA)
    np.testing.assert_allclose(delta[lit], 0.5 * size[lit], rtol=1e-5)
    assert (gradient(Lamp(1, 2), variant)[..., 1] > 0).sum() < lit.sum()


def test_of_reflected_light_the_samples_are_those_of_the_previous_noisy_image() -> None:
    require("llvm")  # scalar variants cannot replay the samples of their images
    variant = choose_variant().variant
    size = gradient(Lamp(1, 0), variant, light="reflected")[..., 1]
    image = render_frame(Lamp(1, 0), 0, RenderSettings(variant=variant, light="reflected", **SIZE)).frame.radiance
    np.testing.assert_allclose(size[size > 0], (image @ LUMINANCE)[size > 0], rtol=1e-5)


def test_the_samples_are_those_of_the_previous_noisy_image() -> None:
    """The larger luminance of a light that is switched off is the previous image's own, at the same pixel."""
    require("llvm")  # scalar variants cannot replay the samples of their images
    variant = choose_variant().variant
    for layers in ((1,), (2,)):
        found = render_frame(
            Lamp(1, 0), 1, RenderSettings(variant=variant, layers=layers, **SIZE)
        ).frame.luminance_gradient
        there = found[..., 1] > 0
        assert there.any()
        if layers == (1,):
            image = render_frame(Lamp(1, 0), 0, RenderSettings(variant=variant, **SIZE)).frame.radiance @ LUMINANCE
            np.testing.assert_allclose(found[there, 1], image[there], rtol=1e-5)
        else:  # the first of the two samples
            sample = choose_tracer(variant).accumulate(
                Lamp(1, 0).build(0, WIDTH, HEIGHT), SampleStream(5, 0, NOISY), 1, 1, max_depth=4
            )
            np.testing.assert_allclose(found[there, 1], (sample.indirect @ LUMINANCE)[there], rtol=1e-5)


def test_a_moving_square_carries_its_samples_along(variant: str) -> None:
    """The light is the same everywhere: what changes is only what the square itself hides and reflects."""
    slid = Lamp(1, 1, square=lambda frame: shift(-3 * PIXEL * frame, 0, SQUARE_Z))
    plain, bright = gradient(slid, variant), gradient(Lamp(1, 4, square=slid._square), variant)
    assert plain.any()
    assert np.abs(plain[..., 0]).sum() < 0.25 * np.abs(bright[..., 0]).sum()


def test_what_is_hidden_now_is_left_out() -> None:
    use_variant()
    slid = Stage(square=lambda frame: shift(-3 * PIXEL * frame, 0, SQUARE_Z))
    options = {**SIZE, "variant": choose_variant().variant}
    first, second = (render_frame(slid, frame, RenderSettings(**options)).view for frame in (0, 1))
    assert first is not None
    assert second is not None
    picked = pick_points(first, second, SampleStream(5, 1, NOISY))
    # Those of the square itself have moved three pixels to the right, all others none.
    here = np.stack([picked.pixel % WIDTH, picked.pixel // WIDTH], -1) + 0.5
    moved = picked.target - here
    on_square = first.gbuffer.ids[..., 0].ravel()[picked.pixel] == first.gbuffer.names.index("square")
    assert on_square.sum() >= 2
    np.testing.assert_allclose(moved[on_square], np.array([[3.0, 0.0]]).repeat(on_square.sum(), 0), atol=1e-4)
    np.testing.assert_array_equal(moved[~on_square], 0)

    replayed = []

    def replay(*arguments, **options):
        found = choose_tracer(choose_variant().variant).replay(*arguments, **options)
        replayed.append(found)
        # Every sample changes, so that those that are kept can be told from the buffer.
        return found._replace(light=np.full_like(found.light, len(replayed)))

    scenes = [slid.build(frame, WIDTH, HEIGHT) for frame in (0, 1)]
    frames = FramePair(BuiltFrame(scenes[0], first), BuiltFrame(scenes[1], second), SampleStream(5, 1, NOISY), 0)
    buffer = compute_luminance_gradient(replay, frames, max_depth=4, with_direct=False)
    kept = np.argwhere(buffer[..., 1] > 0)
    # Where the wall was and the square is now, only samples of the square remain.
    now = second.gbuffer.ids[..., 0] == second.gbuffer.names.index("square")
    before = first.gbuffer.ids[..., 0] == first.gbuffer.names.index("square")
    lost = ~on_square & (now & ~before).ravel()[picked.pixel]
    assert lost.any()
    landed = {(int(y), int(x)) for x, y in np.floor(picked.target[~lost])}
    assert {tuple(place) for place in kept} <= landed
    assert len(kept) >= 0.8 * len(landed)


def test_strata_at_the_border_and_the_sky() -> None:
    use_variant()
    view = render_frame(Stage(), 0, RenderSettings(**SIZE)).view
    assert view is not None
    picked = pick_points(view, view, SampleStream(1, 3, NOISY))
    strata = {(int(y) // 3, int(x) // 3) for x, y in picked.target}
    assert len(strata) == len(picked.pixel) == np.prod(STRATA)
    ids = view.gbuffer.ids.copy()
    ids[:, :4] = -1
    fewer = pick_points(view._replace(gbuffer=view.gbuffer._replace(ids=ids)), view, SampleStream(1, 3, NOISY))
    assert len(fewer.pixel) == np.prod(STRATA) - STRATA[0]  # a stratum with one column left still has its sample
    assert np.all(fewer.pixel % WIDTH >= 4)
    other = pick_points(view, view, SampleStream(1, 4, NOISY))
    assert 0.5 < np.mean(other.pixel != picked.pixel) < 1


def test_of_samples_in_one_stratum_the_nearest_is_kept_in_any_order(rng: np.random.Generator) -> None:
    samples = rng.normal(size=(40, 2))
    target, depth = rng.uniform(0, [10, 7], (40, 2)), rng.integers(1, 4, 40).astype(float)
    expected = np.zeros((7, 10, 2), np.float32)
    for row in range(3):
        for column in range(4):
            inside = [i for i, (x, y) in enumerate(target) if int(y) // 3 == row and int(x) // 3 == column]
            if inside:
                nearest = min(inside, key=lambda i: (depth[i], i))
                x, y = np.floor(target[nearest]).astype(int)
                expected[y, x] = samples[nearest]
    np.testing.assert_array_equal(scatter_samples(samples, target, depth, (7, 10)), expected)
    unique = rng.permutation(np.arange(40.0))
    order = rng.permutation(40)
    np.testing.assert_array_equal(
        scatter_samples(samples, target, unique, (7, 10)),
        scatter_samples(samples[order], target[order], unique[order], (7, 10)),
    )
    assert not scatter_samples(samples * [0, 1], target, depth, (7, 10)).any()


def test_it_is_planned_only_for_a_method_that_reads_it() -> None:
    import jaxdn

    found = effects.choose_effects(["changing-light", "indirect"], 2)
    assert "luminance_gradient" in effects.plan(found, jaxdn.denoisers.asvgf()).buffers
    assert "luminance_gradient" not in effects.plan(found, jaxdn.denoisers.svgf()).buffers
    still = effects.choose_effects(["indirect"], 2)
    assert "luminance_gradient" not in effects.plan(still, jaxdn.denoisers.asvgf()).buffers
    plan = effects.plan(found, jaxdn.denoisers.svgf())
    assert (
        render_frame(Lamp(1, 2), 1, RenderSettings(plan=plan, **{**SIZE, "max_depth": None})).frame.luminance_gradient
        is None
    )


def test_a_sample_that_is_not_finite_says_nothing(variant: str) -> None:
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": 3e38}}
    ball = {"type": "sphere", "center": [0, 2, 2], "radius": 1.0, "emitter": emitter}
    found = choose_tracer(variant).replay(
        Stage(shapes={"lamp": ball}, extra={"more": {"type": "sphere", "center": [3, 0, 4], "bsdf": grey(0.9)}}).build(
            0, WIDTH, HEIGHT
        ),
        SampleStream(0, 0, NOISY),
        0,
        np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1).reshape(-1, 2),
        np.arange(WIDTH * HEIGHT),
        max_depth=4,
        with_direct=True,
    )
    assert np.isfinite(found.light).all()
