"""The command line: ``jaxdn inspect | render | train | denoise | compare``; every verb has ``--help`` with examples."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from jaxdn.commands.errors import told_plainly

_PATH = tyro.conf.Positional[Path]


@dataclass
class Inspect:
    """Say which effects a scene has and why, what will be rendered for them, and what that saves.

    For example:

    jaxdn inspect kitchen/scene.xml --animation kitchen.json --denoiser ntd-large

    jaxdn inspect data/test/fruit-200 --json
    """

    scene: tyro.conf.Positional[str]
    """A Mitsuba scene (.xml), a family, or a finished clip: its folder, or EXR files of any renderer."""
    animation: Path | None = None
    """Animation file for a scene file."""
    denoiser: str | None = None
    """Plan for this denoiser (svgf, ntd-large ...); default: for whatever any denoiser may read."""
    width: int = 128
    height: int = 128
    frames: int | None = None
    """How many frames to look at; default: all that the animation has."""
    json: bool = False
    """Print one JSON object and nothing else: {"effects": [...], "plan": {...}, "uncertain": [...]}."""


@dataclass
class Render:
    """Render animated clips with Mitsuba: noisy indirect light, references, G-buffers and motion vectors.

    Run the same command again to continue what was interrupted.

    For example:

    jaxdn render fruit --seeds 0 1 2 -o data/train

    jaxdn render kitchen/scene.xml --animation kitchen.json -o data/kitchen
    """

    scene: tyro.conf.Positional[str]
    """A family (fruit, robot, pinkroom, mobile, edge, dash) or the path of a Mitsuba scene (.xml)."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder that gets one folder per clip."""
    animation: Path | None = None
    """Animation file (JSON: camera keys, rigid keys, inserted shapes) for a scene file."""
    seeds: list[int] = field(default_factory=lambda: [0])
    """One clip of the family for each seed; for a scene file, the seed of the noise."""
    width: int = 128
    height: int = 128
    frames: int = 10
    reference_spp: int = 256
    """Samples a pixel of the reference; 0 for none."""
    layers: list[int] = field(default_factory=lambda: [1])
    """Independent noisy layers, in samples a pixel (powers of two)."""
    max_depth: int | None = None
    """Path length (1 emission, 2 direct, 3 one bounce of indirect light ...); default: what the scene asks for."""
    effects: str = "auto"
    """auto: what the scene calls for (see `jaxdn inspect`); all: everything; or effects by name, joined by commas."""
    workers: int | None = None
    """Processes; default: the cores."""


@dataclass
class Train:
    """Train the neural temporal denoiser (ntd) on rendered clips; run it again to continue.

    For example:

    jaxdn train data/train --validation data/validation -o runs/mine --size small --steps 3000
    """

    clips: _PATH
    """Folder of clips to train on."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The run's folder: checkpoints, log, and in the end weights.safetensors with its JSON."""
    validation: Path | None = None
    """Folder of whole clips held out for validation."""
    size: Literal["large", "small"] = "small"
    motion: Literal["dual", "traditional"] = "dual"
    """Vectors that warp the history (B and C: dual, A: traditional)."""
    occlusion: bool = True
    """Let the motion-occlusion loss join in the second half (C)."""
    parity: bool = False
    """The paper's letter, in the network and in the optimiser."""
    steps: int = 2000
    batch: int = 4
    crop: int = 64
    spp: int = 1
    """Samples a pixel of the noisy input."""
    learning_rate: float | None = None
    """Peak learning rate; default: 1e-3, with --parity 1e-4 throughout."""
    rematerialize: bool = False
    """A quarter of the memory for 1.1 to 1.4 of the time."""
    implementation: Literal["auto", "reference", "onednn"] = "auto"
    """What convolves: XLA (reference) or oneDNN (CPU; the extra onednn); auto: the latter where it can."""
    seed: int = 0


@dataclass
class Denoise:
    """Denoise a clip, or EXR files of any renderer; adds direct and emitted light back where the clip has them.

    For example:

    jaxdn denoise data/test/fruit-7 -o out --preview

    jaxdn denoise "shots/*.exr" -o out --method ntd-small --motion-convention cycles
    """

    clip: tyro.conf.Positional[Path]
    """Folder of a clip, folder of EXR files, or a quoted pattern of EXR files."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the denoised frames."""
    method: str = "ntd-large"
    """Shipped weights (ntd-large, ntd-small), a filter (svgf), or the path of a .safetensors file."""
    spp: int = 1
    """Samples a pixel to take from the clip's layers."""
    preview: bool = False
    """Write a PNG beside every EXR."""
    motion_convention: str | None = None
    """For foreign files with motion vectors: whose convention they follow; an unknown one lists those known."""
    implementation: Literal["auto", "reference", "onnxruntime"] = "auto"
    """What runs the network: XLA (reference) or ONNX Runtime (CPU; the extra onnx); auto: the latter where it can."""


@dataclass
class Compare:
    """Score methods on clips with references; writes metrics.json and report.html, and says who wins.

    For example:

    jaxdn compare data/test -o runs/compare --methods noisy svgf ntd-small ntd-large
    """

    clips: _PATH
    """Folder of clips, or one clip."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the report."""
    methods: list[str] = field(default_factory=lambda: ["noisy", "svgf", "ntd-small", "ntd-large"])
    """noisy, filters, shipped weights or .safetensors files."""
    spp: int = 1


def clip_folders(folder: Path) -> list[Path]:
    """The clips in a folder (or the folder itself, if it is one); raises ValueError where there is none."""
    if (folder / "clip.json").is_file():
        return [folder]
    found = sorted(path.parent for path in folder.glob("*/clip.json"))
    if not found:
        raise ValueError(f"{folder}: expected a clip or a folder of clips, found no clip.json; render some first.")
    return found


def _family(name: str, seed: int) -> dict[str, Any]:
    return {"family": name, "seed": seed}


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
    )


def _render(options: Render) -> None:
    from jaxdn.commands.inspect import plan_clip
    from jaxdn.render import ClipJob, choose_variant, render_clips, scene_from_record
    from jaxdn.render.families import FAMILIES

    if options.scene in FAMILIES:
        records = [(f"{options.scene}-{seed}", _family(options.scene, seed)) for seed in options.seeds]
    elif options.scene.endswith(".xml"):
        from jaxdn.render.scene_file import SceneFile

        scene = SceneFile(Path(options.scene), options.animation)
        records = [(f"{scene.name}-{seed}", scene.record) for seed in options.seeds]
    else:
        raise ValueError(
            f"scene {options.scene!r}: expected a family ({', '.join(sorted(FAMILIES))}) or a Mitsuba scene (.xml)."
        )
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    jobs = []
    for (name, record), seed in zip(records, options.seeds, strict=True):
        planned = plan_clip(
            scene_from_record(record),
            effects=options.effects,
            width=options.width,
            height=options.height,
            frames=options.frames,
            max_depth=options.max_depth,
        )
        if planned is not None:
            found, made = planned
            print(f"{name}: {', '.join(found) or 'no effects'}; paths of depth {made.max_depth}", flush=True)
        job = ClipJob(
            record,
            str(options.out / name),
            width=options.width,
            height=options.height,
            frames=options.frames,
            layers=tuple(options.layers),
            reference_spp=options.reference_spp,
            max_depth=options.max_depth,
            seed=seed,
            plan=None if planned is None else planned[1].record(),
        )
        jobs.append(job)
    render_clips(jobs, workers=options.workers)


def _train(options: Train) -> None:
    from jaxdn.clips import training_batches
    from jaxdn.commands.train import fit, load_validation, training_engine
    from jaxdn.denoisers import ntd
    from jaxdn.learning.step import PARITY
    from jaxdn.recipe import Recipe
    from jaxdn.weights import save_weights

    recipe = (PARITY if options.parity else Recipe())._replace(
        steps=options.steps,
        occlusion=options.occlusion,
        batch=options.batch,
        crop=options.crop,
        rematerialize=options.rematerialize,
        seed=options.seed,
    )
    if options.learning_rate is not None:
        recipe = recipe._replace(learning_rate=options.learning_rate)
    settings: dict[str, Any] = {"size": options.size, "motion": options.motion}
    if options.parity:
        settings["preset"] = "parity"
    engine = training_engine(options.implementation)
    denoiser = ntd(**settings, implementation=engine)
    print(f"{options.out.name}: convolutions run on {engine}", flush=True)
    batches = training_batches(
        clip_folders(options.clips),
        buffers=denoiser.reads,
        batch=recipe.batch,
        crop=recipe.crop,
        frames=recipe.frames,
        seed=recipe.seed,
        spp=options.spp,
    )
    held_out = load_validation(clip_folders(options.validation), spp=options.spp) if options.validation else []
    state = fit(denoiser, recipe, batches, options.out, label=options.out.name, validation=held_out)
    path = save_weights(
        options.out / "weights.safetensors",
        state.params,
        factory="ntd",
        options=settings,
        record={"recipe": recipe._asdict(), "skipped": int(state.skipped)},
    )
    print(f"{path}: denoise with `jaxdn denoise CLIP -o OUT --method {path}`")


def _denoise(options: Denoise) -> None:
    from jaxdn.commands.denoise import denoise_files, method_on

    console = Console(stderr=True)
    method, engine = method_on(options.method, options.implementation)
    with console.status(f"{options.method}: reading ...") as status:
        written = denoise_files(
            options.clip,
            options.out,
            method,
            spp=options.spp,
            preview=options.preview,
            motion_convention=options.motion_convention,
            say=lambda done, total: status.update(f"{options.method}: frame {done} of {total}"),
        )
    compiled = f"{written.programs} program{'s' * (written.programs != 1)} compiled"
    print(f"{len(written.files)} frames denoised by {options.method} in {options.out} ({engine}, {compiled})")


def _compare(options: Compare) -> None:
    from jaxdn.commands.compare import compare, method_named
    from jaxdn.report import text_table, write_report

    methods = [method_named(name) for name in options.methods]
    folders = clip_folders(options.clips)
    settings = {"clips": len(folders), "spp": options.spp, "methods": options.methods}
    results = compare(methods, folders, title=f"Denoisers on {options.clips.name}", settings=settings, spp=options.spp)
    page = write_report(results, options.out)
    print(text_table(results))
    print(f"report: {page}")


def main(arguments: list[str] | None = None) -> None:
    """Parse the command line and run one verb; what a user can mend ends with one message and exit code 2."""
    verbs: dict[type, Any] = {Inspect: _inspect, Render: _render, Train: _train, Denoise: _denoise, Compare: _compare}
    options = tyro.cli(
        Inspect | Render | Train | Denoise | Compare,
        prog="jaxdn",
        description="Remove Monte Carlo noise from path-traced animations.",
        args=arguments,
    )
    with told_plainly():
        verbs[type(options)](options)


if __name__ == "__main__":
    main(sys.argv[1:])
