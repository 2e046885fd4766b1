"""Kernel application and scale composition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn.ops import scales
from jaxdn.ops.kernel_prediction import apply, softmax
from tests.gradients import check_gradients

# One program each, and not one for each of their operations.
apply_kernels = jax.jit(apply.apply_kernels)
normalize_kernels = jax.jit(apply.normalize_kernels)
softmax_filter = jax.jit(softmax.softmax_filter, static_argnames=("taps", "implementation"))
compose_scales = jax.jit(scales.compose_scales, static_argnames=("down", "up"))
downsample = jax.jit(scales.downsample, static_argnames="down")
upsample = jax.jit(scales.upsample, static_argnames="up")
fill_holes = jax.jit(scales.fill_holes)
SCALES = [(down, up) for down in ("mean", "max") for up in ("bilinear", "nearest")]


@given(seed=st.integers(0, 2**16), scale=st.sampled_from([0.0, 1.0, 1e4]), taps=st.sampled_from([1, 9, 25]))
def test_normalized_kernels_pass_a_constant_image_border_included(seed, scale, taps):
    logits = np.random.default_rng(seed).standard_normal((5, 7, taps)).astype(np.float32) * scale
    kernels = normalize_kernels(logits)
    np.testing.assert_allclose(np.sum(kernels, axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(apply_kernels(np.full((5, 7, 3), 3.0, np.float32), kernels), 3, rtol=1e-6)


def test_normalized_kernels_of_half_precision_sum_to_one(rng):
    kernels = normalize_kernels(jnp.asarray(rng.standard_normal((4, 4, 25)), jnp.bfloat16))
    assert kernels.dtype == jnp.float32
    np.testing.assert_allclose(np.sum(kernels, axis=-1), 1, rtol=1e-6)


def test_softmax_filter_is_normalizing_and_applying(rng):
    images, head = rng.random((2, 6, 5, 3)).astype(np.float32), rng.standard_normal((6, 5, 51)).astype(np.float32)
    own = [head[..., :25], head[..., 25:50]]
    expected = [apply_kernels(image, normalize_kernels(logits)) for image, logits in zip(images, own, strict=True)]
    np.testing.assert_allclose(softmax_filter(images, head), expected, rtol=1e-6)


@pytest.mark.parametrize("implementation", ["reference", "row_tiles"])
@pytest.mark.parametrize("size", [(4, 3), (1, 1), (1, 6)])
@pytest.mark.usefixtures("x64")
def test_gradients_of_guided_kernels(size, implementation, rng):
    images, logits, features = (
        jnp.asarray(rng.standard_normal(shape)) for shape in ((2, *size, 2), (*size, 19), (*size, 3))
    )

    def filtered(images, logits, features):
        filtered = softmax_filter(images, logits, features=features, taps=9, implementation=implementation)
        return jnp.tanh(filtered)

    check_gradients(filtered, (images, logits, features))


@pytest.mark.parametrize("implementation", ["reference", "row_tiles"])
def test_constant_features_change_nothing(implementation, rng):
    images, logits = rng.random((2, 6, 5, 3)).astype(np.float32), rng.standard_normal((6, 5, 51)).astype(np.float32)
    run = jax.jit(softmax_filter, static_argnames="implementation")
    guided = run(images, logits, features=jnp.full((6, 5, 7), 1e4), implementation=implementation)
    np.testing.assert_allclose(guided, run(images, logits, implementation=implementation), rtol=1e-6)


@pytest.mark.parametrize("implementation", ["reference", "row_tiles"])
@pytest.mark.parametrize("step", [4.0, 20.0, 1e4, 1e25])
def test_no_light_crosses_a_step_of_the_features(step, implementation, rng):
    """An image of 1 on one side and 0 on the other: what crosses is the sum of the weights across the edge."""
    side = (np.arange(8) >= 3).astype(np.float32)[None, :, None]
    image = np.broadcast_to(side, (6, 8, 3))[None]
    logits, features = rng.standard_normal((6, 8, 25)).astype(np.float32), step * np.broadcast_to(side, (6, 8, 2))

    @jax.jit
    def crossing(logits, features):
        filtered = softmax_filter(image, logits, features=features, implementation=implementation)
        return jnp.max(jnp.abs(filtered - image))

    assert crossing(logits, jnp.zeros_like(features)) > 0.1
    assert crossing(logits, features) < 1e-6
    slopes = jax.jit(jax.grad(crossing, (0, 1)))(logits, jnp.asarray(features))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


@pytest.mark.parametrize("implementation", ["reference", "row_tiles"])
def test_large_features_keep_their_small_differences(implementation, rng):
    """Features around 20 differ by 0.1: the weights are those of the differences alone."""
    images, logits = rng.random((1, 6, 5, 3)).astype(np.float32), rng.standard_normal((6, 5, 25)).astype(np.float32)
    small = (rng.integers(0, 8, (6, 5, 3)) / 64).astype(np.float32)
    near, far = (
        softmax_filter(images, logits, features=each, implementation=implementation) for each in (small, 20 + small)
    )
    np.testing.assert_allclose(far, near, rtol=1e-5)


def test_features_of_another_size_raise():
    with pytest.raises(ValueError, match="logits and features: expected the same size"):
        softmax_filter(jnp.zeros((1, 6, 5, 3)), jnp.zeros((6, 5, 25)), features=jnp.zeros((5, 6, 7)))


@pytest.mark.parametrize(
    ("images", "logits", "taps", "message"),
    [
        ((2, 6, 5, 3), (6, 5, 49), 25, "2 x 25 channels"),
        ((6, 5, 3), (6, 5, 25), 25, r"\[n, 6, 5, C\]"),
        ((1, 6, 5, 3), (6, 5, 25), 24, "K odd"),
    ],
)
def test_softmax_filter_names_wrong_shapes(images, logits, taps, message):
    with pytest.raises(ValueError, match=message):
        softmax_filter(np.zeros(images), np.zeros(logits), taps=taps)


@pytest.mark.parametrize("tap", [0, 7, 12, 24])
def test_one_tap_is_a_shift_with_repeated_edges(tap, rng):
    image = rng.random((5, 7, 3)).astype(np.float32)
    row, column = divmod(tap, 5)
    expected = np.pad(image, ((2, 2), (2, 2), (0, 0)), mode="edge")[row : row + 5, column : column + 7]
    kernels = np.broadcast_to(np.eye(25, dtype=np.float32)[tap], (5, 7, 25))
    np.testing.assert_array_equal(apply_kernels(image, kernels), expected)


@pytest.mark.usefixtures("x64")
def test_gradients_of_kernel_application(rng):
    image, logits = jnp.asarray(rng.random((4, 3, 2))), jnp.asarray(rng.standard_normal((4, 3, 9)))

    def filtered(image, logits):
        def again(image, _):
            return jnp.tanh(apply_kernels(image, normalize_kernels(logits))), None

        return jax.lax.scan(again, image, length=2)[0]

    check_gradients(filtered, (image, logits))


def test_bilinear_upsampling_is_a_resize(rng):
    for size in [(4, 3), (1, 1), (1, 5)]:
        image = rng.random((*size, 2)).astype(np.float32)
        expected = jax.image.resize(image, (2 * size[0], 2 * size[1], 2), "bilinear")
        np.testing.assert_allclose(upsample(image), expected, rtol=1e-6)
    np.testing.assert_array_equal(upsample(image, up="nearest"), np.repeat(np.repeat(image, 2, 0), 2, 1))


def test_downsampling_takes_blocks(rng):
    image = rng.random((4, 6, 2)).astype(np.float32)
    blocks = image.reshape(2, 2, 3, 2, 2)
    np.testing.assert_allclose(downsample(image), blocks.mean((1, 3)), rtol=1e-6)
    np.testing.assert_array_equal(downsample(image, down="max"), blocks.max((1, 3)))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("down", "up"), SCALES)
@pytest.mark.parametrize("alpha_size", [(4, 6), (2, 3)])
def test_composition_is_the_formula(down, up, alpha_size, rng):
    fine, coarse, alpha = rng.random((4, 6, 2)), rng.random((2, 3, 2)), rng.random((*alpha_size, 1))
    blocks = fine.reshape(2, 2, 3, 2, 2)
    small = blocks.mean((1, 3)) if down == "mean" else blocks.max((1, 3))

    def larger(image):
        if up == "nearest":
            return np.repeat(np.repeat(image, 2, 0), 2, 1)
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
        out = np.empty((4, 6, 2))
        for row in range(4):
            for column in range(6):
                y, x = (row + 0.5) / 2 + 0.5, (column + 0.5) / 2 + 0.5  # half-pixel centres, one pixel of padding
                i, j = int(y), int(x)
                fy, fx = y - i, x - j
                upper = (1 - fx) * padded[i, j] + fx * padded[i, j + 1]
                lower = (1 - fx) * padded[i + 1, j] + fx * padded[i + 1, j + 1]
                out[row, column] = (1 - fy) * upper + fy * lower
        return out

    if alpha_size == (2, 3):
        expected = fine - larger(alpha * small) + larger(alpha * coarse)
    else:
        expected = fine - alpha * larger(small) + alpha * larger(coarse)
    out = compose_scales(fine, coarse, alpha, down=down, up=up)
    np.testing.assert_allclose(out, expected, atol=1e-12)
    check_gradients(
        lambda *arrays: jnp.sin(compose_scales(*arrays, down=down, up=up)),
        tuple(map(jnp.asarray, (fine, coarse, alpha))),
    )


def test_composition_of_constants_is_constant():
    for alpha in (jnp.full((4, 6, 1), 0.3), jnp.full((2, 3, 1), 0.3)):
        out = compose_scales(jnp.full((4, 6, 3), 2.0), jnp.full((2, 3, 3), 2.0), alpha)
        np.testing.assert_allclose(out, 2, rtol=1e-6)


def test_errors_say_what_to_do():
    image = jnp.zeros((4, 6, 3))
    with pytest.raises(ValueError, match=r"K odd.*24"):
        apply_kernels(image, jnp.zeros((4, 6, 24)))
    with pytest.raises(ValueError, match=r"K odd.*16"):
        apply_kernels(image, jnp.zeros((4, 6, 16)))
    with pytest.raises(ValueError, match="multiple of 16"):
        downsample(image[:3])
    with pytest.raises(ValueError, match="multiple of 16"):
        compose_scales(image[:3], image[:2, :3], image[:3, :, :1])
    with pytest.raises(ValueError, match="half of fine"):
        compose_scales(image, image, image[..., :1])
    with pytest.raises(ValueError, match=r"alpha.*\(4, 6\) or \(2, 3\), got \(3, 6\)"):
        compose_scales(image, image[:2, :3], image[:3, :, :1])


def test_fill_takes_the_mean_of_known_neighbours(rng: np.random.Generator) -> None:
    image = rng.random((8, 12, 3)).astype(np.float32)
    known = rng.random((8, 12, 1)) < 0.3
    known[:4, :4] = False  # a block without any
    known[4:6, 4:6] = False
    known[6, 4] = True  # known only in the 4x4 block
    found = np.asarray(fill_holes(np.where(known, image, np.nan), known))
    for y, x in np.ndindex(8, 12):
        if known[y, x, 0]:
            expected = image[y, x]
        else:
            means = []
            for size in (2, 4):
                block = np.s_[y // size * size : y // size * size + size, x // size * size : x // size * size + size]
                inside = known[block][..., 0]
                means += [image[block][inside].astype(np.float64).mean(0)] if inside.any() else []
            expected = means[0] if means else 0.0
        np.testing.assert_allclose(found[y, x], expected, rtol=1e-5)
    slope = jax.jit(jax.grad(lambda x: jnp.sum(fill_holes(x, known) ** 2)))(jnp.asarray(image))
    np.testing.assert_array_equal(np.where(known, 0, slope), 0)  # what is not known has no say
    with pytest.raises(ValueError, match="multiples of 4"):
        fill_holes(np.zeros((6, 8, 3), np.float32), np.ones((6, 8, 1), bool))
