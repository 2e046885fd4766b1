"""Command lines of jaxdn and of its installation, and what the lines that they print mean."""

import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path

_PROGRESS = re.compile(r"^\s*Progress:\s*([0-9]+(?:\.[0-9]+)?)\s*%")
_FRAME = re.compile(r"^frame ([0-9]+) of ([0-9]+): ")
_NOT_INSTALLED = re.compile(r"No module named '?([A-Za-z_]\w*)")


def denoise_command(
    python: str,
    pattern: Path,
    out: Path,
    frames: Collection[int],
    *,
    method: str = "auto",
    safe: bool = True,
    bidirectional: bool = False,
    layer: str | None = None,
) -> list[str]:
    """``jaxdn denoise`` for the files of a scene.

    Args:
      python: the interpreter that has jaxdn.
      pattern: of the rendered files.
      out: folder for the results.
      frames: numbers of the frames to denoise.
      method: as ``--method`` takes it.
      safe: whether what is no noise is kept (``--no-safe`` otherwise).
      bidirectional: whether a backward pass is added.
      layer: the view layer to read, of several.
    """
    words = [python, "-u", "-m", "jaxdn.commands.main", "denoise", str(pattern), "-o", str(out)]
    words += ["--method", method or "auto"]
    words += [] if safe else ["--no-safe"]
    words += ["--bidirectional"] if bidirectional else []
    words += ["--layer", layer] if layer else []
    if min(frames) < 0:  # a word that begins with a minus would be taken for an option
        return words
    return [*words, "--frames", *_ranges(sorted(frames))]


def _ranges(numbers: Sequence[int]) -> list[str]:
    """``["1-4", "7"]``."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1][1:] = [number]
        else:
            parts.append([number])
    return ["-".join(map(str, part)) for part in parts]


def python_of(environment: Path) -> Path:
    """The interpreter of a virtual environment."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def install_commands(python: str, environment: Path, package: str) -> list[list[str]]:
    """Make a virtual environment and install jaxdn into it.

    Blender's own packages stay as they are: it pins NumPy 1, and jaxdn needs NumPy 2.

    Args:
      python: an interpreter, Blender's own.
      environment: folder of the environment.
      package: what pip installs: the folder of jaxdn, or a wheel.
    """
    wanted = package if package.endswith("]") else f"{package}[oidn]"
    pip = [str(python_of(environment)), "-m", "pip", "install", "--disable-pip-version-check", wanted]
    return [[python, "-m", "venv", str(environment)], pip]


def read_progress(line: str) -> float | None:
    """The share that is done, 0 to 1, if the line tells: ``Progress: 40%`` or ``frame 4 of 10: ...``."""
    if found := _PROGRESS.match(line):
        return min(float(found[1]) / 100, 1.0)
    if found := _FRAME.match(line):
        return min(int(found[1]) / max(int(found[2]), 1), 1.0)
    return None


def explain_failure(code: int, lines: Sequence[str]) -> str:
    """Why a command failed, in one sentence: jaxdn's own message, or the last line that it printed."""
    text = [line.strip() for line in lines if line.strip()]
    for found in map(_NOT_INSTALLED.search, text):
        if found:
            lacks = "jaxdn" if found[1] == "jaxdn" else f"{found[1]}, which jaxdn needs"
            return f"This Python has no {lacks}. Name another in the add-on's preferences, or press Install there."
    own = [index for index, line in enumerate(text) if line.startswith("jaxdn: ")]
    if own:
        return " ".join(text[own[-1] :]).removeprefix("jaxdn: ")
    last = text[-1] if text else "It printed nothing."
    return f"{last} (exit code {code})"
