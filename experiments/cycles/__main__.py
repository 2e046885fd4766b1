"""The command line: ``python -m experiments.cycles render --set test -o FOLDER``."""

import argparse
import shutil
import subprocess
import sys
import time
from pathlib import Path

from experiments.cycles.levels import Step, steps
from experiments.cycles.record import RECORD, done, read_record
from experiments.cycles.sets import KINDS, SEEDS

ROOM = 8e9
"""Free bytes of disk below which nothing more is rendered."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; returns the exit code, 2 for what the user can mend."""
    parser = argparse.ArgumentParser(prog="python -m experiments.cycles", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    rendering = commands.add_parser("render", help="render clips; what is there already is kept")
    rendering.add_argument("--set", nargs="+", required=True, choices=list(SEEDS), help="sets, interleaved")
    rendering.add_argument("-o", "--output", type=Path, required=True, help="folder that gets a folder for each set")
    rendering.add_argument("--kinds", nargs="+", default=[], choices=KINDS, help="all that a set may have if left out")
    rendering.add_argument("--seeds", type=_seeds, default=None, help="FIRST-LAST; all of the set if left out")
    rendering.add_argument("--steps", type=int, default=None, help="stop after so many steps that are not done yet")
    rendering.add_argument("--python", default=sys.executable, help="an interpreter that has bpy")
    listing = commands.add_parser("list", help="clips that are done, their noise and their cost")
    listing.add_argument("folder", type=Path)
    given = parser.parse_args(arguments)
    try:
        if given.command == "list":
            return list_clips(given.folder)
        return render(given)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def render(given: argparse.Namespace) -> int:
    """Render all steps in order, each in a process of its own; 1 where a clip failed."""
    failed, made = 0, 0
    for step in steps(tuple(given.set), tuple(given.kinds), given.seeds):
        folder = given.output / step.clip.set / step.clip.name
        if done(folder / RECORD, step.level):
            continue
        if given.steps is not None and made >= given.steps:
            break
        given.output.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(given.output).free < ROOM:
            print(f"stopped: less than {ROOM / 1e9:.0f} GB free at {given.output}", file=sys.stderr)
            return 1
        failed += not _run(given.python, folder, step)
        made += 1
    return 1 if failed else 0


def _run(python: str, folder: Path, step: Step) -> bool:
    """Render one step; says how it went."""
    start = time.time()
    one = step.clip
    arguments = [str(folder), one.set, one.kind, str(one.seed), str(step.level)]
    ended = subprocess.run([python, "-m", "experiments.cycles.shot", *arguments], check=False)
    good = ended.returncode == 0 and done(folder / RECORD, step.level)
    record = read_record(folder / RECORD) or {}
    what = f"reference {record.get('reference_noise_db')} dB" if good else f"FAILED, exit code {ended.returncode}"
    stamp = time.strftime("%Y-%m-%d %H:%M:%S")
    print(f"{stamp} {one.set}/{one.name} level {step.level}: {what}, {time.time() - start:.0f} s", flush=True)
    return good


def list_clips(folder: Path) -> int:
    """A table of the clips in a folder of sets."""
    records = [read_record(path) or {} for path in sorted(folder.glob(f"*/*/{RECORD}"))]
    if not records:
        raise ValueError(f"expected clips in {folder}/SET/KIND-SEED/, found none; render some first")
    for record in records:
        times = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in record["seconds"].items())
        name = f"{record['set']}/{record['kind']}-{record['seed']:04d}"
        print(f"{name:28} level {record['level']}, reference {record['reference_noise_db']:.1f} dB; {times}")
    return 0


def _seeds(text: str) -> range:
    """FIRST-LAST or one number as a range."""
    first, _, last = text.partition("-")
    try:
        return range(int(first), int(last or first) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected FIRST-LAST, got {text!r}") from None


if __name__ == "__main__":
    sys.exit(main())
