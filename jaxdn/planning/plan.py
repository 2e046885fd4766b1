"""What to render, store and compute: what the scene has *and* the denoiser can use, and nothing else."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from jaxdn.denoiser import Denoiser
from jaxdn.frame import Frame
from jaxdn.planning.catalogue import EFFECTS
from jaxdn.planning.found import Effects

GEOMETRY = frozenset({"albedo", "normal", "depth", "ids"})
"""Buffers that every scene has. A constant albedo is still one: dividing by it is what makes rooms alike."""
COMPOSED = frozenset({"direct", "emission"})
"""Buffers that no denoiser need read: they are added to its image."""
BOUND = 0.01
"""Share of a picture's reflected light that may be missing when paths end."""


class Plan(NamedTuple):
    """What a renderer has to do for one clip."""

    integrator: str
    """``path``, ``volpath`` for media, or ``none`` where there is no light at all."""
    max_depth: int | None
    """Path length; None leaves it to the scene."""
    bound: float | None
    """The share of light that longer paths may add, where ``max_depth`` was measured."""
    remaining: float | None
    """The share that they would add, as measured: above the bound where the scene's own limit is shorter."""
    motion: str
    """``none``, ``traditional`` or ``dual``."""
    lobes_apart: bool
    """Whether diffuse and specular light are kept apart: once a denoiser reads ``specular``."""
    gradient_samples: bool
    """Whether samples of the frame before are traced again: once a denoiser reads ``gradient``."""
    demodulation: str
    """``albedo`` where dividing by it pays, ``none`` where it is one colour a surface at most."""
    indirect: bool
    """Whether there is anything to denoise."""
    effects: tuple[str, ...]
    frames: tuple[tuple[str, ...], ...]
    """The buffers of each frame's file besides ``radiance``."""
    held: tuple[int, ...]
    """For each frame the one whose buffers and reference it shares; its own file then holds the noise alone."""

    @property
    def buffers(self) -> tuple[str, ...]:
        """The buffers that some frame has."""
        return tuple(name for name in Frame._fields if any(name in frame for frame in self.frames))

    def programs(self, reads: frozenset[str] | None = None) -> int:
        """How many steps have to be compiled: one for each distinct set of buffers (of those in ``reads``)."""
        return len({frozenset(frame) if reads is None else frozenset(frame) & reads for frame in self.frames})

    def record(self) -> dict[str, Any]:
        """The plan as JSON, for ``clip.json`` and ``--json``; :func:`plan_from_record` is the way back."""
        return {
            **self._asdict(),
            "effects": list(self.effects),
            "frames": [list(frame) for frame in self.frames],
            "held": list(self.held),
        }


def plan_from_record(record: Mapping[str, Any]) -> Plan:
    """The plan that :meth:`Plan.record` wrote. Raises ValueError for anything else."""
    if set(record) != set(Plan._fields):
        differing = ", ".join(sorted(set(record) ^ set(Plan._fields)))
        raise ValueError(f"plan: expected the entries {', '.join(Plan._fields)}; these differ: {differing}.")
    frames = tuple(tuple(frame) for frame in record["frames"])
    tuples = {"effects": tuple(record["effects"]), "frames": frames, "held": tuple(record["held"])}
    return Plan(**{**record, **tuples})


def plan(
    effects: Effects,
    denoiser: Denoiser | None = None,
    *,
    max_depth: int | None = None,
    bound: float | None = None,
    remaining: float | None = None,
) -> Plan:
    """The intersection of what a scene has and what a denoiser reads (None: whatever any denoiser may read).

    ``max_depth`` is the path length to render with, the scene's own by default; ``bound`` and ``remaining`` say how it
    was measured (:func:`jaxdn.render.depth.measure_depth`).
    """
    by_name = {effect.name: effect for effect in EFFECTS}
    wanted = frozenset(Frame._fields) if denoiser is None else denoiser.reads | COMPOSED
    offered = frozenset().union(*(by_name[name].buffers for name in effects.names))

    def buffers(present: frozenset[str]) -> tuple[str, ...]:
        had = GEOMETRY.union(*(by_name[name].buffers for name in present))
        if effects.lit:
            had |= {"direct"}
        return tuple(name for name in Frame._fields if name != "radiance" and name in had & wanted)

    frames = tuple(buffers(present) for present in effects.frames)
    stored = frozenset().union(*frames)
    indirect = "indirect" in effects
    depth = effects.max_depth if max_depth is None else max_depth
    return Plan(
        integrator="none" if not effects.lit else "volpath" if "media" in effects else "path",
        max_depth=depth if indirect or depth is None else min(depth, 2),
        bound=bound,
        remaining=None if remaining is None else round(remaining, 4),
        motion="dual" if "dual_motion" in stored else "traditional" if "motion" in stored else "none",
        lobes_apart="specular" in offered & wanted,
        gradient_samples="gradient" in offered & wanted,
        demodulation="albedo" if "texture" in effects and "albedo" in stored else "none",
        indirect=indirect,
        effects=effects.names,
        frames=frames,
        held=effects.held,
    )
