"""A short run of the fuzzer; `python -m experiments.stability.fuzz` is the long one."""

import json

import pytest

from experiments.stability import fuzz, fuzz_inputs


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return fuzz.prepare(tmp_path_factory.mktemp("fuzz") / "source")


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["exr", *(pytest.param(kind, marks=pytest.mark.slow) for kind in fuzz.KINDS[1:])])
def test_broken_files_only_raise_documented_errors(kind, source):
    counts = fuzz.run_kind(kind, 0, 150, source)
    assert counts.bad == []
    assert counts.read + counts.refused == counts.inputs == 150
    assert counts.refused > 20


def test_inputs_are_the_same_in_every_run():
    good = [b"0123456789" * 9]
    assert fuzz_inputs.broken("exr", good, 5) == fuzz_inputs.broken("exr", good, 5)
    assert fuzz_inputs.broken("exr", good, 5) != fuzz_inputs.broken("exr", good, 6)


def test_half_of_the_json_still_parses_and_says_something_else():
    good = b'{"frames": 4, "camera": [{"frame": 0, "fov": 40}], "lights": {"lamp": [1, 2]}}'
    parsed = 0
    for number in range(200):
        data = fuzz_inputs.broken("animation", [good], number)
        assert len(data) < 1 << 17
        try:
            parsed += json.loads(data) != json.loads(good)
        except (ValueError, RecursionError):
            continue
    assert 60 < parsed < 160
