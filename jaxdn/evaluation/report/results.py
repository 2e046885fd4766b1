"""The results of an evaluation, as the plain structure that the report shows."""

import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from jaxdn.evaluation.report.film import Film

REFERENCE = "reference"
"""The label under which every clip keeps its reference image; no method may have this name."""


class Scores(NamedTuple):
    """One method on one clip, or the mean over clips. NaN means *not measured, or nothing to measure on*."""

    psnr: float
    """dB, peak 1, on tone-mapped images; higher is better."""
    ssim: float
    """Structural similarity; higher is better."""
    l1: float
    """Mean absolute difference on tone-mapped images."""
    mse: float
    """Mean squared difference on tone-mapped images."""
    temporal_psnr: float
    """dB, PSNR of the differences between consecutive frames; higher is better."""
    flip: float
    """Mean FLIP difference (Andersson et al. 2020); lower is better."""
    disoccluded_l1: float
    """``l1`` on pixels that were hidden one frame earlier; NaN where a clip has none."""
    disoccluded_psnr: float
    """``psnr`` on the same pixels."""
    ms_per_frame: float
    """Milliseconds that the method needs per frame on the machine of the report."""
    spp: float
    """Samples per pixel of the noisy radiance it was given."""
    relative_mse: float = math.nan
    """Squared difference over (reference^2 + 0.01), of linear radiance; NaN where it was not measured."""
    unbiased_psnr: float = math.nan
    """dB, ``psnr`` of all frames together without the reference's own noise; NaN where a clip has no half of it."""
    unbiased_temporal_psnr: float = math.nan
    """dB, ``temporal_psnr`` of all differences together, likewise."""
    unbiased_mse: float = math.nan
    """``mse``, likewise; below 0 where the image is as good as can be told."""
    unbiased_disoccluded_mse: float = math.nan
    """``unbiased_mse`` on pixels that were hidden one frame earlier."""
    unbiased_relative_mse: float = math.nan
    """``relative_mse``, likewise."""


class ClipResult(NamedTuple):
    """Everything known about one clip."""

    name: str
    noise_floor_psnr: float
    """dB, the PSNR that a perfect image would get against this reference, which is itself a little noisy."""
    scores: dict[str, Scores]
    """method -> scores; one entry for every method of the results."""
    per_frame: dict[str, dict[str, list[float]]]
    """method -> metric (``psnr``, ``l1``, ``disoccluded_l1``, ...) -> one value per frame; may be empty."""
    shown_frame: int
    """Index of the frame that ``images`` shows."""
    images: dict[str, Any]
    """method or "reference" -> float [H, W, 3], display-encoded, in 0..1."""
    disoccluded: Any
    """[H, W] bool, the disoccluded pixels of the shown frame."""
    films: Mapping[str, Film] = MappingProxyType({})
    """method or "reference" -> its frames from the first on, for the player; may be empty."""


class TrainingCurve(NamedTuple):
    """Loss and validation of one training run."""

    step: list[int]
    loss: list[float]
    validation_step: list[int]
    validation_psnr: list[float]
    """dB, on clips or frames not trained on."""


class Results(NamedTuple):
    """Everything in a report."""

    title: str
    settings: dict[str, Any]
    machine: dict[str, Any]
    methods: list[str]
    """Labels in the order of the page; "reference" is implicit."""
    clips: list[ClipResult]
    training: dict[str, TrainingCurve]
    """label -> curve; empty if nothing was trained."""
    about: Mapping[str, str] = MappingProxyType({})
    """label -> what it is, in a few words, shown where the label stands; may leave labels out."""
    opens_on: str | None = None
    """The label that the page shows first; None is the one with the best PSNR."""


def check_results(results: Results) -> None:
    """Raise ValueError if the structure is inconsistent; the numbers are not checked."""
    methods = list(results.methods)
    if not methods or len(set(methods)) != len(methods) or REFERENCE in methods:
        raise ValueError(
            f"results.methods: expected one or more different labels, none of them {REFERENCE!r}, got {methods}; "
            "give every method a label of its own."
        )
    if not results.clips:
        raise ValueError("results.clips: expected at least one clip, got none; evaluate a clip first.")
    for clip in results.clips:
        where = f"results of clip {clip.name!r}"
        if set(clip.scores) != set(methods):
            raise ValueError(
                f"{where}: expected scores of {methods}, got {list(clip.scores)}; score every method on every clip."
            )
        pictured = {"images": set(clip.images) - {REFERENCE}, "films": set(clip.films) - {REFERENCE}}
        for part, labels in {"per_frame": set(clip.per_frame), **pictured}.items():
            if not set(labels) <= set(methods):
                raise ValueError(f"{where}: {part} has {sorted(labels)}, expected labels out of {methods}.")
        if REFERENCE not in clip.images:
            raise ValueError(f"{where}: images has no {REFERENCE!r}; add the reference of the shown frame.")
        shape = np.shape(clip.images[REFERENCE])
        if len(shape) != 3 or shape[2] != 3 or 0 in shape:
            raise ValueError(f"{where}: expected images [H, W, 3], got {shape}; give one frame in RGB.")
        for label, image in clip.images.items():
            if np.shape(image) != shape:
                raise ValueError(f"{where}: image of {label!r} is {np.shape(image)}, the reference {shape}; crop one.")
        if np.shape(clip.disoccluded) != shape[:2]:
            raise ValueError(f"{where}: expected disoccluded {shape[:2]}, got {np.shape(clip.disoccluded)}.")
        if len(lengths := {len(files) for film in clip.films.values() for files in film if files}) > 1:
            raise ValueError(f"{where}: expected films of one length, got {sorted(lengths)} frames; cut them.")
    told = {*results.about, *filter(None, [results.opens_on])}
    if not told <= set(methods):
        raise ValueError(f"results: about and opens_on have {sorted(told)}, expected labels out of {methods}.")
    for label, curve in results.training.items():
        if len(curve.step) != len(curve.loss) or len(curve.validation_step) != len(curve.validation_psnr):
            raise ValueError(f"training curve {label!r}: expected one value for each step; check the lengths.")


def mean_scores(results: Results) -> dict[str, Scores]:
    """Mean of every score over the clips, for each method.

    A clip on which a metric is NaN for every method cannot be measured (no disoccluded pixels, only one frame) and is
    left out of that metric's mean. A NaN of one method where others have a number is that method's failure and makes
    its mean NaN. dB values are averaged as dB, as the papers do.
    """
    table = np.asarray([[clip.scores[method] for method in results.methods] for clip in results.clips], np.float64)
    measurable = np.any(~np.isnan(table), axis=1)
    means = {}
    for index, method in enumerate(results.methods):
        columns = zip(table[:, index].T, measurable.T, strict=True)
        means[method] = Scores(*[_mean(values[counts]) for values, counts in columns])
    return means


def headline_psnr(clips: Iterable[Mapping[str, Scores]]) -> str:
    """The PSNR that methods are to be judged by: ``unbiased_psnr`` where every clip has it, else ``psnr``.

    ``clips``: the scores of each clip, by method. The plain one has the noise of the reference in it, so it depends on
    the samples of the reference and saturates where methods are good.
    """
    known = all(any(not math.isnan(scores.unbiased_psnr) for scores in clip.values()) for clip in clips)
    return "unbiased_psnr" if known else "psnr"


def mean_noise_floor(results: Results) -> float:
    """Mean noise floor in dB over the clips whose floor is known; NaN where none is."""
    floors = np.asarray([clip.noise_floor_psnr for clip in results.clips], np.float64)
    return _mean(floors[~np.isnan(floors)])


def _mean(values: np.ndarray) -> float:
    """The mean; NaN for no values, and for infinities of both signs, without a warning."""
    if values.size == 0 or (np.isposinf(values).any() and np.isneginf(values).any()):
        return math.nan
    return float(np.mean(values))


def metrics(results: Results) -> dict[str, Any]:
    """The numbers of the results as values of strict JSON.

    NaN (not measured, or nothing to measure on) becomes ``null``; infinities become the strings ``"inf"`` and
    ``"-inf"``, which ``float()`` reads in Python. Images are left out.
    """
    return json_ready(
        {
            "format": 1,
            "title": results.title,
            "methods": list(results.methods),
            "about": dict(results.about),
            "noise_floor_psnr": mean_noise_floor(results),
            "mean": {method: scores._asdict() for method, scores in mean_scores(results).items()},
            "clips": [
                {
                    "name": clip.name,
                    "noise_floor_psnr": clip.noise_floor_psnr,
                    "shown_frame": clip.shown_frame,
                    "disoccluded_pixels": int(np.count_nonzero(clip.disoccluded)),
                    "scores": {method: clip.scores[method]._asdict() for method in results.methods},
                    "per_frame": clip.per_frame,
                }
                for clip in results.clips
            ],
            "training": {label: curve._asdict() for label, curve in results.training.items()},
            "settings": results.settings,
            "machine": results.machine,
        }
    )


def json_ready(value: Any) -> Any:
    """Plain Python for ``json.dumps(..., allow_nan=False)``; values without a JSON form become their ``str``."""
    if value is None or isinstance(value, bool | str):
        return str(value) if isinstance(value, str) else value
    if isinstance(value, dict):
        return {str(key): json_ready(item) for key, item in value.items()}
    if hasattr(value, "_asdict"):
        return json_ready(value._asdict())
    if hasattr(value, "tolist"):  # numpy and jax arrays and scalars
        return json_ready(np.asarray(value).tolist())
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        if math.isnan(value):
            return None
        return float(value) if math.isfinite(value) else ("inf" if value > 0 else "-inf")
    if isinstance(value, Sequence | set | frozenset):
        items = sorted(value, key=str) if isinstance(value, set | frozenset) else value
        return [json_ready(item) for item in items]
    return str(value)
