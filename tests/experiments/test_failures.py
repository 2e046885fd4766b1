"""The failures that the papers name: affected pixels, the share of an old image, fallbacks, the table."""

import json

import numpy as np
import pytest

from experiments.papers.failures import __main__ as failures
from experiments.papers.failures import kept, measure
from experiments.papers.failures.clips import digest_scene
from experiments.papers.failures.scenes import MOVING, SCENES
from experiments.papers.failures.sheet import make_sheet, make_table
from jaxdn.core.frame import Frame
from jaxdn.methods.registry import methods


def test_affected_is_what_was_hidden_or_shows_other_light_than_its_surface_did():
    """A bright square steps by two pixels, and its vectors say so; a shadow falls on what rests."""
    reference, motion = np.ones((3, 20, 24, 3)), np.zeros((3, 20, 24, 2), np.float32)
    visible = np.ones((3, 20, 24, 1), bool)
    for frame in range(3):
        left = 4 + 2 * frame
        reference[frame, 3:9, left : left + 6] = 4.0
        motion[frame, 3:9, left : left + 6, 0] = -2.0
        visible[frame, 3:9, left - 2 : left] = frame == 0
    reference[2, 12:18, 10:20] = 0.3
    found = measure.affected_pixels(reference, Frame(reference, motion=motion, visible=visible), moving=2)
    assert not found[0].any()
    assert found[1, 3:9, 4:6].all()  # hidden a frame ago
    assert not found[1, 5:7, 8:10].any()  # the square takes its light with it
    assert found[2, 13:17, 11:19].all()
    assert not found[1:, 0].any()
    assert not measure.affected_pixels(reference, Frame(reference, motion=motion, visible=visible), moving=1)[2].any()


def test_noise_of_a_dark_reference_is_no_change_of_light(rng):
    """Means over 3x3 pixels that scatter by an eighth, as in the dark half of `dark to light`; a third darkens."""
    reference = 0.01 * (1.0 + 0.37 * rng.normal(size=(2, 56, 96, 1))) * np.ones(3)
    reference[1, 10:30, 20:50] *= 0.33
    found = measure.affected_pixels(reference, Frame(reference), moving=1)[1]
    assert found[12:28, 22:48].mean() > 0.98
    assert found[:, 55:].mean() < 0.03


def test_the_share_of_an_old_image_is_found_in_noise(rng):
    old, new = rng.random((2, 40, 50, 3))
    where = rng.random((40, 50)) < 0.5
    for share in (0.0, 0.3, 1.0):
        image = new + share * (old - new) + 0.3 * rng.normal(size=new.shape)
        assert measure.share_of_old(image, new, old, new, where) == pytest.approx(share, abs=0.03)
        # Blur that is there without a history is none of it.
        blurred = 0.8 * new + 0.2 * old
        left = measure.share_of_old(image + blurred - new, blurred, old, new, where)
        assert left == pytest.approx(share, abs=0.03)
    # Light that finds few pixels, and these bright: black pixels are no old shadow.
    sparse = new * 4.0 * (rng.random((40, 50, 1)) < 0.25)
    assert measure.share_of_old(sparse, new, 0.2 * new, new, where) == pytest.approx(0.0, abs=0.15)
    image[~where] = 100.0
    assert measure.share_of_old(image, new, old, new, where) == pytest.approx(1.0, abs=0.03)


def test_the_response_is_the_first_frame_with_a_tenth_left():
    old, new = np.full((8, 9, 3), 0.8), np.full((8, 9, 3), 0.1)
    reference = np.stack([old] * 3 + [new] * 6)
    affected = np.zeros((9, 8, 9), bool)
    affected[3] = True

    def measured(weight, blur=0.2):
        images = [*reference[:3]]
        for wanted in reference[3:]:
            images.append(weight * wanted + (1 - weight) * images[-1])
        # One that begins with the last movement errs by a fifth of the old image, for ever.
        fresh = np.stack([0.8 * new + 0.2 * old] * 9)
        return measure.measure_failure(np.stack(images) + blur * (old - new), fresh, reference, affected, moving=3)

    assert measured(1.0).response == 0
    assert measured(0.5).response == 3  # a sixteenth
    assert measured(0.1).response is None
    assert measured(1.0, blur=0.0).psnr > 100 > measured(0.5, blur=0.0).psnr > measured(0.1, blur=0.0).psnr


def test_fallbacks_are_hidden_pixels_with_the_vector_of_their_surface():
    visible = np.ones((2, 4, 6, 1), bool)
    visible[1, :, 1:4] = False
    motion = np.full((2, 4, 6, 2), -0.5, np.float32)
    dual = motion.copy()
    dual[1, :, 2:4] = 1.0
    frame = Frame(np.ones((2, 4, 6, 3)), motion=motion, dual_motion=dual, visible=visible)
    assert measure.count_fallbacks(frame) == (12, 4)
    off = motion.copy()
    off[1, :, 1] = -9.0  # the traditional target is off screen: nothing is known of its occluder
    assert measure.count_fallbacks(frame._replace(motion=off, dual_motion=off)) == (12, 8)


def test_a_sheet_has_every_image_enlarged_under_its_name(rng):
    images = {f"method {number}": rng.random((6, 40, 3)) for number in range(6)}
    sheet = make_sheet(images)
    assert sheet.shape == (2 * (18 + 16), 4 * 120, 3)
    for number, image in enumerate(images.values()):
        top, left = 34 * (number // 4) + 16, 120 * (number % 4)
        np.testing.assert_allclose(sheet[top + 1 : top + 18 : 3, left + 1 : left + 120 : 3], image, atol=0.5 / 255)
        assert sheet[top - 16 : top, left : left + 120].min() < 0.2  # letters
    assert sheet[34:, 240:].min() == 1.0
    table = make_table({"a": [images["method 0"], images["method 1"]], "b": [images["method 2"]] * 2}, ["one", "two"])
    assert table.shape == (16 + 2 * 6, 160 + 2 * 40, 3)
    np.testing.assert_allclose(table[16:22, 200:], images["method 1"], atol=0.5 / 255)
    np.testing.assert_allclose(table[22:, 160:200], images["method 2"], atol=0.5 / 255)
    with pytest.raises(ValueError, match="expected 2 images in each, got others in b"):
        make_table({"a": [images["method 0"]] * 2, "b": []}, ["one", "two"])
    with pytest.raises(ValueError, match="expected one size"):
        make_sheet({"a": images["method 0"], "b": images["method 1"][:3]})


def test_a_method_that_never_responds_says_so():
    found = {"taa": {"shadow": measure.Failure(20.0, None), "blur": measure.Failure(20.0, 0)}}
    counts = {name: {"affected": 5} for name in ("shadow", "blur")}
    described = failures.describe(failures.Settings(), found, counts)
    assert described["failures-response"]["rows"] == [["taa", "never", 0]]


def test_every_preset_of_a_paper_that_is_a_filter_has_a_row():
    presets = {name for name, method in methods().items() if method.filter and "paper" in method.presets}
    assert presets == set(failures.PAPERS)


@pytest.mark.slow
@pytest.mark.needs("llvm")
def test_the_clips_fail_what_they_are_for(tmp_path, capsys):
    """Dual vectors leave the image, light changes where nothing moves; the table has a row a method."""
    out = tmp_path / "out"
    scenes = ["border", "shadow"]
    failures.main(failures.Settings(quick=True, scenes=scenes, methods=["noisy", "svgf"], data=tmp_path, out=out))
    found = json.loads((out / "failures.json").read_text())
    assert found["counts"]["border"]["dual vector leaves the image"] > 50
    assert found["counts"]["shadow"]["hidden"] == 0
    assert found["counts"]["shadow"]["affected"] > 50
    response = json.loads((out / "failures-response.json").read_text())
    for result in (found, response):
        assert [column["name"] for column in result["columns"]] == ["method", *scenes]
        assert [row[0] for row in result["rows"]] == ["noisy", "svgf"]
    assert found["rows"][0][1] < found["rows"][1][1]  # of `border`
    assert response["rows"][1][2] != 0  # of `shadow`
    assert (out / "pictures" / "shadow" / "svgf.png").is_file()
    assert all((out / "sheets" / f"{sheet}.png").is_file() for sheet in ("shadow", "all"))
    assert len(capsys.readouterr().out.splitlines()) >= 6


def test_every_scene_moves_and_then_rests():
    for make, _ in SCENES.values():
        stage = make()
        poses = [stage.pose(frame) for frame in (MOVING - 1, MOVING, MOVING + 3)]
        assert poses[0], stage.name
        assert all(np.any(poses[0][name] != poses[1][name]) for name in poses[0]), stage.name
        for name in poses[0]:
            np.testing.assert_array_equal(poses[1][name], poses[2][name])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [({"scenes": ["fog"]}, "--scenes: expected some of border"), ({"frames": 8}, "--frames: expected more than the 8")],
)
def test_what_cannot_be_measured_is_told(wrong, words):
    with pytest.raises(ValueError, match=words):
        failures.main(failures.Settings(**wrong))


def _box_in_light(frame: float) -> float:
    """The share of the front and the top of the box from which nothing hides the lamp, of `dark to light`."""
    parts = SCENES["dark to light"][0]().parts
    places, depths = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-1, 1, 21))
    front = np.stack([places, depths, np.ones_like(places)], -1)
    top = np.stack([places, np.ones_like(places), depths], -1)
    faces = np.concatenate([front.reshape(-1, 3), top.reshape(-1, 3)])
    box, board, lamp = (parts[name].pose(frame) for name in ("box", "board", "lamp"))
    points = faces @ box[:3, :3].T + box[:3, 3]
    # In the board's own space, where it is the cube from -1 to 1: where the way to the lamp crosses its three slabs.
    inverse = np.linalg.inv(board)
    begins = points @ inverse[:3, :3].T + inverse[:3, 3]
    way = inverse[:3, :3] @ lamp[:3, 3] + inverse[:3, 3] - begins
    crossings = np.sort(np.stack([(side - begins) / way for side in (-1, 1)]), axis=0)
    enters, leaves = crossings[0].max(-1), crossings[1].min(-1)
    hidden = (enters < leaves) & (leaves > 0) & (enters < 1)
    return float(1 - hidden.mean())


def test_the_box_shoots_into_the_light_in_the_last_frames_that_move():
    """Were it lit sooner, what is measured at the end would be floor that it uncovers."""
    assert _box_in_light(MOVING) == 1.0
    assert _box_in_light(MOVING - 1) < 0.8
    assert _box_in_light(MOVING - 2) < 0.4
    assert all(_box_in_light(frame) == 0.0 for frame in range(MOVING - 2))


def test_only_the_ball_shows_the_boxes_that_pass_before_it():
    """Below the image, or a box itself would be what fails in `curved mirror`."""
    stage, corners = SCENES["curved mirror"][0](), np.array(np.meshgrid(*[[-1, 1]] * 3, [1])).reshape(4, 8)
    camera = stage.camera(0)
    for frame in range(MOVING + 1):
        for pose in stage.pose(frame).values():
            seen = (np.linalg.inv(camera.to_world) @ pose @ corners)[:3]
            assert np.all(seen[2] > 0)
            assert np.all(seen[1] / seen[2] < -np.tan(np.radians(camera.x_fov / 2)) * 56 / 96)


@pytest.mark.parametrize("name", ["moving mirror", "curved mirror", "transparent"])
def test_no_path_by_way_of_a_mirror_or_glass_makes_a_bright_pixel_of_a_reference(name):
    """Of 128 samples one that finds the lamp by chance adds as much as a surface in the room shows, at most."""
    lamp = SCENES[name][0]().parts["lamp"]
    assert np.max(lamp.glow) / failures.Settings().reference_spp < 0.02


def test_a_changed_scene_has_a_folder_of_its_own():
    digests = {digest_scene(make(), 3) for make, _ in SCENES.values()}
    assert len(digests) == len(SCENES)
    assert digest_scene(SCENES["shadow"][0](), 3) == digest_scene(SCENES["shadow"][0](), 3)
    moved = SCENES["shadow"][0]()
    part = moved.parts["lamp"]
    moved.parts["lamp"] = part._replace(pose=lambda frame: part.pose(frame) + 0.01 * (frame == 2))
    assert digest_scene(moved, 3) not in digests
    assert digest_scene(moved, 2) == digest_scene(SCENES["shadow"][0](), 2)


def test_a_row_is_kept_for_its_own_commit_and_clip(tmp_path, monkeypatch, rng):
    image, path = rng.random((4, 5, 3)), tmp_path / "rows" / "a.npz"
    (tmp_path / "frame_0000.exr").write_bytes(b"one")
    monkeypatch.setattr(kept, "find_revision", lambda: "0123abc")
    origin = kept.name_origin(tmp_path, 1)
    for response in (None, 3):
        kept.keep_row(path, origin, measure.Failure(31.25, response), image)
        failure, there = kept.find_row(path, origin)
        assert failure == measure.Failure(31.25, response)
        np.testing.assert_array_equal(there, image)
    (tmp_path / "frame_0000.exr").write_bytes(b"two")
    assert kept.find_row(path, kept.name_origin(tmp_path, 1)) is None
    (tmp_path / "frame_0000.exr").write_bytes(b"one")
    monkeypatch.setattr(kept, "find_revision", lambda: "0123abd")
    assert kept.find_row(path, kept.name_origin(tmp_path, 1)) is None
    monkeypatch.setattr(kept, "find_revision", lambda: "0123abc-dirty")
    assert kept.name_origin(tmp_path, 1) is None
    other = tmp_path / "rows" / "b.npz"
    kept.keep_row(other, None, measure.Failure(31.25, 3), image)
    assert not other.exists()
    assert kept.find_row(path, None) is None
