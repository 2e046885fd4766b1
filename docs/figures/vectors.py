"""Pictures of motion vectors for the documentation, drawn from the buffers of a rendered clip.

    python -m docs.figures.vectors data/demo/test/mobile-200 --frame 4

Writes ``motion.webp`` (where the history of a pixel lies) and ``dual-motion.webp`` (what the previous frame becomes if
it is warped by traditional and by dual vectors). Both show references, so that no noise hides what the vectors do.
"""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import tyro
from PIL import Image

from jaxdn import color, occlusion_mask, warp
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Clip

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_ARROWS, _HIDDEN = "#d6006c", "#00e5ff"


@dataclass
class Settings:
    """Draw the motion vectors of one frame."""

    clip: Annotated[Path, tyro.conf.Positional]
    """A rendered clip with a reference, and with things that move in front of others."""
    frame: int
    """The frame whose vectors are drawn; its history is the frame before."""
    every: int = 5
    """Pixels from one arrow to the next."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("docs/images")


def light(clip: Clip, frame: int) -> np.ndarray:
    """All light of a frame's reference [H, W, 3], linear."""
    parts = (clip.reference, clip.frames.direct, clip.frames.emission)
    return np.sum([np.asarray(part)[frame] for part in parts if part is not None], axis=0)


def _picture(axes: Any, image: Any, title: str, **options: Any) -> None:
    axes.imshow(np.asarray(color.tonemap(image)) if np.ndim(image) == 3 else image, interpolation="nearest", **options)
    axes.set_title(title, fontsize=10)
    axes.set(xticks=[], yticks=[])


def arrows(clip: Clip, frame: int, every: int) -> Any:
    """The frame before and this frame, with arrows from pixels to where their history lies."""
    figure, (before, now) = plt.subplots(1, 2, figsize=(8.4, 4.5), layout="constrained")
    motion = np.asarray(clip.frames.motion)[frame]
    height, width = motion.shape[:2]
    y, x = np.mgrid[every // 2 : height : every, every // 2 : width : every]
    vectors = motion[y, x]
    _picture(before, light(clip, frame - 1), f"frame {frame - 1}: circles are the ends of the arrows")
    _picture(now, light(clip, frame), f"frame {frame}: arrows are motion vectors")
    to = np.stack([x, y], -1) + vectors
    moving = np.linalg.norm(vectors, axis=-1) > 1.0
    before.plot(*to[moving].T, "o", markersize=4.5, markerfacecolor="none", color=_ARROWS, markeredgewidth=1.3)
    units: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1}
    now.quiver(x[moving], y[moving], *vectors[moving].T, **units, color=_ARROWS, width=0.008, headwidth=3.5)
    for axes in (before, now):
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    return figure


def histories(clip: Clip, frame: int) -> Any:
    """This frame, the pixels that were hidden, and the frame before warped by both kinds of vectors."""
    figure, axes = plt.subplots(2, 2, figsize=(8.4, 8.8), layout="constrained")
    frames, previous = clip.frames, light(clip, frame - 1)
    hidden = ~np.asarray(frames.visible, bool)[frame, ..., 0]
    _picture(axes[0, 0], light(clip, frame), f"frame {frame}")
    # Where both vectors lead to nearly the same place, an outline would only be in the way.
    differ = occlusion_mask(np.asarray(frames.motion)[frame], np.asarray(frames.dual_motion)[frame], threshold=3.0)
    _picture(axes[0, 1], light(clip, frame), "cyan: hidden in the frame before")
    axes[0, 1].imshow(np.where(hidden[..., None], (0.0, 0.9, 1.0, 0.85), 0.0), interpolation="nearest")
    for place, name, title in (
        (axes[1, 0], "motion", "frame before, warped by motion: ghosts"),
        (axes[1, 1], "dual_motion", "frame before, warped by dual_motion"),
    ):
        vectors = np.asarray(getattr(frames, name))[frame]
        _picture(place, np.asarray(warp(previous.astype(np.float32), vectors)), title)
        place.contour(np.asarray(differ)[..., 0], levels=[0.5], colors=_HIDDEN, linewidths=1.0)
    return figure


def save(figure: Any, path: Path) -> None:
    """Write a figure as WebP and print its size."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110)
    plt.close(figure)
    Image.open(buffer).convert("RGB").save(path, quality=88, method=6)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


def main(settings: Settings) -> None:
    """Draw both pictures. Raises ValueError for a clip that lacks a buffer, and for a frame without history."""
    clip = read_clip(settings.clip)
    for name in ("motion", "dual_motion", "visible"):
        if getattr(clip.frames, name) is None:
            raise ValueError(f"{settings.clip}: expected a clip with {name}, got none; render one where things move.")
    count = len(clip.frames.radiance)
    if not 0 < settings.frame < count:
        raise ValueError(f"--frame: expected one that has a frame before it, 1 to {count - 1}, got {settings.frame}.")
    settings.out.mkdir(parents=True, exist_ok=True)
    save(arrows(clip, settings.frame, settings.every), settings.out / "motion.webp")
    save(histories(clip, settings.frame), settings.out / "dual-motion.webp")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
