"""The measurement of training on several devices: its model, and the whole of it on a small method."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.speed.devices import Link, predict_efficiency
from tests.training.test_processes import METHOD, have_devices

ROOT = Path(__file__).parents[2]


def test_the_model_is_that_of_a_ring() -> None:
    free = Link("", 8, 1e30, 0.0)
    assert predict_efficiency(0.2, 10**6, free) == pytest.approx(1.0)
    # 14 messages of 1 MB at 1 GB/s, and 14 times 1 ms: 28 ms beside 72 ms.
    assert predict_efficiency(0.072, 2 * 10**6, Link("", 8, 1e9, 1e-3)) == pytest.approx(0.72)
    two, many = (predict_efficiency(0.1, 10**6, Link("", count, 1e9, 1e-5)) for count in (2, 64))
    assert many < two < 1


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_two_devices_are_measured_and_told(tmp_path: Path) -> None:
    (tmp_path / "learned_kernel.py").write_text(METHOD)
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": have_devices(2),
        "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}",
    }
    command = [sys.executable, "-m", "experiments.speed.devices", "--method", "learned_kernel:kernel", "--variant", ""]
    command += ["--batch", "2", "--crop", "32", "--frames", "2", "--budget", "2", "--elements", "8"]
    command += ["--out", str(tmp_path / "out.json")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads((tmp_path / "out.json").read_text())
    found = dict(told["rows"])
    assert "of 2 times one" in found["step on 2 of 2 devices"]
    assert "0.00 MB, 81 weights" in found["exchanged an update"]
    before, after = (float(found[f"input, varied {how}"].split()[4]) for how in ("by NumPy", "in the update"))
    assert after < 0.6 * before
    assert told["kind"] == "table"
    assert all(name in done.stdout for name in found)
