"""What a method made of one clip, kept in a file: a run that was cut off goes on where it was."""

import hashlib
import io
from pathlib import Path

import numpy as np

from experiments.measurement import find_revision
from experiments.papers.failures.measure import Failure
from jaxdn.clips import frame_path
from jaxdn.runtime.atomic_files import write_atomically

NEVER = -1


def name_origin(clip: Path, frames: int) -> str | None:
    """What figures depend on, as text: the commit of the code, and the bytes of a clip's frames.

    None if files differ from the commit: nobody knows which figures are theirs.
    """
    revision = find_revision()
    if revision is None or revision.endswith("-dirty"):
        return None
    digest = hashlib.sha256()
    for index in range(frames):
        digest.update(frame_path(clip, index).read_bytes())
    return f"{revision} {digest.hexdigest()}"


def keep_row(path: Path, origin: str | None, failure: Failure, image: np.ndarray) -> None:
    """Write a failure and the image [H, W, 3] that a person looks at; nothing without an origin."""
    if origin is None:
        return
    response = NEVER if failure.response is None else failure.response
    file = io.BytesIO()
    np.savez(file, origin=np.array(origin), psnr=np.array(failure.psnr), response=np.array(response), image=image)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically({path: file.getvalue()})


def find_row(path: Path, origin: str | None) -> tuple[Failure, np.ndarray] | None:
    """What :func:`keep_row` wrote, or None: no file, or one of another origin."""
    if origin is None or not path.is_file():
        return None
    with np.load(path) as kept:
        if str(kept["origin"]) != origin:
            return None
        response = int(kept["response"])
        return Failure(float(kept["psnr"]), None if response == NEVER else response), kept["image"]
