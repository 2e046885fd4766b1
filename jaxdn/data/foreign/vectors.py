"""Motion vectors of other programs: their conventions, and the dual ones that Cycles' files allow.

Motion vectors differ in direction, unit and axes from one program to the next, and nothing in a file says which: unless
the layer is Cycles' own four-component ``Vector``, the caller says so.
"""

from collections.abc import Collection, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from jaxdn.data.errors import ClipError
from jaxdn.data.foreign.layers import Channels, last_name
from jaxdn.ops.motion import dual_motion, occlusion_mask

CYCLES = "cycles"
MOTION_CONVENTIONS: dict[str, str] = {
    "previous-current": "pixels, previous minus current position, y down (ours; NTASD, Zeng et al., SVGF)",
    "current-previous": "pixels, current minus previous position, y down (OptiX flow)",
    CYCLES: "pixels, previous minus current position, y up (Blender's Vector pass, first two components)",
    "forward-up": "pixels, current minus previous position, y up (forward vectors for 2-D motion blur in compositing)",
    "uv": "fractions of the image, previous minus current, y down (Falcor, NRD, DLSS scaled to [-1, 1])",
    "ndc": "clip space [-1, 1], previous minus current, y up",
    "rows-columns": "pixels, previous minus current, (row, column) order (Noisebase)",
}
"""What the numbers may mean, in words."""
CHOICES = {**MOTION_CONVENTIONS, "none": "leave the motion out"}
"""What ``motion_convention`` may be, in words."""


class UnknownMotion(ClipError):
    """Motion vectors whose convention nobody has stated."""


def convert_motion(motion: np.ndarray, convention: str) -> np.ndarray:
    """Motion vectors ``[H, W, 2]`` of one of ``MOTION_CONVENTIONS`` in ours. Raises ClipError for another name."""
    height, width = motion.shape[:2]
    if convention == "rows-columns":
        return motion[..., ::-1]
    scales: dict[str, tuple[float, float]] = {
        "previous-current": (1, 1),
        "current-previous": (-1, -1),
        CYCLES: (1, -1),
        "forward-up": (-1, 1),
        "uv": (width, height),
        "ndc": (width / 2, -height / 2),
    }
    if convention not in scales:
        raise ClipError(f"--motion-convention: expected one of the names below, got {convention!r}.\n{conventions()}")
    return motion * np.asarray(scales[convention], motion.dtype)


def conventions() -> str:
    """What ``motion_convention`` may be, each on a line of its own."""
    return "\n".join(f"  {name:<18}{meaning}" for name, meaning in CHOICES.items())


def check_convention(stated: str | None) -> None:
    """Raise ClipError, listing the known ones, for a ``motion_convention`` that is none of them, "none" or None."""
    if stated is not None and stated not in CHOICES:
        raise ClipError(f"--motion-convention: expected one of the names below, got {stated!r}.\n{conventions()}")


def find_motion_convention(
    buffers: Mapping[str, Channels], names: Collection[str], stated: str | None, *, single: bool = False
) -> str | None:
    """The convention of the motion vectors among a file's channels; None where there are none, or none are wanted.

    Raises UnknownMotion where nobody has stated it and the names do not tell; of a ``single`` image, it is None.
    """
    if "motion" not in buffers or stated == "none":
        return None
    if stated is not None:
        return stated
    if _is_cycles_vector(buffers["motion"], names):
        return CYCLES
    if single:
        return None
    raise UnknownMotion(
        f"{', '.join(buffers['motion'])}: nothing in the file says what they mean; state --motion-convention NAME, "
        f"one of these:\n{conventions()}"
    )


def contradicts_cycles(buffers: Mapping[str, Channels], names: Collection[str], convention: str | None) -> bool:
    """Whether another convention was stated for what has the name and the four components of Cycles' ``Vector``."""
    return convention not in (None, CYCLES) and _is_cycles_vector(buffers["motion"], names)


def forward_channels(
    buffers: Mapping[str, Channels], names: Collection[str], convention: str | None
) -> Channels | None:
    """The last two components of Cycles' ``Vector``; None if the motion is anything else."""
    if convention != CYCLES or not _is_cycles_vector(buffers["motion"], names):
        return None
    layer = buffers["motion"][0].rpartition(".")[0]
    return f"{layer}.Z", f"{layer}.W"


def convert_cycles_forward(vectors: np.ndarray) -> np.ndarray:
    """Displacement [H, W, 2] to the next frame, in our axes, from the last two components of Cycles' ``Vector``.

    They are the current position minus the next one, y up: the difference the other way round than in the first two.
    """
    return -convert_motion(vectors.astype(np.float32), CYCLES)


def derive_dual_motion(motion: np.ndarray, forward: np.ndarray | None) -> np.ndarray:
    """Dual motion vectors [H, W, 2] of a frame, from its motion and the forward displacement in the frame before.

    Where both describe the same movement to within half a pixel, the point was seen in the previous frame, or it does
    not matter that it was not: the motion itself. Without a frame before (None), everywhere.
    """
    if forward is None:
        return motion
    return np.asarray(_dual(motion, forward))


@jax.jit
def _dual(motion: jax.Array, forward: jax.Array) -> jax.Array:
    dual = dual_motion(motion, forward)
    return jnp.where(occlusion_mask(motion, dual) > 0, dual, motion)


def _is_cycles_vector(motion: Channels, names: Collection[str]) -> bool:
    layer = motion[0].rpartition(".")[0]
    return last_name(motion) == "vector" and all(f"{layer}.{component}" in names for component in "XYZW")
