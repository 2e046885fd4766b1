"""The ways to an image that are compared, from the registries: new denoisers and weights appear by themselves."""

import inspect
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed import peers
from experiments.speed.timing import Call
from experiments.speed.works import steps
from jaxdn import denoisers
from jaxdn.denoiser import Denoiser
from jaxdn.frame import Frame, frame_at, only, written_out
from jaxdn.networks import Widths, onnx
from jaxdn.weights import describe, load_weights, shipped_names

DENOISED_SPP = (1, 2, 4, 8)
"""Samples a pixel of what is denoised."""

UNTRAINED: dict[str, Widths] = {
    "ntd medium": ((24, 24), (48, 48), (48, 48), (64, 64), (80, 80)),
    "ntd tiny": ((8,), (16, 16), (24, 24), (32, 32), (32, 32)),
}
"""Widths for which there are no trained weights: what they cost can be told, how good they are cannot."""

STILL = frozenset({"motion", "dual_motion", "previous_depth", "visible"})
"""The buffers that a scene in which nothing moves does not have."""


ALL = "effects all"
"""The variant with every buffer written out: the image is that of the plain form, to be told by its time alone."""


class Method(NamedTuple):
    """One way from noisy frames to images."""

    name: str
    family: str
    """What it is a variant of: one colour in the plot."""
    variant: str
    """How it differs from the plain form: one sign in the plot."""
    guides: str
    """What it needs of the renderer besides light: "features" (albedo, normals), or "motion" too."""
    timed: Callable[[Frame], Call]
    """A call that denoises one frame [H, W, C] once more, for timing."""
    images: Callable[[Frame], np.ndarray] | None
    """Frames [T, H, W, C] -> images [T, H, W, 3]; None where only the time can be told."""
    group: str
    """Methods of one group are timed in turns."""


def ours(
    family: str,
    variant: str,
    denoiser: Denoiser,
    params: Any,
    *,
    prepare: Callable[[Frame], Frame] = lambda frame: frame,
    scored: bool = True,
) -> Method:
    """A denoiser of this package; ``prepare`` chooses the buffers it gets."""

    def select(frame: Frame) -> Frame:
        return jax.tree.map(jnp.asarray, prepare(only(frame, denoiser.reads)))

    def timed(frame: Frame) -> Call:
        return steps.recurrent(denoiser, params, select(frame))

    def images(frames: Frame) -> np.ndarray:
        # One step, compiled once for all sample counts and clips, and no scan for each.
        step, frames = jax.jit(denoiser.step, donate_argnums=1), select(frames)
        state = jax.tree.map(jnp.copy, denoiser.start(params, frame_at(frames, 0)))
        results = []
        for index in range(frames.radiance.shape[0]):
            state, image = step(params, state, frame_at(frames, index))
            results.append(np.asarray(image))
        return np.stack(results)

    guides = "motion" if denoiser.reads & STILL else "features"
    name = family if variant == "plain" else f"{family}, {variant}"
    return Method(name, family, variant, guides, timed, images if scored else None, family)


def everything(names: frozenset[str]) -> Callable[[Frame], Frame]:
    """Every buffer of these written out, whatever the scene calls for: effects ``all``."""
    return lambda frame: written_out(frame, names)


def standing_still(frame: Frame) -> Frame:
    """The frame of a scene in which nothing moves."""
    return frame._replace(**dict.fromkeys(STILL))


def registered() -> Iterator[Method]:
    """Filters without weights, and shipped weights, each in all its variants."""
    smallest = Frame(np.zeros((16, 16, 3), np.float32))
    for name in denoisers.NAMES:
        factory = getattr(denoisers, name)
        if not jax.eval_shape(factory().init, jax.random.key(0), smallest):
            yield from variants(name, factory, lambda factory=factory, **options: (factory(**options), {}))
    for name in shipped_names():
        factory = getattr(denoisers, describe(name)["factory"])
        yield from variants(name, factory, partial(load_weights, name))


def variants(
    name: str, factory: Callable[..., Denoiser], load: Callable[..., tuple[Denoiser, Any]]
) -> Iterator[Method]:
    """The plain form, then what the factory has options for, then other sets of buffers."""
    options = inspect.signature(factory).parameters
    denoiser, params = load()
    yield ours(name, "plain", denoiser, params)
    if "implementation" in options and onnx.available():
        yield ours(name, "onnxruntime", *load(implementation="onnxruntime"))
    if "compute_dtype" in options:
        yield ours(name, "bfloat16", *load(compute_dtype="bfloat16"))
    if "demodulate" in options:
        yield ours(name, "not demodulated", *load(demodulate=False))
    yield ours(name, ALL, denoiser, params, prepare=everything(denoiser.reads))
    yield ours(name, "still scene", denoiser, params, prepare=standing_still, scored=False)


def untrained() -> Iterator[Method]:
    """Networks of other widths with random weights: time alone."""
    for name, widths in UNTRAINED.items():

        def timed(frame: Frame, widths: Widths = widths) -> Call:
            denoiser = denoisers.ntd(size=widths)
            frame = jax.tree.map(jnp.asarray, only(frame, denoiser.reads))
            return steps.recurrent(denoiser, denoiser.init(jax.random.key(0), frame), frame)

        yield Method(name, "untrained widths", "untrained", "motion", timed, None, "untrained widths")


def pytorch() -> Iterator[Method]:
    """The network of the shipped weights in PyTorch: the same image, so time alone."""
    lacking = peers.missing()
    for size in ("large", "small"):
        _, params = load_weights(f"ntd-{size}")
        for compiled in (False, True):
            if ("torch-compiled" if compiled else "torch") not in lacking:

                def timed(frame: Frame, size: str = size, params: Any = params, compiled: bool = compiled) -> Call:
                    return steps.pytorch(size, params, frame, compiled=compiled)

                variant = "compiled" if compiled else "eager"
                name, group = f"ntd-{size} in PyTorch, {variant}", f"ntd-{size}"
                yield Method(name, "PyTorch", variant, "motion", timed, None, group)


def open_image_denoise() -> Iterator[Method]:
    """Open Image Denoise with albedo and normals, in its three qualities."""
    if "pyoidn" in peers.missing():
        return
    from experiments.speed.peers.oidn import oidn

    for quality in ("high", "balanced", "fast"):

        def images(frames: Frame, quality: str = quality) -> np.ndarray:
            frames = written_out(frames, ("albedo", "normal"))
            arrays = [np.asarray(buffer, np.float32) for buffer in (frames.radiance, frames.albedo, frames.normal)]
            denoise = oidn(*arrays[0].shape[1:3], quality=quality)
            return np.stack([denoise(*frame).copy() for frame in zip(*arrays, strict=True)])

        def timed(frame: Frame, quality: str = quality) -> Call:
            return steps.open_image_denoise(frame, quality)

        variant = "plain" if quality == "high" else quality
        yield Method(f"oidn {quality}", "Open Image Denoise", variant, "features", timed, images, "ntd-large")


def methods() -> list[Method]:
    """Everything that can be run here."""
    return [*registered(), *open_image_denoise(), *untrained(), *pytorch()]


def left_out() -> list[str]:
    """Why some rows are missing here, in sentences."""
    sentences = list(dict.fromkeys(peers.missing().values()))
    if not onnx.available():
        sentences.append("ONNX Runtime is not installed or jax does not compute on the CPU: its rows are left out.")
    return sentences
