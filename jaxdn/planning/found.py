"""Which effects a scene has, frame by frame, and why."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from jaxdn.planning.catalogue import EFFECTS, NAMES
from jaxdn.planning.facts import Facts

IN_TIME = frozenset(effect.name for effect in EFFECTS if effect.in_time)


@dataclass(frozen=True)
class Effects:
    """The effects of a clip. ``"glossy" in effects`` tests for one; iteration gives the names in a fixed order."""

    names: tuple[str, ...]
    """Effects present in some frame."""
    why: Mapping[str, str]
    """Effect -> the reason, in the first frame that has it."""
    uncertain: Mapping[str, str]
    """Effect -> why it could not be decided; it counts as present."""
    frames: tuple[frozenset[str], ...]
    """The effects of every frame. The first frame takes those that concern two frames from the second: nothing has
    moved yet, but it would otherwise need a separately compiled step in nearly every clip."""
    held: tuple[int, ...]
    """For every frame the earliest one that shows the same, except for the noise: nothing moved or changed since."""
    lit: bool = True
    """The scene has any light."""
    max_depth: int | None = None
    """The path length that the scene itself specifies."""

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def find(facts: Facts) -> Effects:
    """The effects that follow from facts. Raises ValueError for facts without a frame."""
    if not facts.moments:
        raise ValueError("facts: expected at least one frame, got none.")
    why: dict[str, str] = {}
    frames: list[frozenset[str]] = []
    for moment in facts.moments:
        present = set(facts.uncertain)
        for effect in EFFECTS:
            reason = effect.found(facts, moment)
            if reason:
                present.add(effect.name)
                why.setdefault(effect.name, reason)
        frames.append(frozenset(present))
    held: list[int] = []
    for index, present_now in enumerate(frames):
        held.append(held[-1] if index and not present_now & IN_TIME else index)
    if len(frames) > 1:
        frames[0] = (frames[0] - IN_TIME) | (frames[1] & IN_TIME)
    why |= {name: why.get(name, "it could not be ruled out") for name in facts.uncertain}
    names = tuple(name for name in NAMES if name in why)
    return Effects(names, why, facts.uncertain, tuple(frames), tuple(held), bool(facts.lights), facts.max_depth)


def chosen(names: Iterable[str], frames: int) -> Effects:
    """Only the named effects, in every frame. Raises ValueError for an unknown name, listing the known ones."""
    wanted = set(names)
    unknown = sorted(wanted - set(NAMES))
    if unknown:
        raise ValueError(f"effects: unknown {', '.join(map(repr, unknown))}; expected auto, all or {', '.join(NAMES)}.")
    still = not wanted & IN_TIME
    return Effects(
        tuple(name for name in NAMES if name in wanted),
        dict.fromkeys(wanted, "requested"),
        {},
        (frozenset(wanted),) * frames,
        (0,) * frames if still else tuple(range(frames)),
    )


def everything(frames: int) -> Effects:
    """Every effect in every frame: rendering without inspection."""
    return chosen(NAMES, frames)
