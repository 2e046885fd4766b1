"""The command line: ``jaxdn inspect | render | pack | train | denoise | compare | export | doctor``; each has
``--help``."""

import os
import sys
from dataclasses import fields
from typing import Any

import tyro
from rich.console import Console

import jaxdn
from jaxdn.commands.arguments import (
    COMMANDS,
    Compare,
    Denoise,
    Doctor,
    Export,
    Inspect,
    Pack,
    Render,
    Train,
    check_folder,
    make_channel_naming,
)
from jaxdn.commands.errors import computing_errors, end_with_reader, plain_errors
from jaxdn.runtime.garbage import put_off_collection
from jaxdn.runtime.interrupt import exit_on_interrupt
from jaxdn.runtime.program_cache import keep_programs
from jaxdn.runtime.terminal import print_any_letter
from jaxdn.runtime.turns import short_turns

_COMPUTING = (Train, Compare, Doctor)
"""Commands whose programs are worth keeping between runs, besides denoising."""

_POWERS = {"sqrt": 0.5, "linear": 1.0}
"""Of the batch, by which `--scale-rate` scales the learning rate."""


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
        naming=make_channel_naming(options),
        overlay=None if options.overlay is None else check_folder(options.overlay, "--overlay"),
    )


def _render(options: Render) -> None:
    from jaxdn.core.options import numbers
    from jaxdn.render.settings import RenderSettings
    from jaxdn.sequence.render_jobs import ClipSource, render

    given = vars(options)
    settings = RenderSettings(
        **{field.name: given[field.name] for field in fields(RenderSettings) if field.name in given}
    )
    seeds = numbers(options.seeds, "--seeds")
    if again := [seed for seed in seeds if seeds.count(seed) > 1]:
        raise ValueError(f"--seeds: expected each seed once, got {again[0]} again; each makes a clip of its own.")
    if options.threads_per_clip is not None and options.threads_per_clip < 2:
        raise ValueError(f"--threads-per-clip: expected at least 2, got {options.threads_per_clip}.")
    clips = ClipSource(
        options.scene,
        seeds,
        options.frames,
        options.animation,
        options.tour,
        options.effects,
        options.denoiser,
        options.random_optics,
    )
    out, threads = check_folder(options.out), options.threads_per_clip
    if options.scheduler is None:
        if options.frames_per_task is not None:
            raise ValueError("--frames-per-task: expected none without --scheduler; leave it out.")
        render(clips, out, settings, workers=options.workers, threads=threads)
        return
    if options.workers is not None:
        raise ValueError("--workers: expected none with --scheduler, whose workers render; leave it out.")
    from jaxdn.commands.scheduler import open_scheduler

    with open_scheduler(options.scheduler) as executor:
        render(clips, out, settings, executor=executor, threads=threads, frames_per_task=options.frames_per_task)


def _pack(options: Pack) -> None:
    from jaxdn.commands.pack import pack
    from jaxdn.core.frame import GUIDES
    from jaxdn.data.training.windows import USUAL, Packing

    usual = USUAL if options.format == "file" else tuple(GUIDES)
    if options.seed < 0:
        raise ValueError(f"--seed: expected a whole number >= 0, got {options.seed}.")
    packing = Packing(
        crop=options.crop,
        frames=options.frames,
        draws=options.draws,
        buffers=usual if options.buffers is None else tuple(options.buffers),
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
            format=options.format,
            progress=lambda windows, size: status.update(f"{windows} windows, {size / 2**20:.1f} MiB"),
        )
    print(f"{options.out}: {packed.windows} windows of {packed.clips} clips, {packed.size / 2**20:.1f} MiB")


_LESS_TO_TRAIN = "a smaller --batch or --crop, or --rematerialize"


def _train(options: Train) -> None:
    given = options.coordinator, options.processes, options.process
    if not options.distributed:
        if any(value is not None for value in given):
            raise ValueError("--coordinator, --processes, --process: expected --distributed too; give it, or none.")
        with computing_errors(_LESS_TO_TRAIN):
            _train_here(options)
        return
    from jaxdn.commands.distributed import Place, join_processes

    # Outside: which of jax's own errors it is tells whether another process is lost.
    with computing_errors(_LESS_TO_TRAIN), join_processes(Place(*given)):
        _train_here(options)


def _train_here(options: Train) -> None:
    from jaxdn.core.options import parse
    from jaxdn.methods.registry import method_named
    from jaxdn.training.processes import writes
    from jaxdn.training.train import train

    method = method_named(options.method)
    recipe = method.recipe_named(options.recipe)
    changed = {name: getattr(options, name) for name in recipe._fields if hasattr(options, name)}
    changed["spp"] = None if options.spp is None else tuple(options.spp)
    if options.scale_rate != "no":
        if options.learning_rate is not None:
            raise ValueError("--scale-rate: expected none with --learning-rate, which is the rate; leave one out.")
        changed["learning_rate"] = recipe.scale_rate(options.batch or recipe.batch, _POWERS[options.scale_rate])
    recipe = recipe._replace(**{name: value for name, value in changed.items() if value is not None})
    path = train(
        method,
        recipe,
        options.clips,
        check_folder(options.out),
        options={**method.variant_named(options.variant), **parse(options.set)},
        start=options.start,
        validation=[options.validation] if options.validation else [],
        implementation=options.implementation,
        time_limit=None if options.time_limit is None else 60 * options.time_limit,
        devices=options.devices,
    )
    if writes():
        print(f"{path}: denoise with `jaxdn denoise CLIP -o OUT --method {path}`")


def _denoise(options: Denoise) -> None:
    with put_off_collection() as begin_collection:
        keep_programs()
        from jaxdn.commands.denoise import run_denoise
        from jaxdn.data.exr.threads import exr_on_all_cores
        from jaxdn.ops.dispatch.loop_compilers import loops_compiled_apart

        with loops_compiled_apart(), exr_on_all_cores(), short_turns():
            run_denoise(options, on_start=begin_collection)


def _compare(options: Compare) -> None:
    from jaxdn.data.clip.folder import find_clips
    from jaxdn.evaluation.compare import compare
    from jaxdn.evaluation.report import text_table, write_report
    from jaxdn.zoo.ready import all_names, find_model

    if options.methods == []:
        raise ValueError("--methods: expected at least one, got none; name some, or leave --methods out for all.")
    out, names = check_folder(options.out), options.methods or all_names()
    methods = [find_model(name) for name in names]
    folders = find_clips(options.clips)
    settings = {"clips": len(folders), "spp": options.spp, "methods": names}
    title = f"Denoisers on {options.clips.name}"
    with computing_errors("other --methods, or smaller clips"):
        results = compare(methods, folders, title=title, settings=settings, spp=options.spp)
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
            check_folder(options.out),
            buffers=options.buffers,
            size=(sides[0], sides[1]) if sides else None,
            format=options.format,
            progress=lambda what: status.update(f"{what} ..."),
        )
    step = exported.step
    multiple = "" if step.multiple in (None, 1) else f"; height and width are multiples of {step.multiple}"
    for file in exported.files:
        print(f"{file}: {file.stat().st_size / 2**20:.1f} MiB")
    print(f"inputs {', '.join(step.inputs)}; outputs {', '.join(step.outputs)}{multiple}")


def _doctor(options: Doctor) -> None:
    from jaxdn.commands.doctor import doctor

    usual = vars(Doctor())
    given = [name for name, value in vars(options).items() if value != usual[name]]
    if given and not options.warm:
        raise ValueError(f"--{given[0]}: expected --warm with it; add that, or leave it out.")
    doctor()
    if options.warm:
        from jaxdn.commands.warm import warm

        warm((options.height, options.width), options.method)


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
        if isinstance(options, _COMPUTING):
            keep_programs()
        run[type(options)](options)


def program() -> None:
    """The command ``jaxdn``: :func:`main` in a process that ends with it."""
    print_any_letter()
    with end_with_reader(), exit_on_interrupt():
        main()


if __name__ == "__main__":
    program()
