"""Where the time of one ``ntd`` frame goes, in the paper's four parts, each jitted separately.

A step compiled as a whole shares memory between its parts, so the sum of the parts may take longer.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from experiments.speed.timing import Call, Timing, measure
from experiments.speed.works import steps
from jaxdn import brdf, color
from jaxdn.core.frame import FAR, Frame
from jaxdn.core.options import make
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.sanitize import sanitize, sanitize_image
from jaxdn.denoiser.statistics import measure_frame
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods.ntd import guided_features
from jaxdn.methods.reconstruction import TAPS
from jaxdn.networks import MULTIPLE, Widths
from jaxdn.networks.backends import BACKENDS
from jaxdn.networks.unet import unet
from jaxdn.ops.kernel_prediction.softmax import softmax_filter
from jaxdn.ops.motion import on_screen
from jaxdn.ops.scales import compose_scales, downsample, fill_holes
from jaxdn.ops.warp import warp
from jaxdn.zoo.ready import Model

GROUPS = (3, 3, 3, 1, 3, 1)
HEADS = (2 * TAPS + 1, TAPS + 1, TAPS + 1)

REPROJECTION, NETWORK, FILTERING, BLENDING = "reprojection", "features and kernels", "applying kernels", "blending"
WHOLE = "whole step"


class Subject(NamedTuple):
    """A step whose parts can be timed."""

    name: str
    """Weights and backend."""
    widths: Widths
    denoiser: Denoiser
    params: Params
    backend: str


def subjects(denoisers: Sequence[Model], *, quick: bool = False) -> Iterator[Subject]:
    """Denoisers whose step has the parts below, in plain XLA and in each available backend (``quick``: only XLA).

    These are weights of ``ntd`` with its default options and any size of network: others change the parts.
    """
    method = steps.METHOD
    fitting = [BACKENDS[name] for name in method.backends if BACKENDS[name].purpose == "inference"]
    backends = ["reference", *(each.name for each in fitting if each.available() and not quick)]
    for each in denoisers:
        if each.method != method:
            continue
        options: Any = make(method.options, each.options, method=method.name)
        ordinary: Any = method.options()
        kept = {"size": ordinary.size, "initialization": ordinary.initialization}
        if dataclasses.replace(options, **kept) != ordinary:
            continue
        widths = steps.WIDTHS.get(options.size, options.size)
        for backend in backends:
            denoiser = method.factory(**{**each.options, "implementation": backend})
            yield Subject(f"{each.label}, {backend}", widths, denoiser, each.params, backend)


def reproject(history: jax.Array, frame: Frame, noisy: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The warped history, with the noisy pixel where it is missing, and a mask of the missing pixels."""
    lost = ~on_screen(frame.dual_motion)
    return jnp.where(lost, noisy, sanitize_image(warp(history, frame.dual_motion))), lost


Images = tuple[jax.Array, ...]


def apply_kernels(noisy: jax.Array, recalled: jax.Array, heads: Images, guiding: Sequence[jax.Array | None]) -> Images:
    """The noisy image at three scales and the history, filtered."""
    full, half, quarter = heads
    middle = downsample(noisy)
    coarse = softmax_filter(downsample(middle)[None], quarter, features=guiding[2])[0]
    finest, temporal = softmax_filter(jnp.stack([noisy, recalled]), full, features=guiding[0])
    return coarse, softmax_filter(middle[None], half, features=guiding[1])[0], finest, temporal


def blend(filtered: Images, heads: Images, lost: jax.Array, colors: jax.Array, frame: Frame) -> jax.Array:
    """The scales composed, blended with the history, multiplied by what surfaces reflect; the background as it was."""
    coarse, middle, finest, temporal = filtered
    full, half, quarter = heads
    composed = compose_scales(middle, coarse, jax.nn.sigmoid(quarter[..., TAPS:]))
    composed = compose_scales(finest, composed, jax.nn.sigmoid(half[..., TAPS:]))
    current = jnp.where(lost, 1.0, jax.nn.sigmoid(full[..., 2 * TAPS :]))
    image = jnp.maximum(current * composed + (1.0 - current) * temporal, 0.0) * colors
    return jnp.where(frame.depth < FAR, image, frame.radiance)


def breakdown(subject: Subject, frame: Frame, *, rounds: int) -> dict[str, Timing]:
    """The four parts and the whole step, timed interleaved, for a frame whose sides are multiples of 16."""
    height, width = frame.radiance.shape[:2]
    if height % MULTIPLE or width % MULTIPLE:
        raise ValueError(f"frame: expected sides that are multiples of {MULTIPLE}, got {height} x {width}.")
    params = subject.params
    network = unet(GROUPS, HEADS, widths=subject.widths, implementation=subject.backend)

    def predict(params: Params, frame: Frame, noisy: jax.Array, recalled: jax.Array, lost: jax.Array) -> Any:
        frame, _ = sanitize(frame)
        known = frame.depth < FAR
        noisy, recalled = fill_holes(noisy, known), fill_holes(recalled, known)
        gain, scale = color.exposure(noisy), measure_frame(noisy, frame.depth, frame).mean_depth
        seen = {"albedo": frame.albedo - 1.0, "normal": frame.normal, "depth": depth_feature(frame.depth, scale)}
        history = color.compress(gain * recalled)
        features = [color.compress(gain * noisy), *seen.values(), history, lost.astype(noisy.dtype)]
        layers = {name: part for name, part in params.items() if name != "guide"}
        heads = tuple(head[0] for head in network.apply(layers, [feature[None] for feature in features]))
        return (noisy, recalled), heads, guided_features(params["guide"], seen)

    colors = brdf.divisor(frame.albedo if frame.reflectance is None else frame.reflectance)
    noisy = frame.radiance / colors
    reproject_jit, predict_jit = jax.jit(reproject), jax.jit(predict)
    recalled, lost = reproject_jit(noisy, frame, noisy)
    images, heads, guiding = predict_jit(params, frame, noisy, recalled, lost)
    apply_jit = jax.jit(apply_kernels)
    filtered = apply_jit(*images, heads, guiding)
    calls: dict[str, Call] = {
        REPROJECTION: _waiting(reproject_jit, noisy, frame, noisy),
        NETWORK: _waiting(predict_jit, params, frame, noisy, recalled, lost),
        FILTERING: _waiting(apply_jit, *images, heads, guiding),
        BLENDING: _waiting(jax.jit(blend), filtered, heads, lost, colors, frame),
        WHOLE: steps.recurrent(subject.denoiser, params, frame),
    }
    return measure(calls, rounds=rounds)


def _waiting(function: Callable[..., Any], *arguments: Any) -> Call:
    return lambda: jax.block_until_ready(function(*arguments))
