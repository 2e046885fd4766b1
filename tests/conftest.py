"""The settings of every test: strict broadcasting, full float32 precision, fixed seeds, a compilation cache.

Markers: ``slow`` (more than 10 s), ``browser`` (needs Chromium through Playwright).
"""

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from tests.compiling import FLAGS, join_flags

hypothesis.settings.register_profile(
    "jaxdn",
    deadline=None,  # the first example compiles
    derandomize=True,
    max_examples=25,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture, hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("jaxdn")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes more than ten seconds")
    config.addinivalue_line("markers", "browser: needs Chromium through Playwright")

    # [3] against [H, W, 3] has to be written out: silent broadcasting hides a swapped axis.
    jax.config.update("jax_numpy_rank_promotion", "raise")
    # NVIDIA devices compute float32 products as TF32 by default; the references here are float64.
    jax.config.update("jax_default_matmul_precision", "highest")
    # Most of a test's time is compilation, and most of it is the same as in the last run.
    jax.config.update("jax_compilation_cache_dir", str(config.rootpath / ".pytest_cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    _compile_quickly()


def _compile_quickly() -> None:
    """XLA compiles this process's programs without fusion emitters, in less than half of the time.

    Hard cases, in which every method and operation is compared with itself in double precision, ask for them, and real
    processes compile as users do. XLA reads its flags once.
    """
    before = os.environ.get("XLA_FLAGS")
    os.environ["XLA_FLAGS"] = join_flags(before, FLAGS)
    jax.jit(lambda x: x + 1)(1.0)
    if before is None:
        del os.environ["XLA_FLAGS"]
    else:
        os.environ["XLA_FLAGS"] = before


MOST_MAPS = 20_000
"""Pieces of memory that a process may map before its compiled programs are forgotten."""


@pytest.fixture(autouse=True)
def forgotten_programs() -> Iterator[None]:
    """Compiled programs are forgotten after a test, if there are many.

    Each maps some twenty pieces of memory. Those of all tests together are more than Linux allows a process (65,530 by
    default), and the next one that is compiled crashes it.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def rng() -> np.random.Generator:
    """A NumPy generator with the same seed for each test."""
    return np.random.default_rng(20210629)


@pytest.fixture
def key() -> jax.Array:
    """The same JAX key for each test."""
    return jax.random.key(20210629)


@pytest.fixture(scope="module")
def plain_programs() -> Iterator[None]:
    """XLA compiles this module's programs without optimisation: operations the same, in half of the time.

    For modules whose tests run large programs once or twice. What users run is optimised: real processes and all other
    modules compile so.
    """
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def x64() -> Iterator[None]:
    """Double precision for this one test: make every array inside it, not at module level."""
    with jax.enable_x64(True):
        yield
