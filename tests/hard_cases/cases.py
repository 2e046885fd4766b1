"""Faults that occur in practice, as inputs: each case is one function of a valid clip.

All cases have the same buffers, and all but the last four the same shapes, so that one compiled program serves
them. A new case is one more function here.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxdn.core.frame import BUFFERS, FAR, Frame, Kind
from jaxdn.methods.registry import methods
from tests.hard_cases.inputs import BY_HAND, WIDTH, Inputs, dotted, filled, good, replaced

WITHOUT_NAN: tuple[Kind, ...] = ("flag", "id")
"""Kinds that have neither NaN nor infinity."""
WITH_SIGN: tuple[Kind, ...] = ("signed", "direction", "vector")
"""Kinds for which negative values are valid."""


class Case(NamedTuple):
    """One hard case."""

    name: str
    sentence: str
    """Where it occurs in practice."""
    make: Callable[[Inputs], Inputs]


CASES: dict[str, Case] = {}


def case(
    sentence: str, *, name: str | None = None
) -> Callable[[Callable[[Inputs], Inputs]], Callable[[Inputs], Inputs]]:
    """Decorator: make a function of valid inputs a case, under its own name unless another is given."""

    def keep(make: Callable[[Inputs], Inputs]) -> Callable[[Inputs], Inputs]:
        known = name or make.__name__.replace("_", " ")
        CASES[known] = Case(known, sentence, make)
        return make

    return keep


@case("valid inputs, to compare the others with")
def control(inputs: Inputs) -> Inputs:
    return inputs


@case("a path finds a small lamp: one pixel in seven is brighter than all others together")
def fireflies(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", 1e4)


@case("indirect light through a crack: the mildest kind")
def fireflies_of_1e2(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", 1e2)


@case("the largest value of a half-precision file")
def fireflies_of_65504(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", 65504.0)


@case("beyond the largest value of a half-precision file")
def fireflies_beyond_half_precision(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", 1e30)


@case("an overflow that was clipped: the largest finite number")
def fireflies_of_the_largest_number(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", np.finfo(np.float32).max)


@case("the reference itself has fireflies left")
def fireflies_in_the_reference(inputs: Inputs) -> Inputs:
    reference = np.array(inputs.clip.reference)
    reference.reshape(-1, 3)[::7] = 1e30
    return inputs._replace(clip=inputs.clip._replace(reference=reference))


@case("a renderer divides zero by zero")
def radiance_not_a_number(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", np.nan)


@case("a renderer divides by zero, or a half-precision file overflowed")
def radiance_infinite(inputs: Inputs) -> Inputs:
    return dotted(dotted(inputs, "radiance", np.inf), "radiance", -np.inf, every=11)


@case("the renderer's pixel filter has negative lobes")
def radiance_negative(inputs: Inputs) -> Inputs:
    return dotted(inputs, "radiance", -3.0)


def _breakable() -> list[str]:
    """The buffers that can have invalid values, of those in the scene and those that a method of the package reads."""
    read = set(BY_HAND)
    for method in methods().values():
        for options in ({}, *method.variants.values()):
            read |= method.factory(**options).reads
    return [name for name, buffer in BUFFERS.items() if name in read and buffer.kind not in WITHOUT_NAN]


def _everything(value: float, inputs: Inputs) -> Inputs:
    for name in _BREAKABLE:
        inputs = dotted(inputs, name, value)
    return inputs


def _broken(buffer: str, values: tuple[float, ...], inputs: Inputs) -> Inputs:
    for every, value in zip((7, 11), values, strict=False):
        inputs = dotted(inputs, buffer, value, every=every)
    return inputs


_BREAKABLE = _breakable()
case("every buffer has some pixels that are not a number", name="everything not a number")(partial(_everything, np.nan))
case("every buffer has some pixels at infinity", name="everything infinite")(partial(_everything, np.inf))
for _buffer in _BREAKABLE[1:]:  # radiance has its own above
    for _what, _values in (("not a number", (np.nan,)), ("infinite", (np.inf, -np.inf)), ("negative", (-3.0,))):
        if _what != "negative" or BUFFERS[_buffer].kind not in WITH_SIGN:
            _name = f"{_buffer.replace('_', ' ')} {_what}"
            case(f"one buffer alone is broken: {_name}", name=_name)(partial(_broken, _buffer, _values))


@case("the light is off")
def black(inputs: Inputs) -> Inputs:
    inputs = filled(inputs, "radiance", 0.0)
    return inputs._replace(clip=inputs.clip._replace(reference=np.zeros_like(inputs.clip.reference)))


@case("a converged background of one colour: no variance anywhere")
def constant(inputs: Inputs) -> Inputs:
    inputs = filled(inputs, "radiance", 0.5)
    return inputs._replace(clip=inputs.clip._replace(reference=np.full_like(inputs.clip.reference, 0.5)))


@case("a converged still image, repeated: no change from frame to frame")
def identical_frames(inputs: Inputs) -> Inputs:
    first = {name: np.broadcast_to(buffer[:1], buffer.shape) for name, buffer in inputs.clip.frames._asdict().items()}
    still = inputs.clip._replace(reference=np.broadcast_to(inputs.clip.reference[:1], inputs.clip.reference.shape))
    return replaced(inputs._replace(clip=still), **first)


@case("only one sample has hit a light so far")
def one_bright_pixel(inputs: Inputs) -> Inputs:
    radiance = np.zeros_like(inputs.clip.frames.radiance)
    radiance[:, 5, 7] = 6e4
    return replaced(inputs, radiance=radiance)


@case("the noisy image is the reference: zero loss, infinite PSNR")
def identical_to_the_reference(inputs: Inputs) -> Inputs:
    return replaced(inputs, radiance=inputs.clip.reference)


@case("a pure metal has no diffuse reflectance to divide by")
def albedo_zero(inputs: Inputs) -> Inputs:
    return filled(inputs, "albedo", 0.0)


@case("a nearly black cloth: dividing by its albedo multiplies noise by thousands")
def albedo_tiny(inputs: Inputs) -> Inputs:
    return filled(inputs, "albedo", 1e-5)


@case("a black hole in the scene: it reflects nothing at all")
def reflectance_zero(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "albedo", 0.0), "reflectance", 0.0)


@case("soot: reflectances around the smallest that half precision holds")
def reflectance_tiny(inputs: Inputs) -> Inputs:
    return dotted(filled(inputs, "reflectance", 1e-7), "reflectance", 1e-5)


@case("a material that gains energy: more is reflected than arrives")
def reflectance_huge(inputs: Inputs) -> Inputs:
    return filled(inputs, "reflectance", 1e4)


@case("a picture painted in pure colours: in two of three channels nothing is reflected")
def saturated_primaries(inputs: Inputs) -> Inputs:
    columns = np.arange(inputs.clip.frames.albedo.shape[2])
    texture = np.broadcast_to(np.eye(3, dtype=np.float32)[columns % 3], inputs.clip.frames.albedo.shape)
    return replaced(inputs, albedo=texture, reflectance=texture, radiance=texture * inputs.clip.frames.radiance)


@case("a floor seen at a grazing angle: shading normals across the line of sight, and some away from it")
def grazing_cosines(inputs: Inputs) -> Inputs:
    normal = np.zeros_like(inputs.clip.frames.normal)
    cosine = np.linspace(-0.02, 0.02, normal.shape[2], dtype=np.float32)
    normal[..., 1], normal[..., 2] = np.sqrt(1 - cosine**2), cosine
    return filled(replaced(inputs, normal=normal), "reflectance", 1.0)


@case("a polished mirror")
def roughness_zero(inputs: Inputs) -> Inputs:
    return filled(inputs, "roughness", 0.0)


@case("chalk")
def roughness_one(inputs: Inputs) -> Inputs:
    return filled(inputs, "roughness", 1.0)


@case("the camera's rays hit nothing")
def normals_zero(inputs: Inputs) -> Inputs:
    return filled(inputs, "normal", 0.0)


@case("an exporter forgot to normalise")
def normals_of_any_length(inputs: Inputs) -> Inputs:
    normal = inputs.clip.frames.normal * np.linspace(1e-3, 1e3, WIDTH, dtype=np.float32)[:, None]
    return replaced(inputs, normal=normal)


@case("the edges of a box: every cosine between neighbours is zero")
def normals_at_right_angles(inputs: Inputs) -> Inputs:
    normal = np.zeros_like(inputs.clip.frames.normal)
    normal[:, :, ::2, 0] = normal[:, :, 1::2, 1] = 1
    return replaced(inputs, normal=normal)


@case("a wrong scale in a transformation: lengths near the largest and the smallest number")
def normals_of_extreme_length(inputs: Inputs) -> Inputs:
    normal = 3e38 * inputs.clip.frames.normal
    normal[:, ::2] = 2e-38 * inputs.clip.frames.normal[:, ::2]
    return replaced(inputs, normal=normal)


@case("neighbours seen from both sides: cosines below zero")
def normals_opposite(inputs: Inputs) -> Inputs:
    normal = np.array(inputs.clip.frames.normal)
    normal[:, ::2] *= -1
    return replaced(inputs, normal=normal)


@case("a near plane at zero")
def depth_zero(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "depth", 0.0), "previous_depth", 0.0)


@case("nothing but background")
def depth_far(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "depth", FAR), "previous_depth", FAR)


@case(
    "an object at the lens, a mountain, a hole in the mesh and an infinite sky",
    name="depth of 0, 1e-6, 1e6 and infinity in one frame",
)
def depth_of_all_kinds(inputs: Inputs) -> Inputs:
    depth = np.array(inputs.clip.frames.depth)
    for column, value in enumerate((1e-6, 1e6, 0.0, np.inf)):
        depth[:, :, column::4] = value
    return replaced(inputs, depth=depth, previous_depth=depth)


@case("nothing moves, and the renderer says so with zeros")
def motion_of_zero(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "motion", 0.0), "dual_motion", 0.0)


@case("the renderer has no vector for any pixel: fire, water, a mirror")
def no_vector_anywhere(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "motion", np.nan), "dual_motion", np.nan)


@case("exactly between two pixels")
def motion_of_half_a_pixel(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "motion", 0.5), "dual_motion", 0.5)


@case("a cut, or a teleport: every vector leads far outside")
def every_pixel_off_screen(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "motion", 1e4), "dual_motion", 1e4)


@case("a vector too large for any integer")
def motion_of_1e30(inputs: Inputs) -> Inputs:
    return filled(filled(inputs, "motion", 1e30), "dual_motion", -1e30)


@case("a new object fills the image: nothing was visible before")
def every_pixel_disoccluded(inputs: Inputs) -> Inputs:
    inputs = replaced(inputs, visible=np.zeros_like(inputs.clip.frames.visible))
    return filled(inputs, "dual_motion", 3.0)


@case("a cut to another scene, which the motion vectors do not show")
def cut(inputs: Inputs) -> Inputs:
    other = good(7).clip.frames
    frames = {}
    for name in Frame._fields:
        buffer = np.array(getattr(inputs.clip.frames, name))
        buffer[2:] = getattr(other, name)[2:, ::-1]
        frames[name] = buffer
    return replaced(inputs, **frames)


@case("the light is switched off")
def light_switched_off(inputs: Inputs) -> Inputs:
    radiance = np.array(inputs.clip.frames.radiance)
    radiance[1:] = 0
    return replaced(inputs, radiance=radiance)


def _scaled(inputs: Inputs, factor: float) -> Inputs:
    frames = inputs.clip.frames
    return replaced(inputs, depth=factor * frames.depth, previous_depth=factor * frames.previous_depth)


@case("a scene in kilometres, modelled in millimetres")
def scene_scaled_by_1e4(inputs: Inputs) -> Inputs:
    return _scaled(inputs, 1e4)


@case("a scene in millimetres, modelled in kilometres", name="scene scaled by 1e-4")
def scene_made_small(inputs: Inputs) -> Inputs:
    return _scaled(inputs, 1e-4)


@case("radiance in physical units, outdoors")
def brightness_times_1e3(inputs: Inputs) -> Inputs:
    inputs = inputs._replace(clip=inputs.clip._replace(reference=1e3 * inputs.clip.reference))
    return replaced(inputs, radiance=1e3 * inputs.clip.frames.radiance)


@case("radiance in physical units, by moonlight", name="brightness times 1e-3")
def brightness_made_small(inputs: Inputs) -> Inputs:
    inputs = inputs._replace(clip=inputs.clip._replace(reference=1e-3 * inputs.clip.reference))
    return replaced(inputs, radiance=1e-3 * inputs.clip.frames.radiance)


@case("a network trained with too high a learning rate")
def logits_of_1e4(inputs: Inputs) -> Inputs:
    return inputs._replace(logits=1e4 * np.sign(inputs.logits), blend=1e4 * np.sign(inputs.blend))


@case("an untrained network: all taps equal")
def logits_all_equal(inputs: Inputs) -> Inputs:
    return inputs._replace(logits=np.full_like(inputs.logits, 3.0), blend=np.zeros_like(inputs.blend))


@case("a network that returns its input")
def logits_one_hot(inputs: Inputs) -> Inputs:
    logits = np.full_like(inputs.logits, -1e4)
    logits[..., 12] = 0
    return inputs._replace(logits=logits)


@case("a network with a NaN among its weights")
def logits_with_one_that_is_not_a_number(inputs: Inputs) -> Inputs:
    logits = np.array(inputs.logits)
    logits[..., 3] = np.nan
    return inputs._replace(logits=logits)


@case("a metric over disoccluded pixels when there are none")
def mask_of_nothing(inputs: Inputs) -> Inputs:
    return inputs._replace(mask=np.zeros_like(inputs.mask))


@case("a metric over disoccluded pixels right after a cut")
def mask_of_everything(inputs: Inputs) -> Inputs:
    return inputs._replace(mask=np.ones_like(inputs.mask))


@case("numbers below the smallest normal one")
def subnormal_radiance(inputs: Inputs) -> Inputs:
    return filled(inputs, "radiance", 1e-40)


@case("a probe, or a minimal test")
def size_1x1(inputs: Inputs) -> Inputs:
    return good(height=1, width=1)


@case("one line of a still image")
def size_1x9_and_one_frame(inputs: Inputs) -> Inputs:
    return good(frames=1, height=1, width=9)


@case("smaller than every filter kernel, and the shortest clip that has a history")
def size_3x3_and_two_frames(inputs: Inputs) -> Inputs:
    return good(frames=2, height=3, width=3)


@case("a crop by hand: not divisible by a power of two")
def size_17x31(inputs: Inputs) -> Inputs:
    return good(height=17, width=31)
