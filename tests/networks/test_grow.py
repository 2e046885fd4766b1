"""A larger network begins as the smaller one that it continues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame, frame_at
from jaxdn.denoiser.rollout import unroll
from jaxdn.denoisers import arae, dasr, ntasd, rae
from jaxdn.networks.grow import grow
from jaxdn.networks.recurrent import recurrent_unet
from jaxdn.networks.unet import unet
from jaxdn.zoo.weights import flatten, unflatten

SMALL = ((4,), (3,), (4, 2), (4,), (5,))
WIDER = ((6,), (5,), (7, 8), (4,), (9,))
RECURRENT, RECURRENT_WIDER = ((3, 4, 5), (5, 4), (4, 3)), ((5, 4, 6), (7, 5), (4, 6))
GROUPS, HEADS = (3, 2), (7, 4, 3)


@pytest.fixture
def trained(rng):
    """Weights that are nowhere zero."""
    return varied(unet(GROUPS, HEADS, widths=SMALL).init(jax.random.key(0)), rng)


def varied(params, rng):
    """Flat weights, none of them zero."""
    return {name: np.float32(array + 0.1 * rng.standard_normal(array.shape)) for name, array in flatten(params).items()}


@pytest.fixture
def features(rng):
    return [jnp.asarray(rng.normal(size=(1, 32, 32, channels)), jnp.float32) for channels in GROUPS]


def larger(trained, widths, groups=GROUPS):
    network = unet(groups, HEADS, widths=widths)
    return network, unflatten(grow(trained, flatten(network.init(jax.random.key(1)))))


@pytest.mark.slow
def test_wider_levels_and_more_inputs_change_no_output(trained, features):
    wanted = jax.jit(unet(GROUPS, HEADS, widths=SMALL).apply)(unflatten(trained), features)
    network, grown = larger(trained, WIDER, (*GROUPS, 4))
    more = [*features, 10 * jnp.ones((1, 32, 32, 4))]
    found = jax.jit(network.apply)(grown, more)
    for head, expected in zip(found, wanted, strict=True):
        np.testing.assert_allclose(head, expected, rtol=1e-4, atol=1e-5)

    def loss(params):
        return sum(jnp.sum(jnp.sin(head)) for head in network.apply(params, more))

    # Whatever is new can learn: what reads it has a gradient for every input.
    slopes = flatten(jax.jit(jax.grad(loss))(grown))
    for layer in ("encoder_0/convolution_0", "encoder_3/convolution_0", "decoder_2/convolution_0", "head_0"):
        assert np.all(np.abs(slopes[f"{layer}/kernel"]).max((0, 1, 3)) > 0), layer


def test_one_convolution_more_changes_outputs_by_its_rectifier_alone(trained, features):
    wanted = jax.jit(unet(GROUPS, HEADS, widths=SMALL).apply)(unflatten(trained), features)
    network, grown = larger(trained, ((6, 5), (5,), (7, 8, 4), (4,), (9,)))
    for head, expected in zip(jax.jit(network.apply)(grown, features), wanted, strict=True):
        assert np.abs(head - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("widths", "heads", "message"),
    [
        (((3,), *SMALL[1:]), HEADS, "coder_0/convolution_0/bias is .4,. there and .3,. in the network to train"),
        ((*SMALL[:2], (4,), *SMALL[3:]), HEADS, "convolution_1/.* missing in the network to train"),
        (SMALL, (8, 4, 3), "head_0/bias is .7,. there and .8,. in the network to train"),
    ],
)
def test_a_smaller_or_another_network_is_refused(trained, widths, heads, message):
    initial = flatten(unet(GROUPS, heads, widths=widths).init(jax.random.key(1)))
    with pytest.raises(ValueError, match=message):
        grow(trained, initial)


@pytest.mark.slow
@pytest.mark.parametrize("widths", [RECURRENT, RECURRENT_WIDER])
def test_a_recurrent_network_says_and_remembers_the_same(widths, rng):
    """Of each stage the first channels; what its hidden state has more of is not read yet."""
    old, new = (recurrent_unet((3, 2), 3, widths=each) for each in (RECURRENT, widths))
    trained = varied(old.init(jax.random.key(0)), rng)
    grown = unflatten(grow(trained, flatten(new.init(jax.random.key(1)))))
    features = [jnp.asarray(rng.normal(size=(1, 8, 8, channels)), jnp.float32) for channels in (3, 2)]

    def run(network, params):
        images, states = [], network.start(1, 8, 8, jnp.float32)
        for _ in range(2):
            image, states = network.apply(params, features, states)
            images.append(image)
        return images, [state[..., :channels] for state, channels in zip(states, RECURRENT[0], strict=True)]

    jax.tree.map(
        lambda found, wanted: np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5),
        run(new, grown),
        run(old, unflatten(trained)),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "size", "larger_size", "options"),
    [
        (rae, RECURRENT, RECURRENT_WIDER, {}),
        (rae, RECURRENT, RECURRENT_WIDER, {"guides": "materials"}),
        (arae, RECURRENT, RECURRENT_WIDER, {}),
        (ntasd, SMALL, WIDER, {}),
        (dasr, SMALL, WIDER, {}),
    ],
)
def test_images_of_a_grown_method_are_those_of_the_smaller_one(method, size, larger_size, options, rng):
    frames = Frame(
        radiance=rng.exponential(size=(2, 16, 16, 3)).astype(np.float32),
        albedo=rng.uniform(0.2, 1, (2, 16, 16, 3)).astype(np.float32),
        normal=rng.uniform(-1, 1, (2, 16, 16, 3)).astype(np.float32),
        depth=rng.uniform(1, 9, (2, 16, 16, 1)).astype(np.float32),
        sample_count=np.ones((2, 16, 16, 1), np.float32),
    )
    old, new = method(size=size), method(size=larger_size, **options)
    trained = varied(old.init(jax.random.key(0), frame_at(frames, 0)), rng)
    guides = {name: array for name, array in trained.items() if "/guide/" in name}
    initial = flatten(new.init(jax.random.key(1), frame_at(frames, 0)))
    layers = [{name: array for name, array in each.items() if name not in guides} for each in (trained, initial)]
    found, wanted = (
        jax.jit(unroll, static_argnums=0)(denoiser, unflatten(params), frames)
        for denoiser, params in ((new, grow(*layers) | guides), (old, trained))
    )
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)


def test_networks_under_prefixes_grow_as_they_do_alone(trained):
    """Two networks of one method: layers of the same names, each with its own sizes; a convolution is added."""
    initial = flatten(unet(GROUPS, HEADS, widths=((6, 5), *WIDER[1:])).init(jax.random.key(1)))
    alone = grow(trained, initial)
    found = grow(
        under("sampler", trained) | under("deep/denoiser", trained),
        under("sampler", initial) | under("deep/denoiser", initial),
    )
    jax.tree.map(np.testing.assert_array_equal, found, under("sampler", alone) | under("deep/denoiser", alone))


def under(prefix, flat):
    return {f"{prefix}/{name}": array for name, array in flat.items()}


def test_other_heads_and_inputs_under_a_prefix_are_refused(trained):
    """What a method adds to a network's inputs stands behind them: more inputs would be taken for the added ones."""
    for groups, heads, message in (
        (GROUPS, (8, 4, 3), "net/head_0/.* is .*7.* there and .*8.* in"),
        ((*GROUPS, 4), HEADS, "net/encoder_0/convolution_0/kernel is .*5, 4. there and .*9, 4. in"),
    ):
        initial = under("net", flatten(unet(groups, heads, widths=SMALL).init(jax.random.key(1))))
        with pytest.raises(ValueError, match=message):
            grow(under("net", trained), initial)


def test_what_cannot_pass_its_inputs_on_is_refused(trained, rng):
    """A recurrent network with a stage or a convolution more, and a network with a head more."""
    for widths, added in (
        (((3, 4, 5, 5), (6,), *RECURRENT[1:]), "encoder_3/convolution_"),
        (((3, 4, 5), (5, 4, 4), (4, 3)), "decoder_1/convolution_2"),
    ):
        remembering, larger_one = (recurrent_unet((3, 2), 3, widths=each) for each in (RECURRENT, widths))
        with pytest.raises(ValueError, match=f"{added}.* is missing there"):
            grow(varied(remembering.init(jax.random.key(0)), rng), flatten(larger_one.init(jax.random.key(1))))
    fewer = {name: array for name, array in trained.items() if not name.startswith("head_2")}
    with pytest.raises(ValueError, match="head_2 is missing there"):
        grow(fewer, trained)


def test_layers_of_unknown_networks_stay_or_are_refused():
    """Another package's method may have a network of its own."""
    layer = {"own/dense/kernel": np.ones((2, 3), np.float32), "own/dense/bias": np.ones(3, np.float32)}
    jax.tree.map(np.testing.assert_array_equal, grow(layer, jax.tree.map(np.zeros_like, layer)), layer)
    wider = {"own/dense/kernel": np.ones((2, 4), np.float32), "own/dense/bias": np.ones(4, np.float32)}
    with pytest.raises(ValueError, match=r"own/dense/kernel is \(2, 3\) there and \(2, 4\) in the network to train"):
        grow(layer, wider)
