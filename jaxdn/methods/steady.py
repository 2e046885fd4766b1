"""A steady denoiser of our own (``steady``): a variance-guided filter's skeleton, guided by a small recurrent network.

For each frame: divide by what surfaces reflect; fetch the history with a test of every tap; blend the noisy frame into
a running mean whose effective number of samples is known per pixel; filter that mean by an edge-stopping a-trous
cascade, one level at full resolution and the others at half; add what the coarse levels found; blend with the warped
output of the last frame. A U-Net at half resolution decides, per pixel: features whose differences stop the filter,
how much a pixel is to be trusted, how much of each level to take, and how fast both histories follow.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.filters.guides import Guides, depth_slopes, guides_of, hit_mask, shared, unpack
from jaxdn.filters.reprojection import same_surface
from jaxdn.frame import FAR, RADIANCE_MAX, Frame
from jaxdn.methods.demodulated import Demodulation, demodulated
from jaxdn.methods.ntd import depth_feature
from jaxdn.methods.table import method
from jaxdn.networks import Widths, crop, pad
from jaxdn.objectives import unbiased_illumination
from jaxdn.ops.affinity_filter import Guide, affinity_filter
from jaxdn.ops.warp import corners, weighted_cells
from jaxdn.recipe import Recipe
from jaxdn.scales import downsample, fill, upsample

LEVELS = 4
"""Levels of the cascade at half resolution."""
FEATURES = (5, 8)
"""Learned features at full and at half resolution."""
_PACKED = FEATURES[0] + 5  # confidence, share of the frame, history's share, coarse share, feedback
_HALF = FEATURES[1] + 1 + LEVELS
WIDTHS: dict[str, Widths] = {
    "fast": ((16,), (24,), (32,), (32,), (32,)),
    "balanced": ((32,), (48,), (64,), (64,), (64,)),
    "high": ((48, 48), (64, 64), (80, 80), (96, 96), (96, 96)),
}


@dataclass(frozen=True)
class Options:
    """Options."""

    quality: Literal["fast", "balanced", "high"] | Widths = "balanced"
    history_max: float = 32.0
    demodulate: Demodulation | bool = "brdf"
    implementation: Literal["reference", "onnxruntime", "onednn"] | None = None


class SteadyState(NamedTuple):
    """State."""

    history: jax.Array
    """[H, W, 8] mean (3), second moment of luminance (1), effective number of samples (1), output (3)."""
    guides: Guides


@method(
    Options,
    title="Steady",
    recipes={"usual": Recipe(unbiased_illumination(squared_from=0.0))},
    variants={"steady": {"quality": "balanced"}},
    engines=("onednn",),
)
def steady(options: Options) -> Denoiser:
    """Steady."""
    from jaxdn.networks.unet import unet

    widths = WIDTHS[options.quality] if isinstance(options.quality, str) else options.quality
    network = unet((28, 19), (4 * _PACKED + _HALF,), widths=widths, implementation=options.implementation)
    reads = frozenset({"albedo", "normal", "depth", "previous_depth", "motion", "dual_motion", "ids"})

    def init(key: jax.Array, frame: Frame) -> Params:
        params = network.init(key)
        bias = params["head_0"]["bias"]
        at = 4 * FEATURES[0]
        begin = {0: 4.0, 1: 0.0, 2: 0.0, 3: 4.0, 4: -4.0}
        for index, value in begin.items():
            bias = bias.at[at + 4 * index : at + 4 * index + 4].set(value)
        bias = bias.at[4 * _PACKED + FEATURES[1]].set(4.0)
        bias = bias.at[-LEVELS:].set(4.0)
        params = {**params, "head_0": {**params["head_0"], "bias": bias}}
        guide = {
            "albedo": jnp.full((1 + LEVELS, 1), 1.0),
            "normal": jnp.full((1 + LEVELS, 1), math.log(8.0) - 1.0),
            "depth": jnp.full((1 + LEVELS, 1), 6.0),
            "light": jnp.full((1 + LEVELS, 1), math.log(4.0)),
        }
        return {**params, "guide": guide}

    def start(params: Params, frame: Frame) -> SteadyState:
        nothing = jnp.zeros((*frame.radiance.shape[:2], 8), frame.radiance.dtype)
        return SteadyState(nothing, jax.tree.map(jnp.zeros_like, guides_of(frame)))

    def step(params: Params, state: SteadyState, frame: Frame, first: jax.Array):
        size = frame.radiance.shape[:2]
        frame = frame._replace(radiance=jnp.minimum(frame.radiance, RADIANCE_MAX))
        past, valid, broken = _recall(state, frame, first)
        valid = valid[..., None]

        hit = hit_mask(frame.depth, frame.ids)
        hit = jnp.ones(size, bool) if hit is None else hit
        wide = lambda image: pad(image, 32)
        noisy, past, valid, hit = wide(frame.radiance), wide(past), wide(valid), wide(hit[..., None])
        noisy = fill(noisy, hit)
        gain = color.exposure(noisy)
        reflectance = frame.albedo if frame.reflectance is None else frame.reflectance
        albedo = jnp.zeros_like(noisy) if reflectance is None else wide(reflectance) - 1.0
        normal = jnp.zeros_like(noisy) if frame.normal is None else wide(frame.normal)
        depth = None if frame.depth is None else wide(frame.depth)
        closeness = jnp.zeros_like(noisy[..., :1]) if depth is None else depth_feature(depth)
        mean, moment, count, shown = past[..., :3], past[..., 3:4], past[..., 4:5], past[..., 5:8]
        light = color.luminance(noisy)
        spread = jnp.sqrt(jnp.maximum(moment - color.luminance(mean) ** 2, 0.0) + 1e-12) / (
            color.luminance(mean) + 1e-3 / gain
        )
        seen_noisy = color.compress(gain * noisy)
        seen_mean = jnp.where(valid, color.compress(gain * mean), seen_noisy)
        seen_shown = jnp.where(valid, color.compress(gain * shown), seen_noisy)
        geometry = jnp.concatenate([albedo, normal, closeness], -1)
        lights = jnp.concatenate(
            [seen_noisy, seen_mean, seen_shown, jnp.minimum(spread, 8.0) / 8.0, 1.0 / (1.0 + count), hit.astype(noisy.dtype)],
            -1,
        )
        fine = jnp.concatenate([color.luminance(seen_noisy), color.luminance(seen_shown)], -1)
        features = [_packed(geometry), jnp.concatenate([downsample(lights), _packed(color.luminance(seen_shown)), _packed(color.luminance(seen_noisy))[..., :3]], -1)]
        weights = {name: part for name, part in params.items() if name != "guide"}
        head = network.apply(weights, [group[None] for group in features])[0][0]
        full = _unpacked(head[..., : 4 * _PACKED])
        half = head[..., 4 * _PACKED :]
        own, (trust, follow, blend, coarse, back) = full[..., : FEATURES[0]], jnp.split(full[..., FEATURES[0] :], 5, -1)

        # The running mean
        usual = 1.0 / (1.0 + count)
        share = jax.nn.sigmoid(follow + jnp.log(usual / jnp.maximum(1.0 - usual, 1e-6)))
        share = jnp.where(valid, share, 1.0)
        now = jnp.concatenate([noisy, light * light], -1)
        then = jnp.where(valid, past[..., :4], now)
        mixed = then + share * (now - then)
        mean, moment = mixed[..., :3], mixed[..., 3:4]
        number = 1.0 / (jnp.square(1.0 - share) / jnp.maximum(count, 1e-6) + share * share)
        number = jnp.where(valid, jnp.minimum(number, options.history_max), 1.0)

        # cascade
        guide = {name: jnp.exp(0.5 * part) for name, part in params["guide"].items()}

        def planar(image):
            return image.transpose(2, 0, 1)

        def guide_at(level, geometry, own, slanted, trust, hit):
            scales = [guide["albedo"][level]] * 3 + [guide["normal"][level]] * 3
            geometry = geometry * jnp.concatenate(scales)[None, None]
            slanted = guide["depth"][level] * slanted
            confidence = (jax.nn.sigmoid(trust) + 1e-3) * hit
            return Guide(planar(jnp.concatenate([geometry, own], -1)), planar(slanted), confidence[..., 0])

        def filtered(image, step, guide):
            return affinity_filter(planar(image), guide, step=step).transpose(1, 2, 0)

        solid = hit.astype(noisy.dtype)
        slanted = jnp.zeros_like(noisy) if depth is None else _slanted(depth)
        surface = jnp.concatenate([albedo, normal], -1)
        y0 = filtered(mean, 1, guide_at(0, surface, own, slanted, trust, solid))
        small_hit = (downsample(solid) > 0).astype(noisy.dtype)
        x = downsample(fill(y0, hit))
        begin = x
        own_half, trust_half, mixes = half[..., : FEATURES[1]], half[..., FEATURES[1] : FEATURES[1] + 1], half[..., -LEVELS:]
        surface, slanted = downsample(surface), jnp.zeros_like(x) if depth is None else _slanted(depth[::2, ::2])
        for level in range(LEVELS):
            y = filtered(x, 2**level, guide_at(1 + level, surface, own_half, slanted, trust_half, small_hit))
            x = x + jax.nn.sigmoid(mixes[..., level : level + 1]) * (y - x)
        image = y0 + jax.nn.sigmoid(coarse) * upsample(x - begin)
        image = jnp.maximum(image, 0.0)
        # stabilise
        newest = jnp.where(valid, jax.nn.sigmoid(blend), 1.0)
        out = jnp.where(valid, shown, image)
        out = out + newest * (image - out)
        out = jnp.minimum(out, RADIANCE_MAX)
        kept = mean + jax.nn.sigmoid(back) * (y0 - mean)
        history = jnp.concatenate([kept, moment, number, out], -1)
        history, out, hit = crop(history, size), crop(out, size), crop(hit, size)
        result = jnp.where(hit, out, frame.radiance)
        return SteadyState(history, guides_of(frame)), result, broken

    return demodulated(recurrent(Core(start, step, reads, init)), by=options.demodulate)


def _packed(image: jax.Array) -> jax.Array:
    height, width, channels = image.shape
    blocks = image.reshape(height // 2, 2, width // 2, 2, channels)
    return blocks.transpose(0, 2, 4, 1, 3).reshape(height // 2, width // 2, 4 * channels)


def _unpacked(image: jax.Array) -> jax.Array:
    height, width, channels = image.shape
    blocks = image.reshape(height, width, channels // 4, 2, 2)
    return blocks.transpose(0, 3, 1, 4, 2).reshape(2 * height, 2 * width, channels // 4)


def _slanted(depth: jax.Array) -> jax.Array:
    """[H, W, 3] the logarithm-like inverse depth, affine on planes, relative to its mean, and its slopes."""
    known = (depth > 0) & (depth < FAR)
    inverse = jnp.where(known, 1.0 / jnp.where(known, depth, 1.0), 0.0)
    middle = jnp.sum(inverse) / jnp.maximum(jnp.sum(known, dtype=depth.dtype), 1.0)
    inverse = inverse / jnp.maximum(middle, 1e-12)
    slope_x, slope_y = depth_slopes(inverse, None)
    return jnp.stack([inverse[..., 0], slope_x, slope_y], -1)


def _recall(state: SteadyState, frame: Frame, first: jax.Array):
    before = shared(state.guides, guides_of(frame))
    accept = same_surface(frame, before, depth_tolerance=0.02, normal_threshold=0.9)
    height, width = frame.radiance.shape[:2]
    motion = jnp.zeros_like(frame.radiance[..., :2]) if frame.motion is None else frame.motion
    motion = jax.lax.stop_gradient(motion)
    known = jnp.all(jnp.isfinite(motion), axis=-1)
    motion = jnp.where(known[..., None], motion, 0.0)
    x = jax.lax.broadcasted_iota(motion.dtype, (height, width), 1) + motion[..., 0]
    y = jax.lax.broadcasted_iota(motion.dtype, (height, width), 0) + motion[..., 1]
    left = jnp.clip(jnp.floor(x), 0, max(width - 2, 0))
    top = jnp.clip(jnp.floor(y), 0, max(height - 2, 0))
    fx, fy = x - left, y - top
    inside = known & (fx >= 0) & (fx <= 1) & (fy >= 0) & (fy <= 1) & ~first
    fx, fy = jnp.clip(fx, 0, 1), jnp.clip(fy, 0, 1)
    top, left = top.astype(jnp.int32), left.astype(jnp.int32)
    shares = [(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx]
    present = [each for each in before if each is not None]
    sound = jnp.all(jnp.isfinite(state.history) & (state.history >= 0), axis=-1, keepdims=True)
    clean = jnp.where(sound, state.history, 0.0)
    packed = jnp.concatenate([sound.astype(clean.dtype), *present], -1)
    taps = corners(packed, top, left)
    weights = []
    for index, share in enumerate(shares):
        _, tap = unpack(taps[..., index, :], before)
        weights.append(jnp.where(inside & accept(tap) & (taps[..., index, 0] > 0.5), share, 0.0))
    weights = jnp.stack(weights, -1)
    total = jnp.sum(weights, -1, keepdims=True)
    valid = total[..., 0] >= 0.01
    weights = jnp.where(valid[..., None], weights / jnp.where(valid[..., None], total, 1.0), 0.0)
    past = weighted_cells(clean, top, left, jax.lax.stop_gradient(weights))
    return past, valid, jnp.sum(~sound & ~first, dtype=jnp.int32)
