"""The U-Net against a NumPy one, and its guarantees: plain dicts, fixed shapes, absent groups at a lower cost."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxdn.networks import LARGE, LEVELS, SMALL, graph
from jaxdn.networks.graph import FEATURES, NEGATIVE_SLOPE, GraphSpec, Layer
from jaxdn.networks.unet import Network, run_unet, unet
from jaxdn.zoo.weights import flatten, load_weights
from tests.needs import require

GROUPS = (3, 3, 3, 1, 3, 1)
HEADS = (51, 26, 26)
TINY = ((4, 5), (6,), (5,), (4, 4), (7,))


def features(rng: np.random.Generator, groups: tuple[int, ...], size: tuple[int, int] = (16, 32)) -> list[jax.Array]:
    return [jnp.asarray(rng.normal(size=(2, *size, channels)), jnp.float32) for channels in groups]


def numpy_convolution(x: np.ndarray, layer: dict[str, np.ndarray]) -> np.ndarray:
    height, width = x.shape[1:3]
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    taps = (padded[:, i : i + height, j : j + width] @ layer["kernel"][i, j] for i in range(3) for j in range(3))
    return sum(taps) + layer["bias"]


def numpy_unet(params: dict, x: np.ndarray, heads: int) -> list[np.ndarray]:
    """The same network in float64, written from the paper's figure: join, then convolve."""
    params = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), params)

    def level(name: str, x: np.ndarray) -> np.ndarray:
        for index in range(len(params[name])):
            x = numpy_convolution(x, params[name][f"convolution_{index}"])
            x = np.maximum(x, 0) + NEGATIVE_SLOPE * np.minimum(x, 0)
        return x

    skips = []
    for depth in range(LEVELS):
        if depth:
            n, height, width, channels = x.shape
            x = x.reshape(n, height // 2, 2, width // 2, 2, channels).max(axis=(2, 4))
        x = level(f"encoder_{depth}", x)
        skips.append(x)
    outputs = {}
    for depth in reversed(range(LEVELS - 1)):
        x = np.concatenate([x.repeat(2, axis=1).repeat(2, axis=2), skips[depth]], axis=-1)
        x = level(f"decoder_{depth}", x)
        if depth < heads:
            outputs[depth] = numpy_convolution(x, params[f"head_{depth}"])
    return [outputs[depth] for depth in range(heads)]


@pytest.mark.parametrize(("widths", "weights"), [(LARGE, 895_495), (SMALL, 434_423)])
def test_weight_counts(widths: tuple, weights: int, key: jax.Array) -> None:
    network = unet(GROUPS, HEADS, widths=widths)
    assert sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(network.init, key))) == weights


def test_a_network_that_is_built_again_is_not_described_to_flax_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A denoiser is built up to three times before its first frame, and each time takes a hundredth of a second."""
    unet((3, 2), HEADS, widths=TINY)
    monkeypatch.delattr("jaxdn.networks.unet.nnx.eval_shape")
    unet((3, 2), HEADS, widths=TINY)
    with pytest.raises(AttributeError):
        unet((3, 3), HEADS, widths=TINY)


def test_small_computes_a_third_of_large(key: jax.Array) -> None:
    def flops(widths: tuple) -> float:
        network = unet(GROUPS, HEADS, widths=widths)
        inputs = [jax.ShapeDtypeStruct((1, 64, 64, channels), jnp.float32) for channels in GROUPS]
        return jax.jit(network.apply).lower(jax.eval_shape(network.init, key), inputs).cost_analysis()["flops"]

    assert 0.25 < flops(SMALL) / flops(LARGE) < 0.4


def test_forward_is_the_numpy_network(rng: np.random.Generator, key: jax.Array) -> None:
    network = unet((3, 2), (5, 3, 2), widths=TINY)
    params = network.init(key)
    params = jax.tree.map(lambda leaf: np.float32(leaf + 0.1 * rng.normal(size=leaf.shape)), jax.device_get(params))
    inputs = features(rng, (3, 2))
    heads = jax.jit(network.apply)(params, inputs)
    assert [head.shape for head in heads] == [(2, 16, 32, 5), (2, 8, 16, 3), (2, 4, 8, 2)]
    wanted = numpy_unet(params, np.concatenate(inputs, axis=-1).astype(np.float64), 3)
    for head, reference in zip(heads, wanted, strict=True):
        np.testing.assert_allclose(head, reference, atol=2e-5 * np.abs(reference).max())


def test_an_absent_group_is_zeros_at_a_lower_cost(rng: np.random.Generator, key: jax.Array) -> None:
    network = unet(GROUPS, (3, 3, 2), widths=TINY)
    params = network.init(key)
    whole = features(rng, GROUPS)
    absent = [group if index in (0, 3) else None for index, group in enumerate(whole)]
    zeros = [group if index in (0, 3) else jnp.zeros_like(group) for index, group in enumerate(whole)]
    apply = jax.jit(network.apply)
    for first, second in zip(apply(params, absent), apply(params, zeros), strict=True):
        np.testing.assert_allclose(first, second, atol=1e-5)
    flops = [apply.lower(params, group).cost_analysis()["flops"] for group in (absent, zeros)]
    assert flops[0] < flops[1]


@pytest.mark.parametrize("scheme", ["he", "xavier"])
def test_parameters_are_plain_and_uniform_within_the_limits_of_the_scheme(key: jax.Array, scheme: str) -> None:
    params = unet(GROUPS, HEADS, widths=SMALL, initialization=scheme).init(key)
    assert type(params) is dict
    assert all(type(level) is dict for level in params.values())
    for path, leaf in jax.tree.leaves_with_path(params):
        assert leaf.dtype == jnp.float32
        if path[-1].key == "bias":
            assert not np.any(leaf)
        else:
            he = 0.1 * np.sqrt(3 / (9 * leaf.shape[2])) if "head" in path[0].key else np.sqrt(6 / (9 * leaf.shape[2]))
            limit = he if scheme == "he" else np.sqrt(6 / (9 * (leaf.shape[2] + leaf.shape[3])))
            assert np.abs(leaf).max() <= limit
            np.testing.assert_allclose(np.std(leaf), limit / np.sqrt(3), rtol=0.1)
    other = unet(GROUPS, HEADS, widths=SMALL).init(jax.random.key(1))
    assert not np.array_equal(params["head_0"]["kernel"], other["head_0"]["kernel"])


@pytest.mark.slow
def test_every_level_begins_to_learn_at_the_same_pace(key: jax.Array, rng: np.random.Generator) -> None:
    """With Xavier's limits the deepest levels get a hundredth of the others' gradient, relative to their weights."""
    network, inputs = unet(GROUPS, HEADS, widths=SMALL), features(rng, GROUPS)
    wanted = [
        rng.standard_normal(np.shape(head)).astype(np.float32) for head in network.apply(network.init(key), inputs)
    ]

    @jax.jit
    def slope(params: dict) -> dict:
        def error(params: dict) -> jax.Array:
            found = network.apply(params, inputs)
            return sum(jnp.mean((head - other) ** 2) for head, other in zip(found, wanted, strict=True))

        return jax.grad(error)(params)

    def spread(scheme: str) -> float:
        params = unet(GROUPS, HEADS, widths=SMALL, initialization=scheme).init(key)
        sizes = {
            name: float(optax.tree.norm(part) / optax.tree.norm(params[name])) for name, part in slope(params).items()
        }
        levels = [size for name, size in sizes.items() if "head" not in name]
        return max(levels) / min(levels)

    assert 4 * spread("he") < spread("xavier")


def test_errors_say_what_was_expected(rng: np.random.Generator, key: jax.Array) -> None:
    with pytest.raises(ValueError, match="widths: expected 5 levels"):
        unet(GROUPS, HEADS, widths=((4,), (4,)))
    with pytest.raises(ValueError, match="widths: expected 5 levels"):
        unet(GROUPS, HEADS, widths=((4,), (), (4,), (4,), (4,)))
    network = unet((3, 2), (5, 3, 2), widths=TINY)
    params = network.init(key)
    with pytest.raises(ValueError, match="multiples of 16"):
        network.apply(params, features(rng, (3, 2), (16, 24)))
    with pytest.raises(ValueError, match="features: expected"):
        network.apply(params, features(rng, (3, 3)))
    with pytest.raises(ValueError, match="features: expected"):
        network.apply(params, [None, None])
    for wrong, told in (({}, "got none"), ({**params, "guide": {}}, "got decoder_0, .*, guide, head_0")):
        with pytest.raises(ValueError, match=f"params: expected the layers decoder_0, .*{told}.*; pass what init"):
            network.apply(wrong, features(rng, (3, 2), (16, 32)))


def test_only_the_networks_package_imports_flax() -> None:
    import pathlib

    import jaxdn

    package = pathlib.Path(jaxdn.__file__).parent
    users = {path.parent.name for path in package.rglob("*.py") if "from flax" in path.read_text()}
    assert users == {"networks"}


def test_shipped_weights_are_those_of_the_description() -> None:
    """Neither more nor fewer convolutions, each of the described shape."""
    for name, groups, heads, widths, size in (
        ("ntd-small", GROUPS, HEADS, SMALL, 3),
        ("ntd-large", GROUPS, HEADS, LARGE, 3),
    ):
        _, params = load_weights(name)
        found = {path: leaf.shape for path, leaf in flatten(params).items() if not path.startswith("guide")}
        kernels = graph.unet(sum(groups), heads, widths=widths, head_size=size).kernels()
        wanted = {f"{layer}/kernel": shape for layer, shape in kernels.items()}
        wanted |= {f"{layer}/bias": shape[3:] for layer, shape in kernels.items()}
        assert found == wanted


OTHER = GraphSpec(
    {
        FEATURES: Layer("input", (), 18, 0),
        "thin": Layer("convolution", (FEATURES,), 3, 0, 1),
        "half": Layer("pool", ("thin",), 3, 1),
        "wide": Layer("convolution", ("half",), 5, 1, 3),
        "bent": Layer("rectifier", ("wide",), 5, 1),
        "large": Layer("upsample", ("bent",), 5, 0),
        "end": Layer("convolution", ("thin", "large", FEATURES), 4, 0, 3),
    },
    ("bent", "end"),
)
"""No U-Net: outputs at two levels, one of them rectified, three inputs joined."""


@pytest.mark.parametrize("backend", ["reference", "onnxruntime"])
def test_every_backend_runs_whatever_network_is_described(backend: str, rng: np.random.Generator) -> None:
    if backend == "onnxruntime":
        require("onnxruntime")
    weights = {
        name: {"kernel": 0.2 * rng.normal(size=shape), "bias": rng.normal(size=shape[3:])}
        for name, shape in OTHER.kernels().items()
    }
    x = rng.normal(size=(2, 6, 8, 18))
    thin = x @ weights["thin"]["kernel"][0, 0] + weights["thin"]["bias"]
    wide = numpy_convolution(thin.reshape(2, 3, 2, 4, 2, 3).max(axis=(2, 4)), weights["wide"])
    bent = np.where(wide < 0, NEGATIVE_SLOPE * wide, wide)
    end = numpy_convolution(np.concatenate([thin, bent.repeat(2, 1).repeat(2, 2), x], axis=-1), weights["end"])

    run = functools.partial(run_unet, network=OTHER, implementation=backend)
    single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), weights)
    found = jax.jit(run)(single, [jnp.asarray(x[..., :7], jnp.float32), jnp.asarray(x[..., 7:], jnp.float32)])
    for got, wanted in zip(found, (bent, end), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("absent", [(), (1, 3)])
@pytest.mark.parametrize("name", ["onnxruntime", "onednn"])
def test_a_backend_runs_the_same_network(
    name: str, absent: tuple[int, ...], rng: np.random.Generator, key: jax.Array
) -> None:
    """Values of the backend and its gradient, with all features and without some."""
    require(name)
    plain, backend = (unet(GROUPS, HEADS, widths=TINY, implementation=each) for each in (None, name))
    params = jax.tree.map(lambda leaf: leaf + np.float32(0.01), jax.device_get(plain.init(key)))
    inputs = [None if index in absent else group for index, group in enumerate(features(rng, GROUPS))]

    def both(network: Network) -> tuple:
        def loss(params: dict) -> tuple[jax.Array, tuple[jax.Array, ...]]:
            heads = network.apply(params, inputs)
            return sum(jnp.sum(jnp.sin(head)) for head in heads), heads

        return jax.jit(jax.grad(loss, has_aux=True))(params)

    wanted, got = both(plain), both(backend)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4), got, wanted)


@pytest.mark.slow
def test_onnxruntime_follows_the_weights_under_scan_and_vmap(rng: np.random.Generator, key: jax.Array) -> None:
    """The backend keeps weights in its own layout; new weights in the next call give the new image."""
    require("onnxruntime")
    plain, backend = (unet((3, 2), (5, 3, 2), widths=TINY, implementation=name) for name in (None, "onnxruntime"))
    inputs = [jnp.stack([group, 2 * group]) for group in features(rng, (3, 2))]
    run = jax.jit(backend.apply)
    for scale in (1.0, 1.5, 1.0):
        params = jax.tree.map(lambda leaf, scale=scale: scale * leaf, plain.init(key))
        wanted = jax.vmap(lambda *groups, params=params: plain.apply(params, list(groups)))(*inputs)
        for index in range(2):
            got = run(params, [group[index] for group in inputs])
            jax.tree.map(lambda a, b, i=index: np.testing.assert_allclose(a, b[i], rtol=1e-4, atol=1e-5), got, wanted)
        mapped = jax.vmap(lambda *groups, params=params: backend.apply(params, list(groups)))(*inputs)
        _, scanned = jax.lax.scan(lambda _, groups, params=params: (None, backend.apply(params, groups)), None, inputs)
        for got in (mapped, scanned):
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), got, wanted)


def test_onnxruntime_takes_only_float32(rng: np.random.Generator, key: jax.Array) -> None:
    require("onnxruntime")
    network = unet((3, 2), (5, 3, 2), widths=TINY, implementation="onnxruntime")
    inputs = [group.astype(jnp.bfloat16) for group in features(rng, (3, 2))]
    with pytest.raises(ValueError, match="float32"):
        network.apply(network.init(key), inputs)


def test_a_backend_that_is_not_installed_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install onnxruntime onnx"):
        unet((3, 2), (5, 3, 2), widths=TINY, implementation="onnxruntime")
