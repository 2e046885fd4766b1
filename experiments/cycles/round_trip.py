"""Files of each kind that Blender writes: rendered, denoised by jaxdn, and opened again by Blender and OpenImageIO.

    .venv-cycles/bin/python -m experiments.cycles.round_trip runs/round-trip --python .venv/bin/python
    python -m experiments.cycles.round_trip_table runs/round-trip -o runs

Of each kind (:mod:`experiments.cycles.round_trip_kinds`), three frames of a cube, a ball and two lamps are rendered
with Cycles. ``jaxdn inspect``, ``jaxdn inspect --overlay`` and ``jaxdn denoise`` run with the Python that is given.
Then the compositor of this Blender reads every result and writes what its image node gives; that is compared with the
file. OpenImageIO, as it comes with Blender, reads all pixels of all parts. The last frame is compared with one of many
samples. A row a kind says what was found, and the rows are written as ``round-trip.json``, each as soon as it is
there: a run goes on where it was.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from experiments.cycles.reference import compress, decibels
from experiments.cycles.round_trip_kinds import KINDS, ROOT, build_scene, render, render_reference
from experiments.cycles.round_trip_readers import beauty_of, compare, composite, open_with_oiio, read
from jaxdn.runtime.atomic_files import write_json

SEAM = 2
"""Columns at each side of a panorama that count as its seam."""


def run_jaxdn(python: str, *arguments: str | Path) -> tuple[float, str]:
    """Seconds of a command of jaxdn, and what it said. Raises ValueError unless it ends with 0."""
    start = time.perf_counter()
    done = subprocess.run(
        [python, "-m", "jaxdn", *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    seconds = time.perf_counter() - start
    if done.returncode:
        raise ValueError(f"jaxdn {arguments[0]} ended with {done.returncode}\n{(done.stdout + done.stderr)[-2000:]}")
    return seconds, done.stdout


def run_kind(name: str, out: Path, options: argparse.Namespace) -> dict[str, Any]:
    """A row: sizes, times, and what each program found. Raises where anything is not as it has to be."""
    kind, folder = KINDS[name], out / name.replace(", ", "-").replace(" ", "-")
    shutil.rmtree(folder, ignore_errors=True)
    noisy, denoised, page = folder / "noisy", folder / "denoised", folder / "page"
    build_scene(kind, options.size, options.samples)
    names = render(kind, noisy)
    method = ("--method", options.method) if options.method else ()
    inspecting, _ = run_jaxdn(options.python, "inspect", noisy)
    showing, _ = run_jaxdn(options.python, "inspect", noisy, "--overlay", page)
    denoising, _ = run_jaxdn(options.python, "denoise", noisy, "-o", denoised, *method, *kind.options)
    results, sources = [denoised / each for each in names], [noisy / each for each in names]
    row: dict[str, Any] = {"kind": name, "frames": len(results)}
    row |= compare(sources[-1], results[-1], kind.light, lossy=kind.lossy)
    row |= {"bytes in": _mean_size(sources), "bytes out": _mean_size(results)}
    row |= {"inspect, s": inspecting, "denoise, s": denoising, "frame, s": _seconds_a_frame(results)}
    row |= {"page, s": showing, "page, bytes": sum(path.stat().st_size for path in page.rglob("*") if path.is_file())}
    row["parts"] = len({part for part, _ in read(results[-1])})
    row["OpenImageIO"] = None if kind.recompress else max(open_with_oiio(path) for path in results)
    render_reference(kind, folder / "reference", options.reference)
    truth = beauty_of(folder / "reference" / names[-1])
    row |= {"noisy": _psnr(beauty_of(sources[-1]), truth), "denoised": _psnr(beauty_of(results[-1]), truth)}
    if name == "panorama":
        run_jaxdn(options.python, "denoise", noisy, "-o", folder / "open", *method)
        images = {"noisy": sources[-1], "wrapped": results[-1], "open": folder / "open" / names[-1]}
        row["seam"] = {way: measure_seam(beauty_of(path), truth) for way, path in images.items()}
    if name == "light groups":
        row["sum minus beauty"] = sum_minus_beauty(results[-1], kind.light)
    if name == "transparent":
        row["alpha"] = _alpha_errors(sources[-1], results[-1], folder / "reference" / names[-1])
    seen = [] if kind.recompress else [(composite(path, folder / "seen.exr"), beauty_of(path)) for path in results]
    row["Blender"] = max((float(np.abs(image - wanted).max()) for image, wanted in seen), default=None)
    if name == "cryptomatte":
        given, kept = (composite(path, folder / "matte.exr", "Cube") for path in (sources[-1], results[-1]))
        if not (np.array_equal(given, kept) and 0.01 < kept.mean() < 0.9):
            raise ValueError(f"{name}: expected the matte of the noisy file, got another one")
    if not options.keep:
        shutil.rmtree(folder)
    return row


def _mean_size(paths: list[Path]) -> int:
    return sum(path.stat().st_size for path in paths) // len(paths)


def _seconds_a_frame(results: list[Path]) -> float:
    """Between the first result and the last: nothing is started or compiled any more."""
    written = sorted(path.stat().st_mtime for path in results)
    return (written[-1] - written[0]) / (len(written) - 1)


def _psnr(image: np.ndarray, truth: np.ndarray) -> float:
    """Of x / (1 + x), in dB."""
    return decibels(float(np.mean((compress(image) - compress(truth)) ** 2)))


def measure_seam(image: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """PSNR in the columns where both edges of a panorama meet and in all others, and the step between the edges.

    The step is the RMS of the difference between the errors of the last and of the first column: neighbours' errors
    are alike where a filter looked across, and independent where it did not.
    """
    errors = compress(image) - compress(truth)
    edge = np.zeros(errors.shape[1], bool)
    edge[:SEAM] = edge[-SEAM:] = True
    step, inside = errors[:, 0] - errors[:, -1], np.diff(errors, axis=1)
    return {
        "at the seam": decibels(float(np.mean(errors[:, edge] ** 2))),
        "elsewhere": decibels(float(np.mean(errors[:, ~edge] ** 2))),
        "step": float(np.sqrt(np.mean(step**2))),
        "step elsewhere": float(np.sqrt(np.mean(inside**2))),
    }


def sum_minus_beauty(path: Path, groups: Any) -> float:
    """RMS of the light groups' sum minus the beauty, of green, by the mean of the beauty."""
    pixels = {name: values.astype(np.float64) for (_, name), values in read(path).items()}
    total = sum(next(v for name, v in pixels.items() if name.endswith(f"_{group}.G")) for group in groups)
    whole = next(v for name, v in pixels.items() if name.endswith("Combined.G"))
    return float(np.sqrt(np.mean((total - whole) ** 2)) / whole.mean())


def _alpha_errors(noisy: Path, denoised: Path, reference: Path) -> dict[str, float]:
    """RMS of alpha against the reference's, as rendered and as denoised."""
    noisy_alpha, alpha, truth = (
        next(v for (_, name), v in read(path).items() if name.endswith("Combined.A"))
        for path in (noisy, denoised, reference)
    )
    return {
        "noisy": float(np.sqrt(np.mean((noisy_alpha - truth) ** 2))),
        "denoised": float(np.sqrt(np.mean((alpha - truth) ** 2))),
    }


def main() -> int:
    """Print a row for each kind, and write the table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.cycles.round_trip", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the frames and the table")
    parser.add_argument("--python", default="python", help="Python that has jaxdn")
    parser.add_argument("--method", default="", help="as of jaxdn denoise")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS), help="kinds of files")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90), help="width and height in pixels")
    parser.add_argument("--samples", type=int, default=1, help="a pixel")
    parser.add_argument("--reference", type=int, default=256, help="samples a pixel of what the last frame should be")
    parser.add_argument("--keep", action="store_true", help="keep the frames")
    options = parser.parse_args()
    own = Path(bpy.utils.resource_path("LOCAL"))
    sys.path += [str(place) for place in own.glob("python/lib/python*/site-packages")]  # OpenImageIO's
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "round-trip.json"
    rows = json.loads(table.read_text("utf-8"))["rows"] if table.exists() else []
    settings = {
        "blender": bpy.app.version_string,
        "size": options.size,
        "samples": options.samples,
        "reference": options.reference,
        "method": options.method or "its default",
    }
    failed = 0
    for kind in options.kinds:
        if any(row["kind"] == kind for row in rows):
            continue
        try:
            rows.append(run_kind(kind, options.out, options))
        except (ValueError, RuntimeError, OSError) as error:
            failed += 1
            print(f"FAILED {kind}: {error}", flush=True)
            continue
        print("RESULT", rows[-1], flush=True)
        write_json(table, {"settings": settings, "rows": rows})
    return 1 if failed else 0


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # bpy sometimes crashes while the interpreter ends, when all files are written
