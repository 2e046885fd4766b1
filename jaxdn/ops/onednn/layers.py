"""oneDNN's layers for inference: convolutions with all that follows them, pooling, upsampling.

Activations are [N, H, W, C] in float32 or bfloat16, sums are float32. Each function describes a layer and converts its
weights once; the result is placed on memory and called. The library: :mod:`jaxdn.ops.onednn.library`.
"""

from collections.abc import Callable, Sequence
from ctypes import c_float, c_void_p
from typing import Any

import numpy as np

from jaxdn.ops.onednn import library as dnnl

_RECTIFIER, _MAXIMUM, _NEAREST, _TRANSPOSED = 0x20, 0x1FF, 0x2FFF0, 0xA
_SAME_TYPE = 0

Placed = Callable[[c_void_p, c_void_p], dnnl.Primitive]
"""(memory to read, memory to write) -> the primitive."""


def make_convolution(
    reads: c_void_p,
    writes: c_void_p,
    kernel: np.ndarray,
    bias: np.ndarray | None,
    *,
    kind: int,
    slope: float | None = None,
    adds: bool = False,
    upsamples: bool = False,
) -> Placed:
    """A convolution, stride 1, zeros outside.

    Args:
      reads: describes the images that it reads.
      writes: describes what it writes.
      kernel: [size, size, inputs, outputs] float32.
      bias: [outputs] float32, or None.
      kind: the type in which the kernel is kept and multiplied, that of the images that are read.
      slope: that of a leaky rectifier of the result; None: none.
      adds: it adds to what is there.
      upsamples: it is one by a 3x3 kernel of the images after :func:`make_upsampling`, with 4/9 of the operations.
    """
    if upsamples:
        kernel, name, algorithm = _of_upsampled(kernel), "dnnl_deconvolution_forward", _TRANSPOSED
    else:
        name, algorithm = "dnnl_convolution_forward", dnnl.DIRECT
    size, _, inputs, outputs = kernel.shape
    stride, edge = (2, 1) if upsamples else (1, size // 2)
    ours, dims = dnnl.describe_kernels(size, inputs, outputs)
    free = dnnl.create("dnnl_memory_desc_create_with_tag", 4, dims, kind, dnnl.ANY_LAYOUT)
    row = dnnl.create("dnnl_memory_desc_create_with_tag", 1, dnnl.Dims(outputs), dnnl.FLOAT32, dnnl.ROW)
    edges = dnnl.Dims(edge, edge)
    description = dnnl.create(
        f"{name}_primitive_desc_create",
        *(dnnl.engine()[0], dnnl.INFERENCE, algorithm, reads, free, None if bias is None else row, writes),
        *(dnnl.Dims(stride, stride), dnnl.Dims(0, 0), edges, edges, _followed_by(slope, adds)),
    )
    theirs = dnnl.query(description, dnnl.ASK_WEIGHTS)
    given = np.ascontiguousarray(kernel, np.float32)
    source, inside = dnnl.create_memory(ours, dnnl.address_of(given)), dnnl.create_memory(theirs, dnnl.OWN_MEMORY)
    dnnl.Primitive(dnnl.reorder(ours, theirs), (dnnl.SOURCE, source), (dnnl.DESTINATION, inside))()
    weights = [(dnnl.WEIGHTS, inside)]
    if bias is not None:
        own = dnnl.create_memory(row, dnnl.OWN_MEMORY)
        offsets = np.ascontiguousarray(bias, np.float32)
        outside = dnnl.create_memory(row, dnnl.address_of(offsets))
        dnnl.Primitive(dnnl.reorder(row, row), (dnnl.SOURCE, outside), (dnnl.DESTINATION, own))()
        weights.append((dnnl.BIAS, own))
    return _placed(description, weights)


def _of_upsampled(kernel: np.ndarray) -> np.ndarray:
    """[4, 4, inputs, outputs] of the transposed convolution of stride 2 that equals upsampling and a 3x3 convolution.

    Three upsampled pixels in a row are two of before: the weights of those that are equal are added. The result is the
    3x3 kernel, turned, summed over windows of 2x2.
    """
    for axis in (0, 1):
        before, middle, after = (np.take(kernel, [index], axis) for index in range(3))
        kernel = np.concatenate([after, after + middle, middle + before, before], axis)
    return kernel


def make_pooling(reads: c_void_p, writes: c_void_p) -> Placed:
    """The maximum of each 2x2 block."""
    two, none = dnnl.Dims(2, 2), dnnl.Dims(0, 0)
    return _placed(
        dnnl.create(
            "dnnl_pooling_forward_primitive_desc_create",
            *(dnnl.engine()[0], dnnl.INFERENCE, _MAXIMUM, reads, writes, two, two, none, none, none),
            dnnl.attributes(),
        )
    )


def make_upsampling(reads: c_void_p, writes: c_void_p) -> Placed:
    """Every pixel repeated 2x2 times."""
    return _placed(
        dnnl.create(
            "dnnl_resampling_forward_primitive_desc_create",
            *(dnnl.engine()[0], dnnl.INFERENCE, _NEAREST, None, reads, writes, dnnl.attributes()),
        )
    )


def _followed_by(slope: float | None, adds: bool) -> c_void_p:
    """Attributes of a layer: first the sum with what is there, then the rectifier."""
    after = dnnl.create("dnnl_post_ops_create")
    if adds:
        dnnl.call("dnnl_post_ops_append_sum", after, c_float(1.0), 0, _SAME_TYPE)
    if slope is not None:
        dnnl.call("dnnl_post_ops_append_eltwise", after, _RECTIFIER, c_float(slope), c_float(0.0))
    found = dnnl.new_attributes()
    dnnl.call("dnnl_primitive_attr_set_post_ops", found, after)
    return found


def _placed(description: c_void_p, weights: Sequence[tuple[int, Any]] = ()) -> Placed:
    def on(source: c_void_p, target: c_void_p) -> dnnl.Primitive:
        ends = ((dnnl.SOURCE, source), (dnnl.DESTINATION, target))
        return dnnl.Primitive(description, *ends, *weights, scratch=dnnl.NO_MEMORY)

    return on
