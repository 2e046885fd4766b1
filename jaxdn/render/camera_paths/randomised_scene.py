"""Randomised scenes (``jaxdn render --tour``): any scene file, animated by a seed, as training data from rooms.

The result has an ordinary animation (:mod:`jaxdn.render.scenes.animation`): a collision-free camera path, objects of
the room that move, inserted objects, overridden materials, and changed lights. Its record holds the animation in full,
so that the scene is built again without the search that found it.
"""

import functools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mitsuba as mi
import numpy as np

from jaxdn.render.camera_paths.free_space import FreeSpace
from jaxdn.render.camera_paths.inserted_objects import compute_focal_length, insert_objects, move_shapes
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.animation import CameraKeys, make_rotation
from jaxdn.render.scenes.material_overrides import can_override, name_materials
from jaxdn.render.scenes.scene import Camera
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.tracing.volume_path_tracer import scatters

_ATTEMPTS = 32
_VIEWS = 48
"""Views that are compared for one attempt."""
_SIDE, _SAMPLES = 24, 16
"""Size of the images that measure a view's light, and their samples per pixel."""
_DARK = 0.03
"""A view that is darker than this share of the path's middle is rejected."""


class _Draft(NamedTuple):
    """An animation before its light is measured."""

    animation: dict[str, Any]
    level: float
    """Wanted mean radiance."""


def randomise_scene(path: Path | str, seed: int, frames: int) -> SceneFile:
    """Animate a scene file by one seed, for ``frames`` frames; the same arguments always give the same animation.

    Speeds are in pixels per frame at an image width of 128. The camera mostly moves by 0.2 to 3, sometimes by up to 30
    (it pans) or hardly at all; objects by 0.3 to 30. Fields of view are 35 to 80 degrees. The mean radiance of the
    image is drawn from 0.01 to 0.8. Raises ValueError for files that cannot be read or rendered, for a scene without
    free space around its camera, and for one in which no such view is found.
    """
    if frames < 1:
        raise ValueError(f"tour frames: expected at least 1, got {frames}.")
    if seed < 0:
        raise ValueError(f"tour seed: expected at least 0, got {seed}.")
    path = Path(path)
    space = _find_free_space(os.path.abspath(path), path.stat().st_mtime if path.is_file() else 0.0, use_variant())
    for attempt in range(_ATTEMPTS):
        plan = _draft_animation(space, np.random.default_rng([seed, attempt]), frames, ease=attempt / _ATTEMPTS)
        if plan is None:
            continue
        # Overridden materials and inserted objects light the room differently than its own lights were measured to.
        level = _measure_scene_level(
            SceneFile.from_record({"file": str(path), "animation": plan.animation}), frames // 2
        )
        if level > 0:
            animation = _scale_lights(plan.animation, plan.level / level)
            return SceneFile.from_record({"file": str(path), "animation": animation})
    raise ValueError(
        f"tour of {space.file.name}, seed {seed}: expected a lit view that shows the room, found none in {_ATTEMPTS} "
        f"attempts; leave this seed out."
    )


@functools.lru_cache(maxsize=1)
def _find_free_space(path: str, changed: float, variant: str) -> FreeSpace:
    """The free space of a file as it is now, for all seeds."""
    return FreeSpace(SceneFile.from_record({"file": path}))


def _draft_animation(space: FreeSpace, rng: np.random.Generator, frames: int, *, ease: float) -> _Draft | None:
    """An animation of the room; None if none of the views is good enough; ``ease`` in [0, 1) asks for less."""
    view = _choose_view(space, rng, ease)
    if view is None:
        return None
    keys = _make_camera_keys(space, view, rng, frames)
    path = CameraKeys(keys)
    cameras = [Camera(path(frame), view.x_fov) for frame in range(frames)]
    level = float(10 ** (rng.uniform(-2, -1.2) if rng.random() < 0.25 else rng.uniform(-1.2, -0.1)))
    seen = [cameras[frame] for frame in sorted({0, frames // 2, frames - 1})]
    if not _shows_enough(space, seen, ease):
        return None
    images = _render_lights(space, cameras[frames // 2])
    total = _measure_level(sum(images.values(), np.zeros(1)))
    if total <= 0 or min(_measure_level(_render_luminance(space, camera)) for camera in seen) < _DARK * total:
        return None
    lights = _make_light_keys(space, images, rng, frames, level)
    moved = move_shapes(space, cameras, rng, int(rng.integers(0, 5)), keep=set(lights))
    animation: dict[str, Any] = {"frames": frames, "camera": keys}
    inserted = insert_objects(space, cameras, rng, int(rng.integers(1, 7)), level)
    if not inserted:
        return None
    parts = {
        "shapes": moved,
        "inserted": inserted,
        "lights": lights,
        "materials": _draw_materials(space, rng),
    }
    return _Draft(animation | {name: part for name, part in parts.items() if part}, level)


def _choose_view(space: FreeSpace, rng: np.random.Generator, ease: float) -> Camera | None:
    """The best of some random views: many objects, near and far ones, none too close; None if all are poor."""
    cameras = []
    for spot in space.spots[rng.integers(len(space.spots), size=_VIEWS)]:
        pitch, turn = np.radians(rng.uniform(-35, 8)), rng.uniform(0, 360)
        ahead = np.roll(space.up, 1) * np.cos(pitch) + space.up * np.sin(pitch)
        forward = make_rotation(space.up, turn) @ ahead
        cameras.append(Camera(_look_along(space, spot, forward), float(rng.uniform(35, 80))))
    views = space.score_views(cameras)
    good = (views.empty < 0.35 + 0.25 * ease) & (views.close < 0.3 + 0.2 * ease) & (views.largest < 0.7 + 0.3 * ease)
    good &= (views.shapes >= 4 - 3 * ease) & (views.spread > 0.4 - 0.2 * ease) & (views.nearest > 1.5 * space.clear)
    # Noise in the score, so that not every path begins at the richest corner of a room.
    score = np.log(views.shapes + 1.0) + views.spread - views.largest - views.empty + rng.normal(0, 0.4, _VIEWS)
    return cameras[int(np.argmax(np.where(good, score, -np.inf)))] if good.any() else None


def _shows_enough(space: FreeSpace, cameras: Sequence[Camera], ease: float) -> bool:
    """Whether the views along a path show objects of the room, and not only a wall or the outside."""
    views = space.score_views(list(cameras))
    good = (views.empty < 0.7) & (views.close < 0.5) & (views.spread > 0.25 - 0.15 * ease)
    return bool((good & (views.shapes >= 4 - 3 * ease) & (views.nearest > 1.3 * space.near)).all())


def _look_along(space: FreeSpace, origin: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """[4, 4] camera to world, upright."""
    key = {"frame": 0, "origin": origin, "target": origin + forward, "up": space.up}
    return CameraKeys([key])(0)


def _make_camera_keys(space: FreeSpace, view: Camera, rng: np.random.Generator, frames: int) -> list[dict[str, Any]]:
    """Camera keys of a path that begins at a view: nearly still, slow, fast, or panning."""
    style = rng.choice(["still", "slow", "fast", "pan"], p=[0.15, 0.5, 0.15, 0.2])
    low, high = {"still": (0.02, 0.2), "slow": (0.2, 3), "fast": (2, 8), "pan": (4, 30)}[str(style)]
    speed = float(np.exp(rng.uniform(np.log(low), np.log(high)))) / compute_focal_length(view)
    middle = float(space.score_views([view]).middle[0])
    if style == "pan":
        return _make_panning_keys(space, view, rng, frames, float(np.degrees(speed)), middle)
    origin, forward = view.to_world[:3, 3], view.to_world[:3, 2]
    # Moving ahead changes the image less than moving sideways.
    step = view.to_world[:3, :3] @ (rng.normal(size=3) * (1, 0.4, 1.2))
    step = step / np.linalg.norm(step) * min(speed * middle * max(frames - 1, 1), 1.5 * space.reach)
    corners = int(rng.integers(1, 4))
    for _ in range(8):
        bends = [make_rotation(space.up, angle) for angle in np.cumsum(rng.uniform(-45, 45, corners))]
        places = np.cumsum([origin, *(bend @ step / corners for bend in bends)], axis=0)
        if space.is_collision_free(places):
            break
        step = 0.6 * step
    else:
        places = np.repeat(origin[None], corners + 1, axis=0)
    # At 1 the camera looks ahead all the time, at 0 at one place.
    follow = rng.uniform(0, 1)
    targets = origin + middle * forward + follow * (places - origin)
    times = np.linspace(0, max(frames - 1, 1), corners + 1)
    return [_make_camera_key(space, view, *key) for key in zip(times, places, targets, strict=True)]


def _make_panning_keys(
    space: FreeSpace, view: Camera, rng: np.random.Generator, frames: int, rate: float, middle: float
) -> list[dict[str, Any]]:
    """A key for every frame of a camera that turns by ``rate`` degrees a frame, to and fro between two angles."""
    origin, forward = view.to_world[:3, 3], view.to_world[:3, 2]
    best: list[np.ndarray] = []
    most = -1.0
    for _ in range(6):  # the arc that shows most even where it shows least
        widest, start, sign = rng.uniform(30, 140), rng.random(), rng.choice([-1, 1])
        phases = np.mod(start * widest + rate * np.arange(max(frames, 2)), 2 * widest)
        angles = sign * (widest - np.abs(phases - widest))
        turned = [make_rotation(space.up, angle - angles[0]) @ forward for angle in angles]
        views = space.score_views([Camera(_look_along(space, origin, one), view.x_fov) for one in turned])
        shown = float((views.shapes * np.minimum(views.spread, 1)).min())
        if shown > most:
            best, most = turned, shown
    return [_make_camera_key(space, view, at, origin, origin + middle * one) for at, one in enumerate(best)]


def _make_camera_key(
    space: FreeSpace, view: Camera, at: float, origin: np.ndarray, target: np.ndarray
) -> dict[str, Any]:
    key = {"frame": float(at), "origin": origin.tolist(), "target": target.tolist(), "up": space.up.tolist()}
    return {**key, "fov": view.x_fov}


def _render_luminance(space: FreeSpace, camera: Camera) -> np.ndarray:
    """[side, side] luminance of a view of the room."""
    sensor = {
        "type": "perspective",
        "fov": camera.x_fov,
        "near_clip": space.near,
        "to_world": mi.ScalarTransform4f(camera.to_world),
        "sampler": {"type": "independent"},
        "film": {"type": "hdrfilm", "width": _SIDE, "height": _SIDE, "rfilter": {"type": "box"}},
    }
    integrator = _make_integrator(space.scene, min(space.file.max_depth, 8))
    return _compute_luminance(
        mi.render(space.scene, sensor=mi.load_dict(sensor), integrator=integrator, spp=_SAMPLES, seed=mi.UInt32(0))
    )


def _make_integrator(scene: Any, max_depth: int) -> Any:
    return mi.load_dict({"type": "volpath" if scatters(scene) else "path", "max_depth": max_depth})


def _render_lights(space: FreeSpace, camera: Camera) -> dict[str, np.ndarray]:
    """Name -> [side, side] luminance that each light alone gives the view."""
    emitters = [mi.traverse(emitter) for emitter in space.scene.emitters()]
    keys = [[key for key, _ in one if key.endswith((".value", ".data", "scale"))] for one in emitters]
    # Copies: an assignment below changes the value in place.
    own = [{key: type(one[key])(one[key]) for key in names} for one, names in zip(emitters, keys, strict=True)]

    def shine(wanted: set[int]) -> None:
        for index, (one, values) in enumerate(zip(emitters, own, strict=True)):
            for key, value in values.items():
                one[key] = value if index in wanted else 0 * value
            one.update()

    images = {}
    for shining, emitter in enumerate(space.scene.emitters()):
        shine({shining})
        name = emitter.get_shape().id() if emitter.get_shape() is not None else emitter.id()
        images[name] = _render_luminance(space, camera)
    shine(set(range(len(emitters))))
    return images


def _measure_level(image: np.ndarray) -> float:
    """Mean of the darker 90 % of an image's pixels, so that a visible lamp does not count."""
    values = np.sort(image.ravel())
    return float(values[: max(1, int(0.9 * len(values)))].mean())


def _make_light_keys(
    space: FreeSpace, images: Mapping[str, np.ndarray], rng: np.random.Generator, frames: int, level: float
) -> dict[str, list[dict[str, Any]]]:
    """An animation's "lights": tints, lights that are off, and one that is switched or dims in the clip."""
    colored = space.file.lights()
    names = sorted(set(images) & set(colored))
    gains = {name: float(np.exp(rng.normal(0, 0.6))) for name in names}
    for name in names:
        left = sum(gains[other] * _measure_level(images[other]) for other in names if other != name)
        if rng.random() < 0.2 and left > 0.1 * gains[name] * _measure_level(images[name]):
            gains[name] = 0.0
    factor = level / max(_measure_level(sum((gains[name] * images[name] for name in names), np.zeros(1))), 1e-9)
    tint = {name: _draw_tint(rng) if colored[name] else np.ones(3) for name in names}
    keys = {name: [{"frame": 0.0, "scale": (factor * gains[name] * tint[name]).tolist()}] for name in names}
    lit = [name for name in names if gains[name] > 0]
    if lit and frames > 2 and rng.random() < 0.4:
        name = str(rng.choice(lit))
        rest = sum(gains[other] * _measure_level(images[other]) for other in lit if other != name)
        # Without other light it dims and is not switched off.
        least = 0.0 if rest > 0.1 * gains[name] * _measure_level(images[name]) else rng.uniform(0.1, 0.4)
        at = int(rng.integers(1, frames - 1)) if frames > 3 else 1
        over = 1 if rng.random() < 0.6 else int(rng.integers(1, frames - at + 1))
        ends = [keys[name][0]["scale"], (least * np.array(keys[name][0]["scale"])).tolist()]
        if rng.random() < 0.5:
            ends.reverse()
        keys[name] = [
            {"frame": float(when), "scale": scale} for when, scale in zip((at - 1, at - 1 + over), ends, strict=True)
        ]
    return keys


def _draw_tint(rng: np.random.Generator) -> np.ndarray:
    """[3] factors from warm to cold light, now and then a colour; their mean is 1."""
    warm = rng.normal(0, 0.25)
    tint = np.exp([warm, 0.0, -warm])
    if rng.random() < 0.15:
        tint = tint * rng.uniform(0.15, 1.0, 3)
    return tint / tint.mean()


def _draw_materials(space: FreeSpace, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """An animation's "materials": other hues, saturations, tints and roughnesses for a random share of them."""
    share = rng.choice([0.15, 0.5, 0.9])
    changes: dict[str, dict[str, Any]] = {}
    for name, bsdf in sorted(dict(name_materials(space.scene)).items()):
        colored, rough = can_override(bsdf)
        change: dict[str, Any] = {}
        if colored and rng.random() < share:
            change["hue"] = float(rng.uniform(-180, 180))
            change["saturation"] = float(rng.uniform(0.7, 2.5))
            if rng.random() < 0.4:  # what is grey has no hue to turn
                change["tint"] = (1 - rng.uniform(0.2, 1) * (1 - rng.uniform(0.1, 1.0, 3))).tolist()
        if rough and rng.random() < 0.5 * share:
            change["roughness"] = float(rng.uniform(0.1, 0.8))
        if change:
            changes[name] = change
    return changes


def _measure_scene_level(scene: SceneFile, frame: int) -> float:
    """The level of light of one frame."""
    built = scene.build(frame, _SIDE, _SIDE)
    integrator = _make_integrator(built, scene.max_depth)
    image = mi.render(built, integrator=integrator, spp=_SAMPLES, seed=mi.UInt32(frame))
    return _measure_level(_compute_luminance(image))


def _compute_luminance(image: Any) -> np.ndarray:
    """[H, W] mean of the colours of a rendered image."""
    return np.nan_to_num(np.array(image, np.float64))[..., :3].mean(axis=-1)


def _scale_lights(animation: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """The animation with all of the room's lights scaled."""

    def scaled(keys: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        return [{**key, "scale": [factor * value for value in key["scale"]]} for key in keys]

    return {**animation, "lights": {name: scaled(keys) for name, keys in animation.get("lights", {}).items()}}
