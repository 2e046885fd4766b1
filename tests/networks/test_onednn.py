"""Networks in oneDNN: layers against NumPy on numbers that bfloat16 holds exactly, the whole network against XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.methods.registry import method_named
from jaxdn.networks import LARGE, graph, onednn
from jaxdn.networks.backends import BACKENDS
from jaxdn.networks.unet import unet
from jaxdn.ops.onednn import layers
from jaxdn.ops.onednn import library as dnnl
from tests.needs import require

WIDTHS = ((16,), (24,), (32,), (32,), (32,))


@pytest.fixture(params=[onednn.FLOAT32, onednn.BFLOAT16], ids=lambda each: each.backend, scope="module")
def precision(request):
    require("onednn")
    if request.param is onednn.BFLOAT16:
        require("bfloat16")
    return request.param


def run(layer, precision, x, shape, dtype=None, before=None):
    """A layer on an array of small whole numbers [N, H, W, C]."""
    source = np.array(jnp.asarray(x, precision.dtype))
    out = np.zeros(shape, source.dtype if dtype is None else dtype) if before is None else before
    kind = dnnl.FLOAT32 if out.dtype == np.float32 else dnnl.BFLOAT16
    reads, writes = dnnl.describe_images(*x.shape, precision.kind), dnnl.describe_images(*shape, kind)
    ends = (dnnl.create_memory(reads, dnnl.address_of(source)), dnnl.create_memory(writes, dnnl.address_of(out)))
    primitive = layer(reads, writes)(*ends)
    scratch = np.empty(primitive.scratch_bytes, np.uint8)
    dnnl.set_address(primitive.scratch, dnnl.address_of(scratch))
    primitive()
    return out


def convolved(x, kernel):
    size = kernel.shape[0]
    wide = np.pad(x, ((0, 0), (size // 2,) * 2, (size // 2,) * 2, (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(wide, (size, size), axis=(1, 2))
    return np.einsum("nhwcij,ijco->nhwo", windows, kernel)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("slope", [None, 0.25])
@pytest.mark.parametrize("adds", [False, True])
def test_a_convolution_is_exact_for_small_whole_numbers(precision, rng, size, slope, adds):
    x, kernel = rng.integers(0, 4, (2, 10, 12, 20)) * 1.0, rng.integers(-2, 3, (size, size, 20, 24)) * 1.0
    bias, before = rng.integers(-5, 6, 24) * 1.0, rng.integers(-9, 9, (2, 10, 12, 24)) * 1.0
    wanted = convolved(x, kernel) + bias + before * adds
    wanted = wanted if slope is None else np.where(wanted >= 0, wanted, slope * wanted)
    found = run(
        lambda *ends: layers.make_convolution(*ends, kernel, bias, kind=precision.kind, slope=slope, adds=adds),
        precision,
        x,
        wanted.shape,
        before=before.astype(np.float32),
    )
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("adds", [False, True])
def test_a_convolution_of_an_enlarged_image_is_exact_for_small_whole_numbers(precision, rng, adds):
    x, kernel = rng.integers(0, 4, (2, 5, 6, 20)) * 1.0, rng.integers(-2, 3, (3, 3, 20, 24)) * 1.0
    bias, before = rng.integers(-5, 6, 24) * 1.0, rng.integers(-9, 9, (2, 10, 12, 24)) * 1.0
    wanted = convolved(x.repeat(2, axis=1).repeat(2, axis=2), kernel) + bias + before * adds
    wanted = np.where(wanted >= 0, wanted, 0.25 * wanted)
    options = {"kind": precision.kind, "slope": 0.25, "adds": adds, "upsamples": True}
    found = run(
        lambda *ends: layers.make_convolution(*ends, kernel, bias, **options),
        precision,
        x,
        wanted.shape,
        before=before.astype(np.float32),
    )
    np.testing.assert_array_equal(found, wanted)


def test_pooling_and_enlarging(precision, rng):
    x = rng.integers(-99, 99, (2, 8, 6, 16)) * 1.0
    pooled = run(layers.make_pooling, precision, x, (2, 4, 3, 16))
    upsampled = run(layers.make_upsampling, precision, x, (2, 16, 12, 16))
    as_numbers = [np.asarray(each, np.float64) for each in (pooled, upsampled)]
    np.testing.assert_array_equal(as_numbers[0], x.reshape(2, 4, 2, 3, 2, 16).max(axis=(2, 4)))
    np.testing.assert_array_equal(as_numbers[1], x.repeat(2, axis=1).repeat(2, axis=2))


@pytest.fixture(scope="module")
def pair(precision):
    """The same network in XLA and in oneDNN, parameters, and features of two images."""
    plain, fast = (unet((12, 8), (30, 9), widths=WIDTHS, implementation=name) for name in (None, precision.backend))
    keys = jax.random.split(jax.random.key(3), 3)
    groups = [jax.random.normal(key, (2, 32, 48, count)) for key, count in zip(keys, (12, 8), strict=False)]
    return jax.jit(plain.apply), jax.jit(fast.apply), plain.init(keys[2]), groups


def assert_close(found, wanted, precision):
    """Errors of rounding, in the mean and at the worst, after 9 layers: bfloat16 has 8 bits."""
    mean, worst = (0.01, 0.1) if precision is onednn.BFLOAT16 else (1e-6, 1e-5)
    for one, other in zip(found, wanted, strict=True):
        assert one.dtype == jnp.float32
        error, size = np.abs(np.asarray(one) - np.asarray(other)), float(np.std(other))
        assert error.mean() < mean * size
        assert error.max() < worst * size


def test_the_network_is_that_of_xla(pair, precision):
    plain, fast, params, groups = pair
    assert_close(fast(params, groups), plain(params, groups), precision)


def test_other_weights_other_images_and_a_group_that_is_missing(pair, precision):
    plain, fast, params, groups = pair
    other = jax.tree.map(lambda weight: -1.3 * weight, params)
    turned = [group[::-1, :, ::-1] for group in groups]
    first = fast(params, groups)
    for given in ((other, groups), (params, turned), (params, [groups[0], None]), (params, groups)):
        assert_close(fast(*given), plain(*given), precision)
    for one, again in zip(first, fast(params, groups), strict=True):
        np.testing.assert_array_equal(one, again)


@pytest.mark.slow
def test_under_vmap_and_with_the_gradient_of_xla(pair, precision):
    plain, fast, params, groups = pair
    stacked = [jnp.stack([group, 0.5 * group]) for group in groups]
    assert_close(jax.vmap(fast, (None, 0))(params, stacked), jax.vmap(plain, (None, 0))(params, stacked), precision)
    slopes = [jax.grad(lambda params, net=net: jnp.sum(net(params, groups)[0] ** 2))(params) for net in (plain, fast)]
    for one, other in zip(*map(jax.tree.leaves, slopes), strict=True):
        scale = float(jnp.abs(one).max())
        # The square's slope is the image, which differs by 8 bits in bfloat16.
        np.testing.assert_allclose(other, one, atol=0.02 * scale)


def test_large_results_of_64_channels(precision):
    """They are written past the caches, to addresses that have to be multiples of 64."""
    network = graph.unet(16, (8,), widths=((64,),) * 5, head_size=1)
    weights = {
        name: {"kernel": np.zeros(shape, np.float32), "bias": np.ones(shape[3], np.float32)}
        for name, shape in network.kernels().items()
    }
    features, head = np.array(jnp.zeros((1, 384, 640, 16), precision.dtype)), np.zeros((1, 384, 640, 8), np.float32)
    program = onednn.Program(network, weights, features.shape, precision)
    program(dnnl.address_of(features), [dnnl.address_of(head)])
    np.testing.assert_array_equal(head, 1.0)


def test_memory_is_used_again(precision):
    network = graph.unet(20, (9,), widths=LARGE, head_size=3)
    weights = {
        name: {"kernel": np.zeros(shape, np.float32), "bias": np.zeros(shape[3], np.float32)}
        for name, shape in network.kernels().items()
    }
    program = onednn.Program(network, weights, (1, 64, 64, 20), precision)
    # All layers but the input and the head, each a convolution with its rectifier, or a step of its own.
    layers = [layer for layer in network.layers.values() if layer.kind in ("rectifier", "pool", "upsample")]
    size = jnp.dtype(precision.dtype).itemsize
    sizes = [size * layer.channels * (64 >> layer.depth) ** 2 for layer in layers]
    assert program.bytes < 0.6 * sum(sizes)


def test_other_types_are_refused(pair, precision):
    _, fast, params, groups = pair
    with pytest.raises(ValueError, match=f'"{precision.backend}" takes float32, got bfloat16'):
        fast(params, [group.astype(jnp.bfloat16) for group in groups])


def test_weights_for_which_no_program_could_be_made_are_no_program_s():
    """Memory may be full once: the next call must not run with the weights of the one before."""
    ran, full = [], [2.0]

    def describe(weights):
        if weights[0][0] in full:
            full.clear()
            raise MemoryError
        return lambda features, heads: ran.append(float(weights[0][0]))

    session = onednn.Session(describe)
    session([], np.zeros(1), np.full(1, 1.0))
    with pytest.raises(MemoryError):
        session([], np.zeros(1), np.full(1, 2.0))
    session([], np.zeros(1), np.full(1, 2.0))
    assert ran == [1.0, 2.0]


def test_a_cpu_without_it_is_told(monkeypatch):
    monkeypatch.setattr(dnnl, "available", lambda: True)
    monkeypatch.setattr(dnnl, "computes_bfloat16", lambda: False)
    assert not onednn.computes_bfloat16()
    with pytest.raises(ValueError, match='"onednn-bfloat16" needs a CPU with AVX-512 BF16 or AMX'):
        method_named("steady").factory(implementation="onednn-bfloat16")


@pytest.mark.parametrize("backend", ["onednn-bfloat16", "onednn-float32"])
def test_without_the_library_it_is_told_what_to_install(backend, monkeypatch):
    monkeypatch.setattr(dnnl, "PACKAGE", "no-such-package")
    assert not BACKENDS[backend].available()
    with pytest.raises(ValueError, match=rf'"{backend}" needs the package .*pip install onednn-cpu-gomp'):
        method_named("steady").factory(implementation=backend)
