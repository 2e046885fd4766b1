"""The comparison of the learned relatives, on one family and after two updates."""

import re
from pathlib import Path

import numpy as np
import pytest

from experiments.papers import learned

pytestmark = pytest.mark.slow


def test_the_learned_relatives_are_trained_and_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned, "FAMILIES", ("fruit",))
    stages = ["ntasd", "ntasd, uniform", "rae"]
    settings = learned.Settings(
        clips=1, stages=stages, steps=2, frames=2, size=64, data=tmp_path / "data", out=tmp_path / "runs", workers=1
    )
    learned.main(settings)
    text = (tmp_path / "runs" / "table.md").read_text()
    for label in ("noisy", "svgf", *stages):
        assert re.search(rf"\| {label} \| \d", text), text
    assert re.search(r"\| fruit-2000 \| -?\d\.\d\d, 1 to \d+ \|", text), text
    assert (tmp_path / "runs" / "pictures" / "fruit-2000" / "ntasd-samples.png").is_file()
    assert (tmp_path / "runs" / "report.html").is_file()


def test_unknown_stages_raise() -> None:
    with pytest.raises(ValueError, match="--stages: expected some of ntasd"):
        learned.main(learned.Settings(stages=["vae"]))


def test_ranks_correlate_whatever_their_scale(rng: np.random.Generator) -> None:
    values = rng.normal(size=(20, 20))
    assert learned.correlation(values, np.exp(3 * values)) == pytest.approx(1)
    assert learned.correlation(values, -values) == pytest.approx(-1)
    assert abs(learned.correlation(values, rng.normal(size=(20, 20)))) < 0.2
