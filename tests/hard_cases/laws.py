"""How far the learned networks are from what a filter obeys by construction: flips, channels, brightness."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdn
from jaxdn.frame import Clip, Frame
from jaxdn.weights import shipped_names
from tests.hard_cases.inputs import good

FRAMES, HEIGHT, WIDTH = 8, 64, 96
"""Multiples of 16: padding at one side is not what is asked here."""


class Law(NamedTuple):
    """One change of the input, and how far a method is from changing its output alike."""

    law: str
    method: str
    difference: float
    """RMS of (denoised change - changed denoised clip) over the RMS of the latter."""
    error: float
    """RMS of (denoised clip - reference) over the same: what the difference is to be compared with."""


def _flipped(axis: int, sign: tuple[float, float]) -> Callable[[Clip], Clip]:
    """Mirror every buffer along x (axis -2) or y (axis -3); vectors across it change their sign, normals do not.

    World-space normals belong to the scene, which a camera may see in a mirror.
    """

    def change(clip: Clip) -> Clip:
        frames = clip.frames._asdict()
        for name in ("motion", "dual_motion"):
            frames[name] = frames[name] * np.asarray(sign, np.float32)
        return jax.tree.map(lambda buffer: np.flip(np.asarray(buffer), axis), Clip(Frame(**frames), clip.reference))

    return change


def _brighter(factor: float) -> Callable[[Clip], Clip]:
    def change(clip: Clip) -> Clip:
        frames = clip.frames
        light = {name: factor * getattr(frames, name) for name in ("radiance", "direct", "emission")}
        return Clip(frames._replace(**light), factor * clip.reference)

    return change


def _permuted(clip: Clip) -> Clip:
    frames = clip.frames
    colors = {name: getattr(frames, name)[..., [1, 2, 0]] for name in ("radiance", "albedo", "direct", "emission")}
    return Clip(frames._replace(**colors), clip.reference[..., [1, 2, 0]])


CHANGES: dict[str, Callable[[Clip], Clip]] = {
    "mirrored left to right": _flipped(-2, (-1, 1)),
    "mirrored top to bottom": _flipped(-3, (1, -1)),
    "red, green and blue exchanged": _permuted,
    "a sixteenth of the light": _brighter(1 / 16),
    "a quarter of the light": _brighter(1 / 4),
    "four times the light": _brighter(4.0),
    "sixteen times the light": _brighter(16.0),
}


def measured() -> Iterator[Law]:
    """Every law for every network that has shipped weights, and for a filter beside them."""
    clip = good(frames=FRAMES, height=HEIGHT, width=WIDTH).clip
    methods: dict[str, tuple[jaxdn.Denoiser, Any]] = {name: jaxdn.load_weights(name) for name in shipped_names()}
    methods["svgf"] = (jaxdn.denoisers.svgf(), {})
    for method, (denoiser, params) in methods.items():
        run = jax.jit(lambda clip, denoiser=denoiser, params=params: jaxdn.denoise(denoiser, params, clip))
        plain = np.asarray(run(clip))
        for law, change in CHANGES.items():
            expected = change(Clip(clip.frames, plain)).reference
            size = _rms(expected)
            yield Law(
                law, method, _rms(run(change(clip)) - expected) / size, _rms(plain - clip.reference) / _rms(plain)
            )


def _rms(values: Any) -> float:
    return float(jnp.sqrt(jnp.mean(jnp.square(jnp.asarray(values)))))
