"""Write a report: ``metrics.json`` for programs, ``report.html`` for people."""

import json
import os
from pathlib import Path

from jaxdn.evaluation.report.page import page
from jaxdn.evaluation.report.results import Results, check_results, metrics
from jaxdn.runtime.atomic_files import write_atomically


def write_report(results: Results, folder: str | os.PathLike[str]) -> Path:
    """Write ``folder/metrics.json`` and ``folder/report.html``; returns the path of the page.

    ``metrics.json`` is strict JSON with every number of the results and no image: NaN (not measured, or nothing to
    measure on) is ``null``, infinities are the strings ``"inf"`` and ``"-inf"``. ``report.html`` is one file that needs
    neither a server nor a network. Both files are renamed into place when complete, the page last; the folder is
    created if it is missing. Raises ValueError for inconsistent results (a method without scores, images of different
    sizes), before anything is written.
    """
    check_results(results)
    numbers = json.dumps(metrics(results), indent=1, allow_nan=False, ensure_ascii=False)
    document = page(results)
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    write_atomically(
        {
            target / "metrics.json": (numbers + "\n").encode("utf-8", "replace"),
            target / "report.html": document.encode("utf-8", "replace"),
        }
    )
    return target / "report.html"
