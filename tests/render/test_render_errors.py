"""Which errors end with one message and which keep their traceback, with and without the packages of the extras."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from jaxdn.commands import doctor
from jaxdn.commands.errors import plain_errors
from jaxdn.render import clip
from jaxdn.runtime.atomic_files import write_atomically
from jaxdn.runtime.optional import OPTIONAL_DEPENDENCIES, install

WITHOUT_RENDERER = """
import importlib.abc, sys
class NoRenderer(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in ("mitsuba", "drjit"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoRenderer())
from jaxdn.commands.errors import plain_errors
from jaxdn.render.mitsuba.errors import RenderError
with plain_errors():
    %s
"""


def run(line):
    return subprocess.run([sys.executable, "-c", WITHOUT_RENDERER % line], capture_output=True, text=True, check=False)


def test_without_the_renderer_a_bug_keeps_its_traceback():
    done = run("raise RuntimeError('a bug')")
    assert done.returncode == 1
    assert done.stderr.rstrip().endswith("RuntimeError: a bug")
    assert "Traceback" in done.stderr
    assert "mitsuba" not in done.stderr
    assert "drjit" not in done.stderr


def test_without_the_renderer_a_failed_rendering_is_one_message():
    done = run("raise RenderError('frame 7: no pose here')")
    assert done.returncode == 2
    assert done.stderr.strip() == "jaxdn: frame 7: no pose here"


def test_without_the_renderer_rendering_says_what_to_install(tmp_path):
    done = run("import jaxdn.render.clip")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("pip install mitsuba")


def test_without_the_renderer_llvm_is_not_blamed(tmp_path):
    done = run(f"from jaxdn.commands.main import main; main(['render', 'edge', '-o', {str(tmp_path / 'out')!r}])")
    assert done.returncode == 2
    assert done.stderr.strip().endswith("pip install mitsuba")
    assert "LLVM" not in done.stdout + done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("extra", "module"),
    [(name, module) for name in OPTIONAL_DEPENDENCIES for module in OPTIONAL_DEPENDENCIES[name].modules],
)
def test_a_missing_package_is_named_with_the_command_that_installs_it(extra, module, capsys):
    with pytest.raises(SystemExit) as ended, plain_errors():
        raise ModuleNotFoundError(f"No module named {module!r}", name=f"{module}.inner")
    assert ended.value.code == 2
    message = " ".join(capsys.readouterr().err.split())
    assert message.endswith(install(extra))
    assert "jaxdn[" not in message  # no package index has jaxdn


@pytest.mark.parametrize("extra", OPTIONAL_DEPENDENCIES)
def test_the_extras_are_those_of_the_project(extra):
    declared = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    needed = declared["optional-dependencies"][extra]
    assert OPTIONAL_DEPENDENCIES[extra].packages == tuple(re.match(r"[\w-]+", requirement)[0] for requirement in needed)


def test_a_renderer_of_ones_own_has_no_version(monkeypatch):
    """Mitsuba is often built, and found by PYTHONPATH, without having been installed."""

    def version(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", version)
    monkeypatch.setattr(doctor, "find_spec", lambda name: name)
    assert doctor._packages("rendering", "render").found == "mitsuba unknown"
    assert clip._list_versions()["drjit"] == "unknown"


@pytest.mark.parametrize("name", ["jaxdn.nowhere", "PIL", None])
def test_a_missing_package_of_no_extra_keeps_its_traceback(name):
    with pytest.raises(ModuleNotFoundError), plain_errors():
        raise ModuleNotFoundError("No module", name=name)


def test_a_failed_rename_names_the_file_that_was_wanted(tmp_path, capsys):
    target = tmp_path / "out.exr"
    target.mkdir()  # which no file replaces
    with pytest.raises(SystemExit) as ended, plain_errors():
        write_atomically({target: "new"})
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"jaxdn: {target}: ")
    assert ".tmp" not in told.replace(str(tmp_path), "")


def test_a_warning_is_one_line_without_a_place_in_the_code():
    done = run("import warnings; warnings.warn('scene a.xml: its film shows a crop.')")
    assert done.returncode == 0
    assert done.stderr == "jaxdn: scene a.xml: its film shows a crop.\n"
