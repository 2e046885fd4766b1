"""Where and when a measurement was made."""

import re
from datetime import UTC, datetime

from experiments import measurement
from experiments.measurement import describe_measurement, find_revision


def describe():
    return describe_measurement("raw", "A title", "Speed", 7, command="make it", what="Two numbers.", rows=[1, 2])


def test_a_measurement_says_where_and_when_it_was_made():
    before = datetime.now(UTC).date().isoformat()
    found = describe()
    measured = found.pop("measured")
    assert found == {
        **{"kind": "raw", "title": "A title", "section": "Speed", "order": 7},
        **{"command": "make it", "what": "Two numbers.", "rows": [1, 2]},
    }
    assert before <= measured["date"] <= datetime.now(UTC).date().isoformat()
    assert re.match(r"\d+ cores of .+, device .+", measured["machine"])
    assert measured["revision"] == (find_revision() or "unknown")


def test_without_git_the_revision_is_unknown(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert measurement.find_revision() is None
    assert describe()["measured"]["revision"] == "unknown"
