"""The lamps of a parlour: bare bulbs, shades, tubes and screens, some of which move, dim, flicker or are switched."""

from collections.abc import Callable

import numpy as np

from jaxdn.render.families import finishes, furniture, shapes
from jaxdn.render.families.rooms import Opening, Room
from jaxdn.render.families.staging import RECTANGLE, Finish, attached, matte, rod, scale, shift, swing, turn

BLACK = matte(np.zeros(3))
Dimmer = Callable[[float], float]


def light_by_lamps(room: Room, power: float) -> None:
    """One to four lamps of different kinds that share the light; in some rooms one of them changes."""
    rng = room.rng
    kinds = [_bulb, _pendant, _standing, _tube, _screen]  # the last is too weak to be alone
    count = int(rng.integers(1, 5))
    shares = rng.dirichlet(np.full(count, 1.5))
    chosen = [int(kind) for kind in rng.permutation(len(kinds) - (count == 1))[:count]]
    changing = int(rng.integers(count)) if rng.random() < 0.45 else -1
    for index, (kind, share) in enumerate(zip(chosen, shares, strict=True)):
        dimmer = _dimmer(rng, 0.0 if count > 1 else 0.15) if index == changing else None
        kinds[kind](room, 2.6 * power * float(share) * _tint(rng), dimmer)


def light_upwards(room: Room, power: float) -> None:
    """A bowl on a pole that shines only upwards."""
    rng, stage = room.rng, room.stage
    high, radius = rng.uniform(0.55, 0.8) * room.height, rng.uniform(0.12, 0.3)
    spot = room.on_floor(0.2, high)
    spot = shift(0, 0, 0) if spot is None else spot
    stage.add("torch_stand", furniture.lamp_stand(high), spot, finishes.any_metal(rng))
    stage.add("torch_bowl", shapes.dish(0.5), spot @ shift(0, high, 0) @ scale(radius * 1.1), finishes.any_metal(rng))
    glow = 3.2 * power * _tint(rng) / (np.pi * radius**2)
    dimmer = _dimmer(rng, 0.15) if rng.random() < 0.3 else None
    place = spot @ shift(0, high + 0.3 * radius, 0) @ turn("x", -90) @ scale(0.8 * radius)
    stage.add("torch", "disk", place, BLACK, glow=glow / 0.64, dimmer=dimmer)


def light_next_door(room: Room, side: int, hole: Opening, power: float, gap: float) -> None:
    """A lamp in the room behind the opening, which lets light through an area `gap`; it may be switched.

    Args:
      room: gets it.
      side: the wall with the opening.
      hole: the opening.
      power: of all light.
      gap: the area.
    """
    rng, wall = room.rng, room.walls[side]
    radius = rng.uniform(0.05, 0.12)
    x = np.clip(hole.middle + rng.uniform(-1, 1), -wall.half + 0.3, wall.half - 0.3)
    place = wall.frame @ shift(x, rng.uniform(1.2, wall.height - 0.2), -rng.uniform(0.5, 1.9)) @ scale(radius)
    needed = power * float(np.clip(9.0 / gap, 3.0, 40.0)) * rng.uniform(0.7, 1.4)
    glow = needed * _tint(rng) / (4 * np.pi * radius**2)
    dimmer = _dimmer(rng, 0.3) if rng.random() < 0.3 else None
    room.stage.add("lamp_next_door", "sphere", place, BLACK, glow=glow, dimmer=dimmer)


def _tint(rng: np.random.Generator) -> np.ndarray:
    """A colour of mean 1: mostly warm to cool white, sometimes strongly coloured."""
    if rng.random() < 0.15:
        tint = 0.15 + finishes.strong_color(rng)
    else:
        cool = rng.random()
        tint = np.array([1.0, 0.78, 0.5]) * (1 - cool) + np.array([0.85, 0.93, 1.0]) * cool
    return np.asarray(tint / tint.mean())


def _dimmer(rng: np.random.Generator, lowest: float) -> Dimmer:
    """A light that is switched on or off, dims, comes up or flickers; most of it happens in the first ten frames."""
    kind, start, length = rng.integers(4), rng.uniform(1, 7), rng.uniform(3, 9)
    if kind < 2:
        return lambda frame: 1.0 if (frame > start) == (kind == 0) else lowest
    if kind == 2:
        rising = bool(rng.random() < 0.5)

        def ramp(frame: float) -> float:
            share = float(np.clip((frame - start) / length, 0, 1))
            return lowest + (1 - lowest) * (share if rising else 1 - share)

        return ramp
    period, phase = rng.uniform(2.5, 12), rng.random()
    return lambda frame: 0.6 + 0.4 * swing(frame, period, phase) * swing(frame, 1.7 * period)


def _bulb(room: Room, flux: np.ndarray, dimmer: Dimmer | None) -> None:
    """A bare bulb of 3 to 8 cm radius on a cord, still or swinging."""
    _hang(room, "bulb", flux, dimmer, shade=False)


def _pendant(room: Room, flux: np.ndarray, dimmer: Dimmer | None) -> None:
    """A bulb under a shade on a cord, still or swinging."""
    _hang(room, "pendant", flux, dimmer, shade=True)


def _hang(room: Room, name: str, flux: np.ndarray, dimmer: Dimmer | None, *, shade: bool) -> None:
    """A bulb on a cord.

    Args:
      room: gets it.
      name: of the lamp.
      flux: radiance times emitting area.
      dimmer: of the bulb.
      shade: whether it has one.
    """
    rng, stage = room.rng, room.stage
    radius, drop = rng.uniform(0.03, 0.08), rng.uniform(0.15, 0.45) * room.height
    x, z = (rng.uniform(-0.6, 0.6) * room.high[axis] for axis in (0, 2))
    lean, period, phase = rng.choice([0, 8, 22, 35]), rng.uniform(9, 30), rng.random()
    lean = min(lean, np.degrees(np.arcsin(min(0.9, (min(room.high[0] - abs(x), room.high[2] - abs(z)) - 0.25) / drop))))
    turned, cord = turn("y", rng.uniform(0, 180)), rod((0, -drop, 0), (0, 0, 0), 0.004)

    def joint(frame: float) -> np.ndarray:
        return shift(x, room.height - 0.001, z) @ turned @ turn("z", lean * swing(frame, period, phase))

    parts: list[tuple[str, str | shapes.Mesh, np.ndarray, Finish, np.ndarray | None]]
    parts = [("cord", shapes.drum(), cord, matte((0.05, 0.05, 0.05)), None)]
    if shade:
        mesh = furniture.lamp_shade(rng.uniform(0.12, 0.28), rng.uniform(0.03, 0.1), 0.2)
        cover = finishes.cloth(rng) if rng.random() < 0.4 else finishes.any_metal(rng)
        parts.append(("shade", mesh, shift(0, -drop - 0.06, 0), cover, None))
    glow = flux / (4 * np.pi * radius**2)
    parts.append(("bulb", "sphere", shift(0, -drop - 0.5 * radius, 0) @ scale(radius), BLACK, glow))
    for part, shape, local, material, light in parts:
        pose = attached(joint, local) if lean else joint(0) @ local
        own = dimmer if light is not None else None
        stage.add(f"{name}_{part}", shape, pose, material, glow=light, dimmer=own)
    low = np.array([x, room.height - drop - 0.1, z])
    room.sights.append(low)
    swept = 0.25 + drop * np.sin(np.radians(lean))
    room.taken.append(np.stack([low - (swept, 0.1, swept), low + (swept, 0.3, swept)]))  # the camera keeps away


def _standing(room: Room, flux: np.ndarray, dimmer: Dimmer | None) -> None:
    """A lamp with a shade on a stand on the floor, or on a table."""
    rng, stage = room.rng, room.stage
    if room.tops and rng.random() < 0.5:
        frame, wide, deep = room.tops[int(rng.integers(len(room.tops)))]
        spot, high = frame @ shift(rng.uniform(-0.7, 0.7) * wide, 0, rng.uniform(-0.7, 0.7) * deep), 0.35
    else:
        found, high = room.on_floor(0.2, 1.6), rng.uniform(1.2, 1.6)
        spot = shift(0, 0, 0) if found is None else found
    radius = rng.uniform(0.03, 0.06)
    stage.add("lamp_stand", furniture.lamp_stand(high), spot, finishes.any_metal(rng))
    shade = furniture.lamp_shade(rng.uniform(0.14, 0.22), rng.uniform(0.07, 0.14), 0.24)
    stage.add("lamp_shade", shade, spot @ shift(0, high - 0.08, 0), finishes.cloth(rng))
    place = spot @ shift(0, high + radius, 0) @ scale(radius)
    stage.add("lamp_bulb", "sphere", place, BLACK, glow=flux / (4 * np.pi * radius**2), dimmer=dimmer)


def _tube(room: Room, flux: np.ndarray, dimmer: Dimmer | None) -> None:
    """A thin tube along a wall under the ceiling, or near the floor."""
    rng, wall = room.rng, room.walls[int(room.rng.integers(4))]
    long, thick = rng.uniform(0.2, 0.6) * wall.half, rng.uniform(0.008, 0.02)
    y = 0.15 if rng.random() < 0.25 else room.height - 0.12
    place = wall.frame @ shift(rng.uniform(-1, 1) * (wall.half - long) * 0.8, y, 0.12) @ scale(long, thick, thick)
    glow = flux / (8 * long * thick * 2)
    room.stage.add("tube", "cube", place, BLACK, glow=glow, dimmer=dimmer)


def _screen(room: Room, flux: np.ndarray, dimmer: Dimmer | None) -> None:
    """A television that shows a picture in strong colours."""
    rng, stage = room.rng, room.stage
    wide, high = rng.uniform(0.3, 0.6), rng.uniform(0.2, 0.35)
    place = None
    for side in rng.permutation(4):
        place = room.at_wall(int(side), wide, 2 * high, 0.06, low=rng.uniform(0.6, 1.1)) if place is None else place
    if place is None:
        place = room.walls[0].frame @ shift(0, room.height - 2 * high - 0.02, 0)
    middle = place @ shift(0, high, 0)
    stage.add("screen_case", furniture.picture_frame(wide, high, 0.015), middle, finishes.plastic(rng))
    shown = finishes.picture(rng)[::4, ::4] + 0.02
    radiance = min(float(flux.mean()) / (4 * wide * high), 4.0)
    glow = radiance * shown / shown.mean()
    stage.add("screen", RECTANGLE, middle @ shift(0, 0, 0.02) @ scale(wide, high, 1), BLACK, glow=glow, dimmer=dimmer)
