"""The functions under test: every registered denoiser and every public operation, as functions of the inputs."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxdn
from jaxdn import brdf, color, losses, metrics
from jaxdn.core import numerics
from jaxdn.core.frame import FAR, RADIANCE_MAX, Clip, Frame
from jaxdn.denoiser.sanitize import sanitize
from jaxdn.materials import glints, microfacets
from jaxdn.methods.registry import methods
from jaxdn.ops import scales
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from jaxdn.ops.kernel_prediction.softmax import softmax_filter
from jaxdn.ops.motion import on_screen
from tests.hard_cases.inputs import HEIGHT, WIDTH, Inputs

_BORDERS = ("clamp", "zeros")
_METRICS = ("psnr", "temporal_psnr", "ssim", "l1", "mse", "flip", "relative_mse")
_UNBIASED = ("unbiased_mse", "unbiased_psnr", "unbiased_temporal_psnr", "unbiased_relative_mse")
_LOSSES = ("spatial", "temporal", "pyramid", "gradient")
_PICTURED = {*(f"warp, {border}" for border in _BORDERS), "apply_kernels", "compose_scales"} | {
    "softmax_filter",
    "softmax_filter, guided",
}


class Function(NamedTuple):
    """A function under test, and the conditions on its result."""

    name: str
    run: Callable[[Any, Inputs], Any]
    """(params, inputs) -> array."""
    begin: Callable[[], Any] = tuple
    """Makes its parameters: by default none."""
    sanitizes: bool = False
    """Its result must always be finite; the others may pass on NaN or infinity of their input."""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    pictured: bool = False
    """Its result is shown as a picture."""
    kind: str = "operation"
    differentiable: bool = True
    """It has gradients to test."""


def list_denoisers() -> list[Function]:
    """Every registered method that can run here, in its smallest variant, both ways to divide light and to filter it.

    A network has the weights that training starts from; what may follow another method also follows svgf,
    which is stabilised, too.
    """
    functions = []
    for name, method in methods().items():
        if not method.installed:
            continue
        options = method.variant_named(None)
        denoiser = method.factory(**options)
        begin = _beginning(denoiser)
        usual = Function(
            name,
            _on_clips(denoiser),
            begin,
            sanitizes=True,
            bounds=(0.0, RADIANCE_MAX),
            pictured=True,
            kind="denoiser",
            differentiable=method.differentiable,
        )
        functions.append(usual)
        if method.has_option("demodulate"):
            plain = method.factory(**{**options, "demodulate": "albedo"})
            functions.append(usual._replace(name=f"{name} by albedo", run=_on_clips(plain)))
        if method.has_option("after"):
            after = method.factory(**{**options, "after": methods()["svgf"].factory()})
            functions.append(usual._replace(name=f"{name} after svgf", run=_on_clips(after)))
        if method.has_option("kernels"):
            alone = method.factory(**{**options, "kernels": "plain", "background": "filter"})
            functions.append(usual._replace(name=f"{name} unguided", run=_on_clips(alone), begin=_beginning(alone)))
        if name == "svgf":
            functions.append(usual._replace(name=f"{name} stabilised", run=_on_clips(jaxdn.stabilised(denoiser))))
    return functions


def _beginning(denoiser: jaxdn.Denoiser) -> Callable[[], Any]:
    """Makes its weights when they are asked for, in one program: pytest lists the functions and runs few of them."""

    def begin() -> Any:
        return jax.jit(denoiser.init)(jax.random.key(0), Frame(np.zeros((HEIGHT, WIDTH, 3), np.float32)))

    return begin


def _on_clips(denoiser: jaxdn.Denoiser) -> Callable[[Any, Inputs], jax.Array]:
    return lambda params, inputs: denoised(denoiser, params, inputs.clip)


def denoised(denoiser: jaxdn.Denoiser, params: Any, clip: Clip) -> jax.Array:
    """The denoised clip; if samples are requested, every layer is the radiance."""
    if denoiser.samples is not None:
        clip = clip._replace(layers=dict.fromkeys((1, 2, 4, 8), clip.frames.radiance))
    return jaxdn.denoise(denoiser, params, clip)


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
        return jaxdn.apply_kernels(inputs.clip.frames.radiance[-1], jaxdn.normalize_kernels(inputs.logits))

    def filtered_by_logits(inputs: Inputs) -> jax.Array:
        return softmax_filter(inputs.clip.frames.radiance[-1:], inputs.logits)[0]

    def guided_by_features(inputs: Inputs) -> jax.Array:
        frame = sanitize(jax.tree.map(lambda buffer: buffer[-1], inputs.clip.frames))[0]
        features = 20 * jnp.concatenate([frame.albedo, frame.normal], axis=-1)
        return softmax_filter(frame.radiance[None], inputs.logits, features=features)[0]

    def by_affinity(inputs: Inputs) -> jax.Array:
        frame = sanitize(jax.tree.map(lambda buffer: buffer[-1], inputs.clip.frames))[0]
        features = 20 * jnp.concatenate([frame.albedo, frame.normal], axis=-1).transpose(2, 0, 1)
        flat = jnp.zeros((3, *features.shape[1:]), features.dtype)
        guide = Guide(features, flat, jnp.ones_like(flat[0]))
        return affinity_filter(frame.radiance.transpose(2, 0, 1), guide).transpose(1, 2, 0)

    def even(inputs: Inputs) -> jax.Array:
        """As the error for odd sizes says."""
        image = inputs.clip.frames.radiance[-1]
        height, width = image.shape[:2]
        return jnp.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")

    def composed(inputs: Inputs) -> jax.Array:
        fine = even(inputs)
        return jaxdn.compose_scales(fine, fine[::2, ::2], jax.nn.sigmoid(inputs.blend))

    def lost(inputs: Inputs, loss: Callable[..., jax.Array], *arguments: Any, **options: Any) -> jax.Array:
        return loss(*(color.compress(image) for image in _images(inputs)), *arguments, **options)

    def measured(inputs: Inputs, name: str, *, masked: bool) -> jax.Array:
        images = _images(inputs)
        if name != "relative_mse":
            images = tuple(jnp.clip(image, 0.0, 1.0) for image in images)  # a tone curve that half precision holds
        return getattr(metrics, name)(*images, mask=inputs.mask if masked else None)

    def unbiased(inputs: Inputs, name: str) -> jax.Array:
        image, reference = _images(inputs)
        if name != "unbiased_relative_mse":
            image, reference = jnp.clip(image, 0.0, 1.0), jnp.clip(reference, 0.0, 1.0)
        return getattr(metrics, name)(image, reference, reference[..., ::-1])

    def reflected(inputs: Inputs) -> jax.Array:
        frames = inputs.clip.frames
        cosine = frames.normal[..., 2:]
        return jax.vmap(brdf.directional_albedo)(frames.albedo, frames.albedo[..., ::-1], frames.roughness, cosine)

    def divided(inputs: Inputs, way: Callable[..., jax.Array]) -> jax.Array:
        return way(inputs.clip.frames.radiance, inputs.clip.frames.reflectance)

    def texture(inputs: Inputs) -> jax.Array:
        reflectance = inputs.clip.frames.reflectance
        return brdf.texture_left(reflectance, brdf.divisor(reflectance))

    def restored(inputs: Inputs) -> jax.Array:
        return brdf.restore(inputs.clip.frames.radiance, texture(inputs), brdf.hue_left(texture(inputs)))

    def left(inputs: Inputs, hue: bool) -> jax.Array:
        frames = inputs.clip.frames
        return brdf.texture_or_hue(frames.reflectance[-1], frames.radiance[-1], jnp.asarray(hue))

    def of_light(function: Callable[..., jax.Array], **options: Any) -> Callable[[Inputs], jax.Array]:
        return lambda inputs: function(inputs.clip.frames.radiance, **options)

    def curve(inputs: Inputs) -> jax.Array:
        """The green channel of the last frame's first row, as if it were measured; at least one value."""
        return inputs.clip.frames.radiance[-1, 0, :, 1]

    def extracted(inputs: Inputs, shadowing: microfacets.Shadowing = "correlated") -> jax.Array:
        return microfacets.extract_distribution(curve(inputs), shadowing=shadowing)

    def fresnel(inputs: Inputs) -> jax.Array:
        image = inputs.clip.frames.radiance[-1]
        return microfacets.extract_fresnel(image, jnp.linspace(0.0, 1.5, image.shape[0]), extracted(inputs))

    def masked(inputs: Inputs) -> jax.Array:
        return microfacets.masking(extracted(inputs), inputs.clip.frames.depth[-1])

    def lobe(inputs: Inputs, lobe: microfacets.Lobe) -> jax.Array:
        return microfacets.distribution(inputs.clip.frames.normal[-1], inputs.clip.frames.roughness[-1], lobe=lobe)

    def glint(inputs: Inputs, lobe: microfacets.Lobe) -> jax.Array:
        frames = inputs.clip.frames
        place, footprint = frames.motion[-1], frames.depth[-1] / 128  # exact in bfloat16 too
        return glints.glint_distribution(frames.normal[-1], place, footprint, frames.roughness[-1], lobe=lobe)

    def flakes(inputs: Inputs) -> jax.Array:
        return glints.flake_normals(8, inputs.clip.frames.roughness[-1, 0, 0, 0], flakes=32, bins=3)

    def filled(inputs: Inputs) -> jax.Array:
        frame = jax.tree.map(lambda buffer: buffer[-1], inputs.clip.frames)
        known = sanitize(frame)[0].depth < FAR  # as the denoisers that fill pixels see it
        return scales.fill_holes(scales.pad(frame.radiance, 16), scales.pad(known, 16))

    return {
        **{f"warp, {border}": partial(warped, border=border) for border in _BORDERS},
        "on_screen": lambda inputs: jax.vmap(on_screen)(inputs.clip.frames.motion).astype(jnp.float32),
        "dual_motion": dual,
        "occlusion_mask": masks,
        "normalize_kernels": lambda inputs: jaxdn.normalize_kernels(inputs.logits),
        "apply_kernels": filtered,
        "softmax_filter": filtered_by_logits,
        "softmax_filter, guided": guided_by_features,
        "affinity_filter": by_affinity,
        "compose_scales": composed,
        "downsample": lambda inputs: scales.downsample(even(inputs)),
        "space_to_depth": lambda inputs: scales.space_to_depth(even(inputs)),
        "fill_holes": filled,
        "upsample": lambda inputs: scales.upsample(inputs.clip.frames.radiance[-1]),
        "brdf.directional_albedo": reflected,
        "brdf.divisor": lambda inputs: brdf.divisor(inputs.clip.frames.reflectance),
        "brdf.demodulate": partial(divided, way=brdf.demodulate),
        "brdf.remodulate": partial(divided, way=brdf.remodulate),
        "brdf.texture_left": texture,
        "brdf.hue_left": lambda inputs: brdf.hue_left(texture(inputs)),
        "brdf.texture_or_hue": partial(left, hue=False),
        "brdf.texture_or_hue, hue": partial(left, hue=True),
        "brdf.restore": restored,
        "color.compress": of_light(color.compress),
        "color.expand": lambda inputs: color.expand(jnp.minimum(inputs.clip.frames.radiance, 2.0)),
        "color.luminance": of_light(color.luminance),
        "color.luminance_of_planes": of_light(
            lambda light: color.luminance_of_planes(jnp.moveaxis(light, -1, 0))[..., None]
        ),
        **{f"color.tonemap, {one}": of_light(color.tonemap, operator=one) for one in color.OPERATORS},
        "color.exposure": lambda inputs: jnp.reshape(color.exposure(inputs.clip.frames.radiance[-1]), (1, 1, 1)),
        "color.brightness": lambda inputs: color.brightness(inputs.clip.frames.radiance[-1])[None, None],
        "color.exposure_of": lambda inputs: jnp.reshape(
            color.exposure_of(color.brightness(inputs.clip.frames.radiance[-1])), (1, 1, 1)
        ),
        "color.tonemap_halves": lambda inputs: jnp.stack(color.tonemap_halves(*_images(inputs))),
        "color.srgb_encode": lambda inputs: color.srgb_encode(jnp.clip(inputs.clip.frames.radiance, 0.0, 1.0)),
        "color.srgb_decode": lambda inputs: color.srgb_decode(jnp.clip(inputs.clip.frames.radiance, 0.0, 1.0)),
        "microfacets.extract_distribution": extracted,
        "microfacets.extract_distribution, separable": partial(extracted, shadowing="separable"),
        "microfacets.masking": masked,
        "microfacets.extract_fresnel": fresnel,
        **{
            f"microfacets.fit_alpha, {one}": lambda inputs, one=one: jnp.stack(
                microfacets.fit_alpha(extracted(inputs), lobe=one)
            )
            for one in microfacets.LOBES
        },
        **{f"microfacets.distribution, {one}": partial(lobe, lobe=one) for one in microfacets.LOBES},
        **{f"glints.glint_distribution, {one}": partial(glint, lobe=one) for one in microfacets.LOBES},
        "glints.flake_normals": flakes,
        "numerics.absolute": of_light(numerics.absolute),
        "numerics.safe_norm": lambda inputs: numerics.safe_norm(inputs.clip.frames.normal),
        "numerics.safe_norm of light": of_light(numerics.safe_norm),
        "numerics.safe_power": of_light(numerics.safe_power, exponent=0.45),
        **{f"losses.{name}": partial(lost, loss=getattr(losses, name)) for name in _LOSSES},
        "losses.gradient, hfen": partial(lost, loss=losses.gradient, operator="hfen"),
        "losses.unbiased": lambda inputs: jnp.stack(losses.unbiased(*_images(inputs))),
        "losses.occlusion": lambda inputs: lost(inputs, losses.occlusion, inputs.mask),
        **{f"metrics.{name}": partial(measured, name=name, masked=False) for name in _METRICS},
        **{f"metrics.{name}": partial(unbiased, name=name) for name in _UNBIASED},
        **{f"metrics.{name}, masked": partial(measured, name=name, masked=True) for name in _METRICS},
    }


def list_operations() -> list[Function]:
    """Every public operation, and the sanitizing of a frame, the first step of every denoiser."""
    pure = [
        Function(name, lambda params, inputs, run=run: run(inputs), pictured=name in _PICTURED)
        for name, run in _operations().items()
    ]

    def sanitized(params: Any, inputs: Inputs) -> jax.Array:
        return sanitize(inputs.clip.frames)[0].radiance

    mended = Function("sanitize", sanitized, sanitizes=True, bounds=(0.0, RADIANCE_MAX), pictured=True)
    return [*pure, mended]


def gradient_of(run: Callable[[Any, Inputs], Any]) -> Callable[[Any, Inputs], Any]:
    """The gradient of a weighted mean of the result of ``run``, by its parameters, the radiance and the logits.

    The weights vary from -1 to 1: the plain mean of normalised kernels, for one, has a gradient of zero.
    """

    def mean(params: Any, radiance: Any, logits: Any, inputs: Inputs) -> jax.Array:
        frames = inputs.clip.frames._replace(radiance=radiance)
        changed = inputs._replace(clip=inputs.clip._replace(frames=frames), logits=logits)
        out = run(params, changed)
        out = jnp.asarray(out, jnp.promote_types(out.dtype, jnp.float32))
        return jnp.mean(out * np.cos(np.arange(out.size)).reshape(out.shape).astype(out.dtype))

    def gradient(params: Any, inputs: Inputs) -> Any:
        return jax.grad(mean, (0, 1, 2), allow_int=True)(params, inputs.clip.frames.radiance, inputs.logits, inputs)

    return gradient


def narrow_gradient(gradient: Any, inputs: Inputs) -> Any:
    """A gradient of :func:`gradient_of` by widened inputs, as one by ``inputs``: each in the precision of its own."""
    params, radiance, logits = gradient
    return params, radiance.astype(inputs.clip.frames.radiance.dtype), logits.astype(inputs.logits.dtype)
