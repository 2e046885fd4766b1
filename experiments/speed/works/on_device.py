"""What jax's device takes for a frame, asked of a process of its own: time, memory, compile time, kernels, images."""

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.profiler import ProfileData, ProfileOptions

from experiments.speed import roofline
from experiments.speed.timing import milliseconds, summary
from experiments.speed.works import scene, steps
from jaxdn.core.frame import Frame, frame_at, only
from jaxdn.denoiser.rollout import stream
from jaxdn.ops import oidn
from jaxdn.ops.dispatch.operation import REFERENCE, implementation
from jaxdn.zoo.ready import Model, find_model

PRECISIONS = {"float32": "highest", "bfloat16": "bfloat16"}
"""Of products and convolutions, whose sums are float32; all else is float32 in both."""
OPERATIONS = ("auto", REFERENCE)
"""The kernels that each operation chooses on this device (Pallas on a GPU), or plain XLA everywhere."""
_PROFILED = 3
"""Frames."""


class FrameCost(NamedTuple):
    """One step of a method, of a size, in one precision, with one choice of kernels."""

    median_ms: float
    min_ms: float
    max_ms: float
    compile_s: float
    memory_mib: float
    """Arguments, results and what the program needs besides, as the compiler has planned it."""
    gflop: float
    gbytes: float
    """Frame, weights, and the state before and after, each once: the least that a step has to move."""


def measure_rates(rounds: int, length: int, side: int) -> dict[str, float]:
    """Its bandwidth, and its rate of products of square matrices in each precision."""
    copy = roofline.copy_on_device(length)
    rates = {"copy_gb_s": 2.0 * roofline.FLOAT * length / _fastest(copy, rounds) / 1e6}
    a = jnp.ones((side, side), jnp.float32)
    for name, precision in PRECISIONS.items():
        product = jax.jit(partial(jnp.dot, precision=precision if name == "float32" else None))
        with jax.default_matmul_precision(precision):
            rates[f"{name}_gflop_s"] = (
                2.0 * side**3 / _fastest(lambda run=product: run(a, a).block_until_ready(), rounds) / 1e6
            )
    return rates


def measure_frames(
    name: str, height: int, width: int, variants: Sequence[tuple[str, str]], rounds: int
) -> list[FrameCost]:
    """A step for each pair of :data:`PRECISIONS` and :data:`OPERATIONS`, with the state of the step before it."""
    found = find_model(name)
    frame = only_read(found, steps.frame_of(height, width))
    return [_measure_step(found, frame, precision, operations, rounds) for precision, operations in variants]


def step_ms(name: str, height: int, width: int, rounds: int) -> float:
    """The median of a step in float32, with this device's own kernels."""
    return measure_frames(name, height, width, [("float32", "auto")], rounds)[0].median_ms


def _measure_step(found: Model, frame: Frame, precision: str, operations: str, rounds: int) -> FrameCost:
    denoiser = found.denoiser
    assert denoiser is not None
    with jax.default_matmul_precision(PRECISIONS[precision]), implementation(operations):
        state = jax.tree.map(jnp.copy, denoiser.start(found.params, frame))
        began = time.perf_counter()
        compiled = jax.jit(denoiser.step, donate_argnums=1).lower(found.params, state, frame).compile()
        compile_s = time.perf_counter() - began
    held = [state]

    def call() -> None:
        held[0], image = compiled(found.params, held[0], frame)
        image.block_until_ready()

    call()
    taken = summary([milliseconds(call) for _ in range(rounds)], 0.0)
    planned, counted = compiled.memory_analysis(), compiled.cost_analysis()
    memory = sum(
        getattr(planned, f"{kind}_size_in_bytes", 0) * sign
        for kind, sign in (("argument", 1), ("output", 1), ("temp", 1), ("alias", -1))
    )
    flop = counted.get("flops", 0.0) if isinstance(counted, dict) else 0.0
    moved = sum(jnp.asarray(leaf).nbytes for leaf in jax.tree.leaves((found.params, held, held, frame)))
    moved += 3 * roofline.FLOAT * frame.radiance[..., 0].size  # the image
    return FrameCost(*taken[:3], compile_s, memory / 2**20, flop / 1e9, moved / 1e9)


def only_read(found: Model, frame: Frame) -> Frame:
    """The frame with the buffers that a method reads, which alone are copied to a device."""
    assert found.denoiser is not None
    return only(frame, found.denoiser.reads)


def denoise_clip(name: str, frames: Frame, platform: str | None) -> np.ndarray:
    """The images [T, H, W, 3] of a clip, on jax's default device, or on that platform (``"cpu"``).

    To be called in a new process: which devices there are is decided once.
    """
    if platform is not None:
        jax.config.update("jax_platforms", platform)
    found = find_model(name)
    assert found.denoiser is not None
    with jax.default_matmul_precision("highest"):
        step = stream(found.denoiser, found.params)
        return np.stack([np.asarray(step(frame_at(frames, index))) for index in range(frames.radiance.shape[0])])


def draw_clip(count: int, height: int, width: int) -> Frame:
    """Frames [T, H, W, C] with noise and motion."""
    return scene.clip(count, height, width).frames


def longest_kernels(name: str, height: int, width: int, count: int) -> list[tuple[str, float, float]]:
    """The kernels of a step that take longest: name, milliseconds a frame, share of all."""
    found = find_model(name)
    assert found.denoiser is not None
    call = steps.recurrent(found.denoiser, found.params, only_read(found, steps.frame_of(height, width)))
    call()
    options = ProfileOptions()
    options.python_tracer_level = 0
    with tempfile.TemporaryDirectory() as place:
        with jax.profiler.trace(place, profiler_options=options):
            for _ in range(_PROFILED):
                call()
        traces = sorted(Path(place).glob("**/*.xplane.pb"))
        taken = add_kernels(ProfileData.from_file(str(traces[-1]))) if traces else Counter[str]()
    total = sum(taken.values())
    return [(kernel, ns / _PROFILED / 1e6, ns / total) for kernel, ns in taken.most_common(count)]


def add_kernels(profile: Any) -> "Counter[str]":
    """Operation (and kernel) of a profile -> nanoseconds; those of a device, if there is one, else of the CPU."""
    planes = list(profile.planes)
    devices = [plane for plane in planes if plane.name.startswith("/device:") and list(plane.lines)]
    taken: Counter[str] = Counter()
    for plane in devices or planes:
        for line in plane.lines:
            for event in line.events:
                stats = dict(event.stats)
                if "hlo_op" in stats:
                    taken[f"{stats['hlo_op']} ({event.name[:60]})" if devices else str(stats["hlo_op"])] += (
                        event.duration_ns
                    )
    return taken


def measure_oidn(height: int, width: int, rounds: int) -> dict[str, Any]:
    """Open Image Denoise on its device (CUDA where it can): a call with copies to it and back, in milliseconds."""
    call = steps.oidn_high(height, width)
    call()
    taken = summary([milliseconds(call) for _ in range(rounds)], 0.0)
    return {
        "device": oidn.choose_device("auto"),
        "median_ms": taken.median_ms,
        "min_ms": taken.min_ms,
        "max_ms": taken.max_ms,
    }


def describe_device() -> dict[str, str]:
    """What jax computes on."""
    device = jax.devices()[0]
    return {"platform": device.platform, "kind": device.device_kind, "jax": jax.__version__}


def _fastest(call: Any, rounds: int) -> float:
    """Milliseconds, without the first call, which compiles."""
    call()
    return min(milliseconds(call) for _ in range(rounds))
