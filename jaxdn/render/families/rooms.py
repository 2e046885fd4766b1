"""Rooms of any size with an opening in any wall, and a record of the places that are taken."""

from typing import NamedTuple

import numpy as np

from jaxdn.render.families.shapes import Mesh, holed_wall
from jaxdn.render.families.staging import RECTANGLE, Finish, Stage, scale, shift, turn


class Wall(NamedTuple):
    """A wall seen from inside: in its `frame` x runs along it from its middle, y up from the floor, z into the room."""

    frame: np.ndarray
    half: float
    """Half its width."""
    depth: float
    """Half the width of the room in front of it."""
    height: float


class Opening(NamedTuple):
    """A hole in a wall, in metres in the frame of the wall."""

    middle: float
    half: float
    low: float
    high: float


class Room:
    """The shell of a room in a stage, and the boxes [2,3] in it that furniture and its doors need.

    Args:
      stage: gets the shapes.
      half: half width, full height and half length.
      openings: of the walls 0 to 3 (back, left, front, right).
      walls: material of each wall.
      floor: material.
      ceiling: material.
    """

    def __init__(
        self,
        stage: Stage,
        half: tuple[float, float, float],
        openings: dict[int, Opening],
        *,
        walls: list[Finish],
        floor: Finish,
        ceiling: Finish,
    ) -> None:
        width, height, length = half
        self.stage, self.rng, self.height = stage, stage.rng, height
        self.area = 4 * width * length
        self.low, self.high = np.array([-width, 0, -length]), np.array([width, height, length])
        stage.bounds = np.stack([self.low, self.high])
        self.taken: list[np.ndarray] = []
        self.sights: list[np.ndarray] = []
        """Points worth looking at."""
        self.tops: list[tuple[np.ndarray, float, float]] = []
        """Frames of level surfaces that carry things, with their half sizes."""
        self.walls: list[Wall] = []
        stage.add("floor", RECTANGLE, turn("x", -90) @ scale(width, length, 1), floor)
        stage.add("ceiling", RECTANGLE, shift(0, height, 0) @ turn("x", 90) @ scale(width, length, 1), ceiling)
        for side, name in enumerate(("back", "left", "front", "right")):
            across, depth = (length, width) if side % 2 else (width, length)
            frame = turn("y", 90 * side) @ shift(0, 0, -depth)
            self.walls.append(Wall(frame, across, depth, height))
            pose = frame @ shift(0, height / 2, 0) @ scale(across, height / 2, 1)
            stage.add(f"wall_{name}", _wall_shape(openings.get(side), across, height), pose, walls[side])

    def claim(
        self, frame: np.ndarray, low: tuple[float, ...], high: tuple[float, ...], *, margin: float = 0.04
    ) -> bool:
        """Take the box from `low` to `high` of a frame if it is free and inside; whether it was."""
        box = _around(frame, low, high)
        if np.any(box[0] < self.low - 1e-3) or np.any(box[1] > self.high + 1e-3) or self.hits(box, margin):
            return False
        self.taken.append(box)
        return True

    def hits(self, box: np.ndarray, margin: float) -> bool:
        """Whether a box comes closer than `margin` to one that is taken."""
        return any(np.all(box[0] < one[1] + margin) and np.all(box[1] > one[0] - margin) for one in self.taken)

    def at_wall(self, side: int, wide: float, high: float, deep: float, *, low: float = 0.0) -> np.ndarray | None:
        """The frame of a free place along a wall, for a thing of half width `wide`; None if there is none.

        Args:
          side: number of the wall.
          wide: half width.
          high: height.
          deep: depth.
          low: height of the lower edge.
        """
        wall = self.walls[side]
        for _ in range(12):
            if wall.half <= wide + 0.05 or low + high > wall.height - 0.02:
                return None
            x = self.rng.uniform(-1, 1) * (wall.half - wide - 0.05)
            place = wall.frame @ shift(x, low, 0)
            if self.claim(place, (-wide, 0, 0), (wide, high, deep)):
                self.sights.append(place[:3, 3] + place[:3, :3] @ (0, 0.6 * high, 0.5 * deep))
                return place
        return None

    def on_floor(self, radius: float, high: float) -> np.ndarray | None:
        """The frame, turned at random, of a free round place away from the walls; None if there is none."""
        for _ in range(25):
            spot = self.rng.uniform(self.low + radius + 0.05, self.high - radius - 0.05)
            place = shift(spot[0], 0, spot[2])
            if self.claim(place, (-radius, 0, -radius), (radius, high, radius)):
                self.sights.append(np.array([spot[0], 0.6 * high, spot[2]]))
                return place @ turn("y", self.rng.uniform(0, 360))
        return None

    def line(self, start: np.ndarray, end: np.ndarray, radius: float) -> bool:
        """Whether a ball can roll or fly from start to end without touching anything."""
        for share in np.linspace(0, 1, 12):
            point = start + share * (end - start)
            box = np.stack([point - radius, point + radius])
            if np.any(box[0] < self.low) or np.any(box[1] > self.high) or self.hits(box, 0.0):
                return False
        return True


def _wall_shape(opening: Opening | None, half: float, height: float) -> str | Mesh:
    if opening is None:
        return RECTANGLE
    left, right = (opening.middle - opening.half) / half, (opening.middle + opening.half) / half
    return holed_wall(left, right, 2 * opening.low / height - 1, 2 * opening.high / height - 1)


def _around(frame: np.ndarray, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """The box [2,3] along the axes around one in a frame."""
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    points = corners @ frame[:3, :3].T + frame[:3, 3]
    return np.stack([points.min(0), points.max(0)])
