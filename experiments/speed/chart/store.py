"""The raw measurements in one file that is complete after every point: an interrupted run is resumed."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxdn.data.errors import read_json
from jaxdn.evaluation.report.results import json_ready
from jaxdn.runtime.atomic_files import write_json

PARTS = ("clips", "errors", "times", "render", "breakdown", "stages", "left_out")
"""errors: "method @ spp" -> clip -> measure -> number. times: method -> size -> what was measured. render: size ->
clip -> cost. breakdown: network -> part -> timing. stages: method -> the buffers that it reads, and its times."""


class Store:
    """``chart.json``: the measurements, their settings and their machine."""

    def __init__(self, path: Path, settings: Mapping[str, Any], machine: Mapping[str, Any]) -> None:
        self.path = path
        made_with = json_ready({"settings": settings, "machine": machine})
        text = json.dumps(made_with, sort_keys=True)
        mark = hashlib.sha256(text.encode()).hexdigest()[:16]
        self.data: dict[str, Any] = {"fingerprint": mark, **made_with, **{part: {} for part in PARTS}}
        self.kept = False
        """Measurements of an earlier run with the same settings on the same machine were found."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            before = read_json(path)
            if isinstance(before, dict) and before.get("fingerprint") == mark:
                self.data, self.kept = before, True
            else:
                # Numbers of another machine or other settings cannot be combined with these, but may have taken long.
                os.replace(path, path.with_name("chart.before.json"))

    def put(self, part: str, key: str, value: Any) -> None:
        """Add one measurement and rewrite the file."""
        self.data[part][key] = json_ready(value)
        write_json(self.path, self.data)

    def has(self, part: str, key: str) -> bool:
        """Whether this was measured."""
        return key in self.data[part]


def point_key(method: str, spp: float) -> str:
    """The key of a point in the file."""
    return f"{method} @ {spp:g}"
