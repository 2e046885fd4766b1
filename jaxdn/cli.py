"""The command line: ``jaxdn inspect | render | pack | train | denoise | compare | export | doctor``; each has
``--help``."""

import os
import sys
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

import jaxdn
from jaxdn.arguments import COMMANDS, Compare, Denoise, Doctor, Export, Inspect, Pack, Render, Train
from jaxdn.commands.errors import plain_errors
from jaxdn.commands.interrupt import end_of_process
from jaxdn.commands.pipe import end_with_reader


def _folder(out: Path) -> Path:
    """``-o`` of a command that writes into a folder. Raises ValueError for a file, and for what is plainly its name."""
    names = (".exr", ".png", ".safetensors", ".json", ".html", ".onnx", ".mlir", ".stablehlo")
    if out.is_file() or out.suffix.lower() in names:
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
    from jaxdn.clips.vectors import check_convention
    from jaxdn.options import parse

    check_convention(options.motion_convention)
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
        see_through=options.see_through,
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
    from jaxdn.heap import keep_memory
    from jaxdn.options import numbers

    if options.max_memory is None:  # else freed memory goes back to the system at once
        keep_memory()
    naming = _naming(options)
    budget = {} if options.budget is None else {"budget": options.budget}
    if (scene := _scene_of(options)) is not None:
        _denoise_scene(options, scene, budget)
        return
    method, engine = candidate_on(options.method, options.implementation, **budget)
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
        max_memory=None if options.max_memory is None else options.max_memory * 2**30,
        **naming,
    )
    with reporter(options.method) as report:
        written = denoise_files(
            options.clips,
            options.out,
            method,
            settings,
            begin=lambda work: show_sources(work.source, reads=reads, alone=len(work.shot.files) == 1, **naming),
            say=report.say,
            log=report.log,
        )
    if not written.files:
        print(f"nothing to do in {options.out}")
        return
    frames, compiled = _count(len(written.files), "frame"), _count(written.programs, "program")
    print(f"{frames} denoised by {options.method} in {options.out} ({engine}, {compiled} compiled)")
    if written.repaired:
        print(f"{_count(written.repaired, 'value')} repaired: not usable numbers (NaN, infinite, negative ...)")


def _count(number: int, noun: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {noun}{'s' * (number != 1)}"


_OF_SCENES = ("width", "height", "animation", "seed")


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


def _denoise_scene(options: Denoise, scene: str, budget: dict[str, Any]) -> None:
    from jaxdn.candidates import candidate
    from jaxdn.commands.denoise import candidate_on
    from jaxdn.commands.denoise_scene import Settings, denoise_scene
    from jaxdn.commands.progress import reporter
    from jaxdn.options import numbers

    asks = getattr(candidate(options.method).denoiser, "samples", None) is not None
    method, engine = candidate_on(options.method, options.implementation, **(budget if asks else {}))
    size = {name: value for name in ("width", "height", "seed") if (value := getattr(options, name)) is not None}
    settings = Settings(
        frames=numbers(options.frames, "--frames") if options.frames else None,
        preview=options.preview,
        **size,
        **budget,
    )
    with reporter(options.method) as report:
        written = denoise_scene(
            scene, options.animation, _folder(options.out), method, settings, say=report.say, log=report.log
        )
    frames = _count(len(written.files), "frame")
    print(f"{frames} rendered, and denoised by {options.method}, in {options.out} ({engine})")


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


def _export(options: Export) -> None:
    from jaxdn.commands.export import export

    sides = [side for side in (options.height, options.width) if side is not None]
    if len(sides) == 1:
        raise ValueError("--width, --height: expected both or neither, got one; give the other too.")
    with Console(stderr=True).status("") as status:
        exported = export(
            options.method,
            _folder(options.out),
            buffers=options.buffers,
            size=(sides[0], sides[1]) if sides else None,
            format=options.format,
            say=lambda what: status.update(f"{what} ..."),
        )
    step = exported.step
    multiple = "" if step.multiple in (None, 1) else f"; height and width are multiples of {step.multiple}"
    for file in exported.files:
        print(f"{file}: {file.stat().st_size / 2**20:.1f} MiB")
    print(f"inputs {', '.join(step.inputs)}; outputs {', '.join(step.outputs)}{multiple}")


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
        Export: _export,
        Doctor: _doctor,
    }
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        print(f"jaxdn {jaxdn.__version__}")
        return
    options = tyro.cli(
        COMMANDS,
        prog="jaxdn",
        description="Remove Monte Carlo noise from path-traced animations. --version prints the version.",
        args=arguments,
    )
    with plain_errors():
        run[type(options)](options)


def program() -> None:
    """The command ``jaxdn``: :func:`main` in a process that ends with it."""
    with end_with_reader(), end_of_process():
        main()


if __name__ == "__main__":
    program()
