"""Clips on disk: round trips, and errors about broken and missing files and those of other renderers."""

import json
import subprocess
import sys
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.clips import ClipError
from jaxdn.core.frame import BUFFERS, FAR, Clip, Frame
from jaxdn.data.evidence import read_clip_properties
from jaxdn.data.exr.exr import to_half
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.vectors import convert_motion

HALF = tuple(name for name, row in BUFFERS.items() if row.stored == "half")


def make_buffer(rng: np.random.Generator, name: str, height: int, width: int) -> np.ndarray:
    """Random values of a buffer's kind; too large for half precision where single is stored."""
    row = BUFFERS[name]
    image = rng.random((height, width, row.channels), np.float32)
    if row.stored in ("flag", "id"):
        return image > 0.5 if row.stored == "flag" else (9 * image - 1).astype(np.int32)
    scale, offset = {"light": (10, 0), "direction": (2, -1), "fraction": (1, 0)}.get(row.kind, (2e5, -1e5))
    return np.float32(scale) * image + np.float32(offset)


def make_frame(rng: np.random.Generator, height: int, width: int) -> Frame:
    return Frame(**{name: make_buffer(rng, name, height, width) for name in BUFFERS})


def make_clip(rng: np.random.Generator, count: int = 3, height: int = 5, width: int = 7) -> Clip:
    frames = [make_frame(rng, height, width) for _ in range(count)]
    stacked = Frame(*(np.stack(buffers) for buffers in zip(*frames, strict=True)))
    return Clip(stacked, rng.random((count, height, width, 3), np.float32))


@pytest.mark.parametrize("size", [(1, 1), (33, 57), (1, 40)])
def test_every_buffer_round_trips(tmp_path: Path, rng: np.random.Generator, size: tuple[int, int]) -> None:
    frame = make_frame(rng, *size)
    clips.write_frame(tmp_path / "a.exr", frame, reference=frame.direct, reference_half=frame.emission)
    stored = clips.read_frame(tmp_path / "a.exr")
    for name, buffer in frame._asdict().items():
        found = getattr(stored.frame, name)
        expected = buffer.astype(np.float16).astype(np.float32) if name in HALF else buffer
        assert found.dtype == expected.dtype, name
        np.testing.assert_array_equal(found, expected, err_msg=name)
    np.testing.assert_array_equal(stored.reference, frame.direct.astype(np.float16))
    np.testing.assert_array_equal(stored.reference_half, frame.emission.astype(np.float16))
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]  # and nothing else is left


def test_the_channels_of_the_first_version_stay_unchanged(tmp_path: Path, rng: np.random.Generator) -> None:
    """Clips from before there was a table of buffers stay readable, and new clips by old readers."""
    half = [*rgb("albedo"), *rgb("normal", "XYZ"), "roughness.Y", "visible.Y", *rgb("direct"), *rgb("emission")]
    half += [*rgb("noisy_1spp"), *rgb("reference")]
    single = ["depth.Z", "previous_depth.Z", *rgb("motion", "XY"), *rgb("dual_motion", "XY")]
    types = dict.fromkeys(half, np.float16) | dict.fromkeys(single, np.float32) | {"ids.Y": np.uint32}
    names = {name.partition(".")[0] for name in types} & set(BUFFERS)
    frame = make_frame(rng, 3, 4)
    first = Frame(frame.radiance, **{name: getattr(frame, name) for name in names})
    clips.write_frame(tmp_path / "a.exr", first, reference=frame.direct)
    found = clips.read_exr(tmp_path / "a.exr")
    assert {name: pixels.dtype for name, pixels in found.items()} == types
    np.testing.assert_array_equal(found["ids.Y"], frame.ids[..., 0] + 1)


def test_absent_buffers_stay_absent(tmp_path: Path, rng: np.random.Generator) -> None:
    clips.write_frame(tmp_path / "a.exr", Frame(radiance=rng.random((4, 3, 3))))
    stored = clips.read_frame(tmp_path / "a.exr")
    assert all(buffer is None for name, buffer in stored.frame._asdict().items() if name != "radiance")
    assert stored.reference is None
    assert stored.reference_half is None


def test_non_contiguous_views_are_written_correctly(tmp_path: Path, rng: np.random.Generator) -> None:
    image = rng.random((9, 6), np.float32)
    channels = {"turned": np.rot90(image).T, "fortran": np.asfortranarray(image), "mirrored": image[::-1, ::-1]}
    clips.write_exr(tmp_path / "a.exr", channels)
    found = clips.read_exr(tmp_path / "a.exr")
    for name, pixels in channels.items():
        np.testing.assert_array_equal(found[name], pixels)


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((2, 2)),
        np.zeros((2, 2), bool),
        np.zeros((2, 2, 1), np.float32),
        np.zeros((0, 2), np.float32),
        np.zeros(4, np.float32),
    ],
)
def test_channels_that_openexr_would_corrupt_are_refused(tmp_path: Path, pixels: np.ndarray) -> None:
    with pytest.raises(ValueError, match=r"a\.exr: channel x: expected"):
        clips.write_exr(tmp_path / "a.exr", {"x": pixels})
    assert not list(tmp_path.iterdir())


def test_broken_radiance_is_kept_and_large_radiance_clamped(tmp_path: Path) -> None:
    values = np.array([[[np.nan, np.inf, -np.inf], [-3.0, 1e9, -1e9]]], np.float32)
    clips.write_frame(tmp_path / "a.exr", Frame(radiance=values))
    found = clips.read_frame(tmp_path / "a.exr").frame.radiance
    expected = np.array([[[np.nan, np.inf, -np.inf], [-3.0, 65504.0, -65504.0]]], np.float32)
    np.testing.assert_array_equal(found, expected)
    assert to_half(np.float64([65519.99, 65504.0])).tolist() == [65504.0, 65504.0]


def test_sample_counts_are_made_of_independent_layers(tmp_path: Path, rng: np.random.Generator) -> None:
    layers = {n: rng.random((3, 4, 3)).astype(np.float16) for n in (1, 2, 4)}
    clips.write_frame(tmp_path / "a.exr", Frame(radiance=layers[1]), layers=layers)
    for spp in range(1, 8):
        chosen = [n for n in (1, 2, 4) if spp & n]
        expected = sum(n * layers[n].astype(np.float64) for n in chosen) / spp
        np.testing.assert_allclose(clips.read_frame(tmp_path / "a.exr", spp=spp).frame.radiance, expected, rtol=1e-6)
    for spp in (8, 9):
        with pytest.raises(ClipError, match=rf"{spp} samples a pixel are not available.*1, 2, 4"):
            clips.read_frame(tmp_path / "a.exr", spp=spp)
    for spp in (0, -1, 1.5, True):
        with pytest.raises(ClipError, match="spp: expected a whole number"):
            clips.read_frame(tmp_path / "a.exr", spp=spp)  # type: ignore[arg-type]


def test_a_frame_of_wrong_shapes_is_refused(tmp_path: Path) -> None:
    image = np.zeros((4, 6, 3), np.float32)
    with pytest.raises(ValueError, match=r"motion: expected shape \(4, 6, 2\), got \(4, 6, 3\)"):
        clips.write_frame(tmp_path / "a.exr", Frame(radiance=image, motion=image))
    with pytest.raises(ValueError, match=r"reference: expected shape \(4, 6, 3\)"):
        clips.write_frame(tmp_path / "a.exr", Frame(radiance=image), reference=image[1:])
    with pytest.raises(ValueError, match="ids: expected whole numbers"):
        clips.write_frame(tmp_path / "a.exr", Frame(radiance=image, ids=image[..., :1]))
    with pytest.raises(FileNotFoundError, match="create it first"):
        clips.write_frame(tmp_path / "nowhere" / "a.exr", Frame(radiance=image))


def test_every_truncation_is_noticed(tmp_path: Path, rng: np.random.Generator) -> None:
    file = tmp_path / "a.exr"
    clips.write_frame(file, make_frame(rng, 33, 9))
    whole = file.read_bytes()
    for size in [0, 1, 4, 8, len(whole) - 1, *rng.integers(0, len(whole), 60)]:
        file.write_bytes(whole[:size])
        with pytest.raises(ClipError, match=r"a\.exr: "):
            clips.read_frame(file)


def test_damaged_bytes_only_raise_clip_errors(tmp_path: Path, rng: np.random.Generator) -> None:
    file = tmp_path / "a.exr"
    clips.write_frame(file, make_frame(rng, 9, 9))
    whole = np.frombuffer(file.read_bytes(), np.uint8)
    refused = 0
    for _ in range(150):
        damaged = whole.copy()
        damaged[rng.integers(0, len(whole), 3)] ^= rng.integers(1, 256, 3).astype(np.uint8)
        file.write_bytes(damaged.tobytes())
        try:
            clips.read_frame(file)
        except ClipError as error:
            refused += "a.exr" in str(error)
    assert refused > 100  # a compressed file without checksums of its header cannot notice all of it


def test_a_missing_channel_is_named(tmp_path: Path, rng: np.random.Generator) -> None:
    file = tmp_path / "a.exr"
    clips.write_frame(file, make_frame(rng, 4, 4))
    channels = clips.read_exr(file)
    for lost in ("motion.Y", "noisy_1spp.G", "albedo.B"):
        clips.write_exr(file, {name: pixels for name, pixels in channels.items() if name != lost})
        with pytest.raises(ClipError, match=rf"expected the channels {lost}"):
            clips.read_frame(file)


FULL_DISK = """
import resource, sys
import numpy as np
from jaxdn import clips
from jaxdn.core.frame import Frame
for limit, side in ((300, 2), (600, 4), (20000, 99)):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    image = np.random.default_rng(0).random((side, side, 3), np.float32)
    try:
        clips.write_frame(sys.argv[1] + "/a.exr", Frame(radiance=image, motion=image[..., :2]))
    except OSError as error:
        print("OSError", error)
"""


def test_a_full_disk_leaves_only_the_old_frame(tmp_path: Path) -> None:
    """Small files too: the EXR library itself does not notice when a disk fills up within its last buffer."""
    (tmp_path / "a.exr").write_bytes(b"the old frame")
    command = [sys.executable, "-c", FULL_DISK, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    said = [line for line in done.stdout.splitlines() if line.startswith("OSError")]
    assert len(said) == 3
    assert all(str(tmp_path / "a.exr") in line for line in said)
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]
    assert (tmp_path / "a.exr").read_bytes() == b"the old frame"


def test_a_clip_round_trips_with_its_record(tmp_path: Path, rng: np.random.Generator) -> None:
    clip = make_clip(rng)
    clips.write_clip(clip, tmp_path / "c", record={"seed": 5, "scene": {"family": "fruit"}, "layers": [1, 2]}, spp=4)
    record = clips.read_record(tmp_path / "c")
    assert (record["frames"], record["height"], record["width"], record["layers"]) == (3, 5, 7, [4])
    assert (record["name"], record["seed"], record["scene"]) == ("c", 5, {"family": "fruit"})
    found = clips.read_clip(tmp_path / "c", spp=4)
    for name, buffer in clip.frames._asdict().items():
        expected = buffer.astype(np.float16).astype(np.float32) if name in HALF else buffer
        np.testing.assert_array_equal(getattr(found.frames, name), expected, err_msg=name)
    np.testing.assert_array_equal(found.reference, clip.reference.astype(np.float16))
    # Half-precision values are written and read without any change.
    clips.write_clip(found, tmp_path / "d", spp=4)
    again = clips.read_clip(tmp_path / "d", spp=4)
    np.testing.assert_array_equal(again.frames.radiance, found.frames.radiance)
    with pytest.raises(ClipError, match=r"not available.*layers of 4 samples"):
        clips.read_clip(tmp_path / "c", spp=1)
    assert len(list(clips.read_frames(tmp_path / "c", spp=4))) == 3


def test_a_shorter_clip_replaces_a_longer_one(tmp_path: Path, rng: np.random.Generator) -> None:
    clips.write_clip(make_clip(rng, 4), tmp_path / "c")
    clips.write_clip(make_clip(rng, 2), tmp_path / "c")
    assert len(list((tmp_path / "c").glob("*.exr"))) == 2
    assert clips.read_clip(tmp_path / "c").frames.radiance.shape[0] == 2


def test_somebodys_frames_are_not_taken_for_an_old_clip(tmp_path: Path, rng: np.random.Generator) -> None:
    """Rendered files may be called as a clip's frames are: none is overwritten or removed."""
    for index in range(4):
        (tmp_path / f"frame_{index:04d}.exr").write_bytes(b"a render")
    with pytest.raises(ClipError, match=r"got frame_000\d\.exr and no clip\.json; name another folder"):
        clips.write_clip(make_clip(rng, 2), tmp_path)
    assert [path.read_bytes() for path in sorted(tmp_path.iterdir())] == [b"a render"] * 4


@pytest.mark.parametrize("wrong", ["albedo", "reference"])
def test_a_clip_that_is_refused_leaves_the_old_one(tmp_path: Path, rng: np.random.Generator, wrong: str) -> None:
    clips.write_clip(make_clip(rng, 2), tmp_path / "c")
    files = {path: path.read_bytes() for path in (tmp_path / "c").iterdir()}
    clip = make_clip(rng, 2)
    if wrong == "albedo":
        clip = clip._replace(frames=clip.frames._replace(albedo=clip.frames.albedo[..., :1]))
    else:
        clip = clip._replace(reference=clip.reference[:, :3])
    for place in ("c", "new"):
        with pytest.raises(ValueError, match=rf"{wrong}: expected shape"):
            clips.write_clip(clip, tmp_path / place)
    assert {path: path.read_bytes() for path in (tmp_path / "c").iterdir()} == files
    assert not (tmp_path / "new").exists()


def test_light_beyond_half_precision_is_counted(tmp_path: Path, rng: np.random.Generator) -> None:
    clip = make_clip(rng, 2)
    clip.reference[0, 0, :2] = 1e6
    with pytest.warns(UserWarning, match=r"values beyond 65504 become that.*: 6 of reference; divide"):
        clips.write_clip(clip, tmp_path / "c")
    assert clips.read_clip(tmp_path / "c").reference.max() == 65504


@pytest.mark.parametrize("given", [{"channels": {"albedo": "none"}}, {"view": "left"}, {"motion_convention": "uv"}])
def test_a_clip_of_ours_refuses_what_names_the_channels_of_others(
    tmp_path: Path, rng: np.random.Generator, given: dict[str, Any]
) -> None:
    clips.write_clip(make_clip(rng, 2), tmp_path / "c")
    with pytest.raises(ClipError, match=f"expected none of {next(iter(given))}, which are for files of other"):
        clips.read_clip(tmp_path / "c", **given)


def test_broken_clips_are_refused_with_the_reason(tmp_path: Path, rng: np.random.Generator) -> None:
    folder = tmp_path / "c"
    clips.write_clip(make_clip(rng, 4), folder)
    record = json.loads((folder / "clip.json").read_text())

    def refused(match: str, **changes: object) -> None:
        (folder / "clip.json").write_text(json.dumps({**record, **changes}))
        with pytest.raises(ClipError, match=match):
            clips.read_clip(folder)

    refused("expected format 1, got 2", format=2)
    refused("frames: expected a whole number", frames=0)
    refused("width: expected a whole number", width=7.0)
    refused("layers: expected a list", layers=[])
    refused(r"2 of 6 frames are missing \(4, 5\)", frames=6)
    refused(r"frame_0000\.exr: expected 8 x 5 pixels", width=8)
    for text in ("{", "[]", "", '{"format": NaN}', "[" * 100000):
        (folder / "clip.json").write_text(text)
        with pytest.raises(ClipError, match=r"clip\.json: "):
            clips.read_clip(folder)
    clips.finish_record(record, folder)
    clips.write_frame(folder / "frame_0002.exr", make_frame(rng, 6, 7))
    with pytest.raises(ClipError, match=r"frame_0002\.exr: expected 7 x 5 pixels as clip\.json says, got 7 x 6"):
        clips.read_clip(folder)
    clips.write_frame(folder / "frame_0002.exr", make_frame(rng, 5, 7)._replace(albedo=None))
    with pytest.raises(ClipError, match=r"frame_0002\.exr: .*but albedo, reference differs"):
        clips.read_clip(folder)
    (folder / "clip.json").unlink()
    with pytest.raises(ClipError, match="was not finished"):
        clips.read_clip(folder)
    with pytest.raises(ClipError, match="no such folder"):
        clips.read_record(tmp_path / "nowhere")
    with pytest.raises(ClipError, match="found none"):
        clips.read_clip(tmp_path / "nowhere")


def test_a_record_that_is_not_json_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    for value in (float("nan"), np.zeros(3), {1, 2}):
        with pytest.raises(ValueError, match="cannot be written as JSON"):
            clips.write_clip(make_clip(rng, 1), tmp_path / "c", record={"value": value})
        assert not clips.is_clip(tmp_path / "c")


def test_a_refused_record_leaves_the_existing_clip(tmp_path: Path, rng: np.random.Generator) -> None:
    clips.write_clip(make_clip(rng, 2), tmp_path / "c")
    with pytest.raises(ValueError, match="cannot be written as JSON"):
        clips.write_clip(make_clip(rng, 1), tmp_path / "c", record={"value": float("nan")})
    assert clips.read_clip(tmp_path / "c").frames.radiance.shape[0] == 2


def test_a_clip_counts_as_one_when_its_last_frame_is_written(tmp_path: Path, rng: np.random.Generator) -> None:
    folder = tmp_path / "made" / "c"
    record = {"frames": 1, "width": 7, "height": 5, "layers": [1], "seed": 4}
    assert clips.begun_record(folder) is None
    clips.begin_record(record, folder)
    clips.write_frame(clips.frame_path(folder, 0), make_frame(rng, 5, 7))
    assert not clips.is_clip(folder)
    assert clips.begun_record(folder) == {"format": 1, **record}
    for read in (clips.read_clip, clips.read_record, read_clip_properties):
        with pytest.raises(ClipError, match="c: rendering this clip was interrupted; run the same command again"):
            read(folder)
    clips.finish_record(record, folder)
    assert clips.read_record(folder) == clips.begun_record(folder) == {"format": 1, **record}
    assert sorted(file.name for file in folder.iterdir()) == ["clip.json", "frame_0000.exr"]
    # More frames are added: until they exist it is not a clip.
    clips.begin_record({**record, "frames": 2}, folder)
    assert not clips.is_clip(folder)
    assert clips.begun_record(folder)["frames"] == 2
    # A rendering interrupted between the last two steps has a finished clip.
    clips.finish_record(record, folder)
    (folder / "clip.unfinished.json").write_text("{")
    assert clips.is_clip(folder)
    assert clips.begun_record(folder)["frames"] == 1
    (folder / "clip.json").unlink()
    with pytest.raises(ClipError, match=r"clip\.unfinished\.json: not readable"):
        clips.begun_record(folder)


def test_a_record_that_is_refused_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    clips.write_clip(make_clip(rng, 1), tmp_path / "c")
    before = {file.name: file.read_bytes() for file in (tmp_path / "c").iterdir()}
    record = clips.read_record(tmp_path / "c")
    for begin_or_finish in (clips.begin_record, clips.finish_record):
        with pytest.raises(ClipError, match="frames: expected"):
            begin_or_finish({**record, "frames": 0}, tmp_path / "c")
        with pytest.raises(ValueError, match="cannot be written as JSON"):
            begin_or_finish({**record, "seed": float("inf")}, tmp_path / "c")
        assert {file.name: file.read_bytes() for file in (tmp_path / "c").iterdir()} == before


def test_an_interrupted_clip_is_not_a_clip(tmp_path: Path, rng: np.random.Generator, monkeypatch) -> None:
    clips.write_clip(make_clip(rng, 2), tmp_path / "c")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxdn.data.clip.folder.write_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        clips.write_clip(make_clip(rng, 3), tmp_path / "c")
    assert not clips.is_clip(tmp_path / "c")
    assert clips.begun_record(tmp_path / "c")["frames"] == 3


def write_plain(path: Path, names: list[str], rng: np.random.Generator, size: tuple[int, int] = (4, 6)) -> None:
    clips.write_exr(path, {name: rng.random(size, np.float32) for name in names})


def rgb(layer: str, letters: str = "RGB") -> list[str]:
    return [f"{layer}.{letter}" if layer else letter for letter in letters]


BLENDER = [
    *rgb("ViewLayer.Combined", "RGBA"),
    *rgb("Composite.Combined", "RGBA"),
    *rgb("ViewLayer.Denoising Normal", "XYZ"),
    *rgb("ViewLayer.Denoising Albedo"),
    "ViewLayer.Depth.Z",
    *rgb("ViewLayer.Vector", "XYZW"),
]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (
            BLENDER,
            {
                "radiance": "ViewLayer.Combined.R",
                "albedo": "ViewLayer.Denoising Albedo.R",
                "normal": "ViewLayer.Denoising Normal.X",
                "depth": "ViewLayer.Depth.Z",
                "motion": "ViewLayer.Vector.X",
            },
        ),
        (["R", "G", "B", "Z", *rgb("N", "XYZ")], {"radiance": "R", "depth": "Z", "normal": "N.X"}),
        ([*rgb(""), *rgb("Albedo"), *rgb("Ns", "XYZ")], {"radiance": "R", "albedo": "Albedo.R", "normal": "Ns.X"}),
        ([*rgb("Ci", "rgb"), *rgb("backward", "xy")], {"radiance": "Ci.r", "motion": "backward.x"}),
        (["Beauty.red", "Beauty.green", "Beauty.blue", "P.X", "P.Y", "P.Z"], {"radiance": "Beauty.red"}),
        ([*rgb("Noisy Image"), *rgb("Combined")], {"radiance": "Noisy Image.R"}),
    ],
)
def test_channels_are_found_by_their_names(names: list[str], expected: dict[str, str]) -> None:
    assert {buffer: found[0] for buffer, found in clips.detect_channels(names).items()} == expected


def test_ambiguous_or_missing_channels_are_refused() -> None:
    twice = [*rgb("Left.Combined"), *rgb("Right.Combined")]
    with pytest.raises(ClipError, match=r"'Left\.Combined' and 'Right\.Combined' fit equally well"):
        clips.detect_channels(twice)
    with pytest.raises(ClipError, match=r"channels=\{'radiance': LAYER\} \(jaxdn denoise --channels radiance=LAYER\)"):
        clips.detect_channels(twice)
    assert clips.detect_channels(twice, channels={"radiance": "Right.Combined"})["radiance"][0] == "Right.Combined.R"
    with pytest.raises(ClipError, match=r"no radiance among the channels.*--channels radiance=LAYER"):
        clips.detect_channels(["specular.R", "specular.G", "specular.B"])
    with pytest.raises(ClipError, match="no radiance in layer 'Left'"):
        clips.detect_channels(twice, channels={"radiance": "Left"})
    with pytest.raises(ClipError, match="channels: expected buffers among"):
        clips.detect_channels(twice, channels={"colour": "Left.Combined"})


def test_foreign_motion_needs_a_convention(tmp_path: Path, rng: np.random.Generator) -> None:
    write_plain(tmp_path / "shot_0008.exr", [*rgb(""), "motion.X", "motion.Y"], rng)
    write_plain(tmp_path / "shot_0009.exr", [*rgb(""), "motion.X", "motion.Y"], rng)
    with pytest.raises(ClipError, match=r"state --motion-convention NAME.*(?s:.*)  cycles +pixels"):
        clips.read_clip(tmp_path)
    with pytest.raises(ClipError, match="got 'sideways'"):
        clips.read_clip(tmp_path, motion_convention="sideways")
    ours = clips.read_clip(tmp_path, motion_convention="previous-current")
    theirs = clips.read_clip(tmp_path, motion_convention="current-previous")
    np.testing.assert_array_equal(theirs.frames.motion, -ours.frames.motion)
    assert ours.frames.radiance.shape == (2, 4, 6, 3)
    assert clips.read_clip(tmp_path, motion_convention="none").frames.motion is None
    assert clips.read_clip(tmp_path / "shot_0009.exr", motion_convention="uv").frames.motion.shape == (1, 4, 6, 2)
    assert clips.read_clip(str(tmp_path / "shot_*.exr"), motion_convention="uv").frames.motion.shape[0] == 2


def test_every_convention_means_the_same_movement() -> None:
    """History 3 px to the right and 2 px further down, in a picture of 40 x 20 pixels."""
    said = {
        "previous-current": (3, 2),
        "current-previous": (-3, -2),
        "cycles": (3, -2),
        "forward-up": (-3, 2),
        "uv": (3 / 40, 2 / 20),
        "ndc": (3 / 20, -2 / 10),
        "rows-columns": (2, 3),
    }
    assert said.keys() == clips.MOTION_CONVENTIONS.keys()
    for convention, vector in said.items():
        motion = np.broadcast_to(np.float32(vector), (20, 40, 2))
        np.testing.assert_allclose(convert_motion(motion, convention)[4, 7], (3, 2), rtol=1e-6, err_msg=convention)


@pytest.mark.parametrize("index", ["IndexOB", "Object Index"])  # before and since Blender 5.0
def test_blender_sequences_need_no_options(tmp_path: Path, rng: np.random.Generator, index: str) -> None:
    names = [*BLENDER, f"ViewLayer.{index}.X"]
    write_plain(tmp_path / "a1.exr", names, rng)
    channels = clips.read_exr(tmp_path / "a1.exr")
    channels["ViewLayer.Depth.Z"][:] = 1e10
    channels[f"ViewLayer.{index}.X"][:] = [0, 1, 2, 3, 4, 5]
    clips.write_exr(tmp_path / "a1.exr", channels)
    clip = clips.read_clip(tmp_path)
    np.testing.assert_array_equal(clip.frames.motion[0, ..., 1], -channels["ViewLayer.Vector.Y"])
    np.testing.assert_array_equal(clip.frames.ids[0, 0, :, 0], [-1, 0, 1, 2, 3, 4])
    assert np.all(clip.frames.depth == np.float32(FAR))
    channels[f"ViewLayer.{index}.X"][:] = 0
    clips.write_exr(tmp_path / "a1.exr", channels)
    assert clips.read_clip(tmp_path).frames.ids is None


@pytest.mark.parametrize("shown", [0, 1])
def test_ids_are_kept_if_any_frame_has_some(tmp_path: Path, rng: np.random.Generator, shown: int) -> None:
    for index in range(2):
        ids = np.full((4, 6), index == shown, np.float32)
        light = {name: rng.random((4, 6), np.float32) for name in "RGB"}
        clips.write_exr(tmp_path / f"a{index}.exr", {**light, "ids.Y": ids})
    found = clips.read_clip(tmp_path).frames.ids
    np.testing.assert_array_equal(found[shown], 0)
    assert not np.any(found[1 - shown] == 0)


def test_foreign_frames_are_read_one_at_a_time(tmp_path: Path, rng: np.random.Generator, monkeypatch) -> None:
    for index in range(5):
        write_plain(tmp_path / f"a{index}.exr", [*rgb(""), *rgb("Albedo"), *rgb("motion", "XY")], rng)
    read: list[Path] = []
    decode = ExrFile.decode

    def counted(file: ExrFile) -> Any:
        if file.path not in read:
            read.append(file.path)
        return decode(file)

    monkeypatch.setattr(ExrFile, "decode", counted)
    files, frames = clips.plain_frames(tmp_path, motion_convention="uv", channels={"albedo": "Albedo"})
    assert [file.name for file in files] == [f"a{index}.exr" for index in range(5)]
    assert not read
    alive: list[weakref.ref] = []
    for count, frame in enumerate(frames, start=1):
        assert read == files[:count]
        alive.append(weakref.ref(frame.radiance))
        del frame
        # Only the latest frame is in memory; of the first one, its size and the names of its buffers.
        assert sum(reference() is not None for reference in alive) <= 1
    assert len(read) == 5
    assert len(read_clip_properties(tmp_path).moments) == 5  # whether anything moves does not depend on the convention


def test_foreign_sequences_that_are_not_one_clip_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    write_plain(tmp_path / "a_01.exr", rgb(""), rng)
    write_plain(tmp_path / "a_03.exr", rgb(""), rng)
    with pytest.raises(ClipError, match="missing between 1 and 3: 2"):
        clips.read_clip(tmp_path)
    write_plain(tmp_path / "a_02.exr", rgb(""), rng, (5, 6))
    with pytest.raises(ClipError, match=r"a_02\.exr: expected 6 x 4 pixels"):
        clips.read_clip(tmp_path)
    write_plain(tmp_path / "a_02.exr", [*rgb(""), *rgb("albedo")], rng)
    with pytest.raises(ClipError, match=r"a_02\.exr: .*albedo differs"):
        clips.read_clip(tmp_path)
    write_plain(tmp_path / "b_02.exr", rgb(""), rng)
    with pytest.raises(ClipError, match="several: a_, b_"):
        clips.read_clip(tmp_path)
    with pytest.raises(ClipError, match="expected spp 1, got 2"):
        clips.read_clip(tmp_path, spp=2)
    with pytest.raises(ClipError, match=r"expected independent noisy layers .* got none"):
        clips.read_clip(tmp_path / "a_01.exr", layers=True)
    write_plain(tmp_path / "beauty.exr", rgb(""), rng)
    with pytest.raises(ClipError, match="ends in a frame number"):
        clips.read_clip(tmp_path)


def test_images_are_plain_rgb(tmp_path: Path, rng: np.random.Generator) -> None:
    image = rng.random((4, 5, 3), np.float32)
    clips.write_image(tmp_path / "a.exr", image)
    assert sorted(clips.read_exr(tmp_path / "a.exr")) == ["B", "G", "R"]
    np.testing.assert_array_equal(clips.read_clip(tmp_path / "a.exr").frames.radiance[0], image)
    with pytest.raises(ValueError, match="expected an image"):
        clips.write_image(tmp_path / "a.exr", image[..., 0])
