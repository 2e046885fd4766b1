"""Which clips there are: kinds, sets, their seeds, and what must never be trained on."""

import random
from collections.abc import Iterator
from typing import NamedTuple

KINDS = (
    "lamps",
    "sun",
    "glass",
    "metal",
    "textures",
    "bump",
    "hair",
    "leaves",
    "fog",
    "defocus",
    "blur",
    "screens",
    "walker",
    "switch",
    "cut",
    "ball",
)
"""Modules of :mod:`experiments.cycles.kinds`."""

HELD_OUT = ("leaves", "ball")
"""Kinds that nothing is trained on or chosen by: they measure what a denoiser makes of sights it has not met.

What makes them hard occurs elsewhere in training, so that they are a fair test: first hits that are random within the
pixel (hair, thin focus, motion blur), shadows and shading that move (a walker, a switch). The sights themselves, lacy
cut-outs and a contact shadow under a rolling ball, do not. Fog is trained on: nothing else in Cycles has a volume.
"""

SEEDS = {"train": range(0, 8000), "validation": range(8000, 9000), "test": range(9000, 10000)}
"""The seeds of each set. They do not overlap, and a seed draws everything in a scene."""

LARGE = range(9900, 10000)
"""Test seeds that are rendered at 1280x720 instead of 320x180."""

WINDOW = (160, 128)
"""Width and height of what is rendered of a training clip: a denoiser is trained on crops, and scenes count more than
pixels."""


class Window(NamedTuple):
    """The pixels of a picture that are rendered: columns from ``left`` on, rows from ``top`` on."""

    left: int
    top: int
    width: int
    height: int


class Clip(NamedTuple):
    """One clip: its set, kind and seed."""

    set: str
    kind: str
    seed: int

    @property
    def name(self) -> str:
        """The folder of the clip within its set's folder."""
        return f"{self.kind}-{self.seed:04d}"

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the whole picture, in pixels."""
        if self.set == "train":
            return (640, 360) if self._draw().random() < 0.5 else (320, 180)
        return (1280, 720) if self.seed in LARGE else (320, 180)

    @property
    def window(self) -> Window:
        """What is rendered of the picture: a place at random in training, else all of it."""
        (width, height), random_place = self.size, self._draw()
        if self.set != "train":
            return Window(0, 0, width, height)
        random_place.random()  # the size took the first number
        left, top = (random_place.randrange(whole - part + 1) for whole, part in zip(self.size, WINDOW, strict=True))
        return Window(left, top, *WINDOW)

    @property
    def frames(self) -> int:
        """Frames of the clip. Fewer in training: more scenes an hour."""
        return 10 if self.set == "train" else 24

    def _draw(self) -> random.Random:
        """Random numbers of this clip alone."""
        return random.Random(f"{self.set} {self.kind} {self.seed}")

    @property
    def pixel_filter(self) -> tuple[str, float]:
        """Cycles' pixel filter and its width in pixels; half of the clips of a set, and of a kind, have each."""
        wide = (self.seed + KINDS.index(self.kind)) % 2
        return ("BLACKMAN_HARRIS", 1.5) if wide else ("BOX", 1.0)


def clip(name: str, kind: str, seed: int) -> Clip:
    """A clip of a set, checked: ``ValueError`` where no such clip may be made."""
    if name not in SEEDS:
        raise ValueError(f"expected a set of {', '.join(SEEDS)}, got {name!r}")
    if kind not in KINDS:
        raise ValueError(f"expected a kind of {', '.join(KINDS)}, got {kind!r}")
    if seed not in SEEDS[name]:
        seeds = SEEDS[name]
        raise ValueError(f"seeds of the {name} set are {seeds.start} to {seeds.stop - 1}, got {seed}")
    if kind in HELD_OUT and name != "test":
        raise ValueError(f"clips of the kind {kind!r} are for tests only: nothing may be trained on or chosen by them")
    return Clip(name, kind, seed)


def kinds_of(name: str) -> tuple[str, ...]:
    """The kinds that a set may have."""
    return tuple(kind for kind in KINDS if name == "test" or kind not in HELD_OUT)


def rounds(name: str, kinds: tuple[str, ...], seeds: range | None = None) -> Iterator[list[Clip]]:
    """The clips of a set, one of each kind a round: any number of rounds is balanced."""
    for kind in kinds:
        clip(name, kind, SEEDS[name].start)
    for seed in SEEDS[name] if seeds is None else seeds:
        yield [clip(name, kind, seed) for kind in kinds]
