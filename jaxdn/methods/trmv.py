"""Temporally reliable motion vectors (``trmv``): every effect has a history that is fetched where the effect was.

Shadows and reflections do not move with the surfaces that show them, so a history fetched along the surface's motion
has the old shadow in it. Here light is filtered in up to three parts, each with a vector of its own and none blended
with another's:

* light straight from lights: what it would be without shadows moves with the surface; the share of it that the shadows
  leave follows the *shadow vectors*;
* specular light follows the *glossy vectors*, along which the virtual image moves;
* all other light follows the *dual vectors*, which lead a disoccluded pixel beside its former occluder.

Everything else is ``svgf``: running means with tested taps, the variance, and a-trous levels guided by it; but nothing
that was filtered in space is fed back into the histories of shadows and of specular light, as their edges would blur.

Zheng Zeng, Shiqiu Liu, Jinglei Yang, Lu Wang, Ling-Qi Yan, "Temporally Reliable Motion Vectors for Real-time Ray
Tracing", 2021, as far as their follow-up on learned denoising and other descriptions tell; how the parts are put
together is our own. The share of shadows is a ratio of two filtered images (Heitz, Hill and McGuire, "Combining
Analytic Direct Illumination and Stochastic Shadows", 2018).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import brdf
from jaxdn.core.frame import Array, Frame
from jaxdn.core.options import Range
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics, count_reflectance_differs
from jaxdn.filters.accumulation import after_shift, find_least_share, luminance, with_texture
from jaxdn.filters.atrous import GAUSSIAN, stencil
from jaxdn.filters.cascade import cascade
from jaxdn.filters.clamping import clamp_to_fast
from jaxdn.filters.edge_stopping import Weight, depth_weight, lobe_weight, luminance_weight, roughness_weight
from jaxdn.filters.reproject import reproject_along
from jaxdn.filters.surface_test import Guides, expect_surface, guides_of, keep_shared, surface_mask
from jaxdn.filters.variance import estimate_variance
from jaxdn.methods import svgf
from jaxdn.methods.demodulation import Demodulation
from jaxdn.methods.learnable_options import FITTING, LEARNABLE, apply_offsets, at_level, zero_offsets
from jaxdn.methods.lobes import DemodulatedLight, reflectances, split_signals
from jaxdn.methods.registry import method

READS = svgf.READS | {
    *("albedo", "reflectance", "specular_reflectance", "roughness", "dual_motion"),
    *("specular", "glossy_motion", "shadowed", "unshadowed", "shadow_motion"),
}
_TAPS = stencil(1, kernel=GAUSSIAN)
_LENGTH = 5
"""The plane of the history length."""
_DARK = 1e-6
"""Unshadowed light below this has no shadows."""


@dataclass(frozen=True)
class Options(svgf.SharedOptions):
    """The options that filters made of the parts of ``svgf`` share, and those of the vectors."""

    dual_tested: bool = True
    """What a dual vector leads to must show the same shape and normal; or it is taken as it is, as in the paper."""

    clamp_sigma: Annotated[float, Range(0, without_low=True), LEARNABLE] = 1.0
    """The history's share of shadows may be this many standard deviations from the mean of the frame's own over 5x5
    pixels: where none of them is shadowed, none has been."""
    sigma_specular: Annotated[float, Range(0, without_low=True), LEARNABLE] = 2.0
    """Edge-stopping parameter for differences in luminance, in standard deviations, of specular light: it has the
    textures and edges of what is reflected, which no buffer shows."""
    lobe_fraction: Annotated[float, Range(0, without_low=True), LEARNABLE] = 2.0
    """For specular light, normals may differ by this fraction of the lobe's angle."""
    roughness_fraction: Annotated[float, Range(0, without_low=True), LEARNABLE] = 1.0
    """For specular light, roughness may differ by this fraction."""
    demodulate: Demodulation = "brdf"
    """What light is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`; diffuse and specular
    light each by its own part."""


PAPER = Options(dual_tested=False, **svgf.AS_PUBLISHED)
"""The settings of the paper as far as they are known: dual vectors are followed without a test (eq. 6). The paper
filters as SVGF does, so the rest is SVGF's preset; what follows which vector and how the parts are put together is
ours."""


class TrmvState(NamedTuple):
    """What is carried from one frame to the next."""

    rest: jax.Array
    """[H, W, 9] as of ``svgf``; with shadows [H, W, 12]: unshadowed light, too, along the same vectors, of the same
    texture."""
    shadows: jax.Array | None
    """[H, W, 12] the same of light with its shadows, and unshadowed light along the shadow vectors; None without."""
    specular: jax.Array | None
    """[H, W, 9] the same of specular light; None without."""
    guides: Guides
    """Depth, normal and ids of the previous frame, as far as present."""


class _Parts(NamedTuple):
    """A frame's light in parts, divided, [3, H, W]; ``None`` where a part is absent."""

    rest: jax.Array
    shadowed: jax.Array | None
    unshadowed: jax.Array | None
    diffuse: DemodulatedLight
    """All but specular light, with its divisor."""
    specular: DemodulatedLight | None
    """Specular light."""


@method(
    Options,
    title="Motion vectors of shadows and reflections (Zeng, Liu et al. 2021)",
    presets={"paper": PAPER},
    recipes={"usual": FITTING},
    filter=True,
)
def trmv(given: Options) -> Denoiser:
    """The filter, which needs no weights: ``params`` are ``{}``, or move the options that may be learned.

    Reads shadowed, unshadowed, shadow_motion, specular, glossy_motion, dual_motion, reflectance, specular_reflectance,
    albedo, normal, depth, previous_depth, roughness, motion and ids. Without ``shadowed`` direct light follows the dual
    vectors as all other diffuse light; without ``specular`` reflected light does too; a missing vector is ``motion``;
    without any other buffer its test or weight is left out. Pixels without a surface (depth at ``FAR`` or id -1) pass
    through. Raises ValueError for options out of range and radiance that is not [H, W, 3].
    """

    def start(params: Params, frame: Frame) -> TrmvState:
        def nothing(planes: int) -> jax.Array:
            return jnp.zeros((*frame.radiance.shape[:2], planes), frame.radiance.dtype)

        guides = jax.tree.map(jnp.zeros_like, guides_of(frame))
        lit, shines = frame.shadowed is not None, frame.specular is not None
        return TrmvState(
            nothing(12 if lit else 9), nothing(12) if lit else None, nothing(9) if shines else None, guides
        )

    def step(
        params: Params, state: TrmvState, frame: Frame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[TrmvState, jax.Array, jax.Array]:
        options = apply_offsets(given, params)
        parts = _split(frame, options.demodulate, statistics)
        state = _fit_state(state, start(params, frame))
        along = frame.motion if frame.dual_motion is None else frame.dual_motion
        untested = not options.dual_tested
        past, invalid = _reproject_signal(options, state.rest, state.guides, frame, along, first, untested=untested)
        diffuse = frame._replace(radiance=parts.rest.transpose(1, 2, 0), reflectance=reflectances(frame)[0])
        # As in a wrapper by `demodulated`: the light is divided, and the reflectance is what it was divided by.
        differs = jnp.asarray(count_reflectance_differs(diffuse), statistics.reflectance_differs.dtype)
        of_diffuse = statistics._replace(reflectance_differs=differs)
        texture = svgf.planar_texture(diffuse, options.demodulate, of_diffuse)
        history = svgf.blend(options, past[:9], parts.rest, texture)
        kept, image = svgf.filter_history(options, history, diffuse, texture, of_diffuse)
        rest, shadows, specular = kept.history, None, None
        hit = surface_mask(frame.depth, frame.ids)

        if parts.shadowed is not None and parts.unshadowed is not None and state.shadows is not None:
            unshadowed = _mean(options, past[9:], parts.unshadowed, past[_LENGTH])
            free = brdf.restore(unshadowed, texture, history[6:])
            along = frame.motion if frame.shadow_motion is None else frame.shadow_motion
            past, more_invalid = _reproject_signal(
                options, state.shadows, state.guides, frame, along, first, any_surface=True
            )
            shadows, lit = _filter_shadows(options, past, parts, free, frame, hit, statistics.height)
            rest = jnp.concatenate([rest, unshadowed.transpose(1, 2, 0)], axis=-1)
            image, invalid = image + lit, invalid + more_invalid
        image = parts.diffuse.remodulate(image.transpose(2, 0, 1))

        if parts.specular is not None and state.specular is not None:
            along = frame.motion if frame.glossy_motion is None else frame.glossy_motion
            past, more_invalid = _reproject_signal(options, state.specular, state.guides, frame, along, first)
            texture = parts.specular.known_texture()
            history = svgf.blend(options, past, parts.specular.light, texture)
            today = with_texture(history[:6], history[6:], texture)
            image = image + parts.specular.remodulate(
                _filter_specular(options, today, texture, frame, hit, statistics.height)
            )
            specular = history.transpose(1, 2, 0)
            invalid = invalid + more_invalid
        if hit is not None:
            image = jnp.where(hit[..., None], image, frame.radiance)
        return TrmvState(rest, shadows, specular, guides_of(frame)), image, invalid

    return recurrent(Core(start, step, READS, lambda key, frame: zero_offsets(given)))


def _split(frame: Frame, by: Demodulation, statistics: FrameStatistics) -> _Parts:
    diffuse, specular = split_signals(frame, by, statistics)
    if frame.shadowed is None:
        return _Parts(diffuse.light, None, None, diffuse, specular)

    def divided(image: jax.Array) -> jax.Array:
        planes = image.transpose(2, 0, 1)
        return planes if diffuse.divisor is None else planes / diffuse.divisor

    shadowed = jnp.minimum(divided(frame.shadowed), diffuse.light)
    unshadowed = shadowed if frame.unshadowed is None else jnp.maximum(divided(frame.unshadowed), shadowed)
    return _Parts(diffuse.light - shadowed, shadowed, unshadowed, diffuse, specular)


def _fit_state(state: TrmvState, begun: TrmvState) -> TrmvState:
    """The state with the histories that this frame needs; those that have come within the clip are empty."""
    rest, planes = state.rest, begun.rest.shape[-1]
    if rest.shape[-1] != planes:
        rest = jnp.concatenate([rest[..., :9], begun.rest[..., 9:]], axis=-1)
    shadows = begun.shadows if state.shadows is None or begun.shadows is None else state.shadows
    specular = begun.specular if state.specular is None or begun.specular is None else state.specular
    return TrmvState(rest, shadows, specular, state.guides)


def _reproject_signal(
    options: Options,
    history: jax.Array,
    before: Guides,
    frame: Frame,
    vector: Array,
    first: jax.Array,
    *,
    any_surface: bool = False,
    untested: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """The history [C, H, W] fetched along a vector, 0 where missing; how many of its pixels were invalid.

    Where the vector is that of the surface, taps must show the same surface, as in ``svgf``. Elsewhere they show
    another place of it, whose depth tells nothing, or with ``any_surface`` one beside it: normals must agree there.
    With ``untested`` whatever they show there counts.
    """
    expected = expect_surface(frame, before, depth_tolerance=options.depth_tolerance)
    if vector is not None:
        still = 0.0 if frame.motion is None else frame.motion
        elsewhere = jnp.any(jnp.isfinite(vector) & (vector != still), axis=-1)
        if expected.tolerance is not None:
            expected = expected._replace(tolerance=jnp.where(elsewhere, jnp.inf, expected.tolerance))
        if (any_surface or untested) and expected.ids is not None:
            expected = expected._replace(ids=jnp.where(elsewhere, jnp.nan, expected.ids))
        if untested and expected.normal is not None:
            expected = expected._replace(normal=jnp.where(elsewhere[..., None], jnp.nan, expected.normal))
    before = keep_shared(before, guides_of(frame))
    found = reproject_along(
        history, before, vector, expected, first, normal_threshold=options.normal_threshold, search_neighbours=True
    )
    return found.history.transpose(2, 0, 1), found.invalid


def _mean(options: Options, past: jax.Array, now: jax.Array, length: jax.Array) -> jax.Array:
    """The running mean of colour [3, H, W] with the weights that ``accumulate`` has at a past of ``length``."""
    least = find_least_share(length, jnp.minimum(length + 1.0, options.history_max), ramp=options.ramp)
    share = jnp.maximum(options.alpha, least)
    return past + share[None] * (now - past)


def _filter_shadows(
    options: Options,
    past: jax.Array,
    parts: _Parts,
    free: jax.Array,
    frame: Frame,
    hit: jax.Array | None,
    height: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The history [H, W, 12] of shadows, and direct light [H, W, 3].

    The share that shadows leave is S / U, with S light and U unshadowed light, both fetched along the shadow vectors
    and filtered with the same weights; it multiplies the unshadowed light that moves with the surface (``free``).
    """
    assert parts.shadowed is not None
    assert parts.unshadowed is not None
    held = _clamp_shadows(options, past, parts.shadowed, parts.unshadowed, hit)
    texture = parts.diffuse.known_texture()
    history = svgf.blend(options, held, parts.shadowed, texture)
    under = _mean(options, past[9:], parts.unshadowed, past[_LENGTH])
    today = with_texture(history[:6], history[6:], texture)

    def weights(level: Any) -> list[Weight]:
        return svgf.surface_weights(options, frame.depth, frame.normal, frame.ids, height, level)

    def estimated(light: jax.Array) -> tuple[jax.Array, jax.Array]:
        planes = today.at[:3].set(light)
        short: dict[str, Any] = {"short_history": options.short_history, "spatial": options.spatial}
        return estimate_variance(planes, hit, weights(0), texture=texture, **short)

    color, variance = estimated(today[:3])
    # The ratio needs the same neighbours for all.
    lights = [color, estimated(brdf.restore(under, texture, history[6:]))[0], estimated(free)[0]]
    planes = jnp.concatenate([*lights, texture])
    found = _apply_cascade(options, planes, variance, hit, weights, options.sigma_luminance)
    light = brdf.restore(_share(found[:3], found[3:6]) * found[6:9], texture, found[9:])
    return jnp.concatenate([history, under]).transpose(1, 2, 0), light.transpose(1, 2, 0)


def _clamp_shadows(
    options: Options, past: jax.Array, lit: jax.Array, free: jax.Array, hit: jax.Array | None
) -> jax.Array:
    """The history [9, H, W] of light with its shadows, clamped to what the frame shows around each pixel."""
    shines = jnp.any(free > _DARK, axis=0)
    known = shines if hit is None else shines & hit
    before = _share(past[:3], past[9:])
    held = clamp_to_fast(before, _share(lit, free), known, sigma=options.clamp_sigma)
    color = past[:3] + (held - before) * past[9:]
    moments = after_shift(past[3:5], luminance(color) - luminance(past))
    return jnp.concatenate([jnp.maximum(color, 0.0), moments, past[5:9]])


def _share(lit: jax.Array, free: jax.Array) -> jax.Array:
    """The share of light that shadows leave; 1 where there is no light."""
    some = free > _DARK
    return jnp.where(some, lit / jnp.where(some, free, 1.0), 1.0)


def _filter_specular(
    options: Options,
    history: jax.Array,
    texture: jax.Array,
    frame: Frame,
    hit: jax.Array | None,
    height: jax.Array,
) -> jax.Array:
    """Specular light [3, H, W], from its history [6, H, W].

    What is reflected has colours that no division removes: differences of channels stop the filter as those of
    luminance do.
    """
    first = _lobe_weights(options, frame, height, 0)
    short: dict[str, Any] = {"short_history": options.short_history, "spatial": options.spatial}
    color, variance = estimate_variance(history, hit, first, texture=texture, isolated=False, **short)
    deviation = jnp.sqrt(jnp.maximum(variance, 1e-10))
    hues = [luminance_weight(color[one] - color[1], deviation, sigma=options.sigma_specular) for one in (0, 2)]
    return _apply_cascade(
        options,
        color,
        variance,
        hit,
        lambda level: [*_lobe_weights(options, frame, height, level), *hues],
        options.sigma_specular,
        texture,
    )


def _lobe_weights(options: Options, frame: Frame, height: jax.Array, level: Any) -> list[Weight]:
    """The edge-stopping weights of specular light; without roughness its lobes are as wide as diffuse ones."""
    weights: list[Weight] = []
    size = frame.radiance.shape[:2]
    rough = jnp.ones((*size, 1), frame.radiance.dtype) if frame.roughness is None else frame.roughness
    if frame.roughness is not None:
        weights.append(roughness_weight(rough, fraction=options.roughness_fraction))
    if frame.depth is not None:
        sigma = at_level(options.sigma_depth, level)
        weights.append(depth_weight(frame.depth, frame.ids, sigma=sigma, height=height))
    if frame.normal is not None:
        weights.append(lobe_weight(frame.normal, rough, fraction=options.lobe_fraction))
    return weights


def _apply_cascade(
    options: Options,
    planes: jax.Array,
    variance: jax.Array,
    hit: jax.Array | None,
    weights: Callable[[Any], Sequence[Weight]],
    sigma: float | jax.Array,
    texture: jax.Array | None = None,
) -> jax.Array:
    """The image [C, H, W] after the a-trous levels, none of which is fed back: edges of shadows stay sharp."""
    levels = options.levels
    return cascade(planes, variance, hit, weights, _TAPS, levels=levels, sigma_luminance=sigma, texture=texture)[0]
