"""Kinds of files that other programs may write, denoised as a user does: their results have all that they had."""

from pathlib import Path
from typing import Any

import Imath
import numpy as np
import OpenEXR
import pytest

from jaxdn.commands import main
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from tests.programs import Channels, layer, truth
from tests.sharing import share_model

Part = tuple[dict[str, Any], Channels]
FRAMES = 3


def scene(frame: int) -> tuple[Channels, Channels]:
    """The picture, and guides."""
    now = truth(frame, samples=4)
    guides = layer("albedo", now.albedo, "RGB") | layer("N", now.normal, "XYZ") | layer("depth", now.depth, "Z")
    return layer("", now.light, "RGB"), guides


def write(folder: Path, *shot: list[Part]) -> Path:
    """A file of parts for each frame."""
    folder.mkdir()
    usual = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for number, parts in enumerate(shot, start=1):
        made = [OpenEXR.Part(usual | header, channels) for header, channels in parts]
        OpenEXR.File(made).write(str(folder / f"s.{number:04d}.exr"))
    return folder


def denoise(source: Path, **settings: Any) -> tuple[list[tuple[ExrFile, ExrFile]], list[str]]:
    """The file of each frame with its result, and what was told."""
    told: list[str] = []
    out = source.with_name("out" + "".join(settings))
    written = denoise_files([source], out, share_model("svgf"), Settings(**settings), log=told.append)
    return [(ExrFile(source / path.name), ExrFile(path)) for path in written.files], told


def changed(before: ExrFile, after: ExrFile) -> set[str]:
    """The channels with other pixels; every part, window and type of pixels is still there."""
    assert before.windows == after.windows
    assert before.display == after.display
    assert len(before.headers) == len(after.headers)
    one, two = before.pixels, after.pixels
    assert {name: pixels.dtype for name, pixels in one.items()} == {name: pixels.dtype for name, pixels in two.items()}
    return {name for name in one if not np.array_equal(one[name], two[name])}


@pytest.mark.slow
def test_a_picture_without_colours(tmp_path: Path) -> None:
    """OpenEXR calls luminance ``Y``; R, G and B would be what Blender calls *BW* no longer."""
    shot: list[list[Part]] = []
    for frame in range(FRAMES):
        light, guides = scene(frame)
        shot.append([({}, {"Y": np.mean(np.stack([light[c] for c in "RGB"]), axis=0).astype(np.float32)} | guides)])
    source = write(tmp_path / "in", *shot)
    mapped = {one.buffer: one.layer for one in read_channel_mapping(source)}
    assert mapped["radiance"] == "Y"
    assert mapped["normal"] == "N"
    pairs, _ = denoise(source)
    assert [changed(*pair) for pair in pairs] == [{"Y"}] * FRAMES
    wanted = np.mean(truth(2, samples=4096).light, axis=-1)
    noisy, result = (np.mean((file.pixels["Y"] - wanted) ** 2) for file in pairs[-1])
    assert result < 0.5 * noisy
    alone, _ = denoise(source, only_beauty=True)
    assert list(alone[0][1].pixels) == ["Y"]
    np.testing.assert_array_equal(alone[0][1].pixels["Y"], pairs[0][1].pixels["Y"])


def test_luminance_with_chroma_is_refused_in_words(tmp_path: Path, capsys: Any) -> None:
    """Its colours have half the size; without them the picture would come back grey."""
    header = OpenEXR.Header(8, 8)
    whole, half = (Imath.Channel(Imath.PixelType(Imath.PixelType.HALF), step, step) for step in (1, 2))
    header["channels"] = {"Y": whole, "RY": half, "BY": half}
    file = OpenEXR.OutputFile(str(tmp_path / "s.0001.exr"), header)
    file.writePixels({"Y": np.ones((8, 8), np.float16).tobytes()} | dict.fromkeys(("RY", "BY"), bytes(32)))
    file.close()
    for command in (["inspect", str(tmp_path)], ["denoise", str(tmp_path), "-o", str(tmp_path / "out")]):
        with pytest.raises(SystemExit):
            main.main([*command, *(["--method", "svgf"] if command[0] == "denoise" else [])])
        assert "luminance with chroma (Y, RY, BY) cannot be read; save it with R, G, B" in capsys.readouterr().err
