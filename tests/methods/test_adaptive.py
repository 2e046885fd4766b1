"""``ntasd`` and ``dasr``: where samples go, that the budget is kept, and that both networks learn."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxdn.core.frame import FAR, Clip, Frame, frame_at, only
from jaxdn.denoiser import Denoiser, Recurrent, State
from jaxdn.denoiser.rollout import denoise, render_requested, unroll
from jaxdn.methods import ntd
from jaxdn.methods.dasr import dasr
from jaxdn.methods.ntasd import ntasd
from jaxdn.methods.registry import methods
from jaxdn.methods.stabilised import stabilised
from jaxdn.methods.taa import taa
from jaxdn.ops.sampling import from_layers

TINY = ((4,), (4,), (5,), (5,), (6,))
SIZE = (18, 21)
"""Not a multiple of what the networks work on."""
LAYERS = (1, 2, 4, 8)
METHODS = {"ntasd": ntasd, "dasr": dasr}
PLAIN: dict[str, Any] = {"kernels": "plain", "demodulate": "none", "background": "filter", "exposure": "given"}
"""Options of ``ntasd`` with which there is little between its samples and its image."""


def clip_of(rng: np.random.Generator, count: int = 3, size: tuple[int, int] = SIZE) -> Clip:
    """All buffers, a wall whose right half is noisier, a camera that moves a little."""
    shape = (count, *size)
    normal = rng.normal(size=(*shape, 3))
    reference = np.broadcast_to(rng.uniform(0.5, 1.5, size=(*size, 3)), (*shape, 3))
    spread = np.where(np.arange(size[1]) < size[1] // 2, 0.02, 0.8)[:, None]
    layers = {n: reference * (1 + spread * rng.normal(size=(*shape, 3)) / np.sqrt(n)) for n in LAYERS}
    buffers = {
        "radiance": layers[1],
        "albedo": rng.uniform(0.3, 1, size=(*shape, 3)),
        "normal": normal / np.linalg.norm(normal, axis=-1, keepdims=True),
        "depth": rng.uniform(1, 9, size=(*shape, 1)),
        "motion": rng.normal(size=(*shape, 2)),
    }
    clip = Clip(Frame(**buffers), reference, layers)
    return jax.tree.map(lambda values: jnp.asarray(np.maximum(values, -9.0), jnp.float32), clip)


def varied(denoiser: Denoiser, clip: Clip, key: jax.Array) -> Any:
    """Parameters for which every pixel has another number of samples."""
    params = denoiser.init(key, frame_at(clip.frames, 0))
    return jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(key, leaf.shape), params)


def counts_of(denoiser: Denoiser, params: Any, clip: Clip) -> list[np.ndarray]:
    """The numbers of samples that each frame was given."""
    state, found = denoiser.start(params, only(frame_at(clip.frames, 0), denoiser.reads)), []
    for index in range(len(clip.frames.radiance)):
        layers = {samples: layer[index] for samples, layer in clip.layers.items()}
        state, counts = counting(denoiser)(params, state, frame_at(clip.frames, index), layers)
        found.append(np.asarray(counts))
    return found


@functools.cache
def counting(denoiser: Denoiser) -> Callable[..., Any]:
    """A step that returns the numbers of samples: compiled once for each denoiser."""

    def step(params: Any, state: State, frame: Frame, layers: Any) -> Any:
        given = render_requested(denoiser, params, state, frame, layers)
        return denoiser.step(params, state, given)[0], given.sample_count

    return jax.jit(step)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("budget", [2.5, pytest.param(4.0, marks=pytest.mark.slow)])
def test_every_frame_has_the_budget_and_every_pixel_its_own_number(name, budget, rng, key):
    denoiser, clip = METHODS[name](size=TINY, budget=budget), clip_of(rng)
    pairs = round((budget - 1) / 2 * clip.frames.depth[0].size)
    total = 2 * pairs + clip.frames.depth[0].size if name == "dasr" else round(budget * clip.frames.depth[0].size)
    for counts in counts_of(denoiser, varied(denoiser, clip, key), clip)[1:]:
        assert counts.sum() == total
        assert 1 <= counts.min() < budget < counts.max() <= 15


@pytest.mark.slow
def test_the_first_frame_is_sampled_evenly(rng, key):
    denoiser, clip = ntasd(size=TINY), clip_of(rng)
    first, second, _ = counts_of(denoiser, varied(denoiser, clip, key), clip)
    np.testing.assert_array_equal(first, 4)
    assert len(np.unique(second)) > 2


@pytest.mark.slow
def test_the_sampler_of_ntasd_sees_the_last_image_along_the_vectors(rng, key):
    """Another last image gives other numbers of samples, and so do other vectors."""
    denoiser, clip = ntasd(size=TINY, demodulate="none", exposure="given"), clip_of(rng, 1, (16, 32))
    params, frame = varied(denoiser, clip, key), frame_at(clip.frames, 0)
    past = jnp.asarray(rng.exponential(size=(16, 32, 3)), jnp.float32)

    @jax.jit
    def counts(past, shift):
        motion = jnp.broadcast_to(jnp.asarray(shift, jnp.float32), (16, 32, 2))
        state = Recurrent(past, jnp.asarray(3), jnp.asarray(0))
        layers = {samples: layer[0] for samples, layer in clip.layers.items()}
        return render_requested(denoiser, params, state, frame._replace(motion=motion), layers).sample_count

    still = counts(past, [0.0, 0.0])
    assert np.any(counts(4.0 * past, [0.0, 0.0]) != still)
    assert np.any(counts(past, [8.0, 0.0]) != still)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_without_a_sampler_all_pixels_have_the_budget(name, rng, key):
    denoiser, clip = METHODS[name](size=TINY, adaptive=False, budget=3), clip_of(rng)
    params = varied(denoiser, clip, key)
    assert "sampler" not in params
    even = jax.vmap(lambda layers: from_layers(layers, jnp.full((*SIZE, 1), 3.0))[0])(clip.layers)
    assert all(np.all(counts == 3) for counts in counts_of(denoiser, params, clip))
    # Then no radiance but that of the layers counts.
    run = jax.jit(lambda clip: denoise(denoiser, params, clip))
    images = run(clip)
    other = clip._replace(frames=clip.frames._replace(radiance=even))
    np.testing.assert_array_equal(images, run(other))


@pytest.mark.slow
def test_dasr_sees_the_first_sample_and_no_other_frame(rng, key):
    denoiser, clip = dasr(size=TINY), clip_of(rng)
    params = varied(denoiser, clip, key)
    backwards = jax.tree.map(lambda leaf: leaf[::-1], clip)
    run = jax.jit(lambda clip: denoise(denoiser, params, clip))
    np.testing.assert_allclose(run(backwards)[::-1], run(clip), rtol=1e-5, atol=1e-6)
    brighter = clip._replace(layers={**clip.layers, 1: clip.layers[1].at[:, :9].multiply(5.0)})
    # Whatever the radiance is that the clip was read with.
    other = clip._replace(frames=clip.frames._replace(radiance=clip.layers[4]))
    plain, moved, same = (counts_of(denoiser, params, each)[0] for each in (clip, brighter, other))
    assert np.any(plain != moved)
    np.testing.assert_array_equal(plain, same)


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [lambda inner: inner, stabilised, lambda inner: taa(after=inner)])
def test_a_quarter_of_a_sample_rotates_over_the_pixels(wrap, rng, key):
    """Without a sampler, each pixel has one sample in four frames, and each 2x2 block one in every frame."""
    options: dict[str, Any] = {"adaptive": False, "budget": 0.25, "least": 0, "rounding": "stochastic"}
    denoiser, clip = wrap(ntasd(size=TINY, pattern="rotating", **options)), clip_of(rng, 4, (8, 12))
    counts = np.stack(counts_of(denoiser, denoiser.init(key, frame_at(clip.frames, 0)), clip))
    np.testing.assert_array_equal(counts.sum(0), 1)
    np.testing.assert_array_equal(counts.reshape(4, 4, 2, 6, 2).sum((2, 4)), 1)


@pytest.mark.parametrize("options", [{}, {"budget": 1}, {"least": 3, "budget": 5}, {"preset": "paper"}], ids=str)
def test_the_first_sample_of_dasr_is_in_its_image_and_in_its_budget(options, rng, key):
    """Layers are the samples of a number's binary digits: that of one sample is in the odd numbers alone."""
    denoiser, clip = dasr(size=TINY, **options), clip_of(rng)
    for counts in counts_of(denoiser, varied(denoiser, clip, key), clip):
        np.testing.assert_array_equal(counts % 2, 1)
        assert counts.min() >= options.get("least", 1)


@pytest.mark.parametrize("name", METHODS)
def test_of_the_paper_every_network_begins_as_glorot_and_bengio_say(name, rng, key):
    """Weights of a convolution are uniform within sqrt(6 / (fan in + fan out)) (Hasselgren et al. 2020, sec. 2.2)."""
    denoiser = METHODS[name](size=TINY, preset="paper")
    params = denoiser.init(key, frame_at(clip_of(rng).frames, 0))
    assert len(params) == 2
    kernels = [leaf for leaf in jax.tree.leaves(params) if leaf.ndim == 4]
    assert len(kernels) >= 20
    for kernel in kernels:
        area = kernel.shape[0] * kernel.shape[1]
        limit = np.sqrt(6 / (area * (kernel.shape[2] + kernel.shape[3])))
        assert 0.8 * limit < np.abs(kernel).max() <= limit


def test_of_the_paper_the_heads_are_51_26_and_26_channels(rng, key):
    """Hasselgren et al. 2020, sec. 2.1: alpha belongs to the coarser scales, and to the finest the history's."""
    denoiser = ntasd(size=TINY, preset="paper")
    heads = denoiser.init(key, frame_at(clip_of(rng).frames, 0))["denoiser"]
    assert [len(heads[f"head_{scale}"]["bias"]) for scale in range(3)] == [51, 26, 26]


def test_what_the_network_keeps_is_fetched_where_the_surface_was(rng):
    """By whole pixels, so that the fetch is a shift. It is 0 outside, in the first frame, and for NaN."""
    memory = rng.uniform(-1, 1, size=(*SIZE, 4)).astype(np.float32)
    memory[3, 5, 1] = np.nan
    frame = Frame(jnp.zeros((*SIZE, 3)), motion=jnp.broadcast_to(jnp.float32([2, -1]), (*SIZE, 2)))
    options = ntd.Options(motion="traditional")
    found = np.asarray(ntd.warp_memory(options, jnp.asarray(memory), frame, jnp.asarray(False)))
    expected = np.zeros_like(memory)
    expected[1:, :-2] = memory[:-1, 2:]
    np.testing.assert_allclose(found, np.nan_to_num(expected), atol=1e-6)
    assert not np.any(ntd.warp_memory(options, jnp.asarray(memory), frame, jnp.asarray(True)))


@pytest.mark.slow
def test_the_network_learns_what_to_keep(rng, key):
    """What it keeps is its own output, and the next image depends on it."""
    clip, denoiser = clip_of(rng, 2), ntasd(size=TINY, adaptive=False, budget=1.0, memory=4, **PLAIN)
    params = varied(denoiser, clip, key)
    frames = clip.frames._replace(sample_count=jnp.ones_like(clip.frames.depth))

    @jax.jit
    def slopes(params):
        return jax.grad(lambda params: jnp.mean(unroll(denoiser, params, frames)[-1] ** 2))(params)

    head = slopes(params)["denoiser"]["head_0"]["bias"]
    assert head.shape == (2 * 25 + 2 + 4,)
    assert np.all(np.abs(head[-4:]) > 0)
    bias = params["denoiser"]["head_0"]["bias"].at[-4:].set(jnp.float32([0.5, -0.5, 9.0, 0.0]))
    kernel = params["denoiser"]["head_0"]["kernel"].at[..., -4:].set(0.0)
    fixed = {"denoiser": {**params["denoiser"], "head_0": {"kernel": kernel, "bias": bias}}}
    first = only(frame_at(frames, 0), denoiser.reads)
    state, _ = jax.jit(denoiser.step)(fixed, denoiser.start(fixed, first), first)
    kept = next(leaf for leaf in jax.tree.leaves(state) if leaf.ndim == 3)[..., 3:]
    np.testing.assert_allclose(kept, np.broadcast_to(np.tanh([0.5, -0.5, 9.0, 0.0]), kept.shape), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_samples_learn_to_go_where_noise_is(name, rng, key):
    """The error of the image teaches the sampler, through the reference, which half of the wall is noisy."""
    options = PLAIN if name == "ntasd" else {"demodulate": "none"}
    denoiser, clip = METHODS[name](size=TINY, **options), clip_of(rng, 3, (16, 32))
    clip = clip._replace(frames=clip.frames._replace(motion=0 * clip.frames.motion))
    rule = optax.adam(3e-3)

    def loss(params):
        return jnp.mean(jnp.square(unroll(denoiser, params, clip.frames, clip.layers, clip.reference) - clip.reference))

    @jax.jit
    def update(params, state):
        change, state = rule.update(jax.grad(loss)(params), state)
        return optax.apply_updates(params, change), state

    params = denoiser.init(key, frame_at(clip.frames, 0))
    state = rule.init(params)
    for _ in range(200):
        params, state = update(params, state)
    counts = counts_of(denoiser, params, clip)[-1]
    assert counts[:, 16:].mean() > 1.5 * counts[:, :16].mean()


@pytest.mark.slow
def test_the_amplitude_slope_is_half_of_the_mixing_slope(rng, key):
    """Of the numbers of samples, by the weights of the network that asks for them."""
    clip = clip_of(rng, 1)
    past, weights = jnp.asarray(rng.exponential(size=(2, *SIZE, 3)), jnp.float32)
    state, slopes = Recurrent(past, jnp.asarray(3), jnp.asarray(0)), []
    for slope in ("mixing", "amplitude"):
        denoiser = ntasd(size=TINY, slope=slope)
        params, frame = varied(denoiser, clip, key), only(frame_at(clip.frames, 0), denoiser.reads)

        def asked(sampler, denoiser=denoiser, params=params, frame=frame):
            counts = denoiser.samples(params | {"sampler": sampler}, state, frame, sum(LAYERS))
            return jnp.sum(weights[..., :1] * counts)

        slopes.append(jax.tree.leaves(jax.jit(jax.grad(asked))(params["sampler"])))
    largest = max(np.abs(leaf).max() for leaf in slopes[0])
    assert largest > 0
    for whole, half in zip(*slopes, strict=True):
        np.testing.assert_allclose(half, 0.5 * whole, rtol=1e-3, atol=1e-5 * largest)


@pytest.mark.slow
def test_pixels_without_samples_are_filled_from_their_neighbours(rng, key):
    """The paper's map may give none; black pixels would darken all around them."""
    denoiser, clip = ntasd(size=TINY, least=0, budget=1, demodulate="none"), clip_of(rng)
    params = varied(denoiser, clip, key)
    flat = clip._replace(layers={n: jnp.ones_like(layer) for n, layer in clip.layers.items()})
    assert counts_of(denoiser, params, flat)[1].min() == 0
    images = jax.jit(lambda clip: denoise(denoiser, params, clip))(flat)
    np.testing.assert_allclose(np.median(images, axis=(1, 2, 3)), 1.0, rtol=1e-3)


@pytest.mark.slow
def test_background_without_samples_is_filled_from_background_with_samples(rng, key):
    """Of the same block, or else of the frame; surfaces give it none of their light."""
    denoiser, clip = ntasd(size=TINY, least=0, demodulate="none"), clip_of(rng, 1)
    params, frame = varied(denoiser, clip, key), only(frame_at(clip.frames, 0), denoiser.reads)
    sky = np.arange(SIZE[1])[:, None] < 10
    counts = (rng.random((*SIZE, 1)) < 0.3).astype(np.float32)
    counts[:8, :8] = 0.0
    light = counts * np.where(sky, np.float32(2.0), frame.radiance)
    frame = frame._replace(radiance=light, depth=np.where(sky, np.float32(FAR), frame.depth), sample_count=counts)
    _, image = jax.jit(denoiser.step)(params, denoiser.start(params, frame), frame)
    np.testing.assert_allclose(image[:, :10], 2.0, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("adaptive", [False, True])
def test_budgets_below_one_sample_are_kept_in_the_mean_and_move_from_frame_to_frame(adaptive, rng, key):
    denoiser = ntasd(size=TINY, adaptive=adaptive, budget=0.25, least=0, rounding="stochastic")
    clip = clip_of(rng, 6)
    found = np.stack(counts_of(denoiser, varied(denoiser, clip, key), clip))
    np.testing.assert_array_equal(found, np.round(found))
    np.testing.assert_allclose(found.mean((1, 2, 3)), 0.25, atol=0.06)
    assert np.mean(found[0] != found[1]) > 0.2
    if not adaptive:
        assert found.max() == 1
        assert np.mean(found[:5].sum(0) >= 1) > 0.9  # no pixel waits for long
    assert not denoiser.sees_sample
    assert dasr(size=TINY).sees_sample


@pytest.mark.slow
def test_pixels_without_samples_learn_what_a_sample_would_bring(rng, key):
    """They are filled; a sample would move what fills them towards the reference."""
    denoiser, clip = ntasd(size=TINY, least=0, budget=1, demodulate="none"), clip_of(rng, 1)
    params, frame = varied(denoiser, clip, key), frame_at(clip.frames, 0)
    layers, reference = {1: jnp.ones((*SIZE, 3))}, jnp.full((*SIZE, 3), 0.25)
    counts = jnp.ones((*SIZE, 1)).at[5, 6].set(0.0)

    def image(counts):
        radiance, taken = from_layers(layers, counts, reference=reference)
        given = only(frame._replace(radiance=radiance, sample_count=taken), denoiser.reads)
        return denoiser.step(params, denoiser.start(params, given), given)[1]

    # Of an image that is 1 everywhere, and a pixel that would be 0.25: brighter images want fewer of its samples.
    slope = jax.jit(jax.grad(lambda counts: jnp.sum(image(counts))))(counts)
    assert slope[5, 6, 0] < 0
    np.testing.assert_allclose(slope[5, 6, 0], slope[8:12, 8:12].mean(), rtol=0.9)


@pytest.mark.parametrize("name", METHODS)
def test_a_budget_that_the_layers_cannot_give_raises(name, rng, key):
    denoiser, clip = METHODS[name](size=TINY, budget=16), clip_of(rng)
    params = denoiser.init(key, frame_at(clip.frames, 0))
    with pytest.raises(ValueError, match=r"budget: expected a mean number of samples above 0 from 1 to 15"):
        denoise(denoiser, params, clip)
    with pytest.raises(ValueError, match="layers: expected independent noisy layers"):
        denoise(denoiser, params, clip._replace(layers=None))


@pytest.mark.parametrize("name", ["ntasd", "dasr", "rae", "arae"])
def test_no_paper_clips_gradients_or_lets_the_rate_fall(name):
    recipes = methods()[name].recipes
    for recipe in (recipes[each] for each in ("paper", "hasselgren") if each in recipes):
        assert (recipe.clip_norm, recipe.decay, recipe.average) == (0.0, False, 0.0)


def test_options_that_make_no_sense_raise():
    with pytest.raises(ValueError, match=r"least: expected at least 1, the sample that is rendered first, got 0"):
        dasr(least=0)
    with pytest.raises(ValueError, match=r"least: expected an odd number, .* got 2"):
        dasr(least=2)
    with pytest.raises(ValueError, match=r"rounding: expected 'exact' or 'nearest', .* got 'stochastic'"):
        dasr(rounding="stochastic")
    for name in METHODS:
        with pytest.raises(ValueError, match=r"least: expected a whole number of samples, .* got 1\.5"):
            METHODS[name](least=1.5)
        with pytest.raises(ValueError, match=r"budget: expected a number > 0, got 0"):
            METHODS[name](budget=0)
        assert methods()[name].parse_options({"preset": "paper"}).rounding == "nearest"


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_an_absent_number_of_samples_is_one(name, rng, key):
    denoiser = METHODS[name](size=TINY)
    clip = clip_of(rng, count=1)
    frame, params = frame_at(clip.frames, 0), varied(denoiser, clip, key)
    ones = jnp.ones_like(frame.depth)
    absent, written = (
        jax.jit(denoiser.step)(params, denoiser.start(params, only(given, denoiser.reads)), given)[1]
        for given in (frame, frame._replace(sample_count=ones))
    )
    np.testing.assert_array_equal(absent, written)
