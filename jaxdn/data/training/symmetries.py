"""The eight symmetries of a square, applied to a clip: data augmentation.

A symmetry moves pixels *and* turns the vectors that live in the image plane, which are the buffers of the kind
"vector" (:data:`jaxdn.core.frame.BUFFERS`): flipping the image left to right negates their x component, a quarter turn
exchanges the components. Then warping a transformed history with transformed motion gives the transformed warped image,
exactly.

World-space normals stay as they are (only view-space ones would have to change; Hasselgren et al. 2020, sec. 2.2). For
a quarter turn this is exact physics: the camera rolled, the world did not. A flipped image shows the mirrored world
described in mirrored axes, in which a normal's numbers are the same; a denoiser cannot depend on which way the world's
axes point, as every camera sees them differently.
"""

from typing import Any

import jax
import numpy as np

from jaxdn.core.frame import BUFFERS, Clip, Frame


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
    """Every buffer of a clip, its reference and its layers under one symmetry; ``None`` stays ``None``."""

    def moved(images: Any) -> Any:
        return jax.tree.map(lambda image: transform_image(image, flip=flip, turns=turns), images)

    frames = Frame(
        **{
            name: transform_motion(buffer, flip=flip, turns=turns) if BUFFERS[name].kind == "vector" else moved(buffer)
            for name, buffer in clip.frames._asdict().items()
            if buffer is not None
        }
    )
    return Clip(frames, moved(clip.reference), moved(clip.layers))
