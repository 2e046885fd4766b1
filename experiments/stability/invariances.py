"""How far does each denoiser deviate from invariances of light transport: mirrors, exposure, channels, axes?

    python -m experiments.stability.invariances CLIP ... [--methods svgf ntd-small mine.safetensors]

The difference between the output for a changed clip, changed back, and the output for the clip itself: its root mean
square relative to the image's, both tone-mapped, over all frames. The last row is the same of the difference from the
reference.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from jaxdn import color
from jaxdn.clips import find_clips, read_clip
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import BUFFERS, Clip
from jaxdn.data.training.symmetries import transform_clip, transform_image
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.rollout import denoise
from jaxdn.zoo.ready import NOISY, all_names, find_model

Image = np.ndarray


@dataclass
class Settings:
    """Measure how far denoisers deviate from invariances of light transport."""

    clips: Annotated[list[Path], tyro.conf.Positional]
    """Clips, or folders of clips."""
    methods: list[str] = field(default_factory=lambda: [name for name in all_names() if name != NOISY])
    """Filters, and names or files of weights; default: all that are shipped."""


class Invariance(NamedTuple):
    """A change of a clip, and how to change its image back."""

    change: Callable[[Clip], Clip]
    back: Callable[[Image], Image]


def light_times(factor: float) -> Invariance:
    """All light times a factor."""
    return Invariance(
        lambda clip: _each(clip, ("light", "signed"), lambda image: image * np.float32(factor)),
        lambda image: image / factor,
    )


def mirror(turns: int) -> Invariance:
    """The image mirrored left to right (0) or top to bottom (2)."""
    # A mirror is its own inverse.
    return Invariance(
        lambda clip: transform_clip(clip, flip=True, turns=turns),
        lambda image: transform_image(image, flip=True, turns=turns),
    )


def _each(clip: Clip, kinds: tuple[str, ...], change: Callable[[Image], Image]) -> Clip:
    """The clip with every buffer of these kinds changed."""
    buffers = {
        name: change(np.asarray(image))
        for name, image in clip.frames._asdict().items()
        if image is not None and BUFFERS[name].kind in kinds
    }
    return clip._replace(frames=clip.frames._replace(**buffers))


def _channels(clip: Clip) -> Clip:
    colors = ("light", "fraction")
    return _each(clip, colors, lambda image: image[..., [2, 0, 1]] if image.shape[-1] == 3 else image)


_AXES = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], np.float32)

INVARIANCES = {
    "mirrored left to right": mirror(0),
    "mirrored top to bottom": mirror(2),
    "red, green and blue exchanged": Invariance(_channels, lambda image: image[..., [1, 2, 0]]),
    "the world's axes exchanged": Invariance(
        lambda clip: _each(clip, ("direction",), lambda image: image @ _AXES), lambda image: image
    ),
    "a sixteenth of the light": light_times(1 / 16),
    "a quarter of the light": light_times(1 / 4),
    "four times the light": light_times(4),
    "sixteen times the light": light_times(16),
}


def measure_deviations(denoiser: Denoiser, params: Params, clip: Clip) -> dict[str, float]:
    """Invariance -> relative deviation; ``"error"`` -> the same of the difference from the reference."""
    run = jax.jit(lambda clip: denoise(denoiser, params, clip))
    bare = clip._replace(reference=None)

    def seen(image: Image) -> Image:
        return np.asarray(color.tonemap(jnp.asarray(image)), np.float64)

    image = seen(np.asarray(run(bare)))
    size = np.sqrt(np.mean(image**2))

    def difference(other: Image) -> float:
        return float(np.sqrt(np.mean((seen(other) - image) ** 2)) / size)

    found = {name: difference(one.back(np.asarray(run(one.change(bare))))) for name, one in INVARIANCES.items()}
    return found | {"error": difference(np.asarray(clip.reference))}


def main(settings: Settings) -> None:
    """Measure and print a table in the form of Markdown: means over the clips."""
    folders = [folder for place in settings.clips for folder in find_clips(place)]
    columns = {}
    for method in settings.methods:
        one = find_model(method)
        if one.denoiser is None:
            raise ValueError(f"--methods: expected denoisers, got {method}, which is the noisy image.")
        rows = [measure_deviations(one.denoiser, one.params, read_clip(folder)) for folder in folders]
        columns[one.label] = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
    print("| change | " + " | ".join(columns) + " |\n" + "|---" * (1 + len(columns)) + "|")
    for name in next(iter(columns.values())):
        print(f"| {name} | " + " | ".join(f"{100 * column[name]:.2g} %" for column in columns.values()) + " |")


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=Settings.__doc__))
