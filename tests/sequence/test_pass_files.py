"""A file for each pass: one frame by their names or by patterns that are stated, and never a picture of data."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.commands import main
from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.passes import read_pass_name
from jaxdn.data.foreign.shots import Shot
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests.data.test_kept import box_blur
from tests.programs import Channels, layer, truth

FRAMES = 3
Place = Callable[[str, int], str]


def passes(frame: int) -> dict[str, Channels]:
    """Each pass as a file has it: three channels, or Z alone."""
    now = truth(frame)
    rgba = np.concatenate([now.light, now.alpha], axis=-1)
    return {
        "beauty": layer("", rgba, "RGBA"),
        "albedo": layer("", now.albedo, "RGB"),
        "normal": layer("", now.normal, "RGB"),
        "depth": layer("", now.depth, "RGB"),
    }


def write(folder: Path, place: Place, frames: int = FRAMES, **more: Channels) -> Path:
    """Every pass of every frame in a file of its own."""
    for frame in range(1, frames + 1):
        for name, channels in (passes(frame) | more).items():
            path = folder / place(name, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            clips.write_exr(path, channels)
    return folder


PLACES: dict[str, tuple[Place, str]] = {
    "name.number": (lambda name, frame: f"{name}.{frame:04d}.exr", "beauty.{:04d}.exr"),
    "shot_name_number": (lambda name, frame: f"sh010_{name}_{frame:04d}.exr", "sh010_beauty_{:04d}.exr"),
    "number.name": (lambda name, frame: f"sh010.{frame:04d}.{name}.exr", "sh010.{:04d}.beauty.exr"),
    "nameNumber": (lambda name, frame: f"{name.title()}{frame:04d}.exr", "Beauty{:04d}.exr"),
    "the picture without a name": (
        lambda name, frame: f"sh.{frame:04d}.exr" if name == "beauty" else f"sh.{name}.{frame:04d}.exr",
        "sh.{:04d}.exr",
    ),
}


_WORDS = {"albedo": "DiffuseAlbedo", "normal": "WorldNormal", "depth": "LinearDepth"}
_LUX = {"beauty": "RGB_IMAGEPIPELINE", "normal": "AVG_SHADING_NORMAL"}
_TAGS = {"beauty": "ScalingInputColor", "normal": "Normals"}
_METAL = {"beauty": "color", "albedo": "diffuseAlbedo"}
_OIDN = {"beauty": "hdr", "albedo": "alb", "normal": "nrm", "depth": "z"}
PLACES |= {
    "Streamline": (
        lambda name, frame: f"kBufferType{_TAGS.get(name, name.title())}_{frame:04d}.exr",
        "kBufferTypeScalingInputColor_{:04d}.exr",
    ),
    "MetalFX": (
        lambda name, frame: f"{_METAL.get(name, name)}Texture.{frame:04d}.exr",
        "colorTexture.{:04d}.exr",
    ),
    "Metal, words parted": (lambda name, frame: f"{name}_texture_{frame:04d}.exr", "beauty_texture_{:04d}.exr"),
    "In": (
        lambda name, frame: f"In{'Color' if name == 'beauty' else name.title()}{frame:04d}.exr",
        "InColor{:04d}.exr",
    ),
    "Open Image Denoise": (lambda name, frame: f"scene.{frame:04d}.{_OIDN[name]}.exr", "scene.{:04d}.hdr.exr"),
    "a shot called main": (
        lambda name, frame: f"main_{name}_{frame:04d}.exr".replace("_beauty", ""),
        "main_{:04d}.exr",
    ),
    **{
        word: (
            lambda name, frame, word=word: f"{word if name == 'beauty' else name}_{frame:04d}.exr",  # type: ignore[misc]
            word + "_{:04d}.exr",
        )
        for word in ("noisyRadiance", "beauty_noisy", "hdr", "Main", "VRayRGB", "effectsResult")
    },
    "wordsInOne": (lambda name, frame: f"sh_{_WORDS.get(name, name)}_{frame:04d}.exr", "sh_beauty_{:04d}.exr"),
    "the picture has another name": (
        lambda name, frame: f"{'render' if name == 'beauty' else name}.{frame:04d}.exr",
        "render.{:04d}.exr",
    ),
    "LuxCore": (lambda name, frame: f"{_LUX.get(name, name).upper()}{frame:04d}.exr", "RGB_IMAGEPIPELINE{:04d}.exr"),
}


@pytest.mark.parametrize("case", PLACES)
def test_passes_in_files_of_their_own_are_one_frame(case: str, tmp_path: Path) -> None:
    place, result = PLACES[case]
    source, told = write(tmp_path / "in", place), list[str]()
    written = denoise_files([source], tmp_path / "out", box_blur(), Settings(), log=told.append)
    expected = [result.format(number) for number in range(1, FRAMES + 1)]
    assert [path.name for path in written.files] == expected
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == expected
    assert "a file for each pass" in told[0]
    after, before = clips.read_exr(tmp_path / "out" / expected[0]), clips.read_exr(source / expected[0])
    assert set(after) == set("RGBA")
    np.testing.assert_array_equal(after["A"], before["A"])
    assert np.abs(after["R"] - before["R"]).max() > 0.01
    clip = clips.read_clip(source)
    np.testing.assert_allclose(clip.frames.albedo[0], truth(1).albedo, rtol=1e-6)
    np.testing.assert_allclose(clip.frames.normal[0], truth(1).normal, rtol=1e-6)
    np.testing.assert_allclose(clip.frames.depth[0], truth(1).depth, rtol=1e-6)


def test_a_folder_for_each_pass(tmp_path: Path) -> None:
    source = write(tmp_path / "in", lambda name, frame: f"{name}/sh.{frame:04d}.exr")
    told: list[str] = []
    sources = [source / name for name in ("beauty", "albedo", "normal")]
    written = denoise_files(sources, tmp_path / "out", box_blur(), log=told.append)
    assert [path.name for path in written.files] == [f"sh.{number:04d}.exr" for number in range(1, FRAMES + 1)]
    assert "albedo from sh.0001.exr, normal from sh.0001.exr" in told[0]


@pytest.mark.parametrize("pattern", ["*_colours.exr", "####_colours.exr"])
def test_patterns_name_the_files_of_a_pass(pattern: str, tmp_path: Path, capsys: Any) -> None:
    source = write(tmp_path / "in", lambda name, frame: f"{frame:04d}_{'colours' if name == 'albedo' else name}.exr")
    channels = {"albedo": str(source / pattern)}
    clip = clips.read_clip(source, channels=channels)
    np.testing.assert_allclose(clip.frames.albedo[1], truth(2).albedo, rtol=1e-6)
    denoise_files([source], tmp_path / "out", box_blur(), Settings(naming=ChannelNaming(channels=channels)))
    assert len(list((tmp_path / "out").iterdir())) == FRAMES
    main.main(["inspect", str(source), "--channels", f"albedo={source / pattern}"])
    assert "share of light" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main.main(["inspect", str(source), "--channels", f"albedo={source}/none_*.exr"])
    assert "none_*.exr: expected a folder of EXR files, a pattern" in " ".join(capsys.readouterr().err.split())


def test_a_picture_in_files_of_its_own_is_what_is_denoised(tmp_path: Path) -> None:
    """Its result would have no place in the files that were named."""
    source = write(tmp_path / "in", lambda name, frame: f"{'noisy' if name == 'beauty' else name}.{frame:04d}.exr")
    naming = ChannelNaming(channels={"radiance": str(source / "noisy.*.exr")})
    with pytest.raises(ClipError, match=r"--channels radiance=.*noisy.*: expected a layer of the files that are"):
        denoise_files([source / "depth.*.exr"], tmp_path / "out", box_blur(), Settings(naming=naming))
    assert not (tmp_path / "out").exists()


def test_a_frame_without_one_of_its_passes_is_missing(tmp_path: Path) -> None:
    source, told = write(tmp_path / "in", PLACES["name.number"][0]), list[str]()
    (source / "albedo.0001.exr").unlink()
    (source / "normal.0003.exr").write_bytes(b"")
    written = denoise_files([source], tmp_path / "out", box_blur(), log=told.append)
    assert [path.name for path in written.files] == ["beauty.0002.exr"]
    assert [path.name for path in written.left_out] == ["beauty.0001.exr", "beauty.0003.exr"]
    assert any("a file without albedo" in line for line in told)
    assert any("normal.0003.exr: the file is empty (0 bytes)" in line for line in told)


def test_a_data_pass_is_never_a_picture(tmp_path: Path, capsys: Any) -> None:
    depth = layer("", truth(1).depth, "Z")
    source = write(tmp_path / "in", lambda name, frame: f"{name}.{frame:04d}.exr", aaa=depth)
    (tmp_path / "in" / "other_albedo.0001.exr").write_bytes((source / "albedo.0001.exr").read_bytes())
    told: list[str] = []
    written = denoise_files([source], tmp_path / "out", box_blur(), log=told.append)
    assert {path.name.partition(".")[0] for path in written.files} == {"beauty"}
    assert any("aaa.#.exr 1-3 is left out: " in line and "no radiance" in line for line in told)
    assert any("other_albedo.0001.exr: not a picture but a data pass (albedo), left out" in line for line in told)
    with pytest.raises(SystemExit) as ended:
        main.main(["denoise", str(source / "albedo.*.exr"), "-o", str(tmp_path / "no"), "--method", "noisy"])
    assert ended.value.code == 2
    assert "not a picture but a data pass (albedo)" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize("alone", [True, False])
def test_normals_are_no_picture_though_none_is_beside_them(alone: bool, tmp_path: Path) -> None:
    source = write(tmp_path / "in", PLACES["name.number"][0])
    for name in ("beauty", "depth", *(["albedo"] if alone else [])):
        for path in source.glob(f"{name}.*"):
            path.unlink()
    with pytest.raises(ClipError, match="not a picture but a data pass"):
        denoise_files([source], tmp_path / "out", box_blur())


def test_data_that_nobody_reads_is_no_picture_and_light_is_one(tmp_path: Path) -> None:
    now, told = truth(1), list[str]()
    more = {
        "WorldPosition": layer("", 9 * now.normal, "RGB"),
        "uv": layer("", now.albedo, "RGB"),
        "cryptomatte": layer("", now.albedo, "RGB"),
        "specular": layer("", now.light, "RGB"),
        "diffuse": layer("", now.light, "RGB"),
    }
    source = write(tmp_path / "in", lambda name, frame: f"sh_{name}.{frame:04d}.exr", **more)
    written = denoise_files([source], tmp_path / "out", box_blur(), log=told.append)
    assert {path.name.partition(".")[0] for path in written.files} == {"sh_beauty", "sh_specular", "sh_diffuse"}
    assert any("not a picture but a data pass (world_position), left out" in line for line in told)


def test_a_pass_of_another_size_in_one_frame_is_a_missing_frame(tmp_path: Path) -> None:
    source, told = write(tmp_path / "in", PLACES["name.number"][0]), list[str]()
    clips.write_exr(source / "albedo.0002.exr", layer("", truth(2).albedo[::2, ::2], "RGB"))
    written = denoise_files([source], tmp_path / "out", box_blur(), log=told.append)
    assert [path.name for path in written.files] == ["beauty.0001.exr", "beauty.0003.exr"]
    assert any("beauty.0002.exr is left out, as a missing frame" in line for line in told)


def test_whole_frames_are_frames_whatever_they_are_called(tmp_path: Path) -> None:
    now = truth(1)
    channels = layer("", now.light, "RGB") | layer("N", now.normal, "XYZ")
    for name in ("albedo.0001.exr", "beauty.0001.exr", "motion_0001.exr"):
        (tmp_path / "in").mkdir(exist_ok=True)
        clips.write_exr(tmp_path / "in" / name, channels)
    assert len(denoise_files([tmp_path / "in"], tmp_path / "out", box_blur()).files) == 3
    for name in ("vector_0001.exr", "forward_0001.exr"):  # a shot may be called so
        clips.write_exr(tmp_path / name, layer("", now.light, "RGB"))
        assert len(denoise_files([tmp_path / name], tmp_path / "out", box_blur()).files) == 1


@pytest.mark.parametrize(
    ("name", "word", "buffer"),
    [
        ("sh_Denoising Albedo#", "denoising albedo", "albedo"),
        ("sh.diffuseFilter.#", "diffusefilter", "albedo"),
        ("sh_Z_#", "z", "depth"),
        ("Image#", "image", "radiance"),
        ("normality_#", "", None),
        ("beautyshot.#", "", None),
    ],
)
def test_words_for_passes_stand_alone(name: str, word: str, buffer: str | None) -> None:
    found = read_pass_name(Shot((Path(f"{name}.exr"),), (1,), name))
    assert (found.word, found.buffer) == (word, buffer)


@pytest.mark.parametrize(
    ("place", "result"), [("{0}/{1:04d}.exr", "{:04d}.exr"), ("{0}/s_{0}_{1:04d}.exr", "s_Beauty_{:04d}.exr")]
)
def test_the_parent_of_a_folder_for_each_pass(place: str, result: str, tmp_path: Path, capsys: Any) -> None:
    source = write(tmp_path / "in", lambda name, frame: place.format(name.title(), frame))
    (source / "previews").mkdir()
    written = denoise_files([source], tmp_path / "out", box_blur())
    assert written.files == [tmp_path / "out" / result.format(number) for number in range(1, FRAMES + 1)]
    np.testing.assert_allclose(clips.read_clip(source).frames.albedo[0], truth(1).albedo, rtol=1e-6)
    main.main(["inspect", str(source)])
    assert "a file for each pass, albedo from" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("names", [("sh010", "sh020"), ("beauty", "sh010"), ("albedo", "normal")])
def test_folders_whose_names_tell_nothing_are_no_passes(names: tuple[str, str], tmp_path: Path) -> None:
    for name in names:
        (tmp_path / name).mkdir()
        clips.write_exr(tmp_path / name / "0001.exr", layer("", truth(0).light, "RGB"))
    with pytest.raises(ClipError, match="found none"):
        clips.read_clip(tmp_path)


def test_light_in_files_of_its_own_is_not_said_to_be_denoised(tmp_path: Path) -> None:
    for frame in (1, 2):
        light = truth(frame).light
        clips.write_exr(tmp_path / f"in_beauty.{frame:04d}.exr", layer("", light, "RGB"))
        clips.write_exr(tmp_path / f"in_diffuse.{frame:04d}.exr", layer("", 0.5 * light, "RGB"))
    told: list[str] = []
    settings = Settings(aovs="additive")
    denoise_files([tmp_path / "in_*.exr"], tmp_path / "out", find_model("noisy"), settings, log=told.append)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {f"in_beauty.{frame:04d}.exr" for frame in (1, 2)}
    text = "\n".join(told)
    assert text.count("--aovs additive: diffuse lies in files of its own and is not denoised; ") == 1
    assert "denoised with the beauty" not in text
