"""Consecutive frames of a shot: read, denoised in one direction or both, and written."""

from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.data.clip.folder import read_record
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.clip.record import is_filtered
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.read import check_single_layer, open_frames
from jaxdn.runtime.overlap import read_ahead
from jaxdn.sequence.all_light import gather_light
from jaxdn.sequence.backward_pass import BackwardImages, backward_pass
from jaxdn.sequence.frame_denoiser import Fallback, FrameDenoiser
from jaxdn.sequence.jobs import Job
from jaxdn.sequence.missing_motion import fill_motion
from jaxdn.sequence.panorama import Panorama, find_panorama
from jaxdn.sequence.settings import Settings
from jaxdn.sequence.write_frames import ClipWriter, ForeignWriter, SharedResult, Write


class PendingFile(NamedTuple):
    """A denoised frame that is to be written."""

    target: Path
    write: Write
    beside: bool
    """Whether memory is enough to write it while the next frame is denoised."""


def denoise_segment(
    job: Job,
    segment: range,
    denoisers: Sequence[FrameDenoiser],
    settings: Settings,
    log: Callable[[str], None],
    result: SharedResult | None = None,
) -> Generator[PendingFile, None, None]:
    """Denoise consecutive frames of a shot; yields the files to write. The next frame is read meanwhile.

    With a ``result`` the job is one view of its files: they are written when the last view of a frame has come.

    Args:
      job: the shot.
      segment: indices of its frames.
      denoisers: the forward one, and with ``settings.bidirectional`` the backward one.
      settings: what is read and written.
      log: called with lines for the user.
      result: shared by the views of one file; None: there is one.
    """
    wanted = [index for index in segment if index in job.wanted]
    source: _ClipFrames | _ForeignFrames
    writer: ClipWriter | ForeignWriter
    if job.clip is not None:
        source, writer = _ClipFrames(job.clip, segment, settings.spp), ClipWriter(settings)
    else:
        check_single_layer(job.shot.files[segment.start : segment.stop], settings.spp)
        sequence = ForeignSequence(job.files[segment.start : segment.stop], settings.naming)
        panorama = find_panorama(
            sequence.files[0], sequence.window, denoisers[0].receptive_field, stated=settings.wrap, log=log
        )
        # Frames that are blurred once more afterwards are sharp: zeros are right there, or nobody knows better.
        measures = denoisers[0].reads_motion and settings.reblur is None
        source = _ForeignFrames(sequence, segment, panorama, measures=measures)
        writer = ForeignWriter(sequence.window, settings, log, result, panorama)

    def roomy(stored: StoredFrame) -> bool:
        return denoisers[0].leaves_room(stored.frame)

    with ExitStack() as stack:
        backward: BackwardImages | None = None
        if settings.bidirectional:
            log(f"backwards first, through {segment.stop - wanted[0]} frames; nothing is written meanwhile")
            reversed_frames = stack.enter_context(
                read_ahead(partial(source.read, count=segment.stop - wanted[0], backwards=True), log, beside=roomy)
            )
            folder = job.targets[wanted[0]].parent
            numbered = zip(reversed(segment), reversed_frames, strict=False)
            backward = stack.enter_context(backward_pass(numbered, denoisers[1], wanted, folder))
        steps = _ForwardSteps(job, denoisers[0], backward, safe=settings.safe)
        report = _FallbackReport(job, log)
        needed = range(segment.start, wanted[-1] + 1)
        frames = stack.enter_context(read_ahead(partial(source.read, count=len(needed)), log, beside=roomy))
        for index in needed:
            write = _denoise_frame(index, next(frames), source.file(index), steps, writer, report)
            if write is not None:
                yield write
                del write  # and what it is to write
        report.finish()
        source.finish(log)


class FrameOutput(NamedTuple):
    """What became of one frame."""

    image: np.ndarray
    """[H, W, 3] the denoised radiance."""
    fallback: Fallback | None
    """What decided about the noisy image's part in it; None: nobody asked."""


def _denoise_frame(
    index: int,
    stored: StoredFrame,
    file: ExrFile | None,
    steps: "_ForwardSteps",
    writer: "ClipWriter | ForeignWriter",
    report: "_FallbackReport",
) -> PendingFile | None:
    """Denoise a frame; what is to be written, if it is wanted. All else is gone from memory when this returns."""
    target = steps.job.targets[index] if index in steps.job.wanted else None
    needs_pixels = target is not None or writer.has_history
    # First whether frames are tiled: it is asked with the number of channels, which a file knows as long as it is open.
    if file is not None and (steps.denoiser.is_tiled(stored.frame) or not needs_pixels):
        file.drop()  # decoded once more when it is written: of large frames, memory is what there is least of
    output = steps.denoise(index, stored)
    if output.fallback is not None:
        report.observe(index, output.fallback)
    write = writer.prepare(target, file, stored.frame, output.image)
    if target is None or write is None:
        return None
    return PendingFile(target, write, steps.denoiser.leaves_room(stored.frame))


class _ForwardSteps:
    """The forward direction: the denoiser, the backward images that are blended in, and the fallback."""

    def __init__(self, job: Job, denoiser: FrameDenoiser, backward: BackwardImages | None, *, safe: bool) -> None:
        self.job, self.denoiser = job, denoiser
        self._backward, self._safe = backward, safe

    def denoise(self, index: int, stored: StoredFrame) -> FrameOutput:
        image = self.denoiser(stored)
        if self._backward is not None:
            image = self._backward.blend(index, stored.frame, image)
        if not (self._safe and self.denoiser.denoises):
            return FrameOutput(image, None)
        return FrameOutput(*self.denoiser.blend_fallback(stored.frame, image))


class _FallbackReport:
    """Lines about how much of the noisy frames is kept: of the first wanted one, and of those that are not trusted."""

    def __init__(self, job: Job, log: Callable[[str], None]) -> None:
        self._job, self._log = job, log
        self._doubtful: list[Path] = []

    def observe(self, index: int, fallback: Fallback) -> None:
        """The next frame of the segment."""
        file, confidence = self._job.shot.files[index], fallback.confidence
        if index == min(self._job.wanted):
            noise = f"noise is about {confidence.noise:.1%} of the light"
            self._log(f"{label_file(file)}: {noise}; {fallback.kept:.0%} of the frame is kept (--no-safe: nothing)")
        if max(confidence.doubt, confidence.fallback) > 0.5 and index in self._job.wanted:
            if not self._doubtful:
                self._log(explain_fallback(file, fallback))
            self._doubtful.append(file)

    def finish(self) -> None:
        """After the last frame of the segment."""
        if len(self._doubtful) > 1:
            self._log(f"likewise {len(self._doubtful) - 1} more, up to {label_file(self._doubtful[-1])}")


def explain_fallback(file: Path, fallback: Fallback) -> str:
    """Why a frame was kept, as a line."""
    confidence = fallback.confidence
    reason = (
        "there is no albedo, so textures are lost; name one, --channels albedo=LAYER"
        if fallback.texture_unknown
        else "albedo, normals or depth may not belong to this frame"
    )
    kept = max(fallback.kept, confidence.fallback)
    if confidence.doubt <= 0.5:  # no guides to suspect: there is nothing to gain
        return (
            f"{label_file(file)}: with noise of {confidence.noise:.1%} of the light, the denoised image is estimated "
            f"to be no better; {kept:.0%} of the result is the frame as it came (--no-safe: nothing)"
        )
    return (
        f"{label_file(file)}: the denoised image differs by {confidence.lost:.0%} of the light, of which noise "
        f"explains {confidence.noise:.0%}: {reason}; {kept:.0%} of the result is the frame as it came"
    )


class _ClipFrames:
    """Frames of one of our clips."""

    def __init__(self, clip: Path, segment: range, spp: int) -> None:
        self._clip, self._segment, self._spp = clip, segment, spp

    def read(self, log: Callable[[str], None], *, count: int, backwards: bool = False) -> Iterator[StoredFrame]:
        """So many frames, or the same from the last backwards with time turned around."""
        frames = open_frames(self._clip, spp=self._spp, part=self._segment, backwards=backwards, log=log)[1]
        if is_filtered(read_record(self._clip)):
            frames = map(gather_light, frames)
        return islice(frames, count)

    def file(self, index: int) -> ExrFile | None:
        """None: a result is a new file."""
        return None

    def finish(self, log: Callable[[str], None]) -> None:
        """After the last frame; what is replaced in frames of ours is counted by the step."""


class _ForeignFrames:
    """Frames of another renderer, whose results are written into copies of their files."""

    def __init__(self, sequence: ForeignSequence, segment: range, panorama: Panorama | None, *, measures: bool) -> None:
        """``panorama``: its frames are widened. ``measures``: motion is measured where there is none."""
        self._sequence, self._start = sequence, segment.start
        self._panorama, self._measures = panorama, measures

    def read(self, log: Callable[[str], None], *, count: int, backwards: bool = False) -> Iterator[StoredFrame]:
        """So many frames, or the same from the last backwards with time turned around; forwards, files stay decoded."""
        frames = self._sequence.frames(backwards=backwards, keep_pixels=not backwards, log=log)
        if self._measures and len(self._sequence.files) > 1:
            frames = fill_motion(frames, lambda: self._sequence.lacks_motion, log)
        if self._panorama is not None:
            frames = map(self._panorama.widen_frame, frames)
        return map(StoredFrame, islice(frames, count))  # unlike a loop, this keeps no frame while the next one is read

    def file(self, index: int) -> ExrFile | None:
        """The file of a frame."""
        return self._sequence.files[index - self._start]

    def finish(self, log: Callable[[str], None]) -> None:
        """After the last frame: how much was clamped in all."""
        for line in self._sequence.repairs.totals():
            log(line)
