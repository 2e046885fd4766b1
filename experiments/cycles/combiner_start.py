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
from jaxdn.methods.combiner.method import combiner
from jaxdn.zoo.weights import load_weights, save_weights

FROM = "steady-balanced"


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
        params["guide"][name] = steady["guide"][name][:1]  # of full resolution
    first, widened = steady["encoder_0"]["convolution_0"], new["encoder_0"]["convolution_0"]
    old, wide = first["kernel"].shape[2], jnp.zeros_like(widened["kernel"])
    kernel = wide.at[:, :, :old].set(first["kernel"])
    params["encoder_0"] = {**steady["encoder_0"], "convolution_0": {**first, "kernel": kernel}}
    # Features, trust and the share of the new frame are the first of what steady's network says, of four pixels each.
    channels = new["head_0"]["bias"].size
    for leaf, each in steady["head_0"].items():
        params["head_0"][leaf] = each[..., : 4 * channels].reshape(*each.shape[:-1], channels, 4).mean(-1)
    return params


if __name__ == "__main__":
    with plain_errors():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
