"""Leaving out an absent effect gives the same buffers and denoised images as simulating it, at a lower cost."""

import contextlib
import functools
import io

import jax
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import jaxdn
from experiments.speed.small_rooms import ANIMATIONS, BEHIND, CASES, MATERIALS, SEEN, room
from jaxdn import effects
from jaxdn.clips import read_clip, read_exr, read_frame
from jaxdn.clips.folder import frame_path, read_record
from jaxdn.frame import Frame, only, present, written_out
from jaxdn.methods.table import methods
from jaxdn.render.clip import render_clip
from jaxdn.render.scene_file import SceneFile

pytestmark = pytest.mark.usefixtures("plain_programs")

WIDTH, HEIGHT, FRAMES = 24, 16, 4
LAYERS = [1, 2, 4]
"""Some methods request samples, four by default."""


def rendered(case, folder):
    """The same clip with every effect, and with only those of the scene."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = SceneFile(case.write(folder))
    found = effects.inspect(scene, width=WIDTH, height=HEIGHT)
    options = {"width": WIDTH, "height": HEIGHT, "frames": FRAMES, "reference_spp": 2, "layers": LAYERS}
    everything = render_clip(scene, folder / "all", **options)
    return everything, render_clip(scene, folder / "auto", plan=effects.plan(found), **options)


@functools.cache
def compiled(name):
    """A denoiser as a function of clips, compiled once for every distinct set of buffers among those that it reads."""
    denoiser = getattr(jaxdn.denoisers, name)(**methods()[name].variant_named(None))
    params = denoiser.init(jax.random.key(0), Frame(np.zeros((HEIGHT, WIDTH, 3), np.float32)))
    program = jax.jit(lambda clip: jaxdn.denoise(denoiser, params, clip))

    def run(clip):
        layers = clip.layers if denoiser.samples is not None else None
        return program(clip._replace(frames=only(clip.frames, denoiser.reads), layers=layers, reference=None))

    return run


def assert_the_same(everything, auto, names=jaxdn.denoisers.NAMES):
    """Present buffers are equal, absent ones were neutral, and so the images are equal."""
    whole, lean = (read_clip(folder, layers=True) for folder in (everything, auto))
    rendered_without_a_plan = present(whole.frames)
    assert set(present(lean.frames)) <= set(rendered_without_a_plan)
    spelled = written_out(lean.frames, rendered_without_a_plan)
    for name in ("radiance", *rendered_without_a_plan):
        if name == "direct" and getattr(lean.frames, name) is not None:
            continue  # its few samples are shared by frames that show the same
        np.testing.assert_array_equal(getattr(spelled, name), getattr(whole.frames, name), err_msg=name)
    for name in names:
        run = compiled(name)
        first, second = (np.asarray(run(each)) for each in (whole, lean))
        np.testing.assert_allclose(first, second, rtol=1e-5, atol=1e-6, err_msg=name)


def test_what_is_left_out_was_neutral(tmp_path):
    """For a filter, a network and the running mean: each denoiser is compiled twice, and all take a minute."""
    assert_the_same(*rendered(CASES["static grey box"], tmp_path), ["svgf", "steady", "taa"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CASES if name != "fog"])
def test_what_is_left_out_was_neutral_everywhere(name, tmp_path):
    assert_the_same(*rendered(CASES[name], tmp_path))


@pytest.mark.slow
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(MATERIALS)), st.sampled_from(sorted(ANIMATIONS)), st.sampled_from([BEHIND, SEEN]))
def test_what_is_left_out_was_neutral_in_random_rooms(tmp_path_factory, material, animation, lamp):
    case = room(material, animation, lamp=lamp)
    assert_the_same(*rendered(case, tmp_path_factory.mktemp("room")))


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
    render_clip(scene, auto, width=WIDTH, height=HEIGHT, frames=FRAMES, reference_spp=2, layers=LAYERS, plan=plan)
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
    from jaxdn.cli import main

    everything, auto = rendered(CASES["moving: ball, later"], tmp_path)
    images = {}
    for clip in (everything, auto):
        out = tmp_path / f"{clip.name}-out"
        with contextlib.redirect_stdout(io.StringIO()) as said:
            main(["denoise", str(clip), "-o", str(out), "--method", "svgf"])
        images[clip.name] = [read_exr(file)["denoised.G"] for file in sorted(out.glob("*.exr"))]
        assert said.getvalue().strip().endswith(", 2 programs compiled)" if clip == auto else ", 1 program compiled)")
    np.testing.assert_allclose(images["auto"], images["all"], rtol=1e-5, atol=1e-6)
