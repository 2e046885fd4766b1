"""Opening what to train on, in whatever form it is: folders of clips, packed sets, sets of shards."""

from pathlib import Path

from jaxdn.data.clip.folder import find_clips
from jaxdn.data.training.cache import CachedClip, open_cached
from jaxdn.data.training.pack import open_pack
from jaxdn.data.training.shards import is_sharded, open_shards


def open_clips(place: str | Path) -> list[CachedClip]:
    """The clips of a folder, one clip, or the windows of a set that is packed. Raises ClipError as these do."""
    place = Path(place)
    if is_sharded(place):
        return open_shards(place)
    return open_pack(place) if place.is_file() else [open_cached(path) for path in find_clips(place)]
