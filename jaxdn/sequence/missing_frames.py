"""Files of other renderers that count as missing frames of their shot: empty, damaged, or different from the others."""

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.soundness import find_unusable
from jaxdn.sequence.jobs import Job
from jaxdn.sequence.settings import Settings


def leave_out_unusable(
    jobs: Sequence[Job], settings: Settings, log: Callable[[str], None]
) -> list[tuple[Job, dict[Path, str]]]:
    """The jobs without the files whose headers tell that they are no frames of their shot, and why, in words.

    A shot of which nothing is left (a data pass, say) is left out with a line. Raises ClipError where the settings are
    strict, and where nothing is left of all shots.
    """
    checked, errors = [], []
    for job in jobs:
        try:
            checked.append(_leave_out(job, settings))
        except ClipError as error:
            if settings.strict:
                raise
            errors.append((job, error))
    if errors and not checked:
        raise errors[0][1]
    for job, reason in errors:
        for note in job.notes:
            log(note)
        log(f"{job.shot.label} is left out: {reason}")
    return checked


def _leave_out(job: Job, settings: Settings) -> tuple[Job, dict[Path, str]]:
    """The job without the files whose headers tell that they are no frames of the shot, and why, in words.

    Only what is read is looked at. Raises ClipError for the first such file where the settings are strict, and where
    nothing to denoise is left.
    """
    needed = sorted({index for part in job.segments(both_directions=settings.bidirectional) for index in part})
    if job.clip is not None or not needed:
        return job, {}
    found: dict[int, str] = {}
    for files in job.views.values():
        found = find_unusable([files[index] for index in needed], settings.naming) | found
    unusable = {needed[index]: reason for index, reason in found.items()}
    reasons = {job.shot.files[index]: reason for index, reason in unusable.items()}
    if reasons and (settings.strict or job.wanted <= set(unusable)):
        path, reason = next(iter(reasons.items()))
        raise ClipError(f"{path}: {reason}.")
    return (job.without(unusable) if unusable else job), reasons


def explain_left_out(path: Path, reason: str) -> str:
    """Why a file counts as missing, as a line."""
    return f"{label_file(path)} is left out, as a missing frame: {reason}; after it there is no history at first"


def segments_around(job: Job, segment: range, index: int, written: Collection[Path]) -> list[range]:
    """What is left of a segment before and after a frame that cannot be read, where results are still to be written."""
    parts = range(segment.start, index), range(index + 1, segment.stop)
    return [part for part in parts if any(i in job.wanted and job.targets[i] not in written for i in part)]
