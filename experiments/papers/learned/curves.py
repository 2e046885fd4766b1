"""Zeng et al. 2021, figure 8: errors of the methods of table 2, frame by frame, over a clip of hundreds of frames.

Clips of eight frames never reach the state in which a history has forgotten how it began.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.papers.learned import zeng_methods
from experiments.papers.learned.stages import COMPARED, LAYERS, TEST_SEED, Settings, ready
from jaxdn import color, metrics
from jaxdn.clips import read_clip
from jaxdn.core.frame import Clip
from jaxdn.denoiser.rollout import denoise
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import ClipSource, render

FAMILY = "robot"
"""What is filmed: an arm that moves all the time, so that every frame has disocclusions."""
METRICS = ("ssim", "mse")
"""Those of the figure, of tone-mapped images."""
PICTURE = "papers-curves.png"
"""Beside the measurements."""
SHOWN = (2, 5, 10, 30, 100, 300)
"""Frames, from 1, whose errors the report gives."""


def measure_curves(settings: Settings) -> dict[str, dict[str, list[float]]]:
    """Render the clip and measure every method of table 2 on it: row -> metric -> frames; draws :data:`PICTURE`.

    Raises ValueError for fewer than two frames: the figure begins with the second.
    """
    if settings.curve_frames < 2:
        raise ValueError(f"--curve-frames: expected at least 2, or 0 for none, got {settings.curve_frames}.")
    clip = read_clip(_render(settings), spp=1, layers=True)
    found = {row: measure_frames(row, clip, settings) for row in zeng_methods.ROWS}
    _draw(found, settings.measurements / PICTURE)
    return found


def measure_frames(row: str, clip: Clip, settings: Settings) -> dict[str, list[float]]:
    """Metric -> its value in each frame, from the first, of a row of table 2."""
    model = ready(row, settings)
    assert model.denoiser is not None
    images = jax.jit(partial(denoise, model.denoiser))(model.params, jax.tree.map(jnp.asarray, clip))
    pairs = color.tonemap(images), color.tonemap(jnp.asarray(clip.reference))
    return {name: np.asarray(jax.jit(jax.vmap(getattr(metrics, name)))(*pairs)).tolist() for name in METRICS}


def make_table(found: dict[str, dict[str, list[float]]]) -> str:
    """Errors of some frames, and their mean from the second on, as Markdown."""
    count = len(next(iter(found.values()))[METRICS[0]])
    shown = choose_frames(count)
    lines = ["| method | | " + " | ".join(f"frame {number}" for number in shown) + " | mean from 2 on |"]
    lines.append("|---" * (len(shown) + 3) + "|")
    for row, curves in found.items():
        for name, values in curves.items():
            cells = [values[number - 1] for number in shown] + [find_mean(values)]
            lines.append(f"| {row} | {name.upper()} | " + " | ".join(f"{value:.4f}" for value in cells) + " |")
    return "\n".join(lines)


def choose_frames(count: int) -> list[int]:
    """Those of :data:`SHOWN` that a clip of so many frames has."""
    return [number for number in SHOWN if number <= count]


def find_mean(values: Sequence[float]) -> float:
    """From the second frame on, where the figure begins."""
    return float(np.mean(values[1:]))


def _render(settings: Settings) -> Path:
    """The folder of the clip; what is there is kept."""
    own = RenderSettings(settings.size, settings.size, layers=LAYERS, reference_spp=128)
    place = settings.data / "curves" / f"{settings.curve_frames}-frames"
    source = ClipSource(FAMILY, [TEST_SEED], settings.curve_frames, denoiser=COMPARED)
    render(source, place, own, workers=settings.workers)
    return place / f"{FAMILY}-{TEST_SEED}"


def _draw(found: dict[str, dict[str, list[float]]], path: Path) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(METRICS), 1, figsize=(8, 6), sharex=True, constrained_layout=True)
    for axis, name in zip(axes, METRICS, strict=True):
        for row, curves in found.items():
            axis.plot(range(2, len(curves[name]) + 1), curves[name][1:], label=row, linewidth=1)
        axis.set_ylabel(name.upper())
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(found))
    axes[-1].set_xlabel("frame")
    figure.savefig(path)
    plt.close(figure)
