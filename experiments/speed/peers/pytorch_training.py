"""The train step in PyTorch: the loss of ``ntd``, back-propagation through time, the same Adam."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from experiments.speed.peers.pytorch import BUFFERS, NTD, apply_kernels_unfold, compress, start
from jaxdn.core.frame import RADIANCE_MAX, Clip
from jaxdn.networks import Widths
from jaxdn.recipes.recipe import Recipe

WEIGHTS = (1.0, 0.8, 0.6)
"""Of the newest three masks of what the frame before did not show."""
SQUARED_FROM = 0.6
"""The share of the updates after which the loss is made of squares."""
SQUARES = 8.0
"""What these are multiplied by."""


def batch_tensors(batch: Clip) -> tuple[dict[str, Tensor], Tensor]:
    """Buffers and reference of a batch of clips [B, T, H, W, C] as [T, B, C, H, W], each frame channels-last."""

    def convert(array: Any) -> Tensor:
        return torch.from_numpy(np.array(np.moveaxis(np.asarray(array), 1, 0), order="C")).movedim(-1, -3)

    return {name: convert(getattr(batch.frames, name)) for name in (*BUFFERS, "visible")}, convert(batch.reference)


def clip_loss(step: NTD, frames: dict[str, Tensor], reference: Tensor, *, progress: float) -> tuple[Tensor, Tensor]:
    """Mean loss of a batch of clips [T, B, C, H, W], and the PSNR of their last frames.

    The loss is :func:`jaxdn.recipes.objectives.unbiased_illumination` when the share ``progress`` of the updates is
    done. Only the terms that count then are computed; jaxdn's program has those of both phases of training.
    """
    state, images = start(frames["radiance"][0]), []
    for index in range(len(reference)):
        state, image = step(state, {name: buffer[index] for name, buffer in frames.items()})
        images.append(image)
    masks = recent_masks(1.0 - frames["visible"].to(reference.dtype))
    denoised = torch.stack(images)
    if progress >= SQUARED_FROM:
        loss = SQUARES * loss_terms(unbiased_error(denoised, reference), masks, torch.square)
    else:
        loss = loss_terms(compress(denoised) - compress(reference), masks, torch.abs)
    with torch.no_grad():
        psnr = -10 * torch.log10(F.mse_loss(encode(images[-1]), encode(reference[-1])))
    return loss, psnr


def loss_terms(error: Tensor, masks: Tensor, size: Callable[[Tensor], Tensor]) -> Tensor:
    """The means of an error [T, B, C, H, W], of its change from frame to frame, and of what the masks weigh."""
    total = size(error).mean() + size(error * masks).mean()
    return total + size(error[1:] - error[:-1]).mean() if len(error) > 1 else total


def unbiased_error(denoised: Tensor, reference: Tensor) -> Tensor:
    """The difference of the pair of :func:`jaxdn.losses.unbiased`."""
    fixed = denoised.detach()
    point = fixed.clamp(0.02, RADIANCE_MAX)
    slope = torch.log1p(point) ** (1 / 2.2 - 1) / (2.2 * (1.0 + point))
    return (denoised - torch.minimum(reference, 10.0 * (fixed + 0.1))) * slope


def recent_masks(masks: Tensor) -> Tensor:
    """The weighted sum of each frame's mask [T, B, 1, H, W] and of those before it (:func:`jaxdn.losses.occlusion`)."""
    total = torch.zeros_like(masks)
    for age, weight in enumerate(WEIGHTS):
        missing = min(age, len(masks))
        total = total + weight * torch.cat([masks[:missing], masks[: len(masks) - missing]])
    return total


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
        self.clip_norm, self.steps, self.updates = recipe.clip_norm, recipe.steps, 0

    def __call__(self, frames: dict[str, Tensor], reference: Tensor) -> float:
        self.adam.zero_grad(set_to_none=True)
        loss, _ = clip_loss(self.step, frames, reference, progress=self.updates / self.steps)
        self.updates += 1
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.weights, self.clip_norm)
        if torch.isfinite(norm):
            self.adam.step()
        return loss.item()
