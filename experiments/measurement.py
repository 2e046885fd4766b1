"""One measurement in the format of docs/results/*.json: what, where and when was measured, and its rows.

:mod:`experiments.results_page` shows such files. Those of ``runs`` are copied to docs/results by hand.
"""

import math
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from jaxdn.evaluation.compare import describe_machine


def describe_measurement(
    kind: str, title: str, section: str, order: float, *, command: str, what: str, rows: Sequence[Any]
) -> dict[str, Any]:
    """The contents of the file.

    Args:
      kind: how the rows are shown; :mod:`experiments.results_page` lists the kinds.
      title: heading on the page.
      section: heading above it.
      order: number by which the page sorts measurements.
      command: what measures it again.
      what: sentences on what the rows are.
      rows: the numbers.
    """
    machine = describe_machine()
    cores = f"{machine['cores']} core{'s' * (machine['cores'] != 1)}"
    measured = {
        "revision": find_revision() or "unknown",
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{cores} of {machine['processor']}, device {machine['device']}",
    }
    about = {"kind": kind, "title": title, "section": section, "order": order, "measured": measured}
    return {**about, "command": command, "what": what, "rows": list(rows)}


def round_finite(value: float, decimals: int) -> float | None:
    """The number with so many decimals; None for NaN and infinities, which JSON does not have."""
    return round(float(value), decimals) if math.isfinite(value) else None


def find_revision() -> str | None:
    """The commit of the code, with ``-dirty`` if files differ from it; None without git."""
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
