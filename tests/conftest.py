"""The settings of every test: strict broadcasting, full float32 precision, fixed seeds, a compilation cache.

Markers: ``slow`` (more than a second of processor time), ``browser`` (opens a page in one), ``needs("llvm")``
(:mod:`tests.needs`).
"""

import gc
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import jax
import numpy as np
import pytest

from tests.compiling import FLAGS, compiled, count_programs, join_flags, share_contexts
from tests.needs import NEEDS, WITH_BPY, require

hypothesis.settings.register_profile(
    "jaxdn",
    deadline=None,  # the first example compiles
    derandomize=True,
    max_examples=25,
    suppress_health_check=[hypothesis.HealthCheck.function_scoped_fixture, hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("jaxdn")


def pytest_configure(config: pytest.Config) -> None:
    # [3] against [H, W, 3] has to be written out: silent broadcasting hides a swapped axis.
    jax.config.update("jax_numpy_rank_promotion", "raise")
    # NVIDIA devices compute float32 products as TF32 by default; the references here are float64.
    jax.config.update("jax_default_matmul_precision", "highest")
    # Most of a test's time is compilation, and most of it is the same as in the last run.
    jax.config.update("jax_compilation_cache_dir", str(config.rootpath / ".pytest_cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    # A program of a test runs once or twice: compiled without optimisation it has the same operations, and takes a
    # third of the time. What users run is optimised: real processes compile so, and modules with optimised_programs.
    jax.config.update("jax_disable_most_optimizations", True)
    # Tracing makes millions of small objects, few of them in cycles. To look for cycles as often as usual takes a
    # seventh of the time of tracing and lowering.
    gc.set_threshold(200_000, 20, 100)
    count_programs()
    share_contexts()
    _compile_quickly()


def pytest_collection_finish() -> None:
    """From now on the modules and tests, which live until the end, are not searched for cycles."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def small_tiles() -> int:
    """Images of tests are small: compiled loops fill them in several tiles nevertheless, so that borders are tested."""
    from jaxdn.ops.dispatch import numba_call

    usual, numba_call.TILE = numba_call.TILE, 1
    return usual


@pytest.fixture(scope="module")
def usual_tiles(small_tiles: int) -> Iterator[None]:
    """This module's images are one tile, as users' are of such a size: thousands of them take half of the time."""
    from jaxdn.ops.dispatch import numba_call

    numba_call.TILE = small_tiles
    yield
    numba_call.TILE = 1


def pytest_runtest_setup(item: pytest.Item) -> None:
    for mark in item.iter_markers("needs"):
        require(*mark.args)


@pytest.fixture(scope="session")
def blender() -> Path:
    """An interpreter that has ``bpy``, in an environment of its own, which is made if it is not there."""
    if not NEEDS["bpy"].present():
        root = Path(__file__).parents[1]
        subprocess.run(["make", ".venv-cycles/ready"], cwd=root, capture_output=True, check=False)
    require("bpy")
    return WITH_BPY


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
LOOK_EVERY = 200
"""Programs from one look at the pieces to the next: at 20,000 a look takes 20 ms, longer than most tests."""


@pytest.fixture(autouse=True)
def forgotten_programs() -> Iterator[None]:
    """Compiled programs are forgotten after a test, if there are many.

    Each maps some twenty pieces of memory. Those of all tests together are more than Linux allows a process (65,530 by
    default), and the next one that is compiled crashes it.
    """
    yield
    if len(compiled) < LOOK_EVERY:
        return
    compiled.clear()
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
def optimised_programs() -> Iterator[None]:
    """XLA optimises this module's programs: for those that run long enough to be worth it."""
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture
def x64() -> Iterator[None]:
    """Double precision for this one test: make every array inside it, not at module level."""
    with jax.enable_x64(True):
        yield


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
    """Processes compile without optimisation and fusion emitters, as this one does.

    For tests of what a command does with the results of programs which other tests run as users do.
    """
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    monkeypatch.setenv("XLA_FLAGS", join_flags(os.environ.get("XLA_FLAGS"), FLAGS))
