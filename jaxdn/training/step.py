"""One training update: a clip's loss, its gradient through all frames, and the optimiser's step."""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from jaxdn import color, metrics
from jaxdn.core.frame import Clip
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.rollout import unroll
from jaxdn.denoiser.sanitize import sanitize_image
from jaxdn.recipes.augmentation import DrawnClip, vary_clip
from jaxdn.recipes.objectives import Objective
from jaxdn.recipes.recipe import Recipe
from jaxdn.training.devices import CLIPS, DIVIDED, ON_ALL
from jaxdn.training.xla_flags import training_options

Batch = Clip | DrawnClip
"""Stacked: a leading axis more."""


class TrainState(NamedTuple):
    """Everything that an update changes."""

    params: Params
    average: Params
    """The running mean of the parameters, which is what training is for (Polyak and Juditsky 1992)."""
    optimizer: Any
    step: jax.Array
    """int32, updates attempted so far."""
    skipped: jax.Array
    """int32, updates skipped because they were not finite."""


class Report(NamedTuple):
    """The figures of one update (scalars)."""

    loss: jax.Array
    validation_psnr: jax.Array
    """PSNR of the clips' last frame, tone-mapped; it has no gradient."""
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
    # All weights as one vector: separate code for 54 arrays takes XLA a fifth of the whole step's compilation time.
    return optax.flatten(optax.chain(limit, optax.adam(rate)))


def clip_loss(
    denoiser: Denoiser,
    params: Params,
    clip: Clip,
    objective: Objective,
    *,
    progress: jax.Array | float = 1.0,
    rematerialize: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """The objective's loss of one clip, and the PSNR of its last frame, tone-mapped.

    Args:
      denoiser: what is trained.
      params: its parameters.
      clip: frames and reference. Invalid values of the reference (not finite, negative) count as 0, and it is clamped
        to the largest radiance that a denoiser returns.
      objective: the loss.
      progress: fraction of the updates done.
      rematerialize: recompute each step in the backward pass, see :func:`jaxdn.denoiser.rollout.unroll`.
    """
    clip = clip._replace(reference=sanitize_image(clip.reference))
    images = unroll(denoiser, params, clip.frames, clip.layers, clip.reference, rematerialize=rematerialize)
    loss = objective.loss(images, clip, jnp.asarray(progress))
    last = jax.lax.stop_gradient(images[-1])
    return loss, metrics.psnr(color.tonemap(last), color.tonemap(clip.reference[-1]))


def init_state(denoiser: Denoiser, recipe: Recipe, batch: Batch) -> TrainState:
    """Parameters drawn with the recipe's seed and a new optimiser state; ``batch`` gives the shapes."""
    frames = batch.clip.frames if isinstance(batch, DrawnClip) else batch.frames
    frame = jax.tree.map(lambda buffer: buffer[0, 0], frames)
    frame = jax.tree.map(lambda image: image.astype(np.float32) if image.dtype == np.float16 else image, frame)
    params = denoiser.init(jax.random.key(recipe.seed), frame)
    return init_state_from(params, recipe)


def init_state_from(params: Params, recipe: Recipe) -> TrainState:
    """The state before the first update of given parameters."""
    zero = jnp.zeros((), jnp.int32)
    return TrainState(params, jax.tree.map(jnp.copy, params), optimizer(recipe).init(params), zero, jnp.copy(zero))


def make_train_step(
    denoiser: Denoiser, recipe: Recipe, mesh: Mesh | None = None
) -> Callable[[TrainState, Batch], tuple[TrainState, Report]]:
    """The jitted update ``(state, batch of clips) -> (state, report)``; the old state's memory is donated.

    Drawn clips (:class:`jaxdn.recipes.augmentation.DrawnClip`) are varied in it, on the device that trains on them.

    With a mesh (:mod:`jaxdn.training.devices`) each device takes its clips of the batch, and the mean of their
    gradients is all that the devices exchange: once an update, four bytes a weight.

    An update that is not finite, or whose loss is not, is skipped: weights and optimiser stay as they were, and
    ``skipped`` counts it.
    """
    update_rule = optimizer(recipe)

    def batch_loss(params: Params, batch: Batch, progress: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(element: Clip | DrawnClip) -> tuple[jax.Array, jax.Array]:
            clip = vary_clip(*element, recipe.variation) if isinstance(element, DrawnClip) else element
            return clip_loss(
                denoiser, params, clip, recipe.objective, progress=progress, rematerialize=recipe.rematerialize
            )

        loss, psnr = jax.vmap(one)(batch)
        return jnp.mean(loss), jnp.mean(psnr)

    def find_gradient(params: Params, batch: Batch, progress: jax.Array) -> Any:
        found = jax.value_and_grad(batch_loss, has_aux=True)(params, batch, progress)
        return found if mesh is None else jax.lax.pmean(found, CLIPS)

    if mesh is not None:
        # XLA cannot divide the kernels that it does not know, and would gather all clips on each device. What it checks
        # of the outputs, that they are the same everywhere, follows from the mean.
        specs: dict[str, Any] = {"in_specs": (ON_ALL, DIVIDED, ON_ALL), "out_specs": ON_ALL, "check_vma": False}
        find_gradient = jax.shard_map(find_gradient, mesh=mesh, **specs)

    def train_step(state: TrainState, batch: Batch) -> tuple[TrainState, Report]:
        progress = state.step / max(recipe.steps, 1)
        (loss, psnr), gradient = find_gradient(state.params, batch, progress)
        norm = optax.tree.norm(gradient)
        updates, optimizer_state = update_rule.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        kept_share = jnp.minimum(recipe.average, (1.0 + state.step) / (10.0 + state.step))
        average = optax.incremental_update(params, state.average, 1.0 - kept_share if recipe.average else 1.0)
        # With too high a learning rate a finite gradient may give a non-finite weight: the new values are tested.
        kept = jax.tree.leaves((params, average, optimizer_state))
        finite = [jnp.isfinite(norm), jnp.isfinite(loss), *(jnp.isfinite(x).all() for x in kept)]
        usable = functools.reduce(jnp.logical_and, finite)
        params, average, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(usable, new, old),
            (params, average, optimizer_state),
            (state.params, state.average, state.optimizer),
        )
        skipped = state.skipped + jnp.where(usable, 0, 1)
        return TrainState(params, average, optimizer_state, state.step + 1, skipped), Report(loss, psnr, norm)

    return jax.jit(train_step, donate_argnums=0, compiler_options=training_options())
