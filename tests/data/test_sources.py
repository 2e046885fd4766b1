"""What was chosen is said first: which buffer is read from where, what it is taken for, and what is missing."""

import json
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from jaxdn.clips import MOTION_CONVENTIONS, ClipError, read_clip, write_clip
from jaxdn.commands import main
from jaxdn.commands.channel_table import CONSEQUENCES, list_missing
from jaxdn.commands.doctor import doctor
from jaxdn.data.exr.exr import read_exr
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import LAYERS
from jaxdn.methods.registry import methods
from jaxdn.runtime.optional import install
from tests.training.test_training import make_clip


def write(path: Path, *layers: str, value: float = 0.5) -> Path:
    """A file of constant channels, but for normals (which would be an empty layer), each layer as ``name:letters``."""
    names = [f"{name}.{letter}" if name else letter for name, _, letters in (one.partition(":") for one in layers)
             for letter in letters]  # fmt: skip
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = {name: np.full((16, 16), value, np.float32) for name in names}
    for name in names:
        if "Normal" in name:
            pixels[name] += np.linspace(0, 0.1, 16, dtype=np.float32)
    OpenEXR.File(header, pixels).write(str(path))
    return path


BLENDER = ("Combined:RGBA", "Denoising Albedo:RGB", "Denoising Normal:XYZ", "Depth:Z", "Vector:XYZW", "IndexOB:X")


def blender(view: str) -> list[str]:
    return [f"{view}.{layer}" for layer in BLENDER]


@pytest.fixture
def shot(tmp_path):
    """A file of Blender's with two view layers."""
    return write(tmp_path / "shot_0001.exr", *blender("Room"), *blender("Hall"))


def test_the_names_in_a_header_are_those_of_the_pixels(shot, tmp_path):
    assert sorted(ExrFile(shot).windows) == sorted(read_exr(shot))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    plane = np.ones((4, 4), np.float32)
    parts = [OpenEXR.Part({**header, "name": name}, {"R": plane.copy(), "Z": plane.copy()}) for name in ("a", "b.c")]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    assert sorted(ExrFile(tmp_path / "parts.exr").windows) == sorted(read_exr(tmp_path / "parts.exr"))
    (tmp_path / "no.exr").write_bytes(b"not an image")
    with pytest.raises(ClipError, match="not readable as OpenEXR"):
        ExrFile(tmp_path / "no.exr").windows  # noqa: B018
    with pytest.raises(ClipError, match="no such file"):
        ExrFile(tmp_path / "nowhere.exr").windows  # noqa: B018


def test_a_view_layer_is_chosen(shot, capsys):
    with pytest.raises(ClipError, match=r"'Hall\.Combined' and 'Room\.Combined' fit equally well.*--layer"):
        read_channel_mapping(shot)
    found = {source.buffer: source for source in read_channel_mapping(shot, ChannelNaming(layer="Hall"))}
    assert found["radiance"].layer == "Hall.Combined"
    assert found["albedo"].channels == tuple(f"Hall.Denoising Albedo.{letter}" for letter in "RGB")
    assert found["motion"].convention.startswith("pixels, previous minus current position, y up (Blender")
    assert all(source.layer.startswith("Hall.") for source in found.values())
    mixed = {
        source.buffer: source.layer
        for source in read_channel_mapping(shot, ChannelNaming(layer="Hall", channels={"depth": "Room.Depth"}))
    }
    assert (mixed["depth"], mixed["normal"]) == ("Room.Depth", "Hall.Denoising Normal")
    with pytest.raises(ClipError, match=r"layer: there is none called 'Cellar'; there are '\w+', '\w+'"):
        read_channel_mapping(shot, ChannelNaming(layer="Cellar"))
    assert read_clip(shot, layer="Hall").frames.albedo is not None


def test_only_what_can_be_named_is_listed_as_a_layer(tmp_path):
    """The letters of the image itself are no layers; a depth without a layer can be named: Z."""
    path = write(tmp_path / "a_1.exr", ":RGBAZ", "Paint:RGB", "N:XYZ")
    with pytest.raises(ClipError, match=r"no albedo in layer 'Dyes'; there are 'N', 'Paint', 'Z'\.$"):
        read_channel_mapping(path, ChannelNaming(channels={"albedo": "Dyes"}))
    with pytest.raises(ClipError, match=r"none called 'Cellar'; there are 'N', 'Paint'\.$|'Paint', 'N'\.$"):
        read_channel_mapping(path, ChannelNaming(layer="Cellar"))
    with pytest.raises(ClipError, match=r"none called 'Cellar'; there are none\.$"):
        read_channel_mapping(write(tmp_path / "b_1.exr", ":RGBA"), ChannelNaming(layer="Cellar"))


@pytest.mark.parametrize("command", [["inspect", "nowhere"], ["denoise", "nowhere", "-o", "out"]])
def test_an_unknown_convention_is_refused_before_anything_is_read(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main([*command, "--motion-convention", "sideways"])
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "jaxdn: --motion-convention: expected one of the names below, got 'sideways'."
    assert [line.split()[0] for line in lines[1:]] == [*MOTION_CONVENTIONS, "none"]


def run(capsys, *arguments):
    main.main([str(argument) for argument in arguments])
    return " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_denoise_begins_with_the_table(shot, tmp_path, capsys):
    text = run(capsys, "denoise", shot, "-o", tmp_path / "out", "--method", "svgf", "--layer", "Hall")
    for row in (
        "radiance Hall.Combined R, G, B linear light",
        "normal Hall.Denoising Normal X, Y, Z camera space",
        "depth Hall.Depth Z along the optical axis (view-space z), not along the ray",
        "motion Hall.Vector X, Y pixels, previous minus current position, y up (Blender's Vector pass,",
    ):
        assert row in text
    assert text.index("radiance Hall") < text.index("1 frame denoised")
    assert "missing" not in text.partition("1 frame ")[0].replace("specular_reflectance missing", "")


@pytest.mark.slow
def test_a_single_image_is_not_asked_about_motion(tmp_path, capsys):
    layers = ":RGB", "albedo:RGB", "normal:XYZ", "depth:Z"
    for name, vectors in (("with", ("mvec:XY",)), ("without", ())):
        image = write(tmp_path / f"{name}.exr", *layers, *vectors)
        text = run(capsys, "denoise", image, "-o", tmp_path / "out", "--method", "taa")
        assert "1 frame denoised" in text
        assert "motion missing" not in text
        assert "nothing says: state" not in text
        assert ("'mvec', as nothing says what these vectors mean; a single image needs none" in text) == bool(vectors)


@pytest.mark.slow
def test_what_is_missing_is_said_with_its_consequence(tmp_path, capsys):
    path = write(tmp_path / "a_1.exr", ":RGB", "diffuseFilter:RGB", "Paint:RGB", "mvec:XY")
    reads = methods()["svgf"].factory().reads
    lost = list_missing(read_channel_mapping(path), reads)
    assert set(lost) == {"normal", "depth", "ids"} | ({"specular_reflectance"} & reads)
    options = ("--motion-convention", "uv", "--channels", "albedo=Paint")
    text = run(capsys, "denoise", path, "-o", tmp_path / "out", "--method", "svgf", *options)
    assert "albedo Paint R, G, B" in text
    assert "motion mvec X, Y fractions of the image" in text
    for name, consequence in lost.items():
        assert f"{name} missing {consequence}" in text


def test_inspect_prints_the_same_and_gives_it_as_json(tmp_path, capsys):
    path = write(tmp_path / "a_1.exr", ":RGB", "diffuseFilter:RGB", "mvec:XY")
    text = run(capsys, "inspect", path)
    assert "albedo diffuseFilter R, G, B" in text
    assert "motion mvec X, Y nothing says: state --motion-convention" in text
    assert f"depth missing {CONSEQUENCES['depth']}" in text
    sources = json.loads(run(capsys, "inspect", path, "--json", "--channels", "albedo=none"))["sources"]
    assert [source["buffer"] for source in sources] == ["radiance", "motion"]
    with pytest.raises(SystemExit) as ended:
        main.main(["inspect", "edge", "--layer", "Hall"])
    assert ended.value.code == 2
    assert "expected none of --channels, --layer, --motion-convention" in capsys.readouterr().err


def test_a_clip_of_ours_has_a_table_too(tmp_path, capsys):
    write_clip(make_clip(0), tmp_path / "clip")
    found = {source.buffer: source for source in read_channel_mapping(tmp_path / "clip")}
    assert found["radiance"].channels == ("noisy_1spp.R", "noisy_1spp.G", "noisy_1spp.B")
    assert set(found) == {"radiance", "albedo", "normal", "depth", "motion", "dual_motion"}
    assert "motion motion X, Y pixels, previous minus current position, y down" in run(
        capsys, "inspect", tmp_path / "clip"
    )


def test_every_buffer_that_other_renderers_have_has_a_consequence():
    assert set(CONSEQUENCES) == set(LAYERS) - {"radiance"}


def test_the_version_and_what_is_installed(capsys, monkeypatch):
    assert run(capsys, "--version") == f"jaxdn {main.jaxdn.__version__}"
    text = run(capsys, "doctor")
    for word in ("jax ", " on ", "backend for inference", "backend for training", "optax", "mitsuba", "Python"):
        assert word in text
    monkeypatch.setattr("jaxdn.commands.doctor.find_spec", lambda name: None)
    advice = {finding.what: finding.advice for finding in doctor()}
    assert advice["training"].endswith(install("train"))
    assert advice["Open Image Denoise"].endswith(install("oidn"))
    assert advice["rendering"].endswith(install("render"))
