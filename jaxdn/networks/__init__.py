"""The networks: each is an ``init`` and an ``apply`` on plain nested dicts.

Flax is imported by the modules of this room and by nothing else; what a denoiser must know beforehand stands here.
"""

LEVELS = 5
MULTIPLE = 2 ** (LEVELS - 1)
"""Height and width that the network takes are multiples of this."""

Widths = tuple[tuple[int, ...], ...]

LARGE: Widths = ((32, 32), (64, 64), (64, 64), (80, 80), (96, 96))
"""Channels of each convolution, level by level from full resolution down; the decoder mirrors the first four."""

SMALL: Widths = ((16,), (32, 32), (48, 48), (64, 64), (64, 64))
"""About a third of LARGE's time. Most of LARGE's time is its full resolution, so that is where SMALL saves."""
