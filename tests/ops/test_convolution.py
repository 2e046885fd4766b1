"""The convolution and its hand-written gradient."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxdn.ops.convolution.api import convolve
from jaxdn.ops.onednn import library

needs_onednn = pytest.mark.needs("onednn")


def _operands(inputs, outputs, size=(5, 6), count=2, dtype=jnp.float32):
    rng = np.random.default_rng(inputs * 10 + outputs)
    x = jnp.asarray(rng.standard_normal((count, *size, inputs)), dtype)
    return x, jnp.asarray(rng.standard_normal((3, 3, inputs, outputs)), dtype)


@pytest.mark.parametrize(("inputs", "outputs"), [(2, 3), (3, 2), (2, 2)])
@pytest.mark.parametrize("size", [(5, 6), (1, 4)])
def test_gradient_is_that_of_the_function(inputs, outputs, size):
    with jax.enable_x64(True):
        x, kernel = _operands(inputs, outputs, size, dtype=jnp.float64)
        convolved = jax.jit(lambda x, k: convolve(x, k, implementation="blocked"))
        check_grads(convolved, (x, kernel), order=2, modes=["fwd", "rev"])


@pytest.mark.parametrize("implementation", ["blocked", pytest.param("onednn", marks=needs_onednn)])
def test_the_kernels_gradient_is_one_product_for_all_clips(implementation):
    """Not one for each clip, which are added up afterwards."""
    clips, kernel = jnp.ones((5, 3, 2, 6, 7, 4)), jnp.ones((3, 3, 4, 3))

    def loss(kernel):
        def one(clip):
            step = jax.checkpoint(lambda state, x: (state, convolve(x, kernel, implementation=implementation).sum()))
            return jax.lax.scan(step, 0.0, clip)[1].sum()

        return jax.vmap(one)(clips).sum()

    program = str(jax.make_jaxpr(jax.grad(loss))(kernel))
    gradients = [line for line in program.splitlines() if f"{implementation}_kernel_gradient" in line]
    assert len(gradients) == 1
    assert program.count("scan[") == 2, "of frames, forwards and backwards, and none of clips"


@pytest.mark.parametrize(("inputs", "outputs"), [(2, 3), (3, 2)])
def test_training_form_agrees_with_automatic_gradient(inputs, outputs):
    """grad(loss(scan(checkpoint(vmap(step))))) with one image per example, against jax's own convolution gradient."""
    with jax.enable_x64(True):
        frames, kernel = _operands(inputs, outputs, count=6, dtype=jnp.float64)
        frames = frames.reshape(3, 2, *frames.shape[1:])

        def gradient(implementation):
            def step(state, x):
                state = jnp.tanh(0.5 * state + convolve(x[None], kernel_, implementation=implementation)[0])
                return state, jnp.sum(state**2)

            def loss(k, frames):
                nonlocal kernel_
                kernel_ = k
                state = jnp.zeros((*frames.shape[1:4], outputs))
                return jnp.sum(jax.lax.scan(jax.checkpoint(jax.vmap(step)), state, frames)[1])

            kernel_ = kernel
            return jax.jit(jax.grad(loss, (0, 1)))(kernel, frames)

        for ours, theirs in zip(gradient("blocked"), gradient("reference"), strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("size", [(5, 6), (64, 128)], ids=["one block", "several"])
def test_products_of_double_precision_are_the_convolution(size):
    with jax.enable_x64(True):
        x, kernel = _operands(14, 3, size, dtype=jnp.float64)
        ours, theirs = (convolve(x, kernel, implementation=one) for one in ("blocked", "reference"))
        assert ours.dtype == jnp.float64
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-13 * float(np.abs(theirs).max()))


def test_bfloat16_kernel_gradient_is_summed_in_float32():
    x, kernel = jnp.ones((1, 40, 40, 1), jnp.bfloat16), jnp.zeros((3, 3, 1, 1), jnp.bfloat16)
    gradient = jax.grad(lambda k: jnp.sum(convolve(x, k, implementation="blocked").astype(jnp.float32)))(kernel)
    assert gradient.dtype == jnp.bfloat16
    assert float(gradient[1, 1, 0, 0]) == 1600.0  # a bfloat16 running sum of ones stops at 256


def _all_of(function, implementation):
    """(cotangent, x, kernel) -> value and both gradients, compiled."""

    def run(cotangent, *arguments):
        out, pull = jax.vjp(function(lambda x, k: convolve(x, k, implementation=implementation)), *arguments)
        return out, *pull(cotangent)

    return jax.jit(run)


def _agree(function, cotangent, x, kernel, implementation="onednn"):
    """Value and gradients are the automatic ones to single precision's digits, relative to the largest."""
    got = _all_of(function, implementation)(*(jnp.asarray(array, jnp.float32) for array in (cotangent, x, kernel)))
    with jax.enable_x64(True):
        wanted = _all_of(function, "reference")(*(jnp.asarray(array, jnp.float64) for array in (cotangent, x, kernel)))
    for ours, theirs in zip(got, wanted, strict=True):
        assert ours.dtype == jnp.float32
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=3e-6 * float(np.abs(theirs).max()))


@needs_onednn
@pytest.mark.parametrize("size", [(6, 7), (1, 1), (1, 9), (17, 31)])
@pytest.mark.parametrize(("count", "inputs", "outputs"), [(1, 14, 32), (3, 32, 51), (2, 3, 2)])
def test_onednn_in_single_precision(size, count, inputs, outputs):
    """The shared contract test computes in double precision, which oneDNN does not."""
    rng = np.random.default_rng(inputs)
    x, cotangent = (rng.standard_normal((count, *size, channels)) for channels in (inputs, outputs))
    _agree(lambda convolve: convolve, cotangent, x, rng.standard_normal((3, 3, inputs, outputs)))


@pytest.mark.parametrize("implementation", ["blocked", pytest.param("onednn", marks=needs_onednn)])
@pytest.mark.parametrize(
    ("batch", "over_images", "over_kernels"),
    [
        (lambda f: jax.vmap(f, (0, None)), (3,), ()),
        (lambda f: jax.vmap(f, (None, 0)), (), (3,)),
        (jax.vmap, (3,), (3,)),
        (lambda f: jax.vmap(jax.vmap(f, (None, 0)), (0, None)), (3,), (4,)),
        (lambda f: jax.vmap(jax.vmap(f, (0, None)), (None, 0)), (3,), (4,)),
    ],
)
def test_under_vmap(batch, over_images, over_kernels, implementation):
    """Of images, of kernels, of both together and of both crossed; the gradients are those of the mapped function."""
    rng = np.random.default_rng(0)
    x, kernel = rng.standard_normal((*over_images, 2, 6, 7, 3)), rng.standard_normal((*over_kernels, 3, 3, 3, 5))
    shape = jax.eval_shape(batch(convolve), jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32)).shape
    _agree(batch, rng.standard_normal(shape), x, kernel, implementation)


@needs_onednn
def test_onednn_keeps_nan_within_its_3x3_neighbourhood():
    """A Winograd algorithm, which is never requested, would spread it over its tile."""
    rng = np.random.default_rng(0)
    x, kernel = rng.standard_normal((1, 12, 12, 16)).astype(np.float32), rng.standard_normal((3, 3, 16, 16))
    x[0, 5, 6, 0] = np.nan
    out = convolve(jnp.asarray(x), jnp.asarray(kernel, jnp.float32), implementation="onednn")
    reached = np.zeros((12, 12), bool)
    reached[4:7, 5:8] = True
    np.testing.assert_array_equal(np.isnan(out[0]).any(axis=-1), reached)


def test_onednn_that_is_not_installed_says_what_to_install(monkeypatch):
    monkeypatch.setattr("jaxdn.ops.onednn.library.PACKAGE", "no-such-package")
    assert not library.available()
    with pytest.raises(ValueError, match=r"pip install onednn-cpu-gomp"):
        convolve(*_operands(2, 3), implementation="onednn")


MADE_AND_RUN = """
import threading
import numpy as np
from jaxdn.ops.convolution import onednn
from jaxdn.ops.onednn import library

rng = np.random.default_rng(0)
for size, inputs, outputs in (((1, 1), 4, 4), ((16, 16), 14, 4), ((64, 64), 14, 32)):
    x, y = (rng.standard_normal((1, *size, channels)).astype(np.float32) for channels in (inputs, outputs))
    kernel = rng.standard_normal((3, 3, inputs, outputs)).astype(np.float32)
    for direction, (first, second, out) in {
        "forward": (x, kernel, np.zeros_like(y)),
        "kernel gradient": (x, np.zeros_like(kernel), y),
    }.items():
        made, found = [], out if direction != "kernel gradient" else second
        make = lambda: made.append(onednn._Convolution(direction, 1, *size, inputs, outputs))
        run = lambda: made[0](*(library.address_of(array) for array in (first, second, out)))
        for task in (make, run):
            thread = threading.Thread(target=task)
            thread.start()
            thread.join()
        there = found.copy()
        run()
        np.testing.assert_allclose(there, found, rtol=1e-5, atol=1e-5)
        assert np.abs(found).max() > 0.1
print("equal")
"""


@needs_onednn
def test_onednn_runs_on_another_thread_than_the_creating_one():
    """XLA calls back from any of its threads; the library's own working memory belongs to the creating thread."""
    done = subprocess.run([sys.executable, "-c", MADE_AND_RUN], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr  # a write out of bounds ends the process
    assert done.stdout.strip() == "equal"
