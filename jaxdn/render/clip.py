"""Render one frame, or a clip into a folder of OpenEXR frames, resumable at any point."""

import importlib.metadata
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxdn.checks import check_at_least
from jaxdn.clips import ClipError, read_frame, write_frame
from jaxdn.clips.folder import begin_record, begun_record, finish_record, frame_path
from jaxdn.frame import Frame
from jaxdn.motion import dual_motion
from jaxdn.planning.plan import Plan, entries
from jaxdn.render.errors import RenderError
from jaxdn.render.gbuffer import check_scene, gbuffer
from jaxdn.render.geometry import View, motion_between
from jaxdn.render.gradient_samples import Replay, luminance_gradient
from jaxdn.render.scene import AnimatedScene
from jaxdn.render.seeds import DRAWS, NOISY, REFERENCE
from jaxdn.render.variant import use_variant
from jaxdn.render.wavefront import Accumulated, no_light

_SURFACE = ("albedo", "normal", "depth", "roughness", "reflectance", "ids")
_DISOCCLUSION = frozenset({"dual_motion", "visible"})
_MOTION = frozenset({"motion", "previous_depth"}) | _DISOCCLUSION
_GRADIENT = "luminance_gradient"
_FREE = ("frames", "cameras", "versions", "bad_samples")
"""Entries of a record that may change when rendering is resumed."""


class Rendered(NamedTuple):
    """Everything that a clip stores of one frame, as NumPy arrays."""

    frame: Frame
    """``radiance`` is the noisy layer with the fewest samples."""
    layers: dict[int, np.ndarray]
    """Samples per pixel -> [H, W, 3] independent noisy indirect radiance."""
    reference: np.ndarray | None
    """[H, W, 3] converged indirect radiance, of samples that no noisy layer contains."""
    reference_half: np.ndarray | None
    """[H, W, 3] the same from the first half of its samples."""
    draws: np.ndarray | None
    """[n, H, W, 6] independent single samples of indirect and direct light."""
    view: View | None
    """Input of the next frame's motion vectors; None if the plan needs no G-buffer."""
    bad_samples: int
    """Samples that were not finite and count as black."""


def render_frame(
    scene: AnimatedScene,
    frame: int,
    *,
    width: int,
    height: int,
    layers: Sequence[int] = (1,),
    reference_spp: int = 0,
    max_depth: int | None = None,
    seed: int = 0,
    variant: str | None = None,
    draws: int = 0,
    previous: View | None = None,
    plan: Plan | None = None,
) -> Rendered:
    """Render one frame of an animated scene: noisy layers, a reference, G-buffers and motion vectors.

    ``direct`` and ``emission`` are means over the reference's samples, or over the noisy ones if ``reference_spp`` is
    0. The result depends only on the arguments: the same frame rendered again, alone or in another process, is the same
    bit for bit. Raises ValueError for options out of range and scenes with unsupported effects.

    Args:
      scene: to render.
      frame: index of the frame.
      width: in pixels.
      height: in pixels.
      layers: samples per pixel of the noisy layers, powers of two.
      reference_spp: samples per pixel of the reference; 0 for none.
      max_depth: path length; default: that of the plan, else of the scene.
      seed: of the random numbers.
      variant: Mitsuba's; default: the fastest that works here.
      draws: further images of one sample each, for training on noise that rarely repeats.
      previous: the ``view`` of the frame before, computed if it is not given; frame 0 has none, and its motion is 0.
      plan: what to leave out: buffers (None then), paths longer than its ``max_depth``, and, in a frame that shows the
        same as an earlier one (``plan.held``), everything except the noise. The rest is the same as without a plan, bit
        for bit.
    """
    _check_options(width, height, layers, reference_spp, draws)
    use = tracer(use_variant(variant))
    depth = _path_length(scene, max_depth, plan)
    repeated = plan is not None and plan.held[frame] != frame
    wanted = frozenset(Frame._fields if plan is None else () if repeated else plan.frames[frame])
    before = None
    if frame > 0 and (_GRADIENT in wanted or (wanted & _MOTION and previous is None)):
        before = scene.build(frame - 1, width, height)
        previous = previous or _view(scene, frame - 1, before, frozenset())
    built = scene.build(frame, width, height)
    check_scene(built)
    view = previous if repeated else _view(scene, frame, built, wanted) if wanted else None

    dark = plan is not None and plan.integrator == "none"
    noise_only = plan is not None and not plan.indirect

    def light(stream: int, first: int, count: int) -> Accumulated:
        if dark or (noise_only and stream == NOISY and reference_spp):
            return no_light((height, width))
        return use.accumulate(built, seed=seed, frame=frame, stream=stream, first=first, count=count, max_depth=depth)

    # Layer n always holds the samples n-1 ... 2n-2: its image does not depend on the other layers.
    noisy = {samples: light(NOISY, samples - 1, samples) for samples in sorted(layers)}
    halves = []
    if reference_spp and not repeated:
        first_half = (reference_spp + 1) // 2
        halves = [light(REFERENCE, 0, first_half), light(REFERENCE, first_half, reference_spp - first_half)]
    sums = halves or list(noisy.values())
    total = sums[0]
    for part in sums[1:]:
        total = total.plus(part)
    samples = reference_spp or sum(layers)
    singles = [light(DRAWS, index, 1) for index in range(draws)]

    images = {count: _single(part.indirect / count) for count, part in noisy.items()}
    found: dict[str, Any] = {"direct": _single(total.direct / samples), "emission": _single(total.emitted / samples)}
    if view is not None:
        found |= {name: getattr(view.gbuffer, name) for name in _SURFACE}
        if wanted & _MOTION:
            found |= _motion(view, previous, disocclusion=bool(wanted & _DISOCCLUSION))
        if _GRADIENT in wanted:
            found[_GRADIENT] = np.zeros((height, width, 2), np.float32)
            if previous is not None and not dark and (plan is None or plan.indirect):
                numbers = {"seed": seed, "frame": frame, "sample": min(layers) - 1, "max_depth": depth}
                found[_GRADIENT] = luminance_gradient(use.replay, (before, previous), (built, view), **numbers)
    buffers = {name: buffer for name, buffer in found.items() if name in wanted}
    return Rendered(
        frame=Frame(radiance=images[min(images)], **buffers),
        layers=images,
        reference=_single(total.indirect / samples) if halves else None,
        reference_half=_single(halves[0].indirect / ((reference_spp + 1) // 2)) if halves else None,
        draws=np.stack([_single(np.concatenate([one.indirect, one.direct], -1)) for one in singles]) if draws else None,
        view=view,
        bad_samples=sum(part.bad for part in (*noisy.values(), *halves, *singles)),
    )


def render_clip(
    scene: AnimatedScene,
    folder: str | Path,
    *,
    width: int,
    height: int,
    frames: int | None = None,
    layers: Sequence[int] = (1,),
    reference_spp: int = 0,
    max_depth: int | None = None,
    seed: int = 0,
    variant: str | None = None,
    draws: int = 0,
    plan: Plan | None = None,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Render the frames 0 ... ``frames`` - 1 into ``folder``: one ``frame_0000.exr`` each, and then ``clip.json``.

    Existing complete frames are kept, so that an interrupted rendering is resumed; the folder must have been started
    with the same settings (ClipError otherwise). It only becomes a clip when all frames exist
    (:func:`jaxdn.clips.folder.begin_record`). Returns the folder. Raises RenderError, naming the clip and the frame, if
    a frame cannot be rendered or written.

    Args:
      scene: to render.
      folder: of the clip.
      width: in pixels.
      height: in pixels.
      frames: number of frames; default: that of the scene.
      layers: as in :func:`render_frame`, like the next six.
      reference_spp: samples per pixel of the reference; 0 for none.
      max_depth: path length.
      seed: of the random numbers.
      variant: Mitsuba's.
      draws: further images of one sample each.
      plan: for these frames; it is stored in the record.
      progress: called with the index of every frame that is finished or already exists.
    """
    folder = Path(folder)
    frames = scene.frames if frames is None else frames
    check_at_least(1, frames=frames)
    _check_options(width, height, layers, reference_spp, draws)
    if plan is not None and len(plan.frames) != frames:
        raise ValueError(f"plan: expected one for {frames} frames, got one for {len(plan.frames)}.")
    chosen = use_variant(variant)
    record: dict[str, Any] = {
        "name": scene.name,
        "frames": frames,
        "width": width,
        "height": height,
        "layers": sorted(layers),
        "reference_spp": reference_spp,
        "draws": draws,
        "variant": chosen,
        "max_depth": _path_length(scene, max_depth, plan),
        "plan": None if plan is None else plan.record(),
        "seed": seed,
        "jittered": tracer(chosen).jittered,
        "cameras": [_camera_record(scene, frame) for frame in range(frames)],
        "scene": dict(scene.record),
        "versions": _versions(),
        "bad_samples": 0,
    }
    before = begun_record(folder)
    if before is not None:
        _check_settings(folder, record, before)
        record["bad_samples"] = before.get("bad_samples", 0)
    begin_record(record, folder)
    options: dict[str, Any] = {"width": width, "height": height, "layers": layers, "reference_spp": reference_spp}
    options |= {"max_depth": max_depth, "seed": seed, "variant": chosen, "draws": draws, "plan": plan}
    previous: View | None = None
    for frame in range(frames):
        path = frame_path(folder, frame)
        if _is_whole(path):
            previous = None
        else:
            try:
                rendered = render_frame(scene, frame, previous=previous, **options)
                _write(path, rendered)
            except Exception as error:
                reason = f"{type(error).__name__}: {error}"
                raise RenderError(f"clip {scene.name!r} in {folder}, frame {frame}: {reason}") from error
            previous = rendered.view
            if rendered.bad_samples:
                record["bad_samples"] += rendered.bad_samples
                begin_record(record, folder)
        if progress is not None:
            progress(frame)
    finish_record(record, folder)
    return folder


def _write(path: Path, rendered: Rendered) -> None:
    write_frame(
        path,
        rendered.frame,
        layers=rendered.layers,
        reference=rendered.reference,
        reference_half=rendered.reference_half,
        draws=rendered.draws,
    )


def _path_length(scene: AnimatedScene, max_depth: int | None, plan: Plan | None) -> int:
    """The given path length, else the plan's, else the scene's."""
    if max_depth is not None and max_depth < 1:
        raise ValueError(f"max_depth: expected at least 1 (emission only), got {max_depth}.")
    return max_depth or (plan.max_depth if plan else None) or scene.max_depth


class Tracer(NamedTuple):
    """How a variant traces paths."""

    accumulate: Callable[..., Accumulated]
    replay: Replay
    jittered: bool
    """It distributes its samples over the pixel."""


def tracer(variant: str) -> Tracer:
    """The tracer of a variant."""
    if variant.startswith("scalar"):
        from jaxdn.render import exact

        return Tracer(exact.accumulate, exact.replay, True)
    from jaxdn.render import wavefront

    return Tracer(wavefront.accumulate, wavefront.replay, False)


def _view(scene: AnimatedScene, frame: int, built: Any, wanted: frozenset[str]) -> View:
    pose = {name: np.asarray(matrix, np.float64) for name, matrix in scene.pose(frame).items()}
    return View(gbuffer(built, reflectance="reflectance" in wanted), scene.camera(frame), pose)


def _motion(view: View, previous: View | None, *, disocclusion: bool) -> dict[str, Any]:
    """The motion buffers of a Frame; in the first frame nothing has moved yet."""
    if previous is None:
        zero = np.zeros((*view.gbuffer.ids.shape[:2], 2), np.float32)
        seen = np.ones_like(view.gbuffer.ids, bool)
        return {"motion": zero, "dual_motion": zero, "visible": seen, "previous_depth": view.gbuffer.depth}
    found = motion_between(view, previous, disocclusion=disocclusion)
    motion = found.motion.astype(np.float32)
    buffers = {"motion": motion, "previous_depth": found.previous_depth}
    if found.forward_motion is not None and found.visible is not None:
        forward = jnp.asarray(found.forward_motion.astype(np.float32))
        dual = dual_motion(jnp.asarray(motion), forward, visible=jnp.asarray(found.visible[..., 0]))
        buffers |= {"visible": found.visible, "dual_motion": np.asarray(dual)}
    return buffers


def _single(image: np.ndarray) -> np.ndarray:
    return image.astype(np.float32)


def _check_options(width: int, height: int, layers: Sequence[int], reference_spp: int, draws: int) -> None:
    check_at_least(1, width=width, height=height)
    powers = all(isinstance(samples, int) and samples >= 1 and samples & (samples - 1) == 0 for samples in layers)
    if not layers or not powers or len(set(layers)) != len(layers):
        raise ValueError(f"layers: expected different powers of two, such as (1, 2, 4), got {tuple(layers)}.")
    if reference_spp < 0 or reference_spp == 1:
        raise ValueError(f"reference_spp: expected 0 (no reference) or at least 2, got {reference_spp}.")
    if draws < 0:
        raise ValueError(f"draws: expected 0 or more images of one sample each, got {draws}.")


def _camera_record(scene: AnimatedScene, frame: int) -> dict[str, Any]:
    camera = scene.camera(frame)
    return {"to_world": np.asarray(camera.to_world, np.float64).tolist(), "x_fov": float(camera.x_fov)}


def _versions() -> dict[str, str]:
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("mitsuba", "drjit")},
    }


def _check_settings(folder: Path, wanted: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Raise ClipError if the frames in a folder were rendered with other settings."""
    # Frames may be added: what both records say about the same ones is compared.
    common = min(int(found["frames"]), int(wanted["frames"]))
    both = [
        {**record, "plan": _planned(record.get("plan"), common), "draws": record.get("draws", 0)}
        for record in (found, wanted)
    ]
    names = [name for name in wanted if name not in _FREE]
    differing = [line for name in names for line in _differences(name, both[0].get(name), both[1][name])]
    cameras = zip(found.get("cameras", []), wanted["cameras"], strict=False)
    if any(_plain(first) != _plain(second) for first, second in cameras):
        differing.append("another camera path")
    if differing:
        if found["frames"] != wanted["frames"]:
            differing.insert(0, f"{found['frames']} frames there, {wanted['frames']} wanted")
        what = "; ".join(dict.fromkeys(differing))
        raise ClipError(f"{folder}: was rendered with other settings ({what}); choose another folder or remove it.")


def _planned(plan: Mapping[str, Any] | None, frames: int) -> dict[str, Any] | None:
    """What a plan's record says about the first frames; the names of its effects follow from that."""
    known = entries(plan)
    if known is None:
        return None
    cut = {name: known[name][:frames] for name in ("frames", "held") if name in known}
    return {name: value for name, value in known.items() if name != "effects"} | cut


def _differences(name: str, there: Any, wanted: Any) -> list[str]:
    """In words, one for each entry, where two values of a record differ; long ones are not written out."""
    # Compared in the form read from JSON, where tuples have become lists.
    there, wanted = _plain(there), _plain(wanted)
    if there == wanted:
        return []
    if isinstance(there, dict) and isinstance(wanted, dict):
        keys = dict.fromkeys((*wanted, *there))
        return [line for key in keys for line in _differences(f"{name} {key}", there.get(key), wanted.get(key))]
    if name == "plan frames":
        pairs = ((index, set(old), set(new)) for index, (old, new) in enumerate(zip(there, wanted, strict=True)))
        index, old, new = next((index, old, new) for index, old, new in pairs if old != new)
        lists = (", ".join(sorted(buffers)) or "no more" for buffers in (old - new, new - old))
        return ["buffers of frame {}: {} there, {} wanted".format(index, *lists)]
    name = name.removeprefix("plan ")
    if len(f"{there}{wanted}") > 120:
        return [f"{name} differs"]
    return [f"{name}: {there} there, {wanted} wanted"]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


def _is_whole(path: Path) -> bool:
    if not path.exists():
        return False
    try:
        read_frame(path)
    except ClipError:
        return False
    return True
