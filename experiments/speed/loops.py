"""What compiled loops save: each operation that has one, as a loop and in XLA, in turns.

    python -m experiments.speed.loops [--size 1280x720]

Memory is kept between calls as in `jaxdn denoise`. Prints a table of the medians in milliseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from experiments.speed.frames import parsed
from experiments.speed.timing import Call, measure
from jaxdn import brdf
from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.filters.catmull_rom import warp_cubic
from jaxdn.filters.reproject import reproject
from jaxdn.filters.surface_test import guides_of
from jaxdn.methods.steady import regression
from jaxdn.methods.steady.accumulation import (
    History,
    RunningMean,
    assemble_network_input,
    suppress_fireflies,
    update_mean,
)
from jaxdn.methods.steady.levels import LEVELS
from jaxdn.methods.steady.method import FEATURES, HALF_FEATURES, INITIAL, split_heads
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from jaxdn.ops.affinity.joint_upsample import joint_bilateral_upsample
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import implementation
from jaxdn.ops.scales import fill_holes, join_pixels, join_planes
from jaxdn.runtime.malloc import tune_malloc
from jaxdn.sequence.james_stein import combine

Work = tuple[Callable[..., Any], tuple[Any, ...]]
"""A function and its arguments."""


@dataclass
class Settings:
    """Time operations as compiled loops and in XLA."""

    size: str = "1280x720"
    """WIDTHxHEIGHT in pixels, multiples of 4."""
    rounds: int = 9


def works(height: int, width: int) -> dict[str, Work]:
    """Name -> what steady-high and combiner-high do in a frame, on noise: costs hardly depend on values."""
    rng = np.random.default_rng(0)
    half = height // 2, width // 2

    def noise(*shape: int) -> jax.Array:
        return jnp.asarray(rng.random(shape), jnp.float32)

    def guide(size: tuple[int, int]) -> Guide:
        return Guide(noise(12, *size), 0.1 * noise(3, *size), noise(*size), jnp.ones(13))

    image, light = noise(13, height, width), noise(height, width, 3)
    hit = jnp.broadcast_to(jnp.arange(width) > width // 10, (height, width))
    history = History(noise(height, width, 8), noise(height, width) > 0.1)
    albedo, normal, depth, roughness = (noise(height, width, count) for count in (3, 3, 1, 1))
    frame = Frame(light, albedo, normal, depth, previous_depth=depth, motion=4 * noise(height, width, 2) - 2)
    seen_light, gain = (light, history, hit), jnp.float32(1.0)
    scales = {name: jnp.float32(value) for name, value in regression.SCALES.items()}
    joined = "means", "means", "means", "means", "blocks"
    layouts, learned = ("pixels", "pixels", "blocks"), noise(*half, 20)
    return {
        "a level of the affinity filter, 13 channels, 12 features": (affinity_filter, (image, guide((height, width)))),
        "16 channels enlarged along 12 features": (
            joint_bilateral_upsample,
            (noise(16, *half), guide(half), guide((height, width))),
        ),
        "the history reprojected, 8 channels": (
            reproject,
            (history.values, guides_of(frame), frame, jnp.asarray(False)),
        ),
        "what the network sees": (
            partial(assemble_network_input, multiple=16),
            ((albedo, normal, depth, roughness), *seen_light, gain),
        ),
        "the running mean": (partial(update_mean, most=32.0), (*seen_light, noise(height, width))),
        "what is decided": (
            partial(split_heads, size=half),
            (noise(*half, 4 * (FEATURES + len(INITIAL)) + HALF_FEATURES + LEVELS + 2),),
        ),
        "the texture that a division leaves": (brdf.texture_or_hue, (albedo, light, jnp.asarray(True))),
        "single bright pixels": (
            suppress_fireflies,
            (image[:3], hit, RunningMean(image[3:6], image[6], image[7], image[:3])),
        ),
        "what light follows": (regression.regress_residual, (scales, image, image + 0.1, hit, gain)),
        "11 channels as planes": (
            lambda *arrays: join_planes(list(zip(layouts, arrays, strict=True))),
            (albedo, normal, learned),
        ),
        "15 of 18 channels of a history fetched by cubics": (
            partial(warp_cubic, channels=15),
            (noise(height, width, 18), frame.motion),
        ),
        "20 channels of blocks and means as pixels": (
            lambda *arrays: join_pixels(list(zip(joined, arrays, strict=True)), multiple=16),
            (*(noise(3, height, width) for _ in range(4)), noise(2, height, width)),
        ),
        "unknown pixels filled": (fill_holes, (light, hit[..., None])),
        "the safe blend": (combine, (light, noise(height, width, 3))),
    }


def call(work: Work, *, loops: bool) -> Call:
    """The jitted function, with or without loops."""
    function, arguments = work
    with implementation("auto" if loops else "reference"):
        program = jax.jit(lambda *given: function(*given)).lower(*arguments).compile()
    return lambda: jax.block_until_ready(program(*arguments))


def main(settings: Settings) -> None:
    """Measure, and print a table."""
    if reason := numba_call.unavailable():
        raise ValueError(f"loops: numba {reason}.")
    tune_malloc()
    height, width = parsed(settings.size)
    table = Table("operation", "XLA ms", "compiled ms", "ratio")
    for name, work in works(height, width).items():
        found = measure({kind: call(work, loops=kind == "loops") for kind in ("xla", "loops")}, rounds=settings.rounds)
        plain, fast = (found[kind].median_ms for kind in ("xla", "loops"))
        table.add_row(name, f"{plain:.1f}", f"{fast:.1f}", f"{fast / plain:.2f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    with plain_errors():
        main(tyro.cli(Settings, description=__doc__))
