"""What to render, store and compute: only what the scene has *and* the denoiser can use."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxdn.core.frame import GUIDES, ON_REQUEST
from jaxdn.denoiser import Denoiser
from jaxdn.planning.catalogue import (
    DIRECT,
    EFFECTS,
    INDIRECT,
    OF_PRIMARY_SURFACES,
    OF_SHADOWS,
    THROUGH_CENTRES,
    NoisyLight,
)
from jaxdn.planning.detected_effects import Effects

GEOMETRY = frozenset({"albedo", "normal", "depth", "ids"})
"""Buffers that every scene has. A constant albedo is kept too: dividing by it makes scenes similar."""
COMPOSED = frozenset({"direct", "emission"})
"""Buffers that are added to the denoised image, whether or not the denoiser reads them."""
SCORED = frozenset({"visible"})
"""Buffers that errors are reported by, where there is a reference: which pixels the previous frame did not see."""
_ENTRIES = {"shared_with": "held"}
"""Fields of a plan whose entry in a record has another name."""
BOUND = 0.01
"""Largest share of an image's reflected light that limited path lengths may leave out."""


class Plan(NamedTuple):
    """The work of a renderer for one clip."""

    integrator: str
    """Mitsuba's (``path``, ``volpath``), or ``none`` for a scene without light."""
    max_depth: int | None
    """Path length; None: that of the scene."""
    indirect: bool
    """Whether there is anything to denoise: indirect light, or direct light with noise."""
    effects: tuple[str, ...]
    frames: tuple[tuple[str, ...], ...]
    """The buffers of each frame's file, without ``radiance``."""
    shared_with: tuple[int, ...]
    """For each frame the one whose buffers and reference it shares; its own file then stores only the noise."""

    @property
    def buffers(self) -> tuple[str, ...]:
        """The buffers that some frame has."""
        return tuple(name for name in GUIDES if any(name in frame for frame in self.frames))

    def programs(self, reads: frozenset[str] | None = None) -> int:
        """How many steps are compiled: one for each distinct set of buffers (of those in ``reads``)."""
        return len({frozenset(frame) if reads is None else frozenset(frame) & reads for frame in self.frames})

    def record(self) -> dict[str, Any]:
        """The plan as JSON, for ``clip.json`` and ``--json``; :func:`plan_from_record` is the inverse."""
        own = {_ENTRIES.get(name, name): value for name, value in self._asdict().items()}
        frames = [list(frame) for frame in self.frames]
        return own | {"effects": list(self.effects), "frames": frames, "held": list(self.shared_with)}


def plan_from_record(record: Mapping[str, Any]) -> Plan:
    """The plan that :meth:`Plan.record` wrote. Raises ValueError for other entries than it writes."""
    names = {_ENTRIES.get(name, name): name for name in Plan._fields}
    if set(record) != set(names):
        raise ValueError(f"plan: expected the entries {', '.join(names)}, got {', '.join(sorted(record))}.")
    frames = tuple(tuple(frame) for frame in record["frames"])
    tuples = {"effects": tuple(record["effects"]), "frames": frames, "shared_with": tuple(record["held"])}
    return Plan(**{name: record[entry] for entry, name in names.items()} | tuples)


def plan(
    effects: Effects,
    denoiser: Denoiser | None = None,
    *,
    max_depth: int | None = None,
    light: NoisyLight = INDIRECT,
    jitter: bool = False,
    see_through: bool = False,
) -> Plan:
    """The intersection of the effects of a scene and the buffers that a denoiser reads.

    Without a denoiser these are all buffers but those that are rendered on request alone
    (:data:`jaxdn.core.frame.ON_REQUEST`).

    ``max_depth`` is the path length to render with, by default the scene's
    (:func:`jaxdn.render.path_depth.measure_depth` measures it). With ``light="reflected"`` direct light is a part of
    the noisy radiance, and its shadows have buffers, instead of a buffer of its own. With ``jitter`` no frame shows the
    same as another, and what is traced through the centres of pixels (``THROUGH_CENTRES``) is left out. With
    ``see_through`` the guides are those of what mirrors and glass show: what belongs to the first surface
    (``OF_PRIMARY_SURFACES``) is left out, and what moves in a mirror moves on screen.
    """
    by_name = {effect.name: effect for effect in EFFECTS}
    wanted = frozenset(GUIDES) - ON_REQUEST if denoiser is None else denoiser.reads | COMPOSED
    wanted -= {"direct"} if light == "reflected" else OF_SHADOWS
    wanted -= THROUGH_CENTRES if jitter else frozenset()
    wanted -= OF_PRIMARY_SURFACES if see_through else frozenset()
    there = [by_name[name] for name in effects.names]

    def buffers(present: frozenset[str]) -> tuple[str, ...]:
        had = GEOMETRY.union(*(by_name[name].buffers for name in present))
        if see_through:
            had = had.union(*(by_name[name].seen_through for name in present))
        if effects.lit:
            had |= {"direct"}
        return tuple(name for name in GUIDES if name in had & wanted)

    needed = max((effect.depth for effect in there), default=DIRECT)
    depth = effects.max_depth if max_depth is None else max_depth
    asked = [effect.integrator for effect in there if effect.integrator != "path"]
    return Plan(
        integrator="none" if not effects.lit else asked[0] if asked else "path",
        max_depth=depth if needed > DIRECT or depth is None else min(depth, DIRECT),
        indirect=needed > DIRECT or (light == "reflected" and effects.lit),
        effects=effects.names,
        frames=tuple(buffers(present) for present in effects.frames),
        shared_with=tuple(range(len(effects.shared_with))) if jitter else effects.shared_with,
    )
