"""``relax``: textures that its divisions leave, reflections that are others, light that changes."""

import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.denoiser.statistics import measure_frame
from jaxdn.methods.lobes import split_signals
from jaxdn.methods.two_lobes.relax import relax
from tests.methods.lobe_scenes import HEIGHT, WIDTH, mirror_frames, run

DEFAULT = relax()
MEANS = relax(fix_frames=0, clamp_sigma=1e6, lag_sigma=1e6, short_history=0, levels=0, demodulate="none")
"""Nothing but running means."""


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


def test_a_reflection_that_is_another_has_no_history(rng):
    _, frames = mirror_frames(rng, 4)
    # Nearer: at a closeness of 0.3, its virtual image moves by 0.9 px and the surface by 3.
    frames[3] = frames[3]._replace(specular_hit_distance=np.full_like(frames[3].specular_hit_distance, 11.7))
    state, _ = run(MEANS, frames)
    assert np.asarray(state.core.specular)[..., 5].max() < 1.5


@pytest.mark.parametrize(
    ("options", "word"),
    [({"fast_max": 0}, "fast_max"), ({"fix_frames": 9}, "fix_frames"), ({"demodulate": "colour"}, "demodulate")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        relax(**options)
