"""Where compiled programs are kept."""

import errno
import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxdn.runtime import program_cache
from jaxdn.runtime.atomic_files import _host
from jaxdn.runtime.program_cache import VARIABLE, cache_folder, keep_programs

_SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture(autouse=True)
def own_settings(monkeypatch):
    """jax's settings as they were, and none of its variables."""
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    before = {name: getattr(jax.config, name) for name in _SETTINGS}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_folder_is_that_of_the_variable(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path / "new"))
    folder = keep_programs()
    assert folder is not None
    assert folder.is_dir()
    assert folder.parent == tmp_path / "new"
    assert jax.config.jax_compilation_cache_dir == str(folder)
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0


def test_another_cpu_has_another_folder(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    here = keep_programs()
    monkeypatch.setattr(program_cache.platform, "machine", lambda: "another")
    assert keep_programs() != here


def test_without_a_folder_nothing_is_kept(tmp_path, monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    monkeypatch.setenv(VARIABLE, "")
    assert keep_programs() is None
    (tmp_path / "file").touch()
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="file: expected a folder that can be written"):
        assert keep_programs() is None
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "of jax"))
    assert keep_programs() is None
    assert jax.config.jax_compilation_cache_dir == before


def test_a_folder_that_cannot_be_written_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    folder = keep_programs()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert keep_programs() == folder
    assert jax.config.jax_persistent_cache_min_compile_time_secs > 1e6


def compile_new(seed):
    """Compile a program that no other test has: each call has a function of its own, so jax has it nowhere else."""
    return jax.jit(lambda x: x * seed + 1)(jnp.ones(3))


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """An own folder that jax has opened."""
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    compilation_cache.reset_cache()
    yield keep_programs()
    compilation_cache.reset_cache()


def test_half_a_program_is_never_kept(kept, monkeypatch):
    """Of a disk that is full while it is written; the next process writes it."""
    write = Path.write_bytes

    def fill(path, content):
        write(path, content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(Path, "write_bytes", fill)
        with pytest.warns(UserWarning, match="No space left on device"):
            compile_new(0.1)
    assert list(kept.iterdir()) == []
    compile_new(0.1)
    names = [path.name for path in kept.iterdir()]
    assert any(name.startswith("jit__lambda") and name.endswith("-cache") for name in names), names


def test_a_program_that_cannot_be_read_is_written_again(kept):
    compile_new(0.2)
    (program,) = kept.glob("jit__lambda*-cache")
    whole = program.read_bytes()
    program.write_bytes(whole[:100])
    with pytest.warns(UserWarning, match="Error reading"):
        compile_new(0.2)
    assert len(program.read_bytes()) > 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        compile_new(0.2)


def test_what_killed_processes_left_is_removed(kept):
    killed = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    left = kept / f".jit_step-0a-cache.{_host()}.{int(killed.stdout)}.1.tmp"
    left.touch()
    keep_programs()
    assert not left.exists()


def test_a_usual_folder_that_cannot_be_made_is_no_matter(tmp_path, monkeypatch):
    """Without a home, as in many containers, nobody has asked for one."""
    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / "file").touch()
    monkeypatch.setattr(program_cache, "cache_folder", lambda: tmp_path / "file")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert keep_programs() is None


def test_without_a_home_nothing_is_made_where_the_command_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for variable in (VARIABLE, "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(program_cache.os.path, "expanduser", lambda path: path)  # as of a user that is not known
    assert keep_programs() is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("system", "variable", "tail"),
    [("linux", "XDG_CACHE_HOME", "jaxdn"), ("win32", "LOCALAPPDATA", "cache"), ("darwin", None, "jaxdn")],
)
def test_the_usual_folder_is_the_systems(tmp_path, monkeypatch, system, variable, tail):
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(program_cache.sys, "platform", system)
    if variable is not None:
        monkeypatch.setenv(variable, str(tmp_path))
        assert tmp_path in cache_folder().parents
    assert cache_folder().name == tail
