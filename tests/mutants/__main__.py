"""Make every mutant in a copy of the tree and run the tests that have to fail with it: ``make mutants``.

python -m tests.mutants                  # all of them; an hour on two cores
python -m tests.mutants reblur trmv      # those with one of these words in their names
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from jaxdn.commands.errors import plain_errors
from tests.mutants.filters import FILTERS
from tests.mutants.learned import LEARNED
from tests.mutants.mutant import ROOT, Mutant

MUTANTS: tuple[Mutant, ...] = (*FILTERS, *LEARNED)
_COPIED = ("jaxdn", "tests", "experiments", "docs")
_PASSED, _FAILED = 0, 1
"""Exit codes of pytest."""


@dataclass
class Settings:
    """Make every mutant and run the tests that have to fail; the exit code is 1 if one survives."""

    names: Annotated[list[str], tyro.conf.Positional] = field(default_factory=list)
    """Words in the names of mutants; default: all."""


def main(settings: Settings) -> int:
    """The table of the mutants, on standard output."""
    chosen = [one for one in MUTANTS if not settings.names or any(word in one.name for word in settings.names)]
    if not chosen:
        raise ValueError(f"names: expected words of a mutant's name, got {' '.join(settings.names)}.")
    with tempfile.TemporaryDirectory(prefix="jaxdn-mutants-") as folder:
        tree = _copy(Path(folder))
        tests = sorted({test for one in chosen for test in one.tests})
        print(f"{len(tests)} tests on the code as it is ...", file=sys.stderr, flush=True)
        code, said = _run(tree, tests)
        if code != _PASSED:
            raise ValueError(f"tests: expected all to pass on the code as it is, got:\n{said}")
        print("| mutant | result | tests | s |\n|---|---|---|---|", flush=True)
        results = [_judge(tree, one) for one in chosen]
    print(f"\n{results.count('killed')} of {len(results)} mutants were killed.", flush=True)
    return int("SURVIVED" in results)


def _judge(tree: Path, one: Mutant) -> str:
    """Run a mutant's tests and print its row: killed or SURVIVED."""
    files = {edit.file: (tree / edit.file).read_text(encoding="utf-8") for edit in one.edits}
    begun = time.monotonic()
    try:
        for edit in one.edits:
            (tree / edit.file).write_text(edit.applied(tree), encoding="utf-8")
        code, said = _run(tree, one.tests)
    finally:
        for file, text in files.items():
            (tree / file).write_text(text, encoding="utf-8")
    if code not in (_PASSED, _FAILED):
        raise ValueError(f"{one.name}: expected tests that run, got exit code {code}:\n{said}")
    result = "killed" if code == _FAILED else "SURVIVED"
    names = ", ".join(test.partition("::")[2] for test in one.tests)
    print(f"| {one.name} | {result} | {names} | {time.monotonic() - begun:.0f} |", flush=True)
    return result


def _copy(folder: Path) -> Path:
    for name in _COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def _run(tree: Path, tests: Sequence[str]) -> tuple[int, str]:
    """pytest's exit code and the end of what it said. Compiled modules are not kept: a mutant may be as long."""
    command = [sys.executable, "-B", "-m", "pytest", "-q", "-x", "--no-header", *tests]
    environment: dict[str, Any] = {**os.environ, "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, (done.stdout + done.stderr)[-3000:]


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Settings, description=__doc__)))
