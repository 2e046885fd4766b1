"""``jaxdn render``: animated clips by Mitsuba, with only the effects that their scenes have."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxdn.core.checks import check_at_least
from jaxdn.core.frame import OF_SAMPLES
from jaxdn.data.clip.folder import begun_record
from jaxdn.denoiser import Denoiser
from jaxdn.effects import Effects, Plan, chosen, everything, inspect, plan
from jaxdn.methods.registry import methods
from jaxdn.planning.catalogue import OF_FIRST_HITS, THROUGH_CENTRES, NoisyLight
from jaxdn.planning.plan import SCORED
from jaxdn.render.families import FAMILIES
from jaxdn.render.farm import ClipJob, render_clips
from jaxdn.render.frame import check_options
from jaxdn.render.mitsuba.variant import choose_variant, tells_lobes, use_variant
from jaxdn.render.opening import family_scene
from jaxdn.render.path_depth import PathDepth, measure_depth
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.scenes.scene_file import SceneFile
from jaxdn.zoo.ready import candidate


class Planned(NamedTuple):
    """The effects found in a scene, and the plan derived from them."""

    effects: Effects
    plan: Plan
    depth: PathDepth | None = None
    """How the plan's path length was measured; None if it was not."""


def denoiser_named(names: str) -> Denoiser | None:
    """A denoiser to plan for: a method, shipped weights or a file; None for the noisy image, which is not denoised.

    Of several names, separated by commas, it is the first, with all buffers that one of them reads. The weights do not
    matter here, so a learned method needs none. Raises ValueError for any other name.
    """
    known = methods()
    each = [known[name].factory() if name in known else candidate(name).denoiser for name in names.split(",")]
    found = [one for one in each if one is not None]
    return found[0]._replace(reads=frozenset[str]().union(*(one.reads for one in found))) if found else None


def plan_clip(
    scene: AnimatedScene,
    *,
    effects: str = "auto",
    denoiser: Denoiser | None = None,
    width: int,
    height: int,
    frames: int,
    max_depth: int | None = None,
    light: NoisyLight = "indirect",
    jitter: bool = False,
    see_through: bool = False,
) -> Planned | None:
    """The effects to render an animated scene for, and the plan; None means no plan: ``"all"`` without a denoiser.

    Raises ValueError for a name that is not an effect.

    Args:
      scene: what is rendered.
      effects: ``"auto"``, ``"all"``, or names separated by commas.
      denoiser: plan for the buffers that it reads; None: for any denoiser, without the buffers that only few read.
      width: in pixels.
      height: in pixels.
      frames: number of frames.
      max_depth: path length; by default, with ``"auto"``, it is measured.
      light: as in :func:`jaxdn.render.render_frame`.
      jitter: as there.
      see_through: as there.
    """
    options: dict[str, Any] = {"light": light, "jitter": jitter, "see_through": see_through}
    if effects == "all":
        whole = everything(frames)
        return None if denoiser is None else Planned(whole, plan(whole, denoiser, max_depth=max_depth, **options))
    if effects != "auto":
        named = chosen([name.strip() for name in effects.split(",") if name.strip()], frames)
        return Planned(named, plan(named, denoiser, max_depth=max_depth, **options))
    found = inspect(scene, width=width, height=height, frames=frames)
    made = plan(found, denoiser, max_depth=max_depth, **options)
    # Measuring needs a path tracer, and indirect light that longer paths may add.
    if max_depth is not None or not made.indirect or made.integrator != "path":
        return Planned(found, made)
    depth = measure_depth(scene, frames=frames)
    return Planned(found, plan(found, denoiser, max_depth=depth.max_depth, **options), depth)


def render(source: str, out: Path, *, workers: int | None, **wanted: Any) -> list[Path]:
    """Render clips into folders ``out/<scene>-<seed>``, or resume them, and return these folders.

    ``workers`` is the number of processes, by default that of cores; ``wanted`` are the arguments of
    :func:`clips_of`. Raises what that raises, and RenderError, at the end, for clips that failed.
    """
    return render_clips(clips_of(source, out, **wanted), workers=workers)


def clips_of(
    source: str,
    out: Path,
    *,
    animation: Path | None,
    tours: bool = False,
    seeds: Sequence[int],
    width: int,
    height: int,
    frames: int,
    reference_spp: int,
    layers: Sequence[int],
    draws: int = 0,
    light: NoisyLight = "indirect",
    jitter: bool = False,
    see_through: bool = False,
    max_depth: int | None,
    effects: str,
    denoiser: str | None = None,
) -> list[ClipJob]:
    """The clips to render into folders ``out/<scene>-<seed>``.

    Args:
      source: a family, for which each seed gives another scene, or a Mitsuba scene (.xml), whose seeds differ only
        in noise unless ``tours`` is set.
      out: the folder for the clips.
      animation: animation file for a scene file; default: the one next to it.
      tours: every seed gives another tour of the scene file (:func:`jaxdn.render.tours.rooms.tour`) instead of its
        animation.
      seeds: one clip each.
      width: in pixels.
      height: in pixels.
      frames: number of frames.
      reference_spp: samples per pixel of the reference; 0 for none.
      layers: samples per pixel of the noisy layers, powers of two.
      draws: further images of one sample each, for training.
      light: which light is noisy: the indirect part, or all that is reflected.
      jitter: another point of the pixels in every frame, and references that are means over the pixels.
      see_through: guides of what flat mirrors and glass show.
      max_depth: path length (1 emission, 2 direct light ...); default: measured, or the scene's own.
      effects: as in :func:`plan_clip`.
      denoiser: names of the denoisers to render for, separated by commas (with a reference, what errors are reported by
        is rendered too); None: for any, without the buffers that only few read.

    Prints the Mitsuba variant and each clip's effects. Raises ValueError for a source that is not a scene and for
    options out of range.
    """
    check_at_least(1, width=width, height=height, frames=frames)
    check_options(width, height, layers, reference_spp, draws, light, jitter, see_through, None)
    scenes = _tours(source, animation, seeds, frames, out) if tours else _scenes(source, animation, seeds)
    choice = choose_variant()
    print(f"rendering with Mitsuba's {choice.variant}: {choice.reason}", flush=True)
    reader = None if denoiser is None else _reader(denoiser, choice.variant)
    if reader is not None and jitter and reader.reads & THROUGH_CENTRES:
        print(f"with jitter there is no {', '.join(sorted(reader.reads & THROUGH_CENTRES))}: left out", flush=True)
    if reader is not None and see_through and reader.reads & OF_FIRST_HITS:
        print(f"seen through, there is no {', '.join(sorted(reader.reads & OF_FIRST_HITS))}: left out", flush=True)
    if reader is not None and reference_spp:
        reader = reader._replace(reads=reader.reads | SCORED)
    size: dict[str, Any] = {"width": width, "height": height, "frames": frames}
    noisy: dict[str, Any] = {"light": light, "jitter": jitter, "see_through": see_through}
    jobs = []
    for name, scene, noises in scenes:
        planned = plan_clip(scene, effects=effects, denoiser=reader, max_depth=max_depth, **noisy, **size)
        for seed in noises:
            clip = f"{name}-{seed}"
            if planned is not None:
                found = ", ".join(planned.effects) or "no effects"
                print(f"{clip}: {found}; paths of depth {planned.plan.max_depth}", flush=True)
            job = ClipJob(
                scene.record,
                str(out / clip),
                **size,
                layers=tuple(layers),
                draws=draws,
                **noisy,
                reference_spp=reference_spp,
                max_depth=max_depth,
                seed=seed,
                plan=None if planned is None else planned.plan.record(),
            )
            jobs.append(job)
    return jobs


def _reader(names: str, variant: str) -> Denoiser | None:
    """A denoiser with what it reads, as far as the variant can render it; prints what is left out."""
    found = denoiser_named(names)
    if found is None or tells_lobes(variant) or not found.reads & OF_SAMPLES:
        return found
    print(f"{variant} cannot tell diffuse from specular light: {', '.join(sorted(found.reads & OF_SAMPLES))} left out")
    return found._replace(reads=found.reads - OF_SAMPLES)


def _scenes(
    source: str, animation: Path | None, seeds: Sequence[int]
) -> Iterable[tuple[str, AnimatedScene, list[int]]]:
    """Every scene once: its name, the scene, and the noise seeds to render it with."""
    if source in FAMILIES:  # built one at a time: there may be hundreds
        return ((source, family_scene(source, seed, animation), [seed]) for seed in seeds)
    if source.endswith(".xml"):
        scene = SceneFile(Path(source), animation)
        return [(scene.name, scene, list(seeds))]
    raise ValueError(f"scene {source!r}: expected a family ({', '.join(sorted(FAMILIES))}) or a Mitsuba scene (.xml).")


def _tours(
    source: str, animation: Path | None, seeds: Sequence[int], frames: int, out: Path
) -> Iterable[tuple[str, AnimatedScene, list[int]]]:
    """The same of a scene's tours; a tour that a folder's record describes already is not searched again."""
    if not source.endswith(".xml"):
        raise ValueError(f"tour of {source!r}: expected a Mitsuba scene (.xml); leave --tour out for a family.")
    if animation is not None:
        raise ValueError(
            f"animation {animation}: expected none with --tour, which makes its own; leave one of them out."
        )
    if not Path(source).is_file():
        raise ValueError(f"scene {source}: expected a Mitsuba scene (.xml), found no file.")
    use_variant()
    # Its names of Mitsuba exist only after a variant is chosen.
    from jaxdn.render.tours.rooms import tour

    def scene(seed: int) -> SceneFile:
        record = begun_record(out / f"{SceneFile.name_of(source)}-{seed}") or {}
        made = record.get("scene", {})
        same_file = "file" in made and Path(made["file"]).resolve() == Path(source).resolve()
        if same_file and "inserted" in made.get("animation", {}) and record["frames"] == frames:
            return SceneFile.from_record(made)
        return tour(source, seed, frames)

    return ((one.name, one, [seed]) for seed, one in ((seed, scene(seed)) for seed in seeds))
