"""Views of a stereo camera, in one file or in several: each is denoised, with a history of its own."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.data.errors import ClipError
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.views import ViewFile, find_views
from jaxdn.denoiser import Core, recurrent
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import Model
from tests.data.test_kept import assert_same_but
from tests.programs import FULL, Channels, Truth, layer, part, truth

VIEWS = ("right", "left")
FRAMES = 3


def seen(view: str, frame: int) -> Truth:
    """The scene as a view has it: the left one is mirrored, and has other noise."""
    if view == "right":
        return truth(frame)
    now = Truth(*(np.ascontiguousarray(one[:, ::-1]) for one in truth(frame + 1)))
    return now._replace(motion=now.motion * [-1, 1], forward=now.forward * [-1, 1])


def buffers(view: str, frame: int) -> dict[str, Channels]:
    """Layers of a view."""
    now = seen(view, frame)
    return {
        "rgba": layer("", np.concatenate([now.light, now.alpha], axis=-1), "RGBA"),
        "depth": layer("", now.depth, "Z"),
        "forward": layer("forward", now.forward * [1, -1], "uv"),
    }


def nuke(path: Path, frame: int) -> None:
    """One part; the hero's image without a name, others' and layers with the view in the middle."""
    channels: Channels = layer("disparity", truth(frame).motion, "xy")
    for view in VIEWS:
        there = buffers(view, frame)
        for name, pixels in (there["rgba"] | there["depth"]).items():
            channels[name if view == VIEWS[0] else f"{view}.{name}"] = pixels
        channels |= {f"forward.{view}.{name[-1]}": pixels for name, pixels in there["forward"].items()}
    OpenEXR.File([part(channels, name="rgba", multiView=list(VIEWS))]).write(str(path))


def parts(path: Path, frame: int) -> None:
    """A part for each layer of each view, in any order, and one of no view."""
    found = [
        part(pixels, name=f"{name}_{view}", view=view)
        for view, name in [("right", "rgba"), ("left", "depth"), ("left", "forward"), ("left", "rgba"),
                           ("right", "depth"), ("right", "forward")]
        for pixels in [buffers(view, frame)[name]]
    ]  # fmt: skip
    found.append(part(layer("disparity", truth(frame).motion, "xy"), name="disparity"))
    OpenEXR.File(found).write(str(path))


def blender_with_views(path: Path, frame: int) -> None:
    """A part for each pass of each view of a view layer; the channels repeat the name with the view."""
    blender(path, frame, "ViewLayer.{}.{}", "ViewLayer.{}.{}")


def blender_5(path: Path, frame: int) -> None:
    """As Blender 5.0.1 writes them: the channels repeat the name without the view."""
    blender(path, frame, "ViewLayer.{}-{}", "ViewLayer.{}")


def blender(path: Path, frame: int, part_name: str, layer_name: str) -> None:
    """Names of parts and of their layers, by pass and view."""
    found = []
    for view in VIEWS:
        now = seen(view, frame)
        vector = np.concatenate([now.motion * [1, -1], -now.forward * [1, -1]], axis=-1)
        passes = {"Combined": (now.light, "RGBA"), "Depth": (now.depth, "Z"), "Vector": (vector, "XYZW")}
        for name, (values, letters) in passes.items():
            rgba = np.concatenate([values, now.alpha], axis=-1) if name == "Combined" else values
            channels = layer(layer_name.format(name, view), rgba, letters)
            found.append(part(channels, name=part_name.format(name, view), view=view))
    OpenEXR.File(found).write(str(path))


KINDS: dict[str, tuple[Callable[[Path, int], None], dict[str, str]]] = {
    "Nuke, one part": (nuke, {"right": "{}", "left": "left.{}"}),
    "parts": (parts, {"right": "rgba_right.{}", "left": "rgba_left.{}"}),
    "Blender, views in names": (blender_with_views, {view: f"ViewLayer.Combined.{view}.{{}}" for view in VIEWS}),
    "Blender 5": (blender_5, {view: f"ViewLayer.Combined-{view}.ViewLayer.Combined.{{}}" for view in VIEWS}),
}
"""How such a file is written, and view -> name of the channels of its beauty."""
NAMING = ChannelNaming("forward-up")


@functools.cache
def mean_so_far() -> Model:
    """The smallest denoiser with a history: the mean of the frames up to this one."""

    def step(params: Any, state: Any, frame: Frame, first: Any, statistics: Any) -> Any:
        count, total = state
        state = count + 1, total + frame.radiance
        return state, state[1] / state[0], 0

    start = lambda params, frame: (jnp.zeros(()), jnp.zeros_like(frame.radiance))  # noqa: E731
    return Model("mean", recurrent(Core(start, step, frozenset({"motion", "depth"}))), {})


def write(kind: str, folder: Path) -> Path:
    folder.mkdir()
    for frame in range(FRAMES):
        KINDS[kind][0](folder / f"shot.{frame:04d}.exr", frame)
    return folder


def image(path: Path, kind: str, view: str) -> np.ndarray:
    there = clips.read_exr(path)
    return np.stack([there[KINDS[kind][1][view].format(letter)] for letter in "RGB"], axis=-1)


def naming_of(kind: str, view: str | None = None) -> ChannelNaming:
    return ChannelNaming(None if kind.startswith("Blender") else "forward-up", view=view)


@pytest.mark.parametrize("kind", ["Blender, views in names", "Blender 5"])
def test_layers_of_a_view_have_their_plain_names(kind: str, tmp_path: Path) -> None:
    file = ViewFile(write(kind, tmp_path / "in") / "shot.0000.exr", "left")
    letters = {"Combined": "RGBA", "Depth": "Z", "Vector": "XYZW"}
    assert set(file.windows) == {f"ViewLayer.{name}.{letter}" for name in letters for letter in letters[name]}


@pytest.mark.parametrize("kind", KINDS)
def test_each_view_is_read_with_all_of_its_layers(kind: str, tmp_path: Path) -> None:
    source = write(kind, tmp_path / "in")
    assert find_views(ExrFile(source / "shot.0000.exr")) == VIEWS
    stated = None if kind.startswith("Blender") else "forward-up"
    for view in (None, *VIEWS):
        clip = clips.read_clip(source, motion_convention=stated, view=view)
        for frame in range(FRAMES):
            now = seen(view or VIEWS[0], frame)
            np.testing.assert_allclose(clip.frames.radiance[frame], now.light, rtol=1e-6)
            np.testing.assert_allclose(clip.frames.depth[frame], now.depth, rtol=1e-6)
            np.testing.assert_allclose(clip.frames.motion[frame], now.motion, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "bidirectional"), [*((kind, False) for kind in KINDS), ("parts", True)])
def test_every_view_is_denoised_with_its_own_history(kind: str, bidirectional: bool, tmp_path: Path) -> None:
    """As if each were alone; everything else in the files stays."""
    source = write(kind, tmp_path / "in")
    settings = Settings(naming=naming_of(kind), safe=False, bidirectional=bidirectional)
    told: list[str] = []
    done = denoise_files([source], tmp_path / "out", mean_so_far(), settings, log=told.append)
    assert [path.name for path in done.files] == [f"shot.{frame:04d}.exr" for frame in range(FRAMES)]
    changed = tuple(name.format(letter) for name in KINDS[kind][1].values() for letter in "RGB")
    for view in VIEWS:
        alone = tmp_path / view
        alone.mkdir()
        for frame in range(FRAMES):
            now = buffers(view, frame)
            clips.write_exr(alone / f"shot.{frame:04d}.exr", now["rgba"] | now["depth"] | now["forward"])
        given = settings._replace(naming=NAMING)
        denoise_files([alone], tmp_path / f"{view}-out", mean_so_far(), given)
        for frame in range(FRAMES):
            name = f"shot.{frame:04d}.exr"
            result = image(tmp_path / "out" / name, kind, view)
            plain = clips.read_exr(tmp_path / f"{view}-out" / name)
            np.testing.assert_allclose(result, np.stack([plain[one] for one in "RGB"], -1), rtol=1e-5, atol=1e-6)
            if not bidirectional:
                mean = np.mean([seen(view, index).light for index in range(frame + 1)], axis=0)
                np.testing.assert_allclose(result, mean, rtol=1e-5)
            if frame > 0:  # the mean of one frame is that frame
                assert_same_but(source / name, tmp_path / "out" / name, changed)


@pytest.mark.parametrize("kind", KINDS)
def test_one_view_is_chosen(kind: str, tmp_path: Path, capsys: Any) -> None:
    source = write(kind, tmp_path / "in")
    arguments = [] if kind.startswith("Blender") else ["--motion-convention", "forward-up"]
    main.main(["inspect", str(source), "--view", "left", *arguments])
    text = capsys.readouterr().out
    assert "(left): what is read" in text
    assert "(right)" not in text
    settings = Settings(naming=naming_of(kind, "left"), safe=False)
    denoise_files([source], tmp_path / "out", mean_so_far(), settings)
    changed = tuple(KINDS[kind][1]["left"].format(letter) for letter in "RGB")
    assert_same_but(source / "shot.0002.exr", tmp_path / "out" / "shot.0002.exr", changed)
    assert not np.array_equal(image(tmp_path / "out" / "shot.0002.exr", kind, "left"), seen("left", 2).light)
    with pytest.raises(ClipError, match=r"--view: there is none called 'middle' in .*; there are right, left"):
        denoise_files([source], tmp_path / "no", mean_so_far(), Settings(naming=naming_of(kind, "middle")))
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_the_beauty_alone_of_each_view_can_be_read_again(kind: str, tmp_path: Path) -> None:
    source = write(kind, tmp_path / "in")
    settings = Settings(naming=naming_of(kind), safe=False, only_beauty=True, preview=True)
    denoise_files([source], tmp_path / "out", mean_so_far(), settings)
    for view in VIEWS:
        clip = clips.read_clip(tmp_path / "out", view=view)
        mean = np.mean([seen(view, index).light for index in range(FRAMES)], axis=0)
        np.testing.assert_allclose(clip.frames.radiance[-1], mean, rtol=1e-5)
        assert clip.frames.depth is None
        assert (tmp_path / "out" / f"shot.0000.{view}.png").is_file()


def test_previews_of_views_are_held_too(tmp_path: Path) -> None:
    source, out = write("parts", tmp_path / "in"), tmp_path / "out"
    (source / "shot.0001.exr").unlink()
    (source / "shot.0001.exr").symlink_to(source / "shot.0000.exr")
    denoise_files([source], out, mean_so_far(), Settings(naming=NAMING, safe=False, preview=True))
    for view in VIEWS:
        held, first = (out / f"shot.{frame:04d}.{view}.png" for frame in (1, 0))
        assert held.read_bytes() == first.read_bytes()


def test_a_frame_without_one_of_the_views_is_missing(tmp_path: Path) -> None:
    source = write("parts", tmp_path / "in")
    now = buffers("right", 1)
    only = [part(now[name], name=f"{name}_right", view="right") for name in now]
    OpenEXR.File(only).write(str(source / "shot.0001.exr"))
    told: list[str] = []
    done = denoise_files([source], tmp_path / "out", mean_so_far(), Settings(naming=NAMING), log=told.append)
    assert [path.name for path in done.files] == ["shot.0000.exr", "shot.0002.exr"]
    assert any("shot.0001.exr is left out, as a missing frame: the file lacks the view 'left'" in one for one in told)


def test_left_and_right_files_are_shots_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for view, letter in (("left", "L"), ("right", "R")):
        for frame in range(FRAMES):
            now = buffers(view, frame)
            clips.write_exr(tmp_path / "in" / f"{frame:04d}_{letter}.exr", now["rgba"])
    both = denoise_files([tmp_path / "in"], tmp_path / "out", mean_so_far(), Settings(safe=False))
    assert len(both.files) == 2 * FRAMES
    mean = np.mean([seen("left", index).light for index in range(FRAMES)], axis=0)
    after = clips.read_exr(tmp_path / "out" / "0002_L.exr")
    np.testing.assert_allclose(np.stack([after[one] for one in "RGB"], -1), mean, rtol=1e-5)
    settings = Settings(safe=False, naming=ChannelNaming(view="left"))
    one = denoise_files([tmp_path / "in"], tmp_path / "one", mean_so_far(), settings)
    assert [path.name for path in one.files] == [f"{frame:04d}_L.exr" for frame in range(FRAMES)]
    with pytest.raises(ClipError, match="expected files that have the view 'middle'"):
        denoise_files([tmp_path / "in"], tmp_path / "no", mean_so_far(), Settings(naming=ChannelNaming(view="middle")))


def test_names_with_and_without_the_view(tmp_path: Path) -> None:
    """The hero's layers may lack its name; what is nobody's is everybody's; a layer ``left_arm`` is no view."""
    now = seen("right", 0)
    channels = layer("", now.light, "RGB") | layer("N", now.normal, "XYZ") | layer("N.left", -now.normal, "XYZ")
    channels |= layer("left", 2 * now.light, "RGB") | layer("albedo", now.albedo, "RGB")
    channels |= layer("left_arm", now.light, "RGB")
    OpenEXR.File([part(channels, FULL, multiView=["right", "left"])]).write(str(tmp_path / "a.exr"))
    for view, sign, gain in (("right", 1, 1), ("left", -1, 2)):
        (frame,) = clips.plain_frames(tmp_path / "a.exr", view=view)[1]
        np.testing.assert_allclose(frame.radiance, gain * now.light, rtol=1e-6)
        np.testing.assert_allclose(frame.normal, sign * now.normal, rtol=1e-6)
        np.testing.assert_allclose(frame.albedo, now.albedo, rtol=1e-6)


def sides(path: Path, frame: int, left: str = "left", *, more: Channels | None = None) -> None:
    """One part whose channels are called after the sides, and no word of views in the header."""
    channels: Channels = dict(more or {})
    for view, name in (("right", "right"), ("left", left)):
        now = seen(view, frame)
        channels |= layer(name, now.light, "RGB") | layer(f"{name}.albedo", now.albedo, "RGB")
    clips.write_exr(path, channels)


def test_sides_without_an_attribute_are_views(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "in").mkdir()
    shared = layer("depth", truth(0).depth, "Z")
    for frame in range(FRAMES):
        sides(tmp_path / "in" / f"s.{frame:04d}.exr", frame, more=shared)
    for view in VIEWS:
        clip = clips.read_clip(tmp_path / "in", view=view)
        np.testing.assert_allclose(clip.frames.radiance[1], seen(view, 1).light, rtol=1e-6)
        np.testing.assert_allclose(clip.frames.albedo[1], seen(view, 1).albedo, rtol=1e-6)
        np.testing.assert_allclose(clip.frames.depth[1], truth(0).depth, rtol=1e-6)
    main.main(["inspect", str(tmp_path / "in")])
    told = " ".join(capsys.readouterr().out.split())
    assert "left and right are read as views, by their names" in told
    assert told.count("3 frames of") == 2
    lines: list[str] = []
    written = denoise_files([tmp_path / "in"], tmp_path / "out", mean_so_far(), log=lines.append).files
    assert any("left and right are read as views, by their names" in line for line in lines)
    after = clips.read_exr(written[2])
    for view in VIEWS:
        expected = np.mean([seen(view, frame).light for frame in range(FRAMES)], axis=0)
        image = np.stack([after[f"{view}.{letter}"] for letter in "RGB"], axis=-1)
        assert np.abs(image - expected).max() < np.abs(image - seen(view, 2).light).max()


def test_sides_that_are_not_whole_are_no_views(tmp_path: Path) -> None:
    path = tmp_path / "s.0000.exr"
    sides(path, 0, more=layer("", truth(0).light, "RGB"))
    assert find_views(ExrFile(path)) == ()  # the file has an image of its own
    sides(path, 0, more=layer("beauty", truth(0).light, "RGB"))
    assert find_views(ExrFile(path)) == ()  # two lights
    clips.write_exr(path, layer("left", truth(0).light, "RGB") | layer("right", truth(0).light[..., :1], "R"))
    assert find_views(ExrFile(path)) == ()
    sides(path, 0, left="middle")
    assert find_views(ExrFile(path)) == ()


@pytest.mark.parametrize("kind", ["sides", "parts"])
def test_a_first_file_that_is_damaged_is_a_missing_frame(kind: str, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for frame in range(FRAMES):
        (sides if kind == "sides" else parts)(tmp_path / "in" / f"s.{frame:04d}.exr", frame)
    (tmp_path / "in" / "s.0000.exr").write_bytes(b"")
    lines: list[str] = []
    settings = Settings(naming=NAMING)
    written = denoise_files([tmp_path / "in"], tmp_path / "out", mean_so_far(), settings, log=lines.append)
    assert [path.name for path in written.files] == ["s.0001.exr", "s.0002.exr"]
    assert any("read as views" in line for line in lines) == (kind == "sides")
