"""What engines for inference share: they compute in their own way, and have the gradient of the network in XLA."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.networks.description import Weights

Apply = Callable[[Weights, list[jax.Array]], tuple[jax.Array, ...]]
"""(weights, the present feature groups [N, H, W, c]) -> heads."""


def inference_only(name: str, run: Apply, plain: Apply) -> Apply:
    """``run``, by the engine ``name``, with the gradient of ``plain``, recomputed.

    Raises ValueError for features that are not float32.
    """
    both = jax.custom_vjp(run)

    def forward(weights: Weights, groups: list[jax.Array]) -> tuple[Any, Any]:
        return both(weights, groups), (weights, groups)

    def backward(residuals: Any, cotangents: tuple[jax.Array, ...]) -> Any:
        return jax.vjp(plain, *residuals)[1](cotangents)

    both.defvjp(forward, backward)

    def checked(weights: Weights, groups: list[jax.Array]) -> tuple[jax.Array, ...]:
        dtype = jnp.result_type(*groups)
        if dtype != jnp.float32:
            raise ValueError(
                f'implementation: "{name}" takes features in float32, got {dtype}; '
                "leave implementation or compute_dtype None."
            )
        return both(weights, groups)

    return checked


def same(new: Sequence[np.ndarray], old: Sequence[np.ndarray]) -> bool:
    """Whether two lists of weights are equal, bit for bit."""
    return len(new) == len(old) and all(
        np.array_equal(one.view(np.int32), other.view(np.int32)) for one, other in zip(new, old, strict=True)
    )
