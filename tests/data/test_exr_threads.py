"""Files that are read and written by several threads: the same bytes, pixels and errors."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from jaxdn.commands import main
from jaxdn.data.errors import DamagedFile
from jaxdn.data.exr.exr import read_exr, write_exr
from jaxdn.data.exr.threads import exr_on_all_cores
from tests.programs import write_shot


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("jaxdn.data.exr.threads.count_cores", lambda: 3)
    return 3


def test_bytes_and_pixels_are_the_same(cores: int, tmp_path: Path, rng: np.random.Generator) -> None:
    channels = {name: rng.gamma(1, 1, (300, 200)).astype(np.float32) for name in "RGBA"}
    write_exr(tmp_path / "alone.exr", channels)
    with exr_on_all_cores():
        assert OpenEXR.global_thread_count() == cores
        write_exr(tmp_path / "beside.exr", channels)
        found = read_exr(tmp_path / "alone.exr")
    assert OpenEXR.global_thread_count() == 0
    assert (tmp_path / "beside.exr").read_bytes() == (tmp_path / "alone.exr").read_bytes()
    for name, pixels in channels.items():
        np.testing.assert_array_equal(found[name], pixels)


@pytest.mark.parametrize("place", [0.3, 0.6, 0.8])
def test_a_damaged_file_is_told(place: float, cores: int, tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {name: rng.poisson(1, (300, 200)).astype(np.float32) for name in "RGBA"})
    data = bytearray(path.read_bytes())
    at = int(place * (len(data) - 200))
    data[at : at + 200] = bytes(200)
    path.write_bytes(data)
    with exr_on_all_cores(), pytest.raises(DamagedFile, match=r"a\.exr"):
        read_exr(path)


def test_half_a_file_is_told(cores: int, tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "a.exr"
    write_exr(path, {name: rng.poisson(1, (300, 200)).astype(np.float32) for name in "RGBA"})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with exr_on_all_cores(), pytest.raises(DamagedFile, match=r"a\.exr"):
        read_exr(path)


def test_one_core_has_no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaxdn.data.exr.threads.count_cores", lambda: 1)
    with exr_on_all_cores():
        assert OpenEXR.global_thread_count() == 0


def test_an_openexr_without_the_setting_goes_on_without(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(OpenEXR, "set_global_thread_count")
    with exr_on_all_cores():
        assert OpenEXR.global_thread_count() == 0


def test_the_command_reads_and_writes_with_them(cores: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = []
    real = OpenEXR.File.write

    def write(file: OpenEXR.File, name: str) -> None:
        numbers.append(OpenEXR.global_thread_count())
        real(file, name)

    source = write_shot("Blender", tmp_path / "in")
    monkeypatch.setattr(OpenEXR.File, "write", write)
    main.main(["denoise", str(source), "-o", str(tmp_path / "out"), "--method", "noisy"])
    assert set(numbers) == {cores}
    assert OpenEXR.global_thread_count() == 0
