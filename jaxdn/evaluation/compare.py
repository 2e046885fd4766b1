"""``jaxdn compare``: every method on the same clips, scored, timed and shown next to each other in one report."""

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdn import __version__, color, metrics
from jaxdn.core.frame import Clip
from jaxdn.data.clip.noise_floor import read_halves, read_noise_floor
from jaxdn.data.read import read_clip
from jaxdn.denoiser import Denoiser, Params
from jaxdn.denoiser.rollout import denoise
from jaxdn.evaluation.report import ClipResult, Results, Scores, TrainingCurve
from jaxdn.evaluation.report.film import FRAMES, film
from jaxdn.evaluation.report.results import REFERENCE, headline_psnr
from jaxdn.runtime.cores import count_cores
from jaxdn.zoo.ready import DEFAULT_MODEL, Model

Halves = tuple[Any, Any]


class EvaluationClip(NamedTuple):
    """A clip to score images by."""

    clip: Clip
    """With a reference."""
    halves: Halves | None
    """Two independent references [T, H, W, 3] of half the samples each; None if they are not known."""
    noise_floor: float
    """dB, the PSNR of a perfect image against the reference; not a number without halves."""
    relative_to: Any = None
    """[T, H, W, 3] what relative MSE without the reference's noise is relative to; None: to the reference."""


def read_evaluation_clip(folder: Path, *, spp: int = 1, layers: bool = False) -> EvaluationClip:
    """A clip of a folder with ``spp`` samples a pixel. Raises ValueError for one without a reference.

    ``layers`` reads the independent noisy layers too, for denoisers that request samples.
    """
    clip = read_clip(folder, spp=spp, layers=layers)
    if clip.reference is None:
        raise ValueError(f"{folder}: expected a clip with a reference to compare with, got none; render one.")
    return EvaluationClip(clip, read_halves(folder), read_noise_floor(folder))


@jax.jit
def _clip_scores(
    denoised: jax.Array,
    reference: jax.Array,
    disoccluded: jax.Array,
    halves: Halves | None,
    relative_to: jax.Array | None = None,
) -> dict[str, jax.Array]:
    """Every score of a linear clip, and the curves over its frames; those without the noise of the reference too.

    Args:
      denoised: [T, H, W, 3].
      reference: [T, H, W, 3].
      disoccluded: [T, H, W, 1], above 0 where a point was hidden one frame earlier.
      halves: two independent references of half the samples each, where the clip has them.
      relative_to: [T, H, W, 3] that of :func:`jaxdn.metrics.unbiased_relative_mse`.
    """
    image, wanted = color.tonemap(denoised), color.tonemap(reference)
    found = {
        "psnr": metrics.psnr(image, wanted),
        "ssim": metrics.ssim(image, wanted),
        "l1": metrics.l1(image, wanted),
        "mse": metrics.mse(image, wanted),
        "temporal_psnr": metrics.temporal_psnr(image, wanted),
        "relative_mse": metrics.relative_mse(denoised, reference),
        "flip": metrics.flip(image, wanted),
        "disoccluded_l1": metrics.l1(image, wanted, mask=disoccluded),
        "disoccluded_mse": metrics.mse(image, wanted, mask=disoccluded),
        "frame_psnr": jax.vmap(metrics.psnr)(image, wanted),
        "frame_l1": jax.vmap(metrics.l1)(image, wanted),
        "frame_disoccluded_l1": jax.vmap(lambda a, b, m: metrics.l1(a, b, mask=m))(image, wanted, disoccluded),
    }
    return found if halves is None else found | unbiased_scores(denoised, disoccluded, halves, relative_to)


def unbiased_scores(
    denoised: jax.Array, disoccluded: jax.Array, halves: Halves, relative_to: jax.Array | None = None
) -> dict[str, jax.Array]:
    """The scores of a linear clip without the noise of the reference; the arguments are those of ``_clip_scores``."""
    image, shown = color.tonemap(denoised), color.tonemap_halves(*halves)
    return {
        "unbiased_psnr": metrics.unbiased_psnr(image, *shown),
        "unbiased_temporal_psnr": metrics.unbiased_temporal_psnr(image, *shown),
        "unbiased_mse": metrics.unbiased_mse(image, *shown),
        "unbiased_disoccluded_mse": metrics.unbiased_mse(image, *shown, mask=disoccluded),
        "unbiased_relative_mse": metrics.unbiased_relative_mse(denoised, *halves, relative_to=relative_to),
    }


def compare(
    methods: Sequence[Model],
    folders: Sequence[Path],
    *,
    title: str,
    settings: dict[str, Any],
    training: dict[str, TrainingCurve] | None = None,
    about: Mapping[str, str] | None = None,
    spp: int = 1,
    read: Callable[..., EvaluationClip] = read_evaluation_clip,
    log: Callable[[str], None] = print,
) -> Results:
    """Denoise every clip by every method and score it against the clip's reference.

    Images are tone-mapped (sRGB, clipped to [0, 1]) before they are scored, except for relative MSE. Where a clip keeps
    one half of the samples of its reference, PSNR, temporal PSNR, MSE and relative MSE are given without the noise of
    the reference too (:func:`jaxdn.metrics.unbiased_mse`). Disoccluded pixels are those whose point was hidden in the
    previous frame (``visible`` is false). Milliseconds are the median of three runs of the compiled clip, divided by
    its frames, without compilation. Raises ValueError for methods of one label, for the label "reference", and for a
    clip without a reference.

    Args:
      methods: what to compare.
      folders: the clips, each with a reference.
      title: of the report.
      settings: shown in the report.
      training: label of a method -> its training curve, for the report.
      about: label of a method -> what it is, in a few words, where that is not the title of the method.
      spp: samples per pixel to take from the clips' layers.
      read: (folder, spp, layers) -> what to score by.
      log: called with one line per clip.
    """
    labels = [method.label for method in methods]
    if twice := sorted({label for label in labels if labels.count(label) > 1}):
        raise ValueError(
            f"methods: expected every label once, got {', '.join(twice)} twice; name each method once, and let the "
            "folders of weights have different names."
        )
    if REFERENCE in labels:
        raise ValueError(
            f"methods: expected no label {REFERENCE!r}, as reports call the clips' references so, got one; "
            "rename the folder of weights."
        )
    compiled: dict[str, Callable[[Params, Clip], jax.Array]] = {}
    for method in methods:
        if method.denoiser is not None:
            compiled[method.label] = _compile(method.denoiser)
    needs_layers = any(method.denoiser is not None and method.denoiser.samples is not None for method in methods)
    clips = []
    for count, folder in enumerate(folders):
        evaluated = read(folder, spp=spp, layers=needs_layers)
        began = time.monotonic()
        result = _compare_on(evaluated, folder.name, methods, compiled, spp)
        field = headline_psnr([result.scores])
        psnr = "  ".join(f"{label} {getattr(scores, field):.2f}" for label, scores in result.scores.items())
        free = "" if field == "psnr" else " without the reference's noise"
        log(
            f"[{count + 1}/{len(folders)}] {result.name}: PSNR{free} {psnr} dB (reference good to "
            f"{result.noise_floor_psnr:.1f} dB)  {time.monotonic() - began:.0f} s"
        )
        clips.append(result)
    known = {method.label: method.method.title for method in methods if method.method is not None}
    opens_on = DEFAULT_MODEL if DEFAULT_MODEL in labels else _last_network(methods)
    descriptions = {**known, **(about or {})}
    return Results(title, settings, describe_machine(), labels, clips, training or {}, descriptions, opens_on)


def _last_network(methods: Sequence[Model]) -> str | None:
    """The last label of a network, which is what somebody brought to compare; None without any."""
    networks = [method.label for method in methods if method.method is not None and not method.method.filter]
    return networks[-1] if networks else None


def _compile(denoiser: Denoiser) -> Callable[[Params, Clip], jax.Array]:
    return jax.jit(lambda params, clip: denoise(denoiser, params, clip))


def _compare_on(
    evaluated: EvaluationClip,
    name: str,
    methods: Sequence[Model],
    compiled: dict[str, Callable[[Params, Clip], jax.Array]],
    spp: int,
) -> ClipResult:
    """The scores and images of one clip.

    Args:
      evaluated: the clip and its references.
      name: of the clip.
      methods: what to compare.
      compiled: label of a method -> its compiled function.
      spp: samples per pixel of the clip's radiance.
    """
    clip, halves = evaluated.clip, evaluated.halves
    frames = clip.frames
    inputs = jax.tree.map(jax.numpy.asarray, clip._replace(reference=None))
    reference = jax.numpy.asarray(clip.reference)
    shape = (*np.shape(frames.radiance)[:3], 1)
    disoccluded = ~np.asarray(frames.visible, bool) if frames.visible is not None else np.zeros(shape, bool)
    # At a clip's first frame no method has a history, so no pixel counts as disoccluded.
    disoccluded = np.concatenate([np.zeros_like(disoccluded[:1]), disoccluded[1:]])
    shown = int(np.argmax(disoccluded.sum((1, 2, 3)))) if disoccluded.any() else shape[0] - 1
    scores, per_frame = {}, {}
    images = {"reference": np.asarray(color.tonemap(reference[shown]))}
    wanted = np.asarray(color.tonemap(reference[:FRAMES]))
    films = {"reference": film(wanted, None)}
    for method in methods:
        if method.denoiser is None:
            denoised, milliseconds = inputs.frames.radiance, 0.0
        else:
            denoised, milliseconds = _timed(compiled[method.label], method.params, inputs, shape[0])
        scored = _clip_scores(denoised, reference, disoccluded * 1.0, halves, evaluated.relative_to)
        found = {name: np.asarray(value) for name, value in scored.items()}
        scores[method.label] = _as_scores(found, disoccluded, milliseconds, spp)
        per_frame[method.label] = {
            "psnr": found["frame_psnr"].tolist(),
            "l1": found["frame_l1"].tolist(),
            "disoccluded_l1": np.where(disoccluded.any((1, 2, 3)), found["frame_disoccluded_l1"], np.nan).tolist(),
        }
        images[method.label] = np.asarray(color.tonemap(denoised[shown]))
        films[method.label] = film(np.asarray(color.tonemap(denoised[:FRAMES])), wanted)
    return ClipResult(name, evaluated.noise_floor, scores, per_frame, shown, images, disoccluded[shown, ..., 0], films)


def _as_scores(found: dict[str, np.ndarray], disoccluded: np.ndarray, milliseconds: float, spp: int) -> Scores:
    any_disoccluded = bool(disoccluded.any())
    with np.errstate(divide="ignore"):
        disoccluded_psnr = float(-10.0 * np.log10(found["disoccluded_mse"]))
    nothing = () if any_disoccluded else ("disoccluded_l1", "unbiased_disoccluded_mse")
    return Scores(
        **{name: float("nan") if name in nothing else float(found[name]) for name in Scores._fields if name in found},
        disoccluded_psnr=disoccluded_psnr if any_disoccluded else float("nan"),
        ms_per_frame=milliseconds,
        spp=float(spp),
    )


def _timed(
    run: Callable[[Params, Clip], jax.Array], params: Params, clip: Clip, frames: int
) -> tuple[jax.Array, float]:
    """The denoised clip and the median milliseconds per frame of three runs after a first one that compiles."""
    denoised = jax.block_until_ready(run(params, clip))
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        jax.block_until_ready(run(params, clip))
        seconds.append(time.perf_counter() - began)
    return denoised, 1000.0 * float(np.median(seconds)) / frames


def describe_machine() -> dict[str, Any]:
    """The machine of a measurement: processor, cores, device, versions."""
    return {
        "processor": _processor(),
        "cores": count_cores(),
        "device": jax.devices()[0].device_kind,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxdn": __version__,
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
