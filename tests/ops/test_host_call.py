"""Functions of Python in jitted programs, by names: what they get, what they may hold, and that programs are kept."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops.dispatch.host_call import call_host, name_of


def scale_and_sum(results, first, second):
    """Two results of two arrays."""
    results[0][...] = 2 * first
    results[1][...] = second.astype(np.float32).sum()


KINDS = (jax.ShapeDtypeStruct((3, 4), jnp.float32), jax.ShapeDtypeStruct((), jnp.float32))


@jax.jit
def program(first, second):
    doubled, total = call_host(name_of(scale_and_sum), scale_and_sum, KINDS, first, second)
    return doubled + 1, total


@pytest.mark.parametrize("dtype", [bool, jnp.int8, jnp.uint16, jnp.int32, jnp.float16, jnp.bfloat16, jnp.float32])
def test_results_of_all_dtypes(dtype):
    first, second = jnp.arange(12.0).reshape(3, 4), jnp.ones((2, 3), dtype)
    doubled, total = program(first, second)
    np.testing.assert_array_equal(doubled, 2 * first + 1)
    assert float(total) == 6
    assert float(program(first, jnp.ones((0, 3), dtype))[1]) == 0


def test_batches_are_computed_one_after_the_other(rng):
    first, second = rng.standard_normal((5, 3, 4)).astype(np.float32), rng.standard_normal((5, 7)).astype(np.float32)
    doubled, total = jax.vmap(program)(first, second)
    np.testing.assert_array_equal(doubled, 2 * first + 1)
    np.testing.assert_allclose(total, second.sum(axis=1), rtol=1e-6, atol=1e-6)


def test_what_a_program_reads_cannot_be_written():
    def writes(results, array):
        array[...] = 0

    name = "test_what_a_program_reads_cannot_be_written"
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"ValueError: .*read-only"):
        jax.block_until_ready(call_host(name, writes, KINDS[:1], jnp.ones((3, 4))))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("nine lives")])
@pytest.mark.parametrize("named", [True, False])
def test_errors_arrive_with_name_and_message(error, named):
    def fails(results, array):
        raise error

    name = f"fails {error!r}" if named else name_of(fails)
    assert (name is None) != named
    with pytest.raises(jax.errors.JaxRuntimeError) as raised:
        jax.block_until_ready(call_host(name, fails, KINDS[:1], jnp.ones((3, 4))))
    assert str(raised.value).rstrip().endswith(f"{type(error).__name__}: {error}".rstrip())


def test_a_message_that_is_no_text_arrives_too():
    """As of a file whose name is not UTF-8."""

    def fails(results, array):
        raise ValueError("no frame \udcff.exr")

    with pytest.raises(jax.errors.JaxRuntimeError, match=r"ValueError: no frame .*udcff.exr"):
        jax.block_until_ready(call_host("a message", fails, KINDS[:1], jnp.ones((3, 4))))


def test_names_tell_functions_and_constants_apart():
    large = np.zeros(5000, np.float32)
    other = large.copy()
    other[2500] = 1
    given = [
        (),
        (1,),
        (1.0,),
        (np.float32(1),),
        (True,),
        ("1",),
        ((1, 2),),
        (1, 2),
        (large,),
        (other,),
        (other[:, None],),
    ]
    names = [name_of(scale_and_sum, *constants) for constants in given]
    assert len({*names, name_of(name_of)}) == len(given) + 1
    assert None not in names


_PROCESS = """
import logging, sys
import jax
logging.basicConfig(stream=sys.stdout, level=logging.DEBUG)
from jaxdn.runtime.program_cache import keep_programs
print(keep_programs())
import jax.numpy as jnp, numpy as np
from jaxdn.ops.scales import fill_holes
image, known = np.ones((32, 32, 3), np.float32), np.ones((32, 32, 1), bool)
known[8:20, 8:20] = False
jax.config.update("jax_debug_log_modules", "jax._src.compiler,jax._src.compilation_cache")
jaxpr = str(jax.make_jaxpr(fill_holes)(image, known))
assert "ffi_call" in jaxpr, jaxpr
print("sum", float(np.abs(jax.jit(fill_holes)(image, known)).sum()))
"""


def _run(folder):
    usual = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environment = {**usual, "JAXDN_CACHE_DIR": str(folder)}
    done = subprocess.run(
        [sys.executable, "-c", _PROCESS], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_program_with_loops_is_compiled_once_for_all_processes(tmp_path):
    first, second = _run(tmp_path), _run(tmp_path)
    assert "cache hit for 'jit_fill_holes'" not in first
    assert "cache hit for 'jit_fill_holes'" in second
    told = [[line for line in text.splitlines() if line.startswith("sum ")] for text in (first, second)]
    assert told[0] == told[1] != []


_ENDS = """
import sys, time
import jax, jax.numpy as jnp
from jaxdn.ops.dispatch.host_call import call_host

def wait(results, array):
    time.sleep(0.1)
    results[0][...] = array

@jax.jit
def program(x):
    for _ in range(3):
        (x,) = call_host("wait", wait, [jax.ShapeDtypeStruct(x.shape, x.dtype)], x @ x / len(x))
    return x

def main(way):
    images = [program(x) for _ in range(3)]
    if way == "raise":
        raise ValueError("in the middle")
    return images if way == "keep" else None

x = jnp.ones((300, 300))
program(x).block_until_ready()
kept = main(sys.argv[1])
"""


@pytest.mark.parametrize(
    ("way", "code"),
    [("raise", 1), pytest.param("keep", 0, marks=pytest.mark.slow), pytest.param("drop", 0, marks=pytest.mark.slow)],
)
def test_a_process_ends_while_programs_run_that_nobody_waits_for(way, code):
    done = subprocess.run([sys.executable, "-c", _ENDS, way], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == code, done.stderr
    assert ("ValueError: in the middle" in done.stderr) == (way == "raise")


def test_threads_of_programs_are_known_between_calls():
    """Python makes and unmakes its record of a thread that it does not know at every call: half of a short call."""
    here, visits = threading.local(), []

    def visit(results, array):
        visits.append((threading.get_ident(), hasattr(here, "known")))
        here.known = True
        results[0][...] = array

    @jax.jit
    def busy(array):
        for _ in range(4):
            (array,) = call_host("test_threads_of_programs", visit, KINDS[:1], array)
            product = jnp.ones((300, 300)) * array.sum()
            for _ in range(4):
                product = product @ product / 300
            array = array + product[:3, :4]
        return array

    for _ in range(6):
        jax.block_until_ready(busy(jnp.ones((3, 4))))
    threads = {thread for thread, _ in visits}
    assert len(visits) == 24
    assert threads != {threading.get_ident()}, "all calls came from this thread: nothing is tested"
    assert sum(not known for _, known in visits) == len(threads)
