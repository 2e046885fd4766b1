"""``relax``: textures that its divisions leave, reflections that are others, light that changes."""

import jax
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.denoiser.statistics import measure_frame
from jaxdn.methods.lobes import split_signals
from jaxdn.methods.two_lobes.relax import relax
from tests.methods.lobe_scenes import HEIGHT, WIDTH, compiled, mirror_frames, run

DEFAULT = relax()
MEANS = relax(fix_frames=0, clamp_sigma=1e6, lag_sigma=1e6, short_history=0, levels=0, demodulate="none")
"""Nothing but running means."""
HELD = relax(levels=0, short_history=0, lag_sigma=1e6, demodulate="none")
"""Means that are filled while they are short and clamped to the fast one."""
SIZE = (20, 24)


def rough_light(rng):
    """A frame of noise on a rough surface, half of it specular light."""
    light = rng.gamma(4.0, 0.25, (*SIZE, 3)).astype(np.float32)
    return Frame(light, specular=0.5 * light, roughness=np.ones((*SIZE, 1), np.float32))


@pytest.mark.slow
def test_metal_darkens_no_diffuse_neighbour():
    """It has no diffuse light, and no diffuse texture either: all that is seen there is reflected by another lobe."""
    metal = np.zeros((1, 8, 1), bool)
    metal[:, 4:] = True
    light = np.full((1, 8, 3), 0.4, np.float32)
    frame = Frame(
        light,
        reflectance=np.full_like(light, 0.8),
        specular_reflectance=np.where(metal, light * 2, 0.0),
        specular=np.where(metal, light, 0.0),
    )
    diffuse, _ = split_signals(frame, "brdf", measure_frame(frame.radiance, None, frame))
    np.testing.assert_allclose(diffuse.texture[:, 0, 4:], 0.0, atol=1e-6)
    np.testing.assert_allclose(diffuse.texture[:, 0, :4], 1.0, rtol=1e-3)  # the divisor is a soft maximum
    # Giving back divides by one too, at each of eight averages.
    np.testing.assert_allclose(relax().step({}, relax().start({}, frame), frame)[1][0, :4], 0.4, rtol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("levels", [2, 0])
def test_colours_of_a_texture_do_not_run(rng, levels):
    """Even light of both kinds on surfaces that hardly reflect some colours, from the first frame on."""
    squares = np.float32([[0.26, 0.002, 0.36], [0.8, 0.8, 0.8], [0.5, 0.01, 0.02], [0.4, 0.6, 0.5]])
    number = np.indices((HEIGHT, WIDTH)).sum(0) % 4
    albedo, part = squares[number], 0.2 * squares[3 - number]
    light = {"radiance": 0.4 * albedo + 0.9 * part, "specular": 0.9 * part}
    frame = Frame(**light, albedo=albedo, reflectance=albedo + part, specular_reflectance=part)
    for image in run(relax(levels=levels), [frame] * 3)[1]:
        np.testing.assert_allclose(image, frame.radiance, atol=0.01)


def test_light_that_doubles_arrives_within_the_slow_historys_length(rng):
    """Within 5 %. A running mean of 30 frames alone takes 89; the fast one of 6 frames 17."""
    light = rng.gamma(4.0, 0.25, (60, 24, 24, 3)).astype(np.float32)
    light[30:] *= 2.0

    def frames_late(denoiser):
        means = [image.mean() for image in run(denoiser, [Frame(each) for each in light])[1]]
        return next((index for index in range(30, 60) if abs(means[index] - 2.0) < 0.1), 60) - 30

    assert frames_late(DEFAULT) <= 25
    assert frames_late(MEANS) == 30


@pytest.mark.slow
def test_a_reflection_that_is_another_has_no_history(rng):
    _, frames = mirror_frames(rng, 4)
    # Nearer: at a closeness of 0.3, its virtual image moves by 0.9 px and the surface by 3.
    frames[3] = frames[3]._replace(specular_hit_distance=np.full_like(frames[3].specular_hit_distance, 11.7))
    state, _ = run(MEANS, frames)
    assert np.asarray(state.core.specular)[..., 5].max() < 1.5


@pytest.mark.slow
def test_a_slow_history_is_held_to_the_fast_one_and_keeps_its_variance(rng):
    """Light of both kinds that the slow mean still shows and the fast one does not; its moments move with it."""
    frame = rough_light(rng)
    step, (state, _) = compiled(HELD), run(HELD, [frame] * 6)
    level = np.asarray(frame.radiance, np.float64) @ [0.2126, 0.7152, 0.0722] / 2
    spread = np.full(SIZE, 0.3)
    for name in ("diffuse", "specular"):
        planes = getattr(state.core, name).at[..., :3].set(frame.radiance / 2 + 40.0).at[..., 3].set(level + 40.0)
        planes = planes.at[..., 4].set((level + 40.0) ** 2 + spread)
        state = state._replace(core=state.core._replace(**{name: planes}))
    state, image = step({}, state, frame)
    # The fast mean is the frame itself here; four of its deviations over 5x5 pixels are about 2.
    assert np.abs(image - frame.radiance).max() < 5.0
    for planes in (state.core.diffuse, state.core.specular):
        planes = np.asarray(planes, np.float64)
        np.testing.assert_allclose(planes[..., 3], planes[..., :3] @ [0.2126, 0.7152, 0.0722], rtol=1e-3)
        # Blended in with 1 / 7: what the new frame's luminance adds is the square of 40 times 6 / 49.
        np.testing.assert_allclose(planes[..., 4] - planes[..., 3] ** 2, spread * 6 / 7 + 1600 * 6 / 49, rtol=0.01)


def test_a_history_that_begins_is_filled_from_around(rng):
    """The first frame: the mean of 21 taps, two pixels apart; of a mirror, the frame itself."""
    frame = rough_light(rng)
    image = run(HELD, [frame])[1][0]
    taps = [(2 * y, 2 * x) for y in range(-2, 3) for x in range(-2, 3) if abs(x * y) < 4]
    expected = np.mean([frame.radiance[8 + y : 12 + y, 8 + x : 16 + x] for y, x in taps], axis=0)
    np.testing.assert_allclose(image[8:12, 8:16], expected, rtol=1e-4)
    mirror = frame._replace(specular=frame.radiance, roughness=0 * frame.roughness)
    np.testing.assert_allclose(run(HELD, [mirror])[1][0], frame.radiance, rtol=1e-4)


@pytest.mark.slow
def test_nothing_that_was_filtered_in_space_comes_back(rng):
    frames = [rough_light(rng) for _ in range(2)]
    plain, filtered = (run(each, frames)[0].core for each in (HELD, relax(levels=2, lag_sigma=1e6, demodulate="none")))
    for name in ("diffuse", "specular"):
        np.testing.assert_allclose(getattr(plain, name), getattr(filtered, name), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_both_kinds_of_light_have_their_own_tolerance_of_differences(rng):
    frame, denoiser = rough_light(rng), relax(levels=2, lag_sigma=1e6, demodulate="none")
    mirror = frame._replace(specular=frame.radiance)

    @jax.jit
    def image(params, frame):
        return denoiser.step(params, denoiser.start(params, frame), frame)[1]

    def moved_by(name, frame):
        params = denoiser.init(jax.random.key(0), frame)
        strict = params | {name: params[name] - 5.0}
        return np.abs(image(strict, frame) - image(params, frame)).max()

    matt = frame._replace(specular=0 * frame.radiance)
    assert moved_by("sigma_specular", mirror) > 3e-3
    assert moved_by("sigma_diffuse", matt) > 3e-3
    assert moved_by("sigma_specular", matt) < 1e-5
    assert moved_by("sigma_diffuse", mirror) < 1e-5


@pytest.mark.parametrize(
    ("options", "word"),
    [({"fast_max": 0}, "fast_max"), ({"fix_frames": 9}, "fix_frames"), ({"demodulate": "colour"}, "demodulate")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        relax(**options)
