"""Blurred frames denoised, against sharp frames denoised and blurred afterwards (``jaxdn denoise --reblur``).

    python -m experiments.cycles.blurred FOLDER/train FOLDER/sharp --clips blur-0000 defocus-0000 -o runs/blurred

Both have the same samples a pixel; the references are the clips' own, blurred by Cycles. ``experiments.cycles.sharp``
renders the sharp frames into ``FOLDER/sharp/CLIP``. *Only reblurred* are the sharp frames with the most samples: what
is missing there to the reference is noise, and what the filter cannot do. The table is written as
``quality-reblur.json``, in the format of docs/results; a run goes on where it was.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from experiments.cycles import reference as references
from experiments.cycles.compare import read_beauty
from experiments.cycles.score import score
from experiments.measurement import describe_measurement
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.atomic_files import write_json
from jaxdn.sequence.optics import Optics
from jaxdn.sequence.run import denoise_files, select_backend
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import NOISY, choose_model


@dataclass
class Options:
    """Compare what becomes of blurred and of sharp frames of one clip."""

    blurred: Annotated[Path, tyro.conf.Positional]
    """Folder of clips of the kinds blur and defocus."""
    sharp: Annotated[Path, tyro.conf.Positional]
    """Folder of the same clips' sharp frames."""
    clips: list[str]
    """Names of clips."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("runs/blurred")
    """Denoised frames, and the table."""
    method: str = ""
    """As of ``jaxdn denoise --method``; default: what that takes for files of other renderers."""
    spp: list[int] = field(default_factory=lambda: [4, 16])
    """Sample counts."""


def main(options: Options) -> int:
    """Print a row for each clip, sample count and way, and write the table."""
    method = options.method or choose_model(through_centres=False).name
    rows = []
    for clip in options.clips:
        blurred, sharp = options.blurred / clip, options.sharp / clip
        most = max(int(folder.name.partition("spp")[0]) for folder in sharp.glob("*spp-0"))
        for spp in options.spp:
            for name, frames, model, reblur in (
                ("blurred, noisy", blurred, NOISY, None),
                ("blurred, denoised", blurred, method, None),
                ("sharp, denoised", sharp, method, None),
                ("sharp, denoised, reblurred", sharp, method, Optics()),
            ):
                rows.append([clip, spp, name, *_score(frames / f"{spp}spp-0", blurred, options.out, model, reblur)])
                print(*rows[-1], sep="  ", flush=True)
        rows.append(
            [clip, most, "only reblurred", *_score(sharp / f"{most}spp-0", blurred, options.out, NOISY, Optics())]
        )
        print(*rows[-1], sep="  ", flush=True)
    write_json(options.out / "quality-reblur.json", _describe(rows, method, options))
    return 0


def _score(frames: Path, clip: Path, out: Path, method: str, reblur: Optics | None) -> list[float | None]:
    """PSNR of all, at edges, elsewhere, and of the change between two frames; FLIP."""
    way = f"{frames.parent.parent.name}-{method}{'-reblurred' if reblur else ''}"
    folder = out / clip.name / frames.name / way
    folder.mkdir(parents=True, exist_ok=True)
    settings = Settings(only_beauty=True, reblur=reblur, skip_existing=True)
    denoise_files([frames], folder, select_backend(method)[0], settings)
    files = sorted(folder.glob("*.exr"))
    halves = [references.read(clip / "reference" / file.name) for file in files]
    found = score([read_beauty(file) for file in files], halves, [None] * len(files)).figures()
    return [found[figure] for figure in ("psnr", "edges", "inside", "temporal", "flip")]


def _describe(rows: list[list[Any]], method: str, options: Options) -> dict[str, Any]:
    titles = ("PSNR", "at edges", "elsewhere", "temporal")
    columns: list[dict[str, Any]] = [{"name": name} for name in ("clip", "samples", "frames")]
    columns += [{"name": title, "decimals": 2} for title in titles]
    columns += [{"name": "FLIP", "decimals": 3}]
    what = (
        f"Frames of Cycles with motion blur or depth of field, against sharp frames that `jaxdn denoise --reblur` "
        f"blurs; {method}, as a user runs it. References are blurred by Cycles. PSNR of x / (1 + x) in dB, without the "
        "references' noise."
    )
    command = f"python -m experiments.cycles.blurred FOLDER/train FOLDER/sharp --clips {' '.join(options.clips)}"
    title = "Reblurred frames"
    described = describe_measurement("table", title, "Sequences", 215, command=command, what=what, rows=rows)
    return {**described, "columns": columns}


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
