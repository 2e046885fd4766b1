"""jaxdn removes Monte Carlo noise from path-traced animations, in JAX.

Every name below is loaded on first use, so that a notebook that only uses :func:`warp` needs only jax and numpy:
Mitsuba, OpenEXR, Orbax and Grain are imported only by the subpackages that use them.
"""

import importlib
from typing import Any

__version__ = "0.2.0"

_HOMES = {
    "Frame": "core.frame",
    "Clip": "core.frame",
    "Denoiser": "denoiser",
    "warp": "ops.warp",
    "dual_motion": "ops.motion",
    "occlusion_mask": "ops.motion",
    "normalize_kernels": "ops.kernel_prediction.apply",
    "apply_kernels": "ops.kernel_prediction.apply",
    "compose_scales": "ops.scales",
    "denoise": "denoiser.rollout",
    "stream": "denoiser.rollout",
    "load_weights": "zoo.weights",
    "read_clip": "clips",
    "write_clip": "clips",
}
_ROOMS = ("brdf", "color", "losses", "metrics", "denoisers", "effects")

__all__ = [*_HOMES, *_ROOMS, "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(f"jaxdn.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    if name in _ROOMS:
        return importlib.import_module(f"jaxdn.{name}")
    raise AttributeError(f"module 'jaxdn' has no attribute {name!r}; it has {', '.join(sorted(__all__))}")


def __dir__() -> list[str]:
    return sorted(__all__)
