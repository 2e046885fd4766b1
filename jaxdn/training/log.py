"""The log of a training run, ``log.jsonl``, and the curves in it."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.runtime.atomic_files import write_atomically


class Curve(NamedTuple):
    """What a run logged: one entry per logged step, and one per validation."""

    step: list[int]
    loss: list[float]
    validation_step: list[int]
    validation_psnr: list[float]


class Log:
    """``log.jsonl`` of a run: one strict JSON object per line, written immediately."""

    def __init__(self, path: Path, *, keep_until: int):
        """Open the log; entries after step ``keep_until`` belong to lost updates and are removed."""
        kept = [entry for entry in read_log(path) if entry["step"] <= keep_until]
        write_atomically({path: "".join(json.dumps(entry) + "\n" for entry in kept)})
        self._file = path.open("a")

    def write(self, **entry: Any) -> None:
        """Append one entry and flush it; non-finite values are written as null, as strict JSON has no NaN."""
        entry = {key: value if math.isfinite(value) else None for key, value in entry.items()}
        self._file.write(json.dumps(entry, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read_log(path: Path) -> list[dict[str, Any]]:
    """The entries of a log; a last line left incomplete by a crash is ignored, a missing file is an empty log."""
    entries = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            entries.append(json.loads(line))
        except ValueError:
            break
    return entries


def read_curve(folder: Path) -> Curve:
    """The loss and validation curves of a run's folder; NaN where the log has null."""

    def number(value: float | None) -> float:
        return float("nan") if value is None else value

    entries = read_log(folder / "log.jsonl")
    losses = [entry for entry in entries if "loss" in entry]
    checks = [entry for entry in entries if "validation_psnr" in entry]
    return Curve(
        [entry["step"] for entry in losses],
        [number(entry["loss"]) for entry in losses],
        [entry["step"] for entry in checks],
        [number(entry["validation_psnr"]) for entry in checks],
    )
