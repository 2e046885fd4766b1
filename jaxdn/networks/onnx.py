"""The U-Net run by ONNX Runtime, an inference engine for CPUs, from inside a jitted program.

XLA:CPU's convolutions reach about two thirds of the machine's peak. ONNX Runtime keeps activations in blocks of 16
channels from one convolution to the next; a 720p step takes 0.77 to 1.03 of XLA's time (``docs/performance.md``). It
is an extra (``pip install jaxdn[onnx]``) and for inference only: the gradient is that of the U-Net in plain XLA,
recomputed. None of this is visible outside: ``unet(..., implementation="onnxruntime")`` is the same pure function.
"""

import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from jaxdn.networks import LEVELS

OPSET = 17
BLOCK = 16
"""Channels that the engine computes at a time; other input counts take a slow path (3 times the time)."""

Apply = Callable[[dict[str, Any], list[jax.Array]], tuple[jax.Array, ...]]
"""(params, the present feature groups [N, H, W, c]) -> heads."""


def available() -> bool:
    """Whether ONNX Runtime can be imported and jax computes on the CPU."""
    from importlib.util import find_spec

    return jax.default_backend() == "cpu" and all(find_spec(name) is not None for name in ("onnxruntime", "onnx"))


def check_available() -> None:
    """Raise ValueError, with what to do, where the engine cannot run."""
    if jax.default_backend() != "cpu":
        raise ValueError(
            f'implementation: "onnxruntime" runs on the CPU, and jax computes on {jax.default_backend()!r}; '
            "leave it None, or set JAX_PLATFORMS=cpu."
        )
    if not available():
        raise ValueError(
            'implementation: "onnxruntime" needs the packages onnxruntime and onnx; pip install "jaxdn[onnx]".'
        )


def model(
    params: dict[str, Any], shape: tuple[int, ...], used: Sequence[slice] | None, heads: int, slope: float
) -> bytes:
    """The U-Net with these weights as a serialised ONNX graph.

    Its input is ``planes``; its outputs ``head_0`` ... are [N, H / 2^i, W / 2^i, channels].

    Args:
      params: the weights.
      shape: [N, c, H, W] of ``planes``, c a multiple of :data:`BLOCK`.
      used: the slices of the first kernel's inputs that ``planes`` consists of; None: all.
      heads: number of outputs.
      slope: of the LeakyReLU for negative inputs.
    """
    from onnx import TensorProto, helper, numpy_helper

    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(array: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(np.ascontiguousarray(array), f"constant_{len(constants)}"))
        return constants[-1].name

    def node(kind: str, *inputs: str, output: str | None = None, **attributes: Any) -> str:
        output = output or f"value_{len(nodes)}"
        nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def convolution(x: str, kernel: np.ndarray, bias: np.ndarray | None) -> str:
        """HWIO as OIHW; zeros beyond the border."""
        arguments = [x, constant(kernel.transpose(3, 2, 0, 1)), *([] if bias is None else [constant(bias)])]
        size = kernel.shape[0]
        return node("Conv", *arguments, kernel_shape=[size, size], pads=[size // 2] * 4)

    def activated(x: str) -> str:
        return node("LeakyRelu", x, alpha=slope)

    def level(x: str, name: str, first: int = 0) -> str:
        layers = params[name]
        for index in range(first, len(layers)):
            layer = layers[f"convolution_{index}"]
            x = activated(convolution(x, layer["kernel"], layer["bias"]))
        return x

    entry = params["encoder_0"]["convolution_0"]
    kernel = entry["kernel"]
    if used is not None:
        kernel = np.concatenate([kernel[:, :, channels] for channels in used], axis=2)
    kernel = np.pad(kernel, ((0, 0), (0, 0), (0, shape[1] - kernel.shape[2]), (0, 0)))
    x = level(activated(convolution("planes", kernel, entry["bias"])), "encoder_0", first=1)
    skips, channels = [x], [_outputs(params["encoder_0"])]
    for depth in range(1, LEVELS):
        x = level(node("MaxPool", x, kernel_shape=[2, 2], strides=[2, 2]), f"encoder_{depth}")
        skips.append(x)
        channels.append(_outputs(params[f"encoder_{depth}"]))
    twice = constant(np.asarray([1, 1, 2, 2], np.float32))
    below = channels[-1]
    for depth in reversed(range(LEVELS - 1)):
        larger = node(
            "Resize", x, "", twice, mode="nearest", nearest_mode="floor", coordinate_transformation_mode="asymmetric"
        )
        layer = params[f"decoder_{depth}"]["convolution_0"]
        # A sum of two convolutions, which the engine adds in place, is cheaper than concatenating their inputs.
        total = node(
            "Add",
            convolution(larger, layer["kernel"][:, :, :below], None),
            convolution(skips[depth], layer["kernel"][:, :, below:], layer["bias"]),
        )
        x = level(activated(total), f"decoder_{depth}", first=1)
        below = channels[depth]
        if depth < heads:
            head = params[f"head_{depth}"]
            planes = convolution(x, head["kernel"], head["bias"])
            node("Transpose", planes, output=f"head_{depth}", perm=[0, 2, 3, 1])

    def value(name: str, shape: Sequence[int]) -> Any:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, list(shape))

    outputs = [value(f"head_{depth}", head_shape(params, shape, depth)) for depth in range(heads)]
    graph = helper.make_graph(nodes, "unet", [value("planes", shape)], outputs, constants)
    graph_model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    graph_model.ir_version = 8
    return graph_model.SerializeToString()


def _outputs(level: dict[str, Any]) -> int:
    return level[f"convolution_{len(level) - 1}"]["bias"].shape[0]


def head_shape(params: dict[str, Any], shape: Sequence[int], depth: int) -> tuple[int, ...]:
    """[N, H, W, channels] of a head, for planes of ``shape`` [N, c, H, W]."""
    return shape[0], shape[2] >> depth, shape[3] >> depth, params[f"head_{depth}"]["bias"].shape[0]


class Session:
    """The session of one shape, created for the weights of its last call.

    The engine rearranges weights for its blocks, so they belong to the session. Every call compares its weights with
    those of the session (by bytes, about a millisecond), which keeps the function pure.
    """

    def __init__(self, shape: tuple[int, ...], groups: int, describe: Callable[[list[np.ndarray]], bytes]) -> None:
        self._groups, self._describe = groups, describe
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
            binding.bind_input("planes", "cpu", 0, np.float32, self._planes.shape, self._planes.ctypes.data)
            for depth, output in enumerate(outputs):
                head = np.asarray(output)
                binding.bind_output(f"head_{depth}", "cpu", 0, np.float32, head.shape, head.ctypes.data)
            self._session.run_with_iobinding(binding)

    def _prepare(self, weights: list[np.ndarray]) -> None:
        same = len(weights) == len(self._weights) and all(
            np.array_equal(new.view(np.int32), old.view(np.int32))
            for new, old in zip(weights, self._weights, strict=True)
        )
        if same:
            return
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
        options.log_severity_level = 3
        self._weights = [weight.copy() for weight in weights]
        self._session = onnxruntime.InferenceSession(
            self._describe(self._weights), options, providers=["CPUExecutionProvider"]
        )


def engine(plain: Apply, *, heads: int, slope: float, used: Sequence[slice] | None) -> Apply:
    """``plain``, the network in XLA, run by ONNX Runtime; the gradient is ``plain``'s.

    Raises ValueError for features that are not float32.
    """

    @jax.custom_vjp
    def run(params: dict[str, Any], groups: list[jax.Array]) -> tuple[jax.Array, ...]:
        channels = sum(group.shape[-1] for group in groups)
        shape = (groups[0].shape[0], channels + -channels % BLOCK, *groups[0].shape[1:3])
        weights, tree = jax.tree.flatten(params)
        results = [jax.ShapeDtypeStruct(head_shape(params, shape, depth), jnp.float32) for depth in range(heads)]
        session = Session(
            shape, len(groups), lambda weights: model(jax.tree.unflatten(tree, weights), shape, used, heads, slope)
        )
        # The groups are passed separately: XLA would concatenate them into newly allocated memory first.
        return tuple(buffer_callback(session, results, vmap_method="sequential")(*groups, *weights))

    def forward(params: dict[str, Any], groups: list[jax.Array]) -> tuple[Any, Any]:
        return run(params, groups), (params, groups)

    def backward(residuals: Any, cotangents: tuple[jax.Array, ...]) -> Any:
        return jax.vjp(plain, *residuals)[1](cotangents)

    run.defvjp(forward, backward)

    def checked(params: dict[str, Any], groups: list[jax.Array]) -> tuple[jax.Array, ...]:
        dtype = jnp.result_type(*groups)
        if dtype != jnp.float32:
            raise ValueError(
                f'implementation: "onnxruntime" computes in float32, got features in {dtype}; '
                "leave implementation or compute_dtype None."
            )
        return run(params, groups)

    return checked
