"""Absent effects leave no operation in the compiled step: tested on the lowered program, not by timing."""

import functools
import re

import jax
import jax.numpy as jnp
import pytest

import jaxdn
from jaxdn import effects
from jaxdn.core.frame import Frame, only

SIZE = (32, 48)
CHANNELS = {"depth": 1, "roughness": 1, "motion": 2, "dual_motion": 2, "visible": 1, "previous_depth": 1, "ids": 1}
CHANNELS["luminance_gradient"] = 2
KINDS = {"visible": bool, "ids": jnp.int32}


def frame_for(*names):
    """A frame with the buffers that a scene of these effects has, as shapes."""
    plan = effects.plan(effects.choose_effects(["indirect", *names], 2))

    def shape(name):
        return jax.ShapeDtypeStruct((*SIZE, CHANNELS.get(name, 3)), KINDS.get(name, jnp.float32))

    return Frame(**{name: shape(name) for name in ("radiance", *plan.frames[0])})


def lowered_step(denoiser, frame):
    used = only(frame, denoiser.reads)
    params = jax.eval_shape(lambda: denoiser.init(jax.random.key(0), used))
    state = jax.eval_shape(denoiser.start, params, used)
    return jax.jit(denoiser.step).lower(params, state, used).as_text()


@functools.cache
def default_step(name, *names):
    """The step of a denoiser with its default options, for a scene of these effects: traced once for all tests."""
    return lowered_step(getattr(jaxdn.denoisers, name)(), frame_for(*names))


def count(operation, text):
    return len(re.findall(rf"\bstablehlo\.{operation}\b", text))


@pytest.fixture(scope="module")
def gathers_of_a_warp():
    image, motion = (jax.ShapeDtypeStruct((*SIZE, channels), jnp.float32) for channels in (3, 2))
    found = count("gather", jax.jit(jaxdn.warp).lower(image, motion).as_text())
    assert found > 0
    return found


@pytest.mark.parametrize("moving", ["camera-motion", "object-motion"])
def test_without_disocclusion_the_step_has_the_gathers_of_one_warp(moving, gathers_of_a_warp):
    text = lowered_step(jaxdn.denoisers.ntd(size="small"), frame_for(moving))
    assert count("gather", text) == gathers_of_a_warp


@pytest.mark.slow
@pytest.mark.parametrize("name", jaxdn.denoisers.NAMES)
def test_without_motion_there_is_no_gather(name):
    discs = {"radius": 0.0, "pre_radius": 0.0} if name == "reblur" else {}  # whose taps are strewn
    denoiser = getattr(jaxdn.denoisers, name)(**discs)
    assert count("gather", lowered_step(denoiser, frame_for("moving-shadow", "glossy"))) == 0


def test_disocclusion_is_one_warp_too(gathers_of_a_warp):
    # The dual vectors take the place of the traditional ones: the renderer has done the rest.
    text = lowered_step(jaxdn.denoisers.ntd(size="small"), frame_for("object-motion", "disocclusion"))
    assert count("gather", text) == gathers_of_a_warp


@pytest.mark.parametrize("name", [name for name in jaxdn.denoisers.NAMES if name != "oidn"])
def test_every_effect_adds_operations_or_nothing(name):
    """Of those that read more than albedo and normal, which every scene has."""
    everything = len(default_step(name, *effects.choose_all_effects(1)).splitlines())
    nothing = len(default_step(name).splitlines())
    assert nothing < everything


@pytest.mark.parametrize("name", jaxdn.denoisers.NAMES)
def test_an_effect_that_is_not_read_changes_nothing(name):
    """The program is made of the buffers that are read: without another one it is the same."""
    reads = getattr(jaxdn.denoisers, name)().reads
    unread = [effect.name for effect in effects.EFFECTS if not effect.buffers & reads]
    assert unread
    assert only(frame_for(*unread), reads) == only(frame_for(), reads)


@pytest.mark.slow
def test_one_program_per_distinct_set_and_none_per_frame():
    denoiser = jaxdn.denoisers.svgf(levels=1, feedback_level=0)
    traced = 0

    @jax.jit
    def step(state, frame):
        nonlocal traced
        traced += 1
        return denoiser.step({}, state, frame)

    still = Frame(jnp.ones((*SIZE, 3)), depth=jnp.ones((*SIZE, 1)))
    moving = still._replace(motion=jnp.ones((*SIZE, 2)))
    state = denoiser.start({}, still)
    for frame in (still, still, moving, moving, still, moving):
        state, image = step(state, frame)
    assert traced == 2
    assert bool(jnp.all(jnp.isfinite(image)))
