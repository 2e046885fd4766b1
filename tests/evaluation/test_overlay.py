"""``jaxdn inspect SHOT --overlay DIR``: a good shot gives no finding, each fault gives its own, with what to do."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.data.exr.exr import read_exr, write_exr
from jaxdn.evaluation.overlay.camera import CameraMatrices, camera_motion, read_camera
from jaxdn.evaluation.overlay.evidence import box_mean, fireflies, noise_map
from jaxdn.evaluation.overlay.findings import Known, find_all
from jaxdn.evaluation.overlay.views import draw_views

HEIGHT, WIDTH = 72, 96
STEP = (3, -2)
"""The square moves by so many pixels a frame: x, y down."""
PAN = (-2, 1)
"""The wall moves by so many."""


def _texture(seed, height=HEIGHT, width=WIDTH):
    """A periodic texture of 0.15 to 0.85 whose spots are three pixels wide."""
    noise = np.random.default_rng(seed).uniform(size=(height, width, 3))
    smooth = sum(np.roll(noise, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)) / 9
    return np.clip(0.5 + 2.2 * (smooth - 0.5), 0.15, 0.85)


WALL, PAINT = _texture(0), _texture(1, 28, 32)


def frame_of(index):
    """Channels [H, W, C] of a frame as Cycles writes it; float32. A square slides over a wall, and the camera pans."""
    rng = np.random.default_rng(50 + index)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    left, top = 20 + STEP[0] * index, 30 + STEP[1] * index
    square = ((columns >= left) & (columns < left + 32) & (rows >= top) & (rows < top + 28))[..., None]
    albedo = np.roll(WALL, (PAN[1] * index, PAN[0] * index), (0, 1))
    albedo[top : top + 28, left : left + 32] = PAINT
    normal = np.where(square, (0.6, -0.64, 0.48), (0.0, -0.28, 0.96))
    light = albedo * (0.5 + 0.4 * square) * rng.gamma(6, 1 / 6, (HEIGHT, WIDTH, 1))
    forward = np.where(square, STEP, PAN) * (1, -1)  # y up
    return {
        "Combined": light,
        "Depth": np.where(square, 4.0, 9.0),
        "Vector": np.concatenate([-forward, -forward], axis=-1),
        "Object Index": np.where(square, 2.0, 1.0),
        "Denoising Albedo": albedo,
        "Denoising Normal": normal,
    }


LETTERS = {"Combined": "RGB", "Depth": "Z", "Vector": "XYZW", "Object Index": "X"}
LETTERS |= {"Denoising Albedo": "RGB", "Denoising Normal": "XYZ", "motion": "XY"}


def write_frame(path, layers):
    """The layers that are not None."""
    channels = {
        f"ViewLayer.{name}.{letter}": np.ascontiguousarray(image[..., i], np.float32)
        for name, image in layers.items()
        if image is not None
        for i, letter in enumerate(LETTERS[name])
    }
    write_exr(path, channels)


def write_shot(folder, change=lambda index, layers: layers, frames=4):
    """A shot, each frame of which is changed."""
    folder.mkdir(parents=True)
    for index in range(frames):
        write_frame(folder / f"shot_{index + 1:04d}.exr", change(index, frame_of(index)))
    return folder


@pytest.fixture
def inspect(tmp_path, capsys):
    """``inspect(shot, *options)``: the JSON of the command, with its overlay."""

    def run(shot, *options):
        out = tmp_path / "overlay"
        main.main(["inspect", str(shot), "--overlay", str(out), "--json", *options])
        return json.loads(capsys.readouterr().out)

    return run


def names(record):
    return [finding["name"] for finding in record["findings"]]


def test_a_good_shot_gives_no_finding(tmp_path, inspect):
    record = inspect(write_shot(tmp_path / "shot"))
    assert record["findings"] == []
    page = (tmp_path / "overlay" / "overlay.html").read_text("utf-8")
    assert record["overlay"] == str(tmp_path / "overlay" / "overlay.html")
    assert "Nothing was found." in page
    assert len(page) < 3_000_000
    assert not re.search(r"(src|href)=[\"']?https?:", page)
    files = sorted(path.name for path in (tmp_path / "overlay").iterdir())
    assert files == ["overlay.html", *(f"shot_{index:04d}.exr" for index in range(1, 5))]


def test_the_layers_hold_what_was_measured(tmp_path, inspect):
    inspect(write_shot(tmp_path / "shot"))
    layers = read_exr(tmp_path / "overlay" / "shot_0004.exr")
    motion = np.stack([layers["measured_motion.X"], layers["measured_motion.Y"]], -1).astype(np.float32)
    certain = np.isfinite(motion).all(-1)
    assert certain.mean() > 0.5
    given = np.stack([layers["motion.X"], layers["motion.Y"]], -1).astype(np.float32)
    wall = (given == [-PAN[0], -PAN[1]]).all(-1)
    assert (given[~wall] == [-STEP[0], -STEP[1]]).all()
    assert np.median(np.abs(motion - given)[certain & wall]) < 0.1
    assert np.median(np.abs(motion - given)[certain & ~wall]) < 0.1
    assert (layers["history.Y"].max(), layers["history.Y"].min()) == (4, 1)
    # What the square has uncovered, and what has come into the picture, have no history.
    assert layers["history.Y"][:, -2:].max() < 4
    uncovered = (layers["rejected.Y"] > 0) & wall
    assert 20 < uncovered.sum() < 400
    assert layers["outside.Y"][:, -1].all()
    assert layers["fireflies.Y"].sum() == 0


TURNS = {"with y turned": (1, -1), "with x turned": (-1, 1), "turned around": (-1, -1)}


@pytest.mark.parametrize("turn", TURNS)
def test_flipped_vectors(tmp_path, inspect, turn):
    factors = np.array(TURNS[turn] * 2)
    shot = write_shot(tmp_path / "shot", lambda index, layers: layers | {"Vector": layers["Vector"] * factors}, 3)
    record = inspect(shot)
    assert names(record) == ["flipped vectors"]
    assert turn in record["findings"][0]["evidence"]
    # And what it advises is right.
    convention = re.search(r"--motion-convention (\S+)", record["findings"][0]["remedy"])[1]
    assert inspect(shot, "--motion-convention", convention)["findings"] == []


def test_vectors_with_x_and_y_swapped(tmp_path, inspect):
    def swap(index, layers):
        vector = layers["Vector"][..., [1, 0, 3, 2]] * (-1, 1, -1, 1)  # (row, column), y down
        return layers | {"Vector": vector}

    shot = write_shot(tmp_path / "shot", swap)
    record = inspect(shot, "--motion-convention", "previous-current")
    assert names(record) == ["flipped vectors"]
    assert "--motion-convention rows-columns" in record["findings"][0]["remedy"]
    assert inspect(shot, "--motion-convention", "rows-columns")["findings"] == []


def test_vectors_that_nobody_has_explained(tmp_path, inspect):
    def rename(index, layers):
        return {name: image for name, image in layers.items() if name != "Vector"} | {
            "motion": layers["Vector"][..., :2] * (1, -1)
        }

    shot = write_shot(tmp_path / "shot", rename)
    record = inspect(shot)
    assert names(record) == ["vectors without a meaning"]
    assert "State --motion-convention previous-current: " in record["findings"][0]["remedy"]
    assert "motion.X" not in read_exr(tmp_path / "overlay" / "shot_0003.exr")
    assert inspect(shot, "--motion-convention", "previous-current")["findings"] == []


def test_vectors_that_nobody_has_explained_and_the_first_frame_lacks(tmp_path, inspect, capsys):
    """Vectors of a first frame are 0: there is no frame before it."""

    def rename(index, layers):
        vectors = layers["Vector"][..., :2] * (1, -1) * (index > 0)
        return {name: image for name, image in layers.items() if name != "Vector"} | {"motion": vectors}

    shot = write_shot(tmp_path / "shot", rename)
    record = inspect(shot)
    assert record["fitting_conventions"] == ["previous-current"]
    assert names(record) == ["vectors without a meaning"]
    main.main(["inspect", str(shot)])
    assert "--motion-convention previous-current" in capsys.readouterr().out


def test_vectors_of_another_size(tmp_path, inspect):
    """As of a picture of three times the size."""
    record = inspect(write_shot(tmp_path / "shot", lambda index, layers: layers | {"Vector": 3 * layers["Vector"]}))
    assert names(record)[0] in ("vectors of something else", "vectors where nothing moves")


def test_missing_vectors(tmp_path, inspect):
    record = inspect(write_shot(tmp_path / "shot", lambda index, layers: layers | {"Vector": 0 * layers["Vector"]}))
    assert "no motion vectors" in names(record)
    assert "Passes > Vector" in next(f["remedy"] for f in record["findings"] if f["name"] == "no motion vectors")


@pytest.mark.slow
def test_swapped_guides(tmp_path, inspect):
    def swap(index, layers):
        albedo, normal = layers["Denoising Albedo"], layers["Denoising Normal"]
        return layers | {"Denoising Albedo": normal, "Denoising Normal": albedo}

    record = inspect(write_shot(tmp_path / "shot", swap))
    assert names(record) == ["swapped guides: albedo and normal"]
    _, options = record["findings"][0]["remedy"].removesuffix(".").split("the other way around: ")
    albedo, normal = "albedo=ViewLayer.Denoising Normal", "normal=ViewLayer.Denoising Albedo"
    assert shlex.split(options) == ["--channels", albedo, normal]
    # Blender's normals have the letters X, Y and Z.
    assert names(inspect(tmp_path / "shot", *shlex.split(options))) == []


def test_swapped_guides_whose_normals_are_colours(tmp_path, inspect):
    def swap(index, layers):
        albedo, normal = layers["Denoising Albedo"], layers["Denoising Normal"]
        return layers | {"Denoising Albedo": 0.5 + 0.5 * normal, "Denoising Normal": albedo}

    assert names(inspect(write_shot(tmp_path / "shot", swap))) == ["swapped guides: albedo and normal"]


def test_normals_stored_as_colours(tmp_path, inspect):
    def encode(index, layers):
        return layers | {"Denoising Normal": 0.5 + 0.5 * layers["Denoising Normal"]}

    assert names(inspect(write_shot(tmp_path / "shot", encode))) == ["normals stored as colours"]


def test_an_albedo_that_is_upside_down(tmp_path, inspect):
    turned = "Denoising Albedo"
    record = inspect(write_shot(tmp_path / "shot", lambda index, layers: layers | {turned: layers[turned][::-1]}))
    assert "flipped guide: albedo" in names(record)
    assert "upside down" in next(f["evidence"] for f in record["findings"] if f["name"].startswith("flipped guide"))


def test_fireflies(tmp_path, inspect):
    def sparkle(index, layers):
        light = layers["Combined"].copy()
        rng = np.random.default_rng(index)
        light[rng.integers(2, HEIGHT - 2, 30), rng.integers(2, WIDTH - 2, 30)] = 80.0
        return layers | {"Combined": light}

    record = inspect(write_shot(tmp_path / "shot", sparkle))
    assert names(record) == ["fireflies"]
    layers = read_exr(tmp_path / "overlay" / "shot_0002.exr")
    assert 25 <= layers["fireflies.Y"].sum() <= 30


def test_frames_that_differ(tmp_path, inspect):
    def spoil(index, layers):
        if index == 1:  # another size
            return {name: image[:-8] for name, image in layers.items()}
        return layers | ({"Denoising Normal": None} if index == 3 else {})

    shot = write_shot(tmp_path / "shot", spoil, frames=8)
    whole = (shot / "shot_0006.exr").read_bytes()
    (shot / "shot_0006.exr").write_bytes(whole[: len(whole) // 2])
    damaged = bytearray((shot / "shot_0007.exr").read_bytes())
    damaged[len(damaged) // 2 : len(damaged) // 2 + 400] = b"\xff" * 400  # complete, and cannot be decoded
    (shot / "shot_0007.exr").write_bytes(damaged)
    record = inspect(shot)
    assert names(record) == ["frames that differ"]
    evidence = record["findings"][0]["evidence"]
    assert "shot_0002.exr: expected 96 x 72 pixels" in evidence
    assert "shot_0004.exr: expected the buffers of the other frames, got a file without normal" in evidence
    assert "shot_0006.exr" in evidence
    assert "shot_0007.exr" in evidence
    assert (tmp_path / "overlay" / "shot_0008.exr").is_file()


def test_missing_frames_are_a_finding(tmp_path, inspect):
    shot = write_shot(tmp_path / "shot", frames=6)
    (shot / "shot_0003.exr").unlink()
    record = inspect(shot)
    assert names(record) == ["missing frames"]
    assert record["findings"][0]["evidence"] == "3 missing."
    history = [read_exr(tmp_path / "overlay" / f"shot_{index:04d}.exr")["history.Y"].max() for index in (1, 2, 4, 5, 6)]
    assert history == [1, 2, 1, 2, 3]  # it begins anew, and no motion is measured across the gap


def test_a_frame_of_another_brightness(tmp_path, inspect):
    def brighten(index, layers):
        return layers | {"Combined": layers["Combined"] * (2 if index == 2 else 1)}

    record = inspect(write_shot(tmp_path / "shot", brighten, frames=5))
    assert names(record) == ["frames of another brightness"]
    assert "shot_0003.exr (2.0" in record["findings"][0]["evidence"]


def test_noise_that_stands_still(tmp_path, inspect):
    still = frame_of(0)
    still["Vector"] = 0 * still["Vector"]
    assert "noise that stands still" in names(inspect(write_shot(tmp_path / "shot", lambda index, layers: still)))

    def fresh(index, layers):
        noise = np.random.default_rng(index).gamma(6, 1 / 6, (HEIGHT, WIDTH, 1))
        return still | {"Combined": still["Denoising Albedo"] * noise}

    assert names(inspect(write_shot(tmp_path / "other", fresh))) == []


def test_frames_without_noise(tmp_path, inspect):
    def clean(index, layers):
        return layers | {"Combined": np.full((HEIGHT, WIDTH, 3), 0.5) + 0.2 * (layers["Depth"] < 5)}

    assert names(inspect(write_shot(tmp_path / "shot", clean))) == ["no noise"]


@pytest.mark.parametrize(("noisy", "expected"), [(True, []), (False, ["no noise"])])
def test_a_sky_that_fills_most_of_the_picture_is_no_sign_of_noise_or_none(tmp_path, inspect, noisy, expected):
    """An object in front of an even world, as Blender starts with it."""

    def over_sky(index, layers):
        square = layers["Depth"] < 5
        light = layers["Combined"] if noisy else np.full((HEIGHT, WIDTH, 3), 0.6)
        layers["Denoising Normal"] = layers["Denoising Normal"] * square
        return layers | {
            "Combined": np.where(square, light, 0.05),
            "Depth": np.where(square, layers["Depth"], 1e10),
            "Vector": layers["Vector"] * square,
            "Denoising Albedo": layers["Denoising Albedo"] * square,
            "Object Index": layers["Object Index"] * square,
        }

    found = names(inspect(write_shot(tmp_path / "shot", over_sky)))
    assert [name for name in found if "noise" in name] == expected


def test_what_was_hidden_is_not_painted_as_another_surface(rng):
    """Pixels that come into sight have no history because they cannot have one."""
    frame = Frame(rng.uniform(0.2, 0.8, (4, 6, 3)).astype(np.float32))
    layers = {name: np.zeros((4, 6, 1), bool) for name in ("rejected", "disoccluded", "outside", "fireflies")}
    layers["rejected"][1:3, 1:4] = layers["disoccluded"][1:3, 2:5] = layers["outside"][:, 5:] = True
    seen = draw_views(frame, layers | {"history": np.ones((4, 6, 1))})["rejected"]
    red, yellow, blue = ((seen == colour).all(-1) for colour in ((0.9, 0.1, 0.1), (1, 0.85, 0), (0.2, 0.4, 1)))
    np.testing.assert_array_equal(red, (layers["rejected"] & ~layers["disoccluded"])[..., 0])
    np.testing.assert_array_equal(yellow, layers["disoccluded"][..., 0])
    np.testing.assert_array_equal(blue, layers["outside"][..., 0])


@pytest.mark.parametrize(
    ("light", "expected"),
    [(0.0, ["no light"]), (np.nan, ["light that is no number", "no light"])],
)
def test_frames_without_light(tmp_path, inspect, light, expected):
    """They are not told to have been denoised already."""
    record = inspect(
        write_shot(tmp_path / "shot", lambda index, layers: layers | {"Combined": layers["Combined"] * light})
    )
    assert [name for name in names(record) if "light" in name or "noise" in name] == expected


@pytest.mark.filterwarnings("error")
def test_single_pixels_that_are_no_numbers(tmp_path, inspect):
    def spoil(index, layers):
        layers["Combined"][10 + index, 20] = np.inf
        return layers

    (finding,) = inspect(write_shot(tmp_path / "shot", spoil))["findings"]
    assert finding["name"] == "light that is no number"
    assert "0.01% of the pixels" in finding["evidence"]


def test_frames_that_are_too_small(tmp_path, capsys):
    shot = write_shot(tmp_path / "shot", lambda index, layers: {name: image[:3] for name, image in layers.items()})
    with pytest.raises(SystemExit) as ended:
        main.main(["inspect", str(shot), "--overlay", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert "--overlay: expected 4 pixels a side or more, got 96 x 3" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_ids_that_change_reject_the_history(tmp_path, inspect):
    def renumber(index, layers):
        return layers | {"Object Index": layers["Object Index"] + 2 * index}

    record = inspect(write_shot(tmp_path / "shot", renumber))
    assert names(record) == ["history is rejected"]
    assert "--channels ids=none" in record["findings"][0]["remedy"]


def test_noisy_guides(tmp_path, inspect):
    def spread(index, layers):
        noise = np.random.default_rng(index).normal(scale=0.25, size=(HEIGHT, WIDTH, 3))
        return layers | {"Denoising Normal": layers["Denoising Normal"] + noise}

    assert "noisy guide: normal" in names(inspect(write_shot(tmp_path / "shot", spread)))


def test_several_shots_have_a_folder_each(tmp_path, capsys):
    for name in ("a", "b"):
        write_shot(tmp_path / name, frames=2)
        for path in (tmp_path / name).iterdir():
            shutil.move(path, tmp_path / f"{name}_{path.name[-8:]}")
    out = tmp_path / "overlay"
    main.main(["inspect", str(tmp_path / "*.exr"), "--overlay", str(out)])
    text = capsys.readouterr().out
    assert text.count("0 findings; page: ") == 2
    assert "frame 2 of 2: " in text
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*.html")) == [
        f"{name}/overlay.html" for name in ("a", "b")
    ]


def test_what_has_no_overlay_is_refused(tmp_path, capsys):
    shot = write_shot(tmp_path / "shot", frames=2)
    taken = shot / "shot_0001.exr"
    for arguments in (
        ["fruit", "--overlay", str(tmp_path / "out")],
        [str(shot), "--overlay", str(shot)],
        [str(shot), "--overlay", str(taken)],
    ):
        with pytest.raises(SystemExit) as ended:
            main.main(["inspect", *arguments])
        assert ended.value.code == 2
        assert "--overlay" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
    assert sorted(path.suffix for path in shot.iterdir()) == [".exr", ".exr"]


def test_no_file_that_is_read_is_overwritten(tmp_path, capsys):
    """However its folder is called; nor a file of a single pass."""
    shot = write_shot(tmp_path / "shot", lambda index, layers: layers | {"Denoising Albedo": None}, frames=2)
    for path in shot.iterdir():
        (tmp_path / "albedo").mkdir(exist_ok=True)
        rgb = frame_of(0)["Denoising Albedo"].astype(np.float32)
        write_exr(tmp_path / "albedo" / path.name, {letter: rgb[..., i].copy() for i, letter in enumerate("RGB")})
    (tmp_path / "link").symlink_to(shot)
    before = {path: path.read_bytes() for path in tmp_path.glob("*/*.exr")}
    naming = ["--channels", f"albedo={tmp_path / 'albedo'}/*.exr"]
    for out, options in (("link", []), ("albedo/../shot", []), ("albedo", naming)):
        with pytest.raises(SystemExit) as ended:
            main.main(["inspect", str(shot), "--overlay", str(tmp_path / out), *options])
        assert ended.value.code == 2
        assert "expected another folder than that of the shot" in " ".join(capsys.readouterr().err.split())
        assert {path: path.read_bytes() for path in tmp_path.glob("*/*.exr")} == before


def test_box_means_are_those_of_what_is_in_the_image(rng):
    image = rng.random((9, 7, 2))
    found = box_mean(image, 2)
    for row, column in ((0, 0), (4, 3), (8, 6), (1, 5)):
        window = image[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
        np.testing.assert_allclose(found[row, column], window.mean(axis=(0, 1)), rtol=1e-12)


def test_noise_is_measured_beside_edges(rng):
    image = np.broadcast_to(np.where(np.arange(200) < 90, 0.2, 0.9)[:, None, None], (200, 200, 3))
    assert noise_map(np.asarray(image)).max() < 1e-12
    noisy = image + rng.normal(scale=0.07, size=image.shape)
    assert noise_map(noisy).mean() == pytest.approx(0.07, rel=0.03)


def test_only_single_bright_pixels_are_fireflies():
    image = np.full((20, 20, 3), 0.5)
    image[3, 4] = 30.0
    image[10:16, 8:14] = 30.0  # a lamp
    assert np.argwhere(fireflies(image)).tolist() == [[3, 4]]


def _camera(place, turn, focal=1.4, aspect=4 / 3):
    """Matrices for row vectors: a camera at a place, turned about y, that looks along its -z."""
    cos, sin = np.cos(turn), np.sin(turn)
    axes = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])  # rows: the camera's x, y, z in the world
    to_camera = np.eye(4)
    to_camera[:3, :3], to_camera[3, :3] = axes.T, -axes @ place
    screen = np.array([[focal, 0, 0, 0], [0, focal * aspect, 0, 0], [0, 0, 1, -1], [0, 0, 0.1, 0]])
    return CameraMatrices(to_camera, to_camera @ screen), axes


def test_the_cameras_motion_is_that_of_points_of_a_still_world():
    height, width, focal, aspect = 30, 40, 1.4, 4 / 3
    (now, axes), (before, earlier) = _camera((0.3, 0.2, 0.1), 0.1), _camera((0.1, 0.25, 0.0), 0.13)
    rows, columns = np.mgrid[:height, :width]
    depth = 3.0 + 0.05 * columns + 0.03 * rows
    # Independently: the ray of each pixel, the point at that depth, and where the earlier camera sees it.
    x = ((2 * columns + 1) / width - 1) / focal
    y = (1 - (2 * rows + 1) / height) / (focal * aspect)
    rays = x[..., None] * axes[0] + y[..., None] * axes[1] - axes[2]
    points = np.array((0.3, 0.2, 0.1)) + depth[..., None] * rays - np.array((0.1, 0.25, 0.0))
    right, up, ahead = (points @ earlier[0], points @ earlier[1], -(points @ earlier[2]))
    column = ((focal * right / ahead + 1) * width - 1) / 2
    row = ((1 - focal * aspect * up / ahead) * height - 1) / 2
    expected = np.stack([column - columns, row - rows], -1)
    assert np.abs(expected).max() > 1
    np.testing.assert_allclose(camera_motion(depth[..., None], now, before), expected, atol=1e-4)
    far = depth.copy()
    far[2, 3] = 1e6
    assert np.isnan(camera_motion(far[..., None], now, before)[2, 3]).all()
    header = {"worldToCamera": now.to_camera.T.astype(np.float32), "worldToNDC": now.to_screen.T.astype(np.float32)}
    read = read_camera(header)  # some programs write the transpose
    np.testing.assert_allclose(read.to_screen, now.to_screen, atol=1e-6)
    assert read_camera({"worldToCamera": np.eye(4), "worldToNDC": np.eye(4)}) is None
    assert read_camera({}) is None


def test_vectors_without_the_camera_are_a_finding():
    figures = {"light": 1.0, "noise": 0.1, "fireflies": 0.0, "left as given": 0.1, "left turned around": 0.2}
    camera = {"camera differs": 0.8, "left by camera": 0.02, "left beside camera": 0.1}
    known = Known("cycles", {}, "")
    (found,) = find_all(["a", "b"], [figures | camera] * 2, known)
    assert found.name == "vectors without the camera"
    moving = camera | {"left by camera": 0.2}  # what moves by itself explains the difference
    assert find_all(["a", "b"], [figures | moving] * 2, known) == []


def test_a_little_texture_that_moves_otherwise_is_no_finding():
    """As of what a mirror shows."""
    figures = {"light": 1.0, "noise": 0.1, "fireflies": 0.0, "left as given": 0.01, "left turned around": 0.2}
    figures |= {"disagrees": 0.6, "left by given": 0.02, "left by measured": 0.01}
    known = Known("cycles", {}, "")
    assert find_all(["a", "b"], [figures | {"certain": 0.02}] * 2, known) == []
    (found,) = find_all(["a", "b"], [figures | {"certain": 0.4}] * 2, known)
    assert found.name == "vectors of something else"


@pytest.mark.slow
@pytest.mark.browser
def test_the_page_plays_in_a_browser(tmp_path, inspect, browser):
    record = inspect(write_shot(tmp_path / "shot"))
    page = browser.new_page()
    page.set_default_timeout(180_000)  # a busy machine is no fault of the page
    complaints, requests = [], []
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda line: complaints.append(line.text) if line.type != "log" else None)
    page.on("request", lambda request: requests.append(request.url[:80]))
    page.goto(Path(record["overlay"]).as_uri())
    assert "shot_0002.exr (2 of 4)" in page.inner_text("#player")
    page.keyboard.press(".")
    assert "shot_0003.exr (3 of 4)" in page.inner_text("#player")
    page.select_option("select >> nth=0", "given motion")
    picture = page.locator("#player img").first
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") == WIDTH
    assert "the colour is the direction" in page.inner_text("#player")
    page.click("#player button")
    page.locator("#player .count", has_text="(1 of 4)").wait_for()
    page.close()
    assert complaints == []
    assert [url for url in requests if not url.startswith(("file:", "data:"))] == []
