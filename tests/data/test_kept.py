"""Nothing of a renderer's file is lost: only the beauty's pixels change."""

import functools
import struct
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest

from jaxdn import clips
from jaxdn.core.frame import Frame
from jaxdn.data.exr.exr import rewrite_exr
from jaxdn.data.exr.file import ExrFile, Window, utf8_name
from jaxdn.data.foreign.classify import UNNAMED, ChannelNaming
from jaxdn.data.foreign.import_exr import ForeignSequence
from jaxdn.denoiser import Core, recurrent
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import Model
from tests import programs
from tests.programs import PROGRAMS, truth, write_shot


def parts(path: Path) -> list[tuple[dict[str, Any], dict[str, np.ndarray]]]:
    """Header and pixels of every part, as the OpenEXR package gives them."""
    with utf8_name(path) as name, OpenEXR.File(name, separate_channels=True) as file:
        return [(dict(part.header), {name: one.pixels for name, one in part.channels.items()}) for part in file.parts]


def flags(path: Path) -> int:
    """Of the version field: tiled, long names, deep, several parts."""
    return struct.unpack("<I", path.read_bytes()[4:8])[0]


def assert_same_but(source: Path, target: Path, changed: tuple[str, ...]) -> None:
    """Every part, header and channel is that of the source; ``changed`` have the same precision and other pixels."""
    assert flags(source) == flags(target)
    before, after = parts(source), parts(target)
    assert len(before) == len(after)
    found = set()
    for (header, channels), (header_after, channels_after) in zip(before, after, strict=True):
        assert {key: repr(value) for key, value in header.items()} == {
            key: repr(value) for key, value in header_after.items()
        }
        assert list(channels) == list(channels_after)
        for name, pixels in channels.items():
            full = name if len(before) == 1 or name.startswith(header["name"] + ".") else f"{header['name']}.{name}"
            assert pixels.dtype == channels_after[name].dtype
            if full in changed:
                found.add(full)
                assert not np.array_equal(pixels, channels_after[name])
            else:
                assert pixels.tobytes() == channels_after[name].tobytes(), full
    assert found == set(changed)


@functools.cache
def box_blur() -> Model:
    """The smallest denoiser: what is kept does not depend on the method. Made once: a step is traced for a denoiser."""

    def step(params: Any, state: Any, frame: Frame, first: Any, statistics: Any) -> Any:
        padded = jnp.pad(frame.radiance, ((1, 1), (1, 1), (0, 0)), mode="edge")
        height, width = frame.radiance.shape[:2]
        shifts = [padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]
        return state, sum(shifts) / 9, 0

    reads = frozenset({"motion", "albedo", "ids"})
    return Model("blur", recurrent(Core(lambda params, frame: jnp.zeros(1), step, reads)), {})


def denoise(source: Path, out: Path, **settings: Any) -> None:
    denoise_files([source], out, box_blur(), Settings(**settings))


@pytest.mark.parametrize("name", PROGRAMS)
def test_everything_but_the_beauty_stays(name: str, tmp_path: Path) -> None:
    program = PROGRAMS[name]
    source = write_shot(name, tmp_path / "in")
    denoise(source, tmp_path / "out", naming=ChannelNaming(program.motion_convention))
    names = sorted(path.name for path in source.iterdir())
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == names
    errors = np.zeros(2)
    for index, file in enumerate(names):
        assert_same_but(source / file, tmp_path / "out" / file, program.beauty)
        left, top, right, bottom = program.window(index)
        clean = truth(index, samples=100_000).light[top : bottom + 1, left : right + 1]
        for side, folder in enumerate((source, tmp_path / "out")):
            channels = clips.read_exr(folder / file)
            errors[side] += np.mean((np.stack([channels[each] for each in program.beauty], -1) - clean) ** 2)
    assert errors[1] < 0.8 * errors[0]


def test_only_the_beauty_if_asked_for(tmp_path: Path) -> None:
    source = write_shot("Houdini", tmp_path / "in", frames=1) / "shot.0001.exr"
    whole, alone = tmp_path / "whole.exr", tmp_path / "alone.exr"
    denoise(source, whole, naming=ChannelNaming("none"))
    denoise(source, alone, naming=ChannelNaming("none"), only_beauty=True)
    ((header, channels),) = parts(alone)
    assert sorted(channels) == ["A", "B", "G", "R"]
    assert "husk:render_stats" in header
    assert not [key for key in header if key.startswith("cryptomatte/")]
    everything = clips.read_exr(whole)
    for letter in "RGBA":
        assert channels[letter].dtype == np.float16
        np.testing.assert_array_equal(channels[letter], everything[f"C.{letter}"])


def test_half_precision_does_not_overflow(tmp_path: Path) -> None:
    light = np.full((20, 20), 6e4, np.float16)
    clips.write_exr(tmp_path / "a.exr", dict.fromkeys("RGB", light))
    rewrite_exr(ExrFile(tmp_path / "a.exr"), tmp_path / "b.exr", {"R": np.full((20, 20), 1e9, np.float32)})
    assert np.all(clips.read_exr(tmp_path / "b.exr")["R"] == np.float16(65504))


def test_attributes_of_types_that_nobody_knows_stay(tmp_path: Path) -> None:
    """A rational, and a type that this version of OpenEXR has never heard of."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "odd": np.array([24, 1], np.int32)}
    OpenEXR.File(header, {letter: np.ones((4, 4), np.float32) for letter in "RGB"}).write(str(tmp_path / "a.exr"))
    bytes_ = (tmp_path / "a.exr").read_bytes()
    assert b"odd\0v2i\0" in bytes_
    (tmp_path / "a.exr").write_bytes(bytes_.replace(b"odd\0v2i\0", b"odd\0xyz\0"))
    assert rewrite_exr(ExrFile(tmp_path / "a.exr"), tmp_path / "b.exr", {"R": np.zeros((4, 4))}) == []
    at = (tmp_path / "b.exr").read_bytes().index(b"odd\0xyz\0")
    assert (tmp_path / "b.exr").read_bytes()[at + 8 : at + 20] == struct.pack("<Iii", 8, 24, 1)


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA"])
def test_compression_stays_and_loss_is_said(tmp_path: Path, compression: str) -> None:
    scene = truth(0)
    channels = programs.layer("", scene.light, "RGB", np.float16) | programs.layer(
        "albedo", scene.albedo, "RGB", np.float16
    )
    part = programs.part(channels, compression=getattr(OpenEXR, f"{compression}_COMPRESSION"))
    OpenEXR.File([part]).write(str(tmp_path / "a.exr"))
    notes = rewrite_exr(ExrFile(tmp_path / "a.exr"), tmp_path / "b.exr", {"R": np.zeros_like(scene.light[..., 0])})
    lossy = compression in ("B44", "DWAA")
    assert bool(notes) == lossy
    before, after = clips.read_exr(tmp_path / "a.exr"), clips.read_exr(tmp_path / "b.exr")
    for letter in "RGB":
        first, second = (np.float32(found[f"albedo.{letter}"]) for found in (before, after))
        np.testing.assert_allclose(second, first, atol=0.02 if lossy else 0)
    assert parts(tmp_path / "b.exr")[0][0]["compression"] == parts(tmp_path / "a.exr")[0][0]["compression"]


def test_a_mipmap_is_refused_in_words(tmp_path: Path) -> None:
    """A mipmap cannot be read."""
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    tiles.mode = OpenEXR.MIPMAP_LEVELS
    part = programs.part(programs.layer("", truth(0).light, "RGB"), type=OpenEXR.tiledimage, tiles=tiles)
    OpenEXR.File([part]).write(str(tmp_path / "a.exr"))
    with pytest.raises(clips.ClipError, match=r"tiles in several levels \(a mipmap\) cannot be read; save it with one"):
        clips.read_clip(tmp_path / "a.exr")


def test_windows_are_put_into_one_picture(tmp_path: Path) -> None:
    source = write_shot("Arnold", tmp_path)
    sequence = ForeignSequence([ExrFile(file) for file in sorted(source.iterdir())], UNNAMED)
    assert sequence.window == Window(1, 2, programs.WIDTH - 2, programs.HEIGHT - 1)
    frames = list(clips.plain_frames(source, motion_convention="none")[1])
    for index, frame in enumerate(frames):
        assert frame.radiance.shape == (programs.HEIGHT - 2, programs.WIDTH - 2, 3)
        assert not frame.radiance[:index].any()
        assert frame.radiance[index].any()


def test_a_window_far_from_the_picture_names_its_file(tmp_path: Path) -> None:
    """One such file would make every frame as large as the distance: gibibytes."""
    light = {letter: np.ones((8, 12), np.float16) for letter in "RGB"}
    for index, left in enumerate([0, 0, 40000]):
        window = (np.array([left, left], np.int32), np.array([left + 11, left + 7], np.int32))
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "dataWindow": window,
                  "displayWindow": programs.box((0, 0, 11, 7))}  # fmt: skip
        OpenEXR.File(header, light).write(str(tmp_path / f"a_{index}.exr"))
    with pytest.raises(clips.ClipError, match=r"a_2\.exr: expected a data window near the picture of 12 x 8 pixels"):
        clips.read_clip(tmp_path)


def test_a_view_that_is_not_there_is_told(tmp_path: Path) -> None:
    source = write_shot("Arnold", tmp_path)
    with pytest.raises(
        clips.ClipError, match=r"--view: expected files that have the view 'nope', got .* without views"
    ):
        clips.read_clip(source, motion_convention="none", view="nope")


def test_overscan_is_denoised_and_kept(tmp_path: Path) -> None:
    """More pixels than the picture has, to the left of it and above."""
    rng = np.random.default_rng(0)
    window = (np.array([-4, -3], np.int32), np.array([15, 12], np.int32))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "dataWindow": window,
              "displayWindow": programs.box((0, 0, 11, 9))}  # fmt: skip
    light = {letter: rng.exponential(1.0, (16, 20)).astype(np.float16) for letter in "RGB"}
    OpenEXR.File(header, light).write(str(tmp_path / "a.exr"))
    denoise(tmp_path / "a.exr", tmp_path / "out")
    assert_same_but(tmp_path / "a.exr", tmp_path / "out" / "a.exr", ("R", "G", "B"))
