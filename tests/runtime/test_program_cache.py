"""Where compiled programs are kept."""

import os

import jax
import pytest

from jaxdn.runtime import program_cache
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
