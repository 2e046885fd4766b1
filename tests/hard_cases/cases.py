"""What goes wrong in practice, as inputs: each case is one function of a clip in which nothing is wrong.

All cases share shapes and buffers, so that one compiled program serves them all. A new case is one more function here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxdn.frame import FAR, Clip, Frame

FRAMES, HEIGHT, WIDTH = 3, 16, 24


class Inputs(NamedTuple):
    """What denoisers and operations are given."""

    clip: Clip
    logits: np.ndarray
    """[H, W, 25] of predicted kernels."""
    blend: np.ndarray
    """[H / 2, W / 2, 1] of a composition, before the sigmoid."""


class Case(NamedTuple):
    """One hard case."""

    name: str
    sentence: str
    """Where it happens in practice."""
    make: Callable[[Inputs], Inputs]


CASES: dict[str, Case] = {}


def case(sentence: str) -> Callable[[Callable[[Inputs], Inputs]], Callable[[Inputs], Inputs]]:
    """Decorator: make a function of good inputs a case, under its own name."""

    def keep(make: Callable[[Inputs], Inputs]) -> Callable[[Inputs], Inputs]:
        name = make.__name__.replace("_", " ")
        CASES[name] = Case(name, sentence, make)
        return make

    return keep


def good(seed: int = 0, *, frames: int = FRAMES, height: int = HEIGHT, width: int = WIDTH) -> Inputs:
    """A wall, and a square that moves over it by 1.5 px a frame: noisy, with every buffer, and nothing wrong."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    wall = 0.4 + 0.2 * np.sin(columns / 3) * np.cos(rows / 4)

    def square(t: float) -> np.ndarray:
        left = 4 + 1.5 * t
        return (columns >= left) & (columns < left + 7) & (rows >= 4) & (rows < 11)

    shape = (frames, height, width)
    inside = np.stack([square(t) for t in range(frames)])[..., None]
    before = np.stack([square(t - 1) for t in range(frames)])[..., None]
    reference = np.where(inside, [0.2, 0.5, 0.9], wall[None, ..., None] * [1.0, 0.8, 0.6]).astype(np.float32)
    motion = np.where(inside, [-1.5, 0.0], 0.0).astype(np.float32)
    normal = np.where(inside, [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]).astype(np.float32)
    frame = Frame(
        radiance=(reference * rng.exponential(size=(*shape, 1))).astype(np.float32),
        albedo=np.where(inside, [0.3, 0.6, 0.9], 0.7).astype(np.float32),
        normal=normal,
        depth=np.where(inside, 2.0, 5.0 + columns[None, ..., None] / 50).astype(np.float32),
        roughness=np.where(inside, 0.3, 1.0).astype(np.float32),
        motion=motion,
        dual_motion=np.where(before & ~inside, [1.5, 0.0], motion).astype(np.float32),
        visible=inside | ~before,
        previous_depth=np.where(inside, 2.0, 5.0 + columns[None, ..., None] / 50).astype(np.float32),
        ids=np.where(inside, 1, 0).astype(np.int32),
        direct=(0.1 * reference).astype(np.float32),
        emission=np.zeros((*shape, 3), np.float32),
    )
    logits = rng.standard_normal((height, width, 25)).astype(np.float32)
    blend = rng.standard_normal((height // 2, width // 2, 1)).astype(np.float32)
    return Inputs(Clip(frame, reference), logits, blend)


def _with(inputs: Inputs, **buffers: Any) -> Inputs:
    frames = {name: np.asarray(buffer) for name, buffer in buffers.items()}
    return inputs._replace(clip=inputs.clip._replace(frames=inputs.clip.frames._replace(**frames)))


def _filled(inputs: Inputs, name: str, value: Any) -> Inputs:
    buffer = getattr(inputs.clip.frames, name)
    return _with(inputs, **{name: np.full_like(buffer, value)})


def _dotted(inputs: Inputs, name: str, value: Any, *, every: int = 7) -> Inputs:
    """A value in every seventh pixel of a buffer."""
    buffer = np.array(getattr(inputs.clip.frames, name))
    buffer.reshape(-1, buffer.shape[-1])[::every] = value
    return _with(inputs, **{name: buffer})


@case("nothing is wrong: what the others are compared with")
def control(inputs: Inputs) -> Inputs:
    return inputs


@case("a path finds a small lamp: one pixel in seven is brighter than all others together")
def fireflies(inputs: Inputs) -> Inputs:
    return _dotted(inputs, "radiance", 1e4)


@case("beyond what a half-precision file holds")
def fireflies_beyond_half_precision(inputs: Inputs) -> Inputs:
    return _dotted(inputs, "radiance", 1e30)


@case("the reference itself has fireflies left")
def fireflies_in_the_reference(inputs: Inputs) -> Inputs:
    reference = np.array(inputs.clip.reference)
    reference.reshape(-1, 3)[::7] = 1e30
    return inputs._replace(clip=inputs.clip._replace(reference=reference))


@case("a renderer divides zero by zero")
def radiance_not_a_number(inputs: Inputs) -> Inputs:
    return _dotted(inputs, "radiance", np.nan)


@case("a renderer divides by zero, or a half-precision file overflowed")
def radiance_infinite(inputs: Inputs) -> Inputs:
    return _dotted(_dotted(inputs, "radiance", np.inf), "radiance", -np.inf, every=11)


@case("a filter with negative lobes was in the renderer")
def radiance_negative(inputs: Inputs) -> Inputs:
    return _dotted(inputs, "radiance", -3.0)


@case("every buffer has some pixels that are not a number")
def everything_not_a_number(inputs: Inputs) -> Inputs:
    for name in ("radiance", "albedo", "normal", "depth", "roughness", "motion", "dual_motion", "previous_depth"):
        inputs = _dotted(inputs, name, np.nan)
    return inputs


@case("every buffer has some pixels at infinity")
def everything_infinite(inputs: Inputs) -> Inputs:
    for name in ("radiance", "albedo", "normal", "depth", "roughness", "motion", "dual_motion", "previous_depth"):
        inputs = _dotted(inputs, name, np.inf)
    return inputs


@case("the light is off")
def black(inputs: Inputs) -> Inputs:
    inputs = _filled(inputs, "radiance", 0.0)
    return inputs._replace(clip=inputs.clip._replace(reference=np.zeros_like(inputs.clip.reference)))


@case("a converged background of one colour: no variance anywhere")
def constant(inputs: Inputs) -> Inputs:
    inputs = _filled(inputs, "radiance", 0.5)
    return inputs._replace(clip=inputs.clip._replace(reference=np.full_like(inputs.clip.reference, 0.5)))


@case("the first sample that ever hit anything")
def one_bright_pixel(inputs: Inputs) -> Inputs:
    radiance = np.zeros_like(inputs.clip.frames.radiance)
    radiance[:, 5, 7] = 6e4
    return _with(inputs, radiance=radiance)


@case("the noisy image is the reference: zero loss, infinite PSNR")
def identical_to_the_reference(inputs: Inputs) -> Inputs:
    return _with(inputs, radiance=inputs.clip.reference)


@case("a pure metal has no diffuse reflectance to divide by")
def albedo_zero(inputs: Inputs) -> Inputs:
    return _filled(inputs, "albedo", 0.0)


@case("a nearly black cloth: dividing by its albedo multiplies noise by thousands")
def albedo_tiny(inputs: Inputs) -> Inputs:
    return _filled(inputs, "albedo", 1e-5)


@case("a polished mirror")
def roughness_zero(inputs: Inputs) -> Inputs:
    return _filled(inputs, "roughness", 0.0)


@case("the camera's rays hit nothing")
def normals_zero(inputs: Inputs) -> Inputs:
    return _filled(inputs, "normal", 0.0)


@case("an exporter forgot to normalise")
def normals_of_any_length(inputs: Inputs) -> Inputs:
    normal = inputs.clip.frames.normal * np.linspace(1e-3, 1e3, WIDTH, dtype=np.float32)[:, None]
    return _with(inputs, normal=normal)


@case("neighbours seen from both sides: cosines at and below zero")
def normals_opposite(inputs: Inputs) -> Inputs:
    normal = np.array(inputs.clip.frames.normal)
    normal[:, ::2] *= -1
    return _with(inputs, normal=normal)


@case("a near plane at zero")
def depth_zero(inputs: Inputs) -> Inputs:
    return _filled(_filled(inputs, "depth", 0.0), "previous_depth", 0.0)


@case("nothing but background")
def depth_far(inputs: Inputs) -> Inputs:
    return _filled(_filled(inputs, "depth", FAR), "previous_depth", FAR)


@case("an insect on the lens before a mountain")
def depth_from_1e_6_to_1e6(inputs: Inputs) -> Inputs:
    depth = np.array(inputs.clip.frames.depth)
    depth[:, :, ::2], depth[:, :, 1::2] = 1e-6, 1e6
    return _with(inputs, depth=depth, previous_depth=depth)


@case("exactly between two pixels")
def motion_of_half_a_pixel(inputs: Inputs) -> Inputs:
    return _filled(_filled(inputs, "motion", 0.5), "dual_motion", 0.5)


@case("a cut, or a teleport: every vector leads far outside")
def every_pixel_off_screen(inputs: Inputs) -> Inputs:
    return _filled(_filled(inputs, "motion", 1e4), "dual_motion", 1e4)


@case("a vector that no integer holds")
def motion_of_1e30(inputs: Inputs) -> Inputs:
    return _filled(_filled(inputs, "motion", 1e30), "dual_motion", -1e30)


@case("a new object fills the picture: nothing was seen before")
def every_pixel_disoccluded(inputs: Inputs) -> Inputs:
    inputs = _with(inputs, visible=np.zeros_like(inputs.clip.frames.visible))
    return _filled(inputs, "dual_motion", 3.0)


@case("another room from one frame to the next, and motion says nothing of it")
def cut(inputs: Inputs) -> Inputs:
    other = good(7).clip.frames
    frames = {}
    for name in Frame._fields:
        buffer = np.array(getattr(inputs.clip.frames, name))
        buffer[2:] = getattr(other, name)[2:, ::-1]
        frames[name] = buffer
    return _with(inputs, **frames)


@case("somebody switches the light off")
def light_switched_off(inputs: Inputs) -> Inputs:
    radiance = np.array(inputs.clip.frames.radiance)
    radiance[1:] = 0
    return _with(inputs, radiance=radiance)


@case("a scene in kilometres, modelled in millimetres")
def scene_scaled_by_1e4(inputs: Inputs) -> Inputs:
    return _with(inputs, depth=1e4 * inputs.clip.frames.depth, previous_depth=1e4 * inputs.clip.frames.previous_depth)


@case("a scene in millimetres, modelled in kilometres")
def scene_scaled_by_1e_4(inputs: Inputs) -> Inputs:
    return _with(inputs, depth=1e-4 * inputs.clip.frames.depth, previous_depth=1e-4 * inputs.clip.frames.previous_depth)


@case("radiance in physical units, outdoors")
def brightness_times_1e3(inputs: Inputs) -> Inputs:
    inputs = inputs._replace(clip=inputs.clip._replace(reference=1e3 * inputs.clip.reference))
    return _with(inputs, radiance=1e3 * inputs.clip.frames.radiance)


@case("radiance in physical units, by moonlight")
def brightness_times_1e_3(inputs: Inputs) -> Inputs:
    inputs = inputs._replace(clip=inputs.clip._replace(reference=1e-3 * inputs.clip.reference))
    return _with(inputs, radiance=1e-3 * inputs.clip.frames.radiance)


@case("a network that was trained too fast")
def logits_of_1e4(inputs: Inputs) -> Inputs:
    return inputs._replace(logits=1e4 * np.sign(inputs.logits), blend=1e4 * np.sign(inputs.blend))


@case("a network that has learned nothing: all taps alike")
def logits_all_equal(inputs: Inputs) -> Inputs:
    return inputs._replace(logits=np.full_like(inputs.logits, 3.0), blend=np.zeros_like(inputs.blend))


@case("a network that keeps its input")
def logits_one_hot(inputs: Inputs) -> Inputs:
    logits = np.full_like(inputs.logits, -1e4)
    logits[..., 12] = 0
    return inputs._replace(logits=logits)


@case("numbers too small to be normal")
def subnormal_radiance(inputs: Inputs) -> Inputs:
    return _filled(inputs, "radiance", 1e-40)
