"""Which files of a shot cannot be its frames: empty, incomplete, of another size, or with another set of buffers.

A renderer's placeholders, a killed job and a changed setting leave such files. They are told by their headers alone.
"""

from collections import Counter
from collections.abc import Sequence

from jaxdn.data.errors import ClipError, DamagedFile
from jaxdn.data.exr.completeness import check_complete
from jaxdn.data.exr.file import ExrFile, Window
from jaxdn.data.foreign.classify import ChannelNaming

_Look = tuple[Window, frozenset[str]]
"""The picture, and the buffers that the names of the channels promise."""


def find_unusable(files: Sequence[ExrFile], naming: ChannelNaming) -> dict[int, str]:
    """Index -> why that file is no frame of the shot that most of the files are, without the file's name.

    Raises ClipError, naming the first file, if none is usable.
    """
    looks: dict[int, _Look] = {}
    reasons: dict[int, str] = {}
    known: dict[tuple[str, ...], frozenset[str]] = {}
    for index, file in enumerate(files):
        try:
            for path in file.paths:
                check_complete(path)
            names = tuple(file.windows)
            if names not in known:
                known[names] = frozenset(naming.detect(names))
            looks[index] = file.display, known[names]
        except DamagedFile as error:
            reasons[index] = error.reason if error.path == file.path else f"{error.path.name}: {error.reason}"
        except OSError as error:
            reasons[index] = error.strerror or str(error)
        except ClipError as error:
            reasons[index] = str(error).removeprefix(f"{file.path}: ").removesuffix(".")
    if not looks:
        raise ClipError(f"{files[0].path}: {reasons[0]}.")
    counts = Counter(looks.values())
    usual = max(counts, key=lambda look: (counts[look], len(look[1])))  # of equals the one with the most buffers
    differing = {index: _explain(look, usual) for index, look in looks.items() if look != usual}
    return dict(sorted((reasons | differing).items()))


def _explain(look: _Look, usual: _Look) -> str:
    """How a file differs from most of the shot."""
    (display, buffers), (picture, wanted) = look, usual
    if display != picture:
        (height, width), (rows, columns) = display.size, picture.size
        if display.size == picture.size:
            return f"expected the display window {tuple(picture)} of the other frames, got {tuple(display)}"
        return f"expected {columns} x {rows} pixels as in the other frames, got {width} x {height}"
    lacks, more = ", ".join(sorted(wanted - buffers)), ", ".join(sorted(buffers - wanted))
    both = " and ".join(part for part in (lacks and f"without {lacks}", more and f"with {more} besides") if part)
    return f"expected the buffers of the other frames, got a file {both}"
