"""`make papers`: which of the papers' claims on learned temporal denoising hold here?

    python -m experiments.papers.learned [--rooms rooms/*/scene.xml] [--scenes scenes]      # resumable

Renders clips with layers of 1 to 32 samples, trains every network that a table needs with the same number of updates,
in its small size but for table 3 of Hasselgren et al., and scores them on clips of seeds and
scenes that none has seen. Writes ``runs/papers/report.md`` with every table and claim, ``report.html``, every method's
image, maps of samples, and in ``measurements`` each table in the format of docs/results.
"""

from collections.abc import Callable
from pathlib import Path

import tyro

from experiments.papers.learned import (
    ntasd_budgets,
    ntasd_holdout,
    ntasd_methods,
    ntasd_sizes,
    rae_methods,
    zeng_ablation,
    zeng_changes,
    zeng_methods,
)
from experiments.papers.learned.curves import make_table, measure_curves
from experiments.papers.learned.maps import asks, save_maps
from experiments.papers.learned.record import record_curves, record_table
from experiments.papers.learned.scores import Table, claims_table, read
from experiments.papers.learned.small_lights import render_small_lights
from experiments.papers.learned.stages import BUDGET, Clips, Settings, ready, render_families
from experiments.papers.preintegration import file_name, save_pictures
from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.compare import compare
from jaxdn.evaluation.report import Results, write_report
from jaxdn.runtime.atomic_files import write_json

TABLES = {
    file.__name__.rpartition(".")[2]: file.TABLE
    for file in (
        ntasd_methods,
        ntasd_budgets,
        ntasd_holdout,
        ntasd_sizes,
        rae_methods,
        zeng_methods,
        zeng_ablation,
        zeng_changes,
    )
}
RENDERERS: dict[Clips, Callable[[Settings], list[Path]]] = {
    "families": render_families,
    "small lights": render_small_lights,
}
"""What a table is tested on -> how it is rendered, with what is trained on; the folders of the former."""
REFERENCES = ("noisy", "svgf", "steady-balanced")
"""In every run, whatever the tables."""


def tables_named(names: list[str]) -> list[Table]:
    """All for no names. Raises ValueError for an unknown one."""
    if unknown := [name for name in names if name not in TABLES]:
        raise ValueError(f"--tables: expected some of {', '.join(TABLES)}, got {', '.join(unknown)}.")
    return [TABLES[name] for name in names or TABLES]


def sections(tables: list[Table], found: Results) -> list[str]:
    """Each table with its claims, as Markdown."""
    return [f"## {one.heading}\n\n{one.text(found)}\n\n{claims_table(one.claims(found))}" for one in tables]


def main(settings: Settings) -> None:
    """Render, train, compare, report. Raises ValueError for an unknown table."""
    tables = tables_named(settings.tables)
    folders = {clips: render(settings) for clips, render in RENDERERS.items() if clips in {one.clips for one in tables}}
    how = ", as published" if settings.as_published else ""
    text = [f"# The papers' tables after {settings.steps} updates{how}"]
    text += ["Means over the test clips without the noise of the references, but for FLIP, L1 and SSIM."]
    for clips, spp in sorted({(one.clips, one.spp) for one in tables}, key=lambda pair: (pair[0], -pair[1])):
        alike = [one for one in tables if (one.clips, one.spp) == (clips, spp)]
        text += compared(alike, folders[clips], settings, out_of(clips, spp, settings))
    if settings.curve_frames:
        curves = measure_curves(settings)
        write_json(settings.results / "curves.json", curves)
        write_json(settings.measurements / "quality-papers-curves.json", record_curves(curves, settings))
        text.append(f"## Zeng et al. 2021, figure 8: {settings.curve_frames} frames\n\n{make_table(curves)}")
    report = settings.results / "report.md"
    report.write_text("\n\n".join(text) + "\n")
    print("\n\n".join(text))
    print(f"\nreport: {report}")


def out_of(clips: Clips, spp: int, settings: Settings) -> Path:
    """The folder of the report on these clips at so many samples a pixel."""
    place = settings.results if clips == "families" else settings.results / file_name(clips)
    return place if spp == BUDGET else place / f"{spp}-samples"


def compared(tables: list[Table], folders: list[Path], settings: Settings, out: Path) -> list[str]:
    """The sections of tables of the same clips and samples a pixel; writes their report and pictures to ``out``."""
    spp = tables[0].spp
    rows = dict.fromkeys([*REFERENCES, *(row for one in tables for row in one.rows)])
    methods = [ready(row, settings) for row in rows]
    title = f"The papers' tables after {settings.steps} updates, {spp} samples a pixel"
    found = compare(methods, folders, title=title, settings={"clips": len(folders)}, spp=spp, read=read)
    write_report(found, out)
    save_pictures(found, out / "pictures")
    for name, one in TABLES.items():
        if one in tables:
            file = settings.measurements / f"quality-papers-{name.replace('_', '-')}.json"
            write_json(file, record_table(one, found, settings))
    text = sections(tables, found)
    if asking := [one for one in methods if asks(one)]:
        maps = save_maps(asking, folders, out / "pictures")
        text.append(f"## Where samples go: rank correlation with the noise, fewest to most\n\n{maps}")
    return text


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
