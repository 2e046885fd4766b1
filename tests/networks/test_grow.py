"""A larger network begins as the smaller one that it continues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.networks.grow import grow
from jaxdn.networks.unet import unet
from jaxdn.zoo.weights import flatten, unflatten

SMALL = ((4,), (3,), (4, 2), (4,), (5,))
GROUPS, HEADS = (3, 2), (7, 4, 3)


@pytest.fixture
def trained(rng):
    """Weights that are nowhere zero."""
    flat = flatten(unet(GROUPS, HEADS, widths=SMALL).init(jax.random.key(0)))
    return {name: np.float32(array + 0.1 * rng.standard_normal(array.shape)) for name, array in flat.items()}


@pytest.fixture
def features(rng):
    return [jnp.asarray(rng.normal(size=(1, 32, 32, channels)), jnp.float32) for channels in GROUPS]


def larger(trained, widths, groups=GROUPS):
    network = unet(groups, HEADS, widths=widths)
    return network, unflatten(grow(trained, flatten(network.init(jax.random.key(1)))))


@pytest.mark.slow
def test_wider_levels_and_more_inputs_change_no_output(trained, features):
    wanted = jax.jit(unet(GROUPS, HEADS, widths=SMALL).apply)(unflatten(trained), features)
    network, grown = larger(trained, ((6,), (5,), (7, 8), (4,), (9,)), (*GROUPS, 4))
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
