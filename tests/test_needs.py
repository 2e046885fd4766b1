"""No test is skipped in silence: in CI what can be installed there has to be there."""

import ast
from pathlib import Path

import pytest

from tests import needs
from tests.needs import NEEDS, Need, require, require_module

HERE = Path(__file__).parent


@pytest.fixture
def absent(monkeypatch):
    """Something that is missing, which CI can install, and something that it cannot."""
    monkeypatch.setitem(NEEDS, "a tool", Need(lambda: False, "apt-get install a-tool"))
    monkeypatch.setitem(NEEDS, "a machine", Need(lambda: False, "buy one", not_in_ci="it is lent none"))


def test_locally_a_test_without_its_tool_is_skipped_with_advice(absent, monkeypatch):
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="no a tool: apt-get install a-tool"):
        require("a tool")


def test_in_ci_it_fails_unless_ci_cannot_have_it(absent, monkeypatch):
    monkeypatch.setenv("CI", "true")
    monkeypatch.delenv("JAXDN_TESTS_WITHOUT", raising=False)
    with pytest.raises(pytest.fail.Exception, match="no a tool, which it can install: apt-get install a-tool"):
        require("a tool")
    with pytest.raises(pytest.skip.Exception, match="no a machine"):
        require("a machine")
    monkeypatch.setenv("JAXDN_TESTS_WITHOUT", "llvm, a tool")
    with pytest.raises(pytest.skip.Exception, match="no a tool"):
        require("a tool")


def test_what_is_there_is_imported():
    assert require_module("numpy.linalg") is __import__("numpy").linalg
    with pytest.raises(KeyError, match="no such"):
        require("no such")


def _skips(path: Path) -> list[str]:
    """Calls that skip tests by themselves; those of other operating systems may."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    named = [(getattr(call.func, "attr", ""), call) for call in calls]
    return [
        f"{path.relative_to(HERE)}:{call.lineno}"
        for name, call in named
        if name in ("skip", "importorskip", "skipif") and "sys.platform" not in ast.unparse(call)
    ]


def test_only_the_table_skips_tests():
    found = [line for path in sorted(HERE.rglob("*.py")) if path != Path(needs.__file__) for line in _skips(path)]
    assert not found, "call tests.needs.require instead, or mark with pytest.mark.needs"
