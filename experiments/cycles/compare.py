"""Denoisers on clips of Cycles, as a user runs them: real files through ``jaxdn denoise``, measured frame by frame.

    python -m experiments.cycles.compare FOLDER/test -o runs/cycles-compare --methods svgf steady-balanced oidn

For every clip, sample count and method the noisy files are denoised as ``jaxdn denoise`` does it, and scored on the
frames that have references (:mod:`experiments.cycles.score`). One JSON file for each, so that a run goes on where it
was; the denoised frames stay, to be looked at. ``--table`` prints what is there. The tables are written as
``quality-cycles-test.json`` and ``quality-cycles-test-kinds.json``, in the format of docs/results.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from experiments.cycles import reference as references
from experiments.cycles.record import RECORD, read_record
from experiments.cycles.score import Scored, score
from experiments.cycles.sets import kinds_of
from experiments.measurement import describe_measurement
from jaxdn.clips import open_frames, read_exr
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json
from jaxdn.runtime.program_cache import keep_programs
from jaxdn.sequence.run import denoise_files, select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import NOISY, Model

PLAIN = "+no-safe"
"""Ending of a method that is run with ``--no-safe``."""
ALONE = "oidn"
"""The method that sees one frame at a time."""
IN_README = (
    NOISY,
    "svgf" + PLAIN,
    "steady-balanced" + PLAIN,
    "oidn" + PLAIN,
    "oidn+prefiltered" + PLAIN,
    "stabilised:oidn" + PLAIN,
    "combiner-high",
    "combiner-best" + PLAIN,
)
"""Those of the methods whose rows are in the README."""
PREFILTERED = "+prefiltered"
"""Ending of Open Image Denoise that denoises the guides first, as Blender has it do by default."""


@dataclass
class Options:
    """Compare methods on clips of Cycles."""

    folder: Annotated[Path, tyro.conf.Positional]
    """A set: the folder of clips, such as FOLDER/test."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("runs/cycles-compare")
    """Denoised frames and scores."""
    methods: list[str] = field(default_factory=lambda: [NOISY, "svgf", "steady-balanced" + PLAIN])
    """Names as of ``jaxdn denoise --method``; with ``+no-safe`` at the end, without the safe step; with
    ``+prefiltered``, of Open Image Denoise, with guides that it denoises first."""
    spp: list[int] = field(default_factory=lambda: [1, 4, 16])
    """Sample counts."""
    kinds: list[str] = field(default_factory=list)
    """Kinds of clips; default: all that are there."""
    part: str = ""
    """What of the test clips these are, such as "64 samples": it is added to the tables' titles and file names."""
    table: bool = False
    """Measure nothing: print the means of what has been measured."""


def main(options: Options) -> int:
    """Measure what is missing, and print the table."""
    keep_programs()
    clips = find_done(options.folder, options.kinds)
    if not options.table:
        for clip in clips:
            for spp in options.spp:
                for method in options.methods:
                    measure(clip, spp, method, options.out)
    rows = read_rows(options.out, [clip.name for clip in clips])
    for spp in options.spp:
        print_table([row for row in rows if row["spp"] == spp and row["method"] in options.methods], spp)
    part = "-" + options.part.replace(" ", "-") if options.part else ""
    for name, measurement in (("cycles-test", means), ("cycles-test-kinds", kinds)):
        write_json(options.out / f"quality-{name}{part}.json", measurement(rows, options))
    return 0


def find_done(folder: Path, kinds: Sequence[str]) -> list[Path]:
    """The clips of a set that have a record, of the kinds asked for. Raises ValueError where there is none."""
    records = {path.parent: read_record(path) or {} for path in sorted(folder.glob(f"*/{RECORD}"))}
    found = [clip for clip, record in records.items() if not kinds or record["kind"] in kinds]
    if not found:
        raise ValueError(f"{folder}: expected clips with a {RECORD}, found none; render some first: make cycles.")
    return found


def measure(clip: Path, spp: int, method: str, out: Path) -> None:
    """Denoise a clip's frames of one sample count and write their scores, unless that is done or they do not exist."""
    noisy, target = clip / f"{spp}spp-0", out / clip.name / f"{spp}spp" / method.replace("/", "_")
    files = sorted(noisy.glob("*.exr"))
    there = {file.stem for file in files}
    pairs = _paired(sorted(int(path.stem) for path in (clip / "reference").glob("[0-9]*.exr") if path.stem in there))
    if not pairs or target.with_suffix(".json").is_file():
        return
    images = denoise_frames(files, target, method, pairs)
    _, frames = open_frames(noisy)
    motion: dict[int, Any] = {number: stored.frame.motion for number, stored in enumerate(frames, 1)}
    halves = [references.read(clip / "reference" / f"{number:04d}.exr") for number in pairs]
    found = score([images[number] for number in pairs], halves, [motion[number] for number in pairs])
    row = {"clip": clip.name, "kind": (read_record(clip / RECORD) or {})["kind"], "spp": spp, "method": method}
    target.parent.mkdir(parents=True, exist_ok=True)
    write_json(target.with_suffix(".json"), {**row, "frames": pairs, **found.figures()})
    print(f"{clip.name} {spp} spp {method}: {found.figures()}", flush=True)
    jax.clear_caches()  # programs of two hundred methods are more memory maps than Linux gives a process


def denoise_frames(files: Sequence[Path], target: Path, method: str, scored: Sequence[int]) -> dict[int, np.ndarray]:
    """Number of a frame -> image, from the files that were written; ``scored`` ones alone where none needs others."""
    if method == NOISY:
        return {int(file.stem): read_beauty(file) for file in files}
    model, safe = find_method(method)
    target.mkdir(parents=True, exist_ok=True)
    settings = Settings(only_beauty=True, safe=safe, frames=scored if method.partition("+")[0] == ALONE else None)
    written = denoise_files([files[0].parent], target, model, settings)
    return {int(file.stem): read_beauty(file) for file in written.files}


def find_method(method: str) -> tuple[Model, bool]:
    """The denoiser of a name with its endings, on its fastest backend, and whether it has the safe blend."""
    options = {"auxiliary": "prefiltered"} if PREFILTERED in method else {}
    return select_backend(method.partition("+")[0], **options)[0], PLAIN not in method


def read_beauty(file: Path) -> np.ndarray:
    """The radiance [H, W, 3] of a frame."""
    channels = read_exr(file)
    names = [name for name in channels if name.rpartition(".")[2] in "RGB" and ("Combined" in name or "." not in name)]
    return np.stack([channels[name] for name in sorted(names, key=lambda name: "RGB".index(name[-1]))], axis=-1)


def _paired(numbers: Iterable[int]) -> list[int]:
    """Those of ascending numbers that come in pairs of neighbours, each in one pair."""
    found: list[int] = []
    rest = list(numbers)
    while len(rest) > 1:
        if rest[1] == rest[0] + 1:
            found += rest[:2]
            rest = rest[2:]
        else:
            rest = rest[1:]
    return found


def read_rows(out: Path, clips: Iterable[str]) -> list[dict[str, Any]]:
    """The scores that have been written of clips."""
    return [json.loads(path.read_text()) for clip in clips for path in sorted((out / clip).glob("*spp/*.json"))]


def print_table(rows: Sequence[dict[str, Any]], spp: int) -> None:
    """PSNR by kind and method, and the means of all figures."""
    methods = sorted({row["method"] for row in rows}, key=[row["method"] for row in rows].index)
    kinds = sorted({row["kind"] for row in rows})
    if not rows:
        return
    width = max(map(len, methods)) + 2
    print(f"\n{spp} samples".ljust(12) + "".join(method.rjust(width) for method in methods))
    for kind in kinds:
        values = [
            [row["psnr"] for row in rows if row["kind"] == kind and row["method"] == method] for method in methods
        ]
        print(kind.ljust(11) + "".join((f"{np.mean(of):.2f}" if of else "").rjust(width) for of in values))
    for figure in ("psnr", *Scored._fields[1:]):
        means = []
        for method in methods:
            of = [row[figure] for row in rows if row["method"] == method and row[figure] is not None]
            means.append((f"{np.mean(of):.4f}" if figure == "flip" else f"{np.mean(of):.2f}") if of else "")
        print(f"mean {figure}".ljust(14) + "".join(mean.rjust(width) for mean in means)[3:])


FIGURES = {
    "psnr": "PSNR",
    "edges": "at edges",
    "inside": "elsewhere",
    "temporal": "temporal",
    "trail": "where light just changed",
    "flip": "FLIP",
}
"""Figure -> column."""


def means(rows: Sequence[dict[str, Any]], options: Options) -> dict[str, Any]:
    """The means over all clips: a row for each sample count and method."""
    columns = [{"name": "samples"}, {"name": "method"}, *figure_columns()]
    lines = [
        [spp, f"`{method}`", *mean_figures([row for row in rows if _is(row, spp, method)])]
        for spp in options.spp
        for method in options.methods
    ]
    unseen = sorted({row["kind"] for row in rows} - set(kinds_of("train")))
    strange = (
        f"; {' and '.join(f'`{kind}`' for kind in unseen)} are kinds that nothing was trained on" if unseen else ""
    )
    what = (
        f"Means over {_count(rows)} of Blender's Cycles that nothing was trained on or chosen by (`make cycles`)"
        f"{strange}. Files through `jaxdn denoise`, all light; "
        "`+no-safe` is `--no-safe`, `+prefiltered` is Open Image Denoise as Blender runs it by default, with guides "
        "that it denoises first. Open Image Denoise is that of the quality high. PSNR of x / (1 + x) in dB, without "
        "the references' noise. *Edges* are the tenth of the pixels whose guides differ most from their neighbours'. "
        "*Temporal* is the PSNR of the change between two frames. "
        f"Scored: frames {', '.join(map(str, sorted({number for row in rows for number in row['frames']})))}."
    )
    described = {**_describe("Cycles test clips", 9, what, lines, options), "columns": columns, "group": "samples"}
    shown = [f"`{method}`" for method in IN_README if method in options.methods]
    return described if options.part else {**described, "readme": {"rows": shown}}


def kinds(rows: Sequence[dict[str, Any]], options: Options) -> dict[str, Any]:
    """PSNR: a row for each kind and sample count, a column for each method."""
    columns: list[dict[str, Any]] = [{"name": "kind"}, {"name": "samples"}]
    columns += [{"name": f"`{method}`", "decimals": 2} for method in options.methods]
    lines = [
        [
            kind,
            spp,
            *(_mean(row["psnr"] for row in rows if row["kind"] == kind and _is(row, spp, m)) for m in options.methods),
        ]
        for kind in sorted({row["kind"] for row in rows})
        for spp in options.spp
    ]
    what = f"The PSNR of the table above, by kind; {_count(rows)}."
    described = _describe("Kinds of Cycles test clips", 9.5, what, lines, options)
    return {**described, "columns": columns, "best_in_row": "higher"}


def _describe(title: str, order: float, what: str, rows: Sequence[Any], options: Options) -> dict[str, Any]:
    command = f"python -m experiments.cycles.compare {options.folder.name} --methods {' '.join(options.methods)}"
    if options.part:
        title, order = f"{title}, {options.part}", order + 0.3
        command += f" --spp {' '.join(map(str, options.spp))} --part '{options.part}'"
    return describe_measurement("table", title, "Quality", order, command=command, what=what, rows=rows)


def _is(row: dict[str, Any], spp: int, method: str) -> bool:
    return bool(row["spp"] == spp and row["method"] == method)


def figure_columns() -> list[dict[str, Any]]:
    """The columns of :func:`mean_figures` in a table of docs/results."""
    lower, higher = {"decimals": 3, "best": "lower"}, {"decimals": 2, "best": "higher"}
    return [{"name": title, **(lower if name == "flip" else higher)} for name, title in FIGURES.items()]


def mean_figures(rows: Sequence[Mapping[str, Any]]) -> list[float | None]:
    """The mean of each of :data:`FIGURES` over the clips that have it."""
    return [_mean(row[name] for row in rows) for name in FIGURES]


def _mean(values: Iterable[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return round(float(np.mean(there)), 4) if there else None


def _count(rows: Sequence[dict[str, Any]]) -> str:
    clips, kinds = ({row[name] for row in rows} for name in ("clip", "kind"))
    return f"{len(clips)} clip{'s' * (len(clips) > 1)} of {len(kinds)} kind{'s' * (len(kinds) > 1)}"


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
