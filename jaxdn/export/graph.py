"""An ONNX graph as it is being written: shared nodes, constants, sizes that are known only when it runs.

Values are names. A graph inside another (the body of a loop, a branch) may use the names of those around it.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from jaxdn.networks import onnx

OPSET = 18
IR_VERSION = 8


class Graph(onnx.OnnxGraph):
    """The nodes of one graph; the same operation on the same values is written once."""

    def __init__(self, outer: "Graph | None" = None) -> None:
        super().__init__()
        self.outer = outer
        self.root: Graph = self if outer is None else outer.root
        self.sizes: dict[str, str] = {}
        """Symbol in sizes -> int64 scalar, of the root."""
        self._known: dict[Any, str] = {}
        self._narrow: dict[str, str] = {}
        self._numbers = itertools.count()

    def name(self, kind: str) -> str:
        """A name that no other value has."""
        return f"{kind}_{next(self.root._numbers)}"

    def constant(self, array: Any) -> str:
        """The name of a constant, in the root graph."""
        array = np.asarray(array)
        root, key = self.root, (array.dtype.str, array.shape, array.tobytes())
        if key not in root._known:
            root._known[key] = onnx.OnnxGraph.constant(root, array)
        return root._known[key]

    def integers(self, *values: int) -> str:
        """An int64 vector."""
        return self.constant(np.asarray(values, np.int64))

    def value(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """The result of a node with one output."""
        key = kind, inputs, repr(sorted(attributes.items()))
        graph: Graph | None = self
        while graph is not None:
            if key in graph._known:
                return graph._known[key]
            graph = graph.outer
        self._known[key] = self.node(kind, *inputs, output=self.name("value"), **attributes)
        return self._known[key]

    def values(self, kind: str, inputs: Sequence[str], count: int, **attributes: Any) -> list[str]:
        """The results of a node with ``count`` outputs."""
        from onnx import helper

        outputs = [self.name("value") for _ in range(count)]
        self.nodes.append(helper.make_node(kind, list(inputs), outputs, **attributes))
        return outputs

    def cast(self, value: str, dtype: Any) -> str:
        """The value in another type."""
        return self.value("Cast", value, to=element_type(dtype))

    def size(self, dimension: Any) -> str:
        """A length as an int64 scalar: a number, or an expression of the graph's sizes."""
        if isinstance(dimension, int | np.integer):
            return self.constant(np.int64(dimension))
        # The expression's text is documented (jax.export.symbolic_shape); it is one of Python over _Size.
        names: dict[str, Any] = {symbol: _Size(self.root, value) for symbol, value in self.root.sizes.items()}
        return _name(self.root, eval(str(dimension), {"__builtins__": {}}, names | _FUNCTIONS))

    def shape(self, dimensions: Iterable[Any]) -> str:
        """Lengths as an int64 vector."""
        dimensions = list(dimensions)
        if all(isinstance(each, int | np.integer) for each in dimensions):
            return self.integers(*dimensions)
        axis = self.integers(0)
        parts = [self.root.value("Unsqueeze", self.size(each), axis) for each in dimensions]
        return self.root.value("Concat", *parts, axis=0)

    def expand(self, value: str, shape: Iterable[Any]) -> str:
        """The value [1 or n, ...] repeated to a shape; :meth:`narrow` finds it unrepeated."""
        wide = self.value("Expand", value, self.shape(shape))
        self._narrow[wide] = value
        return wide

    def narrow(self, value: str) -> str:
        """The value before it was repeated; itself if it was not."""
        graph: Graph | None = self
        while graph is not None and value not in graph._narrow:
            graph = graph.outer
        return value if graph is None else graph._narrow[value]

    def made(self, name: str, inputs: Sequence[Any], outputs: Sequence[Any]) -> Any:
        """The finished GraphProto, without the nodes that nothing uses."""
        from onnx import helper

        used = {output.name for output in outputs}
        kept = []
        for node in reversed(self.nodes):
            if used.intersection(node.output):
                kept.append(node)
                used.update(_read(node))
        constants = [constant for constant in self.constants if constant.name in used]
        return helper.make_graph(kept[::-1], name, inputs, outputs, constants)


def untranslated(what: str) -> ValueError:
    """The error for an operation that the translation does not know, and what to do."""
    return ValueError(
        f"onnx: expected operations that have a translation, got {what}; export StableHLO alone: --format stablehlo."
    )


def element_type(dtype: Any) -> int:
    """ONNX's number of a NumPy type."""
    from onnx import helper

    return helper.np_dtype_to_tensor_dtype(np.dtype(dtype))


def _read(node: Any) -> set[str]:
    """What a node reads, the graphs in it included."""
    names = set(node.input)
    for attribute in node.attribute:
        for inner in attribute.g.node if attribute.HasField("g") else ():
            names |= _read(inner)
        if attribute.HasField("g"):
            names |= {output.name for output in attribute.g.output}
    return names


class _Size:
    """An int64 scalar of a graph in an expression."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name = graph, name

    def _with(self, kind: str, other: Any, **attributes: Any) -> "_Size":
        return _Size(self.graph, self.graph.value(kind, self.name, _name(self.graph, other), **attributes))

    def __add__(self, other: Any) -> "_Size":
        return self._with("Add", other)

    def __mul__(self, other: Any) -> "_Size":
        return self._with("Mul", other)

    __radd__, __rmul__ = __add__, __mul__

    def __sub__(self, other: Any) -> "_Size":
        return self._with("Sub", other)

    def __rsub__(self, other: Any) -> "_Size":
        return self * -1 + other

    def __neg__(self) -> "_Size":
        return self * -1

    def __pow__(self, exponent: int) -> "_Size":
        power = self
        for _ in range(exponent - 1):
            power = power * self
        return power


def _name(graph: Graph, number: Any) -> str:
    return number.name if isinstance(number, _Size) else graph.constant(np.int64(number))


def _remainder(number: _Size, divisor: Any) -> _Size:
    return number._with("Mod", divisor)  # of the divisor's sign, as Python's


def _quotient(number: _Size, divisor: Any) -> _Size:
    return (number - _remainder(number, divisor))._with("Div", divisor)


def _chosen(kind: str) -> Callable[[Any, Any], Any]:
    def chosen(one: Any, other: Any) -> Any:
        return one._with(kind, other) if isinstance(one, _Size) else other._with(kind, one)

    return chosen


_FUNCTIONS: dict[str, Any] = {
    "floordiv": _quotient,
    "mod": _remainder,
    "max": _chosen("Max"),
    "min": _chosen("Min"),
}
