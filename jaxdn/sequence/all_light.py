"""All light of a frame of ours as one image, where none of it is without noise.

Through the centre of a pixel goes one ray: what its surface emits has no noise, and so has direct light as the clip
keeps it. Both are left out of what is denoised, and added to the result. Where pixels are filtered, an image's direct
and emitted light are means over its own few samples: at the edge of a lamp, and wherever a lamp is out of focus or
blurred by motion, they are as noisy as the rest, and no result may get them back.
"""

import numpy as np

from jaxdn.core.frame import Array
from jaxdn.data.clip.frames import StoredFrame

BESIDE = ("direct", "emission")
"""The light beside a frame's radiance."""


def gather_light(stored: StoredFrame) -> StoredFrame:
    """The frame with all light as its radiance, and in each of its layers; none is left beside."""
    frame = stored.frame
    light = _add(frame.radiance, [getattr(frame, name) for name in BESIDE])
    layers = {}
    for samples, image in stored.layers.items():
        own = stored.layer_guides.get(samples, frame._asdict())  # of a clip with one layer they are the frame's
        layers[samples] = _add(image, [own.get(name) for name in BESIDE])
    return stored._replace(frame=frame._replace(radiance=light, direct=None, emission=None), layers=layers)


def _add(light: Array, others: list[Array]) -> np.ndarray:
    """The sum of what is there."""
    return np.asarray(sum((other for other in others if other is not None), start=light))
