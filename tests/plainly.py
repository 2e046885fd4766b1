"""Programs compiled without optimisation, for tests that run a large one once or twice."""

from collections.abc import Callable
from typing import Any

import jax


def jit_plainly(function: Callable[..., Any]) -> Callable[..., Any]:
    """``jax.jit`` without LLVM's optimisation: compiles in half of the time, runs slower, operations the same."""
    return jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})
