"""Rooms for networks that place samples to learn in: a small lamp, deep shadows, posts that march through both.

All reflected light is rendered. Where a small lamp shines, one sample is enough for most of it; in its shadow light
comes from walls alone, and one sample says little. What the posts uncover has no history. Metres, y up.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.papers.learned.stages import COMPARED, LAYERS, REFERENCE_SPP, TEST_SEED, TRAINED, Settings, place_of
from jaxdn.planning.plan import SCORED
from jaxdn.render.clip import render_clip
from jaxdn.render.families import shapes, textures
from jaxdn.render.families.staging import (
    Stage,
    drifting_camera,
    furnish_room,
    glossy,
    matte,
    scale,
    shift,
    turn,
)
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import find_denoiser, plan_clip

FRAMES = 8
_HALF = (3.6, 2.6, 2.4)


def small_lights(seed: int) -> Stage:
    """A room of a seed: one lamp of 5 to 10 cm, boards that keep its light from half of the room, things, posts."""
    stage = Stage("small-lights", seed, max_depth=4, lamp="down")
    rng = stage.rng
    hue = rng.random()
    paper = textures.wallpaper(rng, textures.hsv(hue, 0.25, 0.85), textures.hsv(hue + 0.4, 0.45, 0.65))
    tiles = textures.tiles(rng, textures.hsv(hue + 0.1, 0.1, 0.85), textures.hsv(hue + 0.6, 0.4, 0.5), count=8)
    wall, ceiling = matte(textures.hsv(hue + 0.3, 0.1, 0.75)), matte((0.8, 0.8, 0.8))
    floor, back = matte(tiles, repeat=(3, 2)), matte(paper, repeat=(3, 1.5))
    furnish_room(stage, _HALF, floor=floor, wall=wall, back=back, ceiling=ceiling)
    side = rng.choice([-1, 1])
    _lamp(stage, side)
    _boards(stage, side)
    _things(stage, hue)
    _posts(stage, hue)
    drifting_camera(stage, (rng.uniform(-0.2, 0.2), 1.3, 2.1), (0.0, 0.9, -0.8), x_fov=60, reach=0.15)
    return stage


def _lamp(stage: Stage, side: float) -> None:
    """A disk that shines down from below the ceiling, to the ``side`` of the middle."""
    rng = stage.rng
    radius = rng.uniform(0.05, 0.1)
    place = shift(side * rng.uniform(0.9, 1.6), 2.5, rng.uniform(-0.4, 0.6)) @ turn("x", 90) @ scale(radius)
    tint = np.array([1.0, rng.uniform(0.8, 1.0), rng.uniform(0.6, 1.0)])
    stage.add("lamp", "disk", place, matte((0.0, 0.0, 0.0)), glow=20.0 * tint / radius**2)


def _boards(stage: Stage, side: float) -> None:
    """Two or three between the lamp and the other half of the room."""
    rng = stage.rng
    plaster = matte(textures.speckled(rng, textures.hsv(0.1, 0.1, 0.8), textures.hsv(0.1, 0.2, 0.6), cells=10))
    for index in range(rng.integers(2, 4)):
        depth = -1.7 + 1.2 * index + rng.uniform(-0.3, 0.3)
        height = rng.uniform(0.3, 0.9)
        place = shift(side * rng.uniform(0.3, 0.7), 2.5 - height, depth) @ turn("y", rng.uniform(-20, 20))
        stage.add(f"board_{index}", "cube", place @ scale(0.03, height, rng.uniform(0.4, 0.7)), plaster)


def _things(stage: Stage, hue: float) -> None:
    """Crates, balls and vases along the back wall, and a picture on it."""
    rng = stage.rng
    for index, x in enumerate(np.linspace(-2.2, 2.2, 6)):
        size = rng.uniform(0.22, 0.36)
        place = shift(x + rng.uniform(-0.2, 0.2), size, rng.uniform(-1.9, -0.9)) @ turn("y", rng.uniform(0, 90))
        color = textures.hsv(hue + 0.19 * index, 0.55, 0.8)
        shape: str | shapes.Mesh = ("cube", "sphere", shapes.vase(rng.uniform(0.3, 0.5), 0.2))[index % 3]
        stage.add(f"thing_{index}", shape, place @ scale(size), glossy(color, 0.4) if index % 2 else matte(color))
    canvas = textures.painting(rng, [textures.hsv(shade, 0.55, 0.85) for shade in rng.random(4)])
    stage.add("picture", "rectangle", shift(rng.uniform(-1, 1), 1.6, -2.38) @ scale(0.6, 0.45, 1), matte(canvas))


def _posts(stage: Stage, hue: float) -> None:
    """Five that march from wall to wall, a tenth to a fifth of a metre a frame."""
    rng = stage.rng
    speed, depth = rng.choice([-1, 1]) * rng.uniform(0.1, 0.2), rng.uniform(-0.5, 0.2)
    for index in range(5):
        begins = -1.8 + 0.9 * index + rng.uniform(-0.2, 0.2)

        def place(frame: float, begins: float = begins) -> np.ndarray:
            return shift(begins + speed * frame, 0.6, depth) @ scale(0.09, 0.6, 0.05)

        stage.add(f"post_{index}", "cube", place, matte(textures.hsv(hue + 0.15 * index, 0.6, 0.8)))


def render_small_lights(settings: Settings) -> list[Path]:
    """Render what is missing: four times ``--clips`` rooms to train on, and four to test on, which are returned."""
    place = place_of("small lights", settings)
    own = RenderSettings(
        settings.size, settings.size, layers=LAYERS, reference_spp=REFERENCE_SPP, light="reflected", max_depth=4
    )
    for seed in range(4 * settings.clips):
        _render(seed, place / "train", own, TRAINED)
    tested = replace(own, reference_spp=256)
    return [_render(TEST_SEED + index, place / "test", tested, COMPARED) for index in range(4)]


def _render(seed: int, place: Path, settings: RenderSettings, readers: str) -> Path:
    """The folder of the clip of a seed, rendered if it is not there.

    It has what these methods read, and what errors are reported by.
    """
    stage = small_lights(seed)
    reader = find_denoiser(readers)
    assert reader is not None
    reader = reader._replace(reads=reader.reads | SCORED)
    planned = plan_clip(stage, settings, frames=FRAMES, denoiser=reader)
    assert planned is not None
    return render_clip(stage, place / f"{stage.name}-{seed}", replace(settings, plan=planned.plan), frames=FRAMES)
