"""What docstrings and pages refer to is there: names of roles (``:func:`jaxdn.warp```), modules of commands."""

import ast
import functools
import re
from pathlib import Path

import pytest

import jaxdn

ROOT = Path(__file__).parents[2]
CODE = [path for folder in ("jaxdn", "experiments", "tests") for path in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "Makefile"]
PAGES += [page for page in sorted((ROOT / "docs").rglob("*.md")) if page.parent.name != "results"]
# A result keeps the command of its revision.


def pytest_id(path: Path) -> str:
    return str(path.relative_to(ROOT))


@functools.cache
def _declared(path: Path) -> dict[str, ast.AST]:
    """The names of a module, of its classes and of what its instances hold."""
    found: dict[str, ast.AST] = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            found[node.id if isinstance(node, ast.Name) else node.attr] = node
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {name.asname or name.name: node for name in node.names}
    return found


def _is_there(name: str) -> bool:
    """Whether there is such a module, or such a name in one."""
    parts = name.split(".")
    if name.startswith("jaxdn.") and parts[1] in jaxdn.__all__:
        return True
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if file.is_file():
            return all(part in _declared(file) for part in parts[count:])
    return False


@pytest.mark.parametrize("path", CODE, ids=pytest_id)
def test_names_of_roles_exist(path):
    own = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    names = re.findall(r":(?:mod|func|class|data|meth|attr):`~?([\w.]+)`", path.read_text())
    whole = [f"{own.rpartition('.')[0]}{name}" if name.startswith(".") else name for name in names]
    packages = ("jaxdn.", "experiments.", "tests.")
    missing = [name for name in whole if not _is_there(name if name.startswith(packages) else f"{own}.{name}")]
    assert missing == []


@pytest.mark.parametrize("path", CODE + PAGES, ids=pytest_id)
def test_modules_of_commands_exist(path):
    modules = re.findall(r"python -m ((?:jaxdn|experiments|tests)(?:\.[a-z]\w*)*)", path.read_text())
    missing = [name for name in modules if not _is_there(name) and not (ROOT / name.replace(".", "/")).is_dir()]
    assert missing == []


def test_references_that_lead_nowhere_are_found():
    assert _is_there("jaxdn.ops.warp.warp")
    assert _is_there("jaxdn.denoiser.statistics.FrameStatistics.mean_depth")
    assert not _is_there("jaxdn.ops.warp.wrap")
    assert not _is_there("experiments.papers.nothing")
