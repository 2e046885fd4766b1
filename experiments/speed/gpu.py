"""A GPU in fifteen minutes: every figure of one device, in an order that puts first what matters most; resumable.

    python -m experiments.speed.gpu --minutes 7        # again, until it says that nothing is left: runs/gpu.json
    python -m experiments.speed.gpu --quick            # a CPU, tiny: whether the script itself works

1. The device: bandwidth, products in float32 and bfloat16.
2. Images of a clip against those of the CPU, of every shipped method, ``svgf`` and ``relax`` (``--clip`` names a real
   one, a folder of ours or of EXR files; else one is drawn).
3. A frame of each: time, roofline, memory, compile time; float32 and bfloat16, with this device's own kernels and plain
   XLA; Open Image Denoise on the same device. 1280 x 720 first.
4. The ten longest kernels of the highest quality.
5. From EXR to EXR by `jaxdn denoise`, and by Open Image Denoise with the same reading and writing.

Each item has a process of its own and is saved when it is done. What is saved is not measured again, unless the
device or the sizes differ; a failure is saved with its reason, and tried again by the next run. Everything that is
needed lies in the repository: a machine without a network runs it.
"""

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments.measurement import find_revision
from experiments.speed import peers
from experiments.speed.frames import parsed
from experiments.speed.workers import WorkerError, apart
from experiments.speed.works import files, on_device
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.data.read import read_clip
from jaxdn.runtime.atomic_files import write_json
from jaxdn.zoo.ready import ready_names

Item = tuple[str, Callable[[], Any]]
"""A key and what measures it."""

AIM = "steady-high"
"""The method whose kernels are listed: the highest quality that needs nothing but the device."""
FILES = (AIM, "svgf")
OIDN = "Open Image Denoise"
USUAL = ["1280x720", "1920x1080", "3840x2160"]


@dataclass
class Settings:
    """Measure one device; continue where the last run ended."""

    minutes: float = 7.0
    """No item is begun after this time."""
    methods: list[str] = field(default_factory=list)
    """By default all shipped weights, svgf and relax."""
    sizes: list[str] = field(default_factory=lambda: list(USUAL))
    """WIDTHxHEIGHT in pixels, the most important first."""
    clip: Path | None = None
    """A clip whose images are compared with those of the CPU: its first frames. None: one is drawn."""
    rounds: int = 20
    quick: bool = False
    """One filter on a tiny image, in half a minute, on any device."""
    out: Path = Path("runs/gpu.json")


class Results:
    """Item -> its figures, in a file that is complete after each."""

    def __init__(self, path: Path, about: dict[str, Any]) -> None:
        """What the file has of the same device, revision and settings is kept."""
        self.path, self.about = path, about
        path.parent.mkdir(parents=True, exist_ok=True)
        before = json.loads(path.read_text()) if path.is_file() else {}
        self.items: dict[str, Any] = before.get("items", {}) if before.get("about") == about else {}

    def has(self, key: str) -> bool:
        """Whether an item is measured; one that failed is not."""
        return key in self.items and "failed" not in self.items[key]

    def add(self, key: str, value: dict[str, Any]) -> None:
        """Save an item."""
        self.items[key] = value
        write_json(self.path, {"about": self.about, "items": self.items})


def items(settings: Settings, results: Results) -> Iterator[Item]:
    """All items, in the order in which they are measured."""
    quick, rounds = settings.quick, settings.rounds
    methods = settings.methods or (["taa"] if quick else [AIM, *_others()])
    sizes = ["48x32"] if quick else settings.sizes
    yield "device", partial(apart, on_device.measure_rates, rounds, 1 << (16 if quick else 27), 64 if quick else 8192)
    for name in methods:
        yield f"images {name}", partial(compare_images, name, settings)
    for size in sizes:
        yield f"frame {size} {OIDN}", partial(_oidn, size, rounds)
        for name in methods:
            yield f"frame {size} {name}", partial(measure_frame, name, size, rounds, results, quick=quick)
        if size == sizes[0]:
            yield f"kernels {size}", partial(list_kernels, methods[0] if quick else AIM, size)
            yield f"files {size}", partial(measure_files, methods[:1] if quick else FILES, size, quick=quick)
    for size in sizes[1:]:
        yield f"files {size}", partial(measure_files, FILES, size, quick=quick)


def _others() -> list[str]:
    return [*(name for name in reversed(ready_names()) if name != AIM), "svgf", "relax"]


def compare_images(name: str, settings: Settings) -> dict[str, Any]:
    """The largest and the mean difference of a clip's images here and on the CPU, relative to their mean light."""
    if settings.clip is None:
        frames = on_device.draw_clip(3, 32, 48) if settings.quick else on_device.draw_clip(8, 144, 256)
    else:
        frames = Frame(*(None if buffer is None else buffer[:8] for buffer in read_clip(settings.clip).frames))
    here, there = (apart(on_device.denoise_clip, name, frames, platform) for platform in (None, "cpu"))
    difference, light = np.abs(here - there), float(np.mean(there))
    return {
        "clip": "drawn" if settings.clip is None else settings.clip.name,
        "largest": float(difference.max()) / light,
        "mean": float(difference.mean()) / light,
        "finite": bool(np.isfinite(here).all()),
    }


def measure_frame(name: str, size: str, rounds: int, results: Results, *, quick: bool) -> dict[str, Any]:
    """Precision and kernels -> what a step takes, and its roofline at the rates that the device reached."""
    variants = list(product(on_device.PRECISIONS, on_device.OPERATIONS))[:: 3 if quick else 1]
    found = apart(on_device.measure_frames, name, *parsed(size), variants, rounds)
    rates = results.items.get("device", {})
    rows = {}
    for (precision, operations), cost in zip(variants, found, strict=True):
        row = cost._asdict()
        if "copy_gb_s" in rates:
            by_bytes = 1e3 * cost.gbytes / rates["copy_gb_s"]
            by_flop = 1e3 * cost.gflop / rates[f"{precision}_gflop_s"]
            row |= {"roofline_ms": max(by_bytes, by_flop), "of_roofline": cost.median_ms / max(by_bytes, by_flop)}
        rows[f"{precision}, {'XLA' if operations != 'auto' else 'own kernels'}"] = row
    return rows


def list_kernels(name: str, size: str) -> dict[str, Any]:
    """The ten longest."""
    found = apart(on_device.longest_kernels, name, *parsed(size), 10)
    return {"method": name, "longest": [{"kernel": k, "ms": ms, "share": share} for k, ms, share in found]}


def measure_files(methods: Sequence[str], size: str, *, quick: bool) -> dict[str, Any]:
    """Method -> seconds of a first frame, cold and warm, milliseconds of each further one, memory of the process."""
    if not files.measurable():
        raise WorkerError("this system does not tell what a child process took")
    peer = [] if "pyoidn" in peers.missing() else [files.PEER]
    frames, rounds = (2, 1) if quick else (files.FRAMES, 2)
    with tempfile.TemporaryDirectory() as place:
        taken = files.measure([*peer, *methods], Path(place), rounds=rounds, frames=frames, size=parsed(size))
    works = files.timings(taken, frames)
    return {
        work: {name: {"median_ms": timing.median_ms, "peak_mib": peak} for name, (timing, peak) in found.items()}
        for work, found in works.items()
    }


def _oidn(size: str, rounds: int) -> dict[str, Any]:
    """Open Image Denoise on the same device."""
    if "pyoidn" in peers.missing():
        raise WorkerError(peers.missing()["pyoidn"])
    return {"with copies": apart(on_device.measure_oidn, *parsed(size), rounds)}


def table(results: Results) -> Table:
    """The frames that are measured, a line for each variant."""
    shown = Table(title="a frame")
    for title in ("size", "method", "precision, kernels", "ms", "of roofline", "memory MiB", "compile s"):
        shown.add_column(title)
    for key, value in results.items.items():
        kind, *rest = key.split(" ", 2)
        if kind != "frame" or "failed" in value:
            continue
        for variant, row in value.items():
            bound = f"{row['of_roofline']:.1f}" if "of_roofline" in row else ""
            memory, compiling = (f"{row[name]:.1f}" if name in row else "" for name in ("memory_mib", "compile_s"))
            shown.add_row(*rest, variant, f"{row['median_ms']:.3f}", bound, memory, compiling)
    return shown


def main(settings: Settings) -> int:
    """Measure what is not measured yet, and print it; returns the number of items that are left."""
    began, console = time.monotonic(), Console(width=120)
    # Several processes share the device, one after the other: none may reserve most of its memory.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    for size in settings.sizes:
        parsed(size)
    about = {
        "device": apart(on_device.describe_device),
        "revision": find_revision() or "unknown",
        "clip": "drawn" if settings.clip is None else settings.clip.name,
        "quick": settings.quick,
    }
    results = Results(settings.out, about)
    console.print(f"{about['device']}, {len(results.items)} items are there", highlight=False)
    left = 0
    for key, measure in items(settings, results):
        if results.has(key):
            continue
        spent = time.monotonic() - began
        if spent > 60 * settings.minutes:
            left += 1
            continue
        try:
            found = measure()
        except (WorkerError, RuntimeError) as error:
            found = {"failed": str(error)[-400:]}
        results.add(key, found)
        console.print(f"[{spent:5.0f} s] {key}: {json.dumps(found)[:300]}", highlight=False, markup=False)
    failed = [key for key in results.items if not results.has(key)]
    console.print(table(results))
    if failed:
        console.print(f"failed, and tried again by the next run: {', '.join(failed)}")
    console.print(f"{settings.out}: {len(results.items)} items; {f'{left} are left: run it again' if left else 'all'}")
    return left


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
