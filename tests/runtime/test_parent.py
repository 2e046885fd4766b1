"""Workers end with their parent, in real processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
import multiprocessing, os, sys, time
from jaxdn.runtime.parent import end_with_parent

def work():
    if "with" in sys.argv:
        end_with_parent()
    print(os.getpid(), flush=True)
    time.sleep(60)

if __name__ == "__main__":
    worker = multiprocessing.get_context("spawn").Process(target=work)
    worker.start()
    worker.join()
"""


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_ends_when_its_parent_is_killed(sent: signal.Signals, tmp_path: Path) -> None:
    assert _survives(tmp_path, sent, "without")
    assert not _survives(tmp_path, sent, "with")


def _survives(folder: Path, sent: signal.Signals, how: str) -> bool:
    """Whether a worker is there three seconds after its parent was killed; it is killed then."""
    script = folder / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    parent = subprocess.Popen([sys.executable, script, how], stdout=subprocess.PIPE, text=True, env=environment)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    parent.send_signal(sent)
    parent.wait()
    end = time.monotonic() + (3 if how == "without" else 20)
    while time.monotonic() < end:
        if not _runs(worker):
            return False
        time.sleep(0.05)
    os.kill(worker, signal.SIGKILL)
    return True


def _runs(process: int) -> bool:
    """Whether a process is there and is no zombie, whose parent has not asked for its exit code."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True, check=False)
    return bool(state.stdout.strip()) and not state.stdout.startswith("Z")
