"""A program of JAX as an ONNX graph: one rule for every primitive, applied in the program's order.

JAX has no exporter to ONNX. Programs here are traced to a jaxpr, whose primitives the tables of
:mod:`jaxdn.export.arithmetic` and :mod:`jaxdn.export.movement` know; loops and branches are here. Sizes may be
symbolic: they are computed from the inputs' shapes when the graph runs.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from jaxdn.export.arithmetic import ARITHMETIC
from jaxdn.export.graph import Graph, element_type, untranslated
from jaxdn.export.movement import MOVEMENT

_INLINE = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
}
"""Primitive that calls a program -> the parameter that holds it."""


def translate(graph: Graph, program: core.ClosedJaxpr, inputs: Sequence[str]) -> list[str]:
    """Append a program to a graph; the names of its results.

    Raises ValueError, naming it, for a primitive without a rule.
    """
    jaxpr = program.jaxpr
    names: dict[core.Var, str] = dict(zip(jaxpr.invars, inputs, strict=True))
    for variable, constant in zip(jaxpr.constvars, program.consts, strict=True):
        names[variable] = graph.constant(constant)

    def read(atom: Any) -> str:
        if isinstance(atom, core.Literal):
            aval: Any = atom.aval
            return graph.constant(np.asarray(atom.val, aval.dtype))
        return names[atom]

    for equation in jaxpr.eqns:
        arguments = [read(atom) for atom in equation.invars]
        found = _rule(equation)(graph, equation, *arguments)
        results = [found] if isinstance(found, str) else found
        names.update(zip(equation.outvars, results, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _rule(equation: core.JaxprEqn) -> Callable[..., str | list[str]]:
    name = equation.primitive.name
    if name in _INLINE:
        return _inlined
    rule = {**ARITHMETIC, **MOVEMENT, **_CONTROL}.get(name)
    if rule is None:
        raise untranslated(f"{name!r} ({', '.join(str(one.aval) for one in equation.invars)})")
    return rule


def _inlined(graph: Graph, equation: core.JaxprEqn, *inputs: str) -> list[str]:
    return translate(graph, _closed(equation.params[_INLINE[equation.primitive.name]]), inputs)


def _closed(program: Any) -> core.ClosedJaxpr:
    return program if isinstance(program, core.ClosedJaxpr) else core.ClosedJaxpr(program, ())


def _scan(graph: Graph, equation: core.JaxprEqn, *inputs: str) -> list[str]:
    """``lax.scan``; what stays the same in all rounds is read from the graph around."""
    parameters, program = equation.params, equation.params["jaxpr"]
    constants, carried = _constants_and_carried(parameters)
    body = Graph(graph)
    variables = program.jaxpr.invars[constants:]
    names = [body.name("round") for _ in variables]
    results = translate(body, program, [*inputs[:constants], *names])
    given = [_typed(name, variable.aval.dtype) for name, variable in zip(names, variables, strict=True)]
    lists, stacks = len(variables) - carried, len(results) - carried
    backwards = {"scan_input_directions": [1] * lists, "scan_output_directions": [1] * stacks}
    directions = {which: each for which, each in backwards.items() if each and parameters["reverse"]}
    return graph.values(
        "Scan",
        inputs[constants:],
        len(results),
        body=body.made("body", given, _results(body, results, program.jaxpr)),
        num_scan_inputs=lists,
        **directions,
    )


def _constants_and_carried(parameters: Mapping[str, Any]) -> tuple[int, int]:
    """How many inputs of ``lax.scan`` are the same in all rounds, and how many go from one round to the next."""
    if "ft_in" in parameters:  # since jax 0.12: trees of both, and of what is read row by row
        constants, carried, _ = parameters["ft_in"].unpack()
        return len(constants), len(carried)
    return parameters["num_consts"], parameters["num_carry"]


def _cond(graph: Graph, equation: core.JaxprEqn, index: str, *inputs: str) -> list[str]:
    """``lax.cond``."""
    branches = equation.params["branches"]
    if len(branches) != 2:
        raise untranslated(f"a choice of {len(branches)} programs")
    made = []
    for number, program in enumerate(branches):
        branch = Graph(graph)
        results = translate(branch, program, inputs)
        made.append(branch.made(f"branch_{number}", [], _results(branch, results, program.jaxpr)))
    yes = graph.cast(index, bool)
    return graph.values("If", [yes], len(equation.outvars), then_branch=made[1], else_branch=made[0])


def _results(graph: Graph, names: Sequence[str], jaxpr: Any) -> list[Any]:
    """The outputs of an inner graph: each a node's own, as ONNX requires."""
    own = [graph.node("Identity", name, output=graph.name("result")) for name in names]
    return [_typed(name, atom.aval.dtype) for name, atom in zip(own, jaxpr.outvars, strict=True)]


def _typed(name: str, dtype: Any) -> Any:
    from onnx import helper

    return helper.make_tensor_value_info(name, element_type(jax.dtypes.canonicalize_dtype(dtype)), None)


_CONTROL: dict[str, Callable[..., str | list[str]]] = {"scan": _scan, "cond": _cond}
