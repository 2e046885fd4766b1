"""``jaxdn pack``: a training set in one compact file, to train on a machine behind a thin line."""

from collections.abc import Callable, Sequence
from pathlib import Path

from jaxdn.data.errors import ClipError
from jaxdn.data.training.pack import Packed, Packing, open_clips, write_pack


def pack(
    places: Sequence[Path],
    out: Path,
    packing: Packing,
    *,
    mib: float,
    progress: Callable[[int, int], None] = lambda windows, size: None,
) -> Packed:
    """Pack random windows of clips into the file ``out`` of at most ``mib`` MiB, in a folder that is made if missing.

    ``places`` are as for :func:`jaxdn.clips.training_batches`. Raises as :func:`jaxdn.data.training.pack.write_pack`
    does, and ValueError for a size that is not positive.
    """
    if not 0 < mib < 2**20:
        raise ValueError(f"--mib: expected more than 0 MiB and less than 2^20, got {mib:g}.")
    clips = [clip for place in places for clip in open_clips(place)]
    if not clips:
        raise ClipError("clips: expected at least one folder, got none.")
    out.parent.mkdir(parents=True, exist_ok=True)
    return write_pack(out, clips, size=int(mib * 2**20), packing=packing, progress=progress)
