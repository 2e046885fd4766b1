"""Savings from leaving out absent effects: rendering, disk, denoising and memory, ``auto`` compared with ``all``.

    python -m experiments.speed.effects            # a minute or two per scene on two cores
    python -m experiments.speed.effects --quick    # fewer samples, three scenes

For each scene of :mod:`experiments.speed.small_rooms` that is listed here the same clip is rendered both ways and
denoised frame by frame, each program once per round. It prints the ratios auto / all of one run; ``runs/effects.json``
has the raw numbers too. The path length is measured for ``auto`` and the scene's own for ``all``; the column ``same
depth`` is the rendering time of ``auto`` at the scene's own path length, which separates the two savings.
"""

import functools
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import jaxdn
from experiments.speed.small_rooms import CASES, FRAMES, Case
from jaxdn import effects
from jaxdn.clips import read_frames
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame, only
from jaxdn.denoiser import Params
from jaxdn.effects import Plan
from jaxdn.render import use_variant
from jaxdn.render.clip import render_clip
from jaxdn.render.path_depth import measure_depth
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings

SCENES = (
    "static grey box",
    "static textured box",
    "a ball: rough metal",
    "moving: camera",
    "moving: ball",
    "moving: ball, later",
    "moving: behind the camera",
    "only emission",
    "a room in which everything moves",
)
ROUNDS = 3


@dataclass
class Settings:
    """Measure what the planner saves, scene by scene."""

    quick: bool = False
    """Three scenes, few samples."""
    size: int = 128
    """Width and height in pixels."""
    reference_spp: int = 64
    out: Path = Path("runs/effects.json")


def medians(programs: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each program; the programs run interleaved, so that all have the same machine conditions."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(rounds):
        for name, program in programs.items():
            start = time.perf_counter()
            program()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in times.items()}


def render(case: Case, settings: Settings, folder: Path) -> tuple[dict[str, Any], dict[str, Path]]:
    """Render one scene with everything and by plan; seconds, bytes and the clips."""
    scene = SceneFile(case.write(folder))
    render_clip(
        scene, folder / "warm", RenderSettings(width=settings.size, height=settings.size, reference_spp=2), frames=1
    )

    start = time.perf_counter()
    found = effects.inspect(scene, width=settings.size, height=settings.size)
    inspected = time.perf_counter() - start
    start = time.perf_counter()
    at_own_depth = effects.plan(found)
    depth = measure_depth(scene) if at_own_depth.indirect else None
    measured = time.perf_counter() - start
    plan = at_own_depth if depth is None else effects.plan(found, max_depth=depth.max_depth)
    plans: dict[str, Plan | None] = {"all": None, "auto": plan, "same depth": at_own_depth}
    clips: dict[str, list[Path]] = {name: [] for name in plans}

    def one(name: str) -> Callable[[], Any]:
        def run() -> None:
            clips[name].append(folder / f"{name}-{len(clips[name])}")
            render_clip(
                scene,
                clips[name][-1],
                RenderSettings(
                    width=settings.size, height=settings.size, reference_spp=settings.reference_spp, plan=plans[name]
                ),
                frames=FRAMES,
            )

        return run

    seconds = medians({name: one(name) for name in plans}, 1 if settings.quick else ROUNDS)
    size = {name: sum(file.stat().st_size for file in clips[name][0].glob("*.exr")) for name in plans}
    figures = {
        "effects": list(found),
        "depth": {"all": scene.max_depth, "auto": plan.max_depth},
        "render seconds": seconds,
        "bytes": size,
        "inspection seconds": inspected,
        "depth seconds": measured,
    }
    return figures, {name: clips[name][0] for name in ("all", "auto")}


def denoise(denoiser: jaxdn.Denoiser, params: Params, clips: dict[str, Path]) -> dict[str, Any]:
    """Steady-state milliseconds per frame, bytes and operations of the step, with everything and by plan."""
    runs: dict[str, Callable[[], Any]] = {}
    figures: dict[str, Any] = {"bytes": {}, "operations": {}}
    for name, clip in clips.items():
        # The last frame: moving objects have started by then and have not stopped yet.
        frame = [jax.tree.map(jax.numpy.asarray, stored.frame) for stored in read_frames(clip)][-1]
        used: Frame = only(frame, denoiser.reads)
        state = denoiser.start(params, used)
        lowered = jax.jit(denoiser.step).lower(params, state, used)
        step = lowered.compile()
        memory: Any = step.memory_analysis()
        sizes = (memory.temp_size_in_bytes, memory.argument_size_in_bytes, memory.output_size_in_bytes)
        figures["bytes"][name] = sum(sizes)
        figures["operations"][name] = lowered.as_text().count("stablehlo.")
        for _ in range(8):  # past the first frames, whose history is short
            state, image = step(params, state, used)
        jax.block_until_ready(image)
        runs[name] = functools.partial(_wait_for, step, params, state, used)
    figures["milliseconds"] = {name: 1e3 * seconds for name, seconds in medians(runs, 15).items()}
    return figures


def _wait_for(step: Callable[..., Any], *arguments: Any) -> Any:
    return jax.block_until_ready(step(*arguments))


def main(settings: Settings) -> None:
    """Measure every scene, print the table, write the JSON."""
    print(f"rendering with Mitsuba's {use_variant()}", flush=True)
    if settings.quick:
        settings.size, settings.reference_spp = 64, 8
    svgf, network = jaxdn.denoisers.svgf(), jaxdn.denoisers.ntd(size="small")
    params = network.init(jax.random.key(0), Frame(np.zeros((16, 16, 3), np.float32)))
    results: dict[str, Any] = {}
    for name in (SCENES[0], SCENES[5], SCENES[-1]) if settings.quick else SCENES:
        print(f"{name} ...", flush=True)
        with tempfile.TemporaryDirectory() as place:
            figures, clips = render(CASES[name], settings, Path(place))
            figures["svgf"] = denoise(svgf, {}, clips)
            figures["ntd small"] = denoise(network, params, clips)
        results[name] = figures
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    settings.out.write_text(json.dumps({"settings": {**vars(settings), "out": None}, "scenes": results}, indent=1))
    show(results)
    print(f"raw numbers: {settings.out}")


def ratio(pair: dict[str, float], name: str = "auto") -> str:
    """auto / all."""
    return f"{pair[name] / pair['all']:.2f}"


def show(results: dict[str, Any]) -> None:
    """One row per scene, ratios auto / all."""
    table = Table(title="auto / all")
    kinds = ("time", "memory", "operations")
    titles = ["scene", "depth", "render", "same depth", "inspection", "disk"]
    for title in titles + [f"{method} {kind}" for method in ("svgf", "ntd small") for kind in kinds]:
        table.add_column(title, overflow="fold")
    for name, figures in results.items():
        seconds = figures["render seconds"]
        inspection = (figures["inspection seconds"] + figures["depth seconds"]) / seconds["all"]
        row = [
            name,
            f"{figures['depth']['auto']}/{figures['depth']['all']}",
            ratio(seconds),
            ratio(seconds, "same depth"),
        ]
        row += [f"{inspection:.3f}", ratio(figures["bytes"])]
        for method in ("svgf", "ntd small"):
            row += [ratio(figures[method][kind]) for kind in ("milliseconds", "bytes", "operations")]
        table.add_row(*row)
    Console(width=160).print(table)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
