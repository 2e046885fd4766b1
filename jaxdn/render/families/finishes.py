"""Materials and pictures drawn at random over a wide range: pale to black, grey to saturated, matte to mirror-like."""

import numpy as np

from jaxdn.render.families import textures
from jaxdn.render.families.furniture import PALETTE
from jaxdn.render.families.staging import Finish, glass, glossy, matte, metal

METALS = ((0.95, 0.93, 0.88), (0.95, 0.64, 0.54), (0.98, 0.78, 0.34), (0.56, 0.57, 0.58), (0.28, 0.27, 0.3))
"""Silver, copper, gold, steel, gunmetal."""


def any_color(rng: np.random.Generator) -> np.ndarray:
    """Pale, middling, saturated with channels near 0, or nearly black, each equally likely."""
    hue, kind = rng.random(), rng.integers(4)
    if kind == 0:
        return textures.hsv(hue, rng.uniform(0.0, 0.25), rng.uniform(0.75, 0.95))
    if kind == 1:
        return textures.hsv(hue, rng.uniform(0.2, 0.6), rng.uniform(0.45, 0.8))
    if kind == 2:
        return strong_color(rng)
    return textures.hsv(hue, rng.uniform(0.0, 0.8), rng.uniform(0.2, 0.4))


def strong_color(rng: np.random.Generator) -> np.ndarray:
    """Saturated: at least one channel is near 0."""
    return textures.hsv(rng.random(), rng.uniform(0.88, 1.0), rng.uniform(0.5, 0.98))


def deepened(image: np.ndarray) -> np.ndarray:
    """A texture of `textures`, whose lowest value is 0.02, with its darks down to 0.002."""
    return np.clip((image - 0.02) * 1.02 + 0.002, 0.002, 0.92).astype(np.float32)


def pattern(rng: np.random.Generator, colors: list[np.ndarray]) -> np.ndarray:
    """A patterned cloth or paper in three or more colours."""
    kind = rng.integers(6)
    if kind == 0:
        image = textures.plaid(rng, colors[0], colors[1], colors[2], count=int(rng.integers(2, 9)))
    elif kind == 1:
        image = textures.stripes(rng, colors, count=len(colors) * int(rng.integers(1, 6)), slant=float(rng.integers(3)))
    elif kind == 2:
        image = textures.tiles(rng, colors[0], colors[1], count=2 * int(rng.integers(1, 7)), grout=0.0)
    elif kind == 3:
        image = textures.wallpaper(rng, colors[0], colors[1], columns=int(rng.integers(2, 10)))
    elif kind == 4:
        image = textures.painting(rng, colors)
    else:
        image = textures.speckled(rng, colors[0], colors[1], cells=int(rng.integers(4, 40)), amount=0.5)
    return deepened(image)


def cloth(rng: np.random.Generator) -> Finish:
    """Matte cloth, mostly patterned in strong colours."""
    if rng.random() < 0.25:
        return matte(any_color(rng))
    colors = [strong_color(rng) if rng.random() < 0.7 else any_color(rng) for _ in range(4)]
    times = float(rng.integers(1, 4))
    return matte(pattern(rng, colors), repeat=(times, times))


def timber(rng: np.random.Generator) -> Finish:
    """Polished or raw wood, from birch to ebony."""
    hue, shade = rng.uniform(0.02, 0.11), rng.choice([0.2, 0.4, 0.65, 0.92])
    dark, light = textures.hsv(hue, 0.65, 0.6 * shade), textures.hsv(hue + 0.02, rng.uniform(0.3, 0.6), shade)
    image = deepened(textures.wood(rng, dark, light, planks=int(rng.integers(1, 7))))
    return matte(image) if rng.random() < 0.3 else glossy(image, rng.uniform(0.12, 0.5))


def plastic(rng: np.random.Generator) -> Finish:
    """Smooth to dull lacquer or plastic."""
    return glossy(any_color(rng), float(rng.choice([0.06, 0.12, 0.25, 0.5])))


def any_metal(rng: np.random.Generator) -> Finish:
    """A metal from mirror-like (roughness 0.05) to rough."""
    color = METALS[int(rng.integers(len(METALS)))]
    return metal(color, float(rng.choice([0.05, 0.1, 0.2, 0.35, 0.6])))


def hard(rng: np.random.Generator) -> Finish:
    """What furniture is made of: wood, plastic, metal or paint."""
    return (timber, timber, plastic, any_metal)[int(rng.integers(4))](rng)


def small_thing(rng: np.random.Generator) -> Finish:
    """What small solid objects are made of; a third are metal, a sixth solid glass."""
    draw = rng.random()
    if draw < 0.17:
        return glass(1 - rng.uniform(0.0, 0.5) * rng.random(3))
    if draw < 0.5:
        return any_metal(rng)
    if draw < 0.75:
        return plastic(rng)
    return glossy(pattern(rng, [strong_color(rng) for _ in range(4)]), rng.uniform(0.1, 0.5))


def wall_finish(rng: np.random.Generator) -> Finish:
    """Plaster, paper, brick, boards or paint, of any darkness."""
    kind, first = rng.integers(5), any_color(rng)
    if kind == 0:
        return matte(textures.bricks(rng, any_color(rng), textures.hsv(0.1, 0.1, 0.7)), repeat=(2, 1))
    if kind == 1:
        return matte(pattern(rng, [first, any_color(rng), strong_color(rng)]), repeat=(3, 2))
    if kind == 2:
        return timber(rng)._replace(repeat=(1, 2))
    if kind == 3:
        return glossy(first, rng.uniform(0.25, 0.6))
    pale = textures.hsv(rng.random(), rng.uniform(0, 0.3), rng.uniform(0.7, 0.95))
    return matte(textures.speckled(rng, pale, 0.85 * pale, cells=10))


def floor_finish(rng: np.random.Generator) -> Finish:
    """Boards, tiles, marble or carpet."""
    kind = rng.integers(4)
    if kind == 0:
        return timber(rng)._replace(repeat=(2, 2))
    if kind == 1:
        image = textures.tiles(rng, any_color(rng), any_color(rng), count=2 * int(rng.integers(2, 6)))
        return glossy(deepened(image), rng.uniform(0.06, 0.4), repeat=(2, 2))
    if kind == 2:
        image = textures.marble(rng, any_color(rng), any_color(rng))
        return glossy(deepened(image), rng.uniform(0.05, 0.3), repeat=(2, 2))
    return cloth(rng)._replace(repeat=(2, 2))


def picture(rng: np.random.Generator) -> np.ndarray:
    """A painting in strong colours, some of them nearly black."""
    colors = [strong_color(rng) * rng.choice([0.02, 0.3, 1.0, 1.0]) for _ in range(int(rng.integers(4, 8)))]
    kind = textures.painting if rng.random() < 0.6 else pattern
    return deepened(kind(rng, colors))


def palette(rng: np.random.Generator, hues: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
    """A `PALETTE` x `PALETTE` texture of single colours; the last row is the brown of stems."""
    shape = (PALETTE, PALETTE)
    hue, saturation, value = rng.uniform(*hues, shape), rng.uniform(0.3, 1.0, shape), rng.uniform(0.15, 0.95, shape)
    cells = np.array([textures.hsv(*each) for each in zip(hue.flat, saturation.flat, value.flat, strict=True)])
    cells = cells.reshape(PALETTE, PALETTE, 3)
    # Row 0 of an image is the v = 1 end, and the cells are counted from v = 0.
    cells[0] = textures.hsv(0.08, 0.6, 0.35)
    return cells.astype(np.float32)


def outdoors(rng: np.random.Generator, zenith: np.ndarray, horizon: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """What is seen through a window, as a radiance with mean 1: sky with clouds over a skyline and a ground."""
    size = 96
    height = np.linspace(1, -1, size)[:, None, None]
    sky = horizon + (zenith - horizon) * np.clip(height, 0, 1) ** 0.7
    clouds = np.clip(textures.noise(rng, 3, size=size) * 2.5 - rng.uniform(0.8, 1.8), 0, 1)[..., None]
    sky = sky * (1 - 0.7 * clouds) + 0.7 * clouds * horizon.max()
    relief = textures.noise(rng, 6, size=size, octaves=3)[0] if rng.random() < 0.5 else np.repeat(rng.random(12), 8)
    skyline = 0.25 * relief[None, :, None] - 0.05
    land = ground * (0.5 + textures.noise(rng, 12, size=size, octaves=2)[..., None])
    image = np.where(height < skyline, land, sky)
    return (image / image.mean()).astype(np.float32)
