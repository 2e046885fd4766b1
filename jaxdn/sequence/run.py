"""``jaxdn denoise``: noisy clips in, denoised EXR frames out, one frame at a time."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.sequence.frame_denoiser import FrameDenoiser
from jaxdn.sequence.jobs import Job, find_jobs
from jaxdn.sequence.segment import denoise_segment
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import Model, find_model


class Written(NamedTuple):
    """What was denoised."""

    files: list[Path]
    programs: int
    """Steps that were compiled: one for each distinct set of buffers among the frames."""
    sanitized: int
    """Invalid values (NaN, infinite, negative ...) of frames and histories that were replaced."""


def select_backend(name: str, implementation: str = "auto", **options: Any) -> tuple[Model, str]:
    """The candidate of that name on a backend, and the backend's name; "reference" is XLA.

    ``options`` are given to it (:func:`jaxdn.zoo.ready.find_model`). ``"auto"`` is the fastest backend for inference
    that the method has and that can run here. Raises ValueError for a name that is not a method, and for a backend that
    cannot run it.
    """
    found = find_model(name, **options)
    known = found.method is not None and found.method.has_option("implementation")
    if implementation == "auto":
        backend = found.backend("inference")
        if backend is None:
            return found, "reference"
        return find_model(name, implementation=backend, **options), backend
    if implementation == "reference" and not known:
        return found, implementation
    return find_model(name, implementation=implementation, **options), implementation


def denoise_files(
    sources: Sequence[Path],
    out: Path,
    method: Model,
    settings: Settings = Settings(),  # noqa: B008, immutable
    *,
    on_job: Callable[[Job], object] = lambda job: None,
    on_frame: Callable[[Path, int, int], None] = lambda path, done, total: None,
    log: Callable[[str], None] = lambda line: None,
) -> Written:
    """Denoise clips' folders, and EXR files of other renderers; returns the files written.

    A frame of another renderer is its own file with the denoised beauty in place of the noisy one
    (:func:`jaxdn.data.foreign.result.write_result`). A frame of one of our clips has the channels ``R, G, B``, the
    denoised radiance with the directly reflected and the emitted light added back, and ``denoised.R/G/B``, the denoised
    part alone. What is no noise is kept as it was (``settings.safe``). Frames are read, denoised and written one at a
    time, so that a sequence of any length takes the memory of one. Files are never left incomplete. Where frames are
    missing, the history begins anew. Raises ValueError for input that cannot be read or is inconsistent, before the
    frame concerned is written.

    Args:
      sources: folders of clips, and folders of, patterns for, or names of EXR files.
      out: folder for the denoised frames; of a single frame, also the name of an EXR file.
      method: the denoiser.
      settings: the rest.
      on_job: called with each shot before its first frame is denoised.
      on_frame: called with a file that was written, the number of frames done, and the total.
      log: called with lines about what is derived from files of other renderers, left unused or cannot be kept; each
        once a shot.
    """
    if settings.aovs == "additive" and settings.only_beauty:
        raise ValueError("--aovs additive: expected the other layers to be written; leave out --only-beauty.")
    jobs = find_jobs(sources, out, frames=settings.frames, skip_existing=settings.skip_existing)
    _refuse_unused(jobs, settings)
    total = sum(len(job.wanted) for job in jobs)
    files: list[Path] = []
    programs: set[tuple[str, ...]] = set()
    sanitized = 0
    for job in jobs:
        for note in job.notes:
            log(note)
        if job.wanted:
            on_job(job)
        log_once = _once(log)
        for segment in job.segments(both_directions=settings.bidirectional):
            denoisers = [
                FrameDenoiser(method, job.source, channels=job.count_channels, limit=settings.max_memory, log=log_once)
                for _ in range(1 + settings.bidirectional)
            ]
            with closing(denoise_segment(job, segment, denoisers, settings, log_once)) as paths:
                for path in paths:
                    files.append(path)
                    on_frame(path, len(files), total)
            programs |= {program for denoiser in denoisers for program in denoiser.programs}
            sanitized += denoisers[0].sanitized  # the other direction repairs the same frames
    return Written(files, len(programs), sanitized)


def _once(log: Callable[[str], None]) -> Callable[[str], None]:
    """The callback without lines that it has been given already."""
    logged: set[str] = set()

    def log_once(line: str) -> None:
        if line not in logged:
            logged.add(line)
            log(line)

    return log_once


def _refuse_unused(jobs: Sequence[Job], settings: Settings) -> None:
    """Raise ValueError for settings that are for files of other renderers where there are only clips of ours."""
    others = {"--aovs": settings.aovs != "keep", "--only-beauty": settings.only_beauty}
    unused = [*settings.naming.options, *(option for option, given in others.items() if given)]
    if unused and all(job.clip is not None for job in jobs):
        raise ValueError(
            f"{', '.join(unused)}: expected files of other renderers, got {jobs[0].clip}, a clip of jaxdn's own; "
            f"leave {'it' if len(unused) == 1 else 'them'} out."
        )
