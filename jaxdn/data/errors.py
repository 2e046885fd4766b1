"""The error of everything about clips, and JSON files read with it."""

import json
from pathlib import Path
from typing import Any


class ClipError(ValueError):
    """A clip, frame or record that cannot be used; the message names the file, the reason and what to do."""


class DamagedFile(ClipError):
    """A file that is missing, incomplete, damaged, or no OpenEXR file: of a sequence, a missing frame."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path}: {reason}.")
        self.path, self.reason = path, reason


def read_json(path: str | Path, advice: str = "restore it or render the clip again") -> Any:
    """Read strict JSON. Raises ClipError, with the file, the place and ``advice``, if it is missing or broken."""
    path = Path(path)

    def refuse(word: str) -> None:
        raise ValueError(f"{word} is not a JSON number")

    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    except FileNotFoundError as error:
        raise ClipError(f"{path}: there is no such file.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise ClipError(f"{path}: not readable as JSON ({error}); {advice}.") from error
