"""Ctrl-C arrives where Python would drop it, and where XLA makes another error of it."""

import gc
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.interrupt import Interrupt


@pytest.fixture
def ctrl_c():
    """Python's own handler: a shell lets processes in its background ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield lambda: signal.raise_signal(signal.SIGINT)
    signal.signal(signal.SIGINT, before)


def during(work):
    """The exit code of a command that does this and then waits, which is what Ctrl-C has to end."""
    with pytest.raises(SystemExit) as ended:
        _command(work)
    return ended.value.code


def _command(work):
    with plain_errors():
        work()
        _wait()


def _wait():
    until = time.monotonic() + 20
    while time.monotonic() < until:
        time.sleep(0.01)


def test_in_a_callback_of_the_garbage_collector(ctrl_c, capsys):
    def interrupted(phase, info):
        gc.callbacks.remove(interrupted)
        ctrl_c()

    gc.callbacks.append(interrupted)
    assert during(gc.collect) == 130
    assert capsys.readouterr().err == "jaxdn: interrupted; what is finished is kept.\n"


def test_where_an_object_dies_twice(ctrl_c):
    class Dying:
        def __del__(self):
            ctrl_c()

    assert during(lambda: (Dying(), Dying())) == 130


def test_what_is_dropped_twice_arrives_once(ctrl_c):
    """The second one would arrive where the command has ended, and print a traceback."""

    class Dying:
        def __del__(self):
            ctrl_c()

    assert during(lambda: (Dying() is None, time.sleep(0.02), Dying() is None)) == 130
    try:
        time.sleep(0.3)
    except KeyboardInterrupt:
        pytest.fail("it arrived twice")


def test_in_a_callback_of_a_program(ctrl_c, capsys):
    def work(context, result, given):
        ctrl_c()

    @jax.jit
    def program(given):
        return buffer_callback(work, jax.ShapeDtypeStruct((3,), jnp.float32))(given)

    assert during(lambda: np.asarray(program(jnp.ones(3)))) == 130
    assert capsys.readouterr().err == "jaxdn: interrupted; what is finished is kept.\n"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_other_errors_stay_what_they_are():
    class Dying:
        def __del__(self):
            raise ValueError("dropped as Python does")

    with plain_errors():
        Dying()
    with pytest.raises(RuntimeError, match="a bug"), plain_errors():
        raise RuntimeError("a bug")


_COMPILING = """
import sys, threading, time
import jax, jax.numpy as jnp
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.interrupt import exit_on_interrupt

def long(x):
    for i in range(400):
        x = jnp.sort(jnp.sin(x) @ x.T + i, axis=0)
    return x

given = jnp.ones((8, 8))
with exit_on_interrupt(), plain_errors():
    lowered = jax.jit(long).lower(given)
    threading.Thread(target=lowered.compile, daemon=True).start()
    time.sleep(0.5)
    raise KeyboardInterrupt
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="exit codes of signals are those of Unix")
def test_a_process_ends_while_a_program_is_compiled():
    for _ in range(3):
        done = subprocess.run([sys.executable, "-c", _COMPILING], capture_output=True, text=True, check=False)
        assert done.returncode == 130, done.stderr
        assert done.stderr.endswith("jaxdn: interrupted; what is finished is kept.\n")


def _be_told(stop, *numbers):
    with plain_errors(), stop:
        stop.raise_if_asked()
        for number in numbers:
            signal.raise_signal(number)
        stop.raise_if_asked()


def test_sigterm_is_a_first_ctrl_c_however_often_it_comes():
    said = []
    with pytest.raises(SystemExit) as ended:
        _be_told(Interrupt(lambda: said.append("stopping")), signal.SIGTERM, signal.SIGTERM)
    assert ended.value.code == 143
    assert said == ["stopping"]
    with pytest.raises(SystemExit) as ended:  # somebody does not want to wait
        _be_told(Interrupt(lambda: None), signal.SIGTERM, signal.SIGINT)
    assert ended.value.code == 130
