"""Motion blur and depth of field of sharp images, against what a shutter and a lens would have seen."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.filters.camera_blur import blur_lens, blur_motion, compute_confusion_radius

HEIGHT, WIDTH = 40, 72
RED, GREEN = np.array([1, 0, 0], np.float32), np.array([0, 1, 0], np.float32)


def noise(channels: int = 3) -> np.ndarray:
    return np.random.default_rng(0).random((HEIGHT, WIDTH, channels)).astype(np.float32)


def flat(value: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 1), value, np.float32)


def vectors(x: float, y: float) -> np.ndarray:
    return np.broadcast_to(np.array([x, y], np.float32), (HEIGHT, WIDTH, 2)).copy()


def box(image: np.ndarray, length: float, axis: int) -> np.ndarray:
    """What a shutter sees of an image that goes ``length`` pixels: the mean over the way, in float64."""
    moments = np.linspace(-0.5, 0.5, 2001)[1::2] * length
    shifts, counts = np.unique(np.round(moments).astype(int), return_counts=True)
    parts = [
        count * np.roll(image.astype(np.float64), shift, axis) for shift, count in zip(shifts, counts, strict=True)
    ]
    return np.asarray(sum(parts) / counts.sum())


def test_what_stands_still_and_is_sharp_is_not_changed() -> None:
    image = noise()
    np.testing.assert_array_equal(blur_motion(image, vectors(0, 0), flat(5), 0.5), image)
    np.testing.assert_array_equal(blur_motion(image, vectors(30, 0), flat(5), 0.0), image)
    np.testing.assert_array_equal(blur_lens(image, flat(0.0), flat(5)), image)


@pytest.mark.parametrize(("x", "y"), [(-20.0, 0.0), (0.0, 12.0)])
def test_a_pan_is_the_mean_over_the_way(x: float, y: float) -> None:
    image = noise()
    blurred = np.asarray(blur_motion(image, vectors(x, y), flat(5), 0.5))
    wanted = box(image, 0.5 * np.hypot(x, y), 1 if x else 0)
    np.testing.assert_allclose(blurred[8:-8, 8:-8], wanted[8:-8, 8:-8], atol=0.01)


def moving_square(depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A red square that goes 24 pixels a frame before green that stands; and what a shutter of 0.5 sees."""
    square = np.zeros((HEIGHT, WIDTH), bool)
    square[10:30, 24:48] = True
    motion, z = vectors(0, 0), flat(5.0)
    motion[square], z[square] = [-24, 0], depth
    covered = box(square[..., None].astype(np.float32), 12.0, 1)
    return np.where(square[..., None], RED, GREEN), motion, z, covered


@pytest.mark.parametrize("depth", [2.0, 5.0], ids=["in front", "in the same depth"])
def test_what_is_covered_for_a_part_of_the_time_is_hidden_by_that_part(depth: float) -> None:
    image, motion, z, covered = moving_square(depth)
    blurred = np.asarray(blur_motion(image, motion, z, 0.5))
    np.testing.assert_allclose(blurred, covered * RED + (1 - covered) * GREEN, atol=0.06)


def test_what_moves_behind_something_does_not_cover_it() -> None:
    image, motion, z, _ = moving_square(8.0)
    before = ~(z[..., 0] == 8.0)
    blurred = np.asarray(blur_motion(image, motion, z, 0.5))
    np.testing.assert_allclose(blurred[before], image[before], atol=1e-6)


def test_parts_of_an_image_still_add_up_to_it() -> None:
    first, second = noise(2), noise(4)[..., 2:]
    motion, z = vectors(-9, 4), 1 + flat(1) * noise(1)
    radius = 3 * noise(1)
    for blur in (lambda image: blur_motion(image, motion, z, 0.7), lambda image: blur_lens(image, radius, z)):
        np.testing.assert_allclose(blur(first) + blur(second), blur(first + second), rtol=2e-5, atol=2e-6)


def test_a_point_becomes_the_disc_of_its_circle_of_confusion() -> None:
    image = np.zeros((HEIGHT, WIDTH, 1), np.float32)
    image[20, 36] = 1
    blurred = np.asarray(blur_lens(image, flat(6.0), flat(5)))[..., 0]
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    away = np.hypot(rows - 20, columns - 36)
    assert blurred.sum() == pytest.approx(1, abs=0.1)
    assert blurred[away > 7.5].max() == 0
    inner = blurred[away < 4.5]
    np.testing.assert_allclose(inner.mean(), 1 / (np.pi * 36), rtol=0.1)


def test_what_is_near_and_out_of_focus_covers_what_is_sharp_behind_it_but_not_the_other_way_round() -> None:
    left = np.arange(WIDTH)[None, :, None] < WIDTH // 2
    image = np.broadcast_to(np.where(left, RED, GREEN), (HEIGHT, WIDTH, 3)).copy()
    depth = np.broadcast_to(np.where(left, 1.0, 5.0), (HEIGHT, WIDTH, 1)).astype(np.float32)
    near = np.broadcast_to(np.where(left, 6.0, 0.0), (HEIGHT, WIDTH, 1)).astype(np.float32)
    red = np.asarray(blur_lens(image, near, depth))[HEIGHT // 2, :, 0]
    assert red[WIDTH // 2] == pytest.approx(0.5, abs=0.1)
    assert 0.05 < red[WIDTH // 2 + 4] < 0.3
    assert 0.7 < red[WIDTH // 2 - 5] < 0.98
    assert red[WIDTH // 2 + 8] == 0
    far = np.where(left, 0.0, 6.0).astype(np.float32) * np.ones((HEIGHT, 1, 1), np.float32)
    behind = np.asarray(blur_lens(image, far, depth))
    np.testing.assert_allclose(behind[:, : WIDTH // 2], image[:, : WIDTH // 2], atol=1e-6)


def test_the_circle_of_confusion_is_that_of_a_thin_lens() -> None:
    """Rays from both ends of a lens through the point in focus, traced to the depth and back through the middle."""
    focus, diameter, focal, depth = 3.0, 0.02, 1500.0, 7.0
    across = diameter * abs(depth - focus) / focus  # of both rays' points at the depth
    radius = compute_confusion_radius(jnp.asarray([depth, focus]), focus, diameter * focal / (2 * focus))
    np.testing.assert_allclose(radius, [across / depth * focal / 2, 0.0], rtol=1e-5)


def test_vectors_that_are_not_known_count_as_none() -> None:
    motion = vectors(0, 0)
    motion[5, 5] = np.nan
    np.testing.assert_array_equal(blur_motion(noise(), motion, flat(5), 0.5), noise())


def test_sizes_are_checked() -> None:
    with pytest.raises(ValueError, match=r"motion: expected 2 channels"):
        blur_motion(noise(), noise(3), flat(5), 0.5)
    with pytest.raises(ValueError, match=r"image and depth: expected the same size"):
        blur_lens(noise(), flat(1), np.ones((3, 3, 1), np.float32))
