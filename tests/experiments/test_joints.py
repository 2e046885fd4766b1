"""The measurement of where chunks join: its figures on known images, and that a chunk which reads all is the shot."""

import json

import numpy as np
import pytest

from experiments.stability.joints import Settings, main, measure_joint


def test_the_figures_of_a_joint_are_those_of_known_images() -> None:
    reference = np.stack([np.full((2, 2, 3), value, np.float32) for value in (1, 1, 2, 2)])
    whole = [image + np.float32(0.25) for image in reference[:2]] + [image + np.float32(0.5) for image in reference[2:]]
    chunk = [reference[2] + 1, whole[3]]
    found = measure_joint(whole, chunk, reference, 2)
    assert found.difference == pytest.approx(0.5 / 2.5)
    assert found.flicker == pytest.approx((3 - 1.25 - 1) / (2.5 - 1.25 - 1))
    assert found.psnr == pytest.approx(-20 * np.log10(3 / 4 - 2 / 3), rel=1e-5)
    assert found.equal_after == 1
    assert measure_joint(whole, chunk[:1], reference, 2).equal_after is None


def test_a_chunk_that_reads_the_whole_shot_before_it_is_the_shot(tmp_path) -> None:
    main(Settings(methods=("taa",), leads=(0, 6), start=6, after=2, size=32, out=tmp_path / "joints.json"))
    rows = json.loads((tmp_path / "joints.json").read_text())["rows"]
    assert [row[1] for row in rows[::2]] == ["camera pans", "camera stands", "lamp goes out"]
    for none, every in zip(rows[::2], rows[1::2], strict=True):
        assert every[3:] == ["0.00 %", 0.0, "1.00", "0"]
        assert none[3] != "0.00 %"
