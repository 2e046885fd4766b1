"""How far learned networks deviate from invariances of filters: flips, channels, brightness."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.candidates import candidate, filters
from jaxdn.frame import BUFFERS, Buffer, Clip, Frame
from jaxdn.weights import shipped_names
from tests.hard_cases.inputs import good
from tests.hard_cases.subjects import denoised

FRAMES, HEIGHT, WIDTH = 8, 64, 96
"""Multiples of 16: padding at one side is not tested here."""


class Law(NamedTuple):
    """One transformation of the input, and how far a method is from transforming its output equally."""

    law: str
    method: str
    difference: float
    """RMS of (denoised change - changed denoised clip) over the RMS of the latter."""
    error: float
    """RMS of (denoised clip - reference) over the same, to compare the difference with."""


def _changed(clip: Clip, change: Callable[[Buffer, np.ndarray], np.ndarray]) -> Clip:
    """The clip with ``change(buffer, values)`` of all its buffers; the reference is light, as ``radiance`` is."""
    frames = {name: change(BUFFERS[name], np.asarray(values)) for name, values in clip.frames._asdict().items()}
    return Clip(Frame(**frames), change(BUFFERS["radiance"], np.asarray(clip.reference)))


def _flipped(axis: int, sign: tuple[float, float]) -> Callable[[Clip], Clip]:
    """Mirror every buffer along x (axis -2) or y (axis -3); vectors across it change their sign, normals do not.

    World-space normals stay: a flipped image shows a mirrored scene in mirrored axes.
    """

    def flip(buffer: Buffer, values: np.ndarray) -> np.ndarray:
        return np.flip(values * np.asarray(sign, np.float32) if buffer.kind == "vector" else values, axis)

    return lambda clip: _changed(clip, flip)


def _brighter(factor: float) -> Callable[[Clip], Clip]:
    """All light times ``factor``."""
    return lambda clip: _changed(
        clip, lambda buffer, values: factor * values if buffer.kind in ("light", "signed") else values
    )


def _permuted(clip: Clip) -> Clip:
    """Red, green and blue permuted in every buffer that has colours."""

    def permute(buffer: Buffer, values: np.ndarray) -> np.ndarray:
        colored = buffer.channels == 3 and buffer.kind in ("light", "fraction")
        return values[..., [1, 2, 0]] if colored else values

    return _changed(clip, permute)


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
    """Every law for every network that has shipped weights, and for the filters to compare with."""
    clip = good(frames=FRAMES, height=HEIGHT, width=WIDTH).clip
    for name in (*shipped_names(), *filters()):
        one = candidate(name)
        run = jax.jit(partial(denoised, one.denoiser, one.params))
        plain = np.asarray(run(clip))
        for law, change in CHANGES.items():
            expected = change(Clip(clip.frames, plain)).reference
            size = _rms(expected)
            yield Law(law, name, _rms(run(change(clip)) - expected) / size, _rms(plain - clip.reference) / _rms(plain))


def _rms(values: Any) -> float:
    return float(jnp.sqrt(jnp.mean(jnp.square(jnp.asarray(values)))))
