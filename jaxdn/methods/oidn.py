"""Open Image Denoise (``oidn``): the networks that renderers ship, for each frame alone.

The library denoises all light at once, without a history: nothing of one frame shows in another, and what it gets wrong
flickers. :func:`jaxdn.stabilised` gives it a history.

It runs outside jax, in a callback. Its images have no gradients and its step cannot be exported.

Attila T. Áfra, "Intel Open Image Denoise", 2019-2025, https://www.openimagedenoise.org.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NoReturn

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.core.frame import Frame, written_out
from jaxdn.denoiser import Core, Denoiser, Params, State, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.methods.registry import method
from jaxdn.ops import oidn as binding
from jaxdn.ops.dispatch.host_call import call_host, name_of
from jaxdn.ops.dispatch.operation import ANY, NotPortableError, platform

Guides = Literal["both", "albedo", "none"]
_READS: dict[Guides, tuple[str, ...]] = {"both": ("albedo", "normal"), "albedo": ("albedo",), "none": ()}


@dataclass(frozen=True)
class Options:
    """The library's settings; the defaults are its own."""

    quality: binding.Quality = "high"
    """Size and precision of the network."""
    guides: Guides = "both"
    """What the network sees besides radiance."""
    auxiliary: binding.Auxiliary = "noisy"
    """What is known of the guides: ``"noisy"``: nothing; ``"clean"``: they have no noise, and may show every detail;
    ``"prefiltered"``: they are noisy, and the library denoises them first, as Blender has it do by default."""
    guide_quality: binding.Quality | None = None
    """Size and precision of the networks that denoise prefiltered guides; None: ``quality``."""
    hdr: bool = True
    """Radiance is linear and may exceed 1. Without it, it is encoded with the sRGB curve, in [0, 1]."""
    device: binding.Device = "auto"
    """Where the library computes: ``"auto"`` is an NVIDIA GPU if it can use one, else the CPU."""

    def __post_init__(self) -> None:
        if self.auxiliary != "noisy" and self.guides != "both":
            raise ValueError(
                f"guides: expected 'both' with auxiliary={self.auxiliary!r}, the network for guides without noise, got "
                f"{self.guides!r}."
            )


@method(Options, title="Open Image Denoise, each frame alone (Áfra)", requires=binding.MODULE, differentiable=False)
def oidn(options: Options) -> Denoiser:
    """Open Image Denoise, a library of networks for single images; ``params`` are ``{}``, and there is no state.

    Reads albedo and normal, as far as ``guides`` says. Radiance is brought to the brightness that the library measures
    itself, here by the whole frame's statistics, so that tiles give the image of the whole.
    Raises ModuleNotFoundError, saying what to install, where the package ``pyoidn`` is missing, when a step is traced;
    NotPortableError where a step is exported, and TypeError where a gradient is asked for.
    """
    settings = binding.OidnSettings(
        options.quality, options.hdr, options.auxiliary, options.device, options.guide_quality
    )
    reads = _READS[options.guides]

    def step(
        params: Params, state: State, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[State, jax.Array, int]:
        whole = written_out(frame, reads)
        images = [whole.radiance, *(getattr(whole, name) for name in reads)]
        scale = statistics.exposure if options.hdr else jnp.ones((), whole.radiance.dtype)
        return state, _denoise(settings, scale, *images), 0

    return recurrent(Core(_start, step, frozenset(reads), receptive_field=settings.receptive_field))


def _start(params: Params, frame: Frame) -> tuple[()]:
    return ()


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _denoise(settings: binding.OidnSettings, scale: jax.Array, *images: jax.Array) -> jax.Array:
    """The image [H, W, 3] of radiance and guides, in the dtype of the radiance."""
    if platform() == ANY:
        raise NotPortableError(
            "oidn: expected a method whose step is a program of its own, got Open Image Denoise, a library that runs "
            "beside it; link that library into your program, or export another method."
        )
    binding.library()  # where it is missing, the error comes now and not out of the running program

    def call(scale: Any, *images: Any, **place: Any) -> np.ndarray:
        return binding.denoise(*map(np.asarray, images), settings=settings, scale=float(np.asarray(scale)), **place)

    def fill(results: list[np.ndarray], *given: np.ndarray) -> None:
        call(*given, out=results[0])

    like = jax.ShapeDtypeStruct(images[0].shape, jnp.float32)
    if platform() == "cpu":  # the program's own memory; arrays of jax may wait for a thread that waits for this call
        (image,) = call_host(name_of(binding.denoise, *settings), fill, [like], scale, *images)
    else:
        image = jax.pure_callback(call, like, scale, *images, vmap_method="sequential")
    return image.astype(images[0].dtype)


@_denoise.defjvp
def _refuse_gradient(settings: binding.OidnSettings, primals: Any, tangents: Any) -> NoReturn:
    raise TypeError(
        "oidn: expected no gradient to be asked for: Open Image Denoise is a library that returns images alone; take a "
        "method that learns, such as steady, to train or to optimise through a denoiser."
    )
