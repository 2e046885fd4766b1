"""Rooms as people live in them: thin furniture, blinds and plants, strong colours, metal, glass, and any kind of light.

A seed chooses the size of the room, its openings, its furniture, its materials, its lights (daylight with a sun, lamps,
or only what comes from the room next door), what moves and how fast, and where the camera stands. `lamp` is "window"
for daylight, "down" for lamps, and "up" for light that reaches most of the room only by reflection.
"""

import numpy as np

from jaxdn.render.families import finishes, furniture, textures
from jaxdn.render.families.parlour_lights import light_by_lamps, light_next_door, light_upwards
from jaxdn.render.families.parlour_motion import film, set_in_motion
from jaxdn.render.families.parlour_things import furnish
from jaxdn.render.families.rooms import Opening, Room
from jaxdn.render.families.shapes import boxes, sheet
from jaxdn.render.families.staging import Finish, Stage, attached, glossy, matte, scale, shift, swing, turn

SKY_RADIUS, SUN_DISTANCE = 4.5, 4.2


def parlour(seed: int, *, lamp: str = "mix") -> Stage:
    """A room with thin and shiny things, a window or a door to other light, and a camera that rests or moves fast."""
    stage = Stage("parlour", seed, lamp=lamp)
    rng = stage.rng
    half = (rng.uniform(1.6, 3.1), rng.uniform(2.2, 3.3), rng.uniform(1.7, 3.3))
    kind = {"up": str(rng.choice(["torch", "next door", "ajar"])), "down": "lamps", "window": "day"}[stage.lamp]
    order = [int(side) for side in rng.permutation(4)]
    openings: dict[int, Opening] = {}
    if rng.random() < 0.55 or kind == "day":
        openings[order[0]] = _window_opening(rng, half, order[0])
    if rng.random() < 0.6 or kind in ("next door", "ajar"):
        openings[order[1]] = _door_opening(rng, half, order[1], kind)
    room = _shell(stage, half, openings)
    power = _power(stage) * room.area
    if order[0] in openings:
        _window(room, order[0], openings[order[0]], power if kind == "day" else 0.0)
    gap = _door(room, order[1], openings[order[1]], kind) if order[1] in openings else 0.0
    furnish(room)
    if kind == "torch":
        light_upwards(room, power)
    elif kind in ("next door", "ajar"):
        light_next_door(room, order[1], openings[order[1]], power, gap)
    elif kind == "lamps":
        light_by_lamps(room, power)
    film(room)
    set_in_motion(room)
    return stage


def _shell(stage: Stage, half: tuple[float, float, float], openings: dict[int, Opening]) -> Room:
    rng = stage.rng
    main, accent = finishes.wall_finish(rng), finishes.wall_finish(rng)
    walls = [main if rng.random() < 0.7 else accent for _ in range(4)]
    ceiling = matte(np.full(3, rng.uniform(0.5, 0.9))) if rng.random() < 0.8 else finishes.timber(rng)
    return Room(stage, half, openings, walls=walls, floor=finishes.floor_finish(rng), ceiling=ceiling)


def _power(stage: Stage) -> float:
    """The light for each square metre: more where walls, floor and ceiling are dark, which reflect little of it."""
    surfaces = [part.material.color.mean() for part in stage.parts.values()]
    share = float(np.mean(surfaces))
    reflected = share**2 / (1 - share)
    return float(np.clip((0.8 / reflected) ** 0.8, 0.7, 3.5) * stage.rng.uniform(0.6, 1.5))


def _window_opening(rng: np.random.Generator, half: tuple[float, float, float], side: int) -> Opening:
    across = half[2] if side % 2 else half[0]
    wide = rng.uniform(0.45, min(1.5, 0.8 * across))
    middle = rng.uniform(-1, 1) * (across - wide - 0.1)
    low = 0.06 if rng.random() < 0.3 else rng.uniform(0.4, 1.0)
    return Opening(middle, wide, low, max(low + 0.8, rng.uniform(0.72, 0.95) * half[1]))


def _door_opening(rng: np.random.Generator, half: tuple[float, float, float], side: int, kind: str) -> Opening:
    across = half[2] if side % 2 else half[0]
    wide = rng.uniform(0.38, 0.48) if kind != "next door" else rng.uniform(0.45, 0.9)
    sill = 0.004  # a hole down to the floor would leave a part of the wall without area
    return Opening(rng.uniform(-1, 1) * (across - wide - 0.1), wide, sill, rng.uniform(1.95, 2.15))


def _window(room: Room, side: int, hole: Opening, power: float) -> None:
    """Bars, what hangs before them, and the sky; `power` is 0 at night."""
    rng, stage = room.rng, room.stage
    high, wall = (hole.high - hole.low) / 2, room.walls[side]
    centre = wall.frame @ shift(hole.middle, hole.low + high, 0)
    columns, rows = int(rng.integers(1, 5)), int(rng.integers(1, 5))
    bars = furniture.window_bars(hole.half, high, columns, rows, rng.uniform(0.006, 0.025))
    paint = glossy(finishes.any_color(rng) if rng.random() < 0.4 else np.full(3, 0.8), 0.3)
    stage.add("window_bars", bars, centre, paint)
    room.claim(wall.frame, (hole.middle - hole.half, hole.low, 0.0), (hole.middle + hole.half, hole.high, 0.2))
    room.sights.append(centre[:3, 3])
    _before_window(room, centre, hole, high)
    _sky(room, centre, hole, high, power)


def _before_window(room: Room, centre: np.ndarray, hole: Opening, high: float) -> None:
    """Blinds, curtains, and a railing outside a low window."""
    rng, stage = room.rng, room.stage
    if rng.random() < 0.5:
        drop, pitch = 2 * high * rng.choice([0.4, 0.7, 1.0]), rng.uniform(0.035, 0.09)
        upright = bool(rng.random() < 0.25)
        slats = furniture.blinds(
            hole.half, drop, pitch=max(pitch, drop / 50), tilt=rng.uniform(-60, 60), upright=upright
        )
        stage.add("blinds", slats, centre @ shift(0, high - 0.02, 0.05), finishes.plastic(rng))
    if rng.random() < 0.5:
        cloth, drop = finishes.cloth(rng), min(2 * high + 0.3, hole.high - 0.03)
        for name, x in (("left", -hole.half - 0.25), ("right", hole.half - 0.15)):
            hung = furniture.curtain(rng, 0.4, drop)
            stage.add(f"curtain_{name}", hung, centre @ shift(x, high + 0.08, 0.14), cloth)
    if hole.low < 0.5 or rng.random() < 0.3:
        rail = furniture.railing(hole.half + 0.4, 0.95, rng.uniform(0.07, 0.14))
        foot = centre @ shift(0, -high - max(hole.low - 0.5, 0), -rng.uniform(0.2, 0.7))
        stage.add("railing", rail, foot, finishes.any_metal(rng))


def _sky(room: Room, centre: np.ndarray, hole: Opening, high: float, power: float) -> None:
    """A backdrop around the window that glows, and by day, unless it is overcast, the sun in front of it."""
    rng, stage = room.rng, room.stage
    area = 4 * hole.half * high
    hue = rng.uniform(0.54, 0.64)
    zenith, horizon = textures.hsv(hue, rng.uniform(0.1, 0.8), 0.9), textures.hsv(hue, rng.uniform(0, 0.3), 1.0)
    if rng.random() < 0.3:  # dusk or dawn
        zenith, horizon = textures.hsv(rng.uniform(0.6, 0.8), 0.6, 0.6), textures.hsv(rng.uniform(0.0, 0.1), 0.7, 1.0)
    ground = textures.hsv(rng.uniform(0.08, 0.4), rng.uniform(0.2, 0.7), rng.uniform(0.3, 0.7))
    sunny = bool(rng.random() < 0.65)
    share = rng.uniform(0.15, 0.5) if sunny else 1.0
    strength = 3.6 * share * power / area if power else float(rng.choice([0.02, 0.1, 0.5]))
    glow = strength * finishes.outdoors(rng, zenith, horizon, ground)
    around, level = np.linspace(-80, 80, 25)[None], np.linspace(1, -1, 3)[:, None]
    x, z = SKY_RADIUS * np.sin(np.radians(around)), -SKY_RADIUS * np.cos(np.radians(around))
    flat = np.stack(np.broadcast_arrays(x, 4.0 * level + 0.6, z), -1)
    backdrop = sheet(flat)
    stage.add("sky", backdrop._replace(uv=backdrop.uv * [1, -1] + [0, 1]), centre, matte(np.zeros(3)), glow=glow)
    rise, aside, size = rng.uniform(12, 50), rng.uniform(-50, 50), rng.uniform(0.012, 0.03)
    tint = np.array([1.0, 0.95, 0.85]) if rise > 25 else np.array([1.0, 0.7, 0.4])
    if sunny and power:
        facing = float(np.cos(np.radians(rise)) * np.cos(np.radians(aside)))
        radiance = min(2.4 * (1 - share) * power / (area * facing * size**2), 4e4)
        # The disk's own z axis looks at the window.
        place = centre @ turn("y", aside) @ turn("x", rise) @ shift(0, 0, -SUN_DISTANCE) @ scale(size * SUN_DISTANCE)
        stage.add("sun", "disk", place, matte(np.zeros(3)), glow=radiance * tint / tint.mean())


def _door(room: Room, side: int, hole: Opening, kind: str) -> float:
    """The room next door, and a leaf on its hinge that may move; the area in m^2 through which light comes in."""
    rng, stage, wall = room.rng, room.stage, room.walls[side]
    left, right = max(hole.middle - 1.3, -wall.half), min(hole.middle + 1.3, wall.half)
    middle, reach, high = (left + right) / 2, (right - left) / 2, wall.height / 2
    slabs = boxes(
        ((middle, high, -2.4), (reach, high, 0.01)),
        ((left, high, -1.2), (0.01, high, 1.19)),
        ((right, high, -1.2), (0.01, high, 1.19)),
        ((middle, 2 * high, -1.2), (reach, 0.01, 1.19)),
        ((middle, -0.01, -1.2), (reach, 0.01, 1.19)),
    )
    stage.add("next_room", slabs, wall.frame, matte(finishes.any_color(rng) * 0.5 + 0.4))
    frame = boxes(
        ((-hole.half, hole.high / 2, 0), (0.04, hole.high / 2, 0.06)),
        ((hole.half, hole.high / 2, 0), (0.04, hole.high / 2, 0.06)),
        ((0, hole.high, 0), (hole.half + 0.04, 0.04, 0.06)),
    )
    trim: Finish = finishes.hard(rng)
    stage.add("door_frame", frame, wall.frame @ shift(hole.middle, 0, 0), trim)
    deep = min(1.8 * hole.half, 0.9)
    room.claim(wall.frame, (hole.middle - hole.half - 0.05, 0, 0), (hole.middle + hole.half + 0.05, hole.high, deep))
    room.sights.append((wall.frame @ shift(hole.middle, 1.1, 0))[:3, 3])
    if kind == "next door":
        return 2 * hole.half * hole.high
    opened = rng.uniform(28, 55) if kind == "ajar" else rng.uniform(5, 85)
    reach, period, phase = 0.4 * min(opened, 90 - opened), rng.uniform(14, 80), rng.random()
    hinge = wall.frame @ shift(hole.middle - hole.half, 0, 0.05)
    leaf = shift(hole.half, hole.high / 2, 0) @ scale(hole.half - 0.01, hole.high / 2 - 0.02, 0.018)
    knob = shift(2 * hole.half - 0.07, 1.0, 0.06) @ scale(0.03)
    finish = finishes.timber(rng) if rng.random() < 0.5 else finishes.plastic(rng)
    moves = bool(rng.random() < 0.5)

    def ajar(frame: float) -> np.ndarray:
        return hinge @ turn("y", -opened - reach * swing(frame, period, phase))

    for name, shape, local, material in (
        ("door", "cube", leaf, finish),
        ("knob", "sphere", knob, finishes.any_metal(rng)),
    ):
        stage.add(name, shape, attached(ajar, local) if moves else ajar(0) @ local, material)
    return float(2 * hole.half * hole.high * np.sin(np.radians(opened)))
