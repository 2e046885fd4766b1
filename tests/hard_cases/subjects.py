"""What the hard cases are put to: every registered denoiser and every public operation, as functions of the inputs."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdn
from jaxdn import color, losses, metrics, numerics
from jaxdn.frame import RADIANCE_MAX, Frame, repair
from tests.hard_cases.cases import HEIGHT, WIDTH, Inputs

_BOTH_WAYS = ("clamp", "zeros")


class Subject(NamedTuple):
    """A function of inputs, and what has to hold of its result."""

    name: str
    run: Callable[[Any, Inputs], Any]
    """(params, inputs) -> array."""
    params: Any = ()
    repairs: bool = False
    """It has to make something usable of anything; the others may hand on what is no number in their input."""
    bounds: tuple[float, float] = (-np.inf, np.inf)


def denoiser_subjects() -> list[Subject]:
    """Every denoiser by its factory; a network with the weights it starts from."""
    subjects = []
    for name in jaxdn.denoisers.NAMES:
        factory = getattr(jaxdn.denoisers, name)
        variants: dict[str, dict[str, Any]] = {name: {}}
        if name == "ntd":
            variants = {"ntd": {"size": "small"}, "ntd bfloat16": {"size": "small", "compute_dtype": "bfloat16"}}
        for label, options in variants.items():
            denoiser = factory(**options)
            params = denoiser.init(jax.random.key(0), Frame(np.zeros((HEIGHT, WIDTH, 3), np.float32)))
            run = partial(_denoised, denoiser)
            subjects.append(Subject(label, run, params, repairs=True, bounds=(0.0, RADIANCE_MAX)))
    return subjects


def _denoised(denoiser: jaxdn.Denoiser, params: Any, inputs: Inputs) -> jax.Array:
    return jaxdn.denoise(denoiser, params, inputs.clip)


def _images(inputs: Inputs) -> tuple[jax.Array, jax.Array]:
    return inputs.clip.frames.radiance, inputs.clip.reference


def _operations() -> dict[str, Callable[[Inputs], Any]]:
    def warped(inputs: Inputs, border: str) -> jax.Array:
        frames = inputs.clip.frames
        return jax.vmap(lambda image, motion: jaxdn.warp(image, motion, border=border))(frames.radiance, frames.motion)

    def dual(inputs: Inputs) -> jax.Array:
        frames = inputs.clip.frames
        return jax.vmap(lambda m, f, v: jaxdn.dual_motion(m, f, visible=v[..., 0]))(
            frames.motion, -frames.dual_motion, frames.visible
        )

    def masks(inputs: Inputs) -> jax.Array:
        return jax.vmap(jaxdn.occlusion_mask)(inputs.clip.frames.motion, inputs.clip.frames.dual_motion)

    def filtered(inputs: Inputs) -> jax.Array:
        return jaxdn.apply_kernels(inputs.clip.frames.radiance[0], jaxdn.normalize_kernels(inputs.logits))

    def composed(inputs: Inputs) -> jax.Array:
        fine = inputs.clip.frames.radiance[0]
        return jaxdn.compose_scales(fine, fine[::2, ::2], jax.nn.sigmoid(inputs.blend))

    def squeezed(loss: Callable[..., jax.Array]) -> Callable[[Inputs], jax.Array]:
        return lambda inputs: loss(*(color.compress(image) for image in _images(inputs)))

    def toned(metric: Callable[..., jax.Array]) -> Callable[[Inputs], jax.Array]:
        return lambda inputs: metric(*(color.tonemap(image) for image in _images(inputs)))

    found: dict[str, Callable[[Inputs], Any]] = {
        **{f"warp, {border}": partial(warped, border=border) for border in _BOTH_WAYS},
        "dual_motion": dual,
        "occlusion_mask": masks,
        "normalize_kernels": lambda inputs: jaxdn.normalize_kernels(inputs.logits),
        "apply_kernels": filtered,
        "compose_scales": composed,
        "color.compress": lambda inputs: color.compress(inputs.clip.frames.radiance),
        "color.expand": lambda inputs: color.expand(jnp.minimum(inputs.clip.frames.radiance, 2.0)),
        "color.luminance": lambda inputs: color.luminance(inputs.clip.frames.radiance),
        "color.tonemap": lambda inputs: color.tonemap(inputs.clip.frames.radiance),
        "numerics.safe_norm": lambda inputs: numerics.safe_norm(inputs.clip.frames.normal),
        "numerics.safe_power": lambda inputs: numerics.safe_power(inputs.clip.frames.radiance, 0.45),
        "losses.occlusion": lambda inputs: losses.occlusion(
            *(color.compress(image) for image in _images(inputs)), masks(inputs)
        ),
    }
    found |= {f"losses.{name}": squeezed(getattr(losses, name)) for name in ("spatial", "temporal", "gradient")}
    names = ("psnr", "temporal_psnr", "ssim", "l1", "mse", "flip")
    found |= {f"metrics.{name}": toned(getattr(metrics, name)) for name in names}
    return found | {"metrics.relative_mse": lambda inputs: metrics.relative_mse(*_images(inputs))}


def operation_subjects() -> list[Subject]:
    """Every public operation, and the frame's repair, which every denoiser begins with."""
    pure = [Subject(name, lambda params, inputs, run=run: run(inputs)) for name, run in _operations().items()]

    def repaired(params: Any, inputs: Inputs) -> jax.Array:
        return repair(inputs.clip.frames)[0].radiance

    return [*pure, Subject("frame.repair", repaired, repairs=True, bounds=(0.0, RADIANCE_MAX))]


def gradient_of(subject: Subject) -> Callable[[Any, Inputs], Any]:
    """The gradient of the mean of what a subject gives, by its parameters, the radiance and the logits."""

    def mean(params: Any, radiance: Any, logits: Any, inputs: Inputs) -> jax.Array:
        frames = inputs.clip.frames._replace(radiance=radiance)
        changed = inputs._replace(clip=inputs.clip._replace(frames=frames), logits=logits)
        out = subject.run(params, changed)
        return jnp.mean(jnp.asarray(out, jnp.promote_types(out.dtype, jnp.float32)))

    def gradient(params: Any, inputs: Inputs) -> Any:
        return jax.grad(mean, (0, 1, 2), allow_int=True)(params, inputs.clip.frames.radiance, inputs.logits, inputs)

    return gradient
