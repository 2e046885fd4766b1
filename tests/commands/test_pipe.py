"""Where the reader of its output has gone, a command ends without a word: real processes, and a pipe nobody reads."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="exit codes of signals are those of Unix")


def without_reader(*command, stderr=subprocess.PIPE, **environment):
    """The exit code and what is said on stderr; nobody reads stdout from the start, so that no race decides."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(
            [sys.executable, *command],
            stdout=writer,
            stderr=stderr,
            text=True,
            env=os.environ | environment,
            timeout=300,
        )
    finally:
        os.close(writer)
    return done.returncode, done.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_what_is_printed_at_the_end(unbuffered):
    assert without_reader("-m", "jaxdn.commands.main", "--version", PYTHONUNBUFFERED=unbuffered) == (141, "")


def test_help():
    assert without_reader("-m", "jaxdn.commands.main", "denoise", "--help") == (141, "")


@pytest.mark.slow
def test_a_table_that_rich_prints():
    assert without_reader("-m", "jaxdn.commands.main", "doctor") == (141, "")


def test_an_error_of_the_user_keeps_its_exit_code():
    code, said = without_reader("-m", "jaxdn.commands.main", "inspect", "/nowhere")
    assert code == 2
    assert "/nowhere" in said
    assert "Traceback" not in said


@pytest.mark.slow
def test_messages_without_a_reader_too():
    assert without_reader("-m", "jaxdn.commands.main", "inspect", "/nowhere", stderr=subprocess.STDOUT) == (141, None)


def test_more_than_a_buffer_while_it_works():
    work = """
from jaxdn.commands.errors import plain_errors
from jaxdn.commands.errors import end_with_reader
with end_with_reader(), plain_errors():
    for line in range(100_000):
        print(line)
"""
    assert without_reader("-c", work) == (141, "")


def test_a_pipe_to_another_process_is_an_error():
    work = """
import os
from jaxdn.commands.errors import plain_errors
from jaxdn.commands.errors import end_with_reader
reader, writer = os.pipe()
os.close(reader)
with end_with_reader(), plain_errors():
    os.write(writer, b"for a process that has ended")
"""
    done = subprocess.run([sys.executable, "-c", work], capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stderr) == (2, "jaxdn: Broken pipe\n")


@pytest.mark.parametrize("end", ["denoise --help | head -n 1", "--version >&-"])
def test_shells_see_nothing(end):
    command = f"{sys.executable} -m jaxdn.commands.main {end}"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
