"""The learned temporal denoiser for indirect illumination of Zeng et al. 2021 (``ntd``).

A U-Net predicts, for every pixel, 5x5 softmax kernels for the noisy image at three scales, one 5x5 kernel for the
previous output warped by *dual* motion vectors, and how to blend them. What the paper leaves open is an option here;
``preset="parity"`` is its letter.

Zheng Zeng, Shiguang Liu, Jinglei Yang, Lu Wang, Ling-Qi Yan, "Temporally Reliable Motion Vectors for Better Use of
Temporal Information" and "Neural Temporal Denoising for Indirect Illumination", 2021.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.checks import check_image, check_option, check_same_size
from jaxdn.frame import FAR, RADIANCE_MAX, Denoiser, Frame, only, repair, repair_image
from jaxdn.kernels import compose_scales, downsample, softmax_filter
from jaxdn.networks import LARGE, MULTIPLE, SMALL
from jaxdn.warping import on_screen, warp

TAPS = 25
SMALLEST_ALBEDO = 0.01
"""Albedo below this is not divided by."""


class State(NamedTuple):
    """What one frame hands to the next."""

    history: jax.Array
    """[H, W, 3] the last output, linear (divided by albedo with ``demodulate``)."""
    age: jax.Array
    """int32, frames seen."""
    repaired: jax.Array
    """int32, values that had to be replaced so far."""


class Options(NamedTuple):
    """The readings of what the paper leaves open; see :func:`ntd`."""

    alpha_at: str = "coarse"
    down: str = "mean"
    up: str = "bilinear"
    pyramid: str = "mean"
    domain: str = "linear"
    depth_scale: str = "geometric"
    border: str = "clamp"
    first_frame: str = "none"
    missing_history: str = "current"
    demodulate: bool = True
    truncate: bool = False


_CHOICES: dict[str, tuple[Any, ...]] = {
    "alpha_at": ("coarse", "fine"),
    "down": ("mean", "max"),
    "up": ("bilinear", "nearest"),
    "pyramid": ("mean", "max"),
    "domain": ("linear", "compressed"),
    "depth_scale": ("geometric", "unit"),
    "border": ("clamp", "zeros"),
    "first_frame": ("none", "noisy"),
    "missing_history": ("current", "blend"),
    "demodulate": (True, False),
    "truncate": (False, True),
}

PARITY = Options(
    down="max", depth_scale="unit", border="zeros", first_frame="noisy", missing_history="blend", demodulate=False
)
"""The paper's letter: D is max-pooling (eq. 4), warped taps outside are 0, the first frame's history is its noise."""


def depth_feature(depth: jax.Array, *, scale: str = "geometric") -> jax.Array:
    """Depth as ``z / (z + g)`` in [0, 1); g is the geometric mean of what is not background, or 1 with ``"unit"``.

    ``depth`` [H, W, 1] >= 0; 0 (the neutral value) gives 0. With the geometric mean the feature does not change with
    the scene's unit of length.
    """
    if scale == "unit":
        return depth / (depth + 1.0)
    known = (depth > 0) & (depth < FAR)
    logarithms = jnp.where(known, jnp.log(jnp.where(known, depth, 1.0)), 0.0)
    middle = jnp.exp(jnp.sum(logarithms) / jnp.maximum(jnp.sum(known, dtype=depth.dtype), 1.0))
    return depth / (depth + middle)


def _pad(image: jax.Array) -> jax.Array:
    """Height and width made multiples of 16 by repeating the last row and column."""
    height, width = image.shape[:2]
    below, right = -height % MULTIPLE, -width % MULTIPLE
    return jnp.pad(image, ((0, below), (0, right), (0, 0)), mode="edge") if below or right else image


def _widths(size: str | Sequence[Sequence[int]]) -> tuple[tuple[int, ...], ...]:
    if isinstance(size, str):
        check_option(size, "size", ("large", "small"))
        return {"large": LARGE, "small": SMALL}[size]
    return tuple(tuple(level) for level in size)


def ntd(
    *,
    size: str | Sequence[Sequence[int]] = "large",
    motion: str = "dual",
    preset: str | None = None,
    alpha_at: str | None = None,
    down: str | None = None,
    up: str | None = None,
    pyramid: str | None = None,
    domain: str | None = None,
    depth_scale: str | None = None,
    border: str | None = None,
    first_frame: str | None = None,
    missing_history: str | None = None,
    demodulate: bool | None = None,
    truncate: bool | None = None,
    compute_dtype: str | None = None,
    implementation: str | None = None,
) -> Denoiser:
    """The neural temporal denoiser; ``None`` takes an option's value from the preset. The first choice is the default.

    With x the noisy radiance, i^s its 5x5 kernel-filtered versions at scales s = 1, 1/2, 1/4 and t the kernel-filtered
    warped history, ``o^c = i^1/4``, ``o^f = i^f - U(alpha D(i^f)) + U(alpha o^c)`` for the two finer scales, and the
    output is ``alpha^t o^1 + (1 - alpha^t) t`` (Zeng et al. 2021, eq. 1 and 4): alpha^t weighs the *current* frame.

    * ``size``: ``"large"``, ``"small"``, or the U-Net's widths (see :func:`jaxdn.networks.unet.unet`).
    * ``motion``: ``"dual"`` (``dual_motion``, or ``motion`` where there is none) or ``"traditional"``.
    * ``preset``: None (ours) or ``"parity"`` (:data:`PARITY`).
    * ``alpha_at``: ``"coarse"`` inside U, or ``"fine"`` outside U, a weight for each fine pixel.
    * ``down``: D is ``"mean"`` or ``"max"`` of 2x2 (parity); max biases dark.
    * ``up``: U is ``"bilinear"`` or ``"nearest"``.
    * ``pyramid``: the noisy image is downsampled by ``"mean"`` or ``"max"``.
    * ``domain``: kernels work on ``"linear"`` or ``"compressed"`` radiance (robust to fireflies, biased dark).
    * ``depth_scale``: see :func:`depth_feature`; ``"geometric"`` or ``"unit"`` (parity).
    * ``border``: of the warp, ``"clamp"`` or ``"zeros"`` (parity).
    * ``first_frame``: no history at age 0 and alpha^t = 1 (``"none"``), or its own noise as history (``"noisy"``).
    * ``missing_history``: off-screen or without a vector, ``"current"`` takes the noisy pixel as history, alpha^t = 1,
      and tells the network by one more channel; ``"blend"`` leaves it to the network (parity).
    * ``demodulate``: filter radiance divided by albedo.
    * ``truncate``: no gradient flows through the history.
    * ``compute_dtype``: ``None`` (the images' dtype) or ``"bfloat16"``, for the U-Net alone.
    * ``implementation``: of the U-Net, None (XLA), on CPUs also ``"onnxruntime"`` (inference; the extra ``onnx``) or
      ``"onednn"`` (training; the extra ``onednn``).

    Raises ValueError for an unknown option, and ``step`` for a frame of the wrong shape, never for its contents.
    """
    widths = _widths(size)
    check_option(motion, "motion", ("dual", "traditional"))
    check_option(preset, "preset", (None, "parity"))
    check_option(compute_dtype, "compute_dtype", (None, "float32", "bfloat16"))
    given: dict[str, Any] = {
        "alpha_at": alpha_at,
        "down": down,
        "up": up,
        "pyramid": pyramid,
        "domain": domain,
        "depth_scale": depth_scale,
        "border": border,
        "first_frame": first_frame,
        "missing_history": missing_history,
        "demodulate": demodulate,
        "truncate": truncate,
    }
    for name, value in given.items():
        check_option(value, name, (None, *_CHOICES[name]))
    base = PARITY if preset == "parity" else Options()
    options = base._replace(**{name: value for name, value in given.items() if value is not None})
    flagged = options.missing_history == "current"
    fine = options.alpha_at == "fine"

    groups = (3, 3, 3, 1, 3, 1) if flagged else (3, 3, 3, 1, 3)
    # full: two kernels and alpha^t; half, quarter: one kernel. An alpha lives at one end of each of the two seams.
    heads = (2 * TAPS + 2, TAPS + 1, TAPS) if fine else (2 * TAPS + 1, TAPS + 1, TAPS + 1)
    # Flax is loaded when a network is built: a filter without weights needs jax and numpy alone.
    from jaxdn.networks.unet import unet

    network = unet(groups, heads, widths=widths, implementation=implementation)
    reads = frozenset({"albedo", "normal", "depth", "motion"} | ({"dual_motion"} if motion == "dual" else set()))

    def init(key: jax.Array, frame: Frame) -> dict[str, Any]:
        return network.init(key)

    def start(params: Any, frame: Frame) -> State:
        dtype = jnp.promote_types(frame.radiance.dtype, jnp.float32)
        zero = jnp.zeros((), jnp.int32)
        return State(jnp.zeros(frame.radiance.shape, dtype), zero, zero)

    def recall(state: State, frame: Frame, noisy: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The warped history, and where there is none (bool [H, W, 1])."""
        first = state.age == 0
        absent = first if options.first_frame == "none" else jnp.zeros_like(first)
        absent = jnp.broadcast_to(absent, (*noisy.shape[:2], 1))
        history = jax.lax.stop_gradient(state.history) if options.truncate else state.history
        vectors = frame.motion if frame.dual_motion is None else frame.dual_motion
        if vectors is not None:
            vectors = jax.lax.stop_gradient(vectors)
            history = warp(history, vectors, border=options.border)
        recalled = jnp.where(first, noisy, repair_image(history))
        if vectors is not None and flagged:
            lost = ~on_screen(vectors) & ~first
            recalled = jnp.where(lost, noisy, recalled)
            absent = absent | lost
        return recalled, absent

    def predict(params: Any, features: list[jax.Array | None], dtype: jnp.dtype) -> list[jax.Array]:
        """The heads [H, W, c] for feature groups [H, W, c]."""
        inner = jnp.dtype(compute_dtype) if compute_dtype == "bfloat16" else dtype
        batch = [None if group is None else group[None].astype(inner) for group in features]
        return [head[0].astype(dtype) for head in network.apply(params, batch)]

    def blend(heads: list[jax.Array], noisy: jax.Array, recalled: jax.Array, absent: jax.Array) -> jax.Array:
        """Kernels applied and composed, in whatever domain the images are in."""

        full, half, quarter = heads
        scales = [noisy]
        for _ in range(2):
            scales.append(downsample(scales[-1], down=options.pyramid))
        seams = (full[..., 2 * TAPS + 1 :], half[..., TAPS:]) if fine else (half[..., TAPS:], quarter[..., TAPS:])
        coarsest, middle = (
            softmax_filter(image[None], head)[0] for image, head in ((scales[2], quarter), (scales[1], half))
        )
        finest, temporal = softmax_filter(jnp.stack([noisy, recalled]), full)
        composed = coarsest
        for image, seam in ((middle, seams[1]), (finest, seams[0])):
            composed = compose_scales(image, composed, jax.nn.sigmoid(seam), down=options.down, up=options.up)
        current = jax.nn.sigmoid(full[..., 2 * TAPS : 2 * TAPS + 1])
        current = jnp.where(absent, 1.0, current)
        return current * composed + (1.0 - current) * temporal

    def step(params: Any, state: State, frame: Frame) -> tuple[State, jax.Array]:
        frame = only(frame, reads)
        check_image(frame.radiance, "frame.radiance", channels=3)
        for name, buffer in frame._asdict().items():
            if buffer is not None:
                check_same_size(frame.radiance, buffer, ("frame.radiance", f"frame.{name}"))
        frame, replaced = repair(frame)
        height, width = frame.radiance.shape[:2]

        noisy, colors = frame.radiance, None
        if options.demodulate and frame.albedo is not None:
            colors = jnp.where(frame.albedo > SMALLEST_ALBEDO, frame.albedo, 1.0)
            noisy = jnp.minimum(noisy / colors, RADIANCE_MAX)
        recalled, absent = recall(state, frame, noisy)

        depth = None if frame.depth is None else _pad(depth_feature(frame.depth, scale=options.depth_scale))
        albedo = None if frame.albedo is None else _pad(frame.albedo - 1.0)
        normal = None if frame.normal is None else _pad(frame.normal)
        noisy, recalled, absent = (_pad(image) for image in (noisy, recalled, absent))
        squeezed, squeezed_history = color.compress(noisy), color.compress(recalled)
        features = [squeezed, albedo, normal, depth, squeezed_history]
        if flagged:
            features.append(absent.astype(noisy.dtype))
        predicted = predict(params, features, noisy.dtype)

        if options.domain == "compressed":
            image = color.expand(jnp.maximum(blend(predicted, squeezed, squeezed_history, absent), 0.0))
        else:
            image = blend(predicted, noisy, recalled, absent)
        image = jnp.clip(image[:height, :width], 0.0, RADIANCE_MAX)
        state = State(image, state.age + 1, state.repaired + replaced)
        return state, image if colors is None else jnp.minimum(image * colors, RADIANCE_MAX)

    return Denoiser(init, start, step, reads)
