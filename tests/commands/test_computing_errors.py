"""Full memory and a failure of Open Image Denoise end a command with one line that says what to change."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from tests.training.test_training import make_clip

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
def test_a_backend_that_fails_ends_denoising_with_what_to_change(
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


def test_any_other_error_of_a_backend_keeps_its_traceback(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise jax.errors.JaxRuntimeError("INTERNAL: a bug")

    monkeypatch.setattr("jaxdn.sequence.frame_denoiser.FrameDenoiser.__call__", fail)
    clips.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", np.ones((8, 8), np.float32)))
    with pytest.raises(jax.errors.JaxRuntimeError, match="a bug"):
        main.main(["denoise", str(tmp_path / "a.exr"), "-o", str(tmp_path / "out"), "--method", "noisy"])


@pytest.mark.parametrize(
    ("command", "where", "remedy"),
    [
        (["train", "DATA", "-o", "OUT"], "jaxdn.training.train.train", "give a smaller --batch or --crop, or --remat"),
        (["compare", "DATA", "-o", "OUT", "--methods", "svgf"], "jaxdn.evaluation.compare.compare", "other --methods"),
    ],
)
@pytest.mark.parametrize("kind", FAILS)
def test_a_backend_that_fails_ends_training_and_comparing_too(
    *,
    command: list[str],
    where: str,
    remedy: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Any,
) -> None:
    error, _, reason = FAILS[kind]

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(where, fail)
    clips.write_clip(make_clip(0, size=16, frames=2), tmp_path / "DATA" / "one")
    with pytest.raises(SystemExit) as ended:
        main.main([str(tmp_path / word) if word.isupper() else word for word in command])
    text = capsys.readouterr().err
    assert (ended.value.code, "Traceback" in text, text.count("\n")) == (2, False, 1)
    assert remedy in text
    assert reason in text
