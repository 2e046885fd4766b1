"""Which vector leads to the history: of the surface, of a passing shadow, of a reflection."""

import jax
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.methods.history_vectors import READS, choose_vectors
from jaxdn.methods.ntd import ntd

SHAPE = (4, 6)


def vectors(x: float) -> np.ndarray:
    return np.broadcast_to(np.float32([x, 0.5]), (*SHAPE, 2)).copy()


def frame(**more) -> Frame:
    """A shadow passes over the left half; the upper rows are a mirror, whose reflection moves."""
    motion, dual, shadow, glossy = (vectors(x) for x in (1.0, 2.0, 3.0, 4.0))
    shadow[:, 3:] = motion[:, 3:]
    dual[2:] = motion[2:]
    shape = (*SHAPE, 3)
    reflectance = np.full(shape, 0.6, np.float32)
    specular = np.full(shape, 0.1, np.float32)
    specular[:2] = 0.5
    given = {"motion": motion, "dual_motion": dual, "shadow_motion": shadow, "glossy_motion": glossy}
    given |= {"reflectance": reflectance, "specular_reflectance": specular}
    return Frame(np.ones(shape, np.float32), **given | more)


def test_reflections_come_before_shadows_and_these_before_the_surface():
    found = np.asarray(choose_vectors(frame(), "effects"))[..., 0]
    np.testing.assert_array_equal(found[:2], 4.0)
    np.testing.assert_array_equal(found[2:, :3], 3.0)
    np.testing.assert_array_equal(found[2:, 3:], 1.0)
    np.testing.assert_array_equal(choose_vectors(frame(), "dual"), frame().dual_motion)
    np.testing.assert_array_equal(choose_vectors(frame(), "traditional"), frame().motion)


def test_a_vector_that_is_not_known_is_that_of_the_surface():
    broken = vectors(4.0)
    broken[0] = np.nan
    found = np.asarray(choose_vectors(frame(glossy_motion=broken, shadow_motion=None), "effects"))[..., 0]
    np.testing.assert_array_equal(found[0], 2.0)
    np.testing.assert_array_equal(found[1], 4.0)
    np.testing.assert_array_equal(found[2:], 1.0)


def test_what_is_absent_is_the_neutral_value():
    bare = frame(shadow_motion=None, glossy_motion=None, specular_reflectance=None)
    np.testing.assert_array_equal(choose_vectors(bare, "effects"), bare.dual_motion)
    assert choose_vectors(Frame(np.ones((*SHAPE, 3))), "effects") is None
    # A camera and surfaces that rest under a shadow that moves.
    still = Frame(np.ones((*SHAPE, 3)), shadow_motion=vectors(3.0))
    np.testing.assert_array_equal(choose_vectors(still, "effects"), still.shadow_motion)
    # A mirror without its reflectance is not known to be one.
    unknown = choose_vectors(frame(specular_reflectance=None), "effects")
    np.testing.assert_array_equal(np.asarray(unknown)[..., 0].max(), 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("motion", READS)
def test_ntd_reads_and_follows_what_its_vectors_are_made_of(motion, key):
    """With a history of 5 in one place, that place shows up where the vector points to it."""
    denoiser = ntd(size=((2,), (2,), (2,), (2,), (2,)), motion=motion)
    assert denoiser.reads >= READS[motion]
    assert ("shadow_motion" in denoiser.reads) == (motion == "effects")
    params = denoiser.init(key, frame())
    first = frame()._replace(radiance=np.zeros((*SHAPE, 3), np.float32))
    step = jax.jit(denoiser.step)
    state, _ = step(params, denoiser.start(params, first), first)
    history = np.zeros((*SHAPE, 3), np.float32)
    history[:, 5] = 5.0
    core = jax.tree.map(lambda leaf: leaf if leaf.shape != history.shape else history, state.core)
    given = frame(motion=vectors(0.0), dual_motion=vectors(0.0), glossy_motion=None, shadow_motion=vectors(3.0))
    _, image = step(params, state._replace(core=core), given._replace(radiance=first.radiance))
    # Kernels of 5 x 5 pixels spread the history: from where it lies, or from three pixels beside.
    assert (np.asarray(image)[:, :3].max() > 0) == (motion == "effects")
