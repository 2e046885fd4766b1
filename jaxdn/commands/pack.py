"""``jaxdn pack``: a training set in one compact file, or exact and in shards, to train on other machines."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from jaxdn.data.clip.folder import is_clip
from jaxdn.data.errors import ClipError
from jaxdn.data.training.open_clips import open_clips
from jaxdn.data.training.pack import write_pack
from jaxdn.data.training.shards import write_shards
from jaxdn.data.training.windows import Packed, Packing


def pack(
    places: Sequence[Path],
    out: Path,
    packing: Packing,
    *,
    mib: float,
    format: Literal["file", "arrayrecord"] = "file",
    progress: Callable[[int, int], None] = lambda windows, size: None,
) -> Packed:
    """Pack random windows of clips into ``out``, of at most ``mib`` MiB, in a folder that is made if missing.

    ``out`` is one compact file, or with ``arrayrecord`` a folder of shards. ``places`` are as for
    :func:`jaxdn.clips.training_batches`. Raises as :func:`jaxdn.data.training.pack.write_pack` and
    :func:`jaxdn.data.training.shards.write_shards` do, and ValueError for a size that is not positive and for an
    ``out`` that is a place of clips, lies in one, or is a folder where a file is to be written.
    """
    if not 0 < mib < 2**30:
        raise ValueError(f"--mib: expected more than 0 MiB and less than 2^30, got {mib:g}.")
    _check_out(out, places, format)
    clips = [clip for place in places for clip in open_clips(place)]
    if not clips:
        raise ClipError("clips: expected at least one folder, got none.")
    out.parent.mkdir(parents=True, exist_ok=True)
    write = write_pack if format == "file" else write_shards
    return write(out, clips, size=int(mib * 2**20), packing=packing, progress=progress)


def _check_out(out: Path, places: Sequence[Path], format: str) -> None:
    """Raise ValueError where clips would be overwritten, or a folder is in the place of a file."""
    if out.resolve() in {place.resolve() for place in places} or is_clip(out.parent) or is_clip(out):
        raise ValueError(f"-o {out}: expected another place than the clips', which would be overwritten; name another.")
    if format == "file" and out.is_dir():
        raise ValueError(
            f"-o {out}: expected the name of a file, got a folder; name a file, or give --format arrayrecord."
        )
