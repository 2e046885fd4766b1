"""The views of the results: frames as other renderers give them."""

from pathlib import Path

import numpy as np
import pytest

from experiments.papers.results import VIEWS, table
from jaxdn import clips
from jaxdn.core.frame import Frame
from jaxdn.evaluation.compare import compare
from jaxdn.zoo.ready import find_model

SIDE = 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Indirect light 0.2 (draws 0.1, 0.4; halves 0.1, 0.3), direct light 0.3 (draws 0.2, 0.6), emission 0.05."""
    home, flat = tmp_path / "room", np.ones((SIDE, SIDE, 3), np.float32)
    home.mkdir()
    draws = np.stack([np.concatenate([a * flat, b * flat], -1) for a, b in ((0.1, 0.2), (0.4, 0.6))])
    frame = Frame(radiance=0.1 * flat, direct=0.3 * flat, emission=0.05 * flat, depth=flat[..., :1])
    for t in range(2):
        light = {"reference": 0.2 * flat, "reference_half": 0.1 * flat, "draws": draws}
        clips.write_frame(clips.frame_path(home, t), frame, layers={1: 0.1 * flat}, **light)
    clips.finish_record({"frames": 2, "width": SIDE, "height": SIDE, "layers": [1]}, home)
    return home


def test_all_light_has_the_noise_of_its_samples_and_halves_of_its_own(folder: Path) -> None:
    for spp, noisy in ((1, 0.1 + 0.2 + 0.05), (2, 0.25 + 0.4 + 0.05)):
        footage = VIEWS["beauty"](folder, spp=spp)
        np.testing.assert_allclose(footage.clip.frames.radiance, noisy, rtol=1e-3)
        np.testing.assert_allclose(footage.clip.reference, 0.2 + 0.3 + 0.05, rtol=1e-3)
        np.testing.assert_allclose(footage.halves[0], 0.1 + 0.35, rtol=1e-3)
        np.testing.assert_allclose(footage.halves[1], 0.3 + 0.35, rtol=1e-3)
    with pytest.raises(ValueError, match="at least 3 single samples; render the clip with --draws 3"):
        VIEWS["beauty"](folder, spp=3)


def test_indirect_light_has_the_noise_of_its_samples(folder: Path) -> None:
    for spp, noisy in ((1, 0.1), (2, 0.25)):
        footage = VIEWS["indirect"](folder, spp=spp)
        np.testing.assert_allclose(footage.clip.frames.radiance, noisy, rtol=1e-3)
        np.testing.assert_allclose(footage.clip.reference, 0.2, rtol=1e-3)
    with pytest.raises(ValueError, match="at least 3 single samples; render the clip with --draws 3"):
        VIEWS["indirect"](folder, spp=3)


def test_buffers_that_a_renderer_does_not_write_are_absent(folder: Path) -> None:
    frames = VIEWS["beauty-without-depth"](folder, spp=1).clip.frames
    assert frames.depth is None
    assert frames.direct is not None
    np.testing.assert_allclose(frames.radiance, 0.35, rtol=1e-3)


@pytest.mark.slow
def test_the_table_scores_what_a_view_reads(folder: Path) -> None:
    """The noisy image is off by 0.1 of indirect light, and by 0.2 of all light, from the mean of the references."""
    lines = {}
    for view in ("indirect", "beauty"):
        noisy = [find_model("noisy")]
        results = compare(noisy, [folder], title="", settings={}, read=VIEWS[view], log=lambda text: None)
        lines[view] = table(results).splitlines()[-1]
    psnr = {view: float(line.split("|")[2]) for view, line in lines.items()}
    assert psnr["indirect"] > psnr["beauty"]
    assert lines["beauty"].startswith("| noisy |")
    wider = table(results, {"milliseconds": {"noisy": "7"}}).splitlines()
    assert wider[0].endswith("| hidden pixels, PSNR | milliseconds |")
    assert wider[-1] == f"{lines['beauty']} 7 |"
