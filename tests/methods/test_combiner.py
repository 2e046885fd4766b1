"""The combiner: means of the history by independent NumPy, candidates, the mixture, what it refuses to spread."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from experiments.cycles.combiner_start import take_over
from jaxdn.core.frame import Clip, Frame, frame_at
from jaxdn.denoiser.rollout import denoise
from jaxdn.denoisers import combiner, oidn
from jaxdn.methods.combiner.candidates import CANDIDATES, FilterParameters, make_candidates
from jaxdn.methods.combiner.choice import RADII, assemble_evidence, count_inputs, split_shares
from jaxdn.methods.combiner.history import (
    Means,
    Past,
    fetch_past,
    keep_history,
    measure_now,
    start_history,
    update_means,
)
from jaxdn.methods.combiner.method import FEATURES, INITIAL, prepare, split_head
from jaxdn.zoo.weights import load_weights, save_weights
from tests.needs import require

SIZE = (40, 54)  # the width is no multiple of 4


def clip_of(rng, count=3, size=SIZE):
    """Noise around a gradient, on one plane that stands still."""
    truth = np.linspace(0.5, 2.0, size[1])[None, :, None] * np.array([1.0, 0.8, 0.5])
    noise = rng.exponential(size=(count, *size, 3))
    return Frame(
        (truth * noise).astype(np.float32),
        albedo=np.full((count, *size, 3), 0.6, np.float32),
        normal=np.broadcast_to(np.float32([0, 0, 1]), (count, *size, 3)),
        depth=np.full((count, *size, 1), 3.0, np.float32),
        motion=np.zeros((count, *size, 2), np.float32),
    )


# Once each: what runs them is compiled anew for every denoiser.
fast = functools.cache(functools.partial(combiner, quality="fast"))
prior_alone = functools.cache(oidn)


@functools.cache
def untrained(seed=0):
    """Parameters of the fast network."""
    return jax.jit(fast().init)(jax.random.key(seed), Frame(jnp.zeros((16, 16, 3))))


@functools.cache
def compiled(denoiser):
    """Its images of parameters and frames."""
    return jax.jit(lambda params, frames: denoise(denoiser, params, Clip(frames, frames.radiance)))


def deciding(weights_of_candidates, follow=0.0):
    """The parameters of a network that decides the same everywhere."""
    params = untrained()
    logits = {**dict.fromkeys(CANDIDATES, -1e3), **weights_of_candidates}
    bias = np.array(params["head_0"]["bias"])
    bias[FEATURES:] = [4.0, follow]
    head = {"kernel": jnp.zeros_like(params["head_0"]["kernel"]), "bias": jnp.asarray(bias)}
    shares = {
        "kernel": jnp.zeros_like(params["choice"]["head_0"]["kernel"]),
        "bias": jnp.asarray([logits[name] for name in CANDIDATES], jnp.float32),
    }
    return {**params, "head_0": head, "choice": {**params["choice"], "head_0": shares}}


def run(denoiser, params, frames):
    """The images of a clip."""
    return np.asarray(compiled(denoiser)(params, frames), np.float64)


def gains(frames):
    """[T, 1, 1, 1] the factor that brings each frame to the network's brightness."""
    statistics_of = jax.jit(lambda frame: prepare(frame)[0])
    of = (statistics_of(jax.tree.map(jnp.asarray, frame_at(frames, index))) for index in range(len(frames.radiance)))
    return np.array([float(statistics.exposure) for statistics in of]).reshape(-1, 1, 1, 1)


def draw_means(rng, size, *, count=None):
    light, prior, albedo, normal = rng.uniform(0, 2, (4, 3, *size))
    counts = rng.uniform(1, 9, size) if count is None else np.full(size, count)
    return Means(light, prior, albedo / 2, normal - 1, rng.uniform(4, 5, size), counts)


def draw_past(rng, size):
    result = jnp.asarray(rng.random((3, *size)))
    return Past(draw_means(rng, size), result, rng.random(size) > 0.3, jnp.zeros((), jnp.int32))


def test_means_follow_by_the_shares_of_an_independent_computation(rng):
    size, most = (5, 6), 7.0
    now, past, follow = draw_means(rng, size, count=1.0), draw_past(rng, size), rng.uniform(0.05, 0.95, size)
    found = update_means(now, past, follow, most=most)
    count = past.means.number
    odds = follow / (1 - follow) / count  # of the new frame against the mean of `count`
    share = np.where(past.valid, odds / (1 + odds), 1.0)
    for name in ("light", "prior", "albedo", "normal", "square"):
        expected = (1 - share) * getattr(past.means, name) + share * getattr(now, name)
        np.testing.assert_allclose(getattr(found, name), expected, rtol=1e-5, atol=1e-6)
    number = np.where(past.valid, np.minimum(1 / ((1 - share) ** 2 / count + share**2), most), 1.0)
    np.testing.assert_allclose(found.number, number, rtol=1e-5)


def test_gradients_of_the_means(rng):
    with jax.enable_x64(True):
        now, past = draw_means(rng, (3, 4), count=1.0), draw_past(rng, (3, 4))

        def light(follow):
            found = update_means(now, past, follow, most=1e3)
            return found.light, found.square, found.number

        check_grads(jax.jit(light), (rng.uniform(0.2, 0.8, (3, 4)),), order=1, modes=["rev"])


@pytest.mark.slow
def test_the_light_of_a_still_clip_is_its_arithmetic_mean(rng):
    clip = clip_of(rng, count=4)

    @jax.jit
    def step(state, frame, prior, first):
        frame = prepare(frame)[1]
        now = measure_now(frame, prior)
        means = update_means(now, fetch_past(state, frame, now, first), jnp.full(SIZE, 0.5), most=32.0)
        return means, keep_history(frame, means, means.prior)

    state = jax.jit(lambda frame: start_history(prepare(frame)[1]))(frame_at(clip, 0))
    for index in range(4):
        prior = np.full((3, *SIZE), index, np.float32)
        means, state = step(state, jax.tree.map(jnp.asarray, frame_at(clip, index)), prior, index == 0)
    planes = np.mean(clip.radiance, axis=0, dtype=np.float64).transpose(2, 0, 1)
    np.testing.assert_allclose(means.light, planes, rtol=1e-4)
    np.testing.assert_allclose(means.prior, 1.5, rtol=1e-5)
    np.testing.assert_allclose(means.number, 4.0, rtol=1e-5)


@pytest.mark.slow
def test_another_depth_ends_a_history_and_another_normal_does_not(rng):
    first, second = (jax.tree.map(np.array, frame_at(clip_of(rng), index)) for index in range(2))
    second.depth[:, 30:], second.normal[:20] = 9.0, [1.0, 0, 0]

    @jax.jit
    def fetch(first, second):
        now = measure_now(first, jnp.zeros((3, *SIZE)))
        kept = keep_history(first, now, now.prior)
        return fetch_past(kept, second, measure_now(second, now.prior), False)

    past = fetch(first, second)
    # Beside the new edge the depth has a slope, which widens the tolerance.
    assert np.asarray(past.valid)[:, :29].all()
    assert not np.asarray(past.valid)[:, 31:].any()


def candidates_of(means, prior, last):
    parameters = FilterParameters(jnp.zeros((FEATURES, 16, 20)), jnp.ones((16, 20)))
    precisions = {name: jnp.full(1, -9.0) for name in ("albedo", "normal", "light", "depth", "learned")}
    statistics, _ = jax.jit(prepare)(Frame(jnp.ones((16, 20, 3))))
    found = jax.jit(make_candidates)(precisions, means, prior, last, None, parameters, statistics)
    return dict(zip(CANDIDATES, found, strict=True))


def test_a_correction_is_what_the_samples_have_more_than_the_prior(rng):
    """Where both means differ by a constant, filters that see no difference add just that to the prior."""
    means = jax.tree.map(jnp.float32, draw_means(rng, (16, 20)))
    means = means._replace(light=means.prior + 0.25)
    prior, last = jnp.asarray(rng.uniform(0, 2, (2, 3, 16, 20)), jnp.float32)
    found = candidates_of(means, prior, last)
    np.testing.assert_allclose(found["correction"], prior + 0.25, atol=1e-4)
    np.testing.assert_array_equal(found["prior"], prior)
    np.testing.assert_array_equal(found["last result"], last)
    np.testing.assert_array_equal(found["prior mean"], means.prior)


@pytest.mark.slow
def test_two_priors_are_mixed_by_their_logarithms(rng):
    require("pyoidn")
    clip = clip_of(rng)
    clip = clip._replace(albedo=rng.uniform(0.2, 0.9, clip.albedo.shape).astype(np.float32))
    careful = oidn(auxiliary="prefiltered", guide_quality="fast")
    plain, second = (run(each, {}, clip) for each in (prior_alone(), careful))
    assert np.abs(plain - second).mean() > 1e-3
    gain = gains(clip)
    mean = np.expm1(0.5 * (np.log1p(gain * plain) + np.log1p(gain * second))) / gain
    images = run(combiner(quality="fast", prefilter=True), deciding({"prior": 0.0}), clip)
    np.testing.assert_allclose(images, mean, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_network_that_trusts_the_prior_alone_shows_it(rng):
    require("pyoidn")
    clip = clip_of(rng)
    images = run(fast(), deciding({"prior": 0.0}), clip)
    np.testing.assert_allclose(images, run(prior_alone(), {}, clip), atol=1e-5)


def test_mixtures_are_means_of_logarithms_by_the_logits(rng):
    require("pyoidn")
    clip, denoiser = clip_of(rng), fast()

    def images(logits):
        return run(denoiser, deciding(logits), clip)

    share, gain = 1 / (1 + np.exp(-1.0)), gains(clip)
    mean, prior = (np.log1p(gain * images({name: 0.0})) for name in ("prior mean", "prior"))
    mixed = np.expm1(share * mean + (1 - share) * prior) / gain
    np.testing.assert_allclose(images({"prior mean": 1.0, "prior": 0.0}), mixed, rtol=2e-4, atol=2e-5)


def test_a_network_that_trusts_the_last_result_alone_shows_the_first_one_where_it_is_now(rng):
    """The first result is the prior; with a motion of whole pixels nothing is lost by fetching."""
    require("pyoidn")
    clip = clip_of(rng)
    clip = clip._replace(motion=np.broadcast_to(np.float32([2, 0]), clip.motion.shape))
    images = run(fast(), deciding({"last result": 0.0}), clip)
    priors = run(prior_alone(), {}, clip)
    np.testing.assert_allclose(images[0], priors[0], atol=1e-5)
    np.testing.assert_allclose(images[1][:, 2:-6], priors[0][:, 4:-4], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(images[2][:, 2:-8], priors[0][:, 6:-4], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(images[1][:, -1], priors[1][:, -1], atol=1e-5)  # was outside


def test_a_mixture_of_all_candidates_has_each_of_them(rng):
    """Compiled, of the first frame. XLA once summed the stacked candidates wrongly."""
    require("pyoidn")
    clip, denoiser = clip_of(rng), fast()
    logits = dict(zip(CANDIDATES, rng.normal(size=len(CANDIDATES)), strict=True))
    shares = np.exp(list(logits.values())) / np.sum(np.exp(list(logits.values())))
    gain = gains(clip)[0]
    logarithms = [np.log1p(gain * run(denoiser, deciding({name: 0.0}), clip)[0]) for name in CANDIDATES]
    expected = np.expm1(np.tensordot(shares, logarithms, 1)) / gain
    np.testing.assert_allclose(run(denoiser, deciding(logits), clip)[0], expected, rtol=2e-4, atol=2e-5)
    # And each counts whole: of even light all are that light.
    even = clip._replace(radiance=np.full_like(clip.radiance, 0.5))
    for name in CANDIDATES:
        image = run(denoiser, deciding({name: 0.0}), even)[0]
        np.testing.assert_allclose(np.median(image), 0.5, rtol=0.03, err_msg=name)


def test_light_that_was_not_measured_does_not_spread(rng):
    require("pyoidn")
    clip, denoiser = clip_of(rng), fast()
    params = untrained(1)
    holes = clip.radiance.copy()
    holes[:, 10:12, 10:12] = np.nan
    images = run(denoiser, params, clip._replace(radiance=holes))
    whole = run(denoiser, params, clip)
    assert np.isfinite(images).all()
    np.testing.assert_allclose(images.mean(), whole.mean(), rtol=0.02)


@pytest.mark.slow
def test_every_part_of_the_weights_learns(rng):
    require("pyoidn")
    clip, denoiser = jax.tree.map(jnp.asarray, clip_of(rng)), fast()
    normal = jnp.asarray(rng.normal(size=clip.normal.shape), jnp.float32)
    rough = {"albedo": rng.random(clip.albedo.shape), "depth": rng.uniform(2, 4, clip.depth.shape)}
    clip = clip._replace(normal=normal, **{name: jnp.asarray(each, jnp.float32) for name, each in rough.items()})
    params = untrained(1)
    truth = jnp.mean(clip.radiance, axis=0, keepdims=True)

    @jax.jit
    def loss(params):
        # A scan: the step is compiled once for all frames.
        return jnp.mean((denoise(denoiser, params, Clip(clip, clip.radiance)) - truth) ** 2)

    gradients = jax.grad(loss)(params)
    for path, leaf in jax.tree_util.tree_flatten_with_path(gradients)[0]:
        assert np.isfinite(leaf).all(), path
        assert np.any(np.asarray(leaf) != 0), path


def test_the_first_weights_take_over_what_steady_knows():
    steady = load_weights("steady-balanced")[1]
    params = take_over(steady)
    like = combiner().init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3))))
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, like)
    kernel = np.asarray(params["encoder_0"]["convolution_0"]["kernel"])
    np.testing.assert_array_equal(kernel[:, :, :52], steady["encoder_0"]["convolution_0"]["kernel"])
    assert not kernel[:, :, 52:].any()
    of_blocks = np.reshape(steady["head_0"]["bias"][:28], (7, 4)).mean(1)
    np.testing.assert_allclose(params["head_0"]["bias"], of_blocks, rtol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, params["choice"], like["choice"])
    np.testing.assert_array_equal(params["guide"]["albedo"], steady["guide"]["albedo"][:1])


def enlarge(blocks):
    """[h, w, C] at twice the size, linear between the centres of blocks, in float64."""

    def along(lines):
        centres = np.arange(len(lines)) + 0.5
        return np.stack([np.interp(np.arange(0.25, len(lines), 0.5), centres, line) for line in lines.T], axis=1)

    tall = np.stack([along(column) for column in blocks.transpose(1, 0, 2)], axis=1)
    return np.stack([along(row) for row in tall])


def test_shares_are_those_of_blocks_enlarged(rng):
    """Pixels of a block have none of their own: where candidates differ much, those showed as a grid."""
    logits = rng.normal(0, 2, (5, 8, len(CANDIDATES)))  # padded by a row and two columns
    found = split_shares(jnp.asarray(logits, jnp.float32), (8, 12))
    expected = np.exp(enlarge(logits[:4, :6])).transpose(2, 0, 1)
    np.testing.assert_allclose(found, expected / expected.sum(0), rtol=2e-5)


def test_parameters_of_the_filter_are_those_of_blocks_enlarged(rng):
    """Of features that pixels of a block have each of their own, the filter makes a weave."""
    head = rng.normal(0, 2, (5, 8, FEATURES + len(INITIAL)))
    parameters, follow = split_head(jnp.asarray(head, jnp.float32), (8, 12))
    own = head[:4, :6]
    features = enlarge(own[..., :FEATURES]).transpose(2, 0, 1)
    np.testing.assert_allclose(parameters.features, features, rtol=1e-5, atol=1e-6)
    trust = 1.0 / (1.0 + np.exp(-enlarge(own[..., FEATURES : FEATURES + 1])[..., 0]))
    np.testing.assert_allclose(parameters.trust, trust, rtol=1e-5)
    shares = enlarge(1.0 / (1.0 + np.exp(-own[..., FEATURES + 1 :])))[..., 0]
    np.testing.assert_allclose(follow, shares, rtol=1e-5)


def evidence_of(rng, candidates, noisy, gain=1.0):
    """The maps of slopes and errors [windows, candidates but the prior, h, w], of an area without borders."""
    size = noisy.shape[1:]
    groups = jax.jit(assemble_evidence)(
        [jnp.asarray(each, jnp.float32) for each in candidates],
        jnp.asarray(noisy, jnp.float32),
        *jnp.asarray(rng.random((2, 3, *size)), jnp.float32),
        jnp.ones(size),
        jnp.float32(gain),
    )
    assert tuple(group.shape[-1] for group in groups) == count_inputs()
    maps = np.asarray(groups[1], np.float64)[: size[0] // 2, : size[1] // 2, :-1]
    return maps.reshape(*maps.shape[:2], len(candidates) - 1, len(RADII), 2).transpose(4, 3, 2, 0, 1)


def test_the_slope_tells_which_candidate_the_light_is_of(rng):
    """Noisy light around the second candidate: 1 for that, the share of its part for others, 0 for what is no part."""
    size = 64, 64
    prior = np.full((3, *size), 0.8)
    waves = 0.1 * rng.choice([-1.0, 1.0], (2, 3, *size))
    candidates = [prior, prior + waves[0], prior + 2 * waves[0], prior + waves[1]]
    noisy = prior + waves[0] + rng.normal(0, 0.05, (3, *size))
    slopes, errors = evidence_of(rng, candidates, noisy)[:, -1, :, 8:-8, 8:-8]  # windows of 14 x 14 pixels
    np.testing.assert_allclose(slopes[0].mean(), 1.0, atol=0.02)
    np.testing.assert_allclose(slopes[1].mean(), 0.5, atol=0.02)
    np.testing.assert_allclose(slopes[2].mean(), 0.0, atol=0.06)  # four standard errors of ten windows apart
    # Of the other wave, all that varies is noise: the slope's scatter is what its error says.
    np.testing.assert_allclose(np.std(slopes[2]), errors[2].mean(), rtol=0.3)
    alike, _ = evidence_of(rng, [prior] * len(CANDIDATES), noisy)[:, -1]
    assert not alike.any()


def test_the_slope_is_that_of_an_independent_computation(rng):
    size, gain = (48, 64), 0.7
    candidates = rng.uniform(0.2, 1.2, (len(CANDIDATES), 3, *size))
    noisy = rng.exponential(1.0, (3, *size))
    slopes, _ = evidence_of(rng, candidates, noisy, gain)[:, 0]
    weight = gain / (1 + gain * candidates[0]) ** 2
    most = 3 * weight * (candidates[0] + 0.2 / gain)
    residual = np.clip(weight * (noisy - candidates[0]), -most, most)
    rows, columns = slice(2 * 10 - 2, 2 * 10 + 4), slice(2 * 7 - 2, 2 * 7 + 4)  # 3x3 blocks around that of (10, 7)
    for index, candidate in enumerate(candidates[1:]):
        difference = np.clip(weight * (candidate - candidates[0]), -most, most)[:, rows, columns]
        own = np.sum(difference**2) / 4 + 9e-5
        expected = np.sum(difference * residual[:, rows, columns]) / 4 / own
        np.testing.assert_allclose(slopes[index, 10, 7], np.clip(expected, -1, 2), rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_gradients_of_the_evidence(rng):
    with jax.enable_x64(True):
        candidates = jnp.asarray(rng.uniform(0.3, 1.0, (len(CANDIDATES), 3, 16, 16)))
        noisy, guides = jnp.asarray(rng.uniform(0.3, 1.0, (3, 16, 16))), jnp.asarray(rng.random((2, 3, 16, 16)))

        def groups(candidates):
            return assemble_evidence(list(candidates), noisy, *guides, jnp.ones((16, 16)), jnp.asarray(1.0))

        check_grads(jax.jit(groups), (candidates,), order=1, modes=["rev"], atol=1e-3, rtol=1e-3)


def test_weights_are_saved_and_loaded(tmp_path, rng):
    params = untrained()
    path = save_weights(tmp_path / "w", params, factory="combiner", options={"quality": "fast"}, record={})
    loaded = load_weights(path)[1]
    jax.tree.map(np.testing.assert_array_equal, loaded, params)


@pytest.mark.parametrize("given", [{"quality": "low"}, {"history_max": 0}, {"device": "tpu"}])
def test_unknown_settings_are_refused(given):
    with pytest.raises(ValueError, match=next(iter(given))):
        combiner(**given)
