"""The results of every method: at several sample counts, of indirect light and of frames as other renderers give them.

    python -m experiments.papers.results CLIP ... --spp 1 4 16 [--weights A.safetensors ...]

Filters, shipped and given weights, and Open Image Denoise frame by frame where it is installed, on clips with a
reference and both its halves, rendered with as many single samples as the largest sample count (``--draws``). For every
view and count: a table, ``runs/results/VIEW-SPP/report.html``, and every method's image of every clip as
``pictures/CLIP/METHOD.png``, to be looked at at 100 %.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import numpy as np
import tyro

from experiments.papers.preintegration import save_pictures
from jaxdn.clips import find_clips
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.data.clip.folder import read_frames
from jaxdn.evaluation.compare import EvaluationClip, compare, read_evaluation_clip
from jaxdn.evaluation.report import Results, write_report
from jaxdn.evaluation.report.results import mean_scores
from jaxdn.zoo.ready import NOISY, filter_names, find_model
from jaxdn.zoo.weights import shipped_names

Read = Callable[..., EvaluationClip]
_NOTHING: Mapping[str, Mapping[str, str]] = MappingProxyType({})


def single_samples(folder: Path, spp: int) -> Iterator[tuple[Frame, np.ndarray]]:
    """Every frame of a clip, and [H, W, 6] the mean of its first ``spp`` single samples, of indirect and direct light.

    Raises ValueError for a clip with fewer.
    """
    for stored in read_frames(folder):
        if stored.draws is None or len(stored.draws) < spp:
            raise ValueError(f"{folder}: expected at least {spp} single samples; render the clip with --draws {spp}.")
        yield stored.frame, stored.draws[:spp].mean(0, dtype=np.float32)


def indirect(folder: Path, *, spp: int, layers: bool = False) -> EvaluationClip:
    """Indirect light as rendered, its noise that of ``spp`` single samples."""
    footage = read_evaluation_clip(folder, layers=layers)
    light = np.stack([mean[..., :3] for _, mean in single_samples(folder, spp)])
    return footage._replace(clip=footage.clip._replace(frames=footage.clip.frames._replace(radiance=light)))


def beauty(folder: Path, *, spp: int, layers: bool = False) -> EvaluationClip:
    """All light in place of indirect light: direct light as noisy, and emitted light, as in other renderers' frames."""
    footage, light, rest = read_evaluation_clip(folder, layers=layers), [], []
    for frame, mean in single_samples(folder, spp):
        emission = 0.0 if frame.emission is None else frame.emission
        direct = 0.0 if frame.direct is None else frame.direct
        light.append(mean[..., :3] + mean[..., 3:] + emission)
        rest.append(direct + emission)
    added = np.stack(rest)
    frames = footage.clip.frames._replace(radiance=np.stack(light).astype(np.float32))
    clip = footage.clip._replace(frames=frames, reference=footage.clip.reference + added)
    # Both halves have the same direct light: its own noise, which is small, stays in the errors.
    halves = None if footage.halves is None else tuple(half + added for half in footage.halves)
    return footage._replace(clip=clip, halves=halves)


def without(read: Read, *names: str) -> Read:
    """The same without some buffers."""

    def reader(folder: Path, *, spp: int, layers: bool = False) -> EvaluationClip:
        footage = read(folder, spp=spp, layers=layers)
        frames = footage.clip.frames._replace(**dict.fromkeys(names))
        return footage._replace(clip=footage.clip._replace(frames=frames))

    return reader


VIEWS: dict[str, Read] = {
    "indirect": indirect,
    "beauty": beauty,
    "beauty-without-depth": without(beauty, "depth", "previous_depth", "ids", "roughness", "reflectance"),
    "beauty-without-motion": without(beauty, "motion", "dual_motion", "previous_depth", "ids", "reflectance"),
}
"""Name -> how clips are read: indirect light alone, and three kinds of foreign frames."""


@dataclass
class Settings:
    """Compare every method at several sample counts and views."""

    clips: Annotated[list[Path], tyro.conf.Positional]
    """Clips, or folders of clips."""
    spp: list[int] = field(default_factory=lambda: [1])
    """Samples per pixel."""
    views: list[str] = field(default_factory=lambda: list(VIEWS))
    """Some of: indirect, beauty, beauty-without-depth, beauty-without-motion."""
    methods: list[str] = field(default_factory=lambda: [NOISY, *filter_names(), *shipped_names()])
    """Filters and shipped weights to compare."""
    weights: list[str] = field(default_factory=list)
    """Files of weights to compare in addition to those that are shipped."""
    out: Path = Path("runs/results")
    """Folder for the reports and the pictures."""


def table(results: Results, more: Mapping[str, Mapping[str, str]] = _NOTHING) -> str:
    """One line per method, in the form of Markdown: means over the clips, without the noise of the references.

    ``more`` are further columns: title -> label of a method -> what stands there.
    """
    titles = ["method", "PSNR", "temporal PSNR", "FLIP", "L1", "hidden pixels, PSNR", *more]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for label, one in mean_scores(results).items():
        with np.errstate(divide="ignore", invalid="ignore"):
            hidden = -10 * np.log10(one.unbiased_disoccluded_mse)
        cells = [label, f"{one.unbiased_psnr:.2f}", f"{one.unbiased_temporal_psnr:.2f}", f"{one.flip:.3f}"]
        cells += [f"{one.l1:.4f}", f"{hidden:.2f}", *(column.get(label, "") for column in more.values())]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(settings: Settings) -> None:
    """Compare, report, save the pictures."""
    unknown = [name for name in settings.views if name not in VIEWS]
    if unknown:
        raise ValueError(f"--views: expected some of {', '.join(VIEWS)}, got {', '.join(unknown)}.")
    folders = [folder for place in settings.clips for folder in find_clips(place)]
    methods = [find_model(name) for name in settings.methods + settings.weights]
    for view in settings.views:
        for spp in settings.spp:
            out, title = settings.out / f"{view}-{spp}", f"{view.replace('-', ' ')}, {spp} samples per pixel"
            results = compare(methods, folders, title=title, settings={"spp": spp}, spp=spp, read=VIEWS[view])
            write_report(results, out)
            save_pictures(results, out / "pictures")
            print(f"\n{title}\n\n{table(results)}", flush=True)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
