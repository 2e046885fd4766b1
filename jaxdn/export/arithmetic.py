"""ONNX operators for JAX's arithmetic: element by element, reductions, products and convolutions."""

from collections.abc import Callable, Sequence
from string import ascii_letters
from typing import Any

import numpy as np

from jaxdn.export.graph import Graph, untranslated

Rule = Callable[..., str | list[str]]
"""(graph, equation, names of the inputs) -> name or names of the results."""


def _narrow(graph: Graph, equation: Any, inputs: Sequence[str]) -> Sequence[str]:
    """The inputs before they were repeated, where one of full size is among them: operators broadcast the others."""
    shape, found = equation.outvars[0].aval.shape, [graph.narrow(name) for name in inputs]
    pairs = zip(inputs, found, equation.invars, strict=True)
    return found if any(name == one and atom.aval.shape == shape for name, one, atom in pairs) else inputs


def _elementwise(kind: str) -> Rule:
    def rule(graph: Graph, equation: Any, *inputs: str) -> str:
        return graph.value(kind, *_narrow(graph, equation, inputs))

    return rule


def _logic(kind: str) -> Rule:
    """And, Or, Not of truth values, or of the bits of integers."""

    def rule(graph: Graph, equation: Any, *inputs: str) -> str:
        bits = "" if equation.invars[0].aval.dtype == bool else "Bitwise"
        return graph.value(bits + kind, *_narrow(graph, equation, inputs))

    return rule


def _unequal(graph: Graph, equation: Any, *inputs: str) -> str:
    return graph.value("Not", graph.value("Equal", *_narrow(graph, equation, inputs)))


def _square(graph: Graph, equation: Any, x: str) -> str:
    return graph.value("Mul", x, x)


def _integer_power(graph: Graph, equation: Any, x: str) -> str:
    exponent = equation.params["y"]
    power, square, rest = "", x, abs(exponent)
    while rest:
        if rest & 1:
            power = graph.value("Mul", power, square) if power else square
        rest >>= 1
        square = graph.value("Mul", square, square) if rest else square
    one = graph.constant(np.ones((), equation.invars[0].aval.dtype))
    if not exponent:
        return graph.value("Add", graph.value("Mul", x, graph.constant(np.zeros_like(1.0, np.float32))), one)
    return power if exponent > 0 else graph.value("Div", one, power)


def _log1p(graph: Graph, equation: Any, x: str) -> str:
    """``log(1 + x)``; for small x times x / ((1 + x) - 1), which undoes the rounding of 1 + x (Kahan)."""
    one = graph.constant(np.float32(1))
    above = graph.value("Add", x, one)
    step = graph.value("Sub", above, one)
    exact = graph.value("Mul", graph.value("Log", above), graph.value("Div", x, step))
    plain = graph.value("Or", graph.value("Equal", step, graph.constant(np.float32(0))), graph.value("IsInf", step))
    return graph.value("Where", plain, x, exact)


def _finite(graph: Graph, equation: Any, x: str) -> str:
    return graph.value("Not", graph.value("Or", graph.value("IsNaN", x), graph.value("IsInf", x)))


def _shift_right(graph: Graph, equation: Any, x: str, bits: str) -> str:
    parts = (graph.cast(each, np.uint32) for each in (x, bits))
    return graph.cast(graph.value("BitShift", *parts, direction="RIGHT"), equation.outvars[0].aval.dtype)


def _select(graph: Graph, equation: Any, *inputs: str) -> str:
    which, no, yes = _narrow(graph, equation, inputs)
    if equation.outvars[0].aval.dtype != bool:
        return graph.value("Where", which, yes, no)
    return graph.value("Or", graph.value("And", which, yes), graph.value("And", graph.value("Not", which), no))


def _clamp(graph: Graph, equation: Any, low: str, x: str, high: str) -> str:
    return graph.value("Min", graph.value("Max", x, low), high)


def _convert(graph: Graph, equation: Any, x: str) -> str:
    before, after = equation.invars[0].aval.dtype, equation.outvars[0].aval.dtype
    return x if before == after else graph.cast(x, after)


def _reduction(kind: str) -> Rule:
    def rule(graph: Graph, equation: Any, x: str) -> str:
        return graph.value(kind, x, graph.integers(*equation.params["axes"]), keepdims=0)

    return rule


def _truth(kind: str) -> Rule:
    """All or any, as the least or the largest of numbers."""

    def rule(graph: Graph, equation: Any, x: str) -> str:
        axes = graph.integers(*equation.params["axes"])
        return graph.cast(graph.value(kind, graph.cast(x, np.int32), axes, keepdims=0), bool)

    return rule


def _cumulative(graph: Graph, equation: Any, x: str) -> str:
    axis = graph.constant(np.int64(equation.params["axis"]))
    return graph.value("CumSum", x, axis, reverse=int(equation.params["reverse"]))


def _product(graph: Graph, equation: Any, one: str, other: str) -> str:
    """A product of tensors as Einsum: the result has the shared axes first, then those of each."""
    (left, right), (left_shared, right_shared) = equation.params["dimension_numbers"]
    letters = iter(ascii_letters)
    first = [next(letters) for _ in equation.invars[0].aval.shape]
    same = dict(zip((*right, *right_shared), (*left, *left_shared), strict=True))
    second = [
        first[same[axis]] if axis in same else next(letters) for axis in range(len(equation.invars[1].aval.shape))
    ]
    result = [first[axis] for axis in left_shared]
    result += [name for axis, name in enumerate(first) if axis not in (*left, *left_shared)]
    result += [name for axis, name in enumerate(second) if axis not in same]
    return graph.value("Einsum", one, other, equation=f"{''.join(first)},{''.join(second)}->{''.join(result)}")


def _convolution(graph: Graph, equation: Any, x: str, kernel: str) -> str:
    given = equation.params
    layout = given["dimension_numbers"]
    if given["batch_group_count"] != 1 or set(given["lhs_dilation"]) != {1}:
        raise untranslated("a convolution of a dilated input or of grouped batches")
    back = [layout.out_spec.index(axis) for axis in range(len(layout.out_spec))]
    low, high = zip(*given["padding"], strict=True)
    made = graph.value(
        "Conv",
        graph.value("Transpose", x, perm=list(layout.lhs_spec)),
        graph.value("Transpose", kernel, perm=list(layout.rhs_spec)),
        strides=list(given["window_strides"]),
        pads=[*low, *high],
        dilations=list(given["rhs_dilation"]),
        group=given["feature_group_count"],
    )
    return graph.value("Transpose", made, perm=back)


ARITHMETIC: dict[str, Rule] = {
    "abs": _elementwise("Abs"),
    "add": _elementwise("Add"),
    "and": _logic("And"),
    "clamp": _clamp,
    "conv_general_dilated": _convolution,
    "convert_element_type": _convert,
    "cumsum": _cumulative,
    "div": _elementwise("Div"),
    "dot_general": _product,
    "eq": _elementwise("Equal"),
    "exp": _elementwise("Exp"),
    "floor": _elementwise("Floor"),
    "ge": _elementwise("GreaterOrEqual"),
    "gt": _elementwise("Greater"),
    "integer_pow": _integer_power,
    "is_finite": _finite,
    "le": _elementwise("LessOrEqual"),
    "log": _elementwise("Log"),
    "log1p": _log1p,
    "logistic": _elementwise("Sigmoid"),
    "lt": _elementwise("Less"),
    "max": _elementwise("Max"),
    "min": _elementwise("Min"),
    "mul": _elementwise("Mul"),
    "ne": _unequal,
    "neg": _elementwise("Neg"),
    "not": _logic("Not"),
    "or": _logic("Or"),
    "pow": _elementwise("Pow"),
    "reduce_and": _truth("ReduceMin"),
    "reduce_max": _reduction("ReduceMax"),
    "reduce_or": _truth("ReduceMax"),
    "reduce_sum": _reduction("ReduceSum"),
    "select_n": _select,
    "shift_right_logical": _shift_right,
    "sqrt": _elementwise("Sqrt"),
    "square": _square,
    "stop_gradient": _elementwise("Identity"),
    "sub": _elementwise("Sub"),
}
"""Primitive -> its rule."""
