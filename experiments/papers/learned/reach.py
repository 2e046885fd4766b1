"""How much well-placed samples could save: the denoisers as they are, with samples placed by someone who knows.

Uniform samples, more of them, and maps with the same budget of 4 made from what no sampler can see: the true noise of
a sample, and the true error of the image from uniform samples. Adaptive sampling cannot be expected to save more than
such maps do, unless training changes the denoiser with it.
"""

from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.papers.learned.maps import windowed
from experiments.papers.learned.scores import read
from experiments.papers.learned.stages import BUDGET, LAYERS
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser.rollout import unroll
from jaxdn.evaluation.compare import Footage
from jaxdn.metrics import unbiased_relative_mse
from jaxdn.ops.sampling import from_layers, sample_map
from jaxdn.zoo.ready import Candidate

UNIFORM = (BUDGET, 2 * BUDGET, 4 * BUDGET)
DENOISERS = ("svgf", "steady-balanced", "ntasd, uniform")
"""Those that are asked, as far as they are there."""
BY_NOISE, BY_ERROR = "by the noise", "by the error"


def table(methods: list[Candidate], folders: list[Path]) -> str:
    """Mean relative MSE of each way to place samples over that of uniform ones, as Markdown."""
    titles = [f"uniform {count}" for count in UNIFORM[1:]] + [f"{BUDGET} {name}" for name in (BY_NOISE, BY_ERROR)]
    lines = [f"| relative MSE / that of uniform {BUDGET} | {' | '.join(titles)} |", "|---" * (len(titles) + 1) + "|"]
    footage = [jax.tree.map(jnp.asarray, read(folder, spp=BUDGET, layers=True)) for folder in folders]
    for method in methods:
        denoise = denoises(method)
        errors = np.mean([list(errors_of(method, denoise, one)) for one in footage], axis=0)
        lines.append(f"| {method.label} | " + " | ".join(f"{value:.2f}" for value in errors[1:] / errors[0]) + " |")
    return "\n".join(lines)


def denoises(method: Candidate) -> Callable[[Frame], jax.Array]:
    """Frames -> images: one program for all clips with the same buffers."""
    denoiser = method.denoiser
    assert denoiser is not None
    return jax.jit(lambda frames: unroll(denoiser, method.params, frames))


def errors_of(method: Candidate, denoise: Callable[[Frame], jax.Array], footage: Footage) -> Iterator[float]:
    """Relative MSE with each of the uniform counts, and with the two maps."""
    clip, halves, near = footage.clip, footage.halves, footage.relative_to
    denoiser = method.denoiser
    assert denoiser is not None
    assert halves is not None

    def image(counts: jax.Array) -> jax.Array:
        light, got = with_counts(clip, counts)
        told = got if "sample_count" in denoiser.reads else None
        return denoise(clip.frames._replace(radiance=light, sample_count=told))

    def error(made: jax.Array) -> float:
        return float(unbiased_relative_mse(made, *halves, relative_to=near))

    flat = jnp.ones((*clip.reference.shape[:-1], 1))
    uniform = image(BUDGET * flat)
    yield error(uniform)
    for count in UNIFORM[1:]:
        yield error(image(count * flat))
    wrong = np.asarray(jnp.square(uniform - near) / (near**2 + 0.01)).mean(-1)
    for importance in (noise_of(clip, near), np.sqrt([windowed(each, 3) for each in wrong])):
        yield error(image(placed(importance)))


def noise_of(clip: Clip, near: jax.Array) -> np.ndarray:
    """[T, H, W] the spread of one sample, relative to the light, in the mean over 5 x 5 pixels."""
    found = []
    for t, wanted in enumerate(np.asarray(clip.reference)):
        scale = np.asarray(near[t]) ** 2 + 0.01
        layers = {n: np.asarray(layer[t]) for n, layer in (clip.layers or {}).items()}
        off = [n * np.minimum(np.square(layer - wanted) / scale, 1e8).mean(-1) for n, layer in layers.items()]
        found.append(np.sqrt(windowed(np.mean(off, axis=0), 2)))
    return np.stack(found)


def placed(importance: np.ndarray) -> jax.Array:
    """[T, H, W, 1] counts in proportion to the importance [T, H, W]: at least 1, as many as are stored at most."""
    logits = jnp.log(jnp.asarray(importance, jnp.float32)[..., None] + 1e-6)
    return jnp.stack([sample_map(each, float(BUDGET), least=1, most=sum(LAYERS)) for each in logits])


def with_counts(clip: Clip, counts: jax.Array) -> tuple[jax.Array, jax.Array]:
    """[T, H, W, 3] the mean of so many stored samples, and [T, H, W, 1] their numbers."""
    layers = clip.layers or {}
    each = [from_layers({n: layer[t] for n, layer in layers.items()}, count) for t, count in enumerate(counts)]
    return jnp.stack([light for light, _ in each]), jnp.stack([count for _, count in each])
