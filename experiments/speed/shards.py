"""Shards of real size: packing, reading by 1, 2 and 4 processes, and a damaged one.

    python -m experiments.speed.shards        # minutes, 6 GB of disk in --folder; runs/shards.json

Synthetic clips are packed by ``jaxdn pack --format arrayrecord``, so that the first shard is as large as the command
makes them. Processes of their own then read the same stream: their batches, joined, have to be those of one process
alone. In the end a bit of the shard is flipped, and the set is read until that is told.
"""

import hashlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from itertools import chain, islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import tyro

from experiments.measurement import describe_measurement
from experiments.speed.timing import peak_mib
from experiments.speed.works import scene
from jaxdn.clips import ClipError, training_batches, write_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.data.training.open_clips import open_clips
from jaxdn.runtime.atomic_files import write_json

PROCESSES = (1, 2, 4)


@dataclass
class Settings:
    """Pack shards as large as they get, read and damage them."""

    mib: float = 2200.0
    """Of the set, before zstd."""
    crop: int = 128
    frames: int = 10
    side: int = 256
    """Of the clips, of which there are four, twice as long as a window."""
    batch: int = 8
    """Elements, of all processes together."""
    batches: int = 8
    """To be read by each number of processes."""
    folder: Path | None = None
    """Where the clips and shards are for the time being; None: the system's folder for such files."""
    out: Path = field(default_factory=lambda: Path("runs/shards.json"))


class Spent(NamedTuple):
    """What a process took."""

    wall_s: float
    cpu_s: float
    peak_mib: float


class Part(NamedTuple):
    """What one of several processes has read."""

    digests: list[list[str]]
    """Of each batch, of each element in it."""
    cpu_ms: float
    """An element, of all threads."""
    mb: float
    """An element, as it goes to a device."""
    peak_mib: float | None


def run(command: Sequence[str]) -> Spent:
    """Run a command of jaxdn; raises RuntimeError where it fails."""
    began = time.perf_counter()
    with subprocess.Popen([sys.executable, "-m", "jaxdn", *command], stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise RuntimeError(f"jaxdn {' '.join(command)}: ended with status {status}.")
    return Spent(time.perf_counter() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def read_part(place: Path, settings: Settings, process: tuple[int, int]) -> Part:
    """The elements of one process; the first batch, which opens files, is not counted in what it takes."""
    found: list[Part] = []

    def read() -> None:
        stream = _open(place, settings, process)
        digests: list[list[str]] = []
        spent = 0.0
        for _ in range(settings.batches):
            began = time.process_time()
            batch = next(stream)
            spent = spent + time.process_time() - began if digests else 0.0
            leaves = jax.tree.leaves(batch)
            elements = len(leaves[0])
            digests.append([_digest(leaf[index] for leaf in leaves) for index in range(elements)])
        size = sum(leaf.nbytes for leaf in leaves) / elements
        found.append(Part(digests, 1e3 * spent / (elements * (settings.batches - 1)), size / 1e6, None))

    peak = peak_mib(read)
    return found[0]._replace(peak_mib=peak)


def _digest(arrays: Any) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()


def _open(place: Path, settings: Settings, process: tuple[int, int]) -> Any:
    return training_batches(
        place,
        batch=settings.batch,
        crop=settings.crop,
        frames=settings.frames,
        seed=0,
        threads=0,
        process=process,
        vary_later=True,
    )


def read_by(count: int, place: Path, settings: Settings) -> list[Part]:
    """What each of ``count`` processes reads, at the same time."""
    with ProcessPoolExecutor(count, get_context("spawn")) as pool:
        given = [(place, settings, (index, count)) for index in range(count)]
        return list(pool.map(read_part, *zip(*given, strict=True)))


def join(parts: Sequence[Part]) -> list[list[str]]:
    """The digests of the batches of all processes together: each has every so many-th element."""
    batches = zip(*(part.digests for part in parts), strict=True)
    return [list(chain.from_iterable(zip(*batch, strict=True))) for batch in batches]


def damage(shard: Path) -> None:
    """Flip a bit in the middle of a file."""
    with shard.open("r+b") as file:
        file.seek(shard.stat().st_size // 2)
        (byte,) = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 1]))


def find_damage(place: Path, settings: Settings, windows: int) -> str:
    """What is said of a damaged shard, reading each window three times at most."""
    stream = _open(place, settings, (0, 1))
    try:
        for _ in islice(stream, 3 * windows // settings.batch + 1):
            pass
    except ClipError as error:
        return str(error).replace(f"{place}{os.sep}", "")
    return "nothing is said"


def main(settings: Settings) -> None:
    """Measure, print, save."""
    with tempfile.TemporaryDirectory(dir=settings.folder) as folder:
        clips, place = Path(folder) / "clips", Path(folder) / "shards"
        for seed in range(4):
            write_clip(scene.clip(2 * settings.frames, settings.side, settings.side, seed=seed), clips / f"clip-{seed}")
        open_clips(clips)  # what packing takes is not what decoding takes
        options = ["--format", "arrayrecord", "--mib", f"{settings.mib}", "--draws", "0", "--without-half"]
        options += ["--crop", f"{settings.crop}", "--frames", f"{settings.frames}"]
        packed = run(["pack", str(clips), "-o", str(place), *options])
        windows = open_clips(place)
        shards = sorted(place.glob("*.arrayrecord"), key=lambda path: path.stat().st_size)
        parts = {count: read_by(count, place, settings) for count in PROCESSES}
        rows = _rows(settings, packed, len(windows), [path.stat().st_size for path in shards], parts)
        damage(shards[-1])
        rows.append(("one bit flipped in the largest", find_damage(place, settings, len(windows))))
    for name, value in rows:
        print(f"{name}: {value}", flush=True)
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    write_json(settings.out, _describe(settings, rows))


def _rows(
    settings: Settings, packed: Spent, windows: int, sizes: list[int], parts: dict[int, list[Part]]
) -> list[tuple[str, str]]:
    total = sum(sizes) / 1e6
    rows = [
        (
            "shards",
            f"{len(sizes)}, the largest of {sizes[-1] / 1e6:.0f} MB, together {total:.0f} MB, {windows} windows",
        ),
        ("packing", f"{packed.wall_s:.0f} s, {total / packed.wall_s:.0f} MB/s"),
        ("packing, processor time", f"{packed.cpu_s:.0f} s, {total / packed.cpu_s:.0f} MB a second"),
        ("packing, peak memory", f"{packed.peak_mib:.0f} MiB"),
    ]
    alone = join(parts[1])
    for count, some in parts.items():
        equal = "" if count == 1 else ", the same batches" if join(some) == alone else ", other batches"
        cpu = sum(part.cpu_ms for part in some) / count
        peak = ", ".join(f"{part.peak_mib:.0f}" for part in some if part.peak_mib is not None) or "unknown"
        told = f"{cpu:.1f} CPU ms an element of {some[0].mb:.1f} MB, {1e3 * some[0].mb / cpu:.0f} MB a second of a core"
        rows.append((f"read by {count}", f"{told}; peak memory in MiB {peak}{equal}"))
    return rows


def _describe(settings: Settings, rows: list[tuple[str, str]]) -> dict[str, Any]:
    found = describe_measurement(
        *("table", "Shards of real size", "Speed", 355),
        command="python -m experiments.speed.shards",
        what=f"Synthetic clips, windows of {settings.frames} frames of {settings.crop} x {settings.crop}. MB a second "
        "are of the compressed files in packing, and of what goes to a device in reading.",
        rows=rows,
    )
    return {**found, "columns": [{"name": "what"}, {"name": "found"}]}


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
