"""The necessary path length, measured with a few samples of the scene.

Paths of depth D + 1 collect the light of depth D and one more bounce, so the sums of a few samples at increasing depths
give what each bounce adds. From some bounce on each adds a fixed share of the one before it, and the rest is a
geometric series.
"""

import itertools
from typing import NamedTuple

import numpy as np

from jaxdn.planning.plan import BOUND
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene import AnimatedScene, brightness
from jaxdn.render.tracing.seeds import DEPTH, SampleStream
from jaxdn.render.tracing.tracer import choose_tracer

_SIDE, _SAMPLES = 24, 16
_FRAMES = 3
"""Frames that are measured, evenly from the first to the last, besides those in which a light is brightest."""
_DEPTHS = (2, 3, 4, 5, 6, 8, 10, 13, 17, 24)


class PathDepth(NamedTuple):
    """The chosen path length and its estimated error."""

    max_depth: int
    """Path length in Mitsuba's count: 1 is emission, 2 direct, 3 one bounce of indirect light."""
    remaining: float
    """Estimated share of the reflected light that longer paths would add."""
    bound: float
    """The allowed share."""
    light: dict[int, float]
    """Path length -> mean reflected radiance, as measured."""
    frame: int = 0
    """The frame that needs this length."""


def measure_depth(scene: AnimatedScene, *, frames: int | None = None, bound: float = BOUND) -> PathDepth:
    """The shortest path length that leaves out at most ``bound`` of the reflected light in every measured frame.

    Measured are the first, the middle and the last of ``frames`` frames (default: all of the animation), and for each
    light whose brightness changes the frame in which it is brightest: a clip may begin in the dark. Light that the
    camera sees directly does not count: next to a bright window everything else would be negligible. It takes 16
    samples for each of 24 x 24 pixels; all depths follow the same paths, so that their differences are exact. The
    result is at most the scene's own ``max_depth`` and always includes indirect light. The light beyond depth D is
    estimated as a geometric series with the ratio of the last two measured bounces, or of the last three if they decay
    slower. Raises ValueError for a bound outside (0, 1).
    """
    if not 0 < bound < 1:
        raise ValueError(f"bound: expected a share of the light between 0 and 1, got {bound!r}.")
    accumulate = choose_tracer(use_variant()).accumulate
    stream = SampleStream(0, 0, DEPTH)
    found: list[PathDepth] = []
    for frame in _choose_frames(scene, scene.frames if frames is None else frames):
        built = scene.build(frame, _SIDE, _SIDE)
        light: dict[int, float] = {}
        for depth in sorted({min(depth, scene.max_depth) for depth in _DEPTHS}):
            sums = accumulate(built, stream, 0, _SAMPLES, max_depth=depth)
            light[depth] = float(np.mean(sums.direct + sums.indirect)) / _SAMPLES
            if depth >= 4 and _estimate_remaining(light) <= bound:
                break
        found.append(_choose_shortest(light, bound)._replace(frame=frame))
    return max(found, key=lambda one: (one.max_depth, one.remaining))


def _choose_frames(scene: AnimatedScene, frames: int) -> list[int]:
    """The frames to measure; of those that show the same only the first."""
    chosen = {round(share * (frames - 1)) for share in np.linspace(0, 1, _FRAMES)}
    scales = [brightness(scene, frame) for frame in range(frames)]
    for light in scales[0]:
        means = [float(np.mean(scale[light])) for scale in scales]
        if max(means) > min(means):
            chosen.add(int(np.argmax(means)))
    different: dict[str, int] = {}
    for frame in sorted(chosen):
        poses = {name: np.asarray(pose).tolist() for name, pose in scene.pose(frame).items()}
        camera = scene.camera(frame)
        different.setdefault(repr((poses, camera.to_world.tolist(), camera.x_fov, scales[frame])), frame)
    return list(different.values())


def _compute_gains(light: dict[int, float]) -> list[float]:
    """The light added by each measured depth, per bounce."""
    depths = sorted(light)
    return [(light[b] - light[a]) / (b - a) for a, b in itertools.pairwise(depths)]


def _estimate_remaining(light: dict[int, float]) -> float:
    """Share of the light that paths longer than the longest measured ones would add."""
    depths, gains = sorted(light), _compute_gains(light)
    total = light[depths[-1]]
    if total <= 0 or len(gains) < 2 or gains[-1] <= 0:
        return 0.0
    middles = [(a + b) / 2 for a, b in itertools.pairwise(depths)]
    # The slower of two decay rates: with few samples a single bounce is noisy.
    ratios = [
        (gains[-1] / gains[-back]) ** (1 / (middles[-1] - middles[-back]))
        for back in (2, 3)
        if len(gains) >= back and gains[-back] > 0
    ]
    ratio = min(max(ratios, default=0.0), 0.98)
    # The gain of the last bounce itself, not of the middle of the last interval.
    last = gains[-1] * ratio ** ((depths[-1] - depths[-2] - 1) / 2)
    return last * ratio / (1 - ratio) / total


def _choose_shortest(light: dict[int, float], bound: float) -> PathDepth:
    """The shortest measured depth within the bound; the longest if none is."""
    depths = sorted(light)
    tail = _estimate_remaining(light)
    full = light[depths[-1]] * (1 + tail)
    found, left_out = depths[-1], tail / (1 + tail)
    for depth in depths[-2::-1]:
        missing = 1 - light[depth] / full if full > 0 else 0.0
        if depth < 3 or missing > bound:
            break
        found, left_out = depth, missing
    return PathDepth(found, float(left_out), bound, light)
