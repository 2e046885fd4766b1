"""Learning to denoise: the loss of a clip, and one step of back-propagation through time.

Pure functions and no files: the loop with data, progress and checkpoints is :mod:`jaxdn.commands.train`.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from jaxdn import color, losses, metrics
from jaxdn.backends.compiler import training_options
from jaxdn.frame import Clip, Denoiser, Frame, repair_image
from jaxdn.motion import occlusion_mask
from jaxdn.rollout import unroll


class Recipe(NamedTuple):
    """How a network is trained: ours by default, :data:`PARITY` is the paper's letter (Zeng et al. 2021, sec. 5)."""

    steps: int = 2000
    """Parameter updates in all; the occlusion loss joins in the second half."""
    occlusion: bool = True
    """Whether the motion-occlusion loss is used at all (experiment C; A and B go without)."""
    learning_rate: float = 1e-3
    """Peak learning rate of Adam."""
    decay: bool = True
    """Warm up over the first 2 % and decay to a hundredth by a cosine; else the rate is constant."""
    clip_norm: float = 1.0
    """Largest global norm of a gradient; 0 for no limit."""
    batch: int = 4
    crop: int = 64
    frames: int = 10
    """Frames of a clip; the last one is for validation and gives no gradient."""
    rematerialize: bool = False
    """Recompute each step in the backward pass: a quarter of the memory for 1.1 to 1.4 of the time."""
    seed: int = 0


PARITY = Recipe(learning_rate=1e-4, decay=False, clip_norm=0.0)
"""Adam at a constant 1e-4 without clipping (the paper trains for 200 epochs of 142 clips)."""


class TrainState(NamedTuple):
    """Everything that an update changes."""

    params: Any
    optimizer: Any
    step: jax.Array
    """int32, updates tried so far."""
    skipped: jax.Array
    """int32, updates left out because their gradient was not finite."""


class Report(NamedTuple):
    """What one step says of itself (scalars)."""

    loss: jax.Array
    validation_psnr: jax.Array
    """PSNR of the clips' last frame, tone-mapped; no gradient comes from it."""
    gradient_norm: jax.Array


def optimizer(recipe: Recipe) -> optax.GradientTransformation:
    """Adam with the recipe's schedule and clipping."""
    rate: Any = recipe.learning_rate
    if recipe.decay:
        warmup = max(1, math.ceil(0.02 * recipe.steps))
        rate = optax.warmup_cosine_decay_schedule(
            0.0, recipe.learning_rate, warmup, max(recipe.steps, warmup + 1), 0.01 * recipe.learning_rate
        )
    limit = optax.clip_by_global_norm(recipe.clip_norm) if recipe.clip_norm > 0 else optax.identity()
    # All weights as one vector: a program for each of 54 arrays takes XLA a fifth of the whole step's compilation.
    return optax.flatten(optax.chain(limit, optax.adam(rate)))


def disocclusions(frames: Frame) -> jax.Array:
    """The masks ``[T, H, W, 1]`` of the occlusion loss: where the dual vector differs from the traditional one.

    No vectors, or no dual vectors: nothing is disoccluded, and the mask is zero.
    """
    if frames.motion is None or frames.dual_motion is None:
        return jnp.zeros_like(frames.radiance[..., :1])
    return jax.vmap(occlusion_mask)(frames.motion, frames.dual_motion)


def clean(reference: jax.Array) -> jax.Array:
    """A reference that cannot poison a weight: not finite or negative -> 0, at most what a denoiser may return."""
    return repair_image(reference)


def clip_loss(
    denoiser: Denoiser, params: Any, clip: Clip, *, occlusion: jax.Array | float = 1.0, rematerialize: bool = False
) -> tuple[jax.Array, jax.Array]:
    """Loss of one clip, and the PSNR of its last frame (Zeng et al. 2021, eq. 5 and 6).

    ``spatial + temporal + occlusion * motion-occlusion`` over all frames but the last, on radiance compressed by
    ``log(1 + x)^(1/2.2)``: in linear radiance one firefly would outweigh a frame. A clip of one frame is trained on.
    ``occlusion`` is traced, so that both phases of training run in one compiled program.
    """
    reference = clean(clip.reference)
    images = unroll(denoiser, params, clip.frames, rematerialize=rematerialize)
    trained = slice(0, max(1, images.shape[0] - 1))
    denoised, wanted = color.compress(images[trained]), color.compress(reference[trained])
    loss = losses.spatial(denoised, wanted) + losses.temporal(denoised, wanted)
    loss = loss + occlusion * losses.occlusion(denoised, wanted, disocclusions(clip.frames)[trained])
    last = jax.lax.stop_gradient(images[-1])
    return loss, metrics.psnr(color.tonemap(last), color.tonemap(reference[-1]))


def initial_state(denoiser: Denoiser, recipe: Recipe, batch: Clip) -> TrainState:
    """Parameters drawn with the recipe's seed and an optimiser that has seen nothing; ``batch`` gives the shapes."""
    frame = jax.tree.map(lambda buffer: buffer[0, 0], batch.frames)
    params = denoiser.init(jax.random.key(recipe.seed), frame)
    return TrainState(params, optimizer(recipe).init(params), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))


def make_train_step(denoiser: Denoiser, recipe: Recipe) -> Callable[[TrainState, Clip], tuple[TrainState, Report]]:
    """The jitted update ``(state, batch of clips) -> (state, report)``; the old state's memory is donated.

    An update that is not finite, or whose loss is not, changes no weight: the state stays as it was and ``skipped``
    counts it.
    """
    update_rule = optimizer(recipe)

    def batch_loss(params: Any, batch: Clip, occlusion: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(clip: Clip) -> tuple[jax.Array, jax.Array]:
            return clip_loss(denoiser, params, clip, occlusion=occlusion, rematerialize=recipe.rematerialize)

        loss, psnr = jax.vmap(one)(batch)
        return jnp.mean(loss), jnp.mean(psnr)

    def train_step(state: TrainState, batch: Clip) -> tuple[TrainState, Report]:
        second_half = state.step >= recipe.steps // 2
        occlusion = jnp.where(second_half, 1.0, 0.0) if recipe.occlusion else jnp.zeros(())
        (loss, psnr), gradient = jax.value_and_grad(batch_loss, has_aux=True)(state.params, batch, occlusion)
        norm = optax.tree.norm(gradient)
        updates, optimizer_state = update_rule.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        # A finite gradient times too high a learning rate is no finite weight: what would be kept is what is tested.
        kept = jax.tree.leaves((params, optimizer_state))
        finite = [jnp.isfinite(norm), jnp.isfinite(loss), *(jnp.isfinite(x).all() for x in kept)]
        usable = functools.reduce(jnp.logical_and, finite)
        params, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(usable, new, old), (params, optimizer_state), (state.params, state.optimizer)
        )
        skipped = state.skipped + jnp.where(usable, 0, 1)
        return TrainState(params, optimizer_state, state.step + 1, skipped), Report(loss, psnr, norm)

    return jax.jit(train_step, donate_argnums=0, compiler_options=training_options())
