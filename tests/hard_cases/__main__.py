"""Run all hard cases and write the page: ``make hard-cases``.

    python -m tests.hard_cases                # runs/hard-cases/table.html and table.json
    python -m tests.hard_cases svgf relax     # these alone, without the page

Results are stored in ``runs/hard-cases/parts``, one file for each function; an interrupted run is resumed from them, as
long as neither the package nor the cases have changed. Compiled programs are cached there too, so that a run after a
fix compiles only what the fix has changed.
"""

import hashlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from jaxdn import color
from jaxdn.commands.errors import plain_errors
from jaxdn.evaluation.report.images import data_address, encode_png
from jaxdn.runtime.atomic_files import write_atomically
from tests.hard_cases import laws
from tests.hard_cases.cases import CASES
from tests.hard_cases.inputs import good
from tests.hard_cases.page import write_page
from tests.hard_cases.subjects import Subject, denoiser_subjects, operation_subjects
from tests.hard_cases.table import Row, rows

FOLDER = Path("runs/hard-cases")


def fingerprint() -> str:
    """Changes with the package, the cases, jax and the device: results of another state are not reused."""
    here = Path(__file__).parent
    package = (here.parent.parent / "jaxdn").rglob("*.py")
    sources = sorted([*(path for path in here.glob("*.py") if path.name != "page.py"), *package])
    state = [jax.__version__, jax.default_backend(), *(path.read_text() for path in sources)]
    return hashlib.sha256("\0".join(state).encode()).hexdigest()


def part(name: str, state: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result of ``make()``, read from its file if that has the same state, else computed and written."""
    path = FOLDER / "parts" / f"{name.replace(' ', '-').replace(',', '')}.json"
    if path.is_file():
        known = json.loads(path.read_text())
        if known["state"] == state:
            return known
    began = time.monotonic()
    made = {"state": state, **make()}
    made["seconds"] = time.monotonic() - began
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically({path: json.dumps(made)})
    return made


def picture(image: np.ndarray, exposure: float) -> str:
    """The data address of linear radiance [H, W, 3], exposed and encoded for a display; magenta is NaN."""
    return data_address(encode_png(np.asarray(color.tonemap(np.asarray(image, np.float32) * exposure))))


def exposure_of(case: str) -> float:
    """The exposure that maps the median of a case's reference to middle grey, so that dark and bright cases show."""
    middle = float(np.median(CASES[case].make(good()).clip.reference))
    return 0.3 / middle if middle > 0 else 1.0


def of_subject(subject: Subject) -> dict[str, Any]:
    """All rows of one subject, and its pictures."""
    images: dict[tuple[str, str], np.ndarray] = {}
    table = list(rows(CASES.values(), [subject], pictures=images))
    pictures = {case: picture(image, exposure_of(case)) for (case, _), image in images.items()}
    return {"rows": table, "pictures": pictures}


def given_pictures() -> dict[tuple[str, str], str]:
    """The inputs: the last noisy frame of each case, and its reference."""
    shown = {}
    for name, case in CASES.items():
        clip = case.make(good()).clip
        shown[name, "noisy"] = picture(clip.frames.radiance[-1], exposure_of(name))
        shown[name, "reference"] = picture(clip.reference[-1], exposure_of(name))
    return shown


@dataclass
class Settings:
    """Run the hard cases and list what is red; the exit code says whether anything is."""

    subjects: Annotated[list[str], tyro.conf.Positional] = field(default_factory=list)
    """How the names of denoisers and operations begin; default: all, and the page is written."""


def main(settings: Settings) -> int:
    """Run the cases, write the page, list what is red. Raises ValueError for a name that no subject has."""
    jax.config.update("jax_compilation_cache_dir", str(FOLDER.resolve() / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    state = fingerprint()
    everything = [*denoiser_subjects(), *operation_subjects()]
    subjects = [one for one in everything if not settings.subjects or one.name.startswith(tuple(settings.subjects))]
    if not subjects:
        names = ", ".join(one.name for one in everything)
        raise ValueError(f"subjects: expected some out of {names}, got {', '.join(settings.subjects)}.")
    table: list[Row] = []
    pictures = given_pictures()
    seconds = 0.0
    for number, subject in enumerate(subjects, 1):
        made = part(subject.name, state, lambda subject=subject: of_subject(subject))
        found = [Row(*row) for row in made["rows"]]
        table += found
        pictures |= {(case, subject.name): address for case, address in made["pictures"].items()}
        seconds += made["seconds"]
        red = sum(row.verdict == "red" for row in found)
        verdict = f"{red} of {len(found)} red" if red else f"{len(found)} cells without red"
        print(f"[{number}/{len(subjects)}] {subject.name}: {verdict}, {made['seconds']:.0f} s", flush=True)
    red = [row for row in table if row.verdict == "red"]
    for row in red:
        print(f"red: {row.subject}, {row.case}, {row.precision}, {row.direction}: {row.reason}")
    if settings.subjects:
        print(f"{len(table)} cells, {len(red)} red, {seconds / 60:.0f} min")
        return 1 if red else 0
    made = part("laws", state, lambda: {"laws": list(laws.measured())})
    seconds += made["seconds"]
    page = write_page(table, FOLDER, laws=[laws.Law(*law) for law in made["laws"]], pictures=pictures)
    print(f"{len(table)} cells, {len(red)} red, {seconds / 60:.0f} min: {page}")
    return 1 if red else 0


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Settings, description=Settings.__doc__)))
