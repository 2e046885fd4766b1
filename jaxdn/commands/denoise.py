"""``jaxdn denoise``: a noisy clip in, denoised EXR frames out, one frame at a time."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxdn import color
from jaxdn.candidates import Candidate, candidate
from jaxdn.clips.exr import write_exr
from jaxdn.clips.folder import open_frames
from jaxdn.clips.frames import StoredFrame, doubling_layers
from jaxdn.repair import repair_image
from jaxdn.report.images import save_png
from jaxdn.rollout import Layers, stream


class Written(NamedTuple):
    """What was denoised."""

    files: list[Path]
    programs: int
    """Steps that were compiled: one for each distinct set of buffers among the frames."""
    repaired: int
    """Invalid values (NaN, infinite, negative ...) of frames and histories that were replaced."""


def candidate_on(name: str, implementation: str = "auto") -> tuple[Candidate, str]:
    """The candidate of that name on an engine, and the engine's name; "reference" is XLA.

    ``"auto"`` is the fastest engine for inference that the method has and that can run here. Raises ValueError for a
    name that is not a method, and for an engine that cannot run it.
    """
    found = candidate(name)
    known = found.method is not None and found.method.knows("implementation")
    if implementation == "auto":
        engine = found.engine("inference")
        return (found, "reference") if engine is None else (candidate(name, implementation=engine), engine)
    if implementation == "reference" and not known:
        return found, implementation
    return candidate(name, implementation=implementation), implementation


def denoise_files(
    source: Path,
    out: Path,
    method: Candidate,
    *,
    spp: int = 1,
    preview: bool = False,
    motion_convention: str | None = None,
    channels: Mapping[str, str] | None = None,
    layer: str | None = None,
    say: Callable[[int, int], None] = lambda done, total: None,
    log: Callable[[str], None] = lambda line: None,
) -> Written:
    """Denoise a clip's folder, or EXR files of another renderer; returns the files written.

    Each output frame has the channels ``R, G, B``: the denoised radiance with the directly reflected and the emitted
    light of the clip added back (files of other renderers: the denoised beauty), and ``denoised.R/G/B``, the denoised
    part alone. Frames are read, denoised and written one at a time, so that a sequence of any length takes the memory
    of one. Files are never left incomplete. Raises ValueError for input that cannot be read or is inconsistent, before
    the frame concerned is written.

    Args:
      source: folder of a clip; or a folder of, or a pattern for, EXR files.
      out: folder for the denoised frames; of a single frame, also the name of an EXR file.
      method: the denoiser.
      spp: samples per pixel to take from a clip's layers.
      preview: write a PNG next to each frame.
      motion_convention: that of motion vectors in files of other renderers (:mod:`jaxdn.clips.import_exr`).
      channels: buffer -> layer to take it from in files of other renderers.
      layer: view layer or part to look for the other buffers in.
      say: called with the number of frames done and the total.
      log: called with lines about what is derived from files of other renderers, or left unused.
    """
    single = out.suffix.lower() == ".exr"
    needs_layers = method.denoiser is not None and method.denoiser.samples is not None
    names, stored = open_frames(
        source, spp=spp, motion_convention=motion_convention, channels=channels, layer=layer, log=log
    )
    frames = ((one.frame, _layers(one, source) if needs_layers else None) for one in stored)
    if single and len(names) > 1:
        raise ValueError(f"{out}: expected a folder for {len(names)} frames, got the name of one EXR file.")
    if out.resolve() in {
        source.resolve(),
        *(place for name in names for place in (name.resolve(), name.resolve().parent)),
    }:
        raise ValueError(f"{out}: expected another place than the input's, whose frames would be overwritten.")
    step = None if method.denoiser is None else stream(method.denoiser, method.params)
    (out.parent if single else out).mkdir(parents=True, exist_ok=True)
    written = []
    for name, (frame, layers) in zip(names, frames, strict=True):
        image = _light(frame.radiance) if step is None else np.asarray(step(frame, layers))
        path = out if single else out / f"{name.stem}.exr"
        beauty = image + _light(frame.direct) + _light(frame.emission)
        write_exr(path, _channels("", beauty) | _channels("denoised.", image))
        if preview:
            save_png(path.with_suffix(".png"), color.tonemap(beauty))
        written.append(path)
        say(len(written), len(names))
    return Written(written, 0 if step is None else len(step.programs), 0 if step is None else step.repaired)


def _layers(stored: StoredFrame, source: Path) -> Layers:
    """The independent layers of a frame, for a method that requests samples."""
    return {count: stored.layers[count] for count in doubling_layers(stored.layers, source)}


def _light(radiance: np.ndarray | None) -> Any:
    """Radiance that can be added: non-finite or negative values become 0, an absent part is 0."""
    return 0.0 if radiance is None else np.asarray(repair_image(radiance), np.float32)


def _channels(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{layer}{letter}": np.ascontiguousarray(image[..., i], np.float32) for i, letter in enumerate("RGB")}
