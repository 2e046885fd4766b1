"""``jaxdn denoise``: a noisy clip in, denoised EXR frames out, one frame at a time."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxdn import color
from jaxdn.clips.exr import write_exr
from jaxdn.clips.folder import frame_path, is_clip, read_frames, read_record
from jaxdn.clips.import_exr import read_plain_frames, sequence_files
from jaxdn.commands.compare import Method, method_named
from jaxdn.frame import RADIANCE_MAX, Frame, only
from jaxdn.networks import onnx
from jaxdn.report.images import save_png
from jaxdn.weights import describe


class Written(NamedTuple):
    """What was denoised."""

    files: list[Path]
    programs: int
    """Steps that were compiled: one for each set of buffers that some frame has."""


def method_on(name: str, implementation: str = "auto") -> tuple[Method, str]:
    """The method of that name on an engine, and the engine's name: "reference" (XLA) or "onnxruntime".

    ``"auto"`` is the faster engine where it can run: on a CPU, installed, for a network that computes in float32.
    Raises ValueError for a name that is no method, and for an engine that cannot run it.
    """
    method = method_named(name)
    if implementation == "auto":
        fits = bool(method.params) and describe(name)["options"].get("compute_dtype") != "bfloat16"
        implementation = "onnxruntime" if fits and onnx.available() else "reference"
    if implementation == "reference":
        return method, implementation
    return method_named(name, implementation=implementation), implementation


def denoise_files(
    source: Path,
    out: Path,
    method: Method,
    *,
    spp: int = 1,
    preview: bool = False,
    motion_convention: str | None = None,
    say: Callable[[int, int], None] = lambda done, total: None,
) -> Written:
    """Denoise a clip's folder, or EXR files of another renderer; returns the files written.

    Each output frame has the channels ``R, G, B``: the denoised radiance with the directly reflected and the emitted
    light of the clip added back (foreign files: the denoised beauty), and ``denoised.R/G/B``, the denoised part alone.
    With ``preview`` a PNG stands beside each. A clip's frames are read, denoised and written one at a time, so that a
    sequence of any length takes the memory of one; a file is there whole or not at all. ``say`` hears (done, total).
    Raises ValueError for input that cannot be read or does not fit together, before the frame concerned is written.
    """
    names, frames = _open(source, spp, motion_convention)
    if out.resolve() in {source.resolve(), *(name.resolve().parent for name in names)}:
        raise ValueError(f"{out}: expected another folder than the input's, whose frames would be overwritten.")
    step, programs = _stepper(method)
    out.mkdir(parents=True, exist_ok=True)
    written = []
    for name, frame in zip(names, frames, strict=True):
        image = step(frame)
        path = out / f"{name.stem}.exr"
        beauty = image + _light(frame.direct) + _light(frame.emission)
        write_exr(path, _channels("", beauty) | _channels("denoised.", image))
        if preview:
            save_png(path.with_suffix(".png"), color.tonemap(beauty))
        written.append(path)
        say(len(written), len(names))
    return Written(written, len(programs))


def _open(source: Path, spp: int, motion_convention: str | None) -> tuple[list[Path], Iterator[Frame]]:
    """The files, and their frames, read when asked for."""
    if is_clip(source):
        names = [frame_path(source, index) for index in range(read_record(source)["frames"])]
        return names, (stored.frame for stored in read_frames(source, spp=spp))
    if spp != 1:
        raise ValueError(f"{source}: expected spp 1, got {spp}; only rendered clips have several sample counts.")
    names = sequence_files(source)
    return names, iter(read_plain_frames(source, motion_convention=motion_convention))


def _stepper(method: Method) -> tuple[Callable[[Frame], np.ndarray], set[tuple[str, ...]]]:
    """A function from one frame to the next denoised one, and the sets of buffers that it was compiled for so far."""
    denoiser = method.denoiser
    programs: set[tuple[str, ...]] = set()
    if denoiser is None:
        return lambda frame: _light(frame.radiance), programs
    run = jax.jit(denoiser.step, donate_argnums=1)
    state: Any = None

    def step(frame: Frame) -> np.ndarray:
        nonlocal state
        inputs = only(frame, denoiser.reads)
        programs.add(tuple(name for name, buffer in inputs._asdict().items() if buffer is not None))
        if state is None:
            state = jax.jit(denoiser.start)(method.params, inputs)
        state, image = run(method.params, state, inputs)
        return np.asarray(image)

    return step, programs


def _light(radiance: np.ndarray | None) -> Any:
    """Radiance fit to be added: not finite or negative becomes 0, an absent part is 0."""
    if radiance is None:
        return 0.0
    good = np.isfinite(radiance) & (np.asarray(radiance) >= 0)
    return np.minimum(np.where(good, radiance, 0.0), RADIANCE_MAX).astype(np.float32)


def _channels(layer: str, image: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{layer}{letter}": np.ascontiguousarray(image[..., i], np.float32) for i, letter in enumerate("RGB")}
