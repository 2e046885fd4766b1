"""The light of one frame with motion blur: its samples see the scene at several times while the shutter is open."""

from collections.abc import Callable
from typing import Any

from jaxdn.render.frame_request import FrameRequest
from jaxdn.render.frame_samples import FrameSamples
from jaxdn.render.scenes.optics import get_shutter
from jaxdn.render.scenes.scene import AnimatedScene
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing.radiance import RadianceSums, TraceRequest
from jaxdn.render.tracing.seeds import NOISY, REFERENCE, SampleStream
from jaxdn.render.tracing.shutter import choose_samples, list_times
from jaxdn.render.tracing.tracer import Tracer


def trace_blurred_samples(
    tracer: Tracer,
    scene: AnimatedScene,
    frame: int,
    settings: RenderSettings,
    request: FrameRequest,
    describe: Callable[[Any], TraceRequest],
) -> FrameSamples:
    """Trace all samples of a frame of a scene whose shutter stays open.

    Args:
      tracer: of the settings' variant.
      scene: that is seen at several times.
      frame: index of the frame.
      settings: complete (:meth:`jaxdn.render.settings.RenderSettings.complete`).
      request: what the frame needs.
      describe: what is asked of all samples in the ``mi.Scene`` of one time.
    """
    middle = (settings.reference_spp + 1) // 2
    wanted = [(NOISY, count - 1, count) for count in settings.layers]
    if settings.reference_spp:
        wanted += [(REFERENCE, 0, middle), (REFERENCE, middle, settings.reference_spp - middle)]
    sums: list[RadianceSums | None] = [None] * len(wanted)
    for index, time in enumerate(list_times(frame, get_shutter(scene), settings.seed)):
        built = scene.build(time, settings.width, settings.height)
        asked = describe(built)
        for place, (kind, first, count) in enumerate(wanted):
            stream = SampleStream(settings.seed, frame, kind)
            pixel, sample = choose_samples(stream, index, settings.width * settings.height, first, count)
            part = tracer.accumulate_samples(
                built, stream, pixel, sample, max_depth=settings.max_depth if request.lit else 1, request=asked
            )
            before = sums[place]
            sums[place] = part if before is None else before.plus(part)
        del built, asked  # Mitsuba's numbers of objects are used again: kernels are not compiled anew
    found = [one for one in sums if one is not None]
    layers = len(settings.layers)
    return FrameSamples(dict(zip(settings.layers, found[:layers], strict=True)), found[layers:], [])
