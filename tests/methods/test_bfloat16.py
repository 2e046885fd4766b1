"""Networks in bfloat16: layers against NumPy on numbers that it holds exactly, the whole network against XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.methods.table import method_named
from jaxdn.networks import LARGE, bfloat16, description
from jaxdn.networks.unet import unet
from jaxdn.ops import onednn_layers
from jaxdn.ops import onednn_library as dnnl

needs_bfloat16 = pytest.mark.skipif(not bfloat16.available(), reason="no oneDNN, or a CPU without bfloat16")
WIDTHS = ((16,), (24,), (32,), (32,), (32,))


def run(layer, x, shape, dtype=np.float32, before=None):
    """A layer on an array of small whole numbers [N, H, W, C]."""
    source = np.asarray(jnp.asarray(x, jnp.bfloat16)).view(np.uint16)
    out = np.zeros(shape, dtype) if before is None else before
    kind = dnnl.FLOAT32 if out.dtype == np.float32 else dnnl.BFLOAT16
    reads, writes = dnnl.images(*x.shape, dnnl.BFLOAT16), dnnl.images(*shape, kind)
    primitive = layer(reads, writes)(dnnl.memory(reads, dnnl.address(source)), dnnl.memory(writes, dnnl.address(out)))
    scratch = np.empty(primitive.scratch_bytes, np.uint8)
    dnnl.set_address(primitive.scratch, dnnl.address(scratch))
    primitive()
    return out


def convolved(x, kernel):
    size = kernel.shape[0]
    wide = np.pad(x, ((0, 0), (size // 2,) * 2, (size // 2,) * 2, (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(wide, (size, size), axis=(1, 2))
    return np.einsum("nhwcij,ijco->nhwo", windows, kernel)


@needs_bfloat16
@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("slope", [None, 0.25])
@pytest.mark.parametrize("adds", [False, True])
def test_a_convolution_is_exact_for_small_whole_numbers(rng, size, slope, adds):
    x, kernel = rng.integers(0, 4, (2, 10, 12, 20)) * 1.0, rng.integers(-2, 3, (size, size, 20, 24)) * 1.0
    bias, before = rng.integers(-5, 6, 24) * 1.0, rng.integers(-9, 9, (2, 10, 12, 24)) * 1.0
    wanted = convolved(x, kernel) + bias + before * adds
    wanted = wanted if slope is None else np.where(wanted >= 0, wanted, slope * wanted)
    found = run(
        lambda reads, writes: onednn_layers.convolution(reads, writes, kernel, bias, slope=slope, adds=adds),
        x,
        wanted.shape,
        before=before.astype(np.float32),
    )
    np.testing.assert_array_equal(found, wanted)


@needs_bfloat16
def test_pooling_and_enlarging(rng):
    x = rng.integers(-99, 99, (2, 8, 6, 16)) * 1.0
    pooled = run(onednn_layers.pooling, x, (2, 4, 3, 16), np.uint16)
    enlarged = run(onednn_layers.enlarging, x, (2, 16, 12, 16), np.uint16)
    as_numbers = [np.asarray(each.view(jnp.bfloat16), np.float64) for each in (pooled, enlarged)]
    np.testing.assert_array_equal(as_numbers[0], x.reshape(2, 4, 2, 3, 2, 16).max(axis=(2, 4)))
    np.testing.assert_array_equal(as_numbers[1], x.repeat(2, axis=1).repeat(2, axis=2))


@pytest.fixture(scope="module")
def pair():
    """The same network in XLA and in bfloat16, parameters, and features of two images."""
    plain, fast = (unet((12, 8), (30, 9), widths=WIDTHS, implementation=name) for name in (None, "onednn-bfloat16"))
    keys = jax.random.split(jax.random.key(3), 3)
    groups = [jax.random.normal(key, (2, 32, 48, count)) for key, count in zip(keys, (12, 8), strict=False)]
    return jax.jit(plain.apply), jax.jit(fast.apply), plain.init(keys[2]), groups


def assert_close(found, wanted):
    """Errors of 8 bits, in the mean and at the worst, after 9 layers."""
    for one, other in zip(found, wanted, strict=True):
        assert one.dtype == jnp.float32
        error, size = np.abs(np.asarray(one) - np.asarray(other)), float(np.std(other))
        assert error.mean() < 0.01 * size
        assert error.max() < 0.1 * size


@needs_bfloat16
def test_the_network_is_that_of_xla(pair):
    plain, fast, params, groups = pair
    assert_close(fast(params, groups), plain(params, groups))


@needs_bfloat16
def test_other_weights_other_images_and_a_group_that_is_missing(pair):
    plain, fast, params, groups = pair
    other = jax.tree.map(lambda weight: -1.3 * weight, params)
    turned = [group[::-1, :, ::-1] for group in groups]
    first = fast(params, groups)
    for given in ((other, groups), (params, turned), (params, [groups[0], None]), (params, groups)):
        assert_close(fast(*given), plain(*given))
    for one, again in zip(first, fast(params, groups), strict=True):
        np.testing.assert_array_equal(one, again)


@needs_bfloat16
def test_under_vmap_and_with_the_gradient_of_xla(pair):
    plain, fast, params, groups = pair
    stacked = [jnp.stack([group, 0.5 * group]) for group in groups]
    assert_close(jax.vmap(fast, (None, 0))(params, stacked), jax.vmap(plain, (None, 0))(params, stacked))
    slopes = [jax.grad(lambda params, net=net: jnp.sum(net(params, groups)[0] ** 2))(params) for net in (plain, fast)]
    for one, other in zip(*map(jax.tree.leaves, slopes), strict=True):
        scale = float(jnp.abs(one).max())
        # The square's slope is the image, which differs by 8 bits.
        np.testing.assert_allclose(other, one, atol=0.02 * scale)


@needs_bfloat16
def test_large_results_of_64_channels():
    """They are written past the caches, to addresses that have to be multiples of 64."""
    network = description.unet(16, (8,), widths=((64,),) * 5, head_size=1)
    weights = {
        name: {"kernel": np.zeros(shape, np.float32), "bias": np.ones(shape[3], np.float32)}
        for name, shape in network.kernels().items()
    }
    features, head = np.zeros((1, 384, 640, 16), np.uint16), np.zeros((1, 384, 640, 8), np.float32)
    program = bfloat16.Program(network, weights, features.shape)
    program(dnnl.address(features), [dnnl.address(head)])
    np.testing.assert_array_equal(head, 1.0)


@needs_bfloat16
def test_memory_is_used_again():
    network = description.unet(20, (9,), widths=LARGE, head_size=3)
    weights = {
        name: {"kernel": np.zeros(shape, np.float32), "bias": np.zeros(shape[3], np.float32)}
        for name, shape in network.kernels().items()
    }
    program = bfloat16.Program(network, weights, (1, 64, 64, 20))
    # All layers but the input and the head, each a convolution with its rectifier, or a step of its own.
    layers = [layer for layer in network.layers.values() if layer.kind in ("rectifier", "pool", "enlarge")]
    sizes = [2 * layer.channels * (64 >> layer.depth) ** 2 for layer in layers]
    assert program.bytes < 0.6 * sum(sizes)


@needs_bfloat16
def test_other_types_are_refused(pair):
    _, fast, params, groups = pair
    with pytest.raises(ValueError, match=r"\"onednn-bfloat16\" takes features in float32, got bfloat16"):
        fast(params, [group.astype(jnp.bfloat16) for group in groups])


def test_a_cpu_without_it_is_told(monkeypatch):
    monkeypatch.setattr(dnnl, "available", lambda: True)
    monkeypatch.setattr(dnnl, "computes_bfloat16", lambda: False)
    assert not bfloat16.available()
    with pytest.raises(ValueError, match='"onednn-bfloat16" needs a CPU with AVX-512 BF16 or AMX'):
        method_named("steady").factory(implementation="onednn-bfloat16")


def test_without_the_library_it_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(dnnl, "PACKAGE", "no-such-package")
    assert not bfloat16.available()
    with pytest.raises(ValueError, match=r'"onednn-bfloat16" needs the package .*pip install onednn-cpu-gomp'):
        method_named("steady").factory(implementation="onednn-bfloat16")
