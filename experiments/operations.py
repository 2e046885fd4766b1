"""What each implementation of the hot operations costs where training uses them: vmap in scan, forward and gradient.

    python experiments/operations.py            # 64 px, 4 clips, 10 frames
    python experiments/operations.py --quick    # 32 px, 2 clips, 2 frames

Implementations of one operation run interleaved in one process and the median of each is printed as a ratio to the
reference: absolute times depend on the machine and on who else is using it. For convolutions the last column compares
one image per vmapped clip, as training calls them, to the same images as one native batch.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.backends.convolution import convolve
from jaxdn.backends.registry import implementations, resolve
from jaxdn.kernels import apply_kernels, normalize_kernels
from jaxdn.warping import warp

CONVOLUTIONS = ((16, 32), (32, 32), (32, 51), (64, 64))
"""(inputs, outputs) of typical layers."""


def looped(one: Callable[..., jax.Array], clips: bool) -> Callable[..., jax.Array]:
    """Sum of squares of ``one(weights, frame)`` over a scan; with ``clips``, vmapped over the frame's first axis."""

    def loss(weights: Any, frames: Any) -> jax.Array:
        def body(total: jax.Array, frame: Any) -> tuple[jax.Array, None]:
            out = jax.vmap(lambda frame: one(weights, frame))(frame) if clips else one(weights, frame)
            return total + jnp.sum(out * out), None

        return jax.lax.scan(body, jnp.zeros(()), frames)[0]

    return loss


def compare(programs: dict[str, Callable[..., Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each program, run in turn after one round that compiles."""
    times: dict[str, list[float]] = {name: [] for name in programs}
    for round_ in range(rounds + 1):
        for name, program in programs.items():
            start = time.perf_counter()
            jax.block_until_ready(program())
            if round_:
                times[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in times.items()}


def measure(
    title: str, op: str, one: Callable[[str], Callable[..., jax.Array]], weights: Any, frames: Any, rounds: int
) -> None:
    """Print one row per implementation: forward, and forward with both gradients, with ratios to the reference."""
    names = implementations(op)
    programs = {}
    for name in names:
        loss = looped(one(name), clips=True)
        forward, backward = jax.jit(loss), jax.jit(jax.grad(loss, (0, 1)))
        programs[f"{name} forward"] = lambda forward=forward: forward(weights, frames)
        programs[f"{name} gradient"] = lambda backward=backward: backward(weights, frames)
        if op == "convolution":
            native = jax.jit(jax.grad(looped(lambda w, x, n=name: convolve(x, w, implementation=n), False), (0, 1)))
            programs[f"{name} native"] = lambda native=native: native(weights, frames)
    times = compare(programs, rounds)
    for name in names:
        chosen = "*" if resolve(op, None) is resolve(op, name) else " "
        columns = ""
        for kind in ("forward", "gradient"):
            seconds = times[f"{name} {kind}"]
            columns += f"{kind} {seconds * 1e3:8.1f} ms ({seconds / times[f'reference {kind}']:5.2f})  "
        extra = ""
        if op == "convolution":
            extra = f"vmapped / native {times[f'{name} gradient'] / times[f'{name} native']:5.2f}"
        print(f"{title:22s} {chosen}{name:10s} {columns}{extra}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small images, few frames")
    quick = parser.parse_args().quick
    size, clips, frames, rounds = (32, 2, 2, 3) if quick else (64, 4, 10, 5)
    rng = np.random.default_rng(0)

    def random(*shape: int) -> jax.Array:
        return jnp.asarray(rng.standard_normal(shape), jnp.float32)

    print(f"{jax.default_backend()}, jax {jax.__version__}, {frames} frames of {clips} x {size} x {size};")
    print("(ratio to the reference), * is what implementation=None picks here")
    here = (frames, clips, size, size)
    for inputs, outputs in CONVOLUTIONS[1:2] if quick else CONVOLUTIONS:
        measure(
            f"convolution {inputs}->{outputs}",
            "convolution",
            lambda name: lambda kernel, x: convolve(x[None], kernel, implementation=name)[0],
            random(3, 3, inputs, outputs),
            random(*here, inputs),
            rounds,
        )
    measure(
        "apply_kernels 5x5 RGB",
        "apply_kernels",
        lambda name: lambda scale, x: apply_kernels(x[0], normalize_kernels(scale * x[1]), implementation=name),
        jnp.ones(()),
        (random(*here, 3), random(*here, 25)),
        rounds,
    )
    for border in ("clamp", "zeros"):

        def warped(name: str, border: str = border) -> Callable[..., jax.Array]:
            return lambda scale, x: warp(scale * x[0], 4 * x[1], border=border, implementation=name)

        measure(f"warp {border} RGB", "warp", warped, jnp.ones(()), (random(*here, 3), random(*here, 2)), rounds)


if __name__ == "__main__":
    main()
