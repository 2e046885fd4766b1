"""ONNX operators for JAX's operations that move values: shapes, slices, joins, gathers and scatters."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode

from jaxdn.export.arithmetic import Rule
from jaxdn.export.graph import Graph, untranslated


def _broadcast(graph: Graph, equation: Any, x: str, *sizes: str) -> str:
    """A value repeated along new axes, and along those of length 1."""
    shape, kept = equation.params["shape"], equation.params["broadcast_dimensions"]
    before = equation.invars[0].aval.shape
    new = [axis for axis in range(len(shape)) if axis not in kept]
    x = graph.value("Unsqueeze", x, graph.integers(*new)) if new and shape else x
    same = all(shape[axis] == 1 for axis in new) and all(shape[axis] == n for axis, n in zip(kept, before, strict=True))
    return x if same else graph.expand(x, shape)


def _reshape(graph: Graph, equation: Any, x: str, *sizes: str) -> str:
    return graph.value("Reshape", x, graph.shape(equation.params["new_sizes"]), allowzero=1)


def _squeeze(graph: Graph, equation: Any, x: str) -> str:
    axes = equation.params["dimensions"]
    return graph.value("Squeeze", x, graph.integers(*axes)) if axes else x


def _transpose(graph: Graph, equation: Any, x: str) -> str:
    return graph.value("Transpose", x, perm=[int(axis) for axis in equation.params["permutation"]])


def _joined(graph: Graph, equation: Any, *parts: str) -> str:
    """Concatenated; arrays without elements are left out."""
    filled = [part for part, atom in zip(parts, equation.invars, strict=True) if 0 not in _numbers(atom.aval.shape)]
    return filled[0] if len(filled) == 1 else graph.value("Concat", *filled, axis=int(equation.params["dimension"]))


def _stacked(graph: Graph, equation: Any, *parts: str) -> str:
    axis = int(equation.params["axis"])
    return graph.value("Concat", *(graph.value("Unsqueeze", part, graph.integers(axis)) for part in parts), axis=axis)


def _split(graph: Graph, equation: Any, x: str) -> list[str]:
    sizes = equation.params["sizes"]
    return graph.values("Split", [x, graph.shape(sizes)], len(sizes), axis=int(equation.params["axis"]))


def _unstacked(graph: Graph, equation: Any, x: str) -> list[str]:
    axis, count = int(equation.params["axis"]), len(equation.outvars)
    parts = graph.values("Split", [x, graph.integers(*[1] * count)], count, axis=axis)
    return [graph.value("Squeeze", part, graph.integers(axis)) for part in parts]


def _slice(graph: Graph, equation: Any, x: str) -> str:
    given, shape = equation.params, equation.invars[0].aval.shape
    strides = given["strides"] or [1] * len(shape)
    spans = zip(given["start_indices"], given["limit_indices"], strides, shape, strict=True)
    cut = [(axis, *span[:3]) for axis, span in enumerate(spans) if span[:3] != (0, span[3], 1)]
    if not cut:
        return x
    axes, low, high, steps = zip(*cut, strict=True)
    return graph.value("Slice", x, graph.shape(low), graph.shape(high), graph.integers(*axes), graph.integers(*steps))


def _pad(graph: Graph, equation: Any, x: str, filling: str) -> str:
    low, high, inner = zip(*equation.params["padding_config"], strict=True)
    if any(inner) or any(isinstance(each, int | np.integer) and each < 0 for each in (*low, *high)):
        raise untranslated("padding between elements or below 0")
    return graph.value("Pad", x, graph.shape((*low, *high)), filling)


def _iota(graph: Graph, equation: Any, *sizes: str) -> str:
    dtype, shape, axis = (equation.params[name] for name in ("dtype", "shape", "dimension"))
    zero, one = (graph.constant(np.asarray(number, np.int64)) for number in (0, 1))
    line = graph.cast(graph.value("Range", zero, graph.size(shape[axis]), one), dtype)
    others = [other for other in range(len(shape)) if other != axis]
    return graph.expand(graph.value("Unsqueeze", line, graph.integers(*others)), shape) if others else line


def _dimension(graph: Graph, equation: Any) -> str:
    """A size as a number of the program."""
    return graph.root.cast(graph.size(equation.params["dim"]), equation.outvars[0].aval.dtype)


def _dynamic_slice(graph: Graph, equation: Any, x: str, *starts: str) -> str:
    """Starts are moved so that the slice lies inside."""
    shape, sizes = equation.invars[0].aval.shape, equation.params["slice_sizes"]
    starts = starts[: len(shape)]
    axes = [axis for axis, size in enumerate(sizes) if shape[axis] != size]
    return _window(graph, x, axes, [starts[axis] for axis in axes], shape, sizes)


def _window(
    graph: Graph, x: str, axes: Sequence[int], starts: Sequence[str], shape: Sequence[Any], sizes: Sequence[Any]
) -> str:
    """``sizes`` elements along ``axes`` from int scalars ``starts`` on, moved so that they lie inside."""
    if not axes:
        return x
    corner = graph.integers(0)
    parts = [graph.value("Unsqueeze", graph.cast(start, np.int64), corner) for start in starts]
    low = graph.value("Concat", *parts, axis=0) if len(parts) > 1 else parts[0]
    last = graph.shape([shape[axis] - sizes[axis] for axis in axes])
    low = graph.value("Max", graph.value("Min", low, last), corner)
    high = graph.value("Add", low, graph.shape([sizes[axis] for axis in axes]))
    return graph.value("Slice", x, low, high, graph.integers(*axes))


def _gather(graph: Graph, equation: Any, x: str, indices: str) -> str:
    """Slices of x at places that lie inside, or are moved so that they do."""
    if equation.params["mode"] == GatherScatterMode.FILL_OR_DROP:
        raise untranslated("a gather that fills what lies outside")
    numbers = equation.params["dimension_numbers"]
    if numbers.operand_batching_dims:
        raise untranslated("a gather from a batch of arrays")
    places = equation.invars[1].aval.shape
    gather = _gather_one if len(places) == 1 else _gather_many
    return gather(graph, equation, numbers, x, indices)


def _gather_one(graph: Graph, equation: Any, numbers: Any, x: str, indices: str) -> str:
    """One slice."""
    shape, sizes = equation.invars[0].aval.shape, equation.params["slice_sizes"]
    starts = {
        axis: graph.value("Gather", indices, graph.constant(np.int64(at)), axis=0)
        for at, axis in enumerate(numbers.start_index_map)
    }
    moved = [axis for axis in starts if shape[axis] != sizes[axis]]
    found = _window(graph, x, moved, [starts[axis] for axis in moved], shape, sizes)
    gone = numbers.collapsed_slice_dims
    return graph.value("Squeeze", found, graph.integers(*gone)) if gone else found


def _gather_many(graph: Graph, equation: Any, numbers: Any, x: str, indices: str) -> str:
    """Slices at many places: whole along axes that are not indexed, single elements or a window of the only one."""
    shape, sizes = equation.invars[0].aval.shape, equation.params["slice_sizes"]
    indexed = list(numbers.start_index_map)
    rest = [axis for axis in range(len(shape)) if axis not in indexed]
    window = [axis for axis in indexed if axis not in numbers.collapsed_slice_dims]
    if any(sizes[axis] != shape[axis] for axis in rest) or (window and (len(indexed) > 1 or rest)):
        raise untranslated(f"a gather of slices {sizes} from {shape}")
    flat = graph.value("Transpose", x, perm=[*indexed, *rest]) if [*indexed, *rest] != sorted(indexed + rest) else x
    if len(indexed) > 1:
        flat = graph.value("Reshape", flat, graph.shape([-1, *(shape[axis] for axis in rest)]))
    dtype = equation.invars[1].aval.dtype
    place = ""
    for at, axis in enumerate(indexed):
        one = graph.value("Gather", indices, graph.constant(np.int64(at)), axis=-1)
        last = graph.cast(graph.size(shape[axis] - sizes[axis]), dtype)
        one = graph.value("Max", graph.value("Min", one, last), graph.constant(np.zeros((), dtype)))
        if place:
            place = graph.value("Mul", place, graph.cast(graph.size(shape[axis]), dtype))
        place = graph.value("Add", place, one) if place else one
    if window:
        steps = graph.constant(np.arange(sizes[window[0]], dtype=dtype))
        place = graph.value("Add", graph.value("Unsqueeze", place, graph.integers(-1)), steps)
    found = graph.value("Gather", flat, place, axis=0)
    # The result has the places' axes first, and is to have the slices' axes at offset_dims.
    count = len(equation.outvars[0].aval.shape)
    inner = list(range(count - len(numbers.offset_dims), count))
    order = list(range(count - len(inner)))
    for axis, source in zip(numbers.offset_dims, inner, strict=True):
        order.insert(axis, source)
    return found if order == sorted(order) else graph.value("Transpose", found, perm=order)


def _scatter(graph: Graph, equation: Any, x: str, indices: str, updates: str) -> str:
    """Single elements of a vector set; those outside go to a place that is cut off."""
    numbers, shape = equation.params["dimension_numbers"], equation.invars[0].aval.shape
    if len(shape) != 1 or numbers.update_window_dims or numbers.operand_batching_dims:
        raise untranslated(f"a scatter of slices into {shape}")
    aval = equation.invars[1].aval
    size, zero = graph.cast(graph.size(shape[0]), aval.dtype), graph.constant(np.zeros((), aval.dtype))
    outside = graph.value("Or", graph.value("Less", indices, zero), graph.value("GreaterOrEqual", indices, size))
    places = graph.cast(graph.value("Where", outside, size, indices), np.int64)
    spare = graph.constant(np.zeros(1, equation.invars[0].aval.dtype))
    found = graph.value("ScatterND", graph.value("Concat", x, spare, axis=0), places, updates)
    return graph.value("Slice", found, graph.integers(0), graph.shape(shape))


def _numbers(shape: Sequence[Any]) -> list[int]:
    return [int(size) for size in shape if isinstance(size, int | np.integer)]


MOVEMENT: dict[str, Rule] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": _joined,
    "dim_as_value": _dimension,
    "dynamic_slice": _dynamic_slice,
    "gather": _gather,
    "iota": _iota,
    "pad": _pad,
    "reshape": _reshape,
    "scatter": _scatter,
    "slice": _slice,
    "split": _split,
    "squeeze": _squeeze,
    "stack": _stacked,
    "transpose": _transpose,
    "unstack": _unstacked,
}
"""Primitive -> its rule."""
