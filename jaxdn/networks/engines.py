"""What can run a network besides plain XLA, and what for."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from jaxdn.networks import onnx
from jaxdn.ops import onednn

Purpose = Literal["inference", "training"]


class Engine(NamedTuple):
    """A value of a network's option ``implementation``; both engines compute in float32 alone."""

    name: str
    purpose: Purpose
    """What it is faster at than XLA, and taken for when nobody names an engine."""
    available: Callable[[], bool]
    """Whether it can run here: installed, and jax computes on a device that it knows."""


ENGINES: dict[str, Engine] = {
    "onnxruntime": Engine("onnxruntime", "inference", onnx.available),
    "onednn": Engine("onednn", "training", onednn.available),
}
