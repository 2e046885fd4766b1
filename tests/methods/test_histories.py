"""Filters that keep the light of lobes apart, ``relax`` and ``reblur``: what must hold for each of them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import FAR, Frame, only
from jaxdn.denoiser import Denoiser
from jaxdn.denoiser.rollout import unroll
from jaxdn.denoiser.statistics import measure_frame
from jaxdn.methods.lobes import split_signals
from jaxdn.methods.two_lobes.reblur import reblur
from jaxdn.methods.two_lobes.relax import relax
from tests.methods.lobe_scenes import (
    HEIGHT,
    WIDTH,
    check_light_and_options,
    compiled,
    mirror_frames,
    neutral,
    run,
    scene,
    starting,
)


@dataclass(frozen=True)
class Kind:
    """One of the filters, and where its state has what the tests look at."""

    method: Callable[..., Denoiser]
    small: dict[str, Any]
    """Options with which it does all of its work on a small image."""
    plain: dict[str, Any]
    """Options with which it is nothing but running means."""
    inside: bool
    """Its histories are in ``core.light``, not in ``core`` itself."""
    length: int
    """Channel of the length of a history."""
    fast: int
    """First channel of the fast history."""

    # Once each: a step is compiled anew for every denoiser.
    @cached_property
    def denoiser(self) -> Denoiser:
        return self.method(**self.small)

    @cached_property
    def default(self) -> Denoiser:
        return self.method()

    @cached_property
    def means(self) -> Denoiser:
        return self.method(**self.plain)

    def histories(self, state: Any) -> Any:
        """The histories, ``diffuse`` and ``specular``."""
        return state.core.light if self.inside else state.core

    def with_histories(self, state: Any, light: Any) -> Any:
        return state._replace(core=state.core._replace(light=light) if self.inside else light)

    def stepped(self, state: Any, frame: Frame) -> tuple[Any, jax.Array]:
        return compiled(self.denoiser)({}, state, frame)


MEANS = {"fix_frames": 0, "clamp_sigma": 1e6, "lag_sigma": 1e6, "demodulate": "none"}
KINDS = {
    "relax": Kind(
        relax,
        small={"levels": 1, "anti_firefly": True},
        plain={**MEANS, "anti_firefly": False, "short_history": 0, "levels": 0},
        inside=False,
        length=5,
        fast=9,
    ),
    "reblur": Kind(
        reblur,
        small={"pre_radius": 3.0, "radius": 3.0, "anti_firefly": True},
        plain={**MEANS, "pre_radius": 0.0, "radius": 0.0, "stable_max": 1},
        inside=True,
        length=3,
        fast=4,
    ),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS)
def kind(request: pytest.FixtureRequest) -> Kind:
    return request.param


@pytest.mark.slow
def test_a_constant_image_stays_with_all_of_its_border(kind, rng):
    frames = [
        frame._replace(
            radiance=np.full_like(frame.radiance, 0.37),
            specular=np.full_like(frame.specular, 0.12),
            **{name: np.full_like(getattr(frame, name), 0.4) for name in ("reflectance", "albedo")},
            specular_reflectance=np.full_like(frame.specular_reflectance, 0.1),
        )
        for frame in scene(rng, 4)
    ]
    for image in run(kind.denoiser, frames)[1]:
        np.testing.assert_allclose(image, 0.37, rtol=2e-5)


@pytest.mark.slow
def test_static_histories_are_the_means_until_their_caps(kind, rng):
    denoiser = kind.method(**kind.plain, history_max=10, fast_max=3)
    noise = rng.gamma(0.5, 1.0, (14, 60, 60, 3)).astype(np.float32)
    share = rng.random((14, 60, 60, 1)).astype(np.float32)
    step, state = compiled(denoiser), starting(denoiser)({}, Frame(noise[0], specular=noise[0] * share[0]))
    spread = []
    for index, (radiance, part) in enumerate(zip(noise, share, strict=True)):
        state, image = step({}, state, Frame(radiance, specular=radiance * part))
        seen, shares = noise[: index + 1].astype(np.float64), share[: index + 1]
        kept = kind.histories(state)
        history = np.asarray(kept.diffuse), np.asarray(kept.specular)
        for found, lights in zip(history, (seen * (1 - shares), seen * shares), strict=True):
            np.testing.assert_array_equal(found[..., kind.length], min(index + 1, 10))
            if index < 10:
                np.testing.assert_allclose(found[..., :3], lights.mean(0), rtol=2e-4, atol=1e-6)
            if index < 3:
                np.testing.assert_allclose(found[..., kind.fast : kind.fast + 3], lights.mean(0), rtol=2e-4, atol=1e-6)
        spread.append(np.var(image))
    single = np.var(noise)
    np.testing.assert_allclose(np.array(spread[:10]) * np.arange(1, 11), single, rtol=0.1)
    # From the cap on, a mean with the weight 1/N tends to a variance of 1 / (2 N - 1).
    assert single / 19 * 0.9 < spread[-1] < single / 10 * 1.1


@pytest.mark.slow
def test_by_default_the_error_of_a_static_scene_falls(kind, rng):
    noise = rng.gamma(0.5, 2.0, (24, 24, 24, 3)).astype(np.float32)
    _, images = run(kind.default, [Frame(each) for each in noise])
    errors = [np.mean((image - 1.0) ** 2) for image in images]
    assert np.mean(errors[20:]) < np.mean(errors[6:10]) < np.mean(errors[:3]) < np.var(noise) / 20


@pytest.mark.slow
@pytest.mark.parametrize(
    "missing",
    [
        (),
        ("far_motion",),
        *(pytest.param((name,), marks=pytest.mark.slow) for name in ("specular_hit_distance", "roughness")),
    ],
)
def test_a_reflection_is_fetched_where_it_was(kind, rng, missing):
    sky, frames = mirror_frames(rng)
    frames = [frame._replace(**dict.fromkeys(missing)) for frame in frames]
    state, _ = run(kind.means, frames)
    inner = np.asarray(kind.histories(state).specular)[4:-4, 4:-8]
    error = np.mean((inner[..., :3] - sky[4:-4, 4:-8]) ** 2) / np.mean(sky**2)
    if missing:
        assert error > 0.1
    else:
        np.testing.assert_allclose(inner[..., kind.length], len(frames), rtol=1e-3)
        assert error < 0.06  # a single frame has 0.5, a mean of twelve 0.042


@pytest.mark.slow
def test_the_first_frame_reads_no_history_and_no_motion(kind, rng):
    frame = scene(rng, 1)[0]
    clean = starting(kind.denoiser)({}, frame)
    nothing = jax.tree.map(lambda leaf: leaf * np.nan, kind.histories(clean))
    poisoned = kind.with_histories(clean, nothing)
    elsewhere = frame._replace(motion=np.full_like(frame.motion, 3.3))
    expected_state, expected = kind.stepped(clean, frame)
    for state, given in ((poisoned, frame), (clean, elsewhere)):
        after, image = kind.stepped(state, given)
        np.testing.assert_array_equal(image, expected)
        np.testing.assert_array_equal(kind.histories(after).specular, kind.histories(expected_state).specular)


@pytest.mark.parametrize("which", ["diffuse", "specular"])
def test_broken_history_is_dropped_where_it_is_broken(kind, rng, which):
    frames = scene(rng, 2)
    state, _ = kind.stepped(starting(kind.denoiser)({}, frames[0]), frames[0])
    light = kind.histories(state)
    broken = kind.with_histories(state, light._replace(**{which: getattr(light, which).at[6, 4, 1].set(np.nan)}))
    after, image = kind.stepped(broken, frames[1])
    assert np.isfinite(image).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.core))
    assert int(after.sanitized) > int(kind.stepped(state, frames[1])[0].sanitized)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("specular",),
        *(
            pytest.param(names, marks=pytest.mark.slow)
            for names in (
                ("specular_hit_distance", "hit_distance"),
                ("roughness",),
                # Two at once: one is read where light is fetched, the other where it is divided.
                ("far_motion", "ray_length", "reflectance", "albedo", "specular_reflectance"),
                ("motion", "far_motion", "previous_depth"),
            )
        ),
    ],
    ids="-".join,
)
def test_none_is_the_neutral_value_written_out(kind, rng, names):
    frames = scene(rng, 3)
    absent = [frame._replace(**dict.fromkeys(names)) for frame in frames]
    written = [neutral(frame, names) for frame in frames]
    for first, second in zip(run(kind.denoiser, absent)[1], run(kind.denoiser, written)[1], strict=True):
        np.testing.assert_allclose(first, second, rtol=2e-5, atol=1e-6)


@pytest.mark.slow
def test_specular_light_may_come_and_go_within_a_clip(kind, rng):
    frames = scene(rng, 4)
    frames[0] = frames[0]._replace(specular=None)
    frames[2] = frames[2]._replace(specular=None)
    state, images = run(kind.denoiser, frames)
    assert all(np.isfinite(image).all() for image in images)
    assert np.isfinite(kind.histories(state).specular).all()


def test_pixels_without_a_surface_pass_through(kind, rng):
    frame = scene(rng, 1)[0]
    np.testing.assert_array_equal(run(kind.denoiser, [frame])[1][0][0], frame.radiance[0])
    sky = frame._replace(depth=np.full_like(frame.depth, FAR), ids=np.full_like(frame.ids, -1))
    np.testing.assert_array_equal(run(kind.denoiser, [sky])[1][0], frame.radiance)


LOBES = frozenset({"specular", "depth", "motion", "far_motion", "roughness", "specular_hit_distance", "hit_distance"})
"""What is read of a frame where its guides are not what a test is about: they are a fourth of its program."""


@pytest.mark.slow
def test_gradients_reach_both_kinds_of_light_and_the_options(kind, x64, rng):
    """In one program; at the options' declared values, where training begins."""
    few = [only(frame, LOBES) for frame in scene(rng, 2, np.float64)]
    frames = jax.tree.map(lambda *buffers: np.stack(buffers), *few)
    params = jax.tree.map(np.float64, kind.denoiser.init(jax.random.key(0), few[0]))
    weights = np.cos(np.arange(HEIGHT * WIDTH * 3)).reshape(HEIGHT, WIDTH, 3)

    def loss(radiance, part, params):
        light = frames.radiance + radiance[None]
        lit = frames._replace(radiance=light, specular=light * part[None])
        return jnp.mean(unroll(kind.denoiser, params, lit)[-1] * weights)

    zero, half = np.zeros((HEIGHT, WIDTH, 3)), np.full((HEIGHT, WIDTH, 1), 0.4)
    check_light_and_options(loss, (zero, half), params, rng, by=[0])


@pytest.mark.slow
def test_specular_light_is_not_mixed_with_that_of_another_roughness(kind):
    """A bright rough half beside a dark smooth one: as wide as diffuse light, it would go there."""
    left = (np.arange(WIDTH) < WIDTH // 2)[None, :, None] & np.ones((HEIGHT, 1, 1), bool)
    light = np.where(left, 1.0, 0.0).astype(np.float32) * np.ones(3, np.float32)
    frame = Frame(light, specular=light, roughness=np.where(left, 0.9, 0.3).astype(np.float32))

    def leaked(frame):
        return run(kind.default, [frame])[1][0][:, WIDTH // 2 :].mean()

    assert leaked(frame) < 0.5 * leaked(frame._replace(specular=0 * light))


@pytest.mark.parametrize("by", ["brdf", "albedo", "none"])
def test_both_kinds_of_light_add_up(rng, by):
    frame = scene(rng, 1)[0]
    diffuse, specular = split_signals(frame, by, measure_frame(frame.radiance, None, frame))
    np.testing.assert_allclose(
        diffuse.remodulate(diffuse.light) + specular.remodulate(specular.light), frame.radiance, rtol=1e-6
    )
    np.testing.assert_allclose(specular.remodulate(specular.light), frame.specular, rtol=1e-6)


def test_specular_light_beyond_all_light_is_cut_off(rng):
    frame = scene(rng, 1)[0]
    frame = frame._replace(specular=2 * frame.radiance + 1)
    diffuse, specular = split_signals(frame, "none", measure_frame(frame.radiance, None, frame))
    assert not np.any(diffuse.light)
    np.testing.assert_array_equal(specular.light.transpose(1, 2, 0), frame.radiance)
