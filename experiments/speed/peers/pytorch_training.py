"""The train step in PyTorch: the loss of ``ntd``, back-propagation through time, the same Adam.

A clip's last frame is for validation as in jaxdn; as it is not in the loss, autograd skips it.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from experiments.speed.peers.pytorch import BUFFERS, NTD, apply_kernels_unfold, compress, start
from jaxdn.core.frame import Clip
from jaxdn.networks import Widths
from jaxdn.recipes.recipe import Recipe

WEIGHTS = (1.0, 0.8, 0.6)
"""Weights of the newest three disocclusion masks."""
THRESHOLD = 0.5
"""Pixels whose two vectors differ by more than this, in pixels, are disoccluded."""


def batch_tensors(batch: Clip) -> tuple[dict[str, Tensor], Tensor]:
    """Buffers and reference of a batch of clips [B, T, H, W, C] as [T, B, C, H, W], each frame channels-last."""

    def convert(array: Any) -> Tensor:
        return torch.from_numpy(np.array(np.moveaxis(np.asarray(array), 1, 0), order="C")).movedim(-1, -3)

    return {name: convert(getattr(batch.frames, name)) for name in BUFFERS}, convert(batch.reference)


def clip_loss(
    step: NTD, frames: dict[str, Tensor], reference: Tensor, *, occlusion: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Mean loss of a batch of clips [T, B, C, H, W] (``recipes.objectives``), and the PSNR of their last frames."""
    state, images = start(frames["radiance"][0]), []
    for index in range(len(reference)):
        state, image = step(state, {name: buffer[index] for name, buffer in frames.items()})
        images.append(image)
    trained = max(1, len(images) - 1)
    error = compress(torch.stack(images[:trained])) - compress(reference[:trained])
    loss = error.abs().mean()
    if trained > 1:
        loss = loss + (error[1:] - error[:-1]).abs().mean()
    difference = frames["dual_motion"] - frames["motion"]
    masks = (difference.square().sum(2, keepdim=True) > THRESHOLD**2).to(error.dtype)[:trained]
    total = torch.zeros_like(masks)
    for age, weight in enumerate(WEIGHTS):
        missing = min(age, trained)
        total = total + weight * torch.cat([masks[:missing], masks[: trained - missing]])
    loss = loss + occlusion * (error * total).abs().mean()
    with torch.no_grad():
        psnr = -10 * torch.log10(F.mse_loss(encode(images[-1]), encode(reference[-1])))
    return loss, psnr


def encode(image: Tensor) -> Tensor:
    """Linear radiance clipped at 1, in sRGB code values."""
    image = image.clamp(0, 1)
    return torch.where(image <= 0.0031308, 12.92 * image, 1.055 * image.clamp(min=0.0031308) ** (1 / 2.4) - 0.055)


class Trainer:
    """Network and optimiser; a call is one update and returns its loss.

    Kernels are applied as patches times kernels, without compilation: with its gradient each of their sizes takes
    PyTorch 80 s to compile on two cores. ``compiled`` concerns only the network.
    """

    def __init__(self, widths: Widths, params: dict[str, Any], recipe: Recipe, *, compiled: bool = False) -> None:
        self.step = NTD(widths, params, apply_kernels=apply_kernels_unfold, compile_network=compiled).train()
        self.weights = list(self.step.parameters())
        self.adam = torch.optim.Adam(self.weights, lr=recipe.learning_rate, fused=True)
        self.clip_norm = recipe.clip_norm

    def __call__(self, frames: dict[str, Tensor], reference: Tensor) -> float:
        self.adam.zero_grad(set_to_none=True)
        loss, _ = clip_loss(self.step, frames, reference)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.weights, self.clip_norm)
        if torch.isfinite(norm):
            self.adam.step()
        return loss.item()
