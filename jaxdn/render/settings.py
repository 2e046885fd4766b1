"""The settings that a clip is rendered with, as one value: checked when it is made, and stored in ``clip.json``."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from jaxdn.core.checks import check_at_least, check_option
from jaxdn.planning.catalogue import OF_PRIMARY_SURFACES, OF_SHADOWS, THROUGH_CENTRES, NoisyLight
from jaxdn.planning.plan import Plan, plan_from_record
from jaxdn.render.mitsuba.variant import use_variant
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.tracing.pixel_filters import PIXEL_FILTERS, PixelFilter

LATER_SETTINGS: dict[str, Any] = {"pixel_filter": "centre"}
"""Settings that clips of earlier versions do not record, and what they were rendered with."""


@dataclass(frozen=True)
class RenderSettings:
    """How the frames of a clip are rendered. Raises ValueError as :meth:`check` does."""

    width: int = 128
    """In pixels."""
    height: int = 128
    """In pixels."""
    layers: tuple[int, ...] = (1,)
    """Samples per pixel of the independent noisy layers: powers of two, kept in ascending order."""
    reference_spp: int = 0
    """Samples per pixel of the reference; 0 for none."""
    draws: int = 0
    """Further images of one sample each, for training on noise that rarely repeats."""
    light: NoisyLight = "indirect"
    """What the radiance holds: ``"indirect"`` light, beside which there is ``direct``, or all that is ``"reflected"``,
    without ``direct``."""
    jitter: bool = False
    """Rays go through another point of the pixels in every frame (:mod:`jaxdn.render.tracing.jitter`), and the
    reference is the mean over each pixel, instead of everything through the centres."""
    pixel_filter: PixelFilter = "centre"
    """Where the samples lie in and around their pixel (:mod:`jaxdn.render.tracing.pixel_filters`). With any but
    ``"centre"`` the guides of :data:`jaxdn.core.frame.AVERAGED` are means over the samples of each image, as noisy as
    those; all others are point samples at the pixels' centres."""
    see_through: bool = False
    """The guides of flat mirrors and of glass are those of what they show
    (:mod:`jaxdn.render.buffers.primary_surface_replacement`); not with the scalar variant."""
    variant: str | None = None
    """Mitsuba's; None: the fastest that works here."""
    max_depth: int | None = None
    """Path length (1 emission, 2 direct light ...); None: that of the plan, else of the scene."""
    plan: Plan | None = None
    """What to leave out: buffers (None then), paths longer than its ``max_depth``, and, in a frame that shows the same
    as an earlier one (``plan.shared_with``), everything except the noise. The rest is the same as without a plan, bit
    for bit. Without one there are all buffers but those on request (:data:`jaxdn.core.frame.ON_REQUEST`)."""
    seed: int = 0
    """Of the random numbers."""

    def __post_init__(self) -> None:
        self.check()
        object.__setattr__(self, "layers", tuple(sorted(self.layers)))

    def check(self) -> None:
        """Raise ValueError for settings that are out of range or contradict each other."""
        check_at_least(1, width=self.width, height=self.height)
        powers = all(isinstance(spp, int) and spp >= 1 and spp & (spp - 1) == 0 for spp in self.layers)
        if not self.layers or not powers or len(set(self.layers)) != len(self.layers):
            raise ValueError(f"layers: expected different powers of two, such as (1, 2, 4), got {tuple(self.layers)}.")
        if self.reference_spp < 0 or self.reference_spp == 1:
            raise ValueError(f"reference_spp: expected 0 (no reference) or at least 2, got {self.reference_spp}.")
        if self.draws < 0:
            raise ValueError(f"draws: expected 0 or more images of one sample each, got {self.draws}.")
        check_option(self.light, "light", ("indirect", "reflected"))
        check_option(self.pixel_filter, "pixel_filter", PIXEL_FILTERS)
        if self.pixel_filter != "centre":
            self._check_filtered()
        if self.draws and self.light == "reflected":
            raise ValueError(
                "draws: expected 0 with light 'reflected', as training draws indirect light; leave one out."
            )
        if self.max_depth is not None and self.max_depth < 1:
            raise ValueError(f"max_depth: expected at least 1 (emission only), got {self.max_depth}.")
        if self.plan is not None:
            self._check_plan(self.plan)

    @property
    def through_centres(self) -> bool:
        """Whether all rays of all frames go through the centres of their pixels."""
        return not self.jitter and self.pixel_filter == "centre"

    def _check_filtered(self) -> None:
        """Raise ValueError for what filtered pixels exclude."""
        for name, what in (("jitter", "spreads rays over the pixels by itself"), ("see_through", "follows one ray")):
            if getattr(self, name):
                raise ValueError(f"{name}: expected pixel_filter 'centre', as it {what}, got {self.pixel_filter!r}.")
        if self.draws:
            raise ValueError(
                f"draws: expected 0 with pixel_filter {self.pixel_filter!r}, as single samples have no guides of their "
                "own; render layers instead."
            )

    def _check_plan(self, plan: Plan) -> None:
        """Raise ValueError for a plan that was made for other settings."""
        buffers = set(plan.buffers)
        if buffers & (OF_SHADOWS if self.light == "indirect" else {"direct"}):
            raise ValueError(
                f"plan: expected one that was made for light {self.light!r}; pass light={self.light!r} to effects.plan."
            )
        shares = plan.shared_with != tuple(range(len(plan.frames)))
        if not self.through_centres and (THROUGH_CENTRES & buffers or shares):
            why = "jitter" if self.jitter else f"pixel_filter {self.pixel_filter!r}"
            raise ValueError(f"plan: expected one that was made for {why}; pass jitter=True to effects.plan.")
        if self.see_through and OF_PRIMARY_SURFACES & buffers:
            raise ValueError("plan: expected one that was made to see through; pass see_through=True to effects.plan.")

    def record(self) -> dict[str, Any]:
        """The settings as JSON, for ``clip.json``; :meth:`from_record` is the inverse."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return own | {"layers": list(self.layers), "plan": None if self.plan is None else self.plan.record()}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "RenderSettings":
        """The settings in a clip's record, which has other entries besides. Raises ValueError for missing entries.

        Clips of earlier versions have no ``pixel_filter``: their rays went through the centres.
        """
        record = LATER_SETTINGS | dict(record)
        names = [field.name for field in fields(cls)]
        if missing := [name for name in names if name not in record]:
            raise ValueError(f"clip record: expected {', '.join(names)}; these are missing: {', '.join(missing)}.")
        own = {name: record[name] for name in names}
        plan = None if own["plan"] is None else plan_from_record(own["plan"])
        return cls(**own | {"layers": tuple(own["layers"]), "plan": plan})

    def complete(self, scene: AnimatedScene) -> "RenderSettings":
        """The same with the variant and the path length that they come to for a scene; switches to the variant."""
        planned = None if self.plan is None else self.plan.max_depth
        depth = self.max_depth or planned or scene.max_depth
        return replace(self, variant=use_variant(self.variant), max_depth=depth)
