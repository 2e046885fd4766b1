"""The eight symmetries of a square, applied to a clip: what makes many clips out of one.

A symmetry moves pixels *and* turns the vectors that live in the image plane: flipping the image left to right negates
the x component of ``motion`` and ``dual_motion``, a quarter turn exchanges the components. Then warping a transformed
history with transformed motion gives the transformed warped image, exactly.

World-space normals stay as they are (only view-space ones would have to change; Hasselgren et al. 2020, sec. 2.2). For
a quarter turn this is exact physics: the camera rolled, the world did not. A flipped image shows the mirrored world
described in mirrored axes, in which a normal's numbers are the same; a denoiser cannot depend on which way the world's
axes point, as every camera sees them differently.
"""

from typing import Any

import numpy as np

from jaxdn.frame import Clip, Frame

_IN_PLANE = ("motion", "dual_motion")


def transform_image(image: np.ndarray, *, flip: bool, turns: int) -> np.ndarray:
    """An image ``[..., H, W, C]`` mirrored left to right if ``flip``, then turned ``turns`` quarters anticlockwise."""
    image = image[..., ::-1, :] if flip else image
    return np.rot90(image, turns % 4, axes=(-3, -2))


def transform_motion(motion: np.ndarray, *, flip: bool, turns: int) -> np.ndarray:
    """Motion vectors ``[..., H, W, 2]`` (x right, y down) under the same symmetry as :func:`transform_image`."""
    moved = transform_image(motion, flip=flip, turns=turns)
    x, y = moved[..., 0], moved[..., 1]
    x = -x if flip else x
    # A quarter turn anticlockwise, with y pointing down, takes the vector (x, y) to (y, -x).
    x, y = [(x, y), (y, -x), (-x, -y), (-y, x)][turns % 4]
    return np.stack([x, y], axis=-1)


def transform_clip(clip: Clip, *, flip: bool, turns: int) -> Clip:
    """Every buffer of a clip, and its reference, under one symmetry; buffers that are ``None`` stay so."""

    def transform(name: str, buffer: Any) -> Any:
        if buffer is None:
            return None
        return (transform_motion if name in _IN_PLANE else transform_image)(buffer, flip=flip, turns=turns)

    frames = Frame(**{name: transform(name, buffer) for name, buffer in clip.frames._asdict().items()})
    return Clip(frames, transform("reference", clip.reference))
