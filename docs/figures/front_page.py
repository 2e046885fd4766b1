"""The second picture of the first page: a frame of a room before and after denoising, and its reference.

    jaxdn render living-room/scene.xml --animation experiments/papers/rooms/living-room.json \\
        --frames 8 --width 320 --height 180 --reference-spp 64 --seeds 2000 --see-through -o data/rooms
    python -m docs.figures.front_page data/rooms/living-room-2000 --part 96 90 160 90

Renders the last frame once more with many samples, to ``runs/front-page``, denoises the clip by the shipped weights
that `jaxdn denoise` uses, and writes a WebP: whole frames above, a part of each, enlarged without smoothing, below.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

from jaxdn import color
from jaxdn.clips import read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Clip
from jaxdn.data.clip.folder import read_record
from jaxdn.denoiser.rollout import denoise
from jaxdn.evaluation.report.images import displayed_bytes
from jaxdn.render import ClipJob, render_clips
from jaxdn.render.settings import RenderSettings
from jaxdn.zoo.ready import DEFAULT_MODEL
from jaxdn.zoo.weights import load_weights

_GAP = 4
"""Pixels between the pictures."""
_LABEL = 22
"""Rows above the pictures for their names."""


@dataclass
class Settings:
    """Show a frame of a clip before and after denoising, and its reference."""

    clip: Annotated[Path, tyro.conf.Positional]
    """A rendered clip."""
    part: tuple[int, int, int, int]
    """X,Y,WIDTH,HEIGHT of the part that is enlarged, in pixels."""
    reference_spp: int = 1024
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = Path("docs/images/room.webp")


def clean_frame(folder: Path, frame: int, spp: int) -> Clip:
    """One frame of a clip, rendered again with many samples; one that is there already is used."""
    record = read_record(folder)
    job = ClipJob(
        {**record["scene"], "start": frame},
        str(Path("runs/front-page") / f"{folder.name}-{frame}"),
        1,
        RenderSettings(
            width=record["width"],
            height=record["height"],
            reference_spp=spp,
            max_depth=record["max_depth"],
            seed=record["seed"],
        ),
    )
    render_clips([job])
    return read_clip(job.folder)


def lit(light: Any, clip: Clip, frame: int) -> np.ndarray:
    """Display values [H, W, 3] of a frame's indirect light and of the light that clips store beside it."""
    rest = [part[frame] for part in (clip.frames.direct, clip.frames.emission) if part is not None]
    return np.asarray(color.tonemap(np.asarray(light) + np.sum(rest, axis=0)))


def sheet(pictures: dict[str, np.ndarray], part: tuple[int, int, int, int] | None) -> Image.Image:
    """The pictures [H, W, 3] side by side under their names, and below them the same part of each, enlarged."""
    rows, columns = next(iter(pictures.values())).shape[:2]
    x, y, width, height = part or (0, 0, columns, 0)
    below = columns * height // width
    end = _LABEL + rows + (_GAP + below if below else 0)
    page = Image.new("RGB", (len(pictures) * (columns + _GAP) - _GAP, end), "white")
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for number, (name, picture) in enumerate(pictures.items()):
        left, image = number * (columns + _GAP), Image.fromarray(displayed_bytes(picture))
        draw.text((left, 1), name, fill="black", font=font)
        page.paste(image, (left, _LABEL))
        if below:
            detail = image.crop((x, y, x + width, y + height)).resize((columns, below), Image.Resampling.NEAREST)
            page.paste(detail, (left, _LABEL + rows + _GAP))
    return page


def main(settings: Settings) -> None:
    """Render what is missing, denoise, draw."""
    clip = read_clip(settings.clip)
    last = len(clip.frames.radiance) - 1
    clean = clean_frame(settings.clip, last, settings.reference_spp)
    denoiser, params = load_weights(DEFAULT_MODEL)
    denoised = jax.jit(partial(denoise, denoiser))(params, clip._replace(reference=None))
    pictures = {
        "before: 1 sample per pixel": lit(clip.frames.radiance[last], clean, 0),
        f"after: {DEFAULT_MODEL}": lit(denoised[last], clean, 0),
        f"reference: {settings.reference_spp} samples": lit(clean.reference[0], clean, 0),
    }
    settings.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(pictures, settings.part).save(settings.out, quality=90, method=6)
    print(f"{settings.out}: {settings.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
