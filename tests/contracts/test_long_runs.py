"""Thousands of frames: the recurrent state stays bounded, does not drift, and forgets one invalid (poisoned) frame.

python -m pytest tests/contracts/test_long_runs.py -m slow -s        # prints the curves' figures
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from experiments.stability import long_runs
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Core, recurrent
from jaxdn.methods.registry import methods
from jaxdn.zoo.ready import filter_names, find_model
from jaxdn.zoo.weights import shipped_names

pytestmark = pytest.mark.usefixtures("optimised_programs", "usual_tiles")  # they run for thousands of frames
SOONER = {"xla_backend_optimization_level": 1}
"""For XLA: what is compiled in three fifths of the time runs as fast."""
SIZE = 32
LONG, SHORT = 2000, 250
"""Frames; the long run is made of short ones, so that one program is compiled."""
LIGHTEST = [list(method.variants)[-1] for method in methods().values() if method.variants]
METHODS = [*filter_names(), *(name for name in LIGHTEST if name in shipped_names())]
FADES = [*METHODS, *(name for name in shipped_names() if name.startswith("steady") and name not in METHODS)]
"""Those whose light has to fade when a lamp is switched off: every ``steady``, as each learns how fast it does."""
FORGETS = {"ntd-small": 80, "relax": 155, "relax-fitted": 155}
"""Frames after which a poisoned frame has to be forgotten, to 1 % of the clean run; 120 for all others.

``relax``, with any constants: the largest number that a file holds fades from the fast mean, of 6 frames, to 1 % in 80
frames; what is left within the noise of that mean, a tenth, from the slow one, of 30 frames, in 70 more."""


def test_filters_and_the_lightest_weights_are_tested():
    assert {"svgf", "ntd-small"} <= set(METHODS)


def test_the_experiment_follows_denoisers_without_a_state():
    def step(params, state, frame, first, statistics):
        return state, frame.radiance, 0

    as_it_is = recurrent(Core(lambda params, frame: {}, step, frozenset()))
    state, error, healthy, _ = long_runs.compiled(as_it_is, {}, 4)((0.7, 0.0, -1))
    assert state.tolist() == [0, 0, 0, 0]
    assert healthy.all()
    assert (np.asarray(error) > 0.5).all()


def wall():
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    albedo = np.stack([0.4 + 0.3 * np.sin(columns / 3), 0.5 + 0 * rows, 0.6 + 0.2 * np.cos(rows / 5)], axis=-1)
    zero = np.zeros((SIZE, SIZE, 1), np.float32)
    return Frame(
        radiance=(0.6 * albedo).astype(np.float32),
        albedo=albedo.astype(np.float32),
        normal=np.concatenate([zero, zero, zero + 1], axis=-1),
        depth=zero + 4,
        roughness=zero + 1,
        ids=np.zeros((SIZE, SIZE, 1), np.int32),
    )


@functools.lru_cache(maxsize=1)
def compiled(name):
    """``SHORT`` frames of a wall from any frame on, while the camera slides back and forth; and the first state."""
    _, denoiser, params, *_ = find_model(name)
    base = jax.tree.map(jnp.asarray, wall())

    def body(settings, state, index):
        speed, poison, at, dark = settings
        noise = jax.random.exponential(jax.random.fold_in(jax.random.key(1), index), (SIZE, SIZE, 1))
        radiance = jnp.where(index < dark, base.radiance * noise, 0.0)
        radiance = jnp.where(index == at, poison, radiance)
        across = jnp.where((index // 8) % 2 == 0, speed, -speed)
        motion = jnp.broadcast_to(jnp.stack([across, 0.5 * across]), (SIZE, SIZE, 2))
        state, image = denoiser.step(params, state, base._replace(radiance=radiance, motion=motion))
        healthy = jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]))
        return state, (jnp.mean(image), jnp.max(image), healthy & jnp.all(jnp.isfinite(image)), image[::4, ::4])

    def part(settings, state, first):
        return lax.scan(functools.partial(body, settings), state, first + jnp.arange(SHORT))

    return jax.jit(part, compiler_options=SOONER), denoiser.start(params, base)


@functools.lru_cache(maxsize=1)
def clean(name):
    """The run of ``SHORT`` frames without a poisoned one."""
    return run(name, SHORT)


def run(name, frames, *, speed=0.7, poison=0.0, at=-1, dark=10**6):
    """Mean and largest value of every output frame, whether all was finite, and every fourth pixel."""
    settings = (jnp.float32(speed), jnp.float32(poison), jnp.int32(at), jnp.int32(dark))
    part, state = compiled(name)
    parts = []
    for first in range(0, frames, SHORT):
        state, seen = part(settings, state, first)
        parts.append(seen)
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))


def remembers(name):
    """Whether a method keeps an image from frame to frame; else nothing can add up."""
    return any(leaf.size >= SIZE * SIZE for leaf in jax.tree.leaves(compiled(name)[1]))


@pytest.mark.needs("pyoidn")
def test_a_history_is_known():
    assert remembers("taa")
    assert not remembers("oidn")


# With the scope of the module, pytest runs all tests of a method one after the other: it is compiled once.


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "frames"), [(0.0, LONG // 2), (0.7, LONG)])
@pytest.mark.parametrize("name", METHODS, scope="module")
def test_thousands_of_frames_neither_diverge_nor_drift(name, speed, frames):
    mean, top, healthy, _ = run(name, frames if remembers(name) else 2 * SHORT, speed=speed)
    assert healthy.all()
    assert top.max() <= RADIANCE_MAX
    early, late = mean[100:300].mean(), mean[-200:].mean()
    print(
        f"{name}, {speed} px: mean {early:.4f} after 100 frames, {late:.4f} after {frames}, "
        f"largest {top[100:].max():.3f}"
    )
    assert late == pytest.approx(early, rel=0.02)
    assert top[100:].max() < 10


@pytest.mark.slow
@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e30, -5.0])
@pytest.mark.parametrize("name", METHODS, scope="module")
def test_one_poisoned_frame_is_forgotten(name, poison):
    at = 60
    expected = clean(name)
    poisoned = run(name, SHORT, poison=poison, at=at)
    assert poisoned[2].all(), "state and image are always finite"
    difference = np.abs(poisoned[3] - expected[3]).max(axis=(1, 2, 3)) / np.abs(expected[3]).mean(axis=(1, 2, 3))
    bad = np.flatnonzero(difference > 0.01)
    recovered = int(bad.max()) + 1 - at if bad.size else 0
    print(f"{name}: {poison:g} forgotten to 1 % after {recovered} frames")
    assert np.array_equal(poisoned[3][:at], expected[3][:at])
    assert recovered <= FORGETS.get(name, 120)


@pytest.mark.slow
@pytest.mark.parametrize("name", FADES, scope="module")
def test_a_light_switched_off_fades(name):
    mean, _, healthy, _ = run(name, SHORT, dark=100)
    assert healthy.all()
    left = mean[100:] / mean[50:100].mean()
    tenth, gone = (int(np.flatnonzero(left < share)[0]) for share in (0.1, 0.01))
    print(f"{name}: at a tenth after {tenth} frames, dark after {gone}")
    assert gone <= 40
    if name.startswith("steady"):
        assert tenth <= 10
