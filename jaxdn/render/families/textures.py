"""Procedural textures: linear RGB reflectances [n,n,3] float32 in [0.02, 0.92], drawn from a numpy Generator.

All of them wrap around, so that a surface may repeat them without a seam. Row 0 is the v = 1 end of a surface.
"""

import colorsys

import numpy as np

Color = tuple[float, float, float] | np.ndarray


def hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """A linear reflectance from hue (turns), saturation and display value in [0, 1]."""
    return np.asarray(colorsys.hsv_to_rgb(hue % 1.0, saturation, value)) ** 2.2


def _grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates (x, y) of the texel corners, in turns."""
    y, x = np.mgrid[0:size, 0:size] / size
    return x, y


def _mix(first: Color, second: Color, share: np.ndarray) -> np.ndarray:
    share = share[..., None]
    return np.asarray(first) * (1 - share) + np.asarray(second) * share


def _finish(image: np.ndarray) -> np.ndarray:
    return np.clip(image, 0.02, 0.92).astype(np.float32)


def noise(rng: np.random.Generator, cells: int, *, size: int = 256, octaves: int = 4) -> np.ndarray:
    """Periodic value noise in [0, 1], [size, size]: `cells` lattice cells a side, halved `octaves - 1` times."""
    total = np.zeros((size, size))
    for octave in range(octaves):
        count = cells * 2**octave
        lattice = rng.random((count, count))
        position = np.arange(size) / size * count
        low = position.astype(int)
        blend = position - low
        blend = blend * blend * (3 - 2 * blend)
        low, high = low % count, (low + 1) % count
        rows = lattice[low] * (1 - blend[:, None]) + lattice[high] * blend[:, None]
        total += 0.5**octave * (rows[:, low] * (1 - blend) + rows[:, high] * blend)
    return (total - total.min()) / (total.max() - total.min())


def wood(rng: np.random.Generator, dark: Color, light: Color, *, planks: int = 5, size: int = 256) -> np.ndarray:
    """Planks along u: grain bent by noise, one tone and one shift for each plank, dark joints between them.

    Args:
      rng: random numbers.
      dark: colour of the grain.
      light: colour between the grain.
      planks: number of planks.
      size: texels per side.
    """
    x, y = _grid(size)
    plank = np.floor(y * planks).astype(int) % planks
    tone, offset = rng.uniform(0.8, 1.1, planks)[plank], rng.random(planks)[plank]
    bend = noise(rng, 3, size=size)
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * (y * 4 * planks + 2.2 * bend + offset + np.sin(2 * np.pi * x) * 0.3))
    grain = 0.75 * grain + 0.25 * noise(rng, 24, size=size, octaves=2)
    joint = (y * planks % 1.0) < 0.05
    return _finish(_mix(dark, light, grain) * tone[..., None] * np.where(joint, 0.45, 1.0)[..., None])


def tiles(
    rng: np.random.Generator, first: Color, second: Color, *, count: int = 8, grout: float = 0.06, size: int = 256
) -> np.ndarray:
    """A chequerboard of worn tiles with grout; `count` must be even to wrap.

    Args:
      rng: random numbers.
      first: colour of half of the tiles.
      second: colour of the others.
      count: tiles per side; must be even to wrap.
      grout: width of the joints, relative to a tile.
      size: texels per side.
    """
    x, y = _grid(size)
    column, row = (x * count).astype(int), (y * count).astype(int)
    wear = rng.uniform(0.8, 1.08, (count, count))[row, column] * (0.9 + 0.2 * noise(rng, 16, size=size))
    image = _mix(first, second, ((column + row) % 2).astype(float)) * wear[..., None]
    joint = ((x * count % 1) < grout) | ((y * count % 1) < grout)
    return _finish(np.where(joint[..., None], 0.3, image))


def bricks(rng: np.random.Generator, brick: Color, mortar: Color, *, rows: int = 12, size: int = 256) -> np.ndarray:
    """A running bond; `rows` must be even to wrap.

    Args:
      rng: random numbers.
      brick: colour.
      mortar: colour.
      rows: number of rows; must be even to wrap.
      size: texels per side.
    """
    x, y = _grid(size)
    row = (y * rows).astype(int)
    across = (x + 0.5 * (row % 2) / (rows // 2)) * (rows // 2)
    tone = rng.uniform(0.7, 1.15, (rows, rows // 2))[row, across.astype(int) % (rows // 2)]
    joint = ((y * rows % 1) < 0.12) | ((across % 1) < 0.07)
    surface = np.asarray(brick) * (tone * (0.85 + 0.3 * noise(rng, 32, size=size)))[..., None]
    return _finish(np.where(joint[..., None], np.asarray(mortar), surface))


def wallpaper(
    rng: np.random.Generator, ground: Color, figure: Color, *, columns: int = 6, size: int = 256
) -> np.ndarray:
    """Soft stripes with a motif (dots, diamonds or rings) in every second one.

    Args:
      rng: random numbers.
      ground: colour.
      figure: colour of motif and stripes.
      columns: number of stripe pairs.
      size: texels per side.
    """
    x, y = _grid(size)
    stripe = 0.5 + 0.5 * np.tanh(6 * np.sin(2 * np.pi * x * columns))
    dx, dy = x * columns % 1 - 0.25, y * columns % 1 - 0.5
    motif = rng.integers(3)
    distance = np.abs(dx) + 0.7 * np.abs(dy) if motif == 1 else np.hypot(dx, dy)
    drawn = np.abs(distance - 0.16) < 0.05 if motif == 2 else distance < 0.17
    share = np.where(drawn, 0.9, 0.35 * stripe)
    return _finish(_mix(ground, figure, share) * (0.93 + 0.1 * noise(rng, 6, size=size))[..., None])


def stripes(
    rng: np.random.Generator, colors: list[np.ndarray], *, count: int = 9, slant: float = 0.0, size: int = 256
) -> np.ndarray:
    """Bands across u that take the colours in turn; `count` should be a multiple of their number.

    Args:
      rng: random numbers.
      colors: used cyclically.
      count: number of bands; should be a multiple of the number of colours.
      slant: shift of the bands in u from v = 0 to 1.
      size: texels per side.
    """
    x, y = _grid(size)
    band = np.floor((x + slant * y) * count).astype(int) % len(colors)
    return _finish(np.asarray(colors)[band] * (0.88 + 0.15 * noise(rng, 12, size=size))[..., None])


def plaid(rng: np.random.Generator, ground: Color, thread: Color, accent: Color, *, count: int = 5) -> np.ndarray:
    """Woven cloth: broad bands both ways, thin accents, and a fine weave.

    Args:
      rng: random numbers.
      ground: colour.
      thread: colour of the bands.
      accent: colour of the thin lines.
      count: bands per side.
    """
    x, y = _grid(256)
    band = 0.5 * ((x * count % 1) < 0.45) + 0.5 * ((y * count % 1) < 0.45)
    thin = (np.abs(x * count % 1 - 0.72) < 0.035) | (np.abs(y * count % 1 - 0.72) < 0.035)
    weave = 0.93 + 0.07 * np.sin(2 * np.pi * 64 * x) * np.sin(2 * np.pi * 64 * y)
    image = np.where(thin[..., None], np.asarray(accent), _mix(ground, thread, band))
    return _finish(image * (weave * (0.92 + 0.12 * noise(rng, 8)))[..., None])


def marble(rng: np.random.Generator, ground: Color, vein: Color) -> np.ndarray:
    """Noise-bent veins that wrap."""
    x, y = _grid(256)
    bend = noise(rng, 4, octaves=5)
    line = 1 - np.abs(np.sin(np.pi * (2 * x + 2 * y + 3.0 * bend)))
    return _finish(_mix(ground, vein, np.clip(line, 0, 1) ** 3))


def apple_skin(rng: np.random.Generator, ripe: Color, unripe: Color) -> np.ndarray:
    """Streaks from stem to base over a blush on one side, with pale freckles."""
    x, y = _grid(256)
    streak = noise(rng, 24, octaves=2)[128][None, :] * 0.6 + noise(rng, 12) * 0.4
    blush = 0.5 + 0.5 * np.sin(2 * np.pi * x + rng.uniform(0, 6))
    share = np.clip(0.25 + 0.8 * blush + 0.9 * (streak - 0.5) - 0.5 * np.clip(np.abs(y - 0.5) * 2 - 0.7, 0, 1), 0, 1)
    freckle = np.where(noise(rng, 48, octaves=1) > 0.93, 0.25, 0.0)
    return _finish(_mix(unripe, ripe, share) * (1 + freckle)[..., None])


def speckled(
    rng: np.random.Generator, ground: Color, spot: Color, *, cells: int = 24, amount: float = 0.3
) -> np.ndarray:
    """Patches and small spots: citrus peel, stone, felt, grass.

    Args:
      rng: random numbers.
      ground: colour.
      spot: colour of the spots.
      cells: of the noise, per side.
      amount: share of spots.
    """
    spots = np.clip((noise(rng, cells, octaves=2) - (1 - amount)) * 6, 0, 1)
    return _finish(_mix(ground, spot, spots) * (0.85 + 0.25 * noise(rng, 5))[..., None])


def painting(rng: np.random.Generator, colors: list[np.ndarray]) -> np.ndarray:
    """An abstract picture: bands of noise in the colours given, with a disc and a horizon."""
    x, y = _grid(256)
    field = np.clip(noise(rng, 3, octaves=3) * 0.7 + y * 0.5, 0, 0.999)
    image = np.asarray(colors)[(field * len(colors)).astype(int)]
    sun = np.hypot(x - rng.uniform(0.25, 0.75), y - rng.uniform(0.2, 0.5)) < rng.uniform(0.08, 0.16)
    return _finish(np.where(sun[..., None], np.asarray(colors[-1]), image) * (0.85 + 0.2 * noise(rng, 40))[..., None])
