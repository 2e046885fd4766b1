"""Our clips with filtered pixels: emitted and direct light are as noisy as the rest, so all light is denoised."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.core.frame import Frame
from jaxdn.sequence.all_light import gather_light
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.sharing import share_model

SIDE, FRAMES = 48, 4
LAYERS = (1, 4)


def make_clip(folder: Path, **record: Any) -> Path:
    """A grey wall (light 0.2) in front of a lamp out of focus: half of the samples are the lamp's, of light 1 each."""
    rng = np.random.default_rng(0)
    flat = np.ones((SIDE, SIDE, 3), np.float32)
    folder.mkdir()
    for index in range(FRAMES):
        images: dict[int, np.ndarray] = {}
        guides: dict[int, dict[str, np.ndarray]] = {}
        for count in LAYERS:
            share = rng.binomial(count, 0.5, (SIDE, SIDE, 1)).astype(np.float32) / count
            images[count] = 0.2 * (1 - share) * flat
            guides[count] = {"albedo": 0.5 * flat, "emission": share * flat, "direct": 0.1 * (1 - share) * flat}
        still = np.zeros((SIDE, SIDE, 2), np.float32)
        frame = Frame(images[1], depth=2 * flat[..., :1], motion=still, **guides[1])
        clips.write_frame(clips.frame_path(folder, index), frame, layers=images, layer_guides=guides)
    size = {"frames": FRAMES, "width": SIDE, "height": SIDE, "layers": list(LAYERS)}
    clips.finish_record({**size, **record}, folder)
    return folder


def denoise(clip: Path, method: str, **settings: Any) -> dict[str, np.ndarray]:
    """The channels of the last frame."""
    out = clip.parent / method
    denoise_files([clip], out, share_model(method), Settings(**settings))
    return clips.read_exr(clips.frame_path(out, FRAMES - 1))


@pytest.mark.slow
@pytest.mark.parametrize("spp", LAYERS)
def test_a_lamp_out_of_focus_is_denoised(spp: int, tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "clip", pixel_filter="box")
    noisy, image = (denoise(clip, name, spp=spp, safe=False) for name in ("noisy", "svgf"))
    assert noisy["R"].std() == pytest.approx((0.7 / 2) / np.sqrt(spp), rel=0.1)  # 1 or 0.3, as often
    assert image["R"].std() < 0.25 * noisy["R"].std()
    assert image["R"].mean() == pytest.approx(0.65, abs=0.03)
    np.testing.assert_array_equal(image["R"], image["denoised.R"])  # nothing is added back


def test_every_layer_has_its_own_light(tmp_path: Path) -> None:
    """For methods that choose samples in each pixel; with one layer its light is the frame's."""
    stored = next(iter(clips.read_frames(make_clip(tmp_path / "clip", pixel_filter="box"), spp=4)))
    gathered = gather_light(stored)
    for samples, image in gathered.layers.items():
        share = stored.layer_guides[samples]["emission"]
        np.testing.assert_allclose(image, 0.3 + 0.7 * share, atol=1e-3)
    np.testing.assert_allclose(gathered.frame.radiance, gathered.layers[4])
    alone = gather_light(stored._replace(layers={4: stored.layers[4]}, layer_guides={}))
    np.testing.assert_allclose(alone.layers[4], gathered.layers[4])
    assert gathered.frame.emission is gathered.frame.direct is None


def test_where_rays_go_through_the_centres_light_that_has_no_noise_is_added_back(tmp_path: Path) -> None:
    clip = make_clip(tmp_path / "clip")
    image = denoise(clip, "svgf", safe=False)
    stored = list(clips.read_frames(clip))[-1].frame
    np.testing.assert_allclose(image["R"] - image["denoised.R"], (stored.emission + stored.direct)[..., 0], atol=1e-6)
