"""Images with any number of samples per pixel from layers of 1, 2, 4, ... samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.sampling import from_layers

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
    layers, image_of = drawn(rng, bits), jax.jit(from_layers)
    for count in range(2**bits):
        counts = np.full((*SIZE, 1), count, np.float32)
        image, taken = image_of(single(layers), counts)
        np.testing.assert_allclose(image, numpy_from_layers(layers, counts), rtol=1e-6)
        np.testing.assert_array_equal(taken, counts)


def test_every_pixel_has_its_own_number(rng):
    layers, counts = drawn(rng, 3), rng.integers(0, 8, (*SIZE, 1)).astype(np.float32)
    assert len(np.unique(counts)) > 4
    image, taken = from_layers(single(layers), jnp.asarray(counts))
    np.testing.assert_allclose(image, numpy_from_layers(layers, counts), rtol=1e-6)
    np.testing.assert_array_equal(taken, counts)
    assert taken.dtype == image.dtype == jnp.float32


@pytest.mark.parametrize(
    ("asked", "had"),
    [
        *((-3.0, 0), (-0.4, 0), (0.4, 0), (0.6, 1), (2.4, 2), (2.6, 3), (6.6, 7)),
        *((7.4, 7), (8.0, 7), (1e30, 7), (np.nan, 0), (-np.inf, 0)),
    ],
)
def test_counts_are_rounded_and_clamped_to_the_available_samples(asked, had, rng):
    layers = drawn(rng, 3)
    image, taken = from_layers(single(layers), jnp.full((*SIZE, 1), asked, jnp.float32))
    np.testing.assert_array_equal(taken, had)
    np.testing.assert_allclose(image, numpy_from_layers(layers, np.full((*SIZE, 1), had)), rtol=1e-6)


def test_no_sample_is_black_and_an_unused_layer_may_be_anything(rng):
    layers = single(drawn(rng, 2))
    layers[2] = jnp.full_like(layers[2], jnp.nan)
    counts = jnp.zeros((*SIZE, 1)).at[1, 1].set(1.0)
    image, _ = from_layers(layers, counts)
    np.testing.assert_array_equal(image, jnp.zeros((*SIZE, 3)).at[1, 1].set(layers[1][1, 1]))
    slopes = jax.grad(lambda layers: jnp.sum(from_layers(layers, counts)[0]))(layers)
    assert all(np.isfinite(slope).all() for slope in slopes.values())


@pytest.mark.parametrize("numbers", [(), (2,), (1, 4), (1, 2, 3), (2, 4), (1, 2, 8), (0, 1)])
def test_layers_with_a_gap_raise(numbers):
    layers = {samples: jnp.zeros((*SIZE, 3)) for samples in numbers}
    with pytest.raises(ValueError, match=r"layers: expected independent layers of 1, 2, 4"):
        from_layers(layers, jnp.ones((*SIZE, 1)))


def test_the_order_of_the_layers_does_not_matter(rng):
    layers, counts = single(drawn(rng, 3)), jnp.asarray(rng.integers(0, 8, (*SIZE, 1)), jnp.float32)
    backwards = dict(reversed(layers.items()))
    np.testing.assert_array_equal(from_layers(backwards, counts)[0], from_layers(layers, counts)[0])


def test_no_gradient_flows_into_the_counts_and_into_layers_their_share(rng):
    layers, counts = single(drawn(rng, 2)), jnp.asarray(rng.integers(0, 4, (*SIZE, 1)), jnp.float32)

    def total(layers, counts):
        image, taken = from_layers(layers, counts)
        return jnp.sum(image) + jnp.sum(taken)

    by_layer, by_count = jax.grad(total, (0, 1))(layers, counts)
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
