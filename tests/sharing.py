"""What takes long to make, made once: for all processes of pytest-xdist, or for all tests of one."""

import functools
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from jaxdn.zoo.ready import Model, find_model
from tests.needs import require_module


@functools.cache
def share_model(name: str) -> Model:
    """:func:`jaxdn.zoo.ready.find_model`, asked once: a step is traced for a denoiser, not for its name.

    For tests that change nothing that a step depends on while it is traced.
    """
    return find_model(name)


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that ``make`` has filled: the first process that asks makes it, and the others wait for it.

    The test that asks is skipped where there are no locks of files, on Windows. What ``make`` raises is raised, and the
    next process that asks begins with what is there.
    """
    fcntl = require_module("fcntl")
    base = factory.getbasetemp()
    place = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "made-once"
    place.mkdir(exist_ok=True)
    folder, made = place / name, place / f"{name}.made"
    with open(place / f"{name}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            made.touch()
    return folder
