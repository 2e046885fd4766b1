"""The tests of files, programs and real processes: processes find the programs that others have compiled."""

from collections.abc import Iterator

import jax
import pytest

CACHE = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
"""Settings of :mod:`jax`; their variables have the same names in capitals."""


@pytest.fixture(scope="session", autouse=True)
def programs_for_processes() -> Iterator[None]:
    """Processes that a test starts keep compiled programs where this one does.

    A test often runs the same command, or trains the same network, in several processes. Their programs are still those
    that users run: the settings of this process that change programs are not theirs.
    """
    with pytest.MonkeyPatch.context() as patch:
        for setting in CACHE:
            patch.setenv(setting.upper(), str(getattr(jax.config, setting)))
        yield


@pytest.fixture
def compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes compile all of their programs, as a user's first run does: for tests of what that takes."""
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")


@pytest.fixture
def plain_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Processes compile without optimisation, as ``plain_programs`` has this one do.

    For tests of what a command does with the results of programs which other tests run as users do.
    """
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
