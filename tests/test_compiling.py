"""The flags with which XLA compiles in tests."""

import os
import subprocess
import sys

import pytest

from tests.compiling import FLAGS, join_flags


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


@pytest.mark.parametrize("before", [None, "", "--xla_cpu_enable_fast_math=false"])
def test_this_version_of_xla_knows_the_flags(before):
    """A process of its own: XLA reads its flags once, and ends the process at one that it does not know."""
    program = "import jax; print(jax.jit(lambda x: x + 1)(1.0))"
    environment = os.environ | {"XLA_FLAGS": join_flags(before, FLAGS)}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "2.0"), done.stderr
