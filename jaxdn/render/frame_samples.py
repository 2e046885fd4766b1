"""The light of one frame: the samples of its noisy layers, of its reference, and of single images to train on."""

from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jaxdn.render.frame_request import FrameRequest
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing import jitter as jitters
from jaxdn.render.tracing.radiance import RadianceSums, TraceRequest, make_zero_radiance
from jaxdn.render.tracing.seeds import DRAWS, NOISY, REFERENCE, SampleStream
from jaxdn.render.tracing.tracer import Tracer


class FrameSamples(NamedTuple):
    """Sums over the samples of one frame."""

    noisy: dict[int, RadianceSums]
    """Samples per pixel -> the layer."""
    halves: list[RadianceSums]
    """The two halves of the reference; empty without one."""
    singles: list[RadianceSums]
    """Images of one sample each."""

    def best(self) -> RadianceSums:
        """The sums over the reference, or over all layers without one."""
        return reduce(RadianceSums.plus, self.halves or self.noisy.values())

    def bad(self) -> int:
        """The number of samples that were not finite."""
        return sum(sums.bad for sums in (*self.noisy.values(), *self.halves, *self.singles))


def trace_samples(
    tracer: Tracer,
    built: Any,
    frame: int,
    settings: RenderSettings,
    request: FrameRequest,
    common: TraceRequest,
) -> FrameSamples:
    """Trace all samples of a frame.

    Args:
      tracer: of the settings' variant.
      built: the ``mi.Scene`` of the frame.
      frame: index of the frame.
      settings: complete (:meth:`jaxdn.render.settings.RenderSettings.complete`).
      request: what the frame needs.
      common: what is asked of all samples.
    """
    lights = _FrameLight(tracer, built, frame, settings, request, common)
    own = request.describe_own_samples(common)
    # Layer n always holds the samples n-1 ... 2n-2: its image does not depend on the other layers.
    noisy = {
        count: lights.trace(NOISY, count - 1, count, own if count == settings.layers[0] else common)
        for count in settings.layers
    }
    halves = lights.trace_halves() if settings.reference_spp and not request.shared else []
    singles = lights.trace_sets(DRAWS, 1, settings.draws) if settings.draws else []
    return FrameSamples(noisy, halves, singles)


class _FrameLight(NamedTuple):
    """How the light of one frame is traced; black where the request says so."""

    tracer: Tracer
    built: Any
    frame: int
    settings: RenderSettings
    request: FrameRequest
    common: TraceRequest
    """What is asked of all samples."""

    def trace(self, stream: int, first: int, count: int, request: TraceRequest) -> RadianceSums:
        """Trace some samples of a stream."""
        # Without a reference the noisy layers are what direct and emitted light are the means of.
        black = stream == NOISY and not self.request.noisy and self.settings.reference_spp
        if (black or not self.request.lit) and request.surfaces is None:
            return make_zero_radiance((self.settings.height, self.settings.width), request)
        # Guides need their samples even in the dark.
        depth = self.settings.max_depth if self.request.lit else 1
        return self.tracer.accumulate(self.built, self._numbers(stream), first, count, max_depth=depth, request=request)

    def trace_sets(self, stream: int, count: int, sets: int) -> list[RadianceSums]:
        """Trace several sets of samples of a stream, one after the other."""
        if not self.request.lit:
            return [self.trace(stream, at, count, self.common) for at in range(0, sets * count, count)]
        numbers, depth = self._numbers(stream), self.settings.max_depth
        return self.tracer.accumulate_sets(self.built, numbers, 0, count, sets, max_depth=depth, request=self.common)

    def trace_halves(self) -> list[RadianceSums]:
        """Trace the two halves of the reference."""
        samples = self.settings.reference_spp
        middle = (samples + 1) // 2
        if self.settings.jitter:
            halves = _trace_spread_halves(
                lambda first, count: self.trace(REFERENCE, first, count, self.common), samples, self.built
            )
            jitters.shift_principal_point(self.built, jitters.get_frame_offset(self.frame))
            return halves
        if samples % 2:
            parts = (0, middle), (middle, samples - middle)
            return [self.trace(REFERENCE, first, count, self.common) for first, count in parts]
        return self.trace_sets(REFERENCE, middle, 2)

    def _numbers(self, stream: int) -> SampleStream:
        return SampleStream(self.settings.seed, self.frame, stream)


def _trace_spread_halves(trace: Callable[[int, int], RadianceSums], samples: int, jittered: Any) -> list[RadianceSums]:
    """Sum the two halves of a reference's samples, through the whole of the pixels of a jittered scene.

    ``trace(first, count)`` gives the sums of some samples; the scene is left at another point of its pixels.
    """
    middle = (samples + 1) // 2

    def spread(first: int, count: int) -> RadianceSums:
        edges = first + np.arange(jitters.POSITIONS + 1) * count // jitters.POSITIONS
        parts = []
        for index, (start, end) in enumerate(pairwise(edges.tolist())):
            if end > start:
                jitters.shift_principal_point(jittered, jitters.get_offset(index))
                parts.append(trace(start, end - start))
        return reduce(RadianceSums.plus, parts)

    return [spread(0, middle), spread(middle, samples - middle)]
