"""Which errors end with one message and which keep their traceback, with and without the packages of the extras."""

import importlib.metadata
import subprocess
import sys

import pytest

from jaxdn.commands.errors import EXTRAS, plain_errors

WITHOUT_RENDERER = """
import importlib.abc, sys
class NoRenderer(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in ("mitsuba", "drjit"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NoRenderer())
from jaxdn.commands.errors import plain_errors
from jaxdn.render.errors import RenderError
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
    assert done.stderr.strip().endswith("pip install 'jaxdn[render]'.")


@pytest.mark.parametrize(("extra", "package"), [(extra, name) for extra, names in EXTRAS.items() for name in names])
def test_a_missing_package_is_in_the_extra_that_is_named(extra, package, capsys):
    with pytest.raises(SystemExit) as ended, plain_errors():
        raise ModuleNotFoundError(f"No module named {package!r}", name=f"{package}.inner")
    assert ended.value.code == 2
    assert f"pip install 'jaxdn[{extra}]'" in capsys.readouterr().err
    assert extra in importlib.metadata.metadata("jaxdn").get_all("Provides-Extra")


@pytest.mark.parametrize("name", ["jaxdn.nowhere", "PIL", None])
def test_a_missing_package_of_no_extra_keeps_its_traceback(name):
    with pytest.raises(ModuleNotFoundError), plain_errors():
        raise ModuleNotFoundError("No module", name=name)
