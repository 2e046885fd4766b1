"""Gradients against central differences, by one compiled program."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.test_util import check_vjp


def check_gradients(function: Callable[..., Any], arguments: Sequence[Any], **tolerances: float) -> tuple[Any, ...]:
    """Check the reverse-mode gradient of arrays (or trees of them) along one random direction, and return it.

    What is returned is the gradient of the sum of all results, by each of the arguments.

    As ``jax.test_util.check_grads`` does it with ``order=1, modes=["rev"]``, which compiles three programs: the
    function, the function with what its gradient needs, and the gradient.

    Args:
      function: of ``arguments``; it has a gradient by all of them.
      arguments: float64, or differences are too coarse.
      tolerances: ``atol``, ``rtol`` and ``eps`` of ``jax.test_util.check_vjp``.
    """

    @jax.jit
    def program(cotangent: Any, *arguments: Any) -> Any:
        value, pull = jax.vjp(function, *arguments)
        return value, pull(cotangent)

    nothing = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *arguments))

    def run(*arguments: Any) -> Any:
        return program(nothing, *arguments)[0]

    def pull_back(*arguments: Any) -> Any:
        return run(*arguments), lambda cotangent: program(cotangent, *arguments)[1]

    check_vjp(run, pull_back, tuple(arguments), **tolerances)
    return program(jax.tree.map(np.ones_like, nothing), *arguments)[1]
