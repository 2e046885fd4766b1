"""The times at which a frame is seen while its shutter is open, and which sample takes which of them.

Mitsuba moves nothing within a frame, so the scene is built at a few times, evenly from the opening to the closing. They
begin at random in each frame. A pixel's samples take the times in an order that begins at random for each pixel and
spreads any 1, 2, 4 ... consecutive samples evenly over the shutter's time (van der Corput 1935).
"""

import numpy as np

from jaxdn.render.tracing.seeds import SampleStream, make_frame_key, tea

TIMES = 16
"""Times at which the scene of a frame is built; a power of two."""
_SHUTTER = 0x5348
_BITS = TIMES.bit_length() - 1


def list_times(frame: int, shutter: float, seed: int) -> list[float]:
    """The times in frames, with the frame's own in the middle of ``shutter``, which is a number of frames."""
    start = make_frame_key(seed, frame, _SHUTTER)[0] * 2.0**-32
    return [frame + shutter * ((index + start) / TIMES - 0.5) for index in range(TIMES)]


def choose_samples(
    stream: SampleStream, time: int, pixels: int, first: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The samples that see the scene at one of the times: their pixels [n] and their indices [n].

    Of the samples ``first`` to ``first + count`` of ``pixels`` pixels; over all times each of them occurs once.
    """
    key = stream.key()
    every = np.arange(pixels, dtype=np.int64)
    begins = tea(every ^ key[0] ^ _SHUTTER, np.full_like(every, key[1]))[0]
    # Sample s takes the time with the mirrored bits of (s + begin) mod TIMES.
    mirrored = int(format(time, f"0{_BITS}b")[::-1], 2)
    earliest = first + (mirrored - begins - first) % TIMES
    rounds = earliest[:, None] + TIMES * np.arange(-(-count // TIMES))
    pixel, turn = np.nonzero(rounds < first + count)
    return pixel, rounds[pixel, turn]
