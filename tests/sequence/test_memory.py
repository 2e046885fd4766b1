"""Memory: a sequence of any length takes that of a short one, and large frames that of their tiles."""

import sys

import numpy as np
import pytest

from experiments.stability.memory import peak_mib, write_sequence
from jaxdn.clips import read_exr
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.sequence.frame_denoiser import STEP, estimate_bytes
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model

pytestmark = pytest.mark.usefixtures("compiled_anew")  # loading a program takes less memory than compiling it


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the peak memory of a child process is only available on Unix")
def test_memory_does_not_grow_with_the_frames_of_a_foreign_sequence(tmp_path):
    """Peaks of the same sequence differ by up to 100 MiB from run to run: the long one is long enough to tell.

    They are those of the child alone, and not of this process, which after a thousand tests is larger.

    By the fastest method, as what keeps frames is around it. It reads six of the twelve channels: a run that keeps only
    those, or only its images, grows by more than is allowed too.
    """
    height, width, short, long = 270, 480, 12, 162
    own, peaks = np.ones(2**28), {}  # 2 GiB, touched
    for count in (short, long):
        write_sequence(tmp_path / str(count), count, height, width)
        peaks[count] = peak_mib(tmp_path / str(count), tmp_path / f"out-{count}", "taa")
    everything = (long - short) * 12 * 4 * height * width / 2**20  # what keeping all frames would take
    assert everything > 850
    assert peaks[short] < 1536 < own.nbytes / 2**20
    assert peaks[long] - peaks[short] < 0.2 * everything


@pytest.mark.slow
def test_frames_in_parts_are_the_same_files(tmp_path):
    """Half the frame fits into the memory that is allowed; the safe mixture and the previews are made in tiles too."""
    height, width = 300, 520
    write_sequence(tmp_path / "in", 2, height, width)
    channels = len(ExrFile(tmp_path / "in/frame_0001.exr").windows)
    enough = estimate_bytes(height, width, channels)
    images, told = {}, []
    for name, limit in (("whole", enough), ("tiles", enough - STEP * (height * width - 288 * 288))):
        settings = Settings(naming=ChannelNaming("previous-current"), max_memory=limit)
        files = denoise_files([tmp_path / "in"], tmp_path / name, find_model("taa"), settings, log=told.append).files
        images[name] = [np.stack([read_exr(file)[letter] for letter in "RGB"], axis=-1) for file in files]
    assert [line for line in told if "in tiles of at most 288 x 288 pixels" in line] == told[-2:-1]
    np.testing.assert_allclose(images["tiles"], images["whole"], rtol=1e-4, atol=1e-5)
    assert np.abs(images["whole"][1] - images["whole"][0]).mean() > 1e-4, "the history of the first frame is used"


@pytest.mark.slow
def test_tiles_of_a_method_that_looks_less_far_than_the_safe_mixture(tmp_path):
    """Pixels decide about one from 4 away in taa, and from 64 away in the mixture."""
    height, width, side = 120, 330, 160
    write_sequence(tmp_path / "in", 1, height, width)
    enough = estimate_bytes(height, width, len(ExrFile(tmp_path / "in/frame_0001.exr").windows))
    settings = Settings(naming=ChannelNaming("previous-current"), max_memory=enough - STEP * (height * width - side**2))
    assert denoise_files([tmp_path / "in"], tmp_path / "out", find_model("taa"), settings).files


def test_too_little_memory_is_refused_before_anything_is_written(tmp_path):
    write_sequence(tmp_path / "in", 1, 200, 300)
    settings = Settings(naming=ChannelNaming("previous-current"), max_memory=0.61 * 2**30)
    with pytest.raises(ValueError, match=r"--max-memory 0.61: whole frames of 300 x 200 need .* got room for"):
        denoise_files([tmp_path / "in"], tmp_path / "out", find_model("svgf"), settings)
    assert not list((tmp_path / "out").glob("**/*.exr"))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the peak memory of a child process is only available on Unix")
def test_a_process_keeps_to_the_memory_it_is_allowed(tmp_path):
    height, width, limit = 540, 960, 0.9
    write_sequence(tmp_path / "in", 2, height, width)
    channels = len(ExrFile(tmp_path / "in/frame_0001.exr").windows)
    assert estimate_bytes(height, width, channels) > 1.2 * limit * 2**30
    assert peak_mib(tmp_path / "in", tmp_path / "out", "svgf", limit) < 1024 * limit
