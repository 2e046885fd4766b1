"""The networks: each is an ``init`` and an ``apply`` on plain nested dicts.

Only modules of this package import Flax; what a denoiser needs before it builds a network is defined here.
"""

LEVELS = 5
MULTIPLE = 2 ** (LEVELS - 1)
"""Height and width of the network's input are multiples of this."""

Widths = tuple[tuple[int, ...], ...]

LARGE: Widths = ((32, 32), (64, 64), (64, 64), (80, 80), (96, 96))
"""Channels of each convolution, level by level from full resolution down; the decoder mirrors the first four."""

SMALL: Widths = ((16,), (32, 32), (48, 48), (64, 64), (64, 64))
"""About a third of LARGE's time. LARGE spends most time at full resolution, so SMALL is reduced there."""
