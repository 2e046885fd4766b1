"""How many samples of a clip's frames were not finite, noted beside each such frame until the clip is finished.

A file for each frame, since several processes may render frames of one clip. Few clips have any.
"""

import json
from pathlib import Path

from jaxdn.data.clip.folder import frame_path
from jaxdn.runtime.atomic_files import write_json

_END = ".bad_samples.json"


def note_bad_samples(folder: Path, frame: int, count: int) -> None:
    """Note the number of a frame; again for a frame that is rendered again."""
    write_json(frame_path(folder, frame).with_suffix(_END), count)


def count_noted(folder: Path) -> int:
    """The sum over all frames that have a note."""
    total = 0
    for path in folder.glob(f"frame_*{_END}"):
        try:
            total += int(json.loads(path.read_text()))
        except FileNotFoundError:  # another process has finished the clip at this moment
            continue
    return total


def remove_notes(folder: Path) -> None:
    """Remove the notes of a finished clip, whose record has their sum."""
    for path in folder.glob(f"frame_*{_END}"):
        path.unlink(missing_ok=True)
