"""One shared test for every implementation of every operation, against float64 NumPy references."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn.networks.unet  # noqa: F401  (registers the networks' implementations)
from jaxdn.ops.convolution.api import convolve
from jaxdn.ops.dispatch.operation import OPERATIONS
from jaxdn.ops.kernel_prediction.apply import apply_kernels
from jaxdn.ops.kernel_prediction.softmax import softmax_filter
from jaxdn.ops.warp import warp

SIZES = [(6, 7), (1, 1), (1, 9)]


def numpy_warp(image, motion, border):
    """Every tap of every pixel in a loop."""
    height, width, channels = image.shape
    out = np.zeros((height, width, channels))
    for row in range(height):
        for column in range(width):
            if not np.all(np.isfinite(motion[row, column])):
                continue
            x, y = column + motion[row, column, 0], row + motion[row, column, 1]
            if border == "clamp":
                x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
            x, y = min(max(x, -2.0), width + 1.0), min(max(y, -2.0), height + 1.0)
            left, top = int(np.floor(x)), int(np.floor(y))
            for i, weight_y in ((top, 1 - (y - top)), (top + 1, y - top)):
                for j, weight_x in ((left, 1 - (x - left)), (left + 1, x - left)):
                    if 0 <= i < height and 0 <= j < width:
                        out[row, column] += weight_y * weight_x * image[i, j]
    return out


def numpy_apply_kernels(image, kernels):
    height, width, channels = image.shape
    size = int(np.sqrt(kernels.shape[-1]))
    out = np.zeros((height, width, channels))
    for row in range(height):
        for column in range(width):
            for tap in range(size * size):
                i = min(max(row + tap // size - size // 2, 0), height - 1)
                j = min(max(column + tap % size - size // 2, 0), width - 1)
                out[row, column] += kernels[row, column, tap] * image[i, j]
    return out


def numpy_prior(features, taps):
    """The squared distance of every pixel to each of its taps, in loops."""
    height, width, _ = features.shape
    size = int(np.sqrt(taps))
    out = np.zeros((height, width, taps))
    for row in range(height):
        for column in range(width):
            for tap in range(taps):
                i = min(max(row + tap // size - size // 2, 0), height - 1)
                j = min(max(column + tap % size - size // 2, 0), width - 1)
                out[row, column, tap] = np.sum((features[row, column] - features[i, j]) ** 2)
    return out


def numpy_softmax_filter(images, logits, features, taps):
    filtered = []
    prior = 0.0 if features is None else numpy_prior(features, taps)
    for index, image in enumerate(images):
        own = logits[..., index * taps : (index + 1) * taps] - prior
        weights = np.exp(own - own.max(axis=-1, keepdims=True))
        filtered.append(numpy_apply_kernels(image, weights / weights.sum(axis=-1, keepdims=True)))
    return np.stack(filtered)


def numpy_convolution(x, kernel):
    count, height, width, _ = x.shape
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    out = np.zeros((count, height, width, kernel.shape[3]))
    for row in range(height):
        for column in range(width):
            window = padded[:, row : row + 3, column : column + 3]
            out[:, row, column] = np.einsum("nijc,ijco->no", window, kernel)
    return out


def _motion(rng, size):
    motion = rng.uniform(-3, 3, (*size, 2))
    special = [np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0, 1.0, -0.5, 0.5, -1.0]
    spots = rng.integers(0, motion.size, 4)
    motion.reshape(-1)[spots] = rng.choice(special, 4)
    return motion


def _case(op, size, rng):
    """(differentiable arguments, function of them and an implementation, NumPy reference of them)."""
    if op.startswith("warp"):
        border = op.removeprefix("warp_")
        motion = _motion(rng, size)
        return (
            (rng.standard_normal((*size, 3)),),
            lambda implementation, image: warp(
                image, jnp.asarray(motion), border=border, implementation=implementation
            ),
            lambda image: numpy_warp(image, motion, border),
        )
    if op.startswith("apply_kernels"):
        taps = int(op.removeprefix("apply_kernels_"))
        return (
            (rng.standard_normal((*size, 3)), rng.standard_normal((*size, taps))),
            lambda implementation, image, kernels: apply_kernels(image, kernels, implementation=implementation),
            numpy_apply_kernels,
        )
    if op.startswith("softmax_filter"):
        taps, count, spare = map(int, op.removeprefix("softmax_filter_").split("_"))
        return (
            (rng.standard_normal((count, *size, 3)), 3 * rng.standard_normal((*size, count * taps + spare))),
            lambda implementation, images, logits: softmax_filter(
                images, logits, taps=taps, implementation=implementation
            ),
            lambda images, logits: numpy_softmax_filter(images, logits, None, taps),
        )
    if op.startswith("guided_filter"):
        taps, count, spare, channels = map(int, op.removeprefix("guided_filter_").split("_"))
        return (
            (
                rng.standard_normal((count, *size, 3)),
                3 * rng.standard_normal((*size, count * taps + spare)),
                rng.standard_normal((*size, channels)),
            ),
            lambda implementation, images, logits, features: softmax_filter(
                images, logits, features=features, taps=taps, implementation=implementation
            ),
            lambda images, logits, features: numpy_softmax_filter(images, logits, features, taps),
        )
    inputs, outputs = map(int, op.removeprefix("convolve_").split("_"))
    return (
        (rng.standard_normal((2, *size, inputs)), rng.standard_normal((3, 3, inputs, outputs))),
        lambda implementation, x, kernel: convolve(x, kernel, implementation=implementation),
        numpy_convolution,
    )


def _pull_back(function, name):
    """(cotangent, *arguments) -> value and gradients, compiled."""

    def both(cotangent, *arguments):
        out, pull = jax.vjp(lambda *arguments: function(name, *arguments), *arguments)
        return out, pull(cotangent)

    return jax.jit(both)


def runnable(op):
    """The implementations that can run here: backends are extras."""
    return tuple(name for name, one in OPERATIONS[op].implementations.items() if not one.refuses(()))


CASES = [
    (case, name)
    for op, cases in {
        "warp": ("warp_clamp", "warp_zeros"),
        "apply_kernels": ("apply_kernels_1", "apply_kernels_25"),
        "convolve": ("convolve_2_3", "convolve_3_2"),
    }.items()
    for case in cases
    for name, one in OPERATIONS[op].implementations.items()
    if not one.dtypes
]
"""Implementations of every dtype; those of float32 alone are compared in ``test_operations.py``."""


FILTERS = (
    *("softmax_filter_25_1_0", "softmax_filter_9_2_1"),
    *("guided_filter_25_2_1_7", "guided_filter_9_1_0_1", "guided_filter_1_1_0_2"),
)
"""Not linear in their logits, so that their gradient has a test of its own."""
TILED_FILTERS = [
    # The largest takes seconds to trace.
    pytest.param(case, "row_tiles", marks=[pytest.mark.slow] * (case == "guided_filter_25_2_1_7"))
    for case in FILTERS
]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("case", "name"), CASES)
def test_value_and_gradient(case, name, size, rng):
    """Values equal NumPy's; these maps are linear in each argument, so the VJP is checked by the inner product."""
    arguments, function, expected = _case(case, size, rng)
    values = expected(*arguments)
    cotangent = rng.standard_normal(values.shape)
    out, gradients = _pull_back(function, name)(jnp.asarray(cotangent), *map(jnp.asarray, arguments))
    np.testing.assert_allclose(out, values, atol=1e-12)
    for index, gradient in enumerate(gradients):
        direction = rng.standard_normal(arguments[index].shape)
        moved = expected(*(direction if i == index else a for i, a in enumerate(arguments)))
        np.testing.assert_allclose(np.sum(direction * gradient), np.sum(cotangent * moved), rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("case", FILTERS)
def test_filter_and_its_gradient(case, size, rng):
    """Values equal NumPy's, the VJP NumPy's central difference along a direction.

    Of the reference. Rows in tiles are compared with it in ``test_operations.py`` and, in float64, below.
    """
    arguments, function, expected = _case(case, size, rng)
    values = expected(*arguments)
    cotangent = rng.standard_normal(values.shape)
    out, gradients = _pull_back(function, "reference")(jnp.asarray(cotangent), *map(jnp.asarray, arguments))
    np.testing.assert_allclose(out, values, atol=1e-12)
    for index, gradient in enumerate(gradients):
        step = 1e-6 * rng.standard_normal(arguments[index].shape)
        ahead, behind = (
            expected(*(a + sign * step if i == index else a for i, a in enumerate(arguments))) for sign in (1, -1)
        )
        slope = np.sum(cotangent * (ahead - behind)) / 2
        np.testing.assert_allclose(np.sum(step * gradient), slope, rtol=1e-6, atol=1e-13)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("case", "name"), [*CASES, *TILED_FILTERS])
def test_vmap_and_scan_change_nothing(case, name, rng):
    """grad(scan(vmap)) of three examples equals the sum, or the stack, of three gradients."""
    arguments, function, _ = _case(case, (5, 7), rng)
    first = jnp.stack([jnp.asarray(arguments[0]) * scale for scale in (1.0, -0.5, 2.0)])
    rest = tuple(map(jnp.asarray, arguments[1:]))

    def one(first, *rest):
        return jnp.sum(jnp.sin(function(name, first, *rest)))

    def looped(first, *rest):
        def body(total, _):
            return total + jnp.sum(jax.vmap(lambda image: one(image, *rest))(first)), None

        return jax.lax.scan(body, jnp.zeros(()), length=2)[0]

    together = jax.jit(jax.grad(looped, tuple(range(len(arguments)))))(first, *rest)
    single = jax.jit(jax.grad(one, tuple(range(len(arguments)))))
    alone = [single(image, *rest) for image in first]
    np.testing.assert_allclose(together[0], 2 * jnp.stack([gradient[0] for gradient in alone]), atol=1e-10)
    for index in range(1, len(arguments)):
        np.testing.assert_allclose(together[index], 2 * sum(gradient[index] for gradient in alone), atol=1e-10)


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float32])
@pytest.mark.parametrize(("case", "name"), CASES)
def test_keeps_the_dtype(case, name, dtype, rng):
    arguments, function, expected = _case(case, (6, 8), rng)
    rounded = [jnp.asarray(argument, dtype) for argument in arguments]
    values = expected(*(np.asarray(argument, np.float64) for argument in rounded))
    out, gradients = _pull_back(function, name)(jnp.asarray(values, dtype), *rounded)
    assert out.dtype == dtype
    assert all(gradient.dtype == dtype for gradient in gradients)
    np.testing.assert_allclose(np.asarray(out, np.float64), values, atol=40 * float(jnp.finfo(dtype).eps))


@pytest.mark.parametrize("op", ["warp", "apply_kernels", "softmax_filter", "convolve", "unet"])
def test_a_named_implementation_runs_or_raises(op):
    known = OPERATIONS[op]
    assert len(known.implementations) > 1
    assert "reference" in runnable(op)
    # Backends are extras, and one of them needs instructions that not every CPU has.
    assert set(known.implementations) - set(runnable(op)) <= {"onednn", "onnxruntime", "onednn-bfloat16"}
    assert known.automatic()[0].name in runnable(op)
    with pytest.raises(ValueError, match=r"'reference'.*'no such'"):
        known.named("no such")


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("height", [pytest.param(5, marks=pytest.mark.slow), 7, 8])
def test_tiles_of_any_number_of_rows_are_the_whole_image(height, guided, rng, monkeypatch):
    """Two rows a tile: heights that they divide and others, whose last tile computes a row again."""
    monkeypatch.setattr("jaxdn.ops.kernel_prediction.softmax._TILE_LOGITS", 2 * 6 * 51)
    images, logits = rng.standard_normal((2, height, 6, 3)), rng.standard_normal((height, 6, 51))
    features = rng.standard_normal((height, 6, 7)) if guided else None
    cotangent = rng.standard_normal(images.shape)

    def both(implementation):
        def filtered(images, logits, features):
            return softmax_filter(images, logits, features=features, implementation=implementation)

        def value_and_slopes(cotangent, *arguments):
            value, pull = jax.vjp(filtered, *arguments)
            return value, pull(cotangent)

        return jax.jit(value_and_slopes)(cotangent, images, logits, features)

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), both("row_tiles"), both("reference")
    )
