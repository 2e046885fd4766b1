"""jaxdn removes Monte Carlo noise from path-traced animations, in JAX.

Every name below is loaded on first use, so that a notebook that only uses :func:`warp` needs only jax and numpy:
Mitsuba, OpenEXR, Orbax and Grain are imported only by the subpackages that use them.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; at run time each name is loaded on first use
    from jaxdn import brdf as brdf
    from jaxdn import color as color
    from jaxdn import denoisers as denoisers
    from jaxdn import effects as effects
    from jaxdn import losses as losses
    from jaxdn import metrics as metrics
    from jaxdn.core.frame import Clip as Clip
    from jaxdn.core.frame import Frame as Frame
    from jaxdn.data.clip.folder import write_clip as write_clip
    from jaxdn.data.read import read_clip as read_clip
    from jaxdn.data.training.dataset import training_batches as training_batches
    from jaxdn.denoiser.interface import Core as Core
    from jaxdn.denoiser.interface import Denoiser as Denoiser
    from jaxdn.denoiser.interface import recurrent as recurrent
    from jaxdn.denoiser.rollout import denoise as denoise
    from jaxdn.denoiser.rollout import stream as stream
    from jaxdn.denoiser.rollout import unroll as unroll
    from jaxdn.filters.reproject import reproject as reproject
    from jaxdn.methods.stabilised import stabilised as stabilised
    from jaxdn.ops.affinity.filter import affinity_filter as affinity_filter
    from jaxdn.ops.dispatch.operation import implementation as implementation
    from jaxdn.ops.kernel_prediction.apply import apply_kernels as apply_kernels
    from jaxdn.ops.kernel_prediction.apply import normalize_kernels as normalize_kernels
    from jaxdn.ops.kernel_prediction.softmax import softmax_filter as softmax_filter
    from jaxdn.ops.motion import dual_motion as dual_motion
    from jaxdn.ops.motion import occlusion_mask as occlusion_mask
    from jaxdn.ops.scales import compose_scales as compose_scales
    from jaxdn.ops.warp import warp as warp
    from jaxdn.training.step import make_train_step as make_train_step
    from jaxdn.zoo.weights import load_weights as load_weights
    from jaxdn.zoo.weights import save_weights as save_weights

__version__ = "0.2.0"

_HOMES = {
    "Frame": "core.frame",
    "Clip": "core.frame",
    "Denoiser": "denoiser.interface",
    "Core": "denoiser.interface",
    "recurrent": "denoiser.interface",
    "warp": "ops.warp",
    "dual_motion": "ops.motion",
    "occlusion_mask": "ops.motion",
    "normalize_kernels": "ops.kernel_prediction.apply",
    "apply_kernels": "ops.kernel_prediction.apply",
    "softmax_filter": "ops.kernel_prediction.softmax",
    "affinity_filter": "ops.affinity.filter",
    "reproject": "filters.reproject",
    "stabilised": "methods.stabilised",
    "implementation": "ops.dispatch.operation",
    "compose_scales": "ops.scales",
    "denoise": "denoiser.rollout",
    "stream": "denoiser.rollout",
    "unroll": "denoiser.rollout",
    "load_weights": "zoo.weights",
    "save_weights": "zoo.weights",
    "read_clip": "data.read",
    "write_clip": "data.clip.folder",
    "training_batches": "data.training.dataset",
    "make_train_step": "training.step",
}
_ROOMS = ("brdf", "color", "losses", "metrics", "denoisers", "effects")

__all__ = [*_HOMES, *_ROOMS, "__version__"]


if not TYPE_CHECKING:  # a checker shall report names that do not exist

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
