"""Virtual motion, lobes, clamps and fixed histories against float64 references and analytic geometry."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.filters.atrous import edge_average, stencil
from jaxdn.filters.clamping import (
    clamp_fireflies,
    clamp_to_fast,
    detect_lag,
    firefly_attenuation,
    measure_neighbourhood,
)
from jaxdn.filters.edge_stopping import lobe_weight, normal_weight, roughness_weight
from jaxdn.filters.history_fix import fix_history
from jaxdn.filters.virtual_motion import closeness, diffuseness, virtual_motion
from tests.gradients import check_gradients
from tests.recomputing import evaluate_recomputing

attenuate = jax.jit(firefly_attenuation)

FOCAL, SIZE = 160.0, np.array([320.0, 180.0])


def turned(degrees, axis):
    """Rodrigues."""
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def projected(points, rotation, place):
    """Pixels and depths of world points in a camera that looks along its own z."""
    local = (points - place) @ rotation
    return FOCAL * local[:, :2] / local[:, 2:] + SIZE / 2, local[:, 2]


def mirror_scene(rng, rotation, place, count=200):
    """What a frame tells of points seen in a slanted mirror, and where their images were in the previous frame."""
    normal = np.array([0.3, 0.2, -1.0]) / np.linalg.norm([0.3, 0.2, -1.0])
    point = np.array([0.0, 0.0, 6.0])
    rays = np.concatenate([rng.uniform(-0.9, 0.9, (count, 2)) * [1.0, 0.55], np.ones((count, 1))], axis=1)
    surface = rays * ((point @ normal) / (rays @ normal))[:, None]
    direction = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    reflected = direction - 2 * (direction @ normal)[:, None] * normal
    length = rng.uniform(0.2, 20.0, (count, 1))
    thing = surface + length * reflected
    image = thing - 2 * ((thing - point) @ normal)[:, None] * normal
    np.testing.assert_allclose(np.cross(image, rays), 0.0, atol=1e-9)  # on the camera ray

    pixel, depth = projected(surface, np.eye(3), np.zeros(3))
    before, previous_depth = projected(surface, rotation, place)
    far, _ = projected(direction * 1e12, rotation, place)
    expected, _ = projected(image, rotation, place)
    near = closeness(length, np.linalg.norm(surface, axis=1, keepdims=True))
    shape = (1, count)
    found = jax.jit(virtual_motion)(
        (before - pixel).reshape(*shape, 2),
        (far - pixel).reshape(*shape, 2),
        (previous_depth / depth).reshape(shape),
        near.reshape(shape),
    )
    parallax = np.linalg.norm(before - far, axis=1)
    return np.asarray(found)[0], expected - pixel, parallax


def test_virtual_motion_is_that_of_the_image_in_a_flat_mirror(x64, rng):
    found, expected, parallax = mirror_scene(rng, np.eye(3), np.array([0.2, -0.1, 0.3]))
    assert np.median(parallax) > 5
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("axis", [(0, 1, 0), (1, 0, 0), (0, 0, 1), (1, 2, 3)])
def test_virtual_motion_holds_where_the_camera_turns_too(x64, rng, axis):
    found, expected, parallax = mirror_scene(rng, turned(1.0, axis), np.array([0.2, -0.1, 0.1]))
    assert np.all(np.linalg.norm(found - expected, axis=1) < 0.005 * parallax)


def test_virtual_motion_without_a_hit_distance_is_the_surfaces(rng):
    motion, far = rng.normal(size=(2, 3, 4, 2)).astype(np.float32)
    moved = jax.jit(virtual_motion)
    unknown = moved(motion, far, None, np.zeros((3, 4)))
    np.testing.assert_array_equal(unknown, motion)
    touching = moved(motion, far, None, np.ones((3, 4)))
    np.testing.assert_allclose(touching, motion, rtol=1e-6)
    assert np.all(np.asarray(jax.jit(closeness)(np.array([0.0, 1.0, 1e9]), np.full(3, 3.0))) >= 0)


def test_diffuseness_is_the_curve_and_has_a_slope_everywhere():
    rough = np.array([0.0, 0.01, 0.05, 0.3, 1.0])
    expected = (1 - 2.0 ** (-200 * rough**2)) * rough**0.25
    np.testing.assert_allclose(jax.jit(diffuseness)(rough), expected, rtol=1e-5)
    assert float(jax.jit(diffuseness)(1.0)) == 1.0
    assert np.isfinite(jax.jit(jax.grad(diffuseness))(0.0))


def test_the_lobes_weight_is_a_gaussian_of_the_angle_between_normals(x64, rng):
    """One tap beside the centre: its share of the mean is w / (1 + w)."""

    @jax.jit
    def average(normal, rough):
        weight = lobe_weight(normal, rough, fraction=0.5)
        return edge_average(jnp.array([[[0.0, 1.0]]]), None, [weight], np.array([[0, 0, 1], [0, 1, 1]]))[0]

    for rough, degrees in ((0.0, 0.3), (0.1, 0.4), (0.3, 3.0), (0.7, 20.0), (1.0, 50.0)):
        angle = np.radians(degrees)
        normal = np.array([[[0, 0, 1.0], [np.sin(angle), 0, np.cos(angle)]]])
        mean = average(normal, np.full((1, 2, 1), rough))
        lobe = 0.5 * max(np.arctan(rough**2 * np.sqrt(3)), 0.01)
        expected = np.exp(-2 * (1 - np.cos(angle)) / lobe**2)
        np.testing.assert_allclose(mean[0, 0, 0], expected / (1 + expected), rtol=1e-9)


def test_the_lobes_angle_contains_three_quarters_of_the_normals(rng):
    rough = 0.6
    uniform = rng.random(200_000)
    angles = np.arctan(rough**2 * np.sqrt(uniform / (1 - uniform)))  # GGX: Walter et al. 2007, eq. 35
    assert abs(np.mean(angles < np.arctan(rough**2 * np.sqrt(3))) - 0.75) < 0.005


def test_roughness_stops_the_average(x64):
    @jax.jit
    def average(rough):
        weight = roughness_weight(rough, fraction=0.15)
        return edge_average(jnp.array([[[0.0, 1.0]]]), None, [weight], np.array([[0, 0, 1], [0, 1, 1]]))[0]

    mean = average(np.array([[[0.4], [0.43]]]))
    expected = np.exp(-0.03 / 0.06)
    np.testing.assert_allclose(mean[0, 0, 0], expected / (1 + expected), rtol=1e-9)


def reference_clamp(slow, fast, hit, sigma):
    """The clamp written pixel by pixel, in float64."""
    matrix = np.array([[0.25, 0.5, 0.25], [0.5, 0, -0.5], [-0.25, 0.5, -0.25]])
    out = np.empty_like(slow)
    height, width = slow.shape[1:]
    for y, x in np.ndindex(height, width):
        window = slice(max(y - 2, 0), y + 3), slice(max(x - 2, 0), x + 3)
        around = (matrix @ fast[:, *window].reshape(3, -1))[:, hit[window].ravel()]
        mean = around.mean(axis=1) if around.size else np.zeros(3)
        deviation = around.std(axis=1) if around.size else np.full(3, 1e-5)
        centre = matrix @ fast[:, y, x]
        low, high = np.minimum(mean - sigma * deviation, centre), np.maximum(mean + sigma * deviation, centre)
        out[:, y, x] = np.linalg.inv(matrix) @ np.clip(matrix @ slow[:, y, x], low, high)
    return np.maximum(out, 0)


def test_the_slow_history_is_clamped_to_the_fast_ones_neighbourhood(x64, rng):
    slow, fast = rng.gamma(0.7, 1.0, (2, 3, 7, 9))
    hit = rng.random((7, 9)) < 0.8
    found = np.asarray(jax.jit(partial(clamp_to_fast, sigma=1.5))(slow, fast, hit))
    np.testing.assert_allclose(found, reference_clamp(slow, fast, hit, 1.5), atol=1e-9)
    assert np.mean(np.abs(found - slow) > 1e-3) > 0.1


def test_histories_contradict_each_other_beyond_the_standard_error(x64, rng):
    slow, fast = rng.gamma(2.0, 1.0, (2, 9, 11))
    fast = fast + np.linspace(0, 3, 11)
    hit = rng.random((9, 11)) < 0.8
    found = np.asarray(jax.jit(partial(detect_lag, sigma=1.5, radius=1))(slow, fast, hit))
    for y, x in np.ndindex(9, 11):
        window = slice(max(y - 1, 0), y + 2), slice(max(x - 1, 0), x + 2)
        inside = hit[window]
        before, now = slow[window][inside], fast[window][inside]
        difference = abs(before.mean() - now.mean())
        noise = 1.5 * now.std() / np.sqrt(inside.sum()) + 1e-4 * now.mean()
        np.testing.assert_allclose(found[y, x], np.clip(difference / noise - 1, 0, 1), atol=1e-9)
    assert np.mean(found > 0.3) > 0.1
    assert not np.asarray(jax.jit(partial(detect_lag, sigma=1.0, radius=3))(slow, slow, None)).any()


def test_neighbourhoods_without_a_surface_are_zero(rng):
    measured = jax.jit(partial(measure_neighbourhood, radius=1))(rng.random((2, 5, 6)), np.zeros((5, 6), bool))
    mean, deviation, number = map(np.asarray, measured)
    assert not np.any(mean)
    assert not np.any(number)
    assert np.all(deviation <= 1e-4)


def test_fireflies_take_the_range_of_their_neighbours(rng):
    color = rng.random((3, 6, 7)).astype(np.float32)
    color[:, 3, 3] = 1e4
    color[:, 0, 6] = -1.0
    ids = np.zeros((1, 6, 7), np.float32)
    ids[0, 5, 0] = 1  # alone on its surface
    found = np.asarray(jax.jit(clamp_fireflies)(color, ids))
    for y, x in np.ndindex(6, 7):
        near = [
            color[:, v, u]
            for v, u in np.ndindex(6, 7)
            if max(abs(v - y), abs(u - x)) == 1 and ids[0, v, u] == ids[0, y, x]
        ]
        expected = np.clip(color[:, y, x], np.min(near, axis=0), np.max(near, axis=0)) if near else color[:, y, x]
        np.testing.assert_array_equal(found[:, y, x], expected)


def test_no_pixel_is_brighter_than_all_of_its_neighbours_but_by_what_it_is_sure_of(rng):
    brightness = (1e-9 * rng.random((8, 9))).astype(np.float32)  # no size of its own
    hit, sure = rng.random((8, 9)) < 0.8, np.where(rng.random((8, 9)) < 0.5, rng.random((8, 9)), -1.0)
    hit[:3, :3] = False
    found = np.asarray(attenuate(brightness, hit, sure))
    for y, x in np.ndindex(8, 9):
        near = [brightness[v, u] for v, u in np.ndindex(8, 9) if max(abs(v - y), abs(u - x)) == 1 and hit[v, u]]
        expected = min(1.0, max(max(near) / brightness[y, x], sure[y, x])) if near else 1.0
        np.testing.assert_allclose(found[y, x], expected, rtol=1e-6)
    assert 0.05 < np.mean(found < 1) < 0.5
    nothing, everywhere = np.zeros((3, 3), np.float32), np.ones((3, 3), bool)
    assert np.all(np.asarray(attenuate(nothing, everywhere, nothing)) == 1)
    faint = np.full((3, 3), 1e-30, np.float32)
    faint[1, 1] = 2e-30
    slope = jax.jit(jax.grad(lambda light: jnp.sum(light * attenuate(light, everywhere, nothing))))(faint)
    assert np.all(np.isfinite(slope))


def test_an_even_brightness_is_kept_however_often_a_compiler_computes_it(rng):
    even, everywhere = np.full((8, 9), 0.7, np.float32), np.ones((8, 9), bool)
    kept = evaluate_recomputing(firefly_attenuation, even, everywhere, np.zeros_like(even), rng=rng, rounding=1e-6)
    np.testing.assert_allclose(kept, 1.0, rtol=2e-5)


@pytest.mark.parametrize(("widest", "strides"), [(14, (7, 4, 3)), (4, (2, 1, 1))])
def test_short_histories_are_filled_from_sparse_taps(x64, rng, widest, strides):
    color = rng.random((3, 40, 44))
    length = np.full((40, 44), 9.0)
    length[20, 21], length[19, 22], length[18, 18] = 1, 2.8, 4.4
    hit = rng.random((40, 44)) < 0.7
    hit[20, 21] = hit[19, 22] = hit[18, 18] = True
    found = np.asarray(jax.jit(partial(fix_history, frames=4, widest=widest))(color, length, hit, []))
    expected = color.copy()
    for (y, x), stride in zip(((20, 21), (19, 22), (18, 18)), strides, strict=True):
        taps = [(y + stride * dy, x + stride * dx) for dy in range(-2, 3) for dx in range(-2, 3) if abs(dx * dy) < 4]
        assert len(taps) == 21
        there = [color[:, v, u] for v, u in taps if 0 <= v < 40 and 0 <= u < 44 and hit[v, u]]
        expected[:, y, x] = np.mean(there, axis=0)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    np.testing.assert_array_equal(fix_history(color, jnp.asarray(length), None, [], frames=0, widest=widest), color)


def test_a_short_history_alone_on_its_surface_gets_the_light_beside_it(rng):
    """Not a reflection's, and not where the history is long."""
    color = rng.random((3, 9, 9)).astype(np.float32)
    normal = np.zeros((9, 9, 3), np.float32)
    normal[..., 2] = 1.0
    normal[4, 4] = normal[4, 7] = [1.0, 0.0, 0.0]  # not beside each other
    length = np.full((9, 9), 9.0, np.float32)
    length[4, 4] = 1.0

    @partial(jax.jit, static_argnames="beside")
    def fix(color, length, normal, *, beside):
        weights = [normal_weight(normal, sigma=16.0)]
        return fix_history(color, length, None, weights, frames=4, widest=4, isolated=beside)

    found, kept = (np.asarray(fix(color, length, normal, beside=beside)) for beside in (True, False))
    expected = np.array(color)
    expected[:, 4, 4] = (expected[:, 3:6, 3:6].sum((1, 2)) - expected[:, 4, 4]) / 8
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    np.testing.assert_allclose(kept, color, rtol=1e-6)


def test_gradients_of_every_part(x64, rng):
    slow, fast = rng.uniform(0.5, 1.5, (2, 3, 4, 5))
    check_gradients(lambda a, b: clamp_to_fast(a, b, None, sigma=0.5), (slow, fast), eps=1e-6)
    check_gradients(lambda a: clamp_fireflies(a, None), (slow,), eps=1e-6)
    sure, seen = rng.uniform(0.1, 0.9, (4, 5)), np.ones((4, 5), bool)
    check_gradients(lambda a: a * firefly_attenuation(a, seen, sure), (slow[0],), eps=1e-6)
    motion, far = rng.normal(size=(2, 4, 5, 2))
    near = rng.uniform(0.1, 0.9, (4, 5))
    check_gradients(lambda m, f, c: virtual_motion(m, f, c + 0.5, c), (motion, far, near))
    rough, normal = rng.uniform(0.3, 0.9, (4, 5, 1)), rng.normal(size=(4, 5, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    def average(values, rough):
        weights = [lobe_weight(jnp.asarray(normal), rough, fraction=2.0), roughness_weight(rough, fraction=0.9)]
        return edge_average(values, None, weights, stencil(1))[0]

    check_gradients(average, (slow, rough))
