"""``jaxdn denoise``: frames that are there, or a scene that is rendered for the denoiser."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxdn.commands.arguments import Denoise, check_folder, make_channel_naming
from jaxdn.commands.channel_table import show_channel_mapping
from jaxdn.commands.errors import computing_errors
from jaxdn.commands.progress import reporter
from jaxdn.core.options import make, numbers, parse
from jaxdn.data.clip.folder import is_clip, read_record
from jaxdn.data.clip.record import is_filtered
from jaxdn.data.errors import DamagedFile
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.frame_names import label_file
from jaxdn.runtime.malloc import tune_malloc
from jaxdn.sequence.jobs import Job
from jaxdn.sequence.optics import Optics
from jaxdn.sequence.run import denoise_files, select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import AUTO, Model, choose_model, find_model

_OF_SCENES = ("width", "height", "animation", "seed")


def run_denoise(options: Denoise, *, on_start: Callable[[], None] = lambda: None) -> None:
    """Denoise what the options name.

    Raises ValueError for options that frames, or scenes, do not have, for full memory, and where Open Image Denoise
    fails.

    ``on_start`` is called when the first frame is written: from then on nothing is imported or traced.
    """
    if options.max_memory is None:  # else freed memory goes back to the system at once
        tune_malloc()
    naming = make_channel_naming(options)
    scene = _scene_of(options)
    if options.method == AUTO:
        options = _choose_method(options, of_scene=scene is not None)
    less = "--max-memory" if scene is None else "a smaller --width and --height"
    with computing_errors(f"{less}, or another --method"):
        if scene is None:
            _denoise_files(options, naming, on_start)
        else:
            _denoise_scene(options, scene, on_start)


def _choose_method(options: Denoise, *, of_scene: bool) -> Denoise:
    """The options with the method that is best for what they name; it is printed."""
    ours = of_scene or any(is_clip(path) and not is_filtered(read_record(path)) for path in options.clips)
    choice = choose_model(through_centres=ours)
    print(f"method: {choice.name} ({choice.reason})")
    return replace(options, method=choice.name)


def _denoise_files(options: Denoise, naming: ChannelNaming, on_start: Callable[[], None]) -> None:
    """Frames of clips and of other renderers."""
    if options.max_memory is not None and not 0 < options.max_memory < math.inf:
        raise ValueError(f"--max-memory: expected more than 0 GiB, got {options.max_memory:g}.")
    if options.budget is not None:
        _check_budget(options.method)
    method, backend = select_backend(options.method, options.implementation, **_budget(options))
    settings = Settings(
        spp=options.spp,
        naming=naming,
        frames=_frames(options),
        skip_existing=options.skip_existing,
        strict=options.strict,
        only_beauty=options.only_beauty,
        aovs=options.aovs,
        alpha=options.alpha,
        wrap=options.wrap,
        reblur=None
        if options.reblur is None
        else make(Optics, parse(options.reblur, option="--reblur"), method="--reblur"),
        preview=options.preview,
        bidirectional=options.bidirectional,
        safe=options.safe,
        max_memory=None if options.max_memory is None else options.max_memory * 2**30,
    )
    with reporter(options.method) as report:
        written = denoise_files(
            options.clips,
            options.out,
            method,
            settings,
            on_job=lambda job: _show_job(job, naming, method),
            on_frame=_after_first(on_start, report.on_frame),
            log=report.log,
        )
    if written.left_out:
        names = ", ".join(map(label_file, written.left_out[:8])) + (" ..." if len(written.left_out) > 8 else "")
        print(f"left out as missing: {_count(len(written.left_out), 'frame')}: {names} (--strict: end there)")
    if not written.files:
        print(f"nothing to do in {options.out}")
        return
    frames, compiled = _count(len(written.files), "frame"), _count(written.programs, "program")
    print(f"{frames} denoised by {options.method} in {options.out} ({backend}, {compiled} compiled)")
    if written.sanitized:
        print(f"{_count(written.sanitized, 'value')} sanitized: not usable numbers (NaN, infinite, negative ...)")


def _show_job(job: Job, naming: ChannelNaming, method: Model) -> None:
    """Print what is read of a shot."""
    single = len(job.shot.files) == 1
    reads = frozenset[str]() if method.denoiser is None else method.denoiser.reads
    if job.clip is not None:
        show_channel_mapping(job.source, read_channel_mapping(job.clip, naming), reads=reads)
    for view, files in job.views.items():
        title = f"{job.source}{view and f' ({view})'}"
        for source in files:
            try:
                mapping = read_channel_mapping(source, naming, single=single)
            except DamagedFile:  # told when its turn comes
                if source is files[-1]:
                    raise
                continue
            show_channel_mapping(title, mapping, reads=reads, single=single)
            break


def _denoise_scene(options: Denoise, scene: str, on_start: Callable[[], None]) -> None:
    """Frames that are rendered with samples where the denoiser wants them."""
    from jaxdn.render.settings import RenderSettings
    from jaxdn.sequence.render_and_denoise import SceneSettings, denoise_scene

    asks = getattr(find_model(options.method).denoiser, "samples", None) is not None
    budget = _budget(options)
    method, backend = select_backend(options.method, options.implementation, **(budget if asks else {}))
    size = {name: value for name in ("width", "height", "seed") if (value := getattr(options, name)) is not None}
    settings = SceneSettings(RenderSettings(**size), _frames(options), preview=options.preview, **budget)
    out = check_folder(options.out)
    with reporter(options.method) as report:
        written = denoise_scene(
            scene,
            options.animation,
            out,
            method,
            settings,
            on_frame=_after_first(on_start, report.on_frame),
            log=report.log,
        )
    frames = _count(len(written.files), "frame")
    print(f"{frames} rendered, and denoised by {options.method}, in {options.out} ({backend})")


def _after_first(
    on_start: Callable[[], None], on_frame: Callable[[Path, int, int], None]
) -> Callable[[Path, int, int], None]:
    """``on_frame`` for every frame, with ``on_start`` after the first."""

    def tell(path: Path, done: int, total: int) -> None:
        on_frame(path, done, total)
        if done == 1:
            on_start()

    return tell


def _scene_of(options: Denoise) -> str | None:
    """The scene to render, if there is one. Raises ValueError for options that only one of scene and clips has."""
    from jaxdn.render.families import FAMILIES

    scenes = [path for path in options.clips if path.suffix == ".xml" or (str(path) in FAMILIES and not path.exists())]
    if not scenes:
        if given := [name for name in _OF_SCENES if getattr(options, name) is not None]:
            raise ValueError(f"--{given[0]}: expected a scene to render, got frames that are there; leave it out.")
        return None
    if len(options.clips) > 1:
        raise ValueError(f"{scenes[0]}: expected one scene and nothing else, got {len(options.clips)} sources.")
    usual = Denoise(options.clips, options.out)
    kept = {"clips", "out", "method", "implementation", "frames", "preview", "budget", *_OF_SCENES}
    other = [name for name in vars(usual) if name not in kept and getattr(options, name) != getattr(usual, name)]
    if other:
        raise ValueError(f"--{other[0].replace('_', '-')}: expected frames that are there, got a scene; leave it out.")
    return str(scenes[0])


def _frames(options: Denoise) -> list[int] | None:
    """The numbers of the frames to denoise; None: all."""
    return None if options.frames is None else numbers(options.frames, "--frames", negative=True)


def _check_budget(name: str) -> None:
    """Raise ValueError for a method that does not say where samples go."""
    known = find_model(name).method
    if known is None or not known.has_option("budget"):
        raise ValueError(
            f"--budget: expected a method that says where samples go (ntasd, dasr), got {name}; leave it out."
        )


def _budget(options: Denoise) -> dict[str, Any]:
    """The option of a method that says where samples go."""
    return {} if options.budget is None else {"budget": options.budget}


def _count(number: int, noun: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {noun}{'s' * (number != 1)}"
