"""A sequence of any length is denoised in the memory of a short one: measured on real processes."""

import sys

import pytest

from experiments.stability.memory import peak_mib, write_sequence


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the peak memory of a child process is only available on Unix")
def test_memory_does_not_grow_with_the_frames_of_a_foreign_sequence(tmp_path):
    height, width, short, long = 270, 480, 2, 50
    peaks = {}
    for count in (short, long):
        write_sequence(tmp_path / str(count), count, height, width)
        peaks[count] = peak_mib(tmp_path / str(count), tmp_path / f"out-{count}", "svgf")
    everything = (long - short) * 12 * 4 * height * width / 2**20  # what keeping all frames would take
    assert everything > 250
    assert peaks[long] - peaks[short] < 0.2 * everything
