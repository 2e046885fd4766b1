"""A network run by ONNX Runtime, an inference backend for CPUs, from inside a jitted program.

XLA:CPU's convolutions reach about two thirds of the machine's peak. ONNX Runtime keeps activations in blocks of 16
channels from one convolution to the next; a 720p step takes 0.77 to 1.03 of XLA's time (``docs/results/index.md``). It
is an extra (``pip install onnxruntime onnx``) and for inference only: the gradient is that of the network in plain XLA,
recomputed. None of this is visible outside: ``unet(..., implementation="onnxruntime")`` is the same pure function.
"""

import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.networks.graph import FEATURES, GraphSpec, Weights, evaluate, output_shapes, same_weights
from jaxdn.runtime.optional import install

OPSET = 17
BLOCK = 16
"""Channels that the backend computes at a time; other input counts take a slow path (3 times the time)."""


def available() -> bool:
    """Whether ONNX Runtime can be imported and jax computes on the CPU."""
    from importlib.util import find_spec

    return jax.default_backend() == "cpu" and all(find_spec(name) is not None for name in ("onnxruntime", "onnx"))


def unavailable() -> str:
    """Why the backend cannot run here, and what to do; empty if it can."""
    if (backend := jax.default_backend()) != "cpu":
        return f"runs on the CPU, and jax computes on {backend!r}; leave it None, or set JAX_PLATFORMS=cpu"
    return "" if available() else f"needs the packages onnxruntime and onnx: {install('onnx')}"


class OnnxGraph:
    """The nodes of an ONNX graph (:class:`jaxdn.networks.graph.LayerBackend`); values are names, [N, C, H, W]."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, array: np.ndarray) -> str:
        from onnx import numpy_helper

        self.constants.append(numpy_helper.from_array(np.asarray(array, order="C"), f"constant_{len(self.constants)}"))
        return self.constants[-1].name

    def node(self, kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        from onnx import helper

        output = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def convolution(self, inputs: Sequence[str], kernels: Sequence[np.ndarray], bias: np.ndarray) -> str:
        # The backend adds a sum of two convolutions in place, which is cheaper than to join their inputs.
        parts: list[str] = []
        for x, kernel in zip(inputs, kernels, strict=True):
            spare = -kernel.shape[2] % BLOCK if x == FEATURES else 0
            kernel = np.pad(kernel, ((0, 0), (0, 0), (0, spare), (0, 0))).transpose(3, 2, 0, 1)  # HWIO as OIHW
            constants = [kernel, bias] if x == inputs[-1] else [kernel]
            size = kernel.shape[-1]
            arguments = x, *map(self.constant, constants)
            parts.append(self.node("Conv", *arguments, kernel_shape=[size, size], pads=[size // 2] * 4))
        return functools.reduce(functools.partial(self.node, "Add"), parts)

    def rectifier(self, x: str, slope: float) -> str:
        return self.node("LeakyRelu", x, alpha=slope)

    def pool(self, x: str) -> str:
        return self.node("MaxPool", x, kernel_shape=[2, 2], strides=[2, 2])

    def upsample(self, x: str) -> str:
        twice = self.constant(np.asarray([1, 1, 2, 2], np.float32))
        how = {"mode": "nearest", "nearest_mode": "floor", "coordinate_transformation_mode": "asymmetric"}
        return self.node("Resize", x, "", twice, **how)


def model(network: GraphSpec, weights: Weights, shape: Sequence[int]) -> bytes:
    """The network with these weights as a serialised ONNX graph.

    Its input is :data:`FEATURES` of ``shape`` [N, c, H, W], c a multiple of :data:`BLOCK`; its outputs are named as
    the description's and [N, h, w, channels].
    """
    from onnx import TensorProto, helper

    graph = OnnxGraph()
    for name, planes in zip(network.outputs, evaluate(network, weights, {FEATURES: FEATURES}, graph), strict=True):
        graph.node("Transpose", planes, output=name, perm=[0, 2, 3, 1])
    features = helper.make_tensor_value_info(FEATURES, TensorProto.FLOAT, list(shape))
    outputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in network.outputs]
    made = helper.make_graph(graph.nodes, "network", [features], outputs, graph.constants)
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=8).SerializeToString()


class Session:
    """The session of one shape, created for the weights of its last call.

    The backend rearranges weights for its blocks, so they belong to the session. Every call compares its weights with
    those of the session (by bytes, about a millisecond), which keeps the function pure.
    """

    def __init__(
        self, shape: Sequence[int], groups: int, names: Sequence[str], describe: Callable[[list[np.ndarray]], bytes]
    ) -> None:
        self._groups, self._names, self._describe = groups, names, describe
        self._planes = np.zeros(shape, np.float32)  # kept: allocating new memory takes longer than writing to it
        self._weights: list[np.ndarray] = []
        self._session: Any = None
        self._lock = threading.Lock()

    def __call__(self, context: Any, outputs: Sequence[Any], *arguments: Any) -> None:
        """Fill ``outputs``; the arguments, feature groups and then weights, are views of XLA's own buffers."""
        with self._lock:
            arrays = [np.asarray(argument) for argument in arguments]
            self._prepare(arrays[self._groups :])
            first = 0
            for group in arrays[: self._groups]:
                last = first + group.shape[-1]
                np.copyto(self._planes[:, first:last], group.transpose(0, 3, 1, 2))
                first = last
            binding = self._session.io_binding()
            binding.bind_input(FEATURES, "cpu", 0, np.float32, self._planes.shape, self._planes.ctypes.data)
            for name, output in zip(self._names, outputs, strict=True):
                head = np.asarray(output)
                binding.bind_output(name, "cpu", 0, np.float32, head.shape, head.ctypes.data)
            self._session.run_with_iobinding(binding)

    def _prepare(self, weights: list[np.ndarray]) -> None:
        if same_weights(weights, self._weights):
            return
        import onnxruntime

        options = onnxruntime.SessionOptions()
        # An arena would keep all that a run needed, between runs too; without one, runs take as long.
        options.enable_cpu_mem_arena = False
        options.intra_op_num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
        options.log_severity_level = 3
        own = [weight.copy() for weight in weights]
        self._session = onnxruntime.InferenceSession(self._describe(own), options, providers=["CPUExecutionProvider"])
        self._weights = own  # after what may fail


def run(network: GraphSpec, weights: Weights, groups: list[jax.Array]) -> tuple[jax.Array, ...]:
    """The outputs of the network for the feature groups [N, H, W, c] that are present, float32."""
    channels = network.layers[FEATURES].channels
    shape = (groups[0].shape[0], channels + -channels % BLOCK, *groups[0].shape[1:3])
    leaves, tree = jax.tree.flatten(weights)
    session = Session(
        shape, len(groups), network.outputs, lambda leaves: model(network, jax.tree.unflatten(tree, leaves), shape)
    )
    results = [jax.ShapeDtypeStruct(each, np.float32) for each in output_shapes(network, groups[0].shape)]
    # The groups are passed separately: XLA would concatenate them into newly allocated memory first.
    return tuple(buffer_callback(session, results, vmap_method="sequential")(*groups, *leaves))
