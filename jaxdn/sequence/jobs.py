"""What ``jaxdn denoise`` has to do: which frames of which shots, where they are written, and what is there already."""

import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from os.path import commonpath
from pathlib import Path

from jaxdn.data.clip.folder import frame_path, is_clip, read_record, refuse_unfinished
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.passes import join_passes
from jaxdn.data.foreign.shots import Shot, find_missing, find_shots, is_named, ranges
from jaxdn.data.foreign.views import explain_views, open_views, select_view

WARM_UP = 16
"""Frames before a wanted one that are read for its history where only a part of a shot is denoised. After so many,
what the history of svgf lacks makes a tenth of the noise that is left (tests/sequence/test_frames.py)."""


_OTHER_IMAGES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".hdr", ".bmp", ".webp")
"""What somebody may want to write, and no folder is called."""


@dataclass(frozen=True)
class Job:
    """A shot, and what to write of it."""

    shot: Shot
    clip: Path | None
    """Its folder, if it is a clip of ours."""
    targets: tuple[Path, ...]
    """The file to write for each frame."""
    wanted: frozenset[int]
    """Indices of the frames to write."""
    notes: tuple[str, ...]
    """What a user should know, in sentences."""
    files: tuple[ExrFile, ...] = ()
    """The files, each to be opened once; of a clip of ours none."""
    copies: Mapping[Path, tuple[Path, ...]] = field(default_factory=dict)
    """Target -> further files to write with the same result, of frames that are held."""

    views: Mapping[str, tuple[ExrFile, ...]] = field(default_factory=dict)
    """View -> its files, each to be opened once; "" for files without views; of a clip of ours none."""

    @property
    def source(self) -> Path:
        """What tells of which layers it consists: the clip's folder, or the first file."""
        return self.clip or self.shot.files[0]

    def count_channels(self, index: int) -> int:
        """The number of channels of a frame's file."""
        file = self.files[index] if self.files else ExrFile(self.shot.files[index])
        return len(file.windows)

    def without(self, indices: Collection[int]) -> "Job":
        """The same job without some of its frames, and without the copies of their results."""
        kept = [index for index in range(len(self.shot.files)) if index not in indices]
        numbers = tuple(self.shot.numbers[index] for index in kept) if self.shot.numbers else ()
        shot = self.shot._replace(files=tuple(self.shot.files[index] for index in kept), numbers=numbers)
        views = {view: tuple(files[index] for index in kept) for view, files in self.views.items()}
        targets = tuple(self.targets[index] for index in kept)
        return replace(
            self,
            views=views,
            shot=shot,
            targets=targets,
            wanted=frozenset(new for new, index in enumerate(kept) if index in self.wanted),
            files=tuple(self.files[index] for index in kept),
            copies={target: copies for target, copies in self.copies.items() if target in targets},
        )

    def of_view(self, view: str) -> "Job":
        """The same job with the files of one view."""
        return replace(self, files=self.views[view])

    def segments(self, *, both_directions: bool = False) -> Iterator[range]:
        """Indices of consecutive frames, each after the first with a history: the wanted ones and their warm-up.

        With ``both_directions`` there are as many frames after the last wanted one.
        """
        last = len(self.shot.files) - 1
        breaks = {
            index + 1 for index, (one, next_) in enumerate(pairwise(self.shot.numbers)) if next_ != one + self.shot.step
        }
        start: int | None = None
        for index in range(last + 1):
            if start is not None and index in breaks:
                yield range(start, index)
                start = None
            ahead = range(index, min(index + WARM_UP, last) + 1)
            end = next((later for later in ahead if later > index and later in breaks), last + 1)
            needed = any(later in self.wanted for later in ahead if later < end)
            if both_directions and start is not None:
                needed |= any(earlier in self.wanted for earlier in range(max(start, index - WARM_UP), index))
            if needed and start is None:
                start = index
            elif not needed and start is not None:
                yield range(start, index)
                start = None
        if start is not None:
            yield range(start, last + 1)


def find_jobs(
    sources: Sequence[Path],
    out: Path,
    *,
    frames: Collection[int] | None = None,
    skip_existing: bool = False,
    pass_files: Mapping[str, str] | None = None,
    view: str | None = None,
) -> list[Job]:
    """The shots of folders, patterns and files; several sequences in a folder are several shots.

    Results have the names of their files. With inputs in several folders, they lie in folders of the same names below
    ``out``. Raises ValueError for no sources and sources without frames, for ``frames`` of which none has any (one that
    is missing between others is no error), for a frame that is there twice, where a file of the input would be
    overwritten or lies in the place of a folder, for the name of one file for several frames, and for that of an image
    which is no EXR file.

    Args:
      sources: folders of clips, folders of EXR files, patterns, or files.
      out: a folder; for a single frame also the name of an EXR file.
      frames: numbers of the frames to denoise; None: all.
      skip_existing: leave out what is there already.
      pass_files: buffer -> pattern for the files that have it, of other renderers' frames.
      view: the only one to denoise of files with several (:mod:`jaxdn.data.foreign.views`); None: each.
    """
    if not sources:
        raise ValueError("expected a folder, a pattern or a file to denoise, got none; name one.")
    found = [shot for source in _gather(sources) for shot in _shots(source)]
    joined, joints = join_passes([shot for shot, clip in found if clip is None], pass_files or {})
    joined = select_view(joined, view)
    places = {shot.files[0]: place for place, (shot, _) in enumerate(found)}
    found = [one for one in found if one[1] is not None] + [(shot, None) for shot in joined]
    found.sort(key=lambda one: places[one[0].files[0]])
    together = Path(commonpath([os.path.dirname(os.path.abspath(file)) for shot, _ in found for file in shot.files]))
    single = out.suffix.lower() == ".exr"
    if out.suffix.lower() in _OTHER_IMAGES:
        raise ValueError(
            f"-o {out}: expected a folder or the name of an EXR file; --preview writes a PNG next to every EXR."
        )
    count = sum(len(shot.files) for shot, _ in found)
    if single and count > 1:
        raise ValueError(f"{out}: expected a folder for {count} frames, got the name of one EXR file.")
    _check_folder(out.parent if single else out)
    if single and out.is_dir():
        raise ValueError(
            f"-o {out}: expected the name of an EXR file, but there is a folder of that name; name another."
        )
    jobs: list[Job] = []
    named = frames is None
    for shot, clip in found:
        # Links keep their own names: a store's are hashes.
        below = [out / Path(os.path.abspath(file)).relative_to(together) for file in shot.files]
        targets = (out,) if single else tuple(map(_as_exr, below))
        chosen = [
            index
            for index in range(len(targets))
            if frames is None or set(map(math.floor, shot.numbers[index : index + 1])) & set(frames)
        ]
        wanted = frozenset(index for index in chosen if not (skip_existing and _is_written(targets[index])))
        named |= bool(chosen) or not set(find_missing(shot.numbers)).isdisjoint(frames or ())
        notes = (
            *(joints if not jobs else ()),
            *_notes(shot, among_others=len(found) > 1, existing=len(chosen) - len(wanted)),
        )
        views = {} if clip is not None else open_views(shot, view)
        notes += tuple(explain_views(shot.label, views))
        jobs.append(_hold(Job(shot, clip, targets, wanted, notes, next(iter(views.values()), ()), views=views)))
    _check_targets(jobs)
    inputs = {file.resolve() for shot, _ in found for file in shot.files}
    inputs |= {file.resolve() for shot, _ in found for each in shot.passes for file in each.values()}
    if {target.resolve() for job in jobs for target in job.targets} & inputs or out.resolve() in inputs:
        raise ValueError(f"{out}: expected another place than the input's, whose frames would be overwritten.")
    if frames is not None and not named:
        there = "; ".join(f"{job.shot.label}" for job in jobs)
        raise ValueError(f"--frames {ranges(sorted(frames))}: expected frames that are there, got none of {there}.")
    return jobs


def _gather(sources: Sequence[Path]) -> list[Path | list[Path]]:
    """The sources, with all files that are named one by one, as a shell expands a pattern, in place of the first."""
    gathered: list[Path | list[Path]] = []
    files: list[Path] = []
    for source in sources:
        if not is_named(source):
            gathered.append(source)
            continue
        if not files:
            gathered.append(files)
        files.append(source)
    return gathered


def _is_written(path: Path) -> bool:
    """Whether a result is there; a placeholder without bytes is none."""
    return path.is_file() and path.stat().st_size > 0


def _as_exr(path: Path) -> Path:
    return path if path.suffix.lower() == ".exr" else path.with_suffix(".exr")


def _hold(job: Job) -> Job:
    """The job with frames that are the file before once more (a link of either kind) as copies of its result."""
    held: dict[int, int] = {}
    for index in range(1, len(job.files)):
        before, now = job.shot.files[index - 1], job.shot.files[index]
        if now.exists() and before.exists() and now.samefile(before):
            held[index] = held.get(index - 1, index - 1)
    if not held:
        return job
    copies: dict[Path, tuple[Path, ...]] = {}
    notes = list(job.notes)
    for index, source in held.items():
        if index in job.wanted:
            copies[job.targets[source]] = (*copies.get(job.targets[source], ()), job.targets[index])
        names = job.shot.files[index].name, job.shot.files[source].name
        notes.append(f"{names[0]} is {names[1]} once more, and so is its result; after it there is no history at first")
    wanted = job.wanted | {source for index, source in held.items() if index in job.wanted}
    return replace(job, wanted=wanted, copies=copies, notes=tuple(notes)).without(held)


def _shots(source: Path | list[Path]) -> list[tuple[Shot, Path | None]]:
    if isinstance(source, list):
        return [(shot, None) for shot in find_shots(source)]
    if is_clip(source):
        count = read_record(source)["frames"]
        return [(Shot(tuple(frame_path(source, index) for index in range(count)), tuple(range(count))), source)]
    refuse_unfinished(source)
    return [(shot, None) for shot in find_shots(source)]


def _check_folder(folder: Path) -> None:
    """Raise ValueError where a folder, or one that it is to lie in, is a file."""
    taken = next((path for path in (folder, *folder.parents) if path.is_file()), None)
    if taken is not None:
        raise ValueError(f"-o {folder}: expected a folder, but {taken} is a file; name another.")


def _check_targets(jobs: Sequence[Job]) -> None:
    """Raise ValueError where two frames would be written into one file."""
    frames: dict[Path, Path] = {}
    for job in jobs:
        for file, target in zip(job.shot.files, job.targets, strict=True):
            other = frames.setdefault(target, file)
            if other is file:
                continue
            if other.resolve() == file.resolve():
                raise ValueError(f"{file}: expected every frame once, got it twice; name it once.")
            raise ValueError(f"{target}: expected the result of one frame, got {other} and {file}; rename one of them.")


def _notes(shot: Shot, *, among_others: bool, existing: int) -> tuple[str, ...]:
    notes = []
    gaps = find_missing(shot.numbers)
    if gaps:
        notes.append(f"{shot.label}: {ranges(gaps)} missing; after a gap there is no history at first")
    if among_others and not shot.numbers:
        notes.append(f"{shot.label}: no frame number in its name, so it is denoised as an image of its own")
    if existing:
        they = f"{existing} frames are there already and stay as they are"
        notes.append(f"{shot.label}: {they if existing > 1 else '1 frame is there already and stays as it is'}")
    return tuple(notes)
