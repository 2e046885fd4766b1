"""``jaxdn inspect SHOT --overlay DIR`` on a scene in perspective: depth, normals and vectors that disagree.

Each fault is written into EXR files; right files of every kind that programs write give no finding.
"""

import json

import numpy as np
import pytest

from jaxdn.commands import main
from jaxdn.data.exr.exr import write_exr
from jaxdn.evaluation.overlay.geometry import occlusion_order

HEIGHT, WIDTH = 72, 96
FOCAL = 1.2 * WIDTH
BALLS = ((0.9, -1.3), (0.6, 0.2), (0.75, 1.6))
"""Radius, and place along x; they lie on the floor."""
DEPTHS = (-1.5, 0.6, -0.4)
SPEED = 0.05
"""What is added to the way of a frame with each frame."""


def _camera(time):
    """Place, and rows: right, up, forward. It moves to the right, always faster, and turns."""
    turn = 0.15 + 0.004 * time
    cos, sin = np.cos(turn), np.sin(turn)
    return np.array((0.02 * time**2, 1.6, 5.0)), np.array(((cos, 0, sin), (0, 1, 0), (sin, 0, -cos)))


def _place(ball, time):
    radius, x = BALLS[ball]
    return np.array((x - (ball == 1) * SPEED * time**2, radius, DEPTHS[ball]))


def _project(points, time):
    """[..., 3] in the world -> column, row, depth."""
    place, axes = _camera(time)
    seen = (points - place) @ axes.T
    column = FOCAL * seen[..., 0] / seen[..., 2] + (WIDTH - 1) / 2
    return column, (HEIGHT - 1) / 2 - FOCAL * seen[..., 1] / seen[..., 2], seen[..., 2]


def frame_of(time):
    """Layers as Cycles writes them, float32: balls on a floor before a wall, with normals of world space."""
    place, axes = _camera(time)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    screen = np.stack([(columns - (WIDTH - 1) / 2) / FOCAL, ((HEIGHT - 1) / 2 - rows) / FOCAL, np.ones(rows.shape)], -1)
    rays = screen @ axes
    floor, wall = -place[1] / np.minimum(rays[..., 1], -1e-9), (-4.0 - place[2]) / np.minimum(rays[..., 2], -1e-9)
    depth, label = np.minimum(floor, wall), np.where(floor < wall, 1, 2)
    normal = np.where((label == 1)[..., None], (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    for ball, (radius, _) in enumerate(BALLS):
        towards = place - _place(ball, time)
        a, b, c = np.sum(rays * rays, -1), rays @ towards, towards @ towards - radius**2
        root = b * b - a * c
        near = (-b - np.sqrt(np.maximum(root, 0))) / a
        hit = (root > 0) & (near < depth)
        depth, label = np.where(hit, near, depth), np.where(hit, 3 + ball, label)
        normal = np.where(hit[..., None], (towards + near[..., None] * rays) / radius, normal)
    points = place + depth[..., None] * rays
    own = [np.zeros(3)] * 3 + [_place(ball, time) for ball in range(3)]
    centre = np.array(own)[label]
    paint = points - centre
    albedo = 0.5 + 0.17 * np.sin(9 * paint + label[..., None]) + 0.17 * np.sin(7 * paint[..., [1, 2, 0]] + 1)
    ways = []
    for other in (time - 1, time + 1):
        moved = np.array([np.zeros(3)] * 3 + [_place(ball, other) for ball in range(3)])[label]
        column, row, _ = _project(points + moved - centre, other)
        ways.append(np.stack([column - columns, -(row - rows)], -1))  # y up
    light = albedo * (0.3 + 0.6 * np.clip(normal @ (0.3, 0.8, 0.52), 0, 1)[..., None])
    noise = np.random.default_rng(time).gamma(6, 1 / 6, (HEIGHT, WIDTH, 1))
    return {
        "Combined": light * noise,
        "Depth": depth[..., None],
        "Vector": np.concatenate([ways[0], -ways[1]], -1),
        "Object Index": label[..., None],
        "Denoising Albedo": albedo,
        "Normal": normal,
    }


FRAMES = [frame_of(time) for time in range(2, 5)]
LETTERS = {"Combined": "RGB", "Depth": "Z", "Vector": "XYZW", "Object Index": "X"}
LETTERS |= {
    "Denoising Albedo": "RGB",
    "Normal": "XYZ",
    "Denoising Normal": "XYZ",
    "FinalImageWorldNormal": "XYZ",
    "motion": "XY",
}


@pytest.fixture
def inspect(tmp_path, capsys):
    """``inspect(change, *options)``: the findings of the shot whose frames' layers ``change`` makes."""

    def run(change, *options):
        shot = tmp_path / "shot"
        shot.mkdir(exist_ok=True)
        for index, layers in enumerate(FRAMES):
            channels = {
                f"ViewLayer.{name}.{letter}": np.ascontiguousarray(image[..., i], np.float32)
                for name, image in change(dict(layers), index).items()
                for i, letter in enumerate(LETTERS[name])
            }
            write_exr(shot / f"shot_{index + 1:04d}.exr", channels)
        main.main(["inspect", str(shot), "--overlay", str(tmp_path / "overlay"), "--json", *options])
        return {one["name"]: one for one in json.loads(capsys.readouterr().out)["findings"]}

    return run


def _camera_space(normal, index, signs=(1, 1, -1)):
    """As Cycles' Denoising Normal has them: z is what lies ahead."""
    return normal @ _camera(index + 2)[1].T * (1, 1, -1) * signs


def _with(name, change):
    """The layer ``name`` of each frame is changed."""
    return lambda layers, index: layers | {name: change(layers[name], index)}


RIGHT = {
    "world space": lambda layers, index: layers,
    "world space, z up": _with("Normal", lambda n, _: np.stack([n[..., 0], -n[..., 2], n[..., 1]], -1)),
    "a left-handed world": lambda layers, index: (
        {name: image for name, image in layers.items() if name != "Normal"}
        | {"FinalImageWorldNormal": layers["Normal"] * (1, 1, -1)}
    ),
    "a camera that looks along -z": _with("Depth", lambda z, _: -z),
    "centimetres": _with("Depth", lambda z, _: 100 * z),
    "far away": _with("Depth", lambda z, _: np.where(z > 8.8, 0, z)),
}


@pytest.mark.parametrize("kind", RIGHT)
def test_right_files_give_no_finding(inspect, kind):
    assert inspect(RIGHT[kind]) == {}


def _denoising(signs):
    """The normals as Cycles' Denoising Normal, with these signs."""

    def change(layers, index):
        return {name: image for name, image in layers.items() if name != "Normal"} | {
            "Denoising Normal": _camera_space(layers["Normal"], index) * signs
        }

    return change


@pytest.mark.parametrize("signs", [(1, 1, 1), (1, 1, -1)])
def test_both_directions_of_the_cameras_z_are_right(inspect, signs):
    assert inspect(_denoising(signs)) == {}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_with("Normal", lambda n, _: n * (-1, 1, 1)), "one axis"),
        (_with("Normal", lambda n, _: n * (1, 1, -1)), "one axis"),
        (_with("Normal", lambda n, _: n[..., [0, 2, 1]]), "one axis"),
        (_with("Normal", lambda n, _: -n), "all three"),
        (_denoising((-1, 1, 1)), "with x turned"),
        (_denoising((1, -1, 1)), "with y turned"),
        (_denoising((-1, -1, -1)), "with x and y turned"),
    ],
    ids=["x", "z", "y and z exchanged", "away", "x of the camera", "y of the camera", "away from the camera"],
)
def test_flipped_normals(inspect, change, said):
    found = inspect(change)
    assert list(found) == ["flipped normals"]
    assert said in found["flipped normals"]["evidence"] + found["flipped normals"]["remedy"]
    assert "--channels normal=none" in found["flipped normals"]["remedy"]


def test_the_normals_of_one_object_point_away(inspect):
    def turn(layers, index):
        return layers | {"Normal": np.where(layers["Object Index"] == 5, -layers["Normal"], layers["Normal"])}

    found = inspect(turn)
    assert list(found) == ["normals that point away"]
    assert "other surfaces" in found["normals that point away"]["evidence"]


@pytest.mark.parametrize(
    "change",
    [lambda z, _: 1 / z, lambda z, _: 20 - z, lambda z, _: 1 - (z - z.min()) / np.ptp(z), lambda z, _: 0.1 / z],
    ids=["1 / z", "turned", "turned and normalised", "a reversed z-buffer"],
)
def test_inverted_depth(inspect, change):
    found = inspect(_with("Depth", change))
    assert list(found) == ["inverted depth"]
    assert "--channels depth=none" in found["inverted depth"]["remedy"]


@pytest.mark.parametrize(
    "change",
    [lambda z, _: (z - z.min()) / np.ptp(z), lambda z, _: np.where(z > 8.8, 1.0, 1.01 * (1 - 0.1 / z))],
    ids=["of each frame", "a z-buffer"],
)
def test_normalised_depth(inspect, change):
    found = inspect(_with("Depth", change))
    assert "normalised depth" in found
    assert "distance" in found["normalised depth"]["remedy"]


@pytest.mark.parametrize("options", [(), ("--motion-convention", "previous-current")], ids=["Vector", "motion"])
def test_vectors_to_the_next_frame(inspect, options):
    """What is exchanged differs only where something speeds up."""

    def exchange(layers, index):
        vector = layers.pop("Vector")
        if not options:
            return layers | {"Vector": vector[..., [2, 3, 0, 1]]}
        return layers | {"motion": vector[..., 2:] * (-1, 1)}  # next minus current, y down

    found = inspect(exchange, *options)
    assert list(found) == ["exchanged vectors"]
    assert "to the next frame" in found["exchanged vectors"]["evidence"]


def test_what_is_left_out_is_no_finding(inspect):
    def spoil(layers, index):
        return layers | {"Normal": -layers["Normal"], "Depth": 1 / layers["Depth"]}

    assert inspect(spoil, "--channels", "normal=none", "depth=none") == {}


def test_a_pixel_that_was_hidden_is_behind():
    """Strips of four columns move to the right by 2 over what stands: the two columns behind each come into sight."""
    depth = np.tile(np.where(np.arange(40) // 4 % 2 == 0, 2.0, 5.0), (12, 1))
    motion = np.zeros((12, 40, 2))
    motion[..., 0] = np.where(depth == 2, -2, 0)
    change = np.where((depth == 5) & (np.arange(40) % 4 > 1), 0.5, 0.0)  # what lay below the next strip
    tested = np.ones(depth.shape, bool)
    assert occlusion_order(depth, motion, change, tested) == 1
    assert occlusion_order(1 / depth, motion, change, tested) == 0
    assert occlusion_order(depth, motion, 0 * change, tested) is None
