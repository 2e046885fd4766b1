"""What is read, printed and understood of the files of each program (tests/programs.py)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.clips import ClipError
from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.data.foreign.measured_motion import fitting_conventions
from jaxdn.ops.warp import warp
from jaxdn.render.mitsuba.variant import use_variant
from tests import programs
from tests.needs import require_module
from tests.programs import FULL, HEIGHT, PROGRAMS, STEP, WIDTH, Truth, corner, truth, write_shot


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three frames of every program."""
    folder = tmp_path_factory.mktemp("programs")
    return {name: write_shot(name, folder / name) for name in PROGRAMS}


def read(name: str, folder: Path, **options: Any) -> tuple[list[Frame], tuple[slice, slice]]:
    """The frames of a program's shot, and which pixels of the truth they are."""
    files, frames = clips.plain_frames(folder, motion_convention=PROGRAMS[name].motion_convention, **options)
    canvas = ForeignSequence([ExrFile(file) for file in files], UNNAMED).window
    return list(frames), (slice(canvas.top, canvas.bottom + 1), slice(canvas.left, canvas.right + 1))


def stored(name: str, frame: int, part: tuple[slice, slice]) -> np.ndarray:
    """Which pixels of the canvas the file of a frame has."""
    left, top, right, bottom = PROGRAMS[name].window(frame)
    there = np.zeros((HEIGHT, WIDTH), bool)
    there[top : bottom + 1, left : right + 1] = True
    return there[part]


@pytest.mark.parametrize("name", PROGRAMS)
def test_every_buffer_has_the_values_of_the_scene(name: str, shots: dict[str, Path]) -> None:
    frames, part = read(name, shots[name])
    wanted = set(PROGRAMS[name].buffers) | ({"reflectance"} if name == "Arnold" else set())
    assert {buffer for buffer, values in frames[0]._asdict().items() if values is not None} == wanted
    for index, frame in enumerate(frames):
        scene, there = truth(index), stored(name, index, part)
        for buffer, attribute in {
            "radiance": "light",
            "albedo": "albedo",
            "normal": "normal",
            "depth": "depth",
        }.items():
            if buffer in wanted:
                expected = getattr(scene, attribute)[part]
                np.testing.assert_allclose(getattr(frame, buffer)[there], expected[there], rtol=2e-3, err_msg=buffer)
        assert not frame.radiance[~there].any()
        if "ids" in wanted:
            ids = frame.ids[..., 0][there]
            square = scene.ids[part][..., 0][there] == 1
            assert len(set(ids[square])) == len(set(ids[~square])) == 1
            assert set(ids[square]) != set(ids[~square])
            assert ids.min() >= 0
        if "motion" in wanted:
            np.testing.assert_allclose(frame.motion[there], scene.motion[part][there], atol=1e-3)


@pytest.mark.parametrize("name", [name for name in PROGRAMS if "motion" in PROGRAMS[name].buffers])
def test_the_previous_frame_warped_by_the_motion_is_this_frame(name: str, shots: dict[str, Path]) -> None:
    """The textures of wall and square come to lie on each other, but for what the square has uncovered."""
    frames, part = read(name, shots[name])
    for index in (1, 2):
        now, before = frames[index], frames[index - 1]
        warped = np.asarray(warp(before.albedo, now.motion))
        was_square, is_square = (truth(i).ids[part][..., 0] == 1 for i in (index - 1, index))
        inside = stored(name, index, part) & stored(name, index - 1, part)
        seen = inside & (is_square | ~was_square)
        # The square comes from where it was stored too: shrink by its step.
        margin = np.zeros_like(seen)
        margin[3:-3, 3:-3] = True
        seen &= margin
        assert (seen & is_square).sum() > 20
        np.testing.assert_allclose(warped[seen], now.albedo[seen], atol=2e-3)
        unmoved = np.abs(before.albedo - now.albedo)[seen & is_square].mean()
        assert unmoved > 0.1, "the test could not fail"


def test_dual_motion_of_blender_leads_what_is_uncovered_beside_the_square(shots: dict[str, Path]) -> None:
    frames, _ = read("Blender", shots["Blender"])
    np.testing.assert_array_equal(frames[0].dual_motion, frames[0].motion)
    for index in (1, 2):
        column, row = corner(index - 1)
        uncovered = np.zeros((HEIGHT, WIDTH), bool)
        uncovered[row : row + 8, column : column + 10] = True
        uncovered &= truth(index).ids[..., 0] == 0
        dual = np.asarray(frames[index].dual_motion)
        assert uncovered.sum() > 20
        np.testing.assert_allclose(dual[uncovered], np.broadcast_to(np.negative(STEP), (uncovered.sum(), 2)), atol=1e-5)
        np.testing.assert_array_equal(dual[~uncovered], frames[index].motion[~uncovered])


def test_no_dual_motion_without_the_frame_before(shots: dict[str, Path]) -> None:
    frame = next(clips.plain_frames([shots["Blender"] / "shot.0003.exr"])[1])
    np.testing.assert_array_equal(frame.dual_motion, frame.motion)


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_table_names_the_layers(
    name: str, shots: dict[str, Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "250")  # no line is broken
    found = read_channel_mapping(shots[name], ChannelNaming(PROGRAMS[name].motion_convention))
    assert {source.buffer: source.layer for source in found} == PROGRAMS[name].buffers
    options = ["--motion-convention", PROGRAMS[name].motion_convention] if PROGRAMS[name].motion_convention else []
    main.main(["inspect", str(shots[name]), *options])
    text = " ".join(capsys.readouterr().out.split())
    for source in found:
        assert f"{source.buffer} {source.layer} {', '.join(c.rpartition('.')[2] for c in source.channels)} " in text
    if "motion" not in PROGRAMS[name].buffers:
        assert "motion missing it is measured from albedo or normals" in text


def test_what_the_numbers_are_taken_for(shots: dict[str, Path]) -> None:
    words = {
        name: {
            source.buffer: source.convention
            for source in read_channel_mapping(shots[name], ChannelNaming("forward-up"))
        }
        for name in ("Mitsuba", "Arnold", "V-Ray")
    }
    blender = {source.buffer: source.convention for source in read_channel_mapping(shots["Blender"])}
    assert words["Mitsuba"]["depth"] == "along the ray"
    assert words["V-Ray"]["depth"].startswith("along the optical axis")
    assert words["Arnold"]["ids"].startswith("hash of what covers most")
    assert words["Arnold"]["motion"].startswith("pixels, current minus previous position, y up")
    assert blender["normal"] == "camera space"
    assert "of the frame before" in blender["dual_motion"]


@pytest.mark.parametrize("name", [name for name in PROGRAMS if PROGRAMS[name].motion_convention])
def test_motion_that_nothing_explains_is_asked_for_with_what_fits(name: str, shots: dict[str, Path]) -> None:
    """The right convention alone fits the first two frames, and is said first; then all that there are."""
    convention = PROGRAMS[name].motion_convention
    with pytest.raises(ClipError) as refused:
        clips.read_clip(shots[name])
    first, why, *known = str(refused.value).splitlines()
    assert first.endswith(f"shot.0001.exr: --motion-convention {convention} fits shot.0001.exr and shot.0002.exr.")
    assert why.endswith(": nothing in the file says what they mean; state --motion-convention NAME, one of these:")
    assert [line.split()[0] for line in known] == [*clips.MOTION_CONVENTIONS, "none"]
    assert max(map(len, [why, *known])) <= 120


def test_one_image_needs_no_motion_and_says_so(shots: dict[str, Path]) -> None:
    lines: list[str] = []
    image = shots["Arnold"] / "shot.0002.exr"
    (frame,) = clips.plain_frames(image, log=lines.append)[1]
    assert frame.motion is None
    told = "not used: 'motionvector', as nothing says what these vectors mean; a single image needs none"
    assert told in lines
    assert next(clips.plain_frames(image, motion_convention="forward-up")[1]).motion is not None


def test_where_nothing_moves_no_convention_fits(shots: dict[str, Path]) -> None:
    there = clips.read_exr(shots["RenderMan"] / "shot.0001.exr")
    found = clips.detect_channels(list(there))
    assert fitting_conventions(there, there, found) == []
    still = {name: np.zeros_like(pixels) if "motion" in name else pixels for name, pixels in there.items()}
    assert fitting_conventions(there, still, found) == []
    sideways = {name: np.roll(pixels, 2, axis=1) for name, pixels in there.items()}
    sideways |= {f"motionBack.{axis}": np.full_like(there["a"], value) for axis, value in (("x", -2), ("y", 0))}
    assert set(fitting_conventions(there, sideways, found)) == {"previous-current", "cycles"}


def test_a_convention_that_contradicts_the_name_is_said(shots: dict[str, Path]) -> None:
    lines: list[str] = []
    frame = next(clips.plain_frames(shots["Blender"], motion_convention="previous-current", log=lines.append)[1])
    assert frame.dual_motion is None
    assert lines == ["'View Layer.Vector' looks like Blender's, whose convention is 'cycles'; read as stated"]
    assert next(clips.plain_frames(shots["Blender"], motion_convention="none")[1]).motion is None


def write_layers(path: Path, scene: Truth, **images: np.ndarray) -> Path:
    layers = {name: programs.layer("" if name == "beauty" else name, image, "RGB") for name, image in images.items()}
    clips.write_exr(path, {name: pixels for one in layers.values() for name, pixels in one.items()})
    return path


@pytest.mark.parametrize(
    ("scale", "why"), [(1.0, "nowhere brighter than the beauty"), (8.0, "an albedo is at most 1"), (0.4, "noisy")]
)
def test_a_lighting_pass_is_no_albedo(tmp_path: Path, scale: float, why: str) -> None:
    scene = truth(0, samples=1 if why == "noisy" else 16)
    beauty = scene.light * (0.1 if why == "noisy" else scale)
    path = write_layers(tmp_path / "a.exr", scene, beauty=beauty, diffuse=np.minimum(scene.diffuse * scale, 1e9))
    if why == "noisy":
        path = write_layers(tmp_path / "a.exr", scene, beauty=beauty, diffuse=np.minimum(scene.diffuse * scale, 1.0))
    lines: list[str] = []
    frame = next(clips.plain_frames(path, log=lines.append)[1])
    assert frame.albedo is None
    assert len(lines) == 1
    assert lines[0].startswith("not used: 'diffuse' is a lighting pass and no albedo: ")
    assert why in lines[0]
    assert "albedo" not in [source.buffer for source in read_channel_mapping(path)]


def test_light_that_is_named_the_albedo_is_taken_with_a_warning(tmp_path: Path) -> None:
    scene = truth(0, samples=1)
    path = write_layers(tmp_path / "a.exr", scene, beauty=scene.light, diffuse=np.minimum(0.4 * scene.diffuse, 1.0))
    lines: list[str] = []
    frame = next(clips.plain_frames(path, channels={"albedo": "diffuse"}, log=lines.append)[1])
    assert frame.albedo is not None
    assert lines[0].startswith("taken as you say: 'diffuse', but it looks like light: it is noisy")


def test_an_albedo_called_diffuse_is_one_and_the_user_knows_better(tmp_path: Path) -> None:
    scene = truth(0)
    path = write_layers(tmp_path / "a.exr", scene, beauty=scene.light, diffuse=scene.albedo, key=0.3 * scene.diffuse)
    np.testing.assert_allclose(next(clips.plain_frames(path)[1]).albedo, scene.albedo, rtol=1e-6)
    named = next(clips.plain_frames(path, channels={"albedo": "key"})[1])
    np.testing.assert_allclose(named.albedo, 0.3 * scene.diffuse, rtol=1e-6)
    write_layers(path, scene, beauty=scene.light, diffuse=9 * scene.diffuse)
    with pytest.raises(
        ClipError, match=r"albedo: 'diffuse' is no albedo: it has values up to .* --channels albedo=none"
    ):
        next(clips.plain_frames(path, channels={"albedo": "diffuse"})[1])


def test_a_cryptomatte_in_half_precision_has_no_ids(tmp_path: Path) -> None:
    scene = truth(0)
    channels = programs.layer("", scene.light, "RGB") | programs.cryptomatte("crypto_object", scene.ids)
    broken = {name: values.astype(np.float16) if "crypto" in name else values for name, values in channels.items()}
    with np.errstate(over="ignore"):
        clips.write_exr(tmp_path / "a.exr", broken)
    lines: list[str] = []
    assert next(clips.plain_frames(tmp_path / "a.exr", log=lines.append)[1]).ids is None
    assert "half precision has destroyed the ids" in lines[0]


def test_the_names_of_mitsuba_are_those_of_mitsuba(tmp_path: Path) -> None:
    """Written by the renderer itself, with the names of its manual."""
    mi = require_module("mitsuba")
    use_variant("scalar_rgb")
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 12, "height": 8}
    scene["sensor"]["sampler"]["sample_count"] = 1
    aovs = "albedo:albedo,dd.y:depth,nn:sh_normal,shape_index:shape_index"
    scene["integrator"] = {"type": "aov", "aovs": aovs, "image": {"type": "path"}}
    loaded = mi.load_dict(scene)
    mi.render(loaded)
    loaded.sensors()[0].film().bitmap().write(str(tmp_path / "box.exr"))
    found = {source.buffer: source.layer for source in read_channel_mapping(tmp_path / "box.exr")}
    wanted = {"radiance": "R, G, B", "albedo": "albedo", "depth": "dd.y", "normal": "nn", "ids": "shape_index"}
    assert found == wanted
    programs.mitsuba(tmp_path / "ours.exr", 0)
    theirs = {name.replace("dd.y", "dd") for name in clips.read_exr(tmp_path / "box.exr") if "shape" not in name}
    assert theirs == set(clips.read_exr(tmp_path / "ours.exr"))


def test_files_of_different_pictures_are_no_sequence(tmp_path: Path) -> None:
    assert FULL == (0, 0, WIDTH - 1, HEIGHT - 1)
    write_shot("V-Ray", tmp_path, frames=2)
    clips.write_exr(tmp_path / "shot.0003.exr", {letter: np.ones((HEIGHT, WIDTH + 1), np.float32) for letter in "RGB"})
    with pytest.raises(ClipError, match=r"shot\.0003\.exr: expected 32 x 24 pixels as in the first frame, got 33 x 24"):
        list(clips.plain_frames(tmp_path, motion_convention="none")[1])
