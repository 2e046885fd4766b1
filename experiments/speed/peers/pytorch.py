"""The recurrent ``ntd`` step in PyTorch, as a peer for speed: the same network, the same weights, the same image.

Written for speed on the CPU, as a PyTorch user would: channels-last tensors, library operations wherever they exist,
inference mode. Options are the defaults of :func:`jaxdn.denoisers.ntd`, but for plain kernels and a background that is
filtered as all else is. Frames are assumed to be valid: what jaxdn sanitizes in every frame (non-finite values, normals
not of unit length) is left out here, which is to PyTorch's advantage.

Tensors are ``[B, C, H, W]`` in channels-last memory; height and width are multiples of 16.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch._dynamo
from torch import Tensor, nn
from torch.nn import functional as F

from jaxdn.brdf import FLOOR
from jaxdn.color import LUMINANCE
from jaxdn.core.frame import FAR, RADIANCE_MAX, Frame
from jaxdn.methods.reconstruction import TAPS
from jaxdn.networks import LEVELS, Widths
from jaxdn.networks.graph import NEGATIVE_SLOPE

FEATURES = 14
"""Compressed radiance 3, albedo 3, normal 3, depth 1, compressed history 3, missing history 1."""
HEADS = (2 * TAPS + 1, TAPS + 1, TAPS + 1)

BUFFERS = ("radiance", "albedo", "normal", "depth", "dual_motion")
"""The buffers of a frame here: all that the network uses."""


class State(NamedTuple):
    """What is carried from one frame to the next."""

    history: Tensor
    """[B, 3, H, W] the last output, divided by albedo."""
    first: Tensor
    """bool scalar: there is no history yet."""


def prepare_process() -> None:
    """Use all cores, and allow compiling every shape (PyTorch stops after eight by default)."""
    torch.set_num_threads(os.cpu_count() or 1)
    torch._dynamo.config.recompile_limit = 64


def tensor(array: Any) -> Tensor:
    """A jaxdn array [..., H, W, C] as [..., C, H, W] with unchanged memory, which is channels-last."""
    return torch.from_numpy(np.array(array)).movedim(-1, -3)


def tensors(frame: Frame) -> dict[str, Tensor]:
    """The buffers of a frame [..., H, W, C] by name."""
    return {name: tensor(getattr(frame, name)) for name in BUFFERS}


class Level(nn.Module):
    """The convolutions of one resolution level, each followed by a LeakyReLU."""

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        pairs = zip((inputs, *widths), widths, strict=False)
        self.convolutions = nn.ModuleList([nn.Conv2d(before, after, 3, padding=1) for before, after in pairs])

    def forward(self, x: Tensor) -> Tensor:
        for convolution in self.convolutions:
            x = F.leaky_relu(convolution(x), NEGATIVE_SLOPE)
        return x


class UNet(nn.Module):
    """Five levels, heads on the last three decoder levels."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        last = [level[-1] for level in widths]
        self.encoder = nn.ModuleList(
            [Level(before, level) for before, level in zip((FEATURES, *last), widths, strict=False)]
        )
        self.decoder = nn.ModuleList([Level(last[n + 1] + last[n], widths[n]) for n in range(LEVELS - 1)])
        self.head = nn.ModuleList([nn.Conv2d(last[n], outputs, 3, padding=1) for n, outputs in enumerate(HEADS)])

    def forward(self, x: Tensor) -> list[Tensor]:
        encoder, decoder, head = (list(part) for part in (self.encoder, self.decoder, self.head))
        skips: list[Tensor] = []
        for level, block in enumerate(encoder):
            x = block(F.max_pool2d(x, 2) if level else x)
            skips.append(x)
        heads: list[Tensor] = []
        for level in reversed(range(LEVELS - 1)):
            x = decoder[level](torch.cat([F.interpolate(x, scale_factor=2, mode="nearest"), skips[level]], 1))
            if level < len(head):
                heads.insert(0, head[level](x))
        return heads


def load(network: UNet, params: dict[str, Any]) -> None:
    """Copy the parameters of a jaxdn network: kernels HWIO become OIHW."""

    def copy(convolution: Any, values: dict[str, Any]) -> None:
        kernel = torch.from_numpy(np.array(values["kernel"])).permute(3, 2, 0, 1)
        with torch.no_grad():
            convolution.weight.copy_(kernel)
            convolution.bias.copy_(torch.from_numpy(np.array(values["bias"])))

    parts: dict[str, Any] = {"encoder": network.encoder, "decoder": network.decoder}
    for part, levels in parts.items():
        for number, level in enumerate(levels):
            for index, convolution in enumerate(level.convolutions):
                copy(convolution, params[f"{part}_{number}"][f"convolution_{index}"])
    for number, head in enumerate(network.head):
        copy(head, params[f"head_{number}"])


def compress(x: Tensor) -> Tensor:
    """``jaxdn.color.compress``: ``log(1 + x)^(1 / 2.2)`` with a straight toe, odd."""
    toe, gamma = 1e-4, 1 / 2.2
    u = torch.log1p(x.abs())
    low = u <= toe
    y = torch.where(low, toe ** (gamma - 1) * u, torch.where(low, 1.0, u) ** gamma)
    return torch.where(x >= 0, y, -y)


def exposure(radiance: Tensor) -> Tensor:
    """``jaxdn.color.exposure``, [B, 1, 1, 1]: 0.18 over the geometric mean of the luminance of blocks that are lit."""
    blocks = F.avg_pool2d(radiance.detach().clamp(max=RADIANCE_MAX), 16)
    means = (blocks * blocks.new_tensor(LUMINANCE)[:, None, None]).sum(1, keepdim=True)
    lit = means > 0
    logarithms = torch.where(lit, torch.log(torch.where(lit, means, 1.0)), 0.0).sum((1, 2, 3), keepdim=True)
    count = lit.sum((1, 2, 3), keepdim=True)
    return torch.where(count > 0, 0.18 * torch.exp(-logarithms / count.clamp(min=1)), 1.0)


def depth_feature(depth: Tensor) -> Tensor:
    """``z / (z + g)`` with the geometric mean g over surfaces, for each image."""
    known = (depth > 0) & (depth < FAR)
    logarithms = torch.where(known, torch.log(torch.where(known, depth, 1.0)), 0.0)
    count = known.sum((1, 2, 3), keepdim=True).clamp(min=1)
    return depth / (depth + torch.exp(logarithms.sum((1, 2, 3), keepdim=True) / count))


def targets(motion: Tensor) -> tuple[Tensor, Tensor]:
    """The array position (x, y), each [B, H, W], that each pixel's vector points to."""
    height, width = motion.shape[-2:]
    x = torch.arange(width, dtype=motion.dtype) + motion[:, 0]
    y = torch.arange(height, dtype=motion.dtype)[:, None] + motion[:, 1]
    return x, y


def warp(image: Tensor, motion: Tensor) -> Tensor:
    """Fetch ``image`` bilinearly at ``p + motion(p)``, positions clamped to the outermost pixel centres."""
    height, width = image.shape[-2:]
    x, y = targets(motion)
    grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
    return F.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)


def apply_kernels_loop(image: Tensor, kernels: Tensor) -> Tensor:
    """``sum_t kernels(p, t) image(p + offset_t)`` as 25 shifted multiply-adds: fastest to run and to compile.

    Planes, not channels-last: 0.65 of the time, and PyTorch 2.13 cannot compile the gradient of a channels-last pad.
    """
    height, width = image.shape[-2:]
    kernels = kernels.contiguous()
    extended = F.pad(image.contiguous(), (2, 2, 2, 2), mode="replicate")
    out = torch.zeros_like(image, memory_format=torch.contiguous_format)
    for tap in range(TAPS):
        i, j = divmod(tap, 5)
        out = torch.addcmul(out, kernels[:, tap : tap + 1], extended[:, :, i : i + height, j : j + width])
    return out


def apply_kernels_unfold(image: Tensor, kernels: Tensor) -> Tensor:
    """The same as patches times kernels: the fastest version for training without compilation."""
    count, channels, height, width = image.shape
    patches = F.unfold(F.pad(image.contiguous(), (2, 2, 2, 2), mode="replicate"), 5)
    patches = patches.reshape(count, channels, TAPS, height, width)
    return (patches * kernels.contiguous()[:, None]).sum(2)


ApplyKernels = Callable[[Tensor, Tensor], Tensor]


def compose_scales(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """``fine - U(alpha D(fine)) + U(alpha coarse)``, D the 2x2 mean, U bilinear."""
    correction = alpha * (coarse - F.avg_pool2d(fine, 2))
    return fine + F.interpolate(correction, scale_factor=2, mode="bilinear", align_corners=False)


class Prepared(NamedTuple):
    """The input of the network and of the kernels."""

    noisy: Tensor
    """[B, 3, H, W] radiance divided by ``colors``."""
    colors: Tensor
    history: Tensor
    """[B, 3, H, W] warped history, the noisy pixel where it is missing."""
    absent: Tensor
    """bool [B, 1, H, W]: the history is missing."""
    features: Tensor
    """[B, 14, H, W] the network's input."""


def prepare(state: State, frame: dict[str, Tensor]) -> Prepared:
    """Divide by albedo, warp the history, assemble the network's input."""
    albedo, motion = frame["albedo"], frame["dual_motion"]
    colors = (
        (albedo**4 + FLOOR**4) / (1 + FLOOR**4)
    ) ** 0.25  # :func:`jaxdn.brdf.divisor` of frames without reflectance
    noisy = (frame["radiance"] / colors).clamp(max=RADIANCE_MAX)
    height, width = noisy.shape[-2:]
    x, y = targets(motion)
    inside = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
    absent = ~inside[:, None] | state.first
    history = torch.where(absent, noisy, warp(state.history, motion))
    gain = exposure(noisy)
    light = compress(gain * noisy)
    parts = [light, albedo - 1.0, frame["normal"], depth_feature(frame["depth"]), compress(gain * history)]
    return Prepared(noisy, colors, history, absent, torch.cat([*parts, absent.to(noisy.dtype)], 1))


def finish(filtered: list[Tensor], heads: list[Tensor], prepared: Prepared) -> tuple[Tensor, Tensor]:
    """The next history and the image from the filtered images (quarter, half, full size, history)."""
    full, half, quarter = heads
    composed = compose_scales(filtered[1], filtered[0], torch.sigmoid(quarter[:, TAPS:]))
    composed = compose_scales(filtered[2], composed, torch.sigmoid(half[:, TAPS:]))
    current = torch.where(prepared.absent, 1.0, torch.sigmoid(full[:, 2 * TAPS :]))
    history = (current * composed + (1.0 - current) * filtered[3]).clamp(0.0, RADIANCE_MAX)
    return history, (history * prepared.colors).clamp(max=RADIANCE_MAX)


class NTD(nn.Module):
    """One step of the recurrent denoiser: ``(state, frame) -> (state, image)``.

    Parts are compiled for static shapes: with symbolic ones they are compiled only once but take 2.4 times as long to
    run. The rest runs as fast without compilation. In a single graph, each of the 25 taps would recompute its image,
    including the warp: compiling a 720p step took more than four minutes.

    Args:
      widths: of the network.
      params: of the jaxdn network.
      apply_kernels: the version of the kernel application.
      compile_network: use ``torch.compile`` for the network.
      compile_kernels: use it for softmax and kernel application.
    """

    def __init__(
        self,
        widths: Widths,
        params: dict[str, Any],
        *,
        apply_kernels: ApplyKernels,
        compile_network: bool = False,
        compile_kernels: bool = False,
    ) -> None:
        super().__init__()
        self.network = UNet(widths)
        load(self.network, params)
        for weights in self.network.parameters():
            if weights.ndim == 4:
                weights.data = weights.data.contiguous(memory_format=torch.channels_last)

        def filtered(image: Tensor, logits: Tensor) -> Tensor:
            return apply_kernels(image, torch.softmax(logits, dim=1))

        self.run_network: Any = torch.compile(self.network, dynamic=False) if compile_network else self.network
        self.filtered: Any = torch.compile(filtered, dynamic=False) if compile_kernels else filtered

    def forward(self, state: State, frame: dict[str, Tensor]) -> tuple[State, Tensor]:
        prepared = prepare(state, frame)
        heads: list[Tensor] = self.run_network(prepared.features)
        half = F.avg_pool2d(prepared.noisy, 2)
        images = [F.avg_pool2d(half, 2), half, prepared.noisy, prepared.history]
        full = heads[0]
        logits = [heads[2][:, :TAPS], heads[1][:, :TAPS], full[:, :TAPS], full[:, TAPS : 2 * TAPS]]
        images = [self.filtered(image, weights) for image, weights in zip(images, logits, strict=True)]
        history, image = finish(images, heads, prepared)
        return State(history, torch.zeros_like(state.first)), image


def start(radiance: Tensor) -> State:
    """The state before the first frame, for frames of this radiance's shape."""
    return State(torch.zeros_like(radiance), torch.tensor(True))
