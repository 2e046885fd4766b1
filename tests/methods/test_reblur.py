"""``reblur``: discs that shrink, mirrors that stay sharp, light that changes."""

import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.methods.two_lobes.reblur import reblur
from tests.methods.lobe_scenes import mirror_frames, run


def test_light_that_doubles_arrives_within_the_slow_historys_length(rng):
    """Within 5 %; a running mean of 30 frames alone takes 89."""
    light = rng.gamma(4.0, 0.25, (60, 24, 24, 3)).astype(np.float32)
    light[30:] *= 2.0
    means = [image.mean() for image in run(reblur(), [Frame(each) for each in light])[1]]
    assert abs(means[29] - 1.0) < 0.05
    assert abs(means[55] - 2.0) < 0.1


def test_the_first_frame_is_blurred_most_and_near_light_least(rng):
    """The sharpness of an edge of light: it is blurred less with a longer history and with a nearer occluder."""
    light = np.where(np.arange(40) < 20, 1.0, 2.0)[None, :, None] * np.ones((40, 1, 3))
    depth = np.full((40, 40, 1), 5.0, np.float32)

    def slope(hit_distance, count):
        frames = [
            Frame(light.astype(np.float32), depth=depth, hit_distance=np.full_like(depth, hit_distance))
            for _ in range(count)
        ]
        image = run(reblur(pre_radius=0.0, radius=8.0, fix_frames=0, stable_max=1), frames)[1][-1]
        return np.mean(image[8:-8, 20] - image[8:-8, 19])

    assert slope(5.0, 1) < 0.5 * slope(0.05, 1)
    np.testing.assert_allclose(slope(5.0, 1), slope(0.0, 1), rtol=1e-4)  # unknown counts as far


def test_a_mirror_is_not_blurred(rng):
    _, frames = mirror_frames(rng, 1)
    _, images = run(reblur(), frames)
    np.testing.assert_allclose(images[0], frames[0].radiance, rtol=2e-5)


@pytest.mark.parametrize(
    ("options", "word"),
    [({"radius": -1.0}, "radius"), ({"stable_max": 0}, "stable_max"), ({"fast_max": 0}, "fast_max")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        reblur(**options)
