"""Invariances for any pixel values: mirrors, bounds, channels, brightness, and less variance with a longer history.

Images here are whole numbers and motion is in sixty-fourths of a pixel, so that every product and sum of a warp, a
kernel application or a mean is exact in single precision: exact invariances are tested bit for bit, those with powers
or divisions (softmax, SSIM, FLIP, filters) up to rounding. Learned networks obey them only approximately, which
``make hard-cases`` measures.
"""

from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxdn
from jaxdn import color, losses, metrics
from jaxdn.core.frame import Clip, Frame
from jaxdn.ops.motion import on_screen
from jaxdn.ops.scales import downsample, upsample

T, H, W = 3, 6, 8
AXES = {"left to right": (-2, (-1.0, 1.0)), "top to bottom": (-3, (1.0, -1.0))}
seeds = st.integers(0, 2**32 - 1)
mirrors = st.sampled_from(sorted(AXES))
powers = st.integers(-12, 12)


def image(rng, *, channels=3, frames=()):
    return rng.integers(0, 256, (*frames, H, W, channels)).astype(np.float32)


def vectors(rng):
    """Odd sixty-fourths: never halfway between two pixels, where the nearest one is ambiguous."""
    return ((2 * rng.integers(-300, 300, (H, W, 2)) + 1) / 64).astype(np.float32)


def weights(rng):
    """[H, W, 9] in 1/256, each pixel's sum 1."""
    taps = rng.integers(0, 25, (H, W, 9))
    taps[..., 4] += 256 - taps.sum(axis=-1)
    return (taps / 256).astype(np.float32)


def mirrored(array, way):
    return np.flip(np.asarray(array), AXES[way][0])


def turned(motion, way):
    """A mirrored field of vectors: the pixels move, and the component across the mirror changes its sign."""
    return mirrored(motion, way) * np.asarray(AXES[way][1], np.float32)


def taps_mirrored(kernels, way):
    size = round(kernels.shape[-1] ** 0.5)
    square = mirrored(kernels, way).reshape(H, W, size, size)
    return np.flip(square, AXES[way][0] + 1).reshape(kernels.shape)


warp = {border: jax.jit(partial(jaxdn.warp, border=border)) for border in ("clamp", "zeros")}
apply_kernels = jax.jit(jaxdn.apply_kernels)
normalize_kernels = jax.jit(jaxdn.normalize_kernels)
down = {how: jax.jit(partial(downsample, down=how)) for how in ("mean", "max")}
up = {how: jax.jit(partial(upsample, up=how)) for how in ("bilinear", "nearest")}
compose = jax.jit(jaxdn.compose_scales)
dual_motion = jax.jit(lambda motion, forward, visible: jaxdn.dual_motion(motion, forward, visible=visible))
occlusion_mask = jax.jit(jaxdn.occlusion_mask)
LOSSES = {name: jax.jit(getattr(losses, name)) for name in ("spatial", "temporal", "gradient")}
LOSSES["hfen"] = jax.jit(partial(losses.gradient, operator="hfen"))
occlusion_loss = jax.jit(partial(losses.occlusion, weights=(1.0, 0.5, 0.25)))
METRICS = {name: jax.jit(getattr(metrics, name)) for name in ("mse", "l1", "psnr", "temporal_psnr", "relative_mse")}
METRICS["ssim"] = jax.jit(metrics.ssim)


# Mirrors


@given(seed=seeds, way=mirrors)
def test_a_mirror_commutes_with_what_moves_and_mixes_pixels(seed, way):
    rng = np.random.default_rng(seed)
    light, motion, kernels = image(rng), vectors(rng), weights(rng)
    half, alpha = image(rng)[::2, ::2], rng.integers(0, 9, (H // 2, W // 2, 1)).astype(np.float32) / 8
    for border, fetch in warp.items():
        found = fetch(mirrored(light, way), turned(motion, way))
        np.testing.assert_array_equal(found, mirrored(fetch(light, motion), way), err_msg=border)
    np.testing.assert_array_equal(
        apply_kernels(mirrored(light, way), taps_mirrored(kernels, way)), mirrored(apply_kernels(light, kernels), way)
    )
    for function in (*down.values(), *up.values()):
        np.testing.assert_array_equal(function(mirrored(light, way)), mirrored(function(light), way))
    np.testing.assert_array_equal(
        compose(mirrored(light, way), mirrored(half, way), mirrored(alpha, way)),
        mirrored(compose(light, half, alpha), way),
    )


@given(seed=seeds, way=mirrors)
def test_a_mirror_commutes_with_dual_motion_and_what_is_made_of_it(seed, way):
    rng = np.random.default_rng(seed)
    motion, forward, visible = vectors(rng), vectors(rng), rng.random((H, W)) < 0.5
    dual = dual_motion(motion, forward, visible)
    shown = np.flip(visible, AXES[way][0] + 1)
    np.testing.assert_array_equal(dual_motion(turned(motion, way), turned(forward, way), shown), turned(dual, way))
    np.testing.assert_array_equal(
        occlusion_mask(turned(motion, way), turned(dual, way)), mirrored(occlusion_mask(motion, dual), way)
    )
    np.testing.assert_array_equal(on_screen(turned(motion, way)), mirrored(on_screen(motion), way))


@given(seed=seeds, way=mirrors)
def test_a_mirror_changes_no_loss_and_no_metric(seed, way):
    rng = np.random.default_rng(seed)
    first, second = image(rng, frames=(T,)), image(rng, frames=(T,))
    pair = mirrored(first, way), mirrored(second, way)
    mask = rng.integers(0, 2, (T, H, W, 1)).astype(np.float32)
    # Sums of whole numbers are exact in any order; HFEN, the relative error and SSIM divide.
    for name, loss in LOSSES.items():
        np.testing.assert_allclose(loss(*pair), loss(first, second), rtol=1e-5 if name == "hfen" else 0, err_msg=name)
    np.testing.assert_array_equal(occlusion_loss(*pair, mirrored(mask, way)), occlusion_loss(first, second, mask))
    for name, metric in METRICS.items():
        exact = name in ("mse", "l1", "psnr", "temporal_psnr")
        given_in = [array / 256 for array in (first, second, *pair)]
        np.testing.assert_allclose(
            metric(*given_in[2:]), metric(*given_in[:2]), rtol=0 if exact else 1e-5, atol=0 if exact else 1e-6
        )


@pytest.mark.slow
@settings(max_examples=5)
@given(seed=seeds, way=mirrors)
def test_a_mirror_changes_no_flip(seed, way):
    rng = np.random.default_rng(seed)
    first, second = image(rng) / 256, image(rng) / 256
    measure = jax.jit(metrics.flip)
    np.testing.assert_allclose(measure(mirrored(first, way), mirrored(second, way)), measure(first, second), rtol=1e-5)


# Bounds


def around(values, radius):
    """Lowest and highest value of each pixel's neighbourhood, edges repeated."""
    height, width = values.shape[:2]
    wide = np.pad(values, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
    size = 2 * radius + 1
    near = np.stack([wide[i : i + height, j : j + width] for i in range(size) for j in range(size)])
    return near.min(axis=0), near.max(axis=0)


@given(seed=seeds, scale=st.sampled_from([0.1, 3.0, 1e4]), size=st.sampled_from([3, 5]))
def test_normalized_kernels_keep_an_image_inside_its_local_bounds(seed, scale, size):
    rng = np.random.default_rng(seed)
    light = rng.exponential(size=(H, W, 3)).astype(np.float32)
    logits = (scale * rng.standard_normal((H, W, size * size))).astype(np.float32)
    lowest, highest = around(light, size // 2)
    out = np.asarray(apply_kernels(light, normalize_kernels(logits)))
    assert np.all(out >= lowest * (1 - 1e-6))
    assert np.all(out <= highest * (1 + 1e-6))


@given(seed=seeds)
def test_a_warp_and_a_change_of_size_keep_an_image_inside_its_bounds(seed):
    rng = np.random.default_rng(seed)
    light = rng.exponential(size=(H, W, 3)).astype(np.float32)
    motion = rng.normal(scale=5, size=(H, W, 2)).astype(np.float32)
    functions = [lambda light: warp["clamp"](light, motion), *down.values(), *up.values()]
    for function in functions:
        out = np.asarray(function(light))
        assert np.all(out >= light.min(axis=(0, 1)) * (1 - 1e-6))
        assert np.all(out <= light.max(axis=(0, 1)) * (1 + 1e-6))


# Channels


@given(seed=seeds)
def test_channels_do_not_influence_each_other(seed):
    rng = np.random.default_rng(seed)
    light, motion = rng.exponential(size=(H, W, 4)).astype(np.float32), vectors(rng)
    kernels = np.asarray(normalize_kernels(rng.standard_normal((H, W, 9)).astype(np.float32)))
    light[..., 3] *= 1e30
    alpha = rng.random((H // 2, W // 2, 1)).astype(np.float32)
    functions = [
        *(lambda light, fetch=fetch: fetch(light, motion) for fetch in warp.values()),
        lambda light: apply_kernels(light, kernels),
        *down.values(),
        *up.values(),
        lambda light: compose(light, light[::2, 1::2], alpha),
    ]
    for function in functions:
        np.testing.assert_array_equal(function(light)[..., :3], function(light[..., :3]))


@given(seed=seeds)
def test_a_mean_over_channels_is_the_mean_of_its_channels(seed):
    rng = np.random.default_rng(seed)
    first, second = image(rng, frames=(T,)) / 256, image(rng, frames=(T,)) / 256
    means = {**LOSSES, **{name: METRICS[name] for name in ("mse", "l1", "relative_mse", "ssim")}}
    for name, mean in means.items():
        alone = [mean(first[..., c : c + 1], second[..., c : c + 1]) for c in range(3)]
        np.testing.assert_allclose(mean(first, second), np.mean(alone), rtol=1e-5, atol=1e-7, err_msg=name)


# Brightness


@given(seed=seeds, power=powers)
def test_brighter_light_is_a_brighter_image(seed, power):
    rng = np.random.default_rng(seed)
    light, motion = rng.exponential(size=(H, W, 3)).astype(np.float32), vectors(rng)
    kernels = np.asarray(normalize_kernels(rng.standard_normal((H, W, 9)).astype(np.float32)))
    alpha = rng.random((H // 2, W // 2, 1)).astype(np.float32)
    factor = np.float32(2.0**power)
    functions = [
        *(lambda light, fetch=fetch: fetch(light, motion) for fetch in warp.values()),
        lambda light: apply_kernels(light, kernels),
        *down.values(),
        *up.values(),
        lambda light: compose(light, light[::2, 1::2], alpha),
        color.luminance,
    ]
    for function in functions:
        np.testing.assert_array_equal(function(factor * light), factor * function(light))


@given(seed=seeds, power=powers)
def test_brighter_light_is_a_larger_error(seed, power):
    rng = np.random.default_rng(seed)
    first, second = (rng.exponential(size=(T, H, W, 3)).astype(np.float32) for _ in range(2))
    mask = rng.integers(0, 2, (T, H, W, 1)).astype(np.float32)
    factor = np.float32(2.0**power)
    linear = {**LOSSES, "l1": METRICS["l1"], "occlusion": lambda first, second: occlusion_loss(first, second, mask)}
    for name, loss in linear.items():
        np.testing.assert_array_equal(loss(factor * first, factor * second), factor * loss(first, second), err_msg=name)
    np.testing.assert_array_equal(
        METRICS["mse"](factor * first, factor * second), factor**2 * METRICS["mse"](first, second)
    )
    for metric in (metrics.psnr, metrics.temporal_psnr):
        np.testing.assert_allclose(
            metric(factor * first, factor * second, peak=float(factor)), metric(first, second), rtol=1e-5, atol=1e-4
        )


# A classical filter

FRAMES, SIZE = 24, 16
svgf = jaxdn.denoisers.svgf()
filtered = jax.jit(lambda frames: jaxdn.denoise(svgf, {}, Clip(frames)))
blending = jaxdn.denoisers.svgf(levels=0, feedback_level=0, short_history=1)  # temporal filtering only
blended = jax.jit(lambda frames: jaxdn.denoise(blending, {}, Clip(frames)))


def scene(seed, *, frames=4):
    """Two surfaces with a moving border, every buffer that the filter reads, and noise."""
    rng = np.random.default_rng(seed)
    shape = (frames, SIZE, SIZE)
    near = rng.random((SIZE, SIZE, 1)) < 0.3
    near = np.broadcast_to(near, (*shape, 1))
    unit = rng.normal(size=(2, 3))
    unit /= np.linalg.norm(unit, axis=-1, keepdims=True)
    return Frame(
        radiance=rng.exponential(size=(*shape, 3)).astype(np.float32) * np.where(near, 0.3, 1.0).astype(np.float32),
        albedo=rng.uniform(0.2, 0.9, (*shape, 3)).astype(np.float32),
        normal=np.where(near, unit[0], unit[1]).astype(np.float32),
        depth=np.where(near, 2 + rng.random((*shape, 1)), 6 + rng.random((*shape, 1))).astype(np.float32),
        motion=np.broadcast_to(np.float32([0.25, -0.75]), (*shape, 2)),
        ids=near.astype(np.int32),
    )


@pytest.mark.slow
@settings(max_examples=8)
@given(seed=seeds, way=mirrors)
def test_a_mirror_commutes_with_svgf(seed, way):
    frames = scene(seed)
    changed = Frame(*(None if buffer is None else mirrored(buffer, way) for buffer in frames))
    changed = changed._replace(motion=turned(frames.motion, way))
    expected = mirrored(filtered(frames), way)
    np.testing.assert_allclose(filtered(changed), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.slow
@settings(max_examples=8)
@given(seed=seeds, power=st.integers(1, 12))
def test_svgf_of_brighter_light_is_a_brighter_image(seed, power):
    # Its two constants, 1e-10 for the variance and 1e-4 for edge-stopping, are in units of light.
    frames = scene(seed)
    factor = np.float32(2.0**power)
    brighter = filtered(frames._replace(radiance=factor * frames.radiance)) / factor
    np.testing.assert_allclose(brighter, filtered(frames), rtol=2e-3, atol=1e-4)


@pytest.mark.slow
@settings(max_examples=8)
@given(seed=seeds)
def test_svgf_stays_within_the_range_of_its_input(seed):
    frames = scene(seed)._replace(albedo=None)
    shown = np.maximum.accumulate(frames.radiance.max(axis=(1, 2)))[:, None, None]
    least = np.minimum.accumulate(frames.radiance.min(axis=(1, 2)))[:, None, None]
    out = np.asarray(jax.jit(lambda frames: jaxdn.denoise(svgf, {}, Clip(frames)))(frames))
    assert np.all(out <= shown * (1 + 1e-5))
    assert np.all(out >= least * (1 - 1e-5))


@pytest.mark.slow
@settings(max_examples=8)
@given(seed=seeds)
def test_on_a_static_scene_the_variance_of_svgf_falls_with_history(seed):
    # Uniform noise: of 256 pixels with long tails, the variance itself would be too noisy to compare.
    noise = np.random.default_rng(seed).uniform(0, 2, (FRAMES, SIZE, SIZE, 1)).astype(np.float32)
    frames = Frame(np.broadcast_to(noise, (FRAMES, SIZE, SIZE, 3)))
    variance = np.asarray(blended(frames))[..., 0].var(axis=(1, 2))
    # Temporal filtering only: on a blank wall the spatial filter would remove nearly all variance at once.
    # 1 / N while the history is a mean, alpha / (2 - alpha) = 1 / 9 once it is a moving average.
    np.testing.assert_allclose(variance[:5] / variance[0], 1 / np.arange(1, 6), rtol=0.5)
    assert np.all(np.diff(variance[:4]) < 0)
    assert 0.05 < variance[15:].mean() / variance[0] < 0.2
