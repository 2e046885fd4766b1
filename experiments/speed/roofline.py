"""The roofline: a lower bound for the time of a workload, from its operations and bytes and the machine's peak rates.

The ceilings are measured interleaved with the workload. Operations and bytes are counted from the shapes, not from a
compiled program: every convolution reads its input once, writes its output once and does ``2 * 9 * Ci * Co`` operations
per pixel. Nothing stays in a cache from one convolution to the next; operations that could be fused into one are not
counted.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.timing import Call
from jaxdn.methods.reconstruction import TAPS
from jaxdn.networks import Widths, graph

FLOAT = 4
"""Bytes of a number."""


class Cost(NamedTuple):
    """The minimum cost of one pass over memory."""

    operations: float
    bytes: float


class Ceilings(NamedTuple):
    """The rates that the machine reaches."""

    copy_gb_s: float
    """Bytes read plus bytes written, in 1e9 per second."""
    matmul_gflop_s: float
    """float32; a multiplication and an addition count as two."""


class Probe(NamedTuple):
    """A call that reaches a ceiling, to be timed interleaved with the workload: a shared machine's speed varies."""

    build: Callable[[], Call]
    bytes: float
    operations: float


def probes() -> dict[str, Probe]:
    """Copying, and float32 matrix products, on jax's default device."""
    if jax.default_backend() != "cpu":
        size, length = 8192, 1 << 27
        return {
            "copy": Probe(partial(copy_on_device, length), 2.0 * FLOAT * length, 0),
            "matrix product": Probe(partial(product_by_jax, size), 0, 2.0 * size**3),
        }
    size, length = 1536, 32 << 20
    return {
        "copy": Probe(partial(copy_by_threads, length), 2.0 * FLOAT * length, 0),
        "matrix product": Probe(partial(product_by_jax, size), 0, 2.0 * size**3),
        "matrix product, numpy": Probe(partial(product_by_numpy, size), 0, 2.0 * size**3),  # sometimes faster
    }


def ceilings(probes: Mapping[str, Probe], median_ms: Mapping[str, float]) -> Ceilings:
    """The highest rates of the probes, from their times."""
    return Ceilings(
        max(probe.bytes / median_ms[name] for name, probe in probes.items()) / 1e6,
        max(probe.operations / median_ms[name] for name, probe in probes.items()) / 1e6,
    )


def _square(size: int) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((size, size), np.float32)


def product_by_jax(size: int) -> Call:
    """The product of two square matrices."""
    a, product = jnp.asarray(_square(size)), jax.jit(lambda a: jnp.dot(a, a, precision="highest"))
    return lambda: product(a).block_until_ready()


def product_by_numpy(size: int) -> Call:
    """The same by NumPy's library."""
    a = _square(size)
    return lambda: a @ a


def copy_by_threads(length: int) -> Call:
    """A copy of this many numbers, divided among the cores."""
    cores = os.cpu_count() or 1
    source, target = (np.ones((cores, length // cores), np.float32) for _ in range(2))
    pool = ThreadPoolExecutor(cores)
    return lambda: list(pool.map(np.copyto, target, source))


def copy_on_device(length: int) -> Call:
    """So many numbers read, changed and written back in place."""
    x = [jnp.zeros(length, jnp.float32)]
    add = jax.jit(lambda x: x + 1, donate_argnums=0)

    def copy() -> None:
        x[0] = jax.block_until_ready(add(x[0]))

    return copy


def milliseconds(costs: Sequence[Cost], ceilings: Ceilings) -> float:
    """The roofline of consecutive passes: each takes the longer of its operations' and its bytes' time."""
    seconds = [
        max(cost.operations / (1e9 * ceilings.matmul_gflop_s), cost.bytes / (1e9 * ceilings.copy_gb_s))
        for cost in costs
    ]
    return 1e3 * sum(seconds)


def convolution(count: int, height: int, width: int, inputs: int, outputs: int) -> Cost:
    """A 3x3 convolution of [count, height, width, inputs]; its gradient by image or by kernel costs the same.

    Args:
      count: number of images.
      height: of an image.
      width: of an image.
      inputs: channels in.
      outputs: channels out.
    """
    pixels = count * height * width
    weights = 9 * inputs * outputs
    return Cost(2.0 * pixels * weights, FLOAT * (pixels * (inputs + outputs) + weights))


def kernel_application(height: int, width: int, *, gradient: bool = False) -> Cost:
    """Softmax of 25 logits and 25 multiply-adds of RGB; with ``gradient`` the forward pass and both gradients.

    Logits and image are read once and the result is written; the gradient reads them and the result's gradient again,
    and writes theirs.
    """
    pixels = height * width
    forward = Cost(pixels * (3.0 * TAPS + 6 * TAPS), FLOAT * pixels * (TAPS + 6.0))
    if not gradient:
        return forward
    return Cost(3 * forward.operations, forward.bytes + FLOAT * pixels * 2.0 * (TAPS + 3) + FLOAT * pixels * 3)


def bilinear_warp(height: int, width: int, *, gradient: bool = False) -> Cost:
    """A bilinear fetch of RGB: image and vectors are read once, the result is written.

    With ``gradient`` (only by the image): the result's gradient and the vectors read, the image's gradient written.
    """
    pixels = height * width
    once = Cost(pixels * 24.0, FLOAT * pixels * 8.0)
    return Cost(2 * once.operations, 2 * once.bytes) if gradient else once


def network(
    widths: Widths, height: int, width: int, *, count: int = 1, features: int = 14, heads: Sequence[int] = (51, 26, 26)
) -> list[Cost]:
    """The convolutions of the U-Net.

    Args:
      widths: of the U-Net.
      height: of an image.
      width: of an image.
      count: number of images.
      features: input channels.
      heads: output channels at full, half and quarter resolution.
    """
    described = graph.unet(features, heads, widths=widths, head_size=3)
    kernels = described.kernels()
    sizes = [(height >> described.layers[name].depth, width >> described.layers[name].depth) for name in kernels]
    return [convolution(count, *size, *kernel[2:]) for size, kernel in zip(sizes, kernels.values(), strict=True)]


def step(widths: Widths, height: int, width: int) -> list[Cost]:
    """One recurrent step: warp, network, kernels at three scales and on the history."""
    kernels = [kernel_application(height >> n, width >> n) for n in (0, 0, 1, 2)]
    return [bilinear_warp(height, width), *network(widths, height, width), *kernels]


def train_step(widths: Widths, size: int, *, batch: int, frames: int) -> list[Cost]:
    """One update on ``batch`` clips of ``frames`` frames: three times the convolutions (forward and two gradients) for
    all frames except the last, which has only the forward pass."""
    convolutions = network(widths, size, size, count=batch)
    return convolutions * (3 * (frames - 1) + 1)
