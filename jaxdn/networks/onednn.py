"""A network run by oneDNN as a whole, in float32 or in bfloat16, from inside a jitted program on CPUs.

Each convolution includes its bias, its sum and its rectifier, and activations lie as the library likes them: in
float32, the U-Nets of ``steady`` take 0.4 to 0.65 of their time in XLA. bfloat16 has the range of float32 and 8 bits of
precision; sums are float32. A CPU with AVX-512 BF16 or AMX multiplies twice as many of them at a time or more, and
activations are half as large. What networks decide are shares, features and logits, for which 8 bits are enough: images
differ by 76 to 85 dB (``docs/results/index.md``). Both are for inference only: the gradient is that of the network in
plain XLA, recomputed.

All primitives are made once for a shape, on memory of their own, and run one after the other. The layers:
:mod:`jaxdn.ops.onednn.layers`.
"""

import hashlib
import math
import threading
from collections.abc import Callable, Sequence
from ctypes import c_void_p
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.networks.graph import FEATURES, GraphSpec, Weights, evaluate, output_shapes, same_weights
from jaxdn.ops.dispatch.host_call import call_host
from jaxdn.ops.onednn import layers
from jaxdn.ops.onednn import library as dnnl


class Precision(NamedTuple):
    """Of activations and of the kernels."""

    backend: str
    """The name of the backend that computes in it."""
    dtype: Any
    """As jax knows it."""
    kind: int
    """As the library knows it."""


FLOAT32 = Precision("onednn-float32", jnp.float32, dnnl.FLOAT32)
BFLOAT16 = Precision("onednn-bfloat16", jnp.bfloat16, dnnl.BFLOAT16)


def computes_bfloat16() -> bool:
    """Whether oneDNN can be loaded, jax computes on the CPU, and the CPU multiplies numbers in bfloat16."""
    return dnnl.available() and dnnl.computes_bfloat16()


def unavailable_in_bfloat16() -> str:
    """Why oneDNN cannot compute in bfloat16 here, and what to do; empty if it can."""
    if reason := dnnl.unavailable():
        return reason
    return "" if dnnl.computes_bfloat16() else f'needs a CPU with AVX-512 BF16 or AMX; take "{FLOAT32.backend}"'


class Value(NamedTuple):
    """An array of a program."""

    number: int
    """Of the step that writes it; -1 for the input."""
    channels: int
    height: int
    width: int


class ProgramLayer:
    """One layer of a program."""

    def __init__(self, kind: str, inputs: Sequence[Value], result: Value, kernel: Any = None, bias: Any = None) -> None:
        self.kind, self.inputs, self.result, self.kernel, self.bias = kind, list(inputs), result, kernel, bias
        self.slope: float | None = None
        """Of the rectifier that is a part of it."""


class ProgramBuilder:
    """The steps of a program (:class:`jaxdn.networks.graph.LayerBackend`)."""

    def __init__(self) -> None:
        self.steps: list[ProgramLayer] = []

    def _add(self, kind: str, inputs: Sequence[Value], channels: int, scale: float = 1.0, **weights: Any) -> Value:
        height, width = (int(size * scale) for size in inputs[0][2:])
        result = Value(len(self.steps), channels, height, width)
        self.steps.append(ProgramLayer(kind, inputs, result, **weights))
        return result

    def convolution(self, inputs: Sequence[Value], kernels: Sequence[np.ndarray], bias: np.ndarray) -> Value:
        """Inputs are added one after the other; the bias comes with the last."""
        total: list[Value] = []
        for x, kernel in zip(inputs, kernels, strict=True):
            weights: dict[str, Any] = {"kernel": kernel, "bias": bias if x is inputs[-1] else None}
            before = self.steps[x.number] if x.number >= 0 else None
            if before is not None and before.kind == "upsample" and kernel.shape[0] == 3:
                read = [before.inputs[0], *total]
                total = [self._add("upsampling convolution", read, kernel.shape[3], 2.0, **weights)]
            else:
                total = [self._add("convolution", [x, *total], kernel.shape[3], **weights)]
        return total[0]

    def rectifier(self, x: Value, slope: float) -> Value:
        """Of the convolution before."""
        self.steps[x.number].slope = slope
        return x

    def pool(self, x: Value) -> Value:
        """A step of its own."""
        return self._add("pool", [x], x.channels, 0.5)

    def upsample(self, x: Value) -> Value:
        """A step of its own, which a 3x3 convolution does without."""
        return self._add("upsample", [x], x.channels, 2.0)

    def needed(self, outputs: set[int]) -> list[ProgramLayer]:
        """The steps whose results are outputs, by number, or read."""
        read = outputs | {value.number for step in self.steps if step.kind != "upsample" for value in step.inputs}
        return [step for step in self.steps if step.result.number in read]


class Program:
    """The network with its weights, for one shape [N, H, W, c] of its features."""

    def __init__(self, network: GraphSpec, weights: Weights, shape: Sequence[int], precision: Precision) -> None:
        builder, self._count, self._precision = ProgramBuilder(), shape[0], precision
        given = Value(-1, shape[3], shape[1], shape[2])
        heads = evaluate(network, weights, {FEATURES: given}, builder)
        self._memory: dict[int, c_void_p] = {-1: dnnl.create_memory(self._description(given))}
        self._free: list[np.ndarray] = []
        self.bytes = 0
        """Of all activations: what nobody reads any more is written over."""
        self._arrays: dict[int, np.ndarray] = {}
        self._kept: list[np.ndarray] = []
        outputs = {head.number for head in heads}
        steps = builder.needed(outputs)
        last_use = {value.number: step.result.number for step in steps for value in step.inputs}
        self._primitives: list[dnnl.Primitive] = []
        for step in steps:
            self._add(step, output=step.result.number in outputs)
            for value in step.inputs:
                if last_use[value.number] == step.result.number and value.number in self._arrays:
                    self._free.append(self._arrays.pop(value.number))
        self._scratch = dnnl.allocate_aligned(max(primitive.scratch_bytes for primitive in self._primitives))
        for primitive in self._primitives:
            dnnl.set_address(primitive.scratch, dnnl.address_of(self._scratch))
        self._ends = [self._memory[-1], *(self._memory[head.number] for head in heads)]

    def _description(self, value: Value, kind: int | None = None) -> c_void_p:
        kind = self._precision.kind if kind is None else kind
        return dnnl.describe_images(self._count, value.height, value.width, value.channels, kind)

    def _add(self, step: ProgramLayer, *, output: bool) -> None:
        """The primitive of a step, on its memory: of what nobody reads any more, else new."""
        result = self._description(step.result, dnnl.FLOAT32 if output else None)
        if len(step.inputs) > 1:
            # The sum goes on in the memory of the sum so far.
            before = step.inputs[1].number
            self._memory[step.result.number] = self._memory[before]
            if before in self._arrays:
                self._arrays[step.result.number] = self._arrays.pop(before)
        elif output:
            self._memory[step.result.number] = dnnl.create_memory(result)
        else:
            size = jnp.dtype(self._precision.dtype).itemsize * self._count * math.prod(step.result[1:])
            array = self._room(size)
            self._arrays[step.result.number] = array
            self._memory[step.result.number] = dnnl.create_memory(result, dnnl.address_of(array))
        source, target = self._memory[step.inputs[0].number], self._memory[step.result.number]
        reads = self._description(step.inputs[0])
        if step.kernel is not None:
            after: Any = {"kind": self._precision.kind, "slope": step.slope, "adds": len(step.inputs) > 1}
            upsamples = step.kind == "upsampling convolution"
            placed = layers.make_convolution(reads, result, step.kernel, step.bias, upsamples=upsamples, **after)
        else:
            placed = (layers.make_pooling if step.kind == "pool" else layers.make_upsampling)(reads, result)
        self._primitives.append(placed(source, target))

    def _room(self, size: int) -> np.ndarray:
        """The smallest piece of memory that nobody reads and that is large enough, else a new one."""
        fitting = [index for index, array in enumerate(self._free) if array.size >= size]
        if fitting:
            return self._free.pop(min(fitting, key=lambda index: self._free[index].size))
        self.bytes += size
        array = dnnl.allocate_aligned(size)
        self._kept.append(array)
        return array

    def __call__(self, features: int, heads: Sequence[int]) -> None:
        """Run on addresses: of the features, and of the heads in float32."""
        for memory, place in zip(self._ends, (features, *heads), strict=True):
            dnnl.set_address(memory, place)
        for primitive in self._primitives:
            primitive()


class Session:
    """The program of one shape, made for the weights of its last call.

    Every call compares its weights with those (by bytes, about a millisecond), which keeps the function pure.
    """

    def __init__(self, describe: Callable[[list[np.ndarray]], Program]) -> None:
        self._describe = describe
        self._weights: list[np.ndarray] = []
        self._program: Any = None
        self._lock = threading.Lock()

    def __call__(self, outputs: Sequence[np.ndarray], features: np.ndarray, *weights: np.ndarray) -> None:
        """Fill ``outputs``; the arguments are views of XLA's own buffers."""
        with self._lock:
            if not same_weights(list(weights), self._weights):
                own = [weight.copy() for weight in weights]
                self._program, self._weights = self._describe(own), own  # where that fails, all stays as it was
            with dnnl.LOCK:
                self._program(dnnl.address_of(features), [dnnl.address_of(output) for output in outputs])


def run(
    network: GraphSpec, weights: Weights, groups: list[jax.Array], *, precision: Precision
) -> tuple[jax.Array, ...]:
    """The outputs of the network, in float32, for the feature groups [N, H, W, c] that are present."""
    leaves, tree = jax.tree.flatten(weights)
    features = jnp.concatenate([group.astype(precision.dtype) for group in groups], axis=-1)
    shape = features.shape
    session = Session(lambda leaves: Program(network, jax.tree.unflatten(tree, leaves), shape, precision))
    results = [jax.ShapeDtypeStruct(each, jnp.float32) for each in output_shapes(network, shape)]
    # One session for all programs of this network and shape; where their weights differ, each makes its own again.
    made = hashlib.sha256(repr((network, str(tree), shape, precision.backend)).encode()).hexdigest()[:32]
    return tuple(call_host(f"{__name__}:{made}", session, results, features, *leaves))
