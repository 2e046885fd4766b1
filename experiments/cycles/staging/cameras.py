"""Cameras and their moves: a dolly, an arc, a pan, a hand that shakes; two cameras with a cut between them."""

import math
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np

from experiments.cycles.staging.stage import Point, Stage, look

Path = Callable[[float], tuple[Point, Point]]
"""The camera's place and the point that it looks at, by time from 0 to 1."""


def film(stage: Stage, path: Path, *, lens: float | None = None, focus: float | None = None, stop: float = 2.8) -> Any:
    """A camera on a path; ``focus`` in metres turns on depth of field with an aperture of f/``stop``."""
    data = bpy.data.cameras.new("camera")
    data.lens = lens or stage.between(22, 35)
    data.clip_start, data.clip_end = 0.02, 2000.0
    if focus is not None:
        data.dof.use_dof = True
        data.dof.focus_distance, data.dof.aperture_fstop = focus, stop
    camera = bpy.data.objects.new("camera", data)
    stage.scene.collection.objects.link(camera)
    stage.scene.camera = camera
    stage.move(camera, lambda t: (path(t)[0], look(*path(t))))
    return camera


def some_path(stage: Stage, at: Point, aim: Point, reach: float) -> Path:
    """One of the moves, about a place and an aim; ``reach`` is how far the camera goes, in metres."""
    return stage.one_of([dolly, dolly, arc, pan, by_hand])(stage, at, aim, reach)


def dolly(stage: Stage, at: Point, aim: Point, reach: float) -> Path:
    """Along a straight line, looking at a point that hardly moves."""
    heading, climb = stage.between(0, 2 * math.pi), stage.between(-0.15, 0.15)
    step = np.array([math.cos(heading), 0.5 * math.sin(heading), climb]) * reach
    start, end = np.asarray(at, float), np.asarray(aim, float)
    return lambda t: (start + step * (t - 0.5), end + 0.2 * step * (t - 0.5))


def arc(stage: Stage, at: Point, aim: Point, reach: float) -> Path:
    """On a circle about the aim."""
    start, centre = np.asarray(at, float), np.asarray(aim, float)
    out = start - centre
    turn = stage.one_of([-1, 1]) * reach / max(float(np.hypot(*out[:2])), 0.1)

    def path(t: float) -> tuple[Point, Point]:
        c, s = math.cos(turn * (t - 0.5)), math.sin(turn * (t - 0.5))
        return centre + np.array([c * out[0] - s * out[1], s * out[0] + c * out[1], out[2]]), centre

    return path


def pan(stage: Stage, at: Point, aim: Point, reach: float) -> Path:
    """Standing still and turning."""
    start, end = np.asarray(at, float), np.asarray(aim, float)
    side = np.cross(end - start, (0, 0, 1))
    step = side / np.linalg.norm(side) * reach * stage.one_of([-0.8, 0.8])
    return lambda t: (start, end + step * (t - 0.5))


def by_hand(stage: Stage, at: Point, aim: Point, reach: float) -> Path:
    """A slow dolly of a hand that shakes a little."""
    steady = dolly(stage, at, aim, 0.6 * reach)
    phases = stage.rng.uniform(0, 2 * math.pi, (2, 3))
    speeds = stage.rng.uniform(5, 16, (2, 3))

    def path(t: float) -> tuple[Point, Point]:
        place, end = steady(t)
        shake = np.sin(speeds * t + phases)
        return place + 0.012 * reach * shake[0], end + 0.05 * reach * shake[1]

    return path


def cut(first: Path, second: Path, at: float) -> Path:
    """One path until a time, another from there on."""
    return lambda t: first(t) if t < at else second(t)
