"""The symmetries: a transformed clip is the clip of the transformed scene."""

import itertools

import numpy as np
import pytest

from jaxdn.core.frame import BUFFERS, Clip, Frame, present
from jaxdn.data.training.symmetries import transform_clip, transform_image, transform_motion

SYMMETRIES = list(itertools.product([False, True], range(4)))


def warp_reference(image: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Bilinear at p + motion(p), positions clamped to the outermost pixel centres, in float64."""
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    x = np.clip(columns + motion[..., 0], 0, width - 1)
    y = np.clip(rows + motion[..., 1], 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[..., None], (y - top)[..., None]
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    return upper * (1 - fy) + lower * fy


@pytest.mark.parametrize(("flip", "turns"), SYMMETRIES)
def test_warping_and_transforming_can_be_exchanged(rng: np.random.Generator, flip: bool, turns: int) -> None:
    history = rng.random((9, 13, 3))
    motion = 10 * rng.random((9, 13, 2)) - 5
    expected = transform_image(warp_reference(history, motion), flip=flip, turns=turns)
    found = warp_reference(
        transform_image(history, flip=flip, turns=turns), transform_motion(motion, flip=flip, turns=turns)
    )
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(("flip", "turns"), SYMMETRIES)
def test_the_librarys_own_warp_agrees(rng: np.random.Generator, flip: bool, turns: int) -> None:
    from jaxdn.ops.warp import warp

    history = rng.random((8, 8, 3), np.float32)
    motion = 10 * rng.random((8, 8, 2), np.float32) - 5
    expected = transform_image(np.asarray(warp(history, motion)), flip=flip, turns=turns)
    moved = transform_motion(motion, flip=flip, turns=turns)
    found = warp(np.ascontiguousarray(transform_image(history, flip=flip, turns=turns)), moved)
    np.testing.assert_allclose(np.asarray(found), expected, atol=2e-6)


def test_the_eight_are_different_and_make_a_group(rng: np.random.Generator) -> None:
    motion = rng.random((5, 5, 2))
    results = [transform_motion(motion, flip=flip, turns=turns) for flip, turns in SYMMETRIES]
    for one, other in itertools.combinations(results, 2):
        assert not np.array_equal(one, other)
    for result, (flip, turns) in zip(results, SYMMETRIES, strict=True):
        # The inverse of a rotation turns back; every reflection is its own inverse.
        back = transform_motion(result, flip=flip, turns=turns if flip else -turns)
        np.testing.assert_array_equal(back, motion)


def test_a_clip_is_transformed_in_every_buffer(rng: np.random.Generator) -> None:
    frames = Frame(**{name: rng.random((2, 4, 6, row.channels)) for name, row in BUFFERS.items() if name != "albedo"})
    layers = {1: frames.radiance + 2, 2: frames.radiance + 3}
    clip = transform_clip(Clip(frames, frames.radiance + 1, layers), flip=True, turns=1)
    assert clip.frames.albedo is None
    np.testing.assert_array_equal(clip.reference, clip.frames.radiance + 1)
    for samples, offset in ((1, 2), (2, 3)):
        np.testing.assert_array_equal(clip.layers[samples], clip.frames.radiance + offset)
    # Pixel (x, y) of an image 6 wide goes to 5 - x by the flip, and then (x, y) -> (y, 5 - x) by the turn: (y, x).
    for name in ("radiance", *present(frames)):
        before, after = getattr(frames, name)[:, 1, 5], getattr(clip.frames, name)[:, 5, 1]
        turned = before[..., ::-1] if BUFFERS[name].kind == "vector" else before  # normals are in world space
        np.testing.assert_array_equal(after, turned, err_msg=name)


def test_vectors_that_are_not_motion_are_turned_too(rng: np.random.Generator) -> None:
    """Vectors of shadows and reflections lie in the image plane; a gradient of luminance does not."""
    plane = rng.random((1, 4, 4, 2))
    frames = Frame(rng.random((1, 4, 4, 3)), shadow_motion=plane, glossy_motion=plane, luminance_gradient=plane)
    found = transform_clip(Clip(frames), flip=False, turns=2).frames
    back = plane[:, ::-1, ::-1]
    np.testing.assert_array_equal(found.shadow_motion, -back)
    np.testing.assert_array_equal(found.glossy_motion, -back)
    np.testing.assert_array_equal(found.luminance_gradient, back)
