"""The flags with which XLA compiles in tests, and the count of what it compiles."""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from jax._src.interpreters import mlir

from tests.compiling import CONTEXT_USES, FLAGS, compiled, join_flags


@pytest.mark.parametrize(
    ("flags", "joined"),
    [
        ((None, "--a=1 --b=2"), "--a=1 --b=2"),
        (("", "--a=1"), "--a=1"),
        ((" ", "--a=1"), "--a=1"),
        (("--a=1", ""), "--a=1"),
        ((" --a=1 ", "--b=2"), "--a=1 --b=2"),
        ((None, ""), ""),
    ],
)
def test_flags_begin_with_a_flag_or_are_empty(flags, joined):
    assert join_flags(*flags) == joined


@pytest.mark.parametrize("before", [None, "--xla_cpu_enable_fast_math=false"])
def test_this_version_of_xla_knows_the_flags(before):
    """A process of its own: XLA reads its flags once, and ends the process at one that it does not know."""
    program = "import jax; print(jax.jit(lambda x: x + 1)(1.0))"
    environment = os.environ | {"XLA_FLAGS": join_flags(before, FLAGS)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "2.0"), done.stderr


def test_compiled_programs_are_counted():
    """Whatever jax calls the event: at too many programs that are not forgotten the process would crash."""
    image, before = np.ones(5, np.float32), len(compiled)
    program = jax.jit(lambda x: 3 * x + 2)
    np.testing.assert_array_equal(np.asarray(program(image)), 5)
    assert len(compiled) == before + 1
    program(image)
    assert len(compiled) == before + 1
    program.clear_cache()  # its own: what other tests have compiled stays
    program(image)
    assert len(compiled) == before + 2, "forgotten, and compiled anew"


def test_several_programs_are_lowered_in_one_context():
    """Ours before jax 0.12, and jax's own from then on; each thread has its own."""
    contexts = [mlir.make_ir_context() for _ in range(2 * CONTEXT_USES)]
    assert len({id(context) for context in contexts}) in (2, 3)
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(mlir.make_ir_context).result() not in contexts


def test_a_program_is_the_same_wherever_in_a_context_it_is_lowered():
    image = np.ones(5, np.float32)
    texts = {jax.jit(lambda x: 3 * x + 2).lower(image).as_text() for _ in range(2 * CONTEXT_USES)}
    assert len(texts) == 1
