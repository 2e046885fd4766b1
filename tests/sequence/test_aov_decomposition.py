"""Additive layers are denoised with the beauty and still add up to it, to rounding."""

from pathlib import Path

import numpy as np
import pytest

from jaxdn import clips
from jaxdn.core.frame import Frame
from jaxdn.data.foreign.classify import ChannelNaming
from jaxdn.data.foreign.layers import stack_channels
from jaxdn.data.foreign.lighting import coloured_layers, explain_light, is_additive, is_clearly_brighter
from jaxdn.sequence.aov_decomposition import add_layers, decompose, init_decomposition
from jaxdn.sequence.run import denoise_files
from jaxdn.sequence.settings import Settings
from jaxdn.zoo.ready import find_model
from tests import programs
from tests.data.test_kept import assert_same_but, box_blur
from tests.programs import PROGRAMS, truth, write_shot


def frame_of(index: int, samples: int = 4, **changes: object) -> Frame:
    scene = truth(index, samples)
    buffers = {name: np.asarray(getattr(scene, name), np.float32) for name in ("normal", "depth", "motion")}
    frame = Frame(np.asarray(scene.light, np.float32), **buffers, ids=scene.ids.astype(np.int32))
    return frame._replace(**changes)


@pytest.mark.slow
@pytest.mark.parametrize("guides", [True, False])
def test_every_set_of_parts_adds_up(guides: bool) -> None:
    """Diffuse and specular light, and two light groups, each pair a decomposition of its own."""
    none = {} if guides else dict.fromkeys(("normal", "depth", "motion", "ids"))
    state = None
    for index in range(3):
        scene, clean = truth(index), truth(index, 10_000)
        frame = frame_of(index, **none)
        key = scene.light * np.random.default_rng(index).uniform(0, 1, scene.light.shape)
        parts = np.stack([scene.diffuse, scene.light - scene.diffuse, key, scene.light - key]).astype(np.float32)
        beauty = np.asarray(clean.light, np.float32)
        state = init_decomposition(frame, len(parts)) if state is None else state
        state, images = decompose(state, frame, beauty, parts)
        images = np.asarray(images)
        assert images.min() >= 0
        for first, second in ((0, 1), (2, 3)):
            np.testing.assert_allclose(images[first] + images[second], beauty, rtol=1e-5, atol=1e-6)
    if guides:  # and they are better than they came, though the texture of the one shows in the other
        for image, noisy, wanted in zip(images, parts, (clean.diffuse, clean.light - clean.diffuse), strict=False):
            assert np.mean((image - wanted) ** 2) < 0.3 * np.mean((noisy - wanted) ** 2)


def test_a_part_that_is_the_beauty_becomes_the_beauty_and_none_stays_none() -> None:
    frame = frame_of(0)
    beauty = np.asarray(truth(0, 10_000).light, np.float32)
    parts = np.stack([frame.radiance, 0 * frame.radiance, frame.radiance, frame.radiance])
    _, (whole, nothing, *_) = decompose(init_decomposition(frame, 4), frame, beauty, parts)
    np.testing.assert_allclose(whole, beauty, rtol=1e-5)
    assert not np.asarray(nothing).any()


def test_invalid_values_and_black_pixels_stay_finite() -> None:
    light = np.zeros((24, 32, 3), np.float32)
    light[5, 5], light[6, 6], light[7, 7], light[8, 8, 0] = np.nan, np.inf, -1.0, 3.0
    frame = frame_of(0, radiance=light)
    beauty = np.full_like(light, 0.1)
    beauty[9] = 0
    _, images = decompose(
        init_decomposition(frame, 4), frame, beauty, np.stack([light, light / 2, light, np.zeros_like(light)])
    )
    assert np.isfinite(np.asarray(images)).all()
    assert np.asarray(images).min() >= 0
    assert not np.asarray(images)[:, 9].any()


ADDITIVE = {
    "Arnold": (("diffuse", "specular"), ()),
    "RenderMan": (("diffuse", "specular"), ("albedo",)),
    "Blender": (("View Layer.DiffDir", "Composite.Combined"), ("View Layer.DiffCol", "View Layer.Noisy Image")),
    "pbrt-v4": ((), ("Variance", "RelativeVariance", "Albedo")),
}


@pytest.mark.parametrize("name", ADDITIVE)
def test_parts_of_the_beauty_are_found_by_their_values(name: str, tmp_path: Path) -> None:
    PROGRAMS[name].write(tmp_path / "a.exr", 0)
    there = clips.read_exr(tmp_path / "a.exr")
    found = clips.detect_channels(list(there))
    layers = coloured_layers(there, PROGRAMS[name].beauty, found)
    radiance = stack_channels(there, found["radiance"])
    parts = {layer for layer, channels in layers.items() if is_additive(there, channels, radiance)}
    assert parts == set(ADDITIVE[name][0])


def test_a_filter_that_rings_hides_no_part() -> None:
    scene = truth(0)
    light, diffuse = (np.array(each, np.float32) for each in (scene.light, scene.diffuse))
    light[3, 4], diffuse[3, 4] = -0.02, -0.01
    for part, wanted in ((diffuse, True), (1e-3 * scene.normal, False)):
        pixels = programs.layer("part", part, "RGB")
        assert is_additive(pixels, tuple(pixels), light) is wanted


def test_what_is_a_part_does_not_depend_on_the_unit_of_light(rng: np.random.Generator) -> None:
    """Light in nits has other figures than light in watts."""
    beauty = rng.uniform(0.01, 1, (16, 16, 3)).astype(np.float32)
    dim = 0.003 * beauty
    dim[::3] *= 400  # brighter than the beauty in a third of the image
    noisy = 0.9 * rng.exponential(0.01, (16, 16, 3)).astype(np.float32)
    for exponent in range(-30, 31):
        light = np.ldexp(beauty, exponent)
        for values, part in ((0.5 * beauty, True), (dim, False), (1.01 * beauty, False)):
            pixels = programs.layer("part", np.ldexp(values, exponent), "RGB")
            assert is_additive(pixels, tuple(pixels), light) is part, exponent
            assert is_clearly_brighter(np.ldexp(values, exponent), light) is (values is dim), exponent
        if exponent <= 0:  # an albedo has a unit: it is at most 1
            assert explain_light(np.ldexp(noisy, exponent), 0 * light) is not None, exponent


@pytest.mark.slow
def test_the_beauty_once_more_is_denoised_but_is_no_part(tmp_path: Path) -> None:
    source, told = write_shot("Blender", tmp_path / "in"), list[str]()
    denoise_files([source], tmp_path / "out", box_blur(), Settings(aovs="additive"), log=told.append)
    line = next(line for line in told if "denoised with the beauty" in line)
    assert line.startswith("denoised with the beauty: View Layer.DiffDir; together they have 0.")
    assert line.endswith("of its light; and Composite.Combined (the beauty once more)")
    for file in sorted((tmp_path / "out").iterdir()):
        there = clips.read_exr(file)
        for letter in "RGB":
            copy, beauty = there[f"Composite.Combined.{letter}"], there[f"View Layer.Combined.{letter}"]
            np.testing.assert_allclose(copy, beauty, rtol=2e-3, atol=1e-4)


@pytest.mark.slow
def test_in_files_they_add_up_and_the_rest_stays(tmp_path: Path) -> None:
    program, told = PROGRAMS["Arnold"], list[str]()
    source, out = write_shot("Arnold", tmp_path / "in"), tmp_path / "out"
    settings = Settings(naming=ChannelNaming(program.motion_convention), aovs="additive")
    denoise_files([source], out, box_blur(), settings, log=told.append)
    assert "denoised with the beauty: diffuse, specular; together they have 1.00 of its light" in told
    changed = (*program.beauty, *(f"{layer}.{letter}" for layer in ("diffuse", "specular") for letter in "RGB"))
    for file in sorted(path.name for path in source.iterdir()):
        assert_same_but(source / file, out / file, changed)
        after = {channel: pixels.astype(np.float64) for channel, pixels in clips.read_exr(out / file).items()}
        for letter in "RGB":
            total = after[f"diffuse.{letter}"] + after[f"specular.{letter}"]
            np.testing.assert_allclose(total, after[letter], rtol=1e-5, atol=1e-6)


def test_what_has_no_parts_says_so(tmp_path: Path) -> None:
    clips.write_exr(tmp_path / "a.exr", programs.layer("", truth(0).light, "RGB"))
    told: list[str] = []
    settings = Settings(aovs="additive")
    denoise_files([tmp_path / "a.exr"], tmp_path / "out", find_model("noisy"), settings, log=told.append)
    assert told == ["--aovs additive: no layer is a part of the beauty; all stay as they are"]
    with pytest.raises(ValueError, match="leave out --only-beauty"):
        denoise_files([tmp_path / "a.exr"], tmp_path / "out", find_model("noisy"), settings._replace(only_beauty=True))


def lit_later(folder: Path, lit: dict[str, list[bool]]) -> Path:
    """Frames whose beauty is the sum of light groups, each lit in some of them."""
    folder.mkdir()
    for index, now in enumerate(zip(*lit.values(), strict=True)):
        scene = truth(index)
        share = dict(zip(lit, ([scene.diffuse, scene.light - scene.diffuse]), strict=True))
        groups = {name: share[name] * on for name, on in zip(lit, now, strict=True)}
        channels = programs.layer("", sum(groups.values()), "RGB") | programs.layer("Z", scene.depth, "Z")
        for name, light in groups.items():
            channels |= programs.layer(name, light, "RGB")
        clips.write_exr(folder / f"s.{index + 1:04d}.exr", channels)
    return folder


LIT_LATER = {
    "a fade from black": ({"diffuse": [False, True, True, True], "specular": [False, True, True, True]}, {}),
    "a light switched on": ({"key": [True, True, True, True], "fill": [False, False, True, True]}, {}),
    "a part of the shot": ({"key": [True, True, True, True], "fill": [False, False, True, True]}, {"frames": [4]}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", LIT_LATER)
def test_a_light_that_is_switched_on_later_is_a_part_from_then_on(case: str, tmp_path: Path) -> None:
    lit, settings = LIT_LATER[case]
    source, told = lit_later(tmp_path / "in", lit), list[str]()
    denoise_files([source], tmp_path / "out", box_blur(), Settings(aovs="additive", **settings), log=told.append)
    assert any("from here on denoised with the beauty" in line for line in told)
    for file in sorted((tmp_path / "out").iterdir()):
        after = clips.read_exr(file)
        for letter in "RGB":
            total = sum(after[f"{name}.{letter}"].astype(np.float64) for name in lit)
            np.testing.assert_allclose(total, after[letter], rtol=1e-5, atol=1e-6)
        before = clips.read_exr(source / file.name)
        assert before["R"].max() == 0 or np.abs(after["R"] - before["R"]).max() > 0.01  # denoised


@pytest.mark.slow
def test_layers_that_are_added_have_been_black(rng: np.random.Generator) -> None:
    """The same as with the black layer from the first frame on."""
    frames = [frame_of(index) for index in range(2)]
    beauty = np.asarray(frames[0].radiance)
    first, second = beauty * 0.3, beauty * 0.7
    state, _ = decompose(init_decomposition(frames[0], 1), frames[0], beauty, first[None])
    _, added = decompose(add_layers(state, 2), frames[1], beauty, np.stack([first, second]))
    state, _ = decompose(init_decomposition(frames[0], 2), frames[0], beauty, np.stack([first, 0 * first]))
    _, always = decompose(state, frames[1], beauty, np.stack([first, second]))
    np.testing.assert_allclose(added, always, rtol=1e-5, atol=1e-6)
