"""Maps of samples that keep a budget, and images with any number of samples from layers of 1, 2, 4, ... samples."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.ops import sampling
from jaxdn.ops.sampling import allot_evenly, draw_random_numbers, rotate_pattern, round_stochastically

# One program each, and not one for each of their operations.
from_layers = jax.jit(sampling.from_layers)
sample_map = jax.jit(sampling.sample_map, static_argnames=("budget", "least", "most", "rounding"))
SIZE = (4, 5)


def drawn(rng, bits):
    return {1 << bit: rng.exponential(size=(*SIZE, 3)) for bit in range(bits)}


def numpy_from_layers(layers, counts):
    """Pixel by pixel and binary digit by binary digit, in float64."""
    image = np.zeros((*SIZE, 3))
    for row, column in np.ndindex(SIZE):
        count = int(counts[row, column, 0])
        for samples, layer in layers.items():
            if count // samples % 2:
                image[row, column] += samples * np.asarray(layer[row, column], np.float64)
        image[row, column] /= max(count, 1)
    return image


def single(layers):
    return {samples: jnp.asarray(layer, jnp.float32) for samples, layer in layers.items()}


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_every_number_of_samples_is_the_sum_over_its_bits(bits, rng):
    layers = drawn(rng, bits)
    for count in range(2**bits):
        counts = np.full((*SIZE, 1), count, np.float32)
        image, taken = from_layers(single(layers), counts)
        np.testing.assert_allclose(image, numpy_from_layers(layers, counts), rtol=1e-6)
        np.testing.assert_array_equal(taken, counts)


def test_every_pixel_has_its_own_number(rng):
    layers, counts = drawn(rng, 3), rng.integers(0, 8, (*SIZE, 1)).astype(np.float32)
    assert len(np.unique(counts)) > 4
    image, taken = from_layers(single(layers), jnp.asarray(counts))
    np.testing.assert_allclose(image, numpy_from_layers(layers, counts), rtol=1e-6)
    np.testing.assert_array_equal(taken, counts)
    assert taken.dtype == image.dtype == jnp.float32


def test_layers_in_half_precision_are_added_in_single(rng):
    """They are light as a file has it; their sum over samples is not rounded again."""
    layers = {samples: jnp.asarray(layer, jnp.bfloat16) for samples, layer in drawn(rng, 4).items()}
    counts = rng.integers(0, 16, (*SIZE, 1)).astype(np.float32)
    image, taken = from_layers(layers, counts)
    assert taken.dtype == image.dtype == jnp.float32
    np.testing.assert_allclose(image, numpy_from_layers(layers, counts), rtol=1e-6)
    np.testing.assert_array_equal(taken, counts)


@pytest.mark.parametrize(
    ("asked", "had"),
    [
        *((-3.0, 0), (-0.4, 0), (0.4, 0), (0.6, 1), (2.4, 2), (2.6, 3), (6.6, 7)),
        *((7.4, 7), (8.0, 7), (1e30, 7), (np.nan, 0), (-np.inf, 0)),
    ],
)
def test_counts_are_rounded_and_clamped_to_the_available_samples(asked, had, rng):
    layers = drawn(rng, 3)
    image, taken = from_layers(single(layers), np.full((*SIZE, 1), asked, np.float32))
    np.testing.assert_array_equal(taken, had)
    np.testing.assert_allclose(image, numpy_from_layers(layers, np.full((*SIZE, 1), had)), rtol=1e-6)


def test_no_sample_is_black_and_an_unused_layer_may_be_anything(rng):
    layers = single(drawn(rng, 2))
    layers[2] = jnp.full_like(layers[2], jnp.nan)
    counts = jnp.zeros((*SIZE, 1)).at[1, 1].set(1.0)
    image, _ = from_layers(layers, counts)
    np.testing.assert_array_equal(image, jnp.zeros((*SIZE, 3)).at[1, 1].set(layers[1][1, 1]))
    slopes = jax.jit(jax.grad(lambda layers: jnp.sum(from_layers(layers, counts)[0])))(layers)
    assert all(np.isfinite(slope).all() for slope in slopes.values())


@pytest.mark.parametrize("numbers", [(), (2,), (1, 4), (1, 2, 3), (2, 4), (1, 2, 8), (0, 1)])
def test_layers_with_a_gap_raise(numbers):
    layers = {samples: jnp.zeros((*SIZE, 3)) for samples in numbers}
    with pytest.raises(ValueError, match=r"layers: expected independent layers of 1, 2, 4"):
        from_layers(layers, jnp.ones((*SIZE, 1)))


def test_the_order_of_the_layers_does_not_matter(rng):
    layers, counts = single(drawn(rng, 3)), jnp.asarray(rng.integers(0, 8, (*SIZE, 1)), jnp.float32)
    backwards = dict(reversed(layers.items()))  # which jit would sort
    np.testing.assert_array_equal(sampling.from_layers(backwards, counts)[0], sampling.from_layers(layers, counts)[0])


def test_no_gradient_flows_into_the_counts_and_into_layers_their_share(rng):
    layers, counts = single(drawn(rng, 2)), jnp.asarray(rng.integers(0, 4, (*SIZE, 1)), jnp.float32)

    def total(layers, counts):
        image, taken = from_layers(layers, counts)
        return jnp.sum(image) + jnp.sum(taken)

    by_layer, by_count = jax.jit(jax.grad(total, (0, 1)))(layers, counts)
    np.testing.assert_array_equal(by_count, 0)
    whole = np.asarray(counts).astype(int)
    for samples, slope in by_layer.items():
        share = np.where(whole & samples, samples / np.maximum(whole, 1), 0)
        np.testing.assert_allclose(slope, np.broadcast_to(share, slope.shape), rtol=1e-6)


def test_the_mean_over_many_noise_realisations_is_the_noise_free_image():
    """Layers of n samples have the variance 1 / n; every number of samples then has the variance 1 / number."""
    rng = np.random.default_rng(0)
    shape = (200, 200, 3)
    layers = {n: jnp.asarray(1 + rng.normal(size=shape) / np.sqrt(n), jnp.float32) for n in (1, 2, 4)}
    for count in range(1, 8):
        image, _ = from_layers(layers, jnp.full((*shape[:2], 1), float(count)))
        assert abs(float(np.mean(image)) - 1) < 0.015
        np.testing.assert_allclose(np.var(image), 1 / count, rtol=0.03)


def filled_by_blocks(image, known):
    """The mean of the known pixels of each pixel's block of 2x2, else of 4x4, else 0; the border repeats."""
    wide = [np.pad(each, ((0, -SIZE[0] % 4), (0, -SIZE[1] % 4), (0, 0)), mode="edge") for each in (image, known)]
    found = np.zeros_like(image)
    for row, column in np.ndindex(SIZE):
        for size in (4, 2):
            block = (slice(row // size * size, row // size * size + size),)
            block += (slice(column // size * size, column // size * size + size),)
            there = wide[1][block][..., 0]
            if there.any():
                found[row, column] = wide[0][block][there].mean(0)
    return found


def test_a_further_sample_moves_the_image_towards_the_reference(rng):
    """Against the mean of s samples and one without noise, in float64; half of the counts are clamped to 1."""
    layers = single(drawn(rng, 3))
    reference, weights = (jnp.asarray(rng.normal(size=(*SIZE, 3)), jnp.float32) for _ in range(2))
    counts = jnp.asarray(rng.integers(0, 8, (*SIZE, 1)), jnp.float32)

    def total(counts, reference):
        return jnp.sum(weights * from_layers(layers, counts, reference=reference)[0])

    by_count, by_reference = jax.jit(jax.grad(total, (0, 1)))(counts, reference)
    image = numpy_from_layers(layers, counts)
    image_filled = np.where(counts > 0, image, filled_by_blocks(image, np.asarray(counts) > 0))
    wanted = (weights * (reference - image_filled)).sum(-1, keepdims=True) / np.maximum(counts, 1)
    np.testing.assert_allclose(by_count, wanted, rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(by_reference, 0)
    np.testing.assert_allclose(from_layers(layers, counts, reference=reference)[0], image, rtol=1e-6)


def test_no_samples_have_a_slope_where_the_reference_is_lit_and_none_where_it_is_black():
    layers = {1: jnp.zeros((2, 2, 3))}
    reference = jnp.zeros((2, 2, 3)).at[0].set(2.0)
    slope = jax.jit(jax.grad(lambda counts: jnp.sum(from_layers(layers, counts, reference=reference)[0])))
    slope = slope(jnp.zeros((2, 2, 1)))
    np.testing.assert_allclose(slope[..., 0], [[6.0, 6.0], [0.0, 0.0]])


def test_the_slope_of_no_samples_is_that_of_what_fills_the_pixel():
    """Neighbours of 3 fill it: where the reference is 1, a sample makes it darker, though the image has 0 there."""
    layers = {1: jnp.full((2, 2, 3), 3.0)}
    counts = jnp.ones((2, 2, 1)).at[1, 0].set(0.0)
    image, back = jax.vjp(lambda counts: from_layers(layers, counts, reference=jnp.ones((2, 2, 3)))[0], counts)
    np.testing.assert_array_equal(image[1, 0], 0.0)
    np.testing.assert_allclose(back(jnp.ones((2, 2, 3)))[0], jnp.full((2, 2, 1), -6.0))


def test_stochastic_rounding_has_the_wanted_mean_and_leaves_whole_numbers(rng):
    wanted = rng.uniform(0, 3, (6, 7, 1)).astype(np.float32)
    wanted[0, 0], wanted[0, 1], wanted[0, 2] = 2.0, 2.99999, 0.0
    frames = 4096
    drawn = jax.vmap(lambda frame: round_stochastically(jnp.asarray(wanted), draw_random_numbers(6, 7, frame)))
    counts = np.asarray(jax.jit(drawn)(jnp.arange(frames)))
    assert set(np.unique(counts - np.floor(wanted))) == {0.0, 1.0}
    np.testing.assert_allclose(counts.mean(0), wanted, atol=2e-3)  # from frame to frame they are evenly spread
    assert (counts[:, 0, 0] == 2).all()
    assert (counts[:, 0, 1] == 3).all()
    assert not counts[:, 0, 2].any()


def test_random_numbers_are_even_and_independent_between_pixels():
    numbers = np.asarray(draw_random_numbers(128, 128, 3))[..., 0]
    assert 0 <= numbers.min() < numbers.max() < 1
    np.testing.assert_allclose(np.histogram(numbers, 8, (0, 1))[0], 2048, rtol=0.1)
    for shift in ((0, 1), (1, 0), (1, 1), (4, 0)):
        moved = np.roll(numbers, shift, (0, 1))
        assert abs(np.corrcoef(numbers.ravel(), moved.ravel())[0, 1]) < 0.03
    quarter = np.stack([np.asarray(draw_random_numbers(8, 8, frame)) > 0.75 for frame in range(40)])
    gaps = [np.diff(np.nonzero(quarter[:, y, x, 0])[0]) for y, x in np.ndindex(8, 8)]
    assert max(gap.max() for gap in gaps) <= 5  # no pixel waits for long


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_a_rotating_pattern_comes_to_every_pixel_once(bits):
    """Of 2^-bits samples a pixel: one in every run of 2^bits frames, and equally many pixels in each frame."""
    period = 2**bits
    wanted = np.full((8, 12, 1), 1 / period, np.float32)
    take = jax.jit(jax.vmap(lambda frame: round_stochastically(wanted, rotate_pattern(8, 12, frame))))
    taken = np.asarray(take(np.arange(3 * period)))
    np.testing.assert_array_equal(taken.reshape(3, period, 8, 12).sum(1), 1)
    np.testing.assert_array_equal(taken.sum((1, 2, 3)), 96 / period)


def test_a_rotating_pattern_is_spread_evenly_in_every_frame():
    """Of a quarter, each 2x2 block has one; of a half, no pixel has what its neighbours have."""
    numbers = np.stack([np.asarray(rotate_pattern(8, 12, frame))[..., 0] for frame in (0, 1, 2, 3, 1000003)])
    assert 0 <= numbers.min() < numbers.max() < 1
    blocks = (numbers < 0.25).reshape(-1, 4, 2, 6, 2).sum((2, 4))
    np.testing.assert_array_equal(blocks, 1)
    half = numbers < 0.5
    assert (half[:, 1:] != half[:, :-1]).all()
    assert (half[:, :, 1:] != half[:, :, :-1]).all()
    # Sixteen thresholds, each in every 4x4 block.
    assert sorted(np.floor(16 * numbers[0, :4, 4:8].ravel())) == list(range(16))


@pytest.mark.parametrize("budget", [0.004, 0.05, 0.1, 0.2, 1 / 3, 0.7, 2.3])
def test_even_samples_are_any_budget_in_the_mean_of_every_frame(budget):
    means = [float(jnp.mean(allot_evenly(budget, 90, 160, index))) for index in (0, 1, 2, 3, 17, 100)]
    np.testing.assert_allclose(means, budget, atol=0.003)


@pytest.mark.parametrize("budget", [0.25, 0.5, 1.0, 2.5, 4.0])
def test_even_samples_are_the_budget_in_the_mean_and_within_one_of_it(budget):
    frames = np.stack([np.asarray(allot_evenly(budget, 8, 12, index)) for index in range(4)])
    np.testing.assert_allclose(frames.mean((1, 2, 3)), budget)
    np.testing.assert_allclose(frames.mean(0), budget)  # each pixel, over four frames
    assert set(np.unique(frames)) == {np.floor(budget), np.ceil(budget)}


def test_the_map_with_fractions_keeps_a_budget_below_one_sample(rng):
    logits = jnp.asarray(2 * rng.normal(size=(16, 24, 1)), jnp.float32)
    for budget in (0.25, 0.5, 1.0):
        wanted = np.asarray(sample_map(logits, budget, most=7, rounding="stochastic"))
        np.testing.assert_allclose(wanted.mean(), budget, rtol=1e-3)
        assert np.any(wanted % 1 > 0.01)
        frames = jnp.arange(256)
        counts = jax.vmap(lambda frame, wanted=wanted: round_stochastically(wanted, draw_random_numbers(16, 24, frame)))
        np.testing.assert_allclose(np.mean(jax.jit(counts)(frames)), budget, rtol=0.01)


def loss_of_image(image, target):
    """Quadratic in every pixel, and mixed between neighbours as a filter does."""
    mixed = image + 0.5 * jnp.roll(image, 1, 0) - 0.25 * jnp.roll(image, 1, 1)
    return jnp.sum((mixed - target) ** 2)


def test_the_gradient_of_rounded_samples_is_that_of_the_mean_loss(rng):
    """Monte Carlo over the random numbers, against the mean loss by enumeration of every pixel's two numbers."""
    layers, target = single(drawn(rng, 2)), jnp.asarray(rng.normal(size=(*SIZE, 3)), jnp.float32)
    wanted = np.full((*SIZE, 1), 2.0, np.float32)
    places = [(0, 0), (0, 1), (2, 3), (3, 4)]
    for place, number in zip(places, (1.3, 1.75, 2.5, 1.1), strict=True):
        wanted[place] = number

    def loss(counts, uniform):
        return loss_of_image(from_layers(layers, counts, reference=target, uniform=uniform)[0], target)

    @jax.jit
    def loss_of_whole(counts):
        return loss_of_image(from_layers(layers, counts)[0], target)

    def mean_loss(counts):
        """Over the sixteen combinations, each with its probability."""
        total = 0.0
        for ups in np.ndindex(2, 2, 2, 2):
            whole, probability = np.array(counts), 1.0
            for place, up in zip(places, ups, strict=True):
                share = float(counts[place][0]) % 1
                whole[place] = np.floor(counts[place]) + up
                probability *= share if up else 1 - share
            total += probability * float(loss_of_whole(whole))
        return total

    numbers = jnp.asarray(np.random.default_rng(1).random((20000, *SIZE, 1)), jnp.float32)
    slope = jax.jit(jax.vmap(jax.grad(loss), in_axes=(None, 0)))
    slopes = np.asarray(slope(jnp.asarray(wanted), numbers), np.float64)
    for place in places:
        low, high = wanted.copy(), wanted.copy()
        low[place] -= 0.05
        high[place] += 0.05
        exact = (mean_loss(high) - mean_loss(low)) / 0.1  # the mean loss is linear in each number
        found, error = slopes[(slice(None), *place, 0)].mean(), slopes[(slice(None), *place, 0)].std() / 20000**0.5
        assert abs(found - exact) < 5 * error + 0.01 * abs(exact)
        assert error < 0.1 * abs(exact) + 0.05


def test_the_gradient_below_one_sample_compares_a_sample_with_what_fills_the_pixel(rng):
    """Whichever of both was drawn: 2 P times the slope is the same, and its mean is the difference of both images."""
    layers = {1: jnp.asarray(rng.random((4, 4, 3)), jnp.float32)}
    counts = jnp.ones((4, 4, 1)).at[1, 2].set(0.3)
    filled = np.asarray([layers[1][0, 2], layers[1][0, 3], layers[1][1, 3]]).mean(0)
    weights = jnp.asarray(rng.normal(size=(4, 4, 3)), jnp.float32)
    found = []
    for uniform, probability in ((0.1, 0.3), (0.9, 0.7)):

        def total(counts, uniform=uniform):
            given = {"reference": layers[1], "uniform": jnp.full((4, 4, 1), uniform)}
            return jnp.sum(weights * from_layers(layers, counts, **given)[0])

        found.append(2 * probability * jax.jit(jax.grad(total))(counts)[1, 2, 0])
    expected = np.sum(np.asarray(weights)[1, 2] * (np.asarray(layers[1])[1, 2] - filled))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)


def test_even_logits_give_every_pixel_the_budget():
    for value in (0.0, -50.0, 1e30):
        np.testing.assert_array_equal(sample_map(np.full((7, 9, 1), value, np.float32), 4, most=63), 4)


@pytest.mark.slow
@hypothesis.given(
    st.integers(0, 2**32 - 1), st.floats(0.3, 6), st.sampled_from([0.0, 1.0, 30.0, 1e4]), st.sampled_from([0, 1])
)
def test_the_budget_is_kept_exactly(seed, budget, spread, least):
    budget = max(budget, least)
    logits = spread * np.random.default_rng(seed).normal(size=(11, 13, 1)).astype(np.float32)
    # Operation by operation: each of them is compiled once, and the whole would be anew for every budget.
    counts = np.asarray(sampling.sample_map(jnp.asarray(logits), budget, least=least, most=7))
    assert counts.sum() == round(143 * budget)
    assert counts.min() >= least
    assert counts.max() <= 7
    np.testing.assert_array_equal(counts, np.round(counts))
    inside = (counts > least) & (counts < 7)
    more = np.argsort(logits[inside])
    assert np.all(np.diff(counts[inside][more]) >= -1)  # in the order of the logits, but for rounding


@pytest.mark.slow
def test_a_whole_frame_keeps_the_budget_exactly(rng):
    """Whose sum float32 no longer counts one by one."""
    logits = jnp.asarray(2 * rng.normal(size=(1080, 1920, 1)), jnp.float32)
    counts = np.asarray(sample_map(logits, 16, most=63), np.float64)
    assert counts.sum() == 16 * 1080 * 1920


def test_numbers_are_the_largest_remainders(rng):
    logits = rng.normal(size=(5, 6, 1))
    shares = 30 * 2.5 * np.exp(logits) / np.exp(logits).sum()
    assert shares.max() < 63
    wanted = np.floor(shares)
    largest = np.argsort(-(shares - wanted).ravel())[: 75 - int(wanted.sum())]
    wanted.ravel()[largest] += 1
    np.testing.assert_array_equal(sample_map(jnp.asarray(logits, jnp.float32), 2.5, most=63), wanted)
    paper = sample_map(jnp.asarray(logits, jnp.float32), 2.5, most=63, rounding="nearest")
    np.testing.assert_array_equal(paper, np.round(shares))


def test_every_pixel_has_a_fraction_before_the_rest_is_placed(rng):
    with jax.enable_x64(True):
        logits = jnp.asarray(3 * rng.normal(size=(6, 7, 1)))
        counts = sample_map(logits, 0.5, least=0.2, most=63, rounding="stochastic")
        shares = np.exp(logits) / np.exp(logits).sum()
        np.testing.assert_allclose(counts, 0.2 + 42 * 0.3 * shares, rtol=1e-6)
        # Those that have hardly more than the fraction can still get more.
        slope = jax.jit(jax.grad(lambda x: sample_map(x, 0.5, least=0.2, most=63, rounding="stochastic").ravel()[0]))
        first = shares.ravel()[0]
        np.testing.assert_allclose(slope(logits).ravel()[0], 42 * 0.3 * first * (1 - first), rtol=1e-6)
    even = sample_map(jnp.asarray(rng.normal(size=(4, 5, 1))), 0.2, least=0.2, most=63, rounding="stochastic")
    np.testing.assert_allclose(even, 0.2, rtol=1e-6)


@pytest.mark.parametrize("rounding", ["exact", "nearest"])
def test_a_fraction_for_every_pixel_needs_fractions(rounding):
    with pytest.raises(ValueError, match=r"least: expected a whole number .* rounding 'stochastic', got 0\.2"):
        sample_map(jnp.zeros((4, 4, 1)), 1, least=0.2, most=7, rounding=rounding)


def test_one_huge_logit_takes_what_a_pixel_can_have_and_a_nan_counts_as_zero():
    logits = jnp.zeros((4, 5, 1)).at[1, 2].set(1e6)
    counts = sample_map(logits, 4, most=63)
    assert counts[1, 2, 0] == 63
    assert jnp.sum(counts) == 80
    assert sample_map(logits, 4, most=63, rounding="nearest")[1, 2, 0] == 63
    bad = jnp.zeros((4, 5, 1)).at[0, 0].set(jnp.nan).at[3, 3].set(jnp.inf)
    np.testing.assert_array_equal(sample_map(bad, 4, most=63), 4)


def test_the_gradient_is_that_of_the_softmax_and_sums_to_zero(rng):
    with jax.enable_x64(True):
        logits, weights = (jnp.asarray(rng.normal(size=(4, 5, 1))) for _ in range(2))
        slope = jax.jit(jax.grad(lambda logits: jnp.sum(weights * sample_map(logits, 4, most=63))))(logits)
        smooth = jax.grad(lambda logits: jnp.sum(weights * 80 * jax.nn.softmax(logits.ravel()).reshape(4, 5, 1)))
        smooth = jax.jit(smooth)
        np.testing.assert_allclose(slope, smooth(logits), rtol=1e-6)
        assert abs(float(jnp.sum(slope))) < 1e-9
        clamped = logits.at[0, 0].set(10.0)
        steep = jax.jit(jax.grad(lambda logits: sample_map(logits, 4, most=20)[0, 0, 0]))(clamped)
        np.testing.assert_array_equal(steep, 0)


@pytest.mark.parametrize("budget", [0, -1, 8, 0.5, float("nan")])
def test_a_budget_that_no_map_can_keep_raises(budget):
    with pytest.raises(ValueError, match=r"budget: expected a mean number of samples above 0 from 1 to 7"):
        sample_map(jnp.zeros((4, 4, 1)), budget, least=1, most=7)
