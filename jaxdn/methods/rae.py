"""``rae``: a recurrent autoencoder that predicts the image itself.

A U-Net sees the noisy light and the surfaces and says what the light is; no kernels, no motion vectors. What it has
seen before it remembers in hidden states, one in each encoder stage, which stay where they are while the image moves.

Chakravarty R. Alla Chaitanya et al., "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent
Denoising Autoencoder", 2017 ("Chaitanya et al. 2017" here). As in Hasselgren et al. 2020, its images may be followed by
``taa(after=...)``.
"""

from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp

from jaxdn import color
from jaxdn.core.frame import RADIANCE_MAX, Frame
from jaxdn.denoiser import Core, Denoiser, Params, recurrent
from jaxdn.denoiser.statistics import FrameStatistics
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods import direct
from jaxdn.methods.demodulation import Demodulation, demodulated
from jaxdn.methods.registry import method
from jaxdn.networks import Widths
from jaxdn.ops.scales import pad
from jaxdn.recipes.augmentation import NO_AUGMENTATION
from jaxdn.recipes.objectives import last_frames, pyramid_illumination, recurrent_illumination
from jaxdn.recipes.recipe import Recipe

LARGE: Widths = ((32, 43, 57, 76, 101, 101), (76, 76), (57, 57), (43, 43), (32, 32), (128, 64))
"""Channels of the encoder's stages, then of the decoder's convolutions from coarse to fine: 1.94 million weights. The
paper's figure, as far as it is known; Hasselgren et al. 2020 count 2.6 million."""
SMALL: Widths = ((16, 22, 28, 38, 50, 50), (38, 38), (28, 28), (22, 22), (16, 16), (32, 16))
"""Half of these, and a quarter at full resolution, where the most time is spent."""

Hidden = tuple[jax.Array, ...]
"""The hidden state of each encoder stage, [1, h, w, c]."""


@dataclass(frozen=True)
class Options:
    """What the papers set differently or leave open, or where another setting may be better."""

    size: Literal["large", "small"] | Widths = "large"
    """The network's widths, by name or as tuples (see :func:`jaxdn.networks.graph.recurrent_unet`)."""
    guides: Literal["geometry", "materials"] = "geometry"
    """What the network sees besides light: normal, depth and roughness, as in the paper; or the albedo too, as in
    Hasselgren et al. 2020."""
    background: Literal["pass", "filter"] = "pass"
    """Pixels without a surface (depth at ``FAR``) keep their radiance; or they are predicted as all others."""
    exposure: Literal["measured", "given"] = "measured"
    """The network sees radiance times :func:`jaxdn.color.exposure` of each frame, so that twice the light gives twice
    the image where nothing is remembered; or radiance as it is given."""
    demodulate: Demodulation = "brdf"
    """What radiance is divided by before it is filtered, see :func:`jaxdn.denoisers.demodulated`."""
    implementation: Literal["reference", "onednn"] | None = None
    """Backend of the network: XLA, or on CPUs oneDNN (training; the extra ``onednn``). None is XLA."""


PRESETS = {
    "paper": Options(background="filter", exposure="given", demodulate="albedo"),
    "hasselgren": Options(guides="materials", background="filter", exposure="given", demodulate="none"),
}
"""The settings of Chaitanya et al. 2017, and those of the comparison in Hasselgren et al. 2020."""
RECIPES = {
    "usual": Recipe(pyramid_illumination(), frames=7),
    "paper": Recipe(
        recurrent_illumination(), crop=128, frames=7, decay=False, clip_norm=0.0, variation=NO_AUGMENTATION, average=0.0
    ),
    "hasselgren": Recipe(last_frames(), frames=5, decay=False, clip_norm=0.0, variation=NO_AUGMENTATION, average=0.0),
}
"""Those of the same papers: the comparison trains all networks by one loss."""


@method(
    Options,
    title="Recurrent denoising autoencoder (Chaitanya et al. 2017)",
    presets=PRESETS,
    recipes=RECIPES,
    variants={"rae-large": {"size": "large"}, "rae-small": {"size": "small"}},
    backends=("onednn",),
)
def rae(options: Options) -> Denoiser:
    """The recurrent autoencoder.

    Light is compressed (:func:`jaxdn.color.compress`) before the network sees it, and the network predicts compressed
    light. Normals are in world space, where the paper has them in the camera's: the recipe "usual" turns them at
    random, "paper" does not. Reads normal, depth and roughness; albedo with ``guides="materials"`` or divided light,
    and reflectance with ``demodulate="brdf"``; an absent buffer is neutral. Raises ValueError for an unknown option,
    and ``step`` for a frame of the wrong shape or of another size than the first, never for its contents.
    """
    return demodulated(recurrent(core_of(options)), by=options.demodulate)


def core_of(options: Options) -> Core:
    """The method without division and shared processing; its state is :data:`Hidden`."""
    # Flax is imported only when a network is built: filters without weights need only jax and numpy.
    from jaxdn.networks.recurrent import recurrent_unet

    materials = options.guides == "materials"
    widths = {"large": LARGE, "small": SMALL}[options.size] if isinstance(options.size, str) else options.size
    groups = (3, 3, 1, 1, *([3] if materials else []))
    network = recurrent_unet(groups, 3, widths=widths, implementation=options.implementation)
    multiple = max(4, 2 ** (len(widths[0]) - 1))

    def init(key: jax.Array, frame: Frame) -> Params:
        return direct.init_grey(network.init(key), "output")

    def start(params: Params, frame: Frame) -> Hidden:
        height, width = (size + -size % multiple for size in frame.radiance.shape[:2])
        return network.start(1, height, width, frame.radiance.dtype)

    def prepare(frame: Frame) -> tuple[FrameStatistics, direct.PreparedFrame]:
        return direct.prepare(frame, background=options.background, multiple=multiple)

    def step(
        params: Params, state: Hidden, prepared: direct.PreparedFrame, first: jax.Array, statistics: FrameStatistics
    ) -> tuple[Hidden, jax.Array, jax.Array]:
        frame, gain = prepared.frame, direct.choose_gain(options.exposure, statistics)
        light = color.compress(gain * prepared.light)
        _check_size(state, light, frame.radiance.shape[:2])
        surfaces = [
            frame.normal,
            None if frame.depth is None else depth_feature(frame.depth, statistics.mean_depth),
            None if frame.roughness is None else frame.roughness - 1.0,
        ]
        if materials:
            surfaces.append(None if frame.albedo is None else frame.albedo - 1.0)
        padded = [None if group is None else pad(group, multiple)[None] for group in surfaces]
        hidden, invalid = _bound_hidden(state)
        output, hidden = network.apply(params, [light[None], *padded], hidden)
        return hidden, direct.expand_output(output[0], prepared, gain), invalid

    guides = {"normal", "depth", "roughness"} | ({"albedo"} if materials else set())
    return Core(start, step, frozenset(guides), init, prepare=prepare)


def _check_size(state: Hidden, noisy: jax.Array, size: tuple[int, ...]) -> None:
    if state[0].shape[1:3] != noisy.shape[:2]:
        raise ValueError(
            f"frame: expected the size of the first frame, got {size[0]} x {size[1]}, whose hidden state would have "
            f"{noisy.shape[:2]} pixels and not {state[0].shape[1:3]}; start again for frames of another size."
        )


def _bound_hidden(states: Hidden) -> tuple[Hidden, jax.Array]:
    """The hidden states without values that would stay for ever, and how many of these there were.

    Rectifiers have no upper end, so nothing but training keeps a state small.
    """
    bounded = tuple(jnp.clip(jnp.nan_to_num(state), -RADIANCE_MAX, RADIANCE_MAX) for state in states)
    changed = [jnp.sum(one != other, dtype=jnp.int32) for one, other in zip(states, bounded, strict=True)]
    return bounded, sum(changed, start=jnp.zeros((), jnp.int32))
