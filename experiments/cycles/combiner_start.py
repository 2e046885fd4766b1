"""Weights that the training of ``combiner`` starts from: what ``steady`` has learned about the same inputs.

    python -m experiments.cycles.combiner_start -o runs/start.safetensors
    jaxdn train data/cycles --method combiner --variant combiner-high --start runs/start.safetensors -o runs/combiner

The first groups of its input are those of steady's network, its U-Net has the widths of ``steady-balanced``, and parts
of its head say the same: features of the filter, trust, how fast the mean follows. These are copied; what is new begins
as ever, with no weight on inputs that steady does not have. So does the network that chooses among the candidates.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import tyro

from jaxdn.commands.errors import plain_errors
from jaxdn.core.frame import Frame
from jaxdn.denoiser import Params
from jaxdn.methods.combiner.method import FEATURES, HALF_FEATURES, INITIAL, combiner
from jaxdn.zoo.weights import load_weights, save_weights

FROM = "steady-balanced"
STEADY_SHARES = 5
"""Logits of a pixel that steady's network predicts, trust and accumulation first."""


@dataclass
class Options:
    """Write the weights to start from."""

    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The file, .safetensors."""


def main(options: Options) -> int:
    """Write the weights and say where."""
    path = save_weights(options.out, take_over(load_weights(FROM)[1]), factory="combiner", options={}, record={})
    print(path)
    return 0


def take_over(steady: Params) -> Params:
    """Parameters of ``combiner()`` with those of ``steady(quality="balanced")`` where they say the same."""
    new = combiner().init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3))))
    params = {**steady, "guide": {**new["guide"]}, "choice": new["choice"], "head_0": {}}
    for name in new["guide"].keys() & steady["guide"].keys():
        params["guide"][name] = steady["guide"][name]
    first, widened = steady["encoder_0"]["convolution_0"], new["encoder_0"]["convolution_0"]
    old, wide = first["kernel"].shape[2], jnp.zeros_like(widened["kernel"])
    kernel = wide.at[:, :, :old].set(first["kernel"])
    params["encoder_0"] = {**steady["encoder_0"], "convolution_0": {**first, "kernel": kernel}}
    # Steady's last features are larger than those that the scale of a new kernel is made for.
    begin = {**new["head_0"], "kernel": jnp.zeros_like(new["head_0"]["kernel"])}
    params["head_0"] = {leaf: _head(each, steady["head_0"][leaf]) for leaf, each in begin.items()}
    return params


def _head(new: jax.Array, steady: jax.Array) -> jax.Array:
    """Kernel or bias of the head: the channels that both have from steady."""
    learned = 4 * FEATURES + 4 * 2  # features of four pixels, then trust and share of the new frame
    here, there = 4 * (FEATURES + len(INITIAL)), 4 * (FEATURES + STEADY_SHARES)
    rest = new.shape[-1] - here
    if rest <= HALF_FEATURES or steady.shape[-1] < there + rest:
        raise ValueError(f"{FROM}: expected a head of {there + rest} channels at least, got {steady.shape[-1]}.")
    return new.at[..., :learned].set(steady[..., :learned]).at[..., here:].set(steady[..., there : there + rest])


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
