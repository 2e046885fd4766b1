"""Compiler options of XLA for train steps: per program, and only those that the installed version supports."""

from functools import cache

import jax

_CANDIDATES = {"cpu": {"xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"}}
"""Matrix products through YNNPACK: a train step takes 0.75 of the time (2 cores with AVX-512, jax 0.10). The forward
pass of a 720p frame gains nothing, so this is not used for denoising."""


@cache
def training_options() -> dict[str, str]:
    """Compiler options for a train step on jax's default platform, those that the installed jax supports."""
    options = _CANDIDATES.get(jax.default_backend(), {})
    return {name: value for name, value in options.items() if _known(name, value)}


def _known(name: str, value: str) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
