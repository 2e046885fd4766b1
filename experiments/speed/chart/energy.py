"""Energy in joules of the processor's packages, where the machine reports it (RAPL under Linux)."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

POWERCAP = Path("/sys/class/powercap")

NOT_MEASURABLE = "Energy is not measurable on this machine: it exposes no readable RAPL counters."


class Meter:
    """The energy counters of all packages; they include everything that runs on the machine."""

    def __init__(self, zones: Sequence[Path]) -> None:
        self._zones = zones

    def joules(self, call: Callable[[], Any]) -> float:
        """The packages' energy while ``call`` ran."""
        before = [_read(zone / "energy_uj") for zone in self._zones]
        call()
        total = 0
        for zone, start in zip(self._zones, before, strict=True):
            spent = _read(zone / "energy_uj") - start
            # The counter wraps around.
            total += spent if spent >= 0 else spent + _read(zone / "max_energy_range_uj")
        return total / 1e6


def find_meter(folder: Path = POWERCAP) -> Meter | None:
    """The meter of this machine; None if it has none or its counters cannot be read (often only by root)."""
    zones = sorted(folder.glob("intel-rapl:[0-9]")) + sorted(folder.glob("intel-rapl:[0-9][0-9]"))
    try:
        for zone in zones:
            _read(zone / "energy_uj")
    except OSError:
        return None
    return Meter(zones) if zones else None


def _read(path: Path) -> int:
    return int(path.read_text())
