"""The command line: ``jaxdn inspect | render | pack | train | denoise | compare | doctor``; each has ``--help``."""

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

import jaxdn
from jaxdn.commands.errors import plain_errors

_PATH = tyro.conf.Positional[Path]


@dataclass
class Inspect:
    """List the effects of a scene and why it has them, what will be rendered for them, and what that saves.

    For example:

    jaxdn inspect kitchen/scene.xml --animation kitchen.json --denoiser steady-balanced

    jaxdn inspect data/test/fruit-200 --json

    jaxdn inspect "shots/*.exr" --channels albedo=diffuseFilter
    """

    scene: tyro.conf.Positional[str]
    """A Mitsuba scene (.xml), a family, or a finished clip: its folder, or EXR files of any renderer."""
    animation: Path | None = None
    """Animation file for a scene file."""
    denoiser: str | None = None
    """Plan for this denoiser (svgf, steady-balanced ...), or several (svgf,relax); default: for every buffer that a
    denoiser may read."""
    width: int = 128
    height: int = 128
    frames: int | None = None
    """Number of frames to inspect; default: all of the animation."""
    json: bool = False
    """Print only one JSON object: {"effects": [...], "plan": {...}, "uncertain": [...]}, of files also "sources"."""
    motion_convention: str | None = None
    """Convention of the motion vectors in files of other renderers; an unknown name lists the known ones."""
    channels: list[str] = field(default_factory=list)
    """For files of other renderers: buffer=layer, if a layer is not found by its name; buffer=none leaves one out."""
    layer: str | None = None
    """For files of other renderers: the view layer or part to look for buffers in."""


@dataclass
class Render:
    """Render animated clips with Mitsuba: noisy indirect light, references, G-buffers and motion vectors.

    Run the same command again to resume an interrupted rendering.

    For example:

    jaxdn render fruit --seeds 0 1 2 -o data/train

    jaxdn render kitchen/scene.xml --animation kitchen.json -o data/kitchen

    jaxdn render kitchen/scene.xml --tour --seeds 0-49 -o data/train
    """

    scene: tyro.conf.Positional[str]
    """A family (fruit, robot, pinkroom, mobile, edge, dash, glitter, parlour) or the path of a Mitsuba scene (.xml)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Output folder; it gets one folder per clip."""
    animation: Path | None = None
    """Animation file (JSON: camera keys, rigid keys, inserted shapes) for a scene file."""
    tour: bool = False
    """Make an animation of the scene file for each seed: camera path, moving things, materials and lights."""
    seeds: list[str] = field(default_factory=lambda: ["0"])
    """One clip of the family, or tour of the scene, for each seed, such as 3 or 0-49; else the seeds of the noise."""
    width: int = 128
    height: int = 128
    frames: int = 10
    reference_spp: int = 256
    """Samples per pixel of the reference; 0 for none."""
    layers: list[int] = field(default_factory=lambda: [1])
    """Independent noisy layers, in samples per pixel (powers of two)."""
    draws: int = 0
    """Further noisy images of one sample each, of indirect and of direct light: training draws from them."""
    light: Literal["indirect", "reflected"] = "indirect"
    """Light with noise: indirect light, with direct light beside it, or all that is reflected, with its shadows."""
    jitter: bool = False
    """Rays go through another point of the pixels in every frame, for taa; references are means over the pixels."""
    max_depth: int | None = None
    """Path length (1 emission, 2 direct, 3 one bounce of indirect light ...); default: as the scene needs."""
    effects: str = "auto"
    """auto: the effects that the scene has (see `jaxdn inspect`); all: every effect; or names separated by commas."""
    denoiser: str | None = None
    """Render only what this denoiser (svgf, relax ...) reads, or several (svgf,relax); default: all but what few
    denoisers read."""
    workers: int | None = None
    """Number of processes; default: the number of cores."""


@dataclass
class Pack:
    """Pack random windows of rendered clips into one compact file, to train on a machine that clips are too large for.

    For example:

    jaxdn pack data/train -o train.pack --mib 50 --crop 64 --draws 2

    jaxdn train train.pack -o runs/mine
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file to write."""
    mib: float
    """Largest size of the file in MiB."""
    crop: int = 64
    """Width and height of the windows, in pixels; training may crop them further."""
    frames: int = 10
    """Consecutive frames of a window; of a shorter clip all."""
    draws: int = 2
    """Single samples to store of each window; 0: the layer of one sample instead."""
    buffers: list[str] | None = None
    """Buffers to store; default: those that every variant of ntd is trained with."""
    indirect_only: bool = False
    """Leave out direct and emitted light: smaller, but nothing can be trained on all light."""
    without_half: bool = False
    """Leave out the reference's first half: a quarter smaller, but no inputs of half the reference's samples."""
    seed: int = 0
    """Of the choice of windows."""


@dataclass
class Train:
    """Train a learned method on rendered clips; run it again to resume.

    For example:

    jaxdn train data/train --validation data/validation -o runs/mine --steps 3000

    jaxdn train data/train -o runs/traditional --variant ntd-large --set motion=traditional
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips, or files of `jaxdn pack`, to train on."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The run's folder: checkpoints, log, and finally weights.safetensors with its JSON."""
    validation: Path | None = None
    """Folder of held-out clips, or a file of `jaxdn pack`, for validation, used whole."""
    method: str = "ntd"
    """Method to train; an unknown name lists the available ones."""
    variant: str | None = None
    """One of the method's variants (ntd-large, ntd-small); default: the fastest."""
    set: list[str] = field(default_factory=list)
    """Options of the method as option=value, such as motion=traditional preset=parity; an unknown name lists them."""
    start: str | None = None
    """Shipped weights or a .safetensors file to continue from; default: new weights."""
    recipe: str | None = None
    """One of the method's recipes; for ntd: usual, without-occlusion, paper, paper-without-occlusion, parity. Default:
    the usual one."""
    steps: int | None = None
    """Parameter updates, more than before to go on with a finished run; default, as for the next seven options: as in
    the recipe."""
    batch: int | None = None
    """Clips per update."""
    crop: int | None = None
    """Width and height of the crops that are trained on, in pixels."""
    frames: int | None = None
    """Consecutive frames of a clip per update."""
    learning_rate: float | None = None
    """Peak learning rate."""
    rematerialize: bool | None = None
    """Recompute in the backward pass: a quarter of the memory for 1.1 to 1.4 times the time."""
    seed: int | None = None
    """Seed of the initial weights and of the data's order."""
    spp: list[int] | None = None
    """Samples per pixel of the noisy input; of several numbers, each clip of a batch has one at random."""
    time_limit: float | None = None
    """Minutes after which training stops and writes its weights; the same command goes on from there."""
    implementation: str = "auto"
    """Engine for convolutions: reference (XLA), onednn (CPU; the extra onednn); auto: the fastest available."""


@dataclass
class Denoise:
    """Denoise clips, or EXR files of any renderer; everything else in the files stays as it is.

    For example:

    jaxdn denoise data/test/fruit-7 -o out --preview

    jaxdn denoise "shots/*.exr" -o out --method ntd-small --motion-convention cycles --channels albedo=DiffCol

    jaxdn denoise shots/a shots/b -o out --frames 10-40 --skip-existing
    """

    clips: tyro.conf.Positional[list[Path]]
    """Folders of clips, folders of EXR files, quoted patterns of EXR files, or files; one or several."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the denoised frames; for a single frame, also the name of an EXR file."""
    method: str = "steady-balanced"
    """Shipped weights (steady-balanced, ntd-large, ntd-small), a filter (svgf, asvgf, taa), or the path of a
    .safetensors file."""
    bidirectional: bool = False
    """Denoise backwards too, from the last frame to the first, and blend both passes: twice the time, and the first
    frames are as good as the last."""
    safe: bool = True
    """Measure the noise, and keep of the frames what is none of it: clean ones come back as they are."""
    frames: list[str] = field(default_factory=list)
    """Numbers of the frames to denoise, such as 7 or 10-40; frames before them are read for their history."""
    skip_existing: bool = False
    """Leave out frames whose result is there already."""
    only_beauty: bool = False
    """Of EXR files of other renderers, write the denoised beauty and its alpha alone, without the other layers."""
    aovs: Literal["keep", "additive"] = "keep"
    """Other layers of light in such files: keep them as they are, or (additive) denoise those that are parts of the
    beauty so that they still add up to it."""
    spp: int = 1
    """Samples per pixel to take from the clip's layers."""
    preview: bool = False
    """Write a PNG next to every EXR."""
    motion_convention: str | None = None
    """Convention of the motion vectors in files of other renderers; an unknown name lists the known ones."""
    channels: list[str] = field(default_factory=list)
    """For files of other renderers: buffer=layer, if a layer is not found by its name; buffer=none leaves one out."""
    layer: str | None = None
    """For files of other renderers: the view layer or part to look for buffers in."""
    implementation: str = "auto"
    """Engine for the network: reference (XLA), onnxruntime (CPU; the extra onnx); auto: the fastest available."""


@dataclass
class Compare:
    """Score methods on clips with references; writes metrics.json and report.html, and prints a table.

    For example:

    jaxdn compare data/test -o runs/compare --methods noisy svgf ntd-small steady-balanced
    """

    clips: _PATH
    """Folder of clips, or one clip."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    methods: list[str] = field(default_factory=list)
    """noisy, filters, shipped weights or .safetensors files; default: all that come with the package."""
    spp: int = 1
    """Samples per pixel to take from the clips' layers."""


@dataclass
class Doctor:
    """Show what this machine computes, denoises, trains and renders with, and what to install for more."""


def _folder(out: Path) -> Path:
    """``-o`` of a command that writes into a folder. Raises ValueError for what is plainly the name of a file."""
    if out.suffix.lower() in (".exr", ".png", ".safetensors", ".json", ".html"):
        raise ValueError(f"-o {out}: expected a folder, got the name of a file.")
    return out


def _inspect(options: Inspect) -> None:
    from jaxdn.commands.inspect import inspect_to_terminal

    inspect_to_terminal(
        options.scene,
        animation=options.animation,
        denoiser=options.denoiser,
        width=options.width,
        height=options.height,
        frames=options.frames,
        as_json=options.json,
        **_naming(options),
    )


def _naming(options: Inspect | Denoise) -> dict[str, Any]:
    """How the buffers of other renderers' files are found."""
    from jaxdn.options import parse

    return {
        "motion_convention": options.motion_convention,
        "channels": parse(options.channels, option="--channels", words=True),
        "layer": options.layer,
    }


def _render(options: Render) -> None:
    from jaxdn.commands.render import render
    from jaxdn.options import numbers

    render(
        options.scene,
        _folder(options.out),
        animation=options.animation,
        tours=options.tour,
        seeds=numbers(options.seeds, "--seeds"),
        width=options.width,
        height=options.height,
        frames=options.frames,
        reference_spp=options.reference_spp,
        layers=options.layers,
        draws=options.draws,
        light=options.light,
        jitter=options.jitter,
        max_depth=options.max_depth,
        effects=options.effects,
        denoiser=options.denoiser,
        workers=options.workers,
    )


def _pack(options: Pack) -> None:
    from jaxdn.clips.pack import USUAL, Packing
    from jaxdn.commands.pack import pack

    packing = Packing(
        crop=options.crop,
        frames=options.frames,
        draws=options.draws,
        buffers=USUAL if options.buffers is None else tuple(options.buffers),
        direct=not options.indirect_only,
        half=not options.without_half,
        seed=options.seed,
    )
    with Console(stderr=True).status("reading ...") as status:
        packed = pack(
            options.clips,
            options.out,
            packing,
            mib=options.mib,
            say=lambda windows, size: status.update(f"{windows} windows, {size / 2**20:.1f} MiB"),
        )
    print(f"{options.out}: {packed.windows} windows of {packed.clips} clips, {packed.size / 2**20:.1f} MiB")


def _train(options: Train) -> None:
    from jaxdn.commands.train import train
    from jaxdn.methods.table import method_named
    from jaxdn.options import parse

    method = method_named(options.method)
    recipe = method.recipe_named(options.recipe)
    changed = {name: getattr(options, name) for name in recipe._fields if hasattr(options, name)}
    changed["spp"] = None if options.spp is None else tuple(options.spp)
    recipe = recipe._replace(**{name: value for name, value in changed.items() if value is not None})
    path = train(
        method,
        recipe,
        options.clips,
        _folder(options.out),
        options={**method.variant_named(options.variant), **parse(options.set)},
        start=options.start,
        validation=[options.validation] if options.validation else [],
        implementation=options.implementation,
        time_limit=None if options.time_limit is None else 60 * options.time_limit,
    )
    print(f"{path}: denoise with `jaxdn denoise CLIP -o OUT --method {path}`")


def _denoise(options: Denoise) -> None:
    from jaxdn.commands.denoise import Settings, candidate_on, denoise_files
    from jaxdn.commands.progress import reporter
    from jaxdn.commands.sources import show_sources
    from jaxdn.options import numbers

    naming = _naming(options)
    method, engine = candidate_on(options.method, options.implementation)
    reads = frozenset[str]() if method.denoiser is None else method.denoiser.reads
    settings = Settings(
        spp=options.spp,
        frames=numbers(options.frames, "--frames") if options.frames else None,
        skip_existing=options.skip_existing,
        only_beauty=options.only_beauty,
        aovs=options.aovs,
        preview=options.preview,
        bidirectional=options.bidirectional,
        safe=options.safe,
        **naming,
    )
    with reporter(options.method) as report:
        written = denoise_files(
            options.clips,
            options.out,
            method,
            settings,
            begin=lambda work: show_sources(work.source, reads=reads, **naming),
            say=report.say,
            log=report.log,
        )
    compiled = f"{written.programs} program{'s' * (written.programs != 1)} compiled"
    print(f"{len(written.files)} frames denoised by {options.method} in {options.out} ({engine}, {compiled})")
    if written.repaired:
        print(f"{written.repaired} values were not usable numbers (NaN, infinite, negative ...) and were repaired")


def _compare(options: Compare) -> None:
    from jaxdn.candidates import all_names, candidate
    from jaxdn.clips import find_clips
    from jaxdn.commands.compare import compare
    from jaxdn.report import text_table, write_report

    out, names = _folder(options.out), options.methods or all_names()
    methods = [candidate(name) for name in names]
    folders = find_clips(options.clips)
    settings = {"clips": len(folders), "spp": options.spp, "methods": names}
    results = compare(methods, folders, title=f"Denoisers on {options.clips.name}", settings=settings, spp=options.spp)
    page = write_report(results, out)
    print(text_table(results))
    print(f"report: {page}")


def _doctor(options: Doctor) -> None:
    from jaxdn.commands.doctor import doctor

    doctor()


def main(arguments: list[str] | None = None) -> None:
    """Parse the command line and run one command; errors a user can fix end with one message and exit code 2."""
    # XLA raises its errors; what it logs besides is an alarm at every compilation of more than two minutes.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    run: dict[type, Any] = {
        Inspect: _inspect,
        Render: _render,
        Pack: _pack,
        Train: _train,
        Denoise: _denoise,
        Compare: _compare,
        Doctor: _doctor,
    }
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"jaxdn {jaxdn.__version__}")
        return
    options = tyro.cli(
        Inspect | Render | Pack | Train | Denoise | Compare | Doctor,
        prog="jaxdn",
        description="Remove Monte Carlo noise from path-traced animations. --version prints the version.",
        args=arguments,
    )
    with plain_errors():
        run[type(options)](options)


if __name__ == "__main__":
    main(sys.argv[1:])
