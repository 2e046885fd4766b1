"""The programs of the safe blend are made while the first frame is computed."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.sequence import run
from jaxdn.sequence.frame_denoiser import FrameDenoiser
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.data.test_kept import box_blur
from tests.programs import PROGRAMS, write_shot


def denoiser_of(**options: Any) -> FrameDenoiser:
    return FrameDenoiser(box_blur(), Path("shot"), channels=lambda: 3, log=lambda line: None, **options)


def count_while(call: Any) -> tuple[Any, list[str]]:
    """The result of a call, and the programs that were traced meanwhile."""
    traced: list[str] = []

    def note(event: str, duration_secs: float, **about: Any) -> None:
        if event.endswith("jaxpr_trace_duration"):
            traced.append(about.get("fun_name", ""))

    jax.monitoring.register_event_duration_secs_listener(note)
    try:
        return call(), traced
    finally:
        jax.monitoring.unregister_event_duration_listener(note)


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_the_blend_finds_them(dtype: type, depth: bool, rng: np.random.Generator) -> None:
    size = 17 + depth, 19 + (dtype == np.float32)
    radiance = rng.gamma(2, 0.1, (*size, 3)).astype(dtype)
    frame = Frame(radiance, depth=np.ones((*size, 1), np.float32) if depth else None)
    denoiser = denoiser_of(blends=True)
    image = denoiser(StoredFrame(frame))
    (blended, _), traced = count_while(lambda: denoiser.blend_fallback(frame, image))
    assert traced == []
    alone = denoiser_of()
    expected = alone.blend_fallback(frame, alone(StoredFrame(frame)))[0]
    np.testing.assert_array_equal(blended, expected)


def test_nothing_is_made_for_frames_that_are_not_blended(rng: np.random.Generator) -> None:
    frame = Frame(rng.gamma(2, 0.1, (13, 29, 3)).astype(np.float32))
    _, traced = count_while(lambda: denoiser_of()(StoredFrame(frame)))
    assert "combine" not in traced


@pytest.mark.parametrize("memory", [None, 1e12])
@pytest.mark.parametrize("safe", [True, False])
@pytest.mark.parametrize("bidirectional", [True, False])
def test_forward_frames_of_a_safe_run_are_blended(
    safe: bool, bidirectional: bool, memory: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where memory is limited, nothing is compiled beside a step."""
    asked = []

    class Recorded(FrameDenoiser):
        def __init__(self, *arguments: Any, blends: bool, **options: Any) -> None:
            asked.append(blends)
            super().__init__(*arguments, blends=blends, **options)

    monkeypatch.setattr(run, "FrameDenoiser", Recorded)
    naming = ChannelNaming(PROGRAMS["Arnold"].motion_convention)
    source = write_shot("Arnold", tmp_path / "in", 2)
    settings = Settings(naming=naming, safe=safe, bidirectional=bidirectional, max_memory=memory)
    denoise_files([source], tmp_path / "out", box_blur(), settings)
    assert asked == [safe and memory is None, False][: 1 + bidirectional]
