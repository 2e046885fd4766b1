"""Which effects a scene has, frame by frame, and why."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

from jaxdn.planning.catalogue import EFFECTS, NAMES
from jaxdn.planning.scene_properties import SceneProperties

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
    shared_with: tuple[int, ...]
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


def detect_effects(scene: SceneProperties) -> Effects:
    """Detect the effects of a scene from its properties. Raises ValueError for properties without a frame."""
    if not scene.moments:
        raise ValueError("scene properties: expected at least one frame, got none.")
    why: dict[str, str] = {}
    frames: list[frozenset[str]] = []
    for moment in scene.moments:
        present = set(scene.uncertain)
        for effect in EFFECTS:
            reason = effect.detect(scene, moment)
            if reason:
                present.add(effect.name)
                why.setdefault(effect.name, reason)
        frames.append(frozenset(present))
    shared_with: list[int] = []
    for index, present_now in enumerate(frames):
        shared_with.append(shared_with[-1] if index and not present_now & IN_TIME else index)
    if len(frames) > 1:
        frames[0] = (frames[0] - IN_TIME) | (frames[1] & IN_TIME)
    why |= {name: why.get(name, "it could not be ruled out") for name in scene.uncertain}
    names = tuple(name for name in NAMES if name in why)
    return Effects(names, why, scene.uncertain, tuple(frames), tuple(shared_with), bool(scene.lights), scene.max_depth)


def choose_effects(names: Iterable[str], frames: int) -> Effects:
    """Only the named effects, in every frame. Raises ValueError for an unknown name, listing the known ones.

    No frame shares what another shows: that the effects of motion are not chosen does not say that nothing moves.
    """
    wanted = set(names)
    unknown = sorted(wanted - set(NAMES))
    if unknown:
        raise ValueError(f"effects: unknown {', '.join(map(repr, unknown))}; expected auto, all or {', '.join(NAMES)}.")
    return Effects(
        tuple(name for name in NAMES if name in wanted),
        dict.fromkeys(wanted, "requested"),
        {},
        (frozenset(wanted),) * frames,
        tuple(range(frames)),
    )


def choose_all_effects(frames: int) -> Effects:
    """Every effect in every frame, whatever the scene is."""
    return choose_effects(NAMES, frames)
