"""Leaving out an absent effect gives the same buffers and denoised images as simulating it, at a lower cost."""

import contextlib
import io
import re

import jax
import numpy as np
import pytest

import jaxdn
from experiments.speed.small_rooms import ANIMATIONS, BEHIND, CASES, MATERIALS, SEEN, room
from jaxdn import effects
from jaxdn.clips import read_clip, read_exr, read_frame
from jaxdn.core.frame import Frame, only, present, written_out
from jaxdn.data.clip.folder import frame_path, read_record
from jaxdn.methods.registry import methods
from jaxdn.render.clip import render_clip
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from tests.sharing import make_once

WIDTH, HEIGHT, FRAMES = 24, 16, 4
LAYERS = [1, 2, 4]
"""Some methods request samples, four by default."""


def random_rooms(count):
    """Rooms of any material, animation and lamp; the same in every run."""
    rng = np.random.default_rng(20210629)
    drawn = [[str(rng.choice(sorted(names))) for names in (MATERIALS, ANIMATIONS)] for _ in range(count)]
    return {", ".join(names): room(*names, lamp=(BEHIND, SEEN)[rng.integers(2)]) for names in drawn}


ROOMS = {name: case for name, case in CASES.items() if name != "fog"} | random_rooms(8)


def rendered(case, folder):
    """The same clip with every effect, and with only those of the scene."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = SceneFile(case.write(folder))
    found = effects.inspect(scene, width=WIDTH, height=HEIGHT)
    options = {"width": WIDTH, "height": HEIGHT, "reference_spp": 2, "layers": LAYERS}
    everything = render_clip(scene, folder / "all", RenderSettings(**options), frames=FRAMES)
    return everything, render_clip(
        scene, folder / "auto", RenderSettings(plan=effects.plan(found), **options), frames=FRAMES
    )


@pytest.fixture(scope="session")
def clips(tmp_path_factory):
    """The two clips of a room by its name, rendered once for all tests, and for all processes of pytest-xdist."""

    def both(name):
        folder = make_once(tmp_path_factory, re.sub(r"\W+", "-", name), lambda place: rendered(ROOMS[name], place))
        return folder / "all", folder / "auto"

    return both


def both_read(clips):
    return tuple(read_clip(folder, layers=True) for folder in clips)


def compiled(name):
    """A denoiser as a function of clips, compiled for every distinct set of buffers among those that it reads."""
    denoiser = getattr(jaxdn.denoisers, name)(**methods()[name].variant_named(None))
    params = denoiser.init(jax.random.key(0), Frame(np.zeros((HEIGHT, WIDTH, 3), np.float32)))
    program = jax.jit(lambda clip: jaxdn.denoise(denoiser, params, clip))

    def run(clip):
        layers = clip.layers if denoiser.samples is not None else None
        frames = only(clip.frames, denoiser.reads)
        return np.asarray(program(clip._replace(frames=frames, layers=layers, reference=None)))

    return run


def assert_the_same_buffers(whole, lean):
    """Present buffers are equal, absent ones were neutral."""
    rendered_without_a_plan = present(whole.frames)
    assert set(present(lean.frames)) <= set(rendered_without_a_plan)
    spelled = written_out(lean.frames, rendered_without_a_plan)
    for name in ("radiance", *rendered_without_a_plan):
        if name == "direct" and getattr(lean.frames, name) is not None:
            continue  # its few samples are shared by frames that show the same
        np.testing.assert_array_equal(getattr(spelled, name), getattr(whole.frames, name), err_msg=name)


def assert_the_same_images(run, whole, lean, message):
    np.testing.assert_allclose(run(whole), run(lean), rtol=1e-5, atol=1e-6, err_msg=message)


@pytest.mark.slow
def test_what_is_left_out_was_neutral(tmp_path):
    """For a filter, a network and the running mean: each denoiser is compiled twice, and all take a minute."""
    both = both_read(rendered(CASES["static grey box"], tmp_path))
    assert_the_same_buffers(*both)
    for name in ("svgf", "steady", "taa"):
        assert_the_same_images(compiled(name), *both, name)


@pytest.mark.slow
@pytest.mark.parametrize("case", ROOMS)
def test_what_is_left_out_was_neutral_everywhere(case, clips):
    assert_the_same_buffers(*both_read(clips(case)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ntasd", "reblur", "trmv"])
def test_what_is_left_out_changes_no_image(name, clips):
    """In every room: a denoiser has few sets of buffers among them, and compiling it takes most of the time.

    By the two that read the most buffers, dual motion among them, and one that requests samples. That a buffer left out
    is the neutral one is tested above in every room, and that None is the neutral value by the tests of each method.
    """
    run = compiled(name)
    for case in ROOMS:
        assert_the_same_images(run, *both_read(clips(case)), f"{name}, {case}")


def test_a_frame_that_shows_the_same_stores_only_the_noise(tmp_path):
    everything, auto = rendered(CASES["moving: ball, later"], tmp_path)
    stored = [read_frame(frame_path(auto, index)) for index in range(FRAMES)]
    assert [frame.reference is not None for frame in stored] == [True, False, True, True]
    assert [frame.frame.motion is not None for frame in stored] == [False, False, True, True]
    assert stored[0].frame.albedo is not None
    assert stored[1].frame.albedo is None
    assert read_record(auto)["plan"]["held"] == [0, 0, 2, 3]
    sizes = [sum(file.stat().st_size for file in clip.glob("*.exr")) for clip in (everything, auto)]
    assert sizes[1] < sizes[0]


def test_an_interrupted_plan_resumes_bit_for_bit(tmp_path):
    _, auto = rendered(CASES["moving: ball, later"], tmp_path)
    before = [frame_path(auto, index).read_bytes() for index in range(FRAMES)]
    for index in (1, 2):
        frame_path(auto, index).unlink()
    scene = SceneFile(tmp_path / "scene.xml")
    plan = effects.plan_from_record(read_record(auto)["plan"])
    render_clip(
        scene,
        auto,
        RenderSettings(width=WIDTH, height=HEIGHT, reference_spp=2, layers=LAYERS, plan=plan),
        frames=FRAMES,
    )
    assert [frame_path(auto, index).read_bytes() for index in range(FRAMES)] == before


def test_a_frame_that_lacks_what_its_plan_says_is_refused(tmp_path):
    _, auto = rendered(CASES["moving: ball, later"], tmp_path)
    frame_path(auto, 0).unlink()
    frame_path(auto, 1).rename(frame_path(auto, 0))
    frame_path(auto, 1).write_bytes(frame_path(auto, 0).read_bytes())
    with pytest.raises(jaxdn.clips.ClipError, match=r"frame_0000.exr: expected the buffers .*albedo"):
        read_clip(auto)


@pytest.mark.slow
def test_training_mixes_clips_of_different_effects(tmp_path):
    from jaxdn.clips import training_batches

    clips = []
    for name in ("static grey box", "moving: ball"):
        _, auto = rendered(CASES[name], tmp_path / name.replace(" ", "-").replace(":", ""))
        clips.append(auto)
    batch = next(training_batches(clips, batch=2, crop=16, frames=FRAMES, seed=0, augment=False))
    assert batch.frames.motion.shape == (2, FRAMES, 16, 16, 2)
    moves = [bool(np.any(motion != 0)) for motion in batch.frames.motion]
    assert sorted(moves) == [False, True]


@pytest.mark.slow
def test_a_finished_clip_is_inspected_without_its_scene(tmp_path):
    everything, auto = rendered(room("rough metal", "ball"), tmp_path)
    found = effects.inspect(auto)
    seen = {"object-motion", "disocclusion", "indirect", "glossy", "specular", "moving-shadow", "moving-reflection"}
    assert set(found) == seen
    blind = effects.inspect(everything)
    assert set(found) <= set(blind)
    assert {"transmission", "media"} <= set(blind.uncertain)
    assert "camera-motion" not in blind  # the record has the cameras
    assert "emission" not in blind


@pytest.mark.slow
def test_a_clip_whose_effects_change_is_denoised_by_two_programs(tmp_path):
    from jaxdn.commands.main import main

    everything, auto = rendered(CASES["moving: ball, later"], tmp_path)
    images = {}
    for clip in (everything, auto):
        out = tmp_path / f"{clip.name}-out"
        with contextlib.redirect_stdout(io.StringIO()) as said:
            main(["denoise", str(clip), "-o", str(out), "--method", "svgf"])
        images[clip.name] = [read_exr(file)["denoised.G"] for file in sorted(out.glob("*.exr"))]
        assert said.getvalue().strip().endswith(", 2 programs compiled)" if clip == auto else ", 1 program compiled)")
    np.testing.assert_allclose(images["auto"], images["all"], rtol=1e-5, atol=1e-6)
