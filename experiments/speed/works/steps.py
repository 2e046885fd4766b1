"""One recurrent ``ntd`` step at 1280x720: ours in each backend, the same network in PyTorch, Open Image Denoise."""

from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import peers, roofline
from experiments.speed.timing import Call
from experiments.speed.works import Work, scene
from jaxdn.core.frame import Frame, frame_at
from jaxdn.denoiser import Denoiser
from jaxdn.methods.registry import method_named
from jaxdn.networks import LARGE, SMALL
from jaxdn.networks.backends import BACKENDS, Purpose
from jaxdn.ops.oidn import OidnSettings, Quality, denoise

HEIGHT, WIDTH = 720, 1280
WIDTHS = {"large": LARGE, "small": SMALL}
METHOD = method_named("ntd")
"""The method whose network the peers also implement."""
PLAIN = {"kernels": "plain", "background": "filter", "exposure": "given", "initialization": "xavier"}
"""Options of the paper's form of it, which is the one that they implement."""


def implementations(purpose: Purpose) -> dict[str, dict[str, Any]]:
    """Name in the results -> options of the method: XLA, and its backends for this purpose."""
    backends = [name for name in METHOD.backends if BACKENDS[name].purpose == purpose]
    return {"xla": {}, **{name: {"implementation": name} for name in backends}}


def program(denoiser: Denoiser) -> Callable[..., Any]:
    """The jitted step ``(params, state, frame) -> (state, image)`` whose state's memory is reused.

    The step itself and not :func:`jaxdn.denoiser.rollout.stream`, as the timed programs are compiled by other
    processes, which have to lower the same program (:mod:`experiments.speed.works.compilation`).
    """
    return jax.jit(denoiser.step, donate_argnums=1)


def recurrent(denoiser: Denoiser, params: Any, frame: Frame) -> Call:
    """A call that denoises ``frame``, jitted, with the state of the previous call."""
    step = program(denoiser)
    state = [jax.tree.map(jnp.copy, denoiser.start(params, frame))]

    def call() -> jax.Array:
        state[0], image = step(params, state[0], frame)
        return jax.block_until_ready(image)

    return call


def open_image_denoise(frame: Frame, quality: Quality) -> Call:
    """Open Image Denoise on radiance, albedo and normal; building the network is not timed."""
    arrays = tuple(np.asarray(buffer, np.float32) for buffer in (frame.radiance, frame.albedo, frame.normal))
    call = partial(denoise, *arrays, settings=OidnSettings(quality))
    call()
    return call


@cache
def frame_of(height: int, width: int) -> Frame:
    """What all implementations denoise; made once in a process."""
    return jax.tree.map(jnp.asarray, frame_at(scene.clip(2, height, width).frames, 1))


def ours(size: str, height: int, width: int, options: dict[str, Any]) -> Call:
    """The step with new weights."""
    denoiser, frame = METHOD.factory(size=size, **PLAIN, **options), frame_of(height, width)
    return recurrent(denoiser, denoiser.init(jax.random.key(0), frame), frame)


def pytorch(size: str, height: int, width: int, *, compiled: bool) -> Call:
    """The same with PyTorch's step, in inference mode."""
    import torch

    from experiments.speed.peers import pytorch as peer

    peer.prepare_process()
    frame = frame_of(height, width)
    step = peer.NTD(
        WIDTHS[size],
        METHOD.factory(size=size, **PLAIN).init(jax.random.key(0), frame),
        apply_kernels=peer.apply_kernels_loop,
        compile_network=compiled,
        compile_kernels=compiled,
    ).eval()
    buffers = {name: buffer[None] for name, buffer in peer.tensors(frame).items()}
    state = [peer.start(buffers["radiance"])]

    def call() -> torch.Tensor:
        with torch.inference_mode():
            state[0], image = step(state[0], buffers)
        return image

    return call


def oidn_high(height: int, width: int) -> Call:
    """Open Image Denoise on the same frame."""
    return open_image_denoise(frame_of(height, width), "high")


def oidn_high_once(height: int, width: int) -> Any:
    """The same with building the network, which keeps its memory."""
    return oidn_high(height, width)()


def works(*, height: int = HEIGHT, width: int = WIDTH, title: str = "720p") -> Iterator[Work]:
    """``step-large-720p`` and ``step-small-720p``."""
    lacking = peers.missing()
    for size, widths in WIDTHS.items():
        others: dict[str, Callable[[], Call]] = {}
        if "torch-compiled" not in lacking:
            others["torch-compiled"] = partial(pytorch, size, height, width, compiled=True)
        if "torch" not in lacking:
            others["torch-eager"] = partial(pytorch, size, height, width, compiled=False)
        alone = {}
        if "pyoidn" not in lacking:
            others["oidn-high"] = partial(oidn_high, height, width)
            alone["oidn-high"] = partial(oidn_high_once, height, width)
        yield Work(
            f"step-{size}-{title}",
            {
                name: partial(ours, size, height, width, options)
                for name, options in implementations("inference").items()
            },
            others,
            roofline.step(widths, height, width),
            alone=alone,
        )
