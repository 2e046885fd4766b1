"""``jaxdn denoise``: noisy clips in, denoised EXR frames out, one frame at a time."""

from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxdn import color
from jaxdn.core.frame import Frame
from jaxdn.data.clip.frames import StoredFrame
from jaxdn.data.exr.exr import write_exr
from jaxdn.data.foreign.import_exr import canvas_of
from jaxdn.data.foreign.result import write_result
from jaxdn.data.read import open_frames
from jaxdn.evaluation.report.images import save_png
from jaxdn.sequence.additive_layers import Aovs
from jaxdn.sequence.backward_pass import Backwards, backward_pass
from jaxdn.sequence.denoise_frames import Pass, Safe, light_of
from jaxdn.sequence.jobs import Work, work_on
from jaxdn.zoo.ready import Candidate, candidate


class Settings(NamedTuple):
    """How frames are read, which of them are denoised, and what is written."""

    spp: int = 1
    """Samples per pixel to take from a clip's layers."""
    motion_convention: str | None = None
    """That of motion vectors in files of other renderers (:data:`jaxdn.clips.MOTION_CONVENTIONS`)."""
    channels: Mapping[str, str] | None = None
    """Buffer -> layer to take it from in files of other renderers."""
    layer: str | None = None
    """View layer or part to look for the other buffers in."""
    frames: Collection[int] | None = None
    """Numbers of the frames to denoise; None: all."""
    skip_existing: bool = False
    """Leave out what is there already."""
    only_beauty: bool = False
    """Of files of other renderers, write the denoised beauty and its alpha alone."""
    aovs: Literal["keep", "additive"] = "keep"
    """What becomes of the other layers of light in files of other renderers: they stay, or are denoised too, so that
    they still add up to the beauty (:mod:`jaxdn.sequence.aov_shares`)."""
    preview: bool = False
    """Write a PNG next to each frame."""
    bidirectional: bool = False
    """Denoise from the last frame to the first too, and blend both passes (:mod:`jaxdn.filters.time_reversal`)."""
    safe: bool = True
    """Keep of the noisy image what is no noise (:mod:`jaxdn.sequence.safe_blend`)."""
    max_memory: float | None = None
    """Bytes; frames that need more are denoised in parts. None: half of the machine's memory."""


class Written(NamedTuple):
    """What was denoised."""

    files: list[Path]
    programs: int
    """Steps that were compiled: one for each distinct set of buffers among the frames."""
    sanitized: int
    """Invalid values (NaN, infinite, negative ...) of frames and histories that were replaced."""


def candidate_on(name: str, implementation: str = "auto", **options: Any) -> tuple[Candidate, str]:
    """The candidate of that name on an engine, and the engine's name; "reference" is XLA.

    ``options`` are given to it (:func:`jaxdn.zoo.ready.candidate`). ``"auto"`` is the fastest engine for inference
    that the method has and that can run here. Raises ValueError for a name that is not a method, and for an engine that
    cannot run it.
    """
    found = candidate(name, **options)
    known = found.method is not None and found.method.knows("implementation")
    if implementation == "auto":
        engine = found.engine("inference")
        return (found, "reference") if engine is None else (candidate(name, implementation=engine, **options), engine)
    if implementation == "reference" and not known:
        return found, implementation
    return candidate(name, implementation=implementation, **options), implementation


def denoise_files(
    sources: Sequence[Path],
    out: Path,
    method: Candidate,
    settings: Settings = Settings(),  # noqa: B008, immutable
    *,
    begin: Callable[[Work], object] = lambda work: None,
    say: Callable[[Path, int, int], None] = lambda path, done, total: None,
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
      begin: called with each shot before its first frame is read.
      say: called with a file that was written, the number of frames done, and the total.
      log: called with lines about what is derived from files of other renderers, left unused or cannot be kept.
    """
    if settings.aovs == "additive" and settings.only_beauty:
        raise ValueError("--aovs additive: expected the other layers to be written; leave out --only-beauty.")
    works = work_on(sources, out, frames=settings.frames, skip_existing=settings.skip_existing)
    _refuse_unused(works, settings)
    total = sum(len(work.wanted) for work in works)
    files: list[Path] = []
    programs: set[tuple[str, ...]] = set()
    sanitized = 0
    for work in works:
        for note in work.notes:
            log(note)
        if work.wanted:
            begin(work)
        told: set[str] = set()

        def once(line: str, told: set[str] = told) -> None:
            if line not in told:
                log(line)
            told.add(line)

        for stretch in work.stretches(both_ways=settings.bidirectional):
            given: dict[str, Any] = {"limit": settings.max_memory, "log": once}
            passes = [Pass(work.source, method, **given) for _ in range(1 + settings.bidirectional)]
            with closing(_denoise(work, stretch, passes, settings, once)) as paths:
                for path in paths:
                    files.append(path)
                    say(path, len(files), total)
            programs |= {program for each in passes for program in each.programs}
            sanitized += passes[0].sanitized  # the other pass sanitizes the same frames
    return Written(files, len(programs), sanitized)


def _refuse_unused(works: Sequence[Work], settings: Settings) -> None:
    """Raise ValueError for settings that are for files of other renderers where there are only clips of ours."""
    given = {
        "--channels": settings.channels,
        "--layer": settings.layer,
        "--motion-convention": settings.motion_convention,
        "--aovs": settings.aovs != "keep",
        "--only-beauty": settings.only_beauty,
    }
    unused = [option for option, value in given.items() if value]
    if unused and all(work.clip is not None for work in works):
        raise ValueError(
            f"{', '.join(unused)}: expected files of other renderers, got {works[0].clip}, a clip of jaxdn's own; "
            f"leave {'it' if len(unused) == 1 else 'them'} out."
        )


def _denoise(
    work: Work, stretch: range, passes: Sequence[Pass], settings: Settings, log: Callable[[str], None]
) -> Generator[Path, None, None]:
    """Denoise consecutive frames of a shot; yields the files as they are written."""
    wanted = [index for index in stretch if index in work.wanted]
    with ExitStack() as stack:
        backwards: Backwards | None = None
        if settings.bidirectional:
            log(f"backwards first, through {stretch.stop - wanted[0]} frames; nothing is written meanwhile")
            turned = zip(reversed(stretch), _frames(work, stretch, settings, log, backwards=True), strict=True)
            needed = islice(turned, stretch.stop - wanted[0])
            backwards = stack.enter_context(backward_pass(needed, passes[1], wanted, work.targets[wanted[0]].parent))
        yield from _forwards(work, stretch, passes[0], backwards, settings, log)


def _forwards(
    work: Work,
    stretch: range,
    forwards: Pass,
    backwards: Backwards | None,
    settings: Settings,
    log: Callable[[str], None],
) -> Iterator[Path]:
    """The forward pass up to the last frame that is wanted, and all that becomes of its images."""
    names = work.shot.files[stretch.start : stretch.stop]
    naming: dict[str, Any] = {"channels": settings.channels, "layer": settings.layer}
    canvas = canvas_of(names)
    aovs = Aovs(canvas, naming, log) if settings.aovs == "additive" and work.clip is None else None

    doubtful: list[Path] = []

    def safer(index: int, frame: Frame, image: np.ndarray) -> np.ndarray:
        image, safe = forwards.safe(frame, image)
        file = work.shot.files[index]
        if index == min(work.wanted):
            log(_measured(file, safe))
        if safe.judged.distrust > 0 and index in work.wanted:
            if not doubtful:
                log(_distrusted(file, safe))
            doubtful.append(file)
        return image

    def one(index: int, name: Path, stored: StoredFrame) -> Path | None:
        """Denoise a frame, and write it if it is wanted. What this leaves in memory is gone when it returns."""
        frame, image = stored.frame, forwards(stored)
        if backwards is not None:
            image = backwards.blended(index, frame, image)
        if settings.safe and forwards.denoises:
            image = safer(index, frame, image)
        parts = {} if aovs is None else aovs.denoise(name, frame, image)
        if index not in work.wanted:
            return None
        path = work.targets[index]
        path.parent.mkdir(parents=True, exist_ok=True)
        beauty = image + light_of(frame.direct) + light_of(frame.emission)
        if work.clip is None:
            images = {"": beauty, **parts}
            for line in write_result(name, path, images, canvas, only_beauty=settings.only_beauty, **naming):
                log(line)
        else:
            write_exr(path, lettered("", beauty) | lettered("denoised.", image))
        if settings.preview:
            save_png(path.with_suffix(".png"), color.tonemap(beauty))
        return path

    frames = _frames(work, stretch, settings, log)
    last = max(index for index in stretch if index in work.wanted)
    for index, name in zip(stretch[: stretch.index(last) + 1], names, strict=False):
        path = one(index, name, next(frames))
        if path is not None:
            yield path
    if len(doubtful) > 1:
        log(f"likewise {len(doubtful) - 1} more, up to {doubtful[-1].name}")


def _frames(
    work: Work, part: range, settings: Settings, log: Callable[[str], None], *, backwards: bool = False
) -> Iterator[StoredFrame]:
    """Consecutive frames of a shot, or the same from the last to the first."""
    _, frames = open_frames(
        list(work.shot.files[part.start : part.stop]) if work.clip is None else work.clip,
        spp=settings.spp,
        motion_convention=settings.motion_convention,
        channels=settings.channels,
        layer=settings.layer,
        part=part,
        backwards=backwards,
        log=log,
    )
    return frames


def _measured(file: Path, safe: Safe) -> str:
    """What was measured in a frame, and what it decided, as a line."""
    noise = f"noise is about {safe.judged.noise:.1%} of the light"
    return f"{file.name}: {noise}; {safe.kept:.0%} of the frame is kept (--no-safe: nothing)"


def _distrusted(file: Path, safe: Safe) -> str:
    """Why a frame was kept, as a line."""
    reason = (
        "there is no albedo, so textures are lost; name one, --channels albedo=LAYER"
        if safe.blind
        else "do albedo, normals and depth belong to this frame?"
    )
    return (
        f"{file.name}: the denoised image differs by {safe.judged.lost:.0%} of the light, of which noise explains "
        f"{safe.judged.noise:.0%}: {reason} {safe.judged.distrust:.0%} of the result is the frame as it came"
    )


def lettered(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    """An image [H, W, 3] as the channels of a file, their names after ``layer``."""
    return {f"{layer}{letter}": np.ascontiguousarray(image[..., i], np.float32) for i, letter in enumerate("RGB")}
