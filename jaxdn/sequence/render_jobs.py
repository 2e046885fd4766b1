"""``jaxdn render``: animated clips by Mitsuba, with only the effects that their scenes have."""

import functools
from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from jaxdn.core.checks import check_at_least
from jaxdn.core.frame import OF_SAMPLES
from jaxdn.data.clip.folder import begun_record
from jaxdn.denoiser import Denoiser
from jaxdn.effects import Effects, Plan, choose_all_effects, choose_effects, inspect, plan
from jaxdn.methods.registry import is_method, method_named
from jaxdn.planning.catalogue import OF_PRIMARY_SURFACES, THROUGH_CENTRES
from jaxdn.planning.detected_effects import IN_TIME
from jaxdn.planning.plan import SCORED
from jaxdn.render.clip_job import ClipJob, UnplannedClip
from jaxdn.render.families import FAMILIES
from jaxdn.render.mitsuba.variant import choose_variant, pin_variant, separates_lobes, use_variant
from jaxdn.render.open_scene import check_no_animation, open_family
from jaxdn.render.path_depth import PathDepth, measure_depth
from jaxdn.render.scenes.optics import ENTRIES, get_shutter
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.render.settings import RenderSettings
from jaxdn.render.worker_pool import render_clips
from jaxdn.zoo.ready import find_model


class PlannedClip(NamedTuple):
    """The effects detected in a scene, and the plan derived from them."""

    effects: Effects
    plan: Plan
    depth: PathDepth | None = None
    """How the plan's path length was measured; None if it was not."""
    left_out: str = ""
    """In words, the buffers that the denoiser reads and that the scene cannot have; "" if there are none."""


def find_denoiser(names: str) -> Denoiser | None:
    """A denoiser to plan for: a method, shipped weights or a file; None for the noisy image, which is not denoised.

    Of several names, separated by commas, it is the first, with all buffers that one of them reads. The weights do not
    matter here, so a learned method needs none. Raises ValueError for any other name.
    """
    denoisers = []
    for name in names.split(","):
        by_name = is_method(name) and not name.endswith(".safetensors")
        denoiser = method_named(name).factory() if by_name else find_model(name).denoiser
        denoisers += [] if denoiser is None else [denoiser]
    reads = frozenset[str]().union(*(denoiser.reads for denoiser in denoisers))
    return denoisers[0]._replace(reads=reads) if denoisers else None


def plan_clip(
    scene: AnimatedScene,
    settings: RenderSettings,
    *,
    frames: int,
    effects: str = "auto",
    denoiser: Denoiser | None = None,
) -> PlannedClip | None:
    """The effects to render an animated scene for, and the plan; None means no plan: ``"all"`` without a denoiser.

    Whatever effects are chosen, the scene is inspected for what they do not say: frames in which nothing changes share
    their buffers, where no chosen effect concerns two frames, and in fog or with a shutter there are no buffers of
    samples. Raises ValueError for a name that is not an effect.

    Args:
      scene: what is rendered.
      settings: how, without a plan; without a path length it is measured with ``"auto"``.
      frames: number of frames.
      effects: ``"auto"``, ``"all"``, or names separated by commas.
      denoiser: plan for the buffers that it reads; None: for any denoiser, without the buffers that only few read.
    """

    if effects == "all" and denoiser is None:
        return None
    chosen = None if effects == "auto" else _choose(effects, frames)
    detected = inspect(scene, width=settings.width, height=settings.height, frames=frames)
    if chosen is not None and not IN_TIME & set(chosen.names):
        chosen = replace(chosen, shared_with=detected.shared_with)

    def make(max_depth: int | None = settings.max_depth) -> PlannedClip:
        shown = detected if chosen is None else chosen
        # Filtered samples go through other points in every frame, as jittered ones do.
        jitter, through = not settings.through_centres, settings.see_through
        made = plan(shown, denoiser, max_depth=max_depth, light=settings.light, jitter=jitter, see_through=through)
        # Nothing is told of samples that fog scatters, or of those of several times.
        where = "with a shutter" if get_shutter(scene) > 0 else "in fog" if "media" in detected else ""
        lost = OF_SAMPLES & set(made.buffers) if where else frozenset[str]()
        if not lost:
            return PlannedClip(shown, made)
        kept = tuple(tuple(name for name in frame if name not in lost) for frame in made.frames)
        told = f"{where} there is no {', '.join(sorted(lost))}: left out"
        return PlannedClip(shown, made._replace(frames=kept), left_out=told)

    planned = make()
    if chosen is not None:
        return planned
    # Measuring needs a path tracer, and indirect light that longer paths may add.
    if settings.max_depth is not None or not planned.plan.indirect or planned.plan.integrator != "path":
        return planned
    depth = measure_depth(scene, frames=frames)
    return make(depth.max_depth)._replace(depth=depth)


def _choose(effects: str, frames: int) -> Effects:
    """The effects of ``"all"``, or of names separated by commas."""
    if effects == "all":
        return choose_all_effects(frames)
    return choose_effects([name.strip() for name in effects.split(",") if name.strip()], frames)


class ClipSource(NamedTuple):
    """Where clips come from: a scene, and seeds."""

    scene: str
    """A family, for which each seed gives another scene, or a Mitsuba scene (.xml), whose seeds differ only in noise
    unless ``randomised`` is set."""
    seeds: Sequence[int] = (0,)
    """One clip each."""
    frames: int = 10
    """Number of frames of each."""
    animation: Path | None = None
    """Animation file for a scene file; None: the one next to it."""
    randomised: bool = False
    """Every seed gives another animation of the scene file
    (:func:`jaxdn.render.camera_paths.randomised_scene.randomise_scene`) instead of its own."""
    effects: str = "auto"
    """As in :func:`plan_clip`."""
    denoiser: str | None = None
    """Names of the denoisers to render for, separated by commas (with a reference, what errors are reported by is
    rendered too); None: for any, without the buffers that only few read."""
    random_optics: bool = False
    """Every seed draws a lens, a shutter and fog (:mod:`jaxdn.render.camera_paths.random_optics`)."""


def render(
    source: ClipSource,
    out: Path,
    settings: RenderSettings,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    threads: int | None = None,
    frames_per_task: int | None = None,
) -> list[Path]:
    """Render clips into folders ``out/<scene>-<seed>``, or resume them, and return these folders.

    With an ``executor`` each clip is planned where it is rendered, unless one plan serves all. The other options are
    those of :func:`jaxdn.render.worker_pool.render_clips`. Raises as :func:`plan_jobs` does, and RenderError, at the
    end, for clips that failed.
    """
    here = executor is None or not (source.randomised or source.scene in FAMILIES)
    jobs: Sequence[ClipJob | UnplannedClip] = (
        plan_jobs(source, out, settings) if here else _list_unplanned(source, out, settings)
    )
    return render_clips(jobs, workers=workers, executor=executor, threads=threads, frames_per_task=frames_per_task)


def _list_unplanned(source: ClipSource, out: Path, settings: RenderSettings) -> list[UnplannedClip]:
    """The clips whose scenes differ, each to be planned by the process that renders it. Raises as plan_jobs does."""
    _check_source(source, settings)
    if source.denoiser is not None:
        find_denoiser(source.denoiser)
    print(f"rendering with Mitsuba's {pin_variant()} on all machines; each clip is planned where it is rendered")
    name = SceneFile.name_of(source.scene) if source.randomised else source.scene
    return [
        UnplannedClip(
            str(out / f"{name}-{seed}"),
            source.frames,
            functools.partial(_plan_job, source._replace(seeds=[seed]), out, settings),
        )
        for seed in source.seeds
    ]


def _plan_job(source: ClipSource, out: Path, settings: RenderSettings) -> ClipJob:
    """The job of a source with one seed."""
    (job,) = plan_jobs(source, out, settings)
    return job


def plan_jobs(source: ClipSource, out: Path, settings: RenderSettings) -> list[ClipJob]:
    """Plan the clips to render into folders ``out/<scene>-<seed>``; ``settings`` have neither plan nor seed.

    Prints the Mitsuba variant and each clip's effects. Raises ValueError for a source that is not a scene and for
    options out of range.
    """
    _check_source(source, settings)
    scenes = _randomise_scenes(source, out) if source.randomised else _open_scenes(source)
    if source.random_optics:
        scenes = _randomise_optics(scenes, source.frames)
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    reader = None if source.denoiser is None else _find_reader(source.denoiser, choice.variant, settings)
    jobs = []
    for name, scene, seeds in scenes:
        planned = plan_clip(scene, settings, frames=source.frames, effects=source.effects, denoiser=reader)
        for seed in seeds:
            clip = f"{name}-{seed}"
            if planned is not None:
                detected = ", ".join(planned.effects) or "no effects"
                print(f"{clip}: {detected}; paths of depth {planned.plan.max_depth or scene.max_depth}", flush=True)
                if planned.left_out:
                    print(f"{clip}: {planned.left_out}", flush=True)
            own = replace(settings, seed=seed, plan=None if planned is None else planned.plan)
            jobs.append(ClipJob(scene.record, str(out / clip), source.frames, own))
    return jobs


def _find_reader(names: str, variant: str, settings: RenderSettings) -> Denoiser | None:
    """A denoiser with what it reads, as far as it can be rendered; prints what is left out."""
    reader = find_denoiser(names)
    if reader is None:
        return None
    if not separates_lobes(variant) and (lost := reader.reads & OF_SAMPLES):
        print(f"{variant} cannot tell diffuse from specular light: {', '.join(sorted(lost))} left out")
        reader = reader._replace(reads=reader.reads - OF_SAMPLES)
    if not settings.through_centres and (lost := reader.reads & THROUGH_CENTRES):
        why = "with jitter" if settings.jitter else "where pixels are filtered"
        print(f"{why} there is no {', '.join(sorted(lost))}: left out", flush=True)
    if settings.see_through and (lost := reader.reads & OF_PRIMARY_SURFACES):
        print(f"seen through, there is no {', '.join(sorted(lost))}: left out", flush=True)
    return reader._replace(reads=reader.reads | SCORED) if settings.reference_spp else reader


def _check_source(source: ClipSource, settings: RenderSettings) -> None:
    """Raise ValueError for a source that is no scene, and for options that it cannot have."""
    check_at_least(1, frames=source.frames)
    if source.random_optics:
        _check_random_optics(source, settings)
    name, animation = source.scene, source.animation
    if source.randomised:
        if not name.endswith(".xml"):
            raise ValueError(f"tour of {name!r}: expected a Mitsuba scene (.xml); leave --tour out for a family.")
        if animation is not None:
            raise ValueError(
                f"animation {animation}: expected none with --tour, which makes its own; leave one of them out."
            )
        if not Path(name).is_file():
            raise ValueError(f"scene {name}: expected a Mitsuba scene (.xml), found no file.")
    elif name in FAMILIES:
        check_no_animation(name, animation)
    elif not name.endswith(".xml"):
        raise ValueError(
            f"scene {name!r}: expected a family ({', '.join(sorted(FAMILIES))}) or a Mitsuba scene (.xml)."
        )


def _check_random_optics(source: ClipSource, settings: RenderSettings) -> None:
    """Raise ValueError for what can have no random optics."""
    if settings.pixel_filter == "centre":
        raise ValueError(
            "random optics: expected filtered pixels, as first hits are random; add --pixel-filter blackman-harris."
        )
    if not source.randomised and source.scene not in FAMILIES:
        raise ValueError(f"random optics of {source.scene!r}: expected a family, or --tour, whose seeds give scenes.")


def _randomise_optics(
    scenes: Iterable[tuple[str, AnimatedScene, list[int]]], frames: int
) -> Iterable[tuple[str, AnimatedScene, list[int]]]:
    """The same scenes with the optics that their seeds draw."""
    use_variant()
    # Its names of Mitsuba exist only after a variant is chosen.
    from jaxdn.render.camera_paths.random_optics import randomise_optics

    return ((name, randomise_optics(scene, seeds[0], frames), seeds) for name, scene, seeds in scenes)


def _open_scenes(source: ClipSource) -> Iterable[tuple[str, AnimatedScene, list[int]]]:
    """Every scene once: its name, the scene, and the seeds of the noise to render it with."""
    name, animation = source.scene, source.animation
    if name in FAMILIES:  # built one at a time: there may be hundreds
        return ((name, open_family(name, seed, animation), [seed]) for seed in source.seeds)
    scene = SceneFile(Path(name), animation)
    return [(scene.name, scene, list(source.seeds))]


def _randomise_scenes(source: ClipSource, out: Path) -> Iterable[tuple[str, AnimatedScene, list[int]]]:
    """As :func:`_open_scenes`, animated by each seed; an animation in a folder's record is not searched again."""
    file = source.scene
    use_variant()
    # Its names of Mitsuba exist only after a variant is chosen.
    from jaxdn.render.camera_paths.randomised_scene import randomise_scene

    def scene(seed: int) -> SceneFile:
        record = begun_record(out / f"{SceneFile.name_of(file)}-{seed}") or {}
        begun = record.get("scene", {})
        same_file = "file" in begun and Path(begun["file"]).resolve() == Path(file).resolve()
        if same_file and "inserted" in begun.get("animation", {}) and record["frames"] == source.frames:
            own = {name: value for name, value in begun["animation"].items() if name not in ENTRIES}
            return SceneFile.from_record({**begun, "animation": own})
        return randomise_scene(file, seed, source.frames)

    return ((one.name, one, [seed]) for seed, one in ((seed, scene(seed)) for seed in source.seeds))
