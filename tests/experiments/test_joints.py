"""Where chunks join: the figures of known images, and where a chunk is the whole shot bit for bit."""

import json

import numpy as np
import pytest

from experiments.stability.joint_shots import CUT, render_shot
from experiments.stability.joints import Settings, main, measure_joint


def test_the_figures_of_a_joint_are_those_of_known_images() -> None:
    reference = np.stack([np.full((2, 2, 3), value, np.float32) for value in (1, 1, 2, 2, 2)])
    whole = {number: image + np.float32(0.25 if number < 2 else 0.5) for number, image in enumerate(reference)}
    first = {**whole, 1: whole[1] + np.float32(0.125)}
    second = {2: reference[2] + 1, 3: whole[3], 4: whole[4]}
    found = measure_joint(whole, [first, second], reference, 2)
    assert found.difference == pytest.approx(0.5 / 2.5)
    assert found.flicker == pytest.approx((3 - 1.375 - 1) / (2.5 - 1.25 - 1))
    own = -20 * np.log10(5 / 7 - 2 / 3)
    assert found.psnr == pytest.approx(-20 * np.log10(3 / 4 - 2 / 3) - own, rel=1e-4)
    assert found.equal_after == 1
    worse_before = measure_joint(whole, [{1: whole[1] + 2}, whole], reference, 2)
    assert worse_before.difference == pytest.approx(2 / 1.25)
    assert worse_before.psnr < -10
    assert worse_before.equal_after == 0
    assert measure_joint(whole, [whole, {**second, 4: second[2]}], reference, 2).equal_after is None


@pytest.mark.slow
def test_a_chunk_that_reads_all_frames_is_the_shot_and_any_is_after_a_cut(tmp_path) -> None:
    main(Settings(methods=("taa",), leads=(0, 6), start=6, after=6, size=32, rendered=(), out=tmp_path / "joints.json"))
    rows = json.loads((tmp_path / "joints.json").read_text())["rows"]
    shots = ("camera pans", "camera stands", "lamp goes out", "cut")
    assert [row[1:3] for row in rows[::2]] == [[shot, both] for shot in shots for both in ("forwards", "both")]
    for none, every in zip(rows[::2], rows[1::2], strict=True):
        assert every[4:] == ["0.00 %", 0.0, "1.00", "0"]
        assert none[4] != "0.00 %"
        assert none[7] == (str(CUT) if none[1] == "cut" else "never")


@pytest.mark.needs("mitsuba")
@pytest.mark.slow
def test_the_rendered_shot_moves_and_has_noise(tmp_path) -> None:
    clip = render_shot("robot", tmp_path / "clip", 2, 16)
    assert clip.frames.radiance.shape == clip.reference.shape == (2, 16, 16, 3)
    assert np.nanmax(np.abs(clip.frames.motion[1])) > 0.1
    assert np.mean((clip.frames.radiance - clip.reference) ** 2) > 1e-4
