"""Full memory and a failure of Open Image Denoise end `jaxdn denoise` with one line that says what to change."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main

FULL = "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 12884901888 bytes.\nBufferAssignment OOM"
FAILS = {
    "memory of the GPU": (jax.errors.JaxRuntimeError(FULL), "--max-memory", "12884901888 bytes"),
    "memory of NumPy": (MemoryError("Unable to allocate 12.0 GiB"), "--max-memory", "12.0 GiB"),
    "Open Image Denoise": (RuntimeError("Open Image Denoise: no CUDA"), "--method", "Open Image Denoise: no CUDA"),
    "in a callback": (
        jax.errors.JaxRuntimeError("INTERNAL: callback\nTraceback:\nRuntimeError: Open Image Denoise: no CUDA\n"),
        "--method",
        "jaxdn: Open Image Denoise: no CUDA; ",
    ),
}


@pytest.mark.parametrize("kind", FAILS)
def test_an_engine_that_fails_ends_denoising_with_what_to_change(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    error, option, reason = FAILS[kind]

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("jaxdn.sequence.frame_denoiser.FrameDenoiser.__call__", fail)
    clips.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", np.ones((8, 8), np.float32)))
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", str(tmp_path / "a.exr"), "-o", str(tmp_path / "out"), "--method", "noisy"])
    assert ended.value.code == 2
    text = capsys.readouterr().err
    assert "Traceback" not in text
    assert text.count("\n") == 1
    assert option in text
    assert reason in text


def test_any_other_error_of_an_engine_keeps_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise jax.errors.JaxRuntimeError("INTERNAL: a bug")

    monkeypatch.setattr("jaxdn.sequence.frame_denoiser.FrameDenoiser.__call__", fail)
    clips.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", np.ones((8, 8), np.float32)))
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
        main.main(["denoise", str(tmp_path / "a.exr"), "-o", str(tmp_path / "out"), "--method", "noisy"])
