"""What light is divided by before it is filtered: the albedo, what surfaces reflect, or nothing.

``python -m experiments.papers.demodulation SCENE.xml ...`` renders each scene (and three small rooms) at 160x90 from a
camera at rest, 1 sample a pixel for :data:`FRAMES` frames, and prints the PSNR of svgf's last two frames for each way
of dividing (:func:`ways`). Errors are free of the reference's own noise (:func:`jaxdn.metrics.unbiased_psnr`).
"""

import functools
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.speed.small_rooms import CASES
from jaxdn import brdf, color, metrics
from jaxdn.core.frame import Clip, Frame
from jaxdn.denoiser.rollout import denoise
from jaxdn.denoisers import svgf

WIDTH, HEIGHT, FRAMES, REFERENCE = 160, 90, 5, 256
ROOMS = ("a ball: textured roughness", "a ball: smooth plastic", "static textured box")

Divisor = Callable[[Frame], Any]


def _square(reflectance: Any, floor: float) -> Any:
    """A softer knee than :func:`jaxdn.brdf.divisor`'s."""
    return jnp.sqrt(reflectance**2 + floor**2)


def _divisor(frame: Frame, *, buffer: str, floor: float) -> Any:
    return brdf.divisor(getattr(frame, buffer), floor=floor)


def ways() -> dict[str, Divisor]:
    """Name -> what a frame's radiance is divided by."""
    found: dict[str, Divisor] = {
        "nothing": lambda frame: jnp.ones(()),
        "albedo > 0.01": lambda frame: jnp.where(frame.albedo > 0.01, frame.albedo, 1.0),
        "max(albedo, 0.2)": lambda frame: jnp.maximum(frame.albedo, 0.2),
    }
    for name, buffer in (("albedo", "albedo"), ("F_b", "reflectance")):
        for floor in (0.04, 0.15):
            found[f"{name}, {floor}"] = functools.partial(_divisor, buffer=buffer, floor=floor)
    found["F_b, 0.04, soft"] = lambda frame: _square(frame.reflectance, 0.04)
    return found


def clip_of(path: Path) -> tuple[Clip, np.ndarray]:
    """Frames of a scene at rest, with other noise each; its reference, and the first half of that."""
    from jaxdn.render.frame import render_frame
    from jaxdn.render.opening import open_scene

    scene = open_scene(str(path))
    first = render_frame(scene, 0, width=WIDTH, height=HEIGHT, reference_spp=REFERENCE)
    rest = [render_frame(scene, 0, width=WIDTH, height=HEIGHT, seed=at).frame for at in range(1, FRAMES)]
    frames = jax.tree.map(lambda *buffers: np.stack(buffers), first.frame, *rest)
    assert first.reference is not None
    assert first.reference_half is not None
    return Clip(frames, first.reference), first.reference_half


def score(image: Any, first: Any, second: Any) -> float:
    """PSNR in dB of tone-mapped light, without the noise of the reference's two halves."""
    return float(metrics.unbiased_psnr(color.tonemap(jnp.asarray(image)), *color.tonemap_halves(first, second)))


def scenes(paths: list[str]) -> Iterator[tuple[str, Clip, np.ndarray]]:
    for path in paths:
        yield Path(path).parent.name, *clip_of(Path(path))
    for name in ROOMS:
        with tempfile.TemporaryDirectory() as folder:
            yield name, *clip_of(CASES[name].write(Path(folder)))


def main() -> None:
    plain = svgf(demodulate="none")
    run = jax.jit(lambda clip: denoise(plain, {}, clip))
    print(f"| scene | {' | '.join(ways())} |\n|{'---|' * (1 + len(ways()))}")
    for name, clip, half in scenes(sys.argv[1:]):
        other = np.maximum(2 * np.asarray(clip.reference) - half, 0)
        row = []
        for divisor in ways().values():
            by = divisor(clip.frames)
            image = run(Clip(clip.frames._replace(radiance=clip.frames.radiance / by, albedo=None))) * by
            row.append(np.mean([score(image[at], half, other) for at in (-2, -1)]))
        print(f"| {name} | {' | '.join(f'{value:.2f}' for value in row)} |", flush=True)


if __name__ == "__main__":
    main()
