"""Loops that processes of their own compile: real processes, an empty folder of compiled loops each time."""

import errno
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from jaxdn.ops.dispatch.loop_compilers import compile_apart, loops_compiled_apart
from jaxdn.runtime.program_cache import VARIABLE

_PROGRAM = """
import sys
import jax
import numpy as np
from jaxdn.ops.dispatch.loop_compilers import loops_compiled_apart
from jaxdn.ops.medians import median
from jaxdn.ops.numba_medians import find_median

kill = "kill" in sys.argv
values = np.random.default_rng(0).uniform(0, 9, (17, 23)).astype(np.float32)
with loops_compiled_apart() as started:
    program = jax.jit(lambda values: median(values, implementation="numba"))
    lowered = program.lower(values)  # tells the loop
    if kill:
        started.compilers[0].process.kill()
    found = lowered.compile()(values)
np.testing.assert_array_equal(found, np.median(values))
ended = all(compiler.process.poll() is not None for compiler in started.compilers)
hits, misses = (sum(counts.values()) for counts in (find_median.stats.cache_hits, find_median.stats.cache_misses))
print(len(started.compilers), ended, hits, misses)
"""


def run(folder, *arguments):
    """(processes, whether all have ended, loops read from files, loops compiled in the process itself)."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *arguments],
        env=os.environ | {VARIABLE: str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.slow
def test_a_loop_is_compiled_once_and_by_another_process(tmp_path):
    assert run(tmp_path) == ["1", "True", "1", "0"]
    # Its file is there now: nothing is told to anybody.
    assert run(tmp_path) == ["0", "True", "1", "0"]


@pytest.mark.slow
def test_a_killed_process_costs_time_alone(tmp_path):
    assert run(tmp_path, "kill") == ["1", "True", "0", "1"]


def test_what_cannot_be_compiled_is_no_wait_for_ever():
    with loops_compiled_apart() as compilers:
        wrong = compilers.compile(("jaxdn.ops.numba_medians", "no_such_loop"), ())
        assert wrong.result(timeout=60) is None
        assert compilers.compile(("jaxdn.ops.numba_medians", "no_such_loop"), ()) is wrong
        (compiler,) = compilers.compilers
        compiler.process.kill()
        compiler.reader.join(60)
        # Of a process that has ended nothing is expected.
        assert compilers.compile(("jaxdn.ops.numba_medians", "another"), ()).result(timeout=60) is None


def test_what_a_loop_prints_is_no_reply(monkeypatch):
    """Numba prints what it reads and writes, if it is asked to."""
    monkeypatch.setenv("NUMBA_DEBUG_CACHE", "1")
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    with loops_compiled_apart() as compilers:
        for number in range(2):
            compilers.compile(("tests.ops.printing_loop", "prints"), (number,)).result(timeout=60)
        (compiler,) = compilers.compilers
        assert compiler.reader.is_alive()


def test_where_no_process_can_be_started_loops_are_compiled_where_they_are_called(monkeypatch):
    def refuse(*_, **__):
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    with loops_compiled_apart() as compilers:
        assert compilers.compile(("module", "loop"), (1,)).result(timeout=1) is None
    assert not compilers.compilers


def test_a_loop_goes_to_the_process_that_has_its_files():
    with loops_compiled_apart() as compilers:
        compilers.most = 2
        loops = [("module", "first"), ("module", "second"), ("module", "third")]
        for loop in loops:
            compilers.compile(loop, (1,))
        places = [compilers.places[loop] for loop in loops]
        for loop in loops:
            compilers.compile(loop, (2,))
        assert [compilers.places[loop] for loop in loops] == places
        assert [compiler.given for compiler in compilers.compilers] == [4, 2]


def test_without_being_asked_no_process_is_started():
    from jaxdn.ops.numba_medians import find_median

    with loops_compiled_apart() as compilers, loops_compiled_apart() as inner:
        assert inner is compilers
        assert not compilers.compilers
    assert compile_apart(find_median, ()) is None


def test_nothing_is_imported_from_the_folder_where_a_command_runs(tmp_path, monkeypatch):
    (tmp_path / "pickle.py").write_text("import pathlib\npathlib.Path('imported').touch()\n")
    monkeypatch.chdir(tmp_path)
    with loops_compiled_apart() as compilers:
        compilers.compile(("jaxdn.ops.numba_medians", "no_such_loop"), ()).result(timeout=60)
    assert not (tmp_path / "imported").exists()


def test_threads_that_tell_loops_at_once_start_no_process_too_many():
    with loops_compiled_apart() as compilers, ThreadPoolExecutor(8) as threads:
        compilers.most = 1
        loops = [("jaxdn.ops.numba_medians", f"no_such_loop_{number}") for number in range(200)]
        for done in list(threads.map(lambda loop: compilers.compile(loop, ()), loops)):
            done.result(timeout=60)
        (compiler,) = compilers.compilers
        assert compiler.given == len(loops)
        assert compiler.process.poll() is None  # it has read every loop whole
