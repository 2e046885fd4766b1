"""The script that measures a device: everything in it, tiny, on a CPU; and that it goes on where it ended."""

import contextlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from experiments.speed import gpu
from experiments.speed.workers import Process, WorkerError, apart
from experiments.speed.works import files, on_device
from tests.needs import require


def settings(out: Path, **changed: Any) -> gpu.Settings:
    """Tiny ones."""
    return gpu.Settings(**{"quick": True, "rounds": 2, "minutes": 30.0, "out": out, **changed})


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="what a child process took is only known on Unix")
@pytest.mark.usefixtures("plain_processes")
def test_every_item_is_measured_on_a_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images by two processes, as users' runs, and files by commands; what else has a process has the same one here."""
    require("pyoidn")
    with contextlib.closing(Process()) as shared:

        def ask(function: Callable[..., Any], *arguments: Any) -> Any:
            return (apart if function is on_device.denoise_clip else shared.ask)(function, *arguments)

        monkeypatch.setattr(gpu, "apart", ask)
        assert gpu.main(settings(tmp_path / "gpu.json")) == 0
    items = json.loads((tmp_path / "gpu.json").read_text())["items"]
    keys = ["device", "images taa", "frame 48x32 Open Image Denoise", "frame 48x32 taa", "kernels 48x32", "files 48x32"]
    assert list(items) == keys
    assert not [value for value in items.values() if "failed" in value]
    assert items["device"]["copy_gb_s"] > 0.01
    assert items["images taa"]["largest"] == 0.0, "the CPU against itself"
    assert set(items["frame 48x32 taa"]) == {"float32, own kernels", "bfloat16, XLA"}
    for row in items["frame 48x32 taa"].values():
        assert row["median_ms"] > 0
        assert row["compile_s"] > 0
        # The buffers that are read: 3 + 1 + 2 floats a pixel at the least, and the image.
        assert row["gbytes"] > 4 * 9 * 48 * 32 / 1e9
        assert row["memory_mib"] > row["gbytes"] * 1e9 / 2**20 / 2
        assert row["roofline_ms"] > 0
    assert 1 <= len(items["kernels 48x32"]["longest"]) <= 10
    shares = [one["share"] for one in items["kernels 48x32"]["longest"]]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) <= 1 + 1e-9
    first = items["files 48x32"]["files-first-frame"]
    assert set(first) == {files.PEER, "taa-cold", "taa-warm"}
    assert first["taa-cold"]["median_ms"] > first[files.PEER]["median_ms"]


@pytest.fixture
def instead(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Items that take no time, the second of which fails the first time; the list of what was measured."""
    measured: list[str] = []

    def measure(key: str) -> dict[str, Any]:
        measured.append(key)
        if key == "frame b" and measured.count(key) == 1:
            raise WorkerError("out of memory")
        return {"float32, XLA": {"median_ms": 1.0}}

    monkeypatch.setattr(gpu, "apart", lambda function, *arguments: {"kind": "none"})
    monkeypatch.setattr(gpu, "items", lambda *_: ((key, lambda key=key: measure(key)) for key in ("a", "frame b", "c")))
    return measured


def test_the_next_run_measures_what_failed_and_nothing_else(tmp_path: Path, instead: list[str]) -> None:
    out = tmp_path / "gpu.json"
    assert gpu.main(settings(out)) == 0
    assert instead == ["a", "frame b", "c"]
    assert json.loads(out.read_text())["items"]["frame b"] == {"failed": "out of memory"}
    assert gpu.main(settings(out)) == 0
    assert instead == ["a", "frame b", "c", "frame b"]
    assert "failed" not in json.loads(out.read_text())["items"]["frame b"]


def test_what_there_is_no_time_for_is_left_to_the_next_run(tmp_path: Path, instead: list[str]) -> None:
    out = tmp_path / "gpu.json"
    assert gpu.main(settings(out, minutes=-1.0)) == 3
    assert instead == []
    assert gpu.main(settings(out)) == 0
    assert instead == ["a", "frame b", "c"]


def test_figures_of_another_device_are_not_kept(tmp_path: Path, instead: list[str]) -> None:
    out = tmp_path / "gpu.json"
    gpu.main(settings(out))
    gpu.main(settings(out, clip=tmp_path / "another"))
    assert instead.count("a") == 2


def test_what_matters_most_comes_first() -> None:
    """720p of all methods, with kernels and files, before larger frames."""
    full = gpu.Settings()
    keys = [key for key, _ in gpu.items(full, gpu.Results.__new__(gpu.Results))]
    assert keys[0] == "device"
    assert keys[1] == f"images {gpu.AIM}"
    assert max(keys.index(f"{kind} 1280x720") for kind in ("kernels", "files")) < keys.index(
        f"frame 1920x1080 {gpu.OIDN}"
    )
    assert {f"frame {size} {name}" for size in gpu.USUAL for name in ("svgf", "relax", "steady-fast")} < set(keys)
    assert len(keys) == len(set(keys))


def test_kernels_are_those_of_the_device_where_there_is_one() -> None:
    class Named:
        def __init__(self, name: str, **parts: Any) -> None:
            self.name = name
            self.__dict__.update(parts)

    def plane(name: str, *events: tuple[str, str, float]) -> Named:
        made = [Named(kernel, stats=[("hlo_op", op)] if op else [], duration_ns=ns) for kernel, op, ns in events]
        return Named(name, lines=[Named("Stream #1", events=made)])

    host = plane("/host:CPU", ("dot.1", "dot.1", 5.0), ("wait", "", 100.0))
    device = plane("/device:GPU:0", ("gemm", "dot.1", 7.0), ("gemm", "dot.1", 2.0), ("MemcpyH2D", "", 3.0))
    assert on_device.add_kernels(Named("", planes=[host])) == {"dot.1": 5.0}
    assert on_device.add_kernels(Named("", planes=[host, device])) == {"dot.1 (gemm)": 9.0}
