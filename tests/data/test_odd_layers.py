"""Layers in which a frame has nothing, and values that no guide can have: told, and never the end of a shot."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.clips import ClipError
from jaxdn.core.frame import FAR, Frame
from jaxdn.data.exr.file import ExrFile
from jaxdn.data.foreign.channel_mapping import read_channel_mapping
from jaxdn.data.foreign.classify import UNNAMED
from jaxdn.data.foreign.decisions import Decisions
from jaxdn.data.foreign.import_exr import ForeignSequence
from tests.programs import HEIGHT, WIDTH, Channels, layer, truth

BLACK = np.zeros((HEIGHT, WIDTH, 3))


def blender(frame: int, **other: np.ndarray) -> Channels:
    """The passes of a view layer, some of them with other values."""
    now = truth(frame, samples=16)
    vector = np.concatenate([now.motion * [1, -1], -now.forward * [1, -1]], axis=-1)
    passes = {"light": now.light, "albedo": now.albedo, "normal": now.normal, "depth": now.depth, "motion": vector}
    passes |= {"roughness": 0.5 + 0 * now.depth, "ids": now.ids + 1.0} | other
    return (
        layer("V.Combined", passes["light"], "RGB")
        | layer("V.Denoising Albedo", passes["albedo"], "RGB")
        | layer("V.Denoising Normal", passes["normal"], "XYZ")
        | layer("V.Depth", passes["depth"], "Z")
        | layer("V.Vector", passes["motion"], "XYZW")
        | layer("V.Denoising Roughness", passes["roughness"], "X")
        | layer("V.IndexOB", passes["ids"], "X")
    )


def read(folder: Path, *frames: Channels) -> tuple[list[Frame], list[str]]:
    """The frames of files with such channels, and what is told meanwhile."""
    folder.mkdir(exist_ok=True)
    for index, channels in enumerate(frames, start=1):
        clips.write_exr(folder / f"s.{index:04d}.exr", channels)
    told: list[str] = []
    return list(clips.plain_frames(folder, log=told.append)[1]), told


NOTHING = {
    "motion": (np.zeros((HEIGHT, WIDTH, 4)), "'V.Vector' is 0 everywhere"),
    "normal": (np.broadcast_to([0.0, 0.0, 1.0], BLACK.shape), "'V.Denoising Normal' is (0, 0, 1) everywhere"),
    "depth": (np.zeros((HEIGHT, WIDTH, 1)), "'V.Depth' is 0 everywhere"),
    "albedo": (np.ones_like(BLACK), "'V.Denoising Albedo' is 1 everywhere"),
    "roughness": (np.full((HEIGHT, WIDTH, 1), np.nan), "'V.Denoising Roughness' is 0 everywhere"),
}


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("motion", np.full((HEIGHT, WIDTH, 4), 1e-8), "'V.Vector' is 0 everywhere"),
        ("normal", np.full((HEIGHT, WIDTH, 3), 0.0), "'V.Denoising Normal' is (0, 0, 0) everywhere"),
    ],
)
def test_other_values_that_say_nothing(name: str, values: np.ndarray, why: str, tmp_path: Path) -> None:
    frames, told = read(tmp_path, blender(0, **{name: values}), blender(1, **{name: values}))
    assert [getattr(frame, name) for frame in frames] == [None, None]
    assert told[0].startswith(f"{name} counts as missing: {why}")


@pytest.mark.parametrize("name", NOTHING)
def test_a_layer_without_anything_in_it_counts_as_missing_and_that_is_told(name: str, tmp_path: Path) -> None:
    values, why = NOTHING[name]
    frames, told = read(tmp_path, blender(0, **{name: values}), blender(1, **{name: values}))
    assert [getattr(frame, name) for frame in frames] == [None, None]
    assert [line for line in told if line.startswith(f"{name} counts as missing: {why}")] == told
    assert len(told) == 1
    assert ("motion blur" in told[0]) == (name == "motion")
    assert all(frame.dual_motion is None for frame in frames) == (name == "motion")
    assert name not in [mapped.buffer for mapped in read_channel_mapping(tmp_path)]


@pytest.mark.parametrize("name", NOTHING)
@pytest.mark.parametrize("row", [0, 5, HEIGHT - 1])
def test_a_single_pixel_is_something(name: str, row: int, tmp_path: Path) -> None:
    """Wherever it is: not all rows are looked at first."""
    values = np.array(NOTHING[name][0])
    values[row, 7] = 0.5
    frames, told = read(tmp_path, blender(0, **{name: values}))
    assert getattr(frames[0], name) is not None
    assert told == []


def test_few_rows_tell_that_a_layer_has_something() -> None:
    """A frame of film has a hundred megabytes of layers, and the first one waits for this."""
    rng = np.random.default_rng(0)
    buffers = {"albedo": ("R", "G", "B"), "normal": ("X", "Y", "Z"), "motion": ("U", "V"), "depth": ("D",)}
    pixels = {name: rng.random((512, 512), np.float32) for channels in buffers.values() for name in channels}
    tracemalloc.start()
    try:
        kept, notes = Decisions().drop_empty(pixels, buffers, forward=None)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert kept == buffers
    assert notes == []
    assert most < pixels["D"].nbytes


@pytest.mark.parametrize("name", [*NOTHING, "ids"])
def test_it_is_read_from_the_first_frame_on_that_has_something(name: str, tmp_path: Path) -> None:
    """And stays: a frame of sky in the middle of a shot takes no buffer away."""
    values = NOTHING[name][0] if name in NOTHING else np.zeros((HEIGHT, WIDTH, 1))
    empty = {name: values}
    frames, told = read(tmp_path, blender(0, **empty), blender(1), blender(2, **empty))
    assert [getattr(frame, name) is None for frame in frames] == [True, False, False]
    assert [line for line in told if line.startswith(f"s.0002.exr: from here on {name} is read")] == told[-1:]


@pytest.mark.parametrize("told_by", ["depth", "normal", "nothing"])
def test_a_surface_without_a_number_is_a_surface(told_by: str, tmp_path: Path) -> None:
    """Blender gives every object the index 0, and most users number those alone that they want to select."""
    ids = (truth(0).ids + 1.0) * (truth(0).ids == 1)
    sky = np.s_[:4]
    ids[sky] = 0
    depth, normal = truth(0).depth.copy(), truth(0).normal.copy()
    depth[sky], normal[sky] = 1e10, 0
    channels = blender(0, ids=ids, depth=depth, normal=normal)
    lost = {"depth": (), "normal": ("Depth",), "nothing": ("Depth", "Normal")}[told_by]
    (frame,), _ = read(tmp_path, {name: one for name, one in channels.items() if not any(n in name for n in lost)})
    found, numbered = frame.ids[..., 0], ids[..., 0] == 2
    assert 0.05 < numbered.mean() < 0.6
    assert np.all(found[numbered] == 1)
    floor = ~numbered
    if told_by != "nothing":
        assert np.all(found[sky] == -1)
        floor[sky] = False
    assert len(set(found[floor])) == 1
    assert found[floor][0] not in (-1, 0, 1)


def arnold(frame: int, light: float = 1.0, **other: np.ndarray) -> Channels:
    """A beauty with the lighting pass ``diffuse`` and no albedo."""
    now = truth(frame, samples=16)
    diffuse = other.get("diffuse", light * now.diffuse)
    return layer("", light * now.light, "RGB") | layer("diffuse", diffuse, "RGB") | layer("N", now.normal, "XYZ")


@pytest.mark.parametrize("lit", [0.0, 1e-3])
def test_a_fade_from_black_makes_no_light_an_albedo(lit: float, tmp_path: Path) -> None:
    frames, told = read(tmp_path, arnold(0, 0.0), arnold(1, lit), arnold(2))
    assert all(frame.albedo is None for frame in frames)
    assert "'diffuse' is a lighting pass and no albedo" in told[-1]
    assert told[-1].startswith("s.0002.exr: " if lit else "s.0003.exr: ")


def test_an_albedo_called_diffuse_is_found_after_a_black_frame(tmp_path: Path) -> None:
    albedo = truth(0).albedo
    frames, told = read(tmp_path, arnold(0, 0.0, diffuse=albedo), arnold(1, diffuse=albedo))
    assert [frame.albedo is None for frame in frames] == [True, False]
    assert told == [
        "'diffuse' is not used yet: a frame without light does not tell an albedo from light",
        "s.0002.exr: from here on 'diffuse' is the albedo",
    ]


def test_an_overexposed_first_frame_decides_nothing_for_good(tmp_path: Path) -> None:
    """Where the beauty is brighter than every albedo, an albedo looks like a part of it."""
    albedo = truth(0).albedo
    frames, told = read(tmp_path, *(arnold(i, 9.0 if i == 0 else 1.0, diffuse=albedo) for i in range(2)))
    assert [frame.albedo is None for frame in frames] == [True, False]
    assert "brighter than the beauty" in told[-1]


def test_the_directions_of_time_share_what_was_decided(tmp_path: Path) -> None:
    read(tmp_path, arnold(0, 0.0), arnold(1))
    backwards = clips.plain_frames(tmp_path, backwards=True)[1]
    assert all(frame.albedo is None for frame in backwards)


def test_odd_pixels_are_clamped_counted_and_told(tmp_path: Path) -> None:
    rough, lamp = np.full((HEIGHT, WIDTH, 1), 0.5), truth(1).albedo.copy()
    rough[5, 5], lamp[:2, :3] = 1.3, 1190.0
    frames, told = read(tmp_path, blender(0), blender(1, roughness=rough, albedo=lamp), blender(2, roughness=3 * rough))
    assert frames[1].roughness[5, 5] == 1
    assert frames[1].albedo[0, 0, 0] == 1
    np.testing.assert_allclose(frames[1].albedo[2:], truth(1).albedo[2:], rtol=1e-6)
    assert sorted(told) == [
        "s.0002.exr: albedo: 6 pixels of 'V.Denoising Albedo' above 1, up to 1190: the light of a lamp, taken as 1",
        "s.0002.exr: roughness: 1 pixel of 'V.Denoising Roughness' beyond [0, 1], such as 1.3: clamped",
    ]
    assert np.all(frames[2].roughness == 1)  # however many: an earlier frame has shown what the layer is
    clips.write_exr(tmp_path / "s.0001.exr", blender(0, roughness=45 * rough))
    with pytest.raises(ClipError, match=r"s\.0001\.exr: roughness: expected values in \[0, 1\] .* got 22\.5 to 58\.5"):
        next(clips.plain_frames(tmp_path)[1])


def test_clamped_pixels_are_counted_once_in_both_directions(tmp_path: Path) -> None:
    rough = np.full((HEIGHT, WIDTH, 1), 0.5)
    rough[5, 5:7] = -0.3
    read(tmp_path, blender(0, roughness=rough), blender(1), blender(2, roughness=rough))
    sequence = ForeignSequence([ExrFile(path) for path in sorted(tmp_path.iterdir())], UNNAMED)
    told: list[str] = []
    for backwards in (True, False):
        assert len(list(sequence.frames(backwards=backwards, log=told.append))) == 3
    assert told == ["roughness: 2 pixels of 'V.Denoising Roughness' beyond [0, 1], such as -0.3: clamped"]
    assert list(sequence.repairs.totals()) == ["roughness: 4 pixels of 2 frames were clamped to [0, 1]"]


def test_depths_that_are_no_numbers_are_far_counted_and_told(tmp_path: Path) -> None:
    depth = truth(0).depth.copy()
    depth[3, 4:6], depth[0, 0] = np.nan, np.inf  # infinity is how renderers write that nothing is there
    frames, told = read(tmp_path, blender(0, depth=depth), blender(1), blender(2, depth=depth))
    assert np.all(frames[0].depth[3, 4:6] == FAR)
    assert frames[0].depth[0, 0] == FAR
    assert told == ["depth: 2 pixels of 'V.Depth' NaN: taken as far away"]
    sequence = ForeignSequence([ExrFile(path) for path in sorted(tmp_path.iterdir())], UNNAMED)
    assert len(list(sequence.frames())) == 3
    assert list(sequence.repairs.totals()) == ["depth: 4 pixels of 2 frames were NaN, taken as far away"]


def test_a_lamp_in_an_albedo_that_is_named_outright_ends_nothing(tmp_path: Path) -> None:
    lamp = truth(0).albedo.copy()
    lamp[:2, :3] = 1190.0
    clips.write_exr(tmp_path / "a.exr", blender(0, albedo=lamp))
    told: list[str] = []
    (frame,) = clips.plain_frames(tmp_path / "a.exr", channels={"albedo": "V.Denoising Albedo"}, log=told.append)[1]
    assert frame.albedo.max() == 1
    assert [line.split(":")[0] for line in told] == ["albedo"]
