"""What moves in a parlour, and the camera: each from standstill to 30 pixels a frame at a width of 128."""

from collections.abc import Callable

import numpy as np

from jaxdn.render.families import finishes, furniture, shapes
from jaxdn.render.families.rooms import Room
from jaxdn.render.families.staging import look_at, matte, rod, scale, shift, shuttle, swing, turn
from jaxdn.render.scenes.scene import Camera

LEAST = 4
"""Moving parts that every room has at least."""


def set_in_motion(room: Room) -> None:
    """A ball, and further things until enough of them move; in some rooms they first rest for a while."""
    rng, stage = room.rng, room.stage
    tempo = float(rng.choice([0.15, 0.5, 1.0]))
    rest = float(rng.uniform(4, 16)) if rng.random() < 0.25 else 0.0

    def clock(frame: float) -> float:
        return tempo * max(0.0, frame - rest)

    makers = [_ball, _fan, _cleaner, _drone, _pendulum]
    least = LEAST + int(rng.integers(0, 3))
    for index in (0, *(1 + rng.permutation(len(makers) - 1))):
        if index == 0 or sum(part.moves for part in stage.parts.values()) < least:
            makers[index](room, clock)


Clock = Callable[[float], float]


def _track(room: Room, radius: float, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """The ends of a long line that a ball of the radius can follow, between two heights; if possible in view.

    Args:
      room: gives the space.
      radius: of the ball.
      low: least height of its centre.
      high: greatest height of its centre.
    """
    rng, camera = room.rng, room.stage.camera(5)
    score = 0.0
    best = (np.array([-0.1, 0.6 * room.height, 0.0]), np.array([0.1, 0.6 * room.height, 0.0]))
    inner = radius + 0.03
    for _ in range(60):
        ends = rng.uniform(room.low + inner, room.high - inner, (2, 3))
        ends[:, 1] = rng.uniform(low, high, 2) if high > low else low
        local = np.linalg.inv(camera.to_world) @ [*ends.mean(0), 1]
        seen = local[2] > 0.7 and np.hypot(local[0], local[1]) < local[2] * np.tan(np.radians(camera.x_fov / 2))
        value = float(np.linalg.norm(ends[1] - ends[0])) + (4.0 - local[2] if seen else 0.0)
        if value > score and room.line(ends[0], ends[1], radius):
            best, score = (ends[0], ends[1]), value
    return best


def _fastest(room: Room, start: np.ndarray, end: np.ndarray) -> float:
    """The speed in metres a frame that is 30 pixels at a width of 128 where the line is nearest to the camera."""
    camera = room.stage.camera(0)
    points = start + np.linspace(0, 1, 16)[:, None] * (end - start)
    nearest = float(np.linalg.norm(points - camera.to_world[:3, 3], axis=1).min())
    return 30 * nearest * 2 * float(np.tan(np.radians(camera.x_fov / 2))) / 128


def _ball(room: Room, clock: Clock) -> None:
    """A ball thrown to and fro, turning as it flies, at up to 0.45 m a frame."""
    rng = room.rng
    radius = rng.uniform(0.07, 0.2)
    start, end = _track(room, radius, radius + 0.3, room.height - radius - 0.2)
    middle, reach = (start + end) / 2, (end - start) / 2
    speed = min(rng.uniform(0.12, 0.45), _fastest(room, start, end))
    period, phase, spin = float(4 * np.linalg.norm(reach) / speed), rng.random(), rng.uniform(-35, 35)

    def ball(frame: float) -> np.ndarray:
        place = middle + reach * shuttle(clock(frame), period, phase)
        return shift(*place) @ turn("y", 40) @ turn("x", spin * clock(frame)) @ scale(radius)

    bands = finishes.pattern(rng, [finishes.strong_color(rng) for _ in range(4)])
    material = finishes.any_metal(rng) if rng.random() < 0.3 else finishes.plastic(rng)._replace(color=bands)
    room.stage.add("ball", "sphere", ball, material)


def _fan(room: Room, clock: Clock) -> None:
    """A ceiling fan with three to five blades."""
    rng = room.rng
    reach = min(rng.uniform(0.4, 0.75), room.high[0] - 0.2, room.high[2] - 0.2)
    for _ in range(10):
        x, z = (rng.uniform(-1, 1) * (room.high[axis] - reach - 0.05) for axis in (0, 2))
        middle = np.array([x, room.height - 0.25, z])
        if not room.hits(np.stack([middle - (reach, 0.2, reach), middle + (reach, 0.2, reach)]), 0.0):
            break
    rate, blades = rng.choice([-1, 1]) * rng.uniform(4, 40), furniture.fan(int(rng.integers(3, 6)))
    drop = rng.uniform(0.2, 0.35)
    hub = shift(x, room.height - drop, z)
    size = scale(reach)
    room.stage.add("fan", blades, lambda frame: hub @ turn("y", rate * clock(frame)) @ size, finishes.hard(rng))
    # The rod turns with its blades.
    pole = rod((0, 0, 0), (0, drop - 0.002, 0), 0.012)
    metal = finishes.any_metal(rng)
    room.stage.add("fan_rod", shapes.drum(), lambda frame: hub @ turn("y", rate * clock(frame)) @ pole, metal)


def _cleaner(room: Room, clock: Clock) -> None:
    """A flat round machine that drives to and fro on the floor, with a knob on it."""
    rng = room.rng
    start, end = _track(room, 0.17, 0.18, 0.18)
    middle, reach = (start + end) / 2, (end - start) / 2
    speed = rng.uniform(0.02, 0.12)
    period, phase = float(4 * np.linalg.norm(reach) / speed), rng.random()

    def drive(frame: float) -> np.ndarray:
        place = middle + reach * shuttle(clock(frame), period, phase)
        return shift(place[0], 0.012, place[2]) @ turn("y", 3 * clock(frame))

    body, knob = scale(0.16, 0.08, 0.16), shift(0.05, 0.08, 0) @ scale(0.045)
    room.stage.add("cleaner", shapes.drum(0.95), lambda frame: drive(frame) @ body, finishes.plastic(rng))
    room.stage.add("cleaner_knob", "sphere", lambda frame: drive(frame) @ knob, finishes.any_metal(rng))


def _drone(room: Room, clock: Clock) -> None:
    """A toy that circles under the ceiling: a body with four thin arms, and a tail."""
    rng = room.rng
    for _ in range(20):
        circle, high = rng.uniform(0.3, min(room.high[0], room.high[2]) - 0.3), rng.uniform(0.55, 0.85)
        rounds = [turn("y", angle)[:3, :3] @ (circle, 0, 0) + (0, high * room.height, 0) for angle in range(0, 360, 15)]
        if not any(room.hits(np.stack([point - 0.15, point + 0.15]), 0.0) for point in rounds):
            break
    lap, phase = rng.uniform(12, 60) * rng.choice([-1, 1]), rng.uniform(0, 360)
    lap = np.sign(lap) * max(abs(lap), 2 * np.pi * circle / 0.4)
    arms = [furniture.stick((0, 0, 0), (x, 0.1, z), 0.05) for x in (-1, 1) for z in (-1, 1)]
    body = shapes.join(*arms, shapes.placed(shapes.soft_box(0.5, 0.5, rows=12, columns=20), (0, 0, 0), (0.4, 0.2, 0.6)))

    def fly(frame: float) -> np.ndarray:
        height = high * room.height + 0.06 * swing(clock(frame), 23)
        around = turn("y", phase + 360 * clock(frame) / lap)
        return shift(0, height, 0) @ around @ shift(circle, 0, 0) @ turn("z", 15)

    room.stage.add("drone", body, lambda frame: fly(frame) @ scale(0.13), finishes.plastic(rng))
    tail = shift(0, 0.03, 0.16) @ scale(0.05)
    room.stage.add("drone_tail", shapes.star(4), lambda frame: fly(frame) @ tail, finishes.any_metal(rng))


def _pendulum(room: Room, clock: Clock) -> None:
    """The pendulum of a clock on a wall: a thin rod and a disk."""
    rng, stage = room.rng, room.stage
    wall = room.walls[int(rng.integers(4))]
    x, high, long = rng.uniform(-0.7, 0.7) * wall.half, rng.uniform(0.75, 0.9) * room.height, rng.uniform(0.25, 0.5)
    period, lean = rng.uniform(8, 40), rng.uniform(8, 25)
    hung = wall.frame @ shift(x, high, 0.09)
    disk = shift(0, -long, 0) @ turn("x", 90) @ scale(0.07, 0.012, 0.07)
    bar = rod((0, -long, 0), (0, 0, 0), 0.005)
    finish = finishes.any_metal(rng)
    for name, local in (("pendulum", disk), ("pendulum_rod", bar)):

        def swings(frame: float, local: np.ndarray = local) -> np.ndarray:
            return hung @ turn("z", lean * swing(clock(frame), period)) @ local

        stage.add(name, shapes.drum(), swings, finish)
    stage.add("clock", "cube", hung @ shift(0, 0.08, -0.04) @ scale(0.11, 0.11, 0.04), matte(finishes.any_color(rng)))


def film(room: Room) -> None:
    """A third of the cameras stand nearly still, a third move slowly, a third pan, shake, zoom or ride fast."""
    rng = room.rng
    fov = float(rng.uniform(35, 80))
    eye, aim, clear = _viewpoint(room, fov)
    pace = int(rng.integers(3))
    if pace == 0:
        _stand(room, eye, aim, fov)
    elif pace == 1:
        _drift(room, eye, aim, fov, clear)
    else:
        _rush(room, eye, aim, fov, clear)
    room.taken.append(np.stack([eye - 0.5, eye + 0.5]))


def _viewpoint(room: Room, fov: float) -> tuple[np.ndarray, np.ndarray, float]:
    """A free place for the eye, with many things in view; one of them as the aim; and how far the eye can move."""
    rng = room.rng
    best, best_score = (np.array([0.0, 0.75 * room.height, 0.0]), np.array([0.0, 0.5, -1.0]), 0.1), -1.0
    sights = np.array(room.sights)
    zone = int(rng.integers(4))
    low, high = [(0.15, 0.6), (0.9, 1.6), (0.9, 1.6), (room.height - 0.6, room.height - 0.2)][zone]
    for _ in range(90):
        eye = rng.uniform(room.low + 0.2, room.high - 0.2)
        eye[1] = rng.uniform(low, high)
        clear = min(_distance(eye, room), *(eye - room.low)[[0, 2]], *(room.high - eye), eye[1])
        if clear < 0.15:
            continue
        aim = sights[int(rng.integers(len(sights)))] + rng.uniform(-0.3, 0.3, 3)
        away = np.linalg.norm(aim - eye)
        steep = abs(aim[1] - eye[1]) / max(away, 1e-6)
        if away < 1.0 or steep > 0.8:
            continue
        rays = (sights - eye) / np.linalg.norm(sights - eye, axis=1, keepdims=True)
        seen = (rays @ ((aim - eye) / away) > np.cos(np.radians(0.5 * fov))) & (
            np.linalg.norm(sights - eye, axis=1) > 0.8
        )
        ahead = _distance(eye + 0.5 * (aim - eye) / away, room)
        score = min(seen.sum(), 9) + min(away, 3.0) + (1.5 if ahead > 0.1 else -1.5)
        if score > best_score:
            best, best_score = (eye, aim, float(clear)), score
        if best_score > 9.5:
            break
    return best


def _distance(point: np.ndarray, room: Room) -> float:
    """The distance of a point to the nearest box that is taken."""
    outside = [np.maximum(np.maximum(box[0] - point, point - box[1]), 0) for box in room.taken]
    return float(min((np.linalg.norm(each) for each in outside), default=9.0))


def _stand(room: Room, eye: np.ndarray, aim: np.ndarray, fov: float) -> None:
    """Held by a hand that trembles, or fixed."""
    tremble = room.rng.choice([0.0, 0.0, 0.004, 0.012])
    times, phases = room.rng.uniform(7, 40, 3), room.rng.random(3)

    def view(frame: float) -> Camera:
        offset = tremble * np.array([swing(frame, *each) for each in zip(times, phases, strict=True)])
        return Camera(look_at(eye + 0.5 * offset, aim + offset), fov)

    room.stage.view = view


def _drift(room: Room, eye: np.ndarray, aim: np.ndarray, fov: float, clear: float) -> None:
    """On a slow closed path, as a person sways or a dolly rolls."""
    rng = room.rng
    reach = np.array([0.8, 0.4, 0.8]) * min(clear - 0.08, 0.3) * rng.uniform(0.5, 1, 3)
    times, phases, pan = rng.uniform(40, 120, 3), rng.random(3), rng.uniform(0, 0.3, 3)

    def view(frame: float) -> Camera:
        waves = np.array([swing(frame, *each) for each in zip(times, phases, strict=True)])
        return Camera(look_at(eye + reach * waves, aim + pan * waves[::-1]), fov)

    room.stage.view = view


def _rush(room: Room, eye: np.ndarray, aim: np.ndarray, fov: float, clear: float) -> None:
    """A whip pan, a steady turn, a shaking hand or a quick zoom, all on a path that sways.

    The rates are given in pixels a frame at 128 pixels, so that a wide view turns faster.
    """
    rng = room.rng
    base, kind = look_at(eye, aim), int(rng.integers(4))
    degrees = rng.uniform(5, 28) * fov / 128
    sense, phase = rng.choice([-1, 1]), rng.uniform(-0.1, 0.1)
    period = rng.uniform(16, 40)
    reach = 0.8 * (clear - 0.08) * np.array([1.0, 0.4, 1.0])
    sway = np.maximum(rng.uniform(12, 40, 3), 2 * np.pi * np.linalg.norm(reach) / 0.09)
    shake, beats = rng.uniform(0.1, 0.3) * degrees, rng.uniform(5, 11, 2)
    to_world = shift(*-eye) @ base  # the orientation alone

    def view(frame: float) -> Camera:
        yaw = pitch = 0.0
        angle = fov
        if kind == 0:
            yaw = sense * degrees * period / (2 * np.pi) * swing(frame, period, phase)
        elif kind == 1:
            yaw = sense * 0.7 * degrees * frame
        elif kind == 2:
            yaw, pitch = (degrees * beats[axis] / 12 * swing(frame, beats[axis], axis / 4) for axis in (0, 1))
        else:
            angle = 57.0 + 20 * sense * swing(frame, period, phase)
            yaw = 0.4 * degrees * frame
        pitch += shake * swing(frame, 9.3)
        offset = reach * [swing(frame, each) for each in sway]
        return Camera(shift(*(eye + offset)) @ turn("y", yaw) @ to_world @ turn("x", pitch), angle)

    room.stage.view = view
