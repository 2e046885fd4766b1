"""What is wrong with a shot, from the figures of its frames: each finding with what to do about it."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from jaxdn.data.foreign.vectors import MOTION_CONVENTIONS
from jaxdn.evaluation.overlay.evidence import FLIPS
from jaxdn.evaluation.overlay.geometry import AS_GIVEN, MIRRORED
from jaxdn.evaluation.overlay.measure import MOVES, TURNED

CLEARLY = 0.6
"""Something else fits better if it leaves less than this share of what the given thing leaves ..."""
TURNED_BETTER = 0.75
"""... and vectors that are turned around if they leave less than this share."""
MANY = 0.25
"""Share of the pixels from which on a disagreement is no matter of edges."""
SEEN = 0.05
"""Share of the picture on which given and measured motion have to differ: what less texture shows may be a mirror."""
SPARKS = 0.002
"""Share of the pixels that are fireflies from which on they are told."""
NOISE_FREE = 0.002
"""Noise of the light below which there is nothing to denoise."""
NOISY_GUIDE = 0.1
"""Median noise of a guide from which on it keeps noise in the picture."""
BRIGHTER = 1.3
"""A frame so many times brighter or darker than both its neighbours, which agree, was rendered otherwise."""
WRONG_ORDER = 0.3
"""Share of newly visible pixels that are behind what hid them, below which depth falls with the distance."""
AGREES = 0.6
"""Share of the directions that has to agree with the depth before normals are called flipped ..."""
CLEARER = 1.2
"""... and how many times larger it has to be than that of the normals as they are."""
POINT_AWAY = 0.05
"""Share of the pixels from which on normals that point into the surface are told, if these and those that agree ..."""
MOST_NORMALS = 0.9
"""... are this share: on mirrors and glass, renderers write the normals of what is seen there."""

_SIGNS = {"previous-current": (1, 1), "current-previous": (-1, -1), "cycles": (1, -1), "forward-up": (-1, 1)}
"""The factors of x and y of conventions in pixels."""


class Finding(NamedTuple):
    """One thing that is wrong."""

    name: str
    evidence: str
    """What was measured, as a sentence."""
    remedy: str
    """What to do."""


class Known(NamedTuple):
    """What is known of a shot besides the figures of its frames."""

    convention: str | None
    """Of its motion vectors; None: they are ours, or there are none."""
    unusable: Mapping[str, str]
    """File -> why it is no frame of the shot."""
    missing: str
    """The numbers of missing frames, in words; empty: none."""
    unexplained: Sequence[str] | None = None
    """Of vectors whose convention nobody has stated, so that they were left out, the conventions that fit; None: there
    are no such vectors."""
    layers: Mapping[str, str] = MappingProxyType({})
    """Buffer -> the layer that it is read from."""


def find_all(names: Sequence[str], figures: Sequence[Mapping[str, float]], known: Known) -> list[Finding]:
    """What is wrong with a shot; nothing for a good one.

    Args:
      names: of the files, of the frames in ``figures``.
      figures: of each frame (:class:`jaxdn.evaluation.overlay.measure.FrameOverlay`).
      known: the rest.
    """
    keys = {key for each in figures for key in each}
    mean = {key: float(np.mean([each[key] for each in figures if key in each])) for key in keys}
    frames = [*_frames(known), *_brightness(names, figures)]
    vectors, guides = _motion(mean, known), _guides(mean, known)
    causes = [*vectors, *guides, *([] if vectors else _depth(mean)), *([] if guides else _normals(mean))]
    return [*frames, *causes, *([] if causes else _history(mean)), *_noise(mean)]


def _frames(known: Known) -> list[Finding]:
    """Files that are no frames of the shot, and gaps."""
    found = []
    if known.unusable:
        shown = "; ".join(f"{name}: {reason}" for name, reason in list(known.unusable.items())[:8])
        more = f"; and {len(known.unusable) - 8} more" if len(known.unusable) > 8 else ""
        found.append(
            Finding(
                "frames that differ",
                f"{shown}{more}.",
                "Render these frames again with the settings of the others. jaxdn denoise leaves them out as missing.",
            )
        )
    if known.missing:
        found.append(
            Finding(
                "missing frames",
                f"{known.missing} missing.",
                "Render them: after a gap there is no history at first.",
            )
        )
    return found


def _brightness(names: Sequence[str], figures: Sequence[Mapping[str, float]]) -> list[Finding]:
    """Single frames of another exposure."""
    light = [max(each["light"], 1e-12) for each in figures]
    odd = []
    for index in range(1, len(light) - 1):
        before, now, after = light[index - 1 : index + 2]
        alike = max(before, after) < 1.1 * min(before, after)
        if alike and not 1 / BRIGHTER < now / (0.5 * (before + after)) < BRIGHTER:
            odd.append(f"{names[index]} ({2 * now / (before + after):.2f} times as bright as its neighbours)")
    if not odd:
        return []
    remedy = "Compare exposure, lights and samples of these frames, and render them again."
    return [Finding("frames of another brightness", f"{', '.join(odd[:8])}.", remedy)]


def _motion(mean: Mapping[str, float], known: Known) -> list[Finding]:
    """Vectors that mean something else, or are missing."""
    if known.unexplained is not None:
        return [_unexplained_motion(known.unexplained)]
    if "left as given" not in mean and "disagrees" not in mean:
        if mean.get("measured motion", 0.0) > MANY:
            return [_missing_motion(mean)]
        return []
    if forward := _exchanged_motion(mean):
        return [forward]
    given = mean.get("left as given")
    tried = {name: mean[f"left {name}"] for name in (*TURNED, "swapped") if f"left {name}" in mean}
    if given is not None:
        best = min(tried, key=lambda name: tried[name])
        if best != "as given" and tried[best] < (CLEARLY if best == "left out" else TURNED_BETTER) * given:
            return [_turned_motion(best, tried[best] / given, known)]
    if "left by camera" in mean and mean["camera differs"] > MANY:
        ratio = mean["left by camera"] / max(mean["left beside camera"], 1e-12)
        if ratio < CLEARLY:
            return [_other_than_camera(mean, ratio)]
    ratio = mean.get("left by measured", 1.0) / max(mean.get("left by given", 1.0), 1e-12)
    disagrees = mean.get("disagrees", 0.0)
    if disagrees > MANY and disagrees * mean["certain"] > SEEN and ratio < CLEARLY:
        return [_disagreeing_motion(mean, ratio)]
    return []


def _unexplained_motion(fitting: Sequence[str]) -> Finding:
    named = " or ".join(f"--motion-convention {name}" for name in fitting)
    return Finding(
        "vectors without a meaning",
        "The files have motion vectors, and nothing says what they mean. They are left out here.",
        f"State {named}: so the first frames come onto each other." if fitting else "State --motion-convention.",
    )


def _missing_motion(mean: Mapping[str, float]) -> Finding:
    share = mean["measured motion"]
    return Finding(
        "no motion vectors",
        f"{share:.0%} of the pixels with texture move by more than {MOVES} pixels, and the files have no vectors.",
        "Switch on the renderer's motion vectors (Blender: Passes > Vector, and motion blur off). Without them motion "
        "is measured, which does not follow shadows, reflections and what is small and fast.",
    )


def _exchanged_motion(mean: Mapping[str, float]) -> Finding | None:
    """Vectors that lead to the next frame; at even speed they are those to the frame before, turned around."""
    before = min(mean.get("left as given", 0.0), mean.get("left turned around", 0.0))
    after = min(mean.get("left as forward", np.inf), mean.get("left as forward turned", np.inf))
    if not after < TURNED_BETTER * before:
        return None
    return Finding(
        "exchanged vectors",
        f"The vectors lead to the next frame: to it they leave {after / before:.0%} of what they leave otherwise.",
        "Write those to the frame before (of Blender's Vector, X and Y are to the frame before, Z and W to the next). "
        "--motion-convention none leaves them out.",
    )


def _turned_motion(best: str, ratio: float, known: Known) -> Finding:
    """Vectors that fit when something about them is changed."""
    if best == "left out":
        return Finding(
            "vectors where nothing moves",
            f"No motion fits better than the given vectors: it leaves {ratio:.0%} of the difference between frames.",
            "Check that the vectors belong to these frames. --motion-convention none leaves them out.",
        )
    if best == "swapped":
        advice = _state("rows-columns", known)
        return Finding(
            "flipped vectors", f"With x and y swapped, the vectors leave {ratio:.0%} of the difference.", advice
        )
    x, y = _SIGNS.get(known.convention or "previous-current", (0, 0))
    factor_x, factor_y = TURNED[best]
    wanted = (x * factor_x, y * factor_y)
    name = next((name for name, signs in _SIGNS.items() if signs == wanted), None)
    return Finding(
        "flipped vectors",
        f"The vectors fit {best}: so they leave {ratio:.0%} of the difference between frames.",
        _state(name, known),
    )


def _state(name: str | None, known: Known) -> str:
    """What to do about vectors that have another convention."""
    if name is None:
        taken = MOTION_CONVENTIONS.get(known.convention or "", "as they are")
        return f"They were taken for: {taken}. Turn the signs where they are written, or state --motion-convention."
    return f"State --motion-convention {name} ({MOTION_CONVENTIONS[name]})."


def _other_than_camera(mean: Mapping[str, float], ratio: float) -> Finding:
    return Finding(
        "vectors without the camera",
        f"{mean['camera differs']:.0%} of the vectors differ from depth and camera by more than {MOVES} pixels; those "
        f"of the camera leave {ratio:.0%} of the difference between frames.",
        "Switch on the camera's part of the motion vectors. Some programs write the motion of objects alone.",
    )


def _disagreeing_motion(mean: Mapping[str, float], ratio: float) -> Finding:
    return Finding(
        "vectors of something else",
        f"{mean['disagrees']:.0%} of the vectors differ from the measured motion, which leaves {ratio:.0%} of the "
        "difference between frames.",
        "Check that the vectors are those of this frame, in pixels of this size, and to the frame before. Look at the "
        "views of given and measured motion.",
    )


def _history(mean: Mapping[str, float]) -> list[Finding]:
    """History that the surface test rejects nearly everywhere."""
    rejected = mean.get("rejected", 0.0)
    by = {guide: mean.get(f"rejected by {guide}", 0.0) for guide in ("depth", "normal", "ids")}
    guide = max(by, key=lambda name: by[name])
    if rejected < 0.5 or by[guide] < 0.3:
        return []
    remedies = {
        "depth": "Check that depth is measured along the optical axis, in one unit in all frames, and without noise.",
        "normal": "Check that normals are in world space, and without noise.",
        "ids": "The ids change from frame to frame. Leave them out: --channels ids=none.",
    }
    evidence = f"{rejected:.0%} of the pixels have no history; {guide} alone rejects {by[guide]:.0%}."
    return [Finding("history is rejected", evidence, remedies[guide])]


def _exchange(known: Known) -> str:
    """The option that reads albedo and normals from each other's layer."""
    albedo, normal = (known.layers.get(buffer, "...") for buffer in ("albedo", "normal"))
    return f'Name the two layers the other way around: --channels "albedo={normal}" "normal={albedo}"'


def _guides(mean: Mapping[str, float], known: Known) -> list[Finding]:
    """Guides that hold something else, or lie otherwise than the picture."""
    found = []
    unit, encoded = mean.get("unit normals", 1.0), mean.get("encoded normals", 0.0)
    if mean.get("negative normals", 1.0) < 0.02 and mean.get("negative albedo", 0.0) > 0.05:
        what = f"Normals have no negative component, and {mean['negative albedo']:.0%} of the albedo is negative."
        remedy = f"{_exchange(known)}."
        found.append(Finding("swapped guides: albedo and normal", what, remedy))
    elif max(unit, encoded) < 0.5 and mean.get("albedo of normals", 0.0) > 0.8:
        what = f"{mean['albedo of normals']:.0%} of the albedo are normals stored as colours, and the normals are none."
        remedy = f"{_exchange(known)}, and write normals with their signs, from -1 to 1."
        found.append(Finding("swapped guides: albedo and normal", what, remedy))
    elif unit < 0.5 and encoded > 0.5:
        what = f"{encoded:.0%} of the normals have unit length as 2 n - 1, and {unit:.0%} as they are."
        found.append(Finding("normals stored as colours", what, "Write normals with their signs, from -1 to 1."))
    elif unit < 0.5 and mean.get("normal noise", 0.0) < NOISY_GUIDE / 2:  # means of noisy normals are short
        what = f"{1 - unit:.0%} of the normals have another length than 1."
        remedy = "Name the layer that holds normals, or leave this one out: --channels normal=none."
        found.append(Finding("normals that are none", what, remedy))
    elif mean.get("negative albedo", 0.0) > 0.05:
        what = f"{mean['negative albedo']:.0%} of the albedo is negative."
        remedy = "Name the layer that holds the albedo, or leave this one out: --channels albedo=none."
        found.append(Finding("an albedo that is none", what, remedy))
    return found + _turned_guides(mean)


def _depth(mean: Mapping[str, float]) -> list[Finding]:
    """Depth that falls with the distance, or that has no unit."""
    order = mean.get("occlusion order", 1.0)
    leave = "or leave depth out: --channels depth=none."
    if order < WRONG_ORDER:
        what = f"{1 - order:.0%} of the pixels that come into sight have less depth than what hid them."
        remedy = f"Write the distance itself, not 1 / z and nothing that falls with the distance, {leave}"
        return [Finding("inverted depth", what, remedy)]
    if mean.get("normalised depth", 0.0) > 0.5:
        what = "Depth is from 0 to 1, and reaches 1: it was normalised, or is a z-buffer's value."
        return [Finding("normalised depth", what, f"Write the distance in the scene's unit, {leave}")]
    return []


def _normals(mean: Mapping[str, float]) -> list[Finding]:
    """Normals that contradict the slopes of the depth."""
    prefix = "normals agree "
    agree = {key.removeprefix(prefix): share for key, share in mean.items() if key.startswith(prefix)}
    if not agree or mean.get("occlusion order", 1.0) < WRONG_ORDER:
        return []
    best = max(agree, key=lambda name: agree[name])
    if agree[best] > AGREES and agree[best] > CLEARER * agree[AS_GIVEN]:
        told = (
            f"{agree[best]:.0%} of their directions agree with the slopes of the depth {best}, {agree[AS_GIVEN]:.0%} so"
        )
        axes = "one axis, or all three" if best == MIRRORED else best.removeprefix("with ").removesuffix(" turned")
        remedy = f"Turn the sign of {axes} where normals are written, or leave them out: --channels normal=none."
        if best == MIRRORED:
            remedy += " If the renderer's world is left-handed, they are right."
        return [Finding("flipped normals", f"{told}.", remedy)]
    if mean["normals away"] > POINT_AWAY and mean["normals agreeing"] + mean["normals away"] > MOST_NORMALS:
        what = f"{mean['normals away']:.1%} of the normals point into the surface, and those of other surfaces do not."
        remedy = "Recalculate the normals of these meshes, or write those that face the camera."
        return [Finding("normals that point away", what, remedy)]
    return []


def _turned_guides(mean: Mapping[str, float]) -> list[Finding]:
    """Guides whose edges lie on those of the beauty only when they are turned."""
    found = []
    for guide in ("albedo", "normal", "depth"):
        upright = mean.get(f"{guide} as it is")
        if upright is None:
            continue
        flips = {name: mean.get(f"{guide} {name}", -1.0) for name in FLIPS}
        best = max(flips, key=lambda name: flips[name])
        if flips[best] > 0.25 and flips[best] > upright + 0.15:
            what = f"The edges of {guide} correlate with the beauty's by {flips[best]:.2f} {best}, by {upright:.2f} so."
            remedy = f"Write {guide} the same way up as the beauty, or leave it out: --channels {guide}=none."
            found.append(Finding(f"flipped guide: {guide}", what, remedy))
    return found


def _noise(mean: Mapping[str, float]) -> list[Finding]:
    """Noise that stands still, that is not there, that sparks, or that is in the guides; pixels without light."""
    found = []
    if mean.get("invalid", 0.0) > 0:
        what = f"{mean['invalid']:.2%} of the pixels are NaN or infinite."
        remedy = "Look in the renderer for what makes them. jaxdn denoise replaces them by what is around."
        found.append(Finding("light that is no number", what, remedy))
    if "noise" not in mean:
        remedy = "Name the layer that has the picture: --channels radiance=LAYER."
        found.append(Finding("no light", "No pixel of any frame has light.", remedy))
    elif mean["noise"] < NOISE_FREE:
        what = f"The noise is {mean['noise']:.2%} of the light."
        found.append(Finding("no noise", what, "If the frames were denoised already, give those that were not."))
    elif mean.get("same noise", 0.0) > 0.8:
        what = f"{mean['same noise']:.0%} of the still pixels have the noise of the frame before."
        found.append(Finding("noise that stands still", what, "Animate the seed of the renderer."))
    if mean["fireflies"] > SPARKS:
        what = f"{mean['fireflies']:.2%} of the pixels are single bright ones."
        remedy = "Clamp indirect light in the renderer, switch caustics off, or render more samples."
        found.append(Finding("fireflies", what, remedy))
    for guide in ("albedo", "normal"):
        if mean.get(f"{guide} noise", 0.0) > NOISY_GUIDE:
            what = f"The noise of {guide} is {mean[f'{guide} noise']:.2f}, where values reach 1."
            remedy = "Render guides with more samples, or without depth of field and motion blur."
            found.append(Finding(f"noisy guide: {guide}", what, remedy))
    return found
