"""Argument checks of public functions: what was expected, what was given, what to do. Pixel values are not checked."""

from typing import Any

import jax.numpy as jnp


def check_image(image: Any, name: str, *, channels: int | None = None, rank: int = 3) -> None:
    """Raise ValueError unless ``image`` is a floating-point array of ``rank`` axes, the last of ``channels``.

    ``rank`` 3 is ``[H, W, C]``, 4 is a clip ``[T, H, W, C]``. Sizes of zero raise as well.
    """
    layout = {3: "[H, W, C]", 4: "[T, H, W, C]"}.get(rank, f"{rank} axes")
    shape, dtype = jnp.shape(image), jnp.result_type(image)
    if len(shape) != rank:
        hint = "batch with jax.vmap" if len(shape) == rank + 1 else "add the missing axes"
        raise ValueError(f"{name}: expected {layout}, got shape {shape}; {hint}.")
    if 0 in shape:
        raise ValueError(f"{name}: expected at least one pixel and one channel, got shape {shape}.")
    if channels is not None and shape[-1] != channels:
        raise ValueError(f"{name}: expected {channels} channels in the last axis, got shape {shape}.")
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"{name}: expected a floating-point array, got {dtype}; convert it with .astype(jnp.float32).")


def check_same_size(first: Any, second: Any, names: tuple[str, str]) -> None:
    """Raise ValueError unless both arrays agree in every axis but the last."""
    if jnp.shape(first)[:-1] != jnp.shape(second)[:-1]:
        raise ValueError(
            f"{names[0]} and {names[1]}: expected the same size, got {jnp.shape(first)} and {jnp.shape(second)}; "
            "crop or resample one of them."
        )


def check_at_least(least: int, **values: int) -> None:
    """Raise ValueError for the first of ``values`` that is smaller than ``least``."""
    for name, value in values.items():
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}.")


def check_option(value: Any, name: str, choices: tuple[Any, ...]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, choices))}, got {value!r}.")
