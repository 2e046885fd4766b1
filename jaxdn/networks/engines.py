"""The engines that can run a network instead of plain XLA, and their purposes."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from jaxdn.networks import onnx
from jaxdn.ops import onednn

Purpose = Literal["inference", "training"]


class Engine(NamedTuple):
    """A value of a network's option ``implementation``; both engines compute only in float32."""

    name: str
    purpose: Purpose
    """The work at which it is faster than XLA, and for which it is the default."""
    available: Callable[[], bool]
    """Whether it can run here: it is installed and supports jax's device."""


ENGINES: dict[str, Engine] = {
    "onnxruntime": Engine("onnxruntime", "inference", onnx.available),
    "onednn": Engine("onednn", "training", onednn.available),
}
