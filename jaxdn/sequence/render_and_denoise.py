"""``jaxdn denoise SCENE``: render and denoise frame by frame, with samples where the denoiser wants them."""

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxdn.core.frame import OF_SAMPLES, Frame
from jaxdn.data.exr.exr import write_exr
from jaxdn.denoiser.rollout import stream
from jaxdn.evaluation.report.images import save_png
from jaxdn.methods.registry import methods
from jaxdn.ops.sampling import allot_evenly
from jaxdn.planning.catalogue import OF_PRIMARY_SURFACES
from jaxdn.render.adaptive import render_sampled
from jaxdn.render.open_scene import open_scene
from jaxdn.render.settings import RenderSettings
from jaxdn.runtime.atomic_files import remove_abandoned
from jaxdn.sequence.frame_denoiser import light_of
from jaxdn.sequence.render_jobs import plan_clip
from jaxdn.sequence.run import Written
from jaxdn.sequence.write_frames import name_channels, write_preview
from jaxdn.zoo.ready import Model

MOST = 64
"""Samples that one pixel may have, in budgets; at least this many."""


class SceneSettings(NamedTuple):
    """What is rendered and written."""

    render: RenderSettings = RenderSettings()
    """Size, seed and variant; the rest follows from the method."""
    frames: Collection[int] | None = None
    """Numbers of the frames to denoise; None: all of the scene."""
    budget: float = 4.0
    """Mean number of samples per pixel; below 1, not every pixel of a frame has one."""
    preview: bool = False
    """Write a PNG next to each frame, and one of its samples."""


def denoise_scene(
    source: str,
    animation: Path | None,
    out: Path,
    method: Model,
    settings: SceneSettings,
    *,
    on_frame: Callable[[Path, int, int], None] = lambda path, done, total: None,
    log: Callable[[str], None] = lambda line: None,
) -> Written:
    """Render an animated scene as the method asks for samples, and denoise it; returns the files written.

    A method that does not ask has the budget in every pixel; if it takes frames with gaps
    (:attr:`jaxdn.methods.registry.Method.sparse`), fractions of a sample follow a pattern that rotates from frame to
    frame (:func:`jaxdn.ops.sampling.rotate_pattern`). All reflected light is noisy. A file has the channels
    ``R, G, B``, the picture, ``denoised.R/G/B``, the reflected light alone, and ``samples.Y``, the number of samples of
    each pixel. Frames before the first that is wanted are rendered for their history. Flat mirrors and glass are seen
    through, unless the method follows reflections itself. Raises ValueError for what is not
    a scene, for a budget that is out of range, and where Mitsuba has only scalar variants.
    """
    scene = open_scene(source, animation)
    wanted = sorted(set(range(scene.frames) if settings.frames is None else settings.frames))
    if not wanted or wanted[0] < 0 or wanted[-1] >= scene.frames:
        raise ValueError(f"--frames: expected some of 0 to {scene.frames - 1}, which {source} has, got {wanted}.")
    if method.denoiser is None:
        raise ValueError(f"--method {method.label}: expected a denoiser for a scene, got the noisy image itself.")
    reads = method.denoiser._replace(reads=method.denoiser.reads - OF_SAMPLES)
    rendering = replace(settings.render, light="reflected", see_through=not reads.reads & OF_PRIMARY_SURFACES)
    planned = plan_clip(scene, rendering, frames=wanted[-1] + 1, denoiser=reads)
    assert planned is not None
    rendering = replace(rendering, plan=planned.plan)
    if method.denoiser.samples is None:
        _check_even_budget(settings.budget, method)
    if out.is_dir():
        remove_abandoned(out)
    step = stream(method.denoiser, method.params)
    sees_sample = method.denoiser.samples is not None and method.denoiser.sees_sample
    most = max(MOST, round(settings.budget * MOST))

    def ask(index: int, frame: Frame) -> np.ndarray:
        asked = step.ask(frame, most)
        height, width = frame.radiance.shape[:2]
        even = allot_evenly(settings.budget, height, width, index) if asked is None else asked
        return np.asarray(even)

    if rendering.see_through and {"mirror", "transmission"} & set(planned.effects):
        log("guides of flat mirrors and glass are those of what they show")
    files: list[Path] = []
    view = None
    for index in range(wanted[-1] + 1):
        sampled = render_sampled(scene, index, partial(ask, index), rendering, previous=view, sample_first=sees_sample)
        view, counts = sampled.view, np.asarray(sampled.frame.sample_count)
        image = np.asarray(step(sampled.frame))
        if index not in wanted:
            continue
        path = out / f"frame_{index:04d}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        picture = image + light_of(sampled.frame.emission)
        write_exr(path, name_channels("", picture) | name_channels("denoised.", image) | {"samples.Y": counts[..., 0]})
        if settings.preview:
            write_preview(path, picture)
            save_png(path.with_suffix(".samples.png"), np.sqrt(counts[..., 0] / max(counts.max(), 1)))
        files.append(path)
        log(f"{path.name}: {counts.mean():.3g} samples per pixel, {counts.min():g} to {counts.max():g}")
        on_frame(path, len(files), len(wanted))
    return Written(files, len(step.programs), step.sanitized)


def _check_even_budget(budget: float, method: Model) -> None:
    """Raise ValueError for a budget that cannot be the same everywhere, of a method that does not say otherwise."""
    sparse = method.method is not None and method.method.sparse
    if sparse and not 0 < budget < math.inf:
        raise ValueError(f"--budget {budget:g}: expected a number of samples above 0.")
    if not sparse and (budget < 1 or budget % 1):
        able = ", ".join(each.name for each in methods().values() if each.sparse)
        raise ValueError(
            f"--budget {budget:g}: expected a whole number of at least 1, as {method.label} does not say where samples "
            f"go; fractions are for {able}, and for weights of methods that do (ntasd, dasr)."
        )
