"""Functions of parameters and inputs, compiled and run no more often than their results can differ."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tests.hard_cases.inputs import Inputs
from tests.hard_cases.widening import widen, widens_first

Run = Callable[[Any, Inputs], Any]
"""(params, inputs) -> arrays."""
Options = Mapping[str, bool | str | int]
"""XLA's, of one program."""


class Program:
    """A function, compiled once for each size, that runs once for all inputs with the same in what it reads.

    Most cases break one buffer, and most functions do not read it: their programs have no such argument. Cases are not
    batched: 97 % of the time is compilation, and under ``jax.vmap`` an operation may have another implementation.
    """

    def __init__(self, function: Run, options: Callable[[Inputs], Options]) -> None:
        """``options``: XLA's for some inputs."""
        self._jitted = jax.jit(function)
        self._options = options
        self._compiled: dict[Any, tuple[Callable[..., Any], list[int]]] = {}
        self._results: dict[Any, Any] = {}

    def __call__(self, params: Any, inputs: Inputs) -> Any:
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(inputs)]
        types = types_of(inputs)
        if types not in self._compiled:
            traced = self._jitted.trace(params, inputs)
            compiled = traced.lower().compile(compiler_options=dict(self._options(inputs)))
            self._compiled[types] = compiled, _read(traced.jaxpr.jaxpr, len(leaves))
        compiled, read = self._compiled[types]
        given = (types, *(leaves[index].tobytes() for index in read))
        if given not in self._results:
            self._results[given] = jax.tree.map(np.asarray, compiled(params, inputs))
        return self._results[given]


class Widening:
    """Whether a function's program for some inputs is that for the same in float32: found once for each size."""

    def __init__(self, function: Run) -> None:
        self._function = function
        self._known: dict[Any, bool] = {}

    def __call__(self, params: Any, inputs: Inputs) -> bool:
        """False if no input is bfloat16."""
        types = types_of(inputs)
        if types not in self._known:
            narrow = any(dtype == jnp.bfloat16 for _, dtype in types)
            self._known[types] = narrow and widens_first(
                self._trace(params, widen(inputs)), self._trace(params, inputs)
            )
        return self._known[types]

    def _trace(self, params: Any, inputs: Inputs) -> Any:
        return jax.jit(self._function).trace(params, inputs).jaxpr


def types_of(inputs: Inputs) -> tuple[Any, ...]:
    """Shape and type of every array."""
    return tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(inputs))


def _read(program: Any, count: int) -> list[int]:
    """Which of the program's last ``count`` arguments any operation has as an operand, or are results themselves."""
    operands = [*program.outvars, *(operand for equation in program.eqns for operand in equation.invars)]
    read = {id(operand) for operand in operands}
    return [index for index, argument in enumerate(program.invars[-count:]) if id(argument) in read]
