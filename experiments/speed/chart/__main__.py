"""`make chart`: error against time per frame for every way to make an image, measured on this machine.

    python -m experiments.speed.chart                          # everything, about 20 minutes on two cores
    python -m experiments.speed.chart --quick                  # the fastest of each method, one tiny clip: a minute
    python -m experiments.speed.chart --clips my/clip other    # your own clips (with layers and a reference)
    python -m experiments.speed.chart --methods taa "steady-fast, onednn-bfloat16"      # some rows alone

Writes ``runs/chart/chart.json`` (raw measurements), ``runs/chart/chart.html`` (a page that needs no network), and the
front as ``runs/chart/speed-error-against-time.json``, in the format of docs/results. Every point is saved when it is
measured: an interrupted run is resumed and measures only what is missing.
"""

import gc
import hashlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

from experiments.speed.chart import footage, summary
from experiments.speed.chart.breakdown import breakdown, subjects
from experiments.speed.chart.energy import NOT_MEASURABLE, Meter, find_meter
from experiments.speed.chart.footage import EvaluationClip, Sizes
from experiments.speed.chart.page import write_page
from experiments.speed.chart.record import Measured, record_front
from experiments.speed.chart.render_cost import FRACTIONS, measure_cost
from experiments.speed.chart.scores import MEASURES, picture, score
from experiments.speed.chart.store import Store, point_key
from experiments.speed.chart.summary import RENDERER
from experiments.speed.chart.way import Way
from experiments.speed.chart.ways import chosen, left_out, select_ways, ways
from experiments.speed.timing import measure, peak_mib
from experiments.speed.workers import WorkerError
from experiments.speed.works import files, scene
from experiments.speed.works.stages import measure_stages
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame, frame_at, written_out
from jaxdn.evaluation.compare import describe_machine
from jaxdn.evaluation.report import save_png
from jaxdn.render import scene_from_record, use_variant
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.malloc import tune_malloc
from jaxdn.zoo.weights import SHIPPED


@dataclass
class Settings:
    """Measure error and time for every way to make an image on the same clips; write runs/chart/chart.html."""

    quick: bool = False
    """The fastest weights of each method on one tiny clip, to see that everything works."""
    clips: tuple[Path, ...] = ()
    """Folders of your own clips, with noisy layers and a reference; default: two of the scene families."""
    methods: tuple[str, ...] = ()
    """Names of the rows to measure, as the page has them; default: all."""
    out: Path | None = None
    """Folder of the results; default: runs/chart, with --quick runs/chart-quick."""


class Run:
    """One run: the measurements, their storage and the messages."""

    def __init__(
        self, sizes: Sizes, clips: Sequence[EvaluationClip], folder: Path, console: Console, methods: Sequence[str] = ()
    ) -> None:
        self.sizes, self.clips, self.folder, self.console = sizes, clips, folder, console
        self.denoisers = chosen(quick=sizes.quick)
        self.ways = select_ways(ways(self.denoisers, quick=sizes.quick), methods)
        if methods:
            self.denoisers = []  # no parts of frames then
        self.labels = {each.name: (each.family, each.variant, each.reads) for each in self.ways}
        self.labels[RENDERER] = (RENDERER, "plain", "")
        self.reads = sorted({each.reads for each in self.ways})
        self.layers = footage.common_layers(clips)
        self.meter: Meter | None = find_meter()
        height, width = clips[0].reference.shape[1:3]
        self.own_size, self.timed_size = f"{width}x{height}", f"{sizes.timed[1]}x{sizes.timed[0]}"
        settings = {
            "clips": {clip.name: clip.record for clip in clips},
            "sizes": sizes._asdict(),
            "scored frames": footage.SCORED,
            "buffers read": self.reads,
            "measures": [measure.field for measure in MEASURES],
            "weights": {path.name: _digest(path) for path in sorted(SHIPPED.glob("*.safetensors"))},
        }
        self.store = Store(folder / "chart.json", settings, describe_machine())

    def say(self, line: str) -> None:
        """Print a line above the progress bars."""
        self.console.print(line, highlight=False, markup=False, soft_wrap=True)

    @contextmanager
    def counted(self, title: str, total: int) -> Iterator[Any]:
        """A bar on a terminal, lines elsewhere; the caller calls ``done(what)`` after each part."""
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), "{task.fields[what]}")
        with Progress(title, *columns, console=self.console, disable=not self.console.is_terminal) as bar:
            task = bar.add_task(title, total=total, what="")

            def done(what: str) -> None:
                bar.update(task, advance=1, what=what)
                if not self.console.is_terminal:
                    self.say(f"{title}: {what}")

            yield done

    def errors(self) -> None:
        """Score the renderer and every denoised point on every clip, and keep the picture that the page shows."""
        spps: dict[str, Sequence[float]] = {RENDERER: self.layers}
        scored = {RENDERER: None, **{each.name: each.images for each in self.ways if each.images is not None}}
        there = [*FRACTIONS, *self.layers] if 1 in self.layers else self.layers
        spps |= {each.name: [spp for spp in each.samples if spp in there] for each in self.ways}
        todo = [
            (name, spp)
            for name in scored
            for spp in spps[name]
            if not self.store.has("errors", point_key(name, spp)) or not self._pictured(point_key(name, spp))
        ]
        for clip in self.clips:
            facts = {"shown": clip.shown, "noise_floor": clip.noise_floor, "hidden": float(clip.hidden.mean())}
            self.store.put("clips", clip.name, facts)
            save_png(self._picture("reference", clip), picture(clip.reference[clip.shown]))
        with self.counted("errors", len(todo)) as done:
            for name, points in itertools.groupby(todo, key=lambda point: point[0]):
                for _, spp in points:
                    mean = self._scored(name, spp, scored[name])
                    done(f"{point_key(name, spp)}: {mean:.2f} dB")
                _forget_programs()

    def _scored(self, name: str, spp: float, denoise: Callable[[Frame], np.ndarray] | None) -> float:
        """Store a point's errors on every clip and its pictures; its mean PSNR. ``denoise``: None leaves the noise."""
        key, found = point_key(name, spp), {}
        for clip in self.clips:
            noisy = footage.noisy_frames(clip, spp)
            images = np.asarray(noisy.radiance) if denoise is None else denoise(noisy)
            found[clip.name] = score(images, clip)
            save_png(self._picture(key, clip), picture(images[clip.shown]))
        self.store.put("errors", key, found)
        return float(np.mean([scores["psnr"] for scores in found.values()]))

    def _picture(self, key: str, clip: EvaluationClip) -> Path:
        folder = self.folder / "images" / clip.name
        folder.mkdir(parents=True, exist_ok=True)
        return folder / f"{key.replace(' ', '_')}.png"

    def _pictured(self, key: str) -> bool:
        return all(self._picture(key, clip).is_file() for clip in self.clips)

    def render_costs(self) -> None:
        """Measure the cost of rendering a frame of each clip, at its own size and at the timed one."""
        use_variant()
        sizes = {self.own_size: self.clips[0].reference.shape[1:3], self.timed_size: self.sizes.timed}
        with self.counted("rendering", len(sizes) * len(self.clips)) as done:
            for size, (height, width) in sizes.items():
                costs = dict(self.store.data["render"].get(size, {}))
                for clip in self.clips:
                    if clip.name not in costs:
                        try:
                            animated = scene_from_record(clip.record.get("scene") or {})
                        except ValueError as error:
                            self.say(f"{clip.name}: its rendering cost cannot be measured: {error}")
                            continue
                        there = [name for name in Frame._fields if getattr(clip.frames, name) is not None]
                        costs[clip.name] = measure_cost(animated, height, width, self.reads, there, self.meter)
                        self.store.put("render", size, costs)
                    done(f"{clip.name} at {size}")

    def times(self) -> None:
        """Time every method, those of a group interleaved, at both sizes."""
        own = jax.tree.map(np.asarray, frame_at(self.clips[0].frames, self.clips[0].shown))
        present = [name for name in Frame._fields if getattr(own, name) is not None]
        height, width = self.sizes.timed
        made = written_out(frame_at(scene.clip(2, height, width).frames, 1), present)
        frames = {self.timed_size: made, self.own_size: own}
        groups: dict[str, list[Way]] = {}
        for way in self.ways:
            if not all(size in self.store.data["times"].get(way.name, {}) for size in frames):
                groups.setdefault(way.group, []).append(way)
        with self.counted("times", len(groups)) as done:
            for group, members in groups.items():
                found: dict[str, dict[str, Any]] = {way.name: {} for way in members}
                for size, frame in frames.items():
                    for name, timing in self._timed(members, frame, size).items():
                        found[name][size] = timing
                for name, sizes in found.items():
                    if sizes:
                        self.store.put("times", name, sizes)
                _forget_programs()
                done(group)

    def _timed(self, members: Sequence[Way], frame: Frame, size: str) -> dict[str, dict[str, Any]]:
        calls = {way.name: way.timed(frame) for way in members}
        # Small frames vary more and take little time.
        rounds = self.sizes.rounds if size == self.timed_size else 7 * self.sizes.rounds
        found: dict[str, dict[str, Any]] = {}
        for name, timing in measure(calls, rounds=rounds, budget_s=150 if size == self.timed_size else 10).items():
            found[name] = {**timing._asdict(), "peak_mib": peak_mib(calls[name])}
            if self.meter is not None:
                found[name]["joules"] = self.meter.joules(calls[name])
            self.say(f"  {name} at {size}: {timing.median_ms:.1f} ms, compiled in {timing.first_ms / 1e3:.1f} s")
        return found

    def breakdowns(self) -> None:
        """Where the time of one frame goes, of those denoisers whose parts are known."""
        height, width = self.sizes.timed
        frame = jax.tree.map(jnp.asarray, frame_at(scene.clip(2, height, width).frames, 1))
        for subject in subjects(self.denoisers, quick=self.sizes.quick):
            if not self.store.has("breakdown", subject.name):
                parts = breakdown(subject, frame, rounds=self.sizes.rounds)
                self.store.put("breakdown", subject.name, parts)
                figures = ", ".join(f"{part} {timing.median_ms:.0f} ms" for part, timing in parts.items())
                self.say(f"one frame of {subject.name}: {figures}")

    def stages(self) -> None:
        """From file to file, stage by stage, with the start of a first frame: what a person waits for."""
        if not files.measurable():
            return
        for method in (name for name in files.METHODS if name in self.labels):
            if not self.store.has("stages", method):
                try:
                    taken = measure_stages(method, self.sizes.timed)
                except (RuntimeError, WorkerError) as error:
                    self.say(f"{method} from file to file is left out: {error}")
                    continue
                self.store.put("stages", method, {"reads": self.labels[method][2], "stages": taken._asdict()})
                figures = ", ".join(f"{stage} {ms:.0f} ms" for stage, ms in taken._asdict().items())
                self.say(f"{method} from file to file: {figures}")


def _forget_programs() -> None:
    """Compiled programs are forgotten, all of this process.

    Each maps some twenty pieces of memory, and those of all methods together are more than Linux allows a process
    (65,530 by default): the next one that is compiled ends it.
    """
    jax.clear_caches()
    gc.collect()


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def main(settings: Settings) -> None:
    """Render, score, time, draw."""
    tune_malloc()  # as `jaxdn denoise` does
    began = time.monotonic()
    console = Console()
    sizes = footage.QUICK if settings.quick else footage.FULL
    folder = settings.out or Path("runs") / ("chart-quick" if settings.quick else "chart")
    places = list(settings.clips) or footage.render(sizes, Path("data") / folder.name)
    run = Run(sizes, [footage.read(place) for place in places], folder, console, settings.methods)
    missing = left_out() + ([] if run.meter else [NOT_MEASURABLE])
    run.store.put("left_out", "here", missing)
    for sentence in missing:
        run.say(sentence)
    if run.store.kept:
        run.say(f"{run.store.path}: resuming the earlier measurements with these settings on this machine")
    run.errors()
    run.render_costs()
    run.times()
    run.breakdowns()
    run.stages()
    found = summary.points(run.store.data, run.labels)
    equals = summary.equal_quality(found, summary.render_cost(run.store.data, run.timed_size))
    page = write_page(folder, run.store.data, found, equals, (run.timed_size, run.own_size))
    quality = summary.headline(found)
    front = summary.pareto(found, quality[0], run.timed_size, render=bool(run.store.data["render"]))
    measured = Measured(len(run.clips), run.own_size, run.timed_size, max(run.layers), settings.methods)
    write_json(folder / "speed-error-against-time.json", record_front(front, equals, quality, measured))
    print(summary.front_table(front, equals, run.timed_size, max(run.layers), quality))
    print(f"raw numbers: {run.store.path}\npage:        {page}  ({time.monotonic() - began:.0f} s in total)")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
