"""``jaxdn denoise``: noisy clips in, denoised EXR frames out, one frame at a time."""

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.data.errors import DamagedFile
from jaxdn.runtime.atomic_files import atomic_write, remove_abandoned
from jaxdn.runtime.overlap import Behind
from jaxdn.runtime.scratch import remove_abandoned_folders
from jaxdn.sequence.backward_pass import HIDDEN
from jaxdn.sequence.frame_denoiser import FrameDenoiser
from jaxdn.sequence.jobs import Job, find_jobs
from jaxdn.sequence.missing_frames import explain_left_out, leave_out_unusable, segments_around
from jaxdn.sequence.segment import denoise_segment
from jaxdn.sequence.settings import Settings
from jaxdn.sequence.write_frames import SharedResult, Write
from jaxdn.zoo.ready import Model, find_model


class Written(NamedTuple):
    """What was denoised."""

    files: list[Path]
    programs: int
    """Steps that were compiled: one for each distinct set of buffers among the frames."""
    sanitized: int
    """Invalid values (NaN, infinite, negative ...) of frames and histories that were replaced."""
    left_out: Sequence[Path] = ()
    """Files of other renderers that count as missing frames: damaged, or different from the others."""


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
    if not known:
        if implementation != "reference":
            raise ValueError(
                f"implementation: expected auto or reference for {name}, which has no choice, got {implementation!r}."
            )
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
    part alone; where its pixels are filtered, that is all light (:mod:`jaxdn.sequence.all_light`). What is no noise is
    kept as it was (``settings.safe``). While a frame is denoised, the next one is read and the one before is written,
    so that a sequence of any length takes the memory of three frames, or of one where that is all there is. Files are
    never left incomplete. Where frames are missing, the history begins anew. Files of other renderers that are damaged,
    of another size or with other buffers than most of their shot count as missing, unless ``settings.strict``. A shot
    of which nothing is left is left out with a line. Raises ValueError for input that cannot be read or is
    inconsistent, before the frame concerned is written, and where nothing is left of all shots.

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
    jobs = find_jobs(
        sources,
        out,
        frames=settings.frames,
        skip_existing=settings.skip_existing,
        pass_files=settings.naming.pass_files,
        view=settings.naming.view,
    )
    _refuse_unused(jobs, settings)
    for folder in {target.parent for job in jobs for target in job.targets}:
        if folder.is_dir():
            remove_abandoned_folders(folder, HIDDEN)
            remove_abandoned(folder)
    checked = leave_out_unusable(jobs, settings, log)
    run = _Run(method, settings, sum(_count_results(job) for job, _ in checked), on_frame, log)
    lost = 0
    for job, reasons in checked:
        for note in job.notes:
            log(note)
        for path, reason in reasons.items():
            run.leave_out(path, reason)
        try:
            if job.wanted:
                on_job(job)
            run.denoise(job)
        except DamagedFile as error:
            lost += 1
            if lost == len(checked) or not run.leave_out_shot(job, error):
                raise
    return Written(run.files, len(run.programs), run.sanitized, run.left_out)


class _Run:
    """The shots that are denoised with one method, and what has become of them so far."""

    def __init__(
        self,
        method: Model,
        settings: Settings,
        total: int,
        on_frame: Callable[[Path, int, int], None],
        log: Callable[[str], None],
    ) -> None:
        """``total``: the number of frames to write. The others as :func:`denoise_files` takes them."""
        self._method, self._settings, self._total = method, settings, total
        self._on_frame, self._log = on_frame, log
        self.files: list[Path] = []
        self.left_out: list[Path] = []
        self.programs: set[tuple[str, ...]] = set()
        self.sanitized = 0

    def leave_out(self, path: Path, reason: str) -> None:
        """Tell that a file counts as a missing frame."""
        self.left_out.append(path)
        self._log(explain_left_out(path, reason))

    def leave_out_shot(self, job: Job, error: DamagedFile) -> bool:
        """Whether the run goes on without a shot of another renderer of which nothing is left; if so, tell."""
        if self._settings.strict or job.clip is not None or error.path not in job.shot.files:
            return False
        self._total -= _count_results(job)
        self._log(f"{job.shot.label} is left out: {error}")
        return True

    def denoise(self, job: Job) -> None:
        """Denoise a shot; a file of another renderer that cannot be decoded counts as missing.

        Raises DamagedFile for one of a clip of ours, and where nothing else of the shot is left.
        """
        log_once = _once(self._log)
        before, total = len(self.files), self._total
        segments = list(job.segments(both_directions=self._settings.bidirectional))
        while segments:
            segment = segments.pop(0)
            try:
                self._denoise_segment(job, segment, log_once)
            except DamagedFile as error:
                read = job.shot.files[segment.start : segment.stop]
                if self._settings.strict or job.clip is not None or error.path not in read:
                    raise
                index = segment.start + read.index(error.path)
                segments[:0] = segments_around(job, segment, index, self.files)
                if not segments and len(self.files) == before:
                    self._total = total
                    raise
                if index in job.wanted:
                    self._total -= 1 + len(job.copies.get(job.targets[index], ()))
                self.leave_out(error.path, error.reason)

    def _denoise_segment(self, job: Job, segment: range, log: Callable[[str], None]) -> None:
        """Denoise consecutive frames of a shot, from a new history."""
        views = list(job.views) or [""]
        limit = self._settings.max_memory
        count_channels = cache(partial(job.count_channels, segment.start))
        count_channels()  # later the writing thread may drop the same file
        with Behind[list[Sequence[str]]]() as behind, ExitStack() as stack:

            def log_in_order(line: str) -> None:
                behind.finish()  # what a frame before has to tell comes first
                log(line)

            make = partial(
                FrameDenoiser,
                self._method,
                job.source,
                channels=count_channels,
                limit=None if limit is None else limit / len(views),
            )
            logs = {view: log_in_order if view == "" else _with_view(view, log_in_order) for view in views}
            # Not what is backward; and where memory is little, nothing is compiled beside a step.
            blends = [self._settings.safe and limit is None, False][: 1 + self._settings.bidirectional]
            denoisers = {view: [make(log=logs[view], blends=each) for each in blends] for view in views}
            stack.callback(self._count, denoisers)
            result = SharedResult(views) if len(views) > 1 else None
            running = [
                stack.enter_context(
                    closing(
                        denoise_segment(
                            job.of_view(view) if job.views else job,
                            segment,
                            denoisers[view],
                            self._settings,
                            logs[view],
                            result,
                        )
                    )
                )
                for view in views
            ]
            # Frame by frame, so that a file has all of its views when it is written.
            while pending := [one for view in running if (one := next(view, None)) is not None]:
                path, beside = pending[0].target, pending[0].beside
                done = partial(self._tell, path, job.copies.get(path, ()), logs)
                behind.start(partial(_write, [one.write for one in pending]), done, beside=beside)
                del pending, done  # and what is to be written

    def _tell(
        self,
        path: Path,
        copies: Sequence[Path],
        logs: Mapping[str, Callable[[str], None]],
        notes: list[Sequence[str]],
    ) -> None:
        """A file is written, with these notes about each view: copy it for frames that are held, and tell."""
        for log, lines in zip(logs.values(), notes, strict=True):
            for line in lines:
                log(line)
        for written in (path, *copies):
            if written != path:
                _copy(path, written, logs)
            self.files.append(written)
            self._on_frame(written, len(self.files), self._total)

    def _count(self, denoisers: Mapping[str, Sequence[FrameDenoiser]]) -> None:
        """Add what the denoisers of each view have counted."""
        for each in denoisers.values():
            self.programs |= {program for denoiser in each for program in denoiser.programs}
            self.sanitized += each[0].sanitized  # the other direction repairs the same frames


def _count_results(job: Job) -> int:
    """The number of files to write."""
    return len(job.wanted) + sum(map(len, job.copies.values()))


def _write(views: list[Write]) -> list[Sequence[str]]:
    """Write a file; the lines about each of its views. The list is empty then, so that nothing is held any longer."""
    return [views.pop(0)() for _ in range(len(views))]


def _with_view(view: str, log: Callable[[str], None]) -> Callable[[str], None]:
    """The callback with a view's name before its lines."""
    return lambda line: log(f"{view}: {line}")


def _copy(result: Path, target: Path, views: Collection[str]) -> None:
    """The result of one frame as that of another, with its previews."""
    target.parent.mkdir(parents=True, exist_ok=True)
    for ending in (result.suffix, ".png", *(f".{view}.png" for view in views)):
        source = result.with_name(f"{result.stem}{ending}")
        if source.is_file():
            with atomic_write(target.with_name(f"{target.stem}{ending}")) as temporary:
                shutil.copyfile(source, temporary)


def _once(log: Callable[[str], None]) -> Callable[[str], None]:
    """The callback without lines that it has been given already."""
    logged: set[str] = set()

    def log_once(line: str) -> None:
        if line not in logged:
            logged.add(line)
            log(line)

    return log_once


def _refuse_unused(jobs: Sequence[Job], settings: Settings) -> None:
    """Raise ValueError for settings that are for files of other renderers where there is a clip of ours."""
    others = {
        "--aovs": settings.aovs != "keep",
        "--only-beauty": settings.only_beauty,
        "--alpha": settings.alpha,
        "--wrap": settings.wrap,
        "--reblur": settings.reblur is not None,
    }
    unused = [*settings.naming.options, *(option for option, given in others.items() if given)]
    ours = next((job.clip for job in jobs if job.clip is not None), None)
    mixed = any(job.clip is None for job in jobs)
    if unused and ours is not None:
        raise ValueError(
            f"{', '.join(unused)}: expected files of other renderers, got {ours}, a clip of jaxdn's own; "
            f"leave {'it' if len(unused) == 1 else 'them'} out{', or denoise the clip by itself' if mixed else ''}."
        )
