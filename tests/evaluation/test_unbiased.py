"""``compare`` tells errors without the reference's own noise, from the halves that a clip keeps."""

import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.data.clip.folder import begin_record, finish_record, frame_path
from jaxdn.data.clip.frames import write_frame
from jaxdn.data.clip.noise_floor import read_halves
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import sentences, text_table, write_report
from jaxdn.evaluation.report.summary import headline
from jaxdn.zoo.ready import Model

SHAPE = (2, 60, 80, 3)
ERROR = 0.02
"""Of the image and of the reference, in linear light about 0.2, where the transfer curve is nearly straight."""


def write(folder, *, halves):
    """A clip of a grey wall: an image of the noise ERROR, and a reference as noisy as that."""
    rng = np.random.default_rng(2)
    image, first, second = (0.2 + size * rng.standard_normal(SHAPE) for size in (ERROR, ERROR * 2**0.5, ERROR * 2**0.5))
    record = {"name": "wall", "frames": SHAPE[0], "width": SHAPE[2], "height": SHAPE[1], "layers": [1]}
    begin_record(record, folder)
    for index in range(SHAPE[0]):
        half = first[index] if halves else None
        reference = (first[index] + second[index]) / 2
        frame = Frame(image[index].astype(np.float32))
        write_frame(frame_path(folder, index), frame, reference=reference, reference_half=half)
    finish_record(record, folder)
    return first, second


def test_the_halves_of_a_reference_are_read(tmp_path):
    written = write(tmp_path / "clip", halves=True)
    found = read_halves(tmp_path / "clip")
    assert found is not None
    for half, expected in zip(found, written, strict=True):
        np.testing.assert_allclose(half, expected, rtol=0, atol=1e-3)  # half precision


def test_a_clip_without_a_half_has_none(tmp_path):
    write(tmp_path / "clip", halves=False)
    assert read_halves(tmp_path / "clip") is None


@pytest.mark.slow
@pytest.mark.parametrize("halves", [True, False])
def test_the_references_noise_is_not_in_the_score(tmp_path, halves):
    write(tmp_path / "clip", halves=halves)
    noisy = Model("noisy", None, {}, None, {})
    results = compare([noisy], [tmp_path / "clip"], title="", settings={}, log=lambda text: None)
    scores = results.clips[0].scores["noisy"]
    if not halves:
        assert np.isnan(scores.unbiased_psnr)
        return
    # The reference's noise is as large as the image's: half of the plain error is not the image's.
    assert abs(scores.unbiased_psnr - scores.psnr - 10 * np.log10(2)) < 0.15
    assert abs(scores.unbiased_temporal_psnr - scores.temporal_psnr - 10 * np.log10(2)) < 0.3
    assert abs(scores.unbiased_mse / scores.mse - 0.5) < 0.02
    assert abs(scores.unbiased_relative_mse / scores.relative_mse - 0.5) < 0.05


@pytest.mark.parametrize("halves", [True, False])
def test_the_report_says_which_score_to_read(tmp_path, halves):
    write(tmp_path / "clip", halves=halves)
    said = []
    noisy = Model("noisy", None, {}, None, {})
    results = compare([noisy], [tmp_path / "clip"], title="", settings={}, log=said.append)
    assert headline(results).field == ("unbiased_psnr" if halves else "psnr")
    assert ("without the reference's noise" in said[0]) == halves
    assert ("Compare by the unbiased columns" in " ".join(sentences(results))) == halves
    assert ("unbiased" in text_table(results)) == halves
    page = write_report(results, tmp_path / "report").read_text()
    assert ("Temporal PSNR dB, unbiased" in page) == halves


def test_methods_of_one_name_are_refused_before_a_clip_is_read(tmp_path):
    noisy = Model("noisy", None, {}, None, {})
    with pytest.raises(ValueError, match="methods: expected every label once, got noisy twice"):
        compare([noisy, noisy], [tmp_path / "nowhere"], title="", settings={})


def test_a_method_with_the_name_of_the_reference_is_refused_before_a_clip_is_read(tmp_path):
    named = Model("reference", None, {}, None, {})
    with pytest.raises(ValueError, match=r"methods: expected no label 'reference'.* rename the folder of weights"):
        compare([named], [tmp_path / "nowhere"], title="", settings={})
