"""A short run of the fuzzer; `python -m experiments.fuzz` is the long one."""

import pytest

from experiments import fuzz


@pytest.mark.parametrize("kind", ["exr", *(pytest.param(kind, marks=pytest.mark.slow) for kind in fuzz.KINDS[1:])])
def test_broken_files_are_refused_and_nothing_else(kind):
    told = fuzz.run_kind(kind, 0, 150, 150)
    assert told["bad"] == []
    assert told["read"] + told["refused"] == 150
    assert told["refused"] > 20


def test_inputs_are_the_same_in_every_run():
    assert fuzz.broken(b"0123456789" * 9, 5) == fuzz.broken(b"0123456789" * 9, 5)
    assert fuzz.broken(b"0123456789" * 9, 5) != fuzz.broken(b"0123456789" * 9, 6)
