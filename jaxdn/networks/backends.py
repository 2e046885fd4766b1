"""The backends that can run a network instead of plain XLA, and their purposes."""

from collections.abc import Callable
from typing import Literal, NamedTuple

from jaxdn.networks import onednn, onnx
from jaxdn.ops.onednn import library

Purpose = Literal["inference", "training"]


class Backend(NamedTuple):
    """A value of a network's option ``implementation``; their features and results are float32."""

    name: str
    purpose: Purpose
    """The work for which it is the default, where it is faster than XLA."""
    available: Callable[[], bool]
    """Whether it can run here: it is installed and supports jax's device."""
    faster: Callable[[], bool] = lambda: True
    """Whether it is faster than XLA here, if it can run: else it is used only on request."""


BACKENDS: dict[str, Backend] = {
    "onednn-bfloat16": Backend("onednn-bfloat16", "inference", onednn.computes_bfloat16),
    "onednn-float32": Backend("onednn-float32", "inference", library.available),
    "onnxruntime": Backend("onnxruntime", "inference", onnx.available),
    "onednn": Backend("onednn", "training", library.available, library.training_is_faster),
}
