"""What is rendered of a clip, in steps of rising cost, and the order in which clips and steps come."""

from collections.abc import Iterator
from itertools import chain, islice
from typing import NamedTuple

from experiments.cycles.sets import LARGE, Clip, clip, kinds_of, rounds


class Draw(NamedTuple):
    """Noisy frames: of ``samples`` a pixel, ``images`` of independent noise each, of the first ``frames`` of a clip."""

    samples: int
    images: int = 1
    frames: int = 24


class Level(NamedTuple):
    """What a clip has when a step is done.

    ``reference_frames``: the frames that have references (numbers from 1), all if empty. ``decibels``: the PSNR of a
    reference's own noise, of x / (1 + x), at which it is good enough; ``seconds``: the processor time after which a
    frame's reference is left as it is.
    """

    draws: tuple[Draw, ...]
    reference_frames: tuple[int, ...]
    decibels: float
    seconds: float


SOME = (5, 6, 14, 15, 23, 24)
"""Pairs of frames, for temporal errors: early, after the middle (where lights switch and shots are cut), late."""
FEW = tuple(Draw(samples, frames=15) for samples in (1, 4, 16))
MANY = tuple(Draw(samples) for samples in (1, 4, 16, 64))
"""The noisy frames of coarse steps, and of those that refine them."""

LEVELS = {
    "train": (Level((Draw(1, 2), Draw(4), Draw(16)), (), 42.0, 6.0),),
    "validation": (Level(MANY[:3], SOME, 52.0, 90.0),),
    "test": (
        Level(FEW, SOME[:4], 52.0, 30.0),
        Level((*FEW, Draw(64, frames=6)), SOME[:4], 52.0, 30.0),
        Level(MANY, SOME, 58.0, 900.0),
        Level(MANY, (), 58.0, 900.0),
    ),
}
"""The steps of a set's clips, each having what the one before it has."""

LARGE_LEVELS = (
    Level(tuple(Draw(samples, frames=6) for samples in (1, 4, 16)), SOME[:2], 50.0, 600.0),
    Level(MANY[:3], SOME, 50.0, 900.0),
    Level(MANY, SOME, 56.0, 3600.0),
)
"""The steps of a clip of 1280x720: sixteen times the pixels."""

TRAIN_CLIPS_BETWEEN = 6
"""Training clips that come between two steps that refine the test set."""


class Step(NamedTuple):
    """A clip and how far to bring it."""

    clip: Clip
    level: int


def levels(of: Clip) -> tuple[Level, ...]:
    """The steps of a clip."""
    return LARGE_LEVELS if of.seed in LARGE else LEVELS[of.set]


def steps(sets: tuple[str, ...], kinds: tuple[str, ...] = (), seeds: range | None = None) -> Iterator[Step]:
    """All steps in their order.

    First one test clip of each kind, coarsely; then a training clip of each kind, and a validation clip. After that
    training clips, with one step of the rest of the test and validation sets after every six.
    """
    training = _clips("train", sets, kinds, seeds)
    testing = _testing(sets, kinds, seeds)
    validation = (Step(one, 0) for one in _clips("validation", sets, kinds, seeds))
    some = {name: len(_chosen(name, kinds)) if name in sets else 0 for name in ("train", "validation", "test")}
    yield from islice(testing, some["test"])
    yield from (Step(one, 0) for one in islice(training, some["train"]))
    yield from islice(validation, some["validation"])
    refining = chain(testing, validation)
    while True:
        batch = [Step(one, 0) for one in islice(training, TRAIN_CLIPS_BETWEEN)]
        batch += islice(refining, 1)
        if not batch:
            return
        yield from batch


def _chosen(name: str, kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The kinds asked for, or all that a set may have."""
    return kinds or kinds_of(name)


def _clips(name: str, sets: tuple[str, ...], kinds: tuple[str, ...], seeds: range | None) -> Iterator[Clip]:
    if name not in sets:
        return iter(())
    return chain.from_iterable(rounds(name, _chosen(name, kinds), seeds))


def _testing(sets: tuple[str, ...], kinds: tuple[str, ...], seeds: range | None) -> Iterator[Step]:
    """Test clips: a round coarsely, then finer, then two large ones, then all frames; then the next seeds likewise."""
    if "test" not in sets:
        return
    for number, row in enumerate(rounds("test", _chosen("test", kinds), seeds)):
        small = [one for one in row if one.seed not in LARGE]
        yield from (Step(one, level) for level in (0, 1, 2) for one in small)
        if seeds is not None:
            large = [one for one in row if one.seed in LARGE]
            yield from (Step(one, level) for level in range(len(LARGE_LEVELS)) for one in large)
        elif number == 0:
            large = [clip("test", kind, LARGE.start) for kind in ("lamps", "sun") if kind in _chosen("test", kinds)]
            yield from (Step(one, 0) for one in large)
        yield from (Step(one, 3) for one in small)
