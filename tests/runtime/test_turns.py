"""Threads of Python that wait for each other; the system rounds to microseconds."""

import sys
from pathlib import Path

import pytest

from jaxdn.commands import main
from jaxdn.runtime.turns import TURN_S, short_turns
from tests.programs import write_shot


def test_turns_are_short_until_the_end_of_the_block() -> None:
    before = sys.getswitchinterval()
    with short_turns():
        assert sys.getswitchinterval() == pytest.approx(TURN_S, rel=0.02)
    assert sys.getswitchinterval() == before
    with pytest.raises(KeyError), short_turns():
        raise KeyError
    assert sys.getswitchinterval() == before


def test_turns_that_are_shorter_stay() -> None:
    before = sys.getswitchinterval()
    sys.setswitchinterval(TURN_S / 5)
    try:
        with short_turns():
            assert sys.getswitchinterval() == pytest.approx(TURN_S / 5, rel=0.02)
    finally:
        sys.setswitchinterval(before)


def test_frames_are_denoised_with_short_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    monkeypatch.setattr(
        "jaxdn.commands.denoise.run_denoise", lambda options, on_start: found.append(sys.getswitchinterval())
    )
    before = sys.getswitchinterval()
    source = write_shot("Blender", tmp_path / "in", 1)
    main.main(["denoise", str(source), "-o", str(tmp_path / "out"), "--method", "noisy"])
    assert found == [pytest.approx(TURN_S, rel=0.02)]
    assert sys.getswitchinterval() == before
