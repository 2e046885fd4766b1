"""Rotated discs, the weight of closeness, and steady luminance against float64 loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.filters.disc import TAPS, disc_average, rotations
from jaxdn.filters.edge_stopping import closeness_weight, depth_weight, normal_weight
from jaxdn.filters.stabilisation import stabilise
from tests.gradients import check_gradients

stable = jax.jit(stabilise, static_argnames="sigma")

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
HEIGHT, WIDTH = 9, 11


def surfaces(rng):
    depth = 4 + 0.2 * np.arange(WIDTH) + rng.normal(0, 0.05, (HEIGHT, WIDTH))
    normal = rng.normal(0, 0.2, (HEIGHT, WIDTH, 3)) + [0, 0, -1]
    return depth, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def reference_slopes(depth):
    """Of the two differences along each axis the one that is smaller."""
    slopes = np.zeros((*depth.shape, 2))
    for y, x in np.ndindex(depth.shape):
        for axis, (dy, dx) in enumerate(((0, 1), (1, 0))):
            found = []
            for sign in (1, -1):
                v, u = y + sign * dy, x + sign * dx
                if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1]:
                    found.append(sign * (depth[v, u] - depth[y, x]))
            slopes[y, x, axis] = min(found, key=abs)
    return slopes


def reference_disc(values, hit, depth, normal, radius, angle):
    out, slopes = np.zeros_like(values), reference_slopes(depth)
    for y, x in np.ndindex(depth.shape):
        if not hit[y, x]:
            continue
        total, weights = values[:, y, x].copy(), 1.0
        for number in range(8):
            far = 1.0 if number < 4 else 0.5
            around = angle[y, x] + np.pi / 2 * number + (0 if number < 4 else np.pi / 4)
            dx, dy = (np.round(radius[y, x] * far * part(around)) for part in (np.cos, np.sin))
            v, u = y + int(dy), x + int(dx)
            if not (0 <= v < HEIGHT and 0 <= u < WIDTH) or not hit[v, u]:
                continue
            scale = abs(slopes[y, x] @ [dx, dy]) + 1e-3 / HEIGHT * np.hypot(dx, dy) * depth[y, x] + 1e-10
            w = np.exp(-0.66 * far**2) * np.exp(-abs(depth[v, u] - depth[y, x]) / scale)
            w *= max(0.0, normal[y, x] @ normal[v, u]) ** 16
            total, weights = total + w * values[:, v, u], weights + w
        out[:, y, x] = total / weights
    return out


def test_a_disc_matches_a_loop(rng, x64):
    depth, normal = surfaces(rng)
    values, hit = rng.exponential(size=(4, HEIGHT, WIDTH)), rng.random((HEIGHT, WIDTH)) < 0.8
    radius, angle = rng.uniform(0, 6, (HEIGHT, WIDTH)), rng.uniform(0, 7, (HEIGHT, WIDTH))

    @jax.jit
    def average(values, hit, depth, normal, radius, angle):
        by_depth = depth_weight(depth[..., None], None, sigma=1.0, height=len(depth))
        return disc_average(values, hit, [by_depth, normal_weight(normal, sigma=16.0)], radius, angle)

    found = average(values, hit, depth, normal, radius, angle)
    np.testing.assert_allclose(found, reference_disc(values, hit, depth, normal, radius, angle), rtol=1e-9)


def test_tiles_do_not_show(rng, monkeypatch):
    given = rng.random((3, HEIGHT, WIDTH)), None, [], np.full((HEIGHT, WIDTH), 3.0), rng.uniform(0, 6, (HEIGHT, WIDTH))
    whole = jax.jit(lambda *given: disc_average(*given))(*given)
    monkeypatch.setattr("jaxdn.filters.disc._TILE_PIXELS", 2 * WIDTH)
    # Another function: what is compiled of the first has its tile.
    np.testing.assert_allclose(jax.jit(lambda *given: disc_average(*given))(*given), whole, rtol=1e-6)


def test_a_disc_of_no_size_changes_nothing(rng):
    values, nothing = rng.random((3, HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH))
    np.testing.assert_allclose(jax.jit(disc_average)(values, None, [], nothing, nothing), values, rtol=1e-6)


def test_rotations_are_even_and_differ_from_frame_to_frame():
    turn = jax.jit(lambda number: rotations((64, 64), number, jnp.dtype("float32")))
    first, second = (np.asarray(turn(number)) for number in (3, 4))
    np.testing.assert_array_equal(first, turn(3))
    for angles in (first, second):
        np.testing.assert_allclose(np.histogram(angles, 8, (0, 2 * np.pi))[0], 512, rtol=0.2)
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    assert abs(np.corrcoef(first[:, 1:].ravel(), first[:, :-1].ravel())[0, 1]) < 0.05


def test_the_taps_are_on_two_rings():
    np.testing.assert_allclose(np.sort(np.hypot(*TAPS[:, :2].T)), [0.5] * 4 + [1.0] * 4)
    np.testing.assert_allclose(TAPS[:, :2].sum(0), 0.0, atol=1e-12)


def test_gradients_reach_values_and_guides(rng, x64):
    depth, _ = surfaces(rng)
    radius, angle = rng.uniform(1, 4, (2, HEIGHT, WIDTH))

    def mean(values, depth):
        return disc_average(
            values, None, [depth_weight(depth[..., None], None, sigma=1.0, height=len(depth))], radius, angle
        )

    check_gradients(mean, (rng.random((2, HEIGHT, WIDTH)), depth), eps=1e-7)


def test_the_weight_of_closeness_is_its_formula(rng, x64):
    here, there = rng.random((2, 5, 6))
    here[0], there[:, 0] = 0.0, 0.0

    @jax.jit
    def exponent(here, there):
        return closeness_weight(here, tolerance=0.2, least=0.1).exponent([there], [here], None)

    found = np.exp(-np.asarray(exponent(here, there)))
    expected = np.where((here > 0) & (there > 0), np.maximum(np.exp(-abs(here - there) / 0.2), 0.1), 1.0)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert (expected == 0.1).any()


def test_steady_luminance_matches_a_loop(rng, x64):
    color, past = rng.exponential(size=(3, HEIGHT, WIDTH)), rng.exponential(size=(HEIGHT, WIDTH))
    color[:, 2, 3] = 0.0
    share, hit = rng.uniform(0, 0.97, (HEIGHT, WIDTH)), rng.random((HEIGHT, WIDTH)) < 0.8
    image, kept = map(np.asarray, stable(color, past, share, hit, sigma=0.7))
    level = np.einsum("cyx,c->yx", color, LUMINANCE)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        box = slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2)
        near = level[box][hit[box]]
        assert near.size
        mean, deviation = near.mean(), np.sqrt(max(near.var(), 1e-10))
        low, high = min(mean - 0.7 * deviation, level[y, x]), max(mean + 0.7 * deviation, level[y, x])
        steady = level[y, x] + share[y, x] * (np.clip(past[y, x], low, high) - level[y, x])
        if level[y, x] == 0:
            assert kept[y, x] == 0
            continue
        np.testing.assert_allclose(kept[y, x], steady, rtol=1e-6)
        np.testing.assert_allclose(image[:, y, x], color[:, y, x] * steady / level[y, x], rtol=1e-6)


@pytest.mark.parametrize("brightness", [0.0, 1e-9, 1.0, 1e4])
def test_an_even_image_stays_even(brightness):
    even = np.full((3, 4, 5), brightness, np.float32)
    image, kept = stable(even, even[0], np.full((4, 5), 0.9), None, sigma=1.0)
    np.testing.assert_allclose(image, even, rtol=1e-5)
    np.testing.assert_allclose(kept, even[0], rtol=1e-5)
