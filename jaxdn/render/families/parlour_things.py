"""What stands and hangs in a parlour: each thing is there or not, by chance and where there is room for it."""

from itertools import pairwise

import numpy as np

from jaxdn.render.families import finishes, furniture, shapes
from jaxdn.render.families.rooms import Room
from jaxdn.render.families.staging import (
    RECTANGLE,
    Finish,
    Motion,
    attached,
    glass,
    matte,
    metal,
    scale,
    shift,
    swing,
    turn,
)

MANY = 36
"""A room with as many parts gets no more small things."""


def furnish(room: Room) -> None:
    """Furniture at the walls and in the middle, things on it, and pictures."""
    _table(room)
    makers = [_bookcase, _sofa, _sideboard, _plant, _mirror, _rack]
    for index in room.rng.permutation(len(makers)):
        if room.rng.random() < 0.85:
            makers[index](room)
    for index in range(int(room.rng.integers(2, 6))):
        _picture(room, index)
    _rug(room)
    for index in range(int(room.rng.integers(3, 8))):
        if len(room.stage.parts) < MANY:
            _small_thing(room, index)


def _table(room: Room) -> None:
    """A table on thin legs, with one to four chairs around it; one chair may rock."""
    rng, stage = room.rng, room.stage
    wide, deep = rng.uniform(0.35, 0.75), rng.uniform(0.3, 0.45)
    high = rng.uniform(0.38, 0.5) if rng.random() < 0.3 else rng.uniform(0.68, 0.78)
    spot = room.on_floor(max(wide, deep) * 0.9, high + 0.02)
    if spot is None:
        return
    top = spot @ shift(0, high, 0)
    if rng.random() < 0.2:
        stage.add(
            "table_top", RECTANGLE, top @ turn("x", -90) @ scale(wide, deep, 1), glass((0.9, 0.95, 0.93), thin=True)
        )
    elif rng.random() < 0.4:
        wide = deep = max(deep, 0.8 * wide)
        stage.add("table_top", shapes.drum(), top @ shift(0, -0.025, 0) @ scale(wide, 0.025, deep), finishes.hard(rng))
    else:
        stage.add("table_top", "cube", top @ shift(0, -0.012, 0) @ scale(wide, 0.012, deep), finishes.hard(rng))
    stage.add("table_legs", furniture.table_legs(rng, 0.8 * wide, 0.8 * deep, high - 0.02), spot, finishes.hard(rng))
    room.tops.append((top, 0.7 * wide, 0.7 * deep))
    if high < 0.6:
        return
    mesh, material = furniture.chair(rng), finishes.hard(rng)
    rocks, period, lean = bool(rng.random() < 0.3), rng.uniform(9, 30), rng.uniform(4, 10)
    for index in range(int(rng.integers(1, 5))):
        angle, away = 90 * index + rng.uniform(-25, 25), (wide, deep)[(index + 1) % 2] + rng.uniform(0.08, 0.3)
        place = spot @ turn("y", angle) @ shift(0, 0, away) @ turn("y", 180 + rng.uniform(-30, 30))
        if not room.claim(place, (-0.2, 0, -0.2), (0.2, 1.0, 0.2), margin=-0.12):
            continue
        if rocks and index == 0:
            stage.add("chair_0", mesh, _rocking(place, period, lean), material)
        else:
            stage.add(f"chair_{index}", mesh, place, material)


def _rocking(place: np.ndarray, period: float, lean: float) -> Motion:
    return lambda frame: place @ turn("x", lean * swing(frame, period))


def _bookcase(room: Room) -> None:
    """Thin books of many colours on boards."""
    rng, stage = room.rng, room.stage
    wide, deep, shelves = rng.uniform(0.35, 0.8), rng.uniform(0.2, 0.32), int(rng.integers(2, 7))
    high = min(0.36 * shelves, room.height - 0.1)
    place = room.at_wall(int(rng.integers(4)), wide + 0.01, high, deep)
    if place is None:
        return
    stage.add("bookcase", furniture.bookcase(wide, high, deep, shelves), place, finishes.hard(rng))
    rows = furniture.books(rng, wide, high, deep, shelves)
    stage.add("books", rows, place, matte(finishes.palette(rng)))
    if high < 1.2:
        room.tops.append((place @ shift(0, high, deep / 2), 0.9 * wide, 0.3 * deep))


def _sofa(room: Room) -> None:
    rng = room.rng
    wide = rng.uniform(0.4, 0.9)
    place = room.at_wall(int(rng.integers(4)), wide + 0.15, 0.95, 0.85)
    if place is not None:
        cover = finishes.cloth(rng) if rng.random() < 0.8 else finishes.plastic(rng)
        room.stage.add("sofa", furniture.sofa(rng, wide), place, cover)


def _sideboard(room: Room) -> None:
    """A box with doors on thin feet."""
    rng, stage = room.rng, room.stage
    wide, high, deep = rng.uniform(0.4, 0.85), rng.uniform(0.5, 0.95), rng.uniform(0.18, 0.25)
    place = room.at_wall(int(rng.integers(4)), wide, high, 2 * deep)
    if place is None:
        return
    feet = [((x, 0.06, z), (0.012, 0.06, 0.012)) for x in (-0.9 * wide, 0.9 * wide) for z in (0.04, 2 * deep - 0.04)]
    body = shapes.boxes(((0, 0.12 + (high - 0.12) / 2, deep), (wide, (high - 0.12) / 2, deep - 0.012)), *feet)
    stage.add("sideboard", body, place, finishes.hard(rng))
    count = int(rng.integers(2, 5))
    middles = wide * ((2 * np.arange(count) + 1) / count - 1)
    face = [
        ((float(x), 0.14 + (high - 0.16) / 2, 0.0), (wide / count - 0.008, (high - 0.18) / 2, 0.008)) for x in middles
    ]
    stage.add("sideboard_doors", shapes.boxes(*face), place @ shift(0, 0, 2 * deep - 0.008), finishes.hard(rng))
    room.tops.append((place @ shift(0, high, deep), 0.9 * wide, 0.7 * deep))


def _plant(room: Room) -> None:
    """A pot with many leaves, from small to as high as a person."""
    rng, stage = room.rng, room.stage
    high, pot = rng.uniform(0.4, 1.3), rng.uniform(0.1, 0.18)
    spot = room.on_floor(pot + 0.15, 0.3 + high)
    if spot is None:
        return
    profile = [(0.0, 0.0), (0.75 * pot, 0.0), (pot, 0.3), (0.9 * pot, 0.3), (0.85 * pot, 0.26), (0.0, 0.26)]
    stage.add("pot", shapes.lathe(*([a, b] for a, b in pairwise(profile))), spot, finishes.hard(rng))
    hues = (0.2, 0.4) if rng.random() < 0.8 else (0.85, 1.1)
    stage.add("plant", furniture.plant(rng, high), spot @ shift(0, 0.25, 0), matte(finishes.palette(rng, hues)))


def _mirror(room: Room) -> None:
    """A mirror on the wall, or one that leans against it from the floor."""
    rng, stage = room.rng, room.stage
    wide, high = rng.uniform(0.2, 0.6), rng.uniform(0.3, 0.75)
    low = rng.uniform(0.0, 0.3) if high > 0.6 else rng.uniform(0.7, 1.1)
    place = room.at_wall(int(rng.integers(4)), wide, 2 * high, 0.05, low=low)
    if place is None:
        return
    middle = place @ shift(0, high, 0)
    stage.add("mirror_frame", furniture.picture_frame(wide, high, 0.02), middle, finishes.hard(rng))
    silver = metal((0.93, 0.93, 0.93), 0.05)
    stage.add("mirror", RECTANGLE, middle @ shift(0, 0, 0.015) @ scale(wide, high, 1), silver)


def _rack(room: Room) -> None:
    """A railing in the room, as around stairs: thin uprights across part of the floor."""
    rng = room.rng
    wide = rng.uniform(0.4, 0.9)
    spot = room.at_wall(int(rng.integers(4)), wide, 0.95, 0.3)
    if spot is not None:
        rail = furniture.railing(wide, 0.92, rng.uniform(0.06, 0.13))
        room.stage.add("inner_railing", rail, spot @ shift(0, 0, 0.2), finishes.hard(rng))


def _picture(room: Room, index: int) -> None:
    """A painting in strong colours in a thin frame."""
    rng, stage = room.rng, room.stage
    wide, high = rng.uniform(0.15, 0.65), rng.uniform(0.15, 0.45)
    place = room.at_wall(int(rng.integers(4)), wide + 0.02, 2 * high + 0.04, 0.035, low=rng.uniform(0.9, 1.4))
    if place is None:
        return
    middle = place @ shift(0, high, 0)
    stage.add(
        f"frame_{index}", furniture.picture_frame(wide, high, rng.uniform(0.008, 0.03)), middle, finishes.hard(rng)
    )
    canvas = finishes.picture(rng)
    material = matte(canvas) if rng.random() < 0.6 else Finish(canvas, rng.uniform(0.08, 0.4))
    stage.add(f"canvas_{index}", RECTANGLE, middle @ shift(0, 0, 0.012) @ scale(wide, high, 1), material)


def _rug(room: Room) -> None:
    rng = room.rng
    if rng.random() < 0.25:
        return
    wide, deep = rng.uniform(0.5, 0.8) * room.high[0], rng.uniform(0.4, 0.8) * room.high[2]
    place = shift(rng.uniform(-0.2, 0.2), 0.006, rng.uniform(-0.2, 0.2)) @ turn("y", rng.choice([0, 0, 12, -8]))
    round_ = rng.random() < 0.3
    size = scale(min(wide, deep), 0.005, min(wide, deep)) if round_ else scale(wide, 0.005, deep)
    room.stage.add("rug", shapes.drum() if round_ else "cube", place @ size, finishes.cloth(rng))


def _small_thing(room: Room, index: int) -> None:
    """A vase, glass, ball, ring, bowl or box on some furniture, or on the floor; every second one may turn."""
    rng, stage = room.rng, room.stage
    size = rng.uniform(0.06, 0.16)
    if not room.tops or rng.random() < 0.2:
        size *= 1.7
        spot = room.on_floor(1.1 * size, 2 * size)
        if spot is None:
            return
        place = spot
    else:
        frame, wide, deep = room.tops[int(rng.integers(len(room.tops)))]
        place = (
            frame @ shift(rng.uniform(-1, 1) * wide, 0.001, rng.uniform(-1, 1) * deep) @ turn("y", rng.uniform(0, 360))
        )
        if not room.claim(place, (-0.8 * size, 0.05, -0.8 * size), (0.8 * size, 2 * size, 0.8 * size), margin=0.0):
            return
        room.sights.append(place[:3, 3] + (0, size, 0))
    shape, local, material = _kind(rng, size)
    if rng.random() < 0.35:
        rate = rng.choice([-1, 1]) * rng.choice([1.5, 6, 25])
        stage.add(f"thing_{index}", shape, attached(lambda frame: place @ turn("y", rate * frame), local), material)
    else:
        stage.add(f"thing_{index}", shape, place @ local, material)


def _kind(rng: np.random.Generator, size: float) -> tuple[str | shapes.Mesh, np.ndarray, Finish]:
    """A shape that stands on the origin, its place and its material."""
    material, kind = finishes.small_thing(rng), rng.integers(7)
    if kind == 0:
        return "sphere", shift(0, size, 0) @ scale(size), material
    if kind == 1:
        return shapes.soft_box(0.2, 0.2), shift(0, size, 0) @ scale(size), material
    if kind == 2:
        return shapes.ring(0.3), shift(0, 1.2 * size, 0) @ turn("x", 75) @ scale(0.9 * size), material
    if kind == 3:
        return furniture.goblet(rng), scale(2 * size), glass(1 - rng.uniform(0, 0.4) * rng.random(3), thin=True)
    if kind == 4:
        return shapes.dish(rng.uniform(0.2, 0.6)), scale(size), finishes.plastic(rng)
    vase = shapes.vase(rng.uniform(0.3, 0.5), rng.uniform(0.1, 0.2))
    return vase, scale(2 * size), finishes.any_metal(rng) if kind == 5 else finishes.plastic(rng)
