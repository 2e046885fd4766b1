"""The files of an exported step: StableHLO and ONNX."""

from typing import Any

import jax
import numpy as np
from jax import export

import jaxdn
from jaxdn.core.frame import BUFFERS
from jaxdn.export.graph import IR_VERSION, OPSET, Graph, element_type
from jaxdn.export.step import ExportedStep, name_buffer_channels
from jaxdn.export.translate import translate

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Where the StableHLO runs."""


def stablehlo(step: ExportedStep) -> bytes:
    """The step as ``jax.export`` serialises it; ``jax.export.deserialize(data).call(inputs)`` runs it.

    ``inputs`` and the result are dicts as in :class:`jaxdn.export.step.ExportedStep`. The StableHLO itself, a portable
    artifact for compilers other than JAX's, is its ``mlir_module_serialized``.
    """
    return bytes(export.export(jax.jit(step.function), platforms=PLATFORMS)(step.inputs).serialize())


def onnx_model(step: ExportedStep, name: str) -> bytes:
    """The step as an ONNX model, with :func:`about` as its metadata.

    Raises ValueError for an operation without a translation (:mod:`jaxdn.export.translate`).
    """
    from onnx import helper

    graph = Graph()
    lengths = ("height", "width")
    if step.multiple is not None:
        shape = graph.node("Shape", "radiance", output=graph.name("shape"))
        for axis, symbol in enumerate("hw"):
            length = graph.value("Gather", shape, graph.constant(np.int64(axis)), axis=0)
            graph.sizes[symbol] = graph.value("Div", length, graph.constant(np.int64(step.multiple)))
    results = translate(graph, step.program, list(step.inputs))

    def typed(one: str, value: Any) -> Any:
        named = [*lengths, None] if step.multiple is not None else [None] * 3
        shape = [size if isinstance(size, int) else named[axis] for axis, size in enumerate(value.shape)]
        return helper.make_tensor_value_info(one, element_type(value.dtype), shape)

    for output, result in zip(step.outputs, results, strict=True):
        graph.node("Identity", result, output=output)
    inputs = [typed(one, spec) for one, spec in step.inputs.items()]
    outputs = [typed(one, aval) for one, aval in zip(step.outputs, step.program.out_avals, strict=True)]
    made = graph.made("step", inputs, outputs)
    opsets = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(made, opset_imports=opsets, ir_version=IR_VERSION, producer_name="jaxdn")
    helper.set_model_props(model, about(step, name))
    return bytes(model.SerializeToString())


def about(step: ExportedStep, name: str) -> dict[str, str]:
    """What a program needs to know to run the step, as text.

    ``jaxdn`` is the version, ``method`` the name, ``multiple`` that of height and width, if they are free, and
    ``channels.BUFFER`` the channels of each buffer in the files of clips.
    """
    found = {"jaxdn": jaxdn.__version__, "method": name}
    if step.multiple is not None:
        found["multiple"] = str(step.multiple)
    return found | {f"channels.{one}": " ".join(name_buffer_channels(one)) for one in step.inputs if one in BUFFERS}
