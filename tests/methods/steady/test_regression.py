"""What a filter takes away where light follows the guides: against normal equations in NumPy, and what must hold."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.methods.steady import regression
from jaxdn.methods.steady.regression import CELL, GUIDES, SCALES, receptive_field, regressors_of
from jaxdn.ops.dispatch.operation import implementation
from tests.gradients import check_gradients

SIZE = 96, 128
PLAIN = {name: jnp.zeros(()) for name in SCALES}
UNITS = [
    name for name, channels in (("normal", 3), ("position", 2), ("gloss", 1), ("depth", 1)) for _ in range(channels)
]


def blurred(planes):
    """By a filter that keeps constants: means of 9 x 9 pixels, of those inside the image."""
    planes = np.asarray(planes, np.float64)
    for axis in (-2, -1):
        count = np.zeros_like(planes)
        total = np.zeros_like(planes)
        for shift in range(-4, 5):
            there = np.roll(planes, shift, axis)
            inside = np.roll(np.ones_like(planes), shift, axis)
            edge = [slice(None)] * planes.ndim
            edge[axis] = slice(0, shift) if shift > 0 else slice(planes.shape[axis] + shift, None)
            if shift:
                inside[tuple(edge)] = 0
            total, count = total + inside * there, count + inside
        planes = total / count
    return planes


def ball(size=SIZE):
    """Normals of a ball before a wall, its depth, and gloss of the left half of the wall."""
    y, x = np.mgrid[: size[0], : size[1]]
    across, down = (x - size[1] / 2) / 36, (y - size[0] / 2) / 36
    inside = across**2 + down**2 < 1
    toward = np.sqrt(np.maximum(1 - across**2 - down**2, 0))
    normal = np.where(inside[..., None], np.stack([across, down, -toward], -1), [0.0, 0.0, -1.0])
    gloss = np.where(inside, 0.0, 0.3 * (x < size[1] / 2))[..., None]
    return normal, gloss, np.where(inside, 1.2 + 0.2 * toward, 1.0)


def given(rng, light=None, size=SIZE):
    """Light, guides, and both filtered."""
    normal, gloss, inverse = ball(size)
    guides = np.asarray(regressors_of(*(jnp.asarray(each, jnp.float32) for each in (normal, gloss, inverse))))
    if light is None:
        light = np.exp(rng.normal(size=(*size, 3))) * (1.0 + 0.5 * normal[..., :1])
    smooth = np.stack([blurred(light[..., channel]) for channel in range(3)], -1)
    return [jnp.asarray(each, jnp.float32) for each in (light, smooth, guides, blurred(guides))]


def given_back(scales, light, smooth, guides, smooth_guides, hit, floor):
    """The function under test, of pixels [H, W, 3]."""
    before, after = (
        jnp.concatenate([one.transpose(2, 0, 1), others]) for one, others in ((light, guides), (smooth, smooth_guides))
    )
    return regression.regress_residual(scales, before, after, hit[..., 0], floor).transpose(1, 2, 0)


def added(arrays, *, scales=PLAIN, hit=None, floor=1e-3):
    size = arrays[0].shape[:2]
    hit = jnp.ones((*size, 1), bool) if hit is None else jnp.asarray(hit)
    return np.asarray(jax.jit(given_back)(scales, *arrays, hit, jnp.asarray(floor, arrays[0].dtype)))


def in_numpy(arrays, factors, hit, floor):
    """The same in float64, cell by cell, as the module's documentation says it."""
    light, smooth, guides, smooth_guides = (np.asarray(each, np.float64) for each in arrays)
    height, width = light.shape[:2]
    level = smooth.mean(-1) + floor
    d = factors[:, None, None] * np.where(hit[..., 0], guides - smooth_guides, 0)
    r = np.where(hit, light - smooth, 0).transpose(2, 0, 1) / level
    rows, columns = -(-height // CELL), -(-width // CELL)
    both = np.zeros((GUIDES + 4, rows * CELL, columns * CELL))
    both[:, :height, :width] = np.concatenate([d, r, hit[..., 0][None]])
    products = np.einsum("iyx,jyx->ijyx", both, both)
    products = products.reshape(GUIDES + 4, GUIDES + 4, rows, CELL, columns, CELL).mean((3, 5))
    spline = np.array([1, 4, 6, 4, 1]) / 16
    windows = []
    for step in (1, 2):
        for axis in (2, 3):
            wide = np.zeros_like(products)
            for tap, weight in zip(range(-2, 3), spline, strict=True):
                for place in range(products.shape[axis]):
                    if 0 <= place + tap * step < products.shape[axis]:
                        here, there = [slice(None)] * 4, [slice(None)] * 4
                        here[axis], there[axis] = place, place + tap * step
                        wide[tuple(here)] += weight * products[tuple(there)]
            products = wide
        windows.append((products, (CELL * step / np.square(spline).sum()) ** 2))
    slopes = np.zeros((rows, columns, GUIDES, 3))
    for window, pixels in windows[::-1]:
        for y, x in np.ndindex(rows, columns):
            moments = window[..., y, x]
            variance = np.trace(moments[GUIDES : GUIDES + 3, GUIDES : GUIDES + 3]) / 3
            doubt = 64.0 * variance / pixels + 1e-4 * moments[-1, -1] + 1e-8
            system = moments[:GUIDES, :GUIDES] + doubt * np.eye(GUIDES)
            right = moments[:GUIDES, GUIDES : GUIDES + 3] + doubt * slopes[y, x]
            slopes[y, x] = np.linalg.solve(system, right)
    found = np.zeros((height, width, 3))
    for y, x in np.ndindex(height, width):
        places = [np.clip((at + 0.5) / CELL - 0.5, 0, count - 1) for at, count in ((y, rows), (x, columns))]
        low = [int(place) for place in places]
        for up, right in itertools.product((0, 1), (0, 1)):
            at = min(low[0] + up, rows - 1), min(low[1] + right, columns - 1)
            share = [
                place - first if far else 1 - place + first
                for place, first, far in zip(places, low, (up, right), strict=True)
            ]
            found[y, x] += share[0] * share[1] * level[y, x] * d[:, y, x] @ slopes[at]
    return found


@pytest.mark.parametrize("size", [(40, 52), (16, 16), (100, 4)])
@pytest.mark.parametrize("chosen", ["auto", "reference"])
def test_it_solves_the_normal_equations(size, chosen, rng):
    """Sizes that are multiples of a cell, and others; a part of the image without a surface."""
    arrays = given(rng, size=size)
    hit = rng.uniform(size=(*size, 1)) < 0.9
    scales = {"normal": 0.3, "position": -0.5, "gloss": 0.1, "depth": 0.7}
    wanted = in_numpy(arrays, np.exp([scales[name] for name in UNITS]), hit, 0.01)
    with implementation(chosen):
        found = added(arrays, scales={name: jnp.float32(value) for name, value in scales.items()}, hit=hit, floor=0.01)
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=2e-4 * np.abs(wanted).max())
    assert np.abs(wanted).max() > 0.01


def test_light_that_follows_the_normal_is_given_back(rng):
    normal, _, _ = ball()
    light = 1.0 + normal @ np.array([[0.5, 0.1, -0.3], [0.2, -0.4, 0.1], [-0.3, 0.2, 0.3]])
    arrays = given(rng, light)
    lost = np.abs(light - arrays[1])
    left = np.abs(light - arrays[1] - added(arrays))
    assert lost.max() > 0.1
    assert left.mean() < 0.15 * lost.mean()


def test_so_it_is_from_noise(rng):
    """Of single samples whose deviation is the light itself, a half of the error that the filter makes on a ball."""
    normal, _, _ = ball()
    light = 1.0 + normal @ np.array([[0.6], [0.2], [-0.3]]) * np.ones(3)
    clean, before, after = given(rng, light), 0.0, 0.0
    on_ball = normal[..., 2] != -1
    for _ in range(8):
        noisy = light * rng.exponential(size=(*SIZE, 3))
        arrays = given(rng, noisy)
        noise = np.asarray(arrays[1] - clean[1])  # that of the filter, which stays
        before += np.square(np.asarray(arrays[1]) - noise - light)[on_ball].mean()
        after += np.square(np.asarray(arrays[1]) + added(arrays) - noise - light)[on_ball].mean()
    assert after < 0.5 * before


def test_noise_adds_next_to_nothing_and_does_not_darken(rng):
    """Of even light and skewed noise: of the power that the filter leaves, less than a tenth; its mean is 0."""
    sums, squares, left = [], [], []
    for _ in range(60):
        noisy = rng.exponential(size=(*SIZE, 1)) * (rng.uniform(size=(*SIZE, 1)) < 0.3) / 0.3 * np.ones(3)
        arrays = given(rng, noisy)
        more = added(arrays)
        sums.append(more.mean())
        squares.append(np.square(more).mean())
        left.append(np.square(np.asarray(arrays[1]) - 1.0).mean())
    assert np.mean(squares) < 0.1 * np.mean(left)
    assert np.abs(np.mean(sums)) < 4 * np.std(sums) / np.sqrt(len(sums)) + 1e-4


def test_it_does_not_depend_on_the_directions_of_the_axes(rng):
    """All normals turned at random, and the image mirrored."""
    arrays = given(rng)
    plain = added(arrays)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned = [np.concatenate([np.einsum("ij,jyx->iyx", turn, each[:3]), each[3:]]) for each in arrays[2:]]
    np.testing.assert_allclose(added([*arrays[:2], *map(jnp.float32, turned)]), plain, atol=2e-5)
    mirrored = [each[:, ::-1] if each.shape[-1] == 3 else each[..., ::-1] for each in arrays]
    np.testing.assert_allclose(added(mirrored), plain[:, ::-1], atol=2e-5)


@pytest.mark.parametrize("gain", [2.0**-12, 2.0**10])
def test_brightness_does_not_matter(gain, rng):
    arrays = given(rng)
    scaled = added([gain * arrays[0], gain * arrays[1], *arrays[2:]], floor=gain * 1e-3)
    np.testing.assert_allclose(scaled / gain, added(arrays), rtol=1e-4, atol=1e-6)


def test_the_sky_says_nothing_and_gets_nothing(rng):
    hit = np.ones((*SIZE, 1), bool)
    hit[:, 70:] = False
    one = given(rng)
    other = [jnp.where(jnp.asarray(hit if each.shape[-1] == 3 else hit[..., 0]), each, 1e3) for each in one]
    one, other = added(one, hit=hit), added(other, hit=hit)
    np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(other[:, 70:], 0.0)
    nothing = added(given(rng), hit=np.zeros((*SIZE, 1), bool))
    np.testing.assert_array_equal(nothing, 0.0)


@pytest.mark.parametrize("size", [65504.0, 1e-30, 0.0])
def test_any_light_stays_finite(size, rng):
    arrays = given(rng)
    found = added([size * arrays[0], size * arrays[1], *arrays[2:]])
    assert np.isfinite(found).all()
    arrays[0] = arrays[0].at[40, 50].set(65504.0)
    assert np.isfinite(added(arrays)).all()


def test_no_further_than_it_says(rng):
    arrays = given(rng, size=(32, 480))
    middle = 240
    plain, changed = (added([light, *arrays[1:]]) for light in (arrays[0], arrays[0].at[:, middle].mul(3.0)))
    differs = np.flatnonzero((plain != changed).any(axis=(0, 2)))
    assert middle - receptive_field() <= differs.min() < middle - receptive_field() // 2
    assert middle + receptive_field() // 2 < differs.max() <= middle + receptive_field()


@pytest.mark.slow
def test_gradients(rng, x64):
    arrays = [jnp.asarray(each, jnp.float64) for each in given(rng, size=(24, 20))]
    scales = {name: jnp.asarray(0.1) for name in SCALES}
    hit = jnp.asarray(rng.uniform(size=(24, 20, 1)) < 0.9)
    # Guides vary by much here: the smallest share of noise would do.
    check_gradients(lambda scales, *given: given_back(scales, *given, hit, 0.01), (scales, *arrays), rtol=1e-4)


@pytest.mark.slow
def test_its_gradient_in_single_precision_is_that_of_the_plain_form(rng):
    """In training, and where nothing is seen at all."""
    arrays = given(rng, size=(32, 48))

    def loss(scales, arrays, hit):
        return jnp.sum(jnp.square(given_back(scales, *arrays, hit, jnp.float32(1e-3))))

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))
    for hit in (jnp.ones((32, 48, 1), bool), jnp.zeros((32, 48, 1), bool)):
        found = gradient(PLAIN, arrays, hit)
        assert all(np.isfinite(each).all() for each in jax.tree.leaves(found))
        assert any(np.abs(each).max() > 0 for each in jax.tree.leaves(found)) == bool(hit.all())


@pytest.mark.slow
def test_gradients_of_a_batch_through_time(rng):
    """As in training: a scan of frames of a batch, with one set of scales."""
    arrays = [jnp.stack([each, 0.5 * each]) for each in given(rng, size=(32, 48))]
    hit = jnp.ones((32, 48, 1), bool)

    def clip(scales, light, *others):
        def frame(carried, _):
            more = given_back(scales, light + carried, *others, hit, jnp.float32(1e-3))
            return carried + more, more.sum()

        last, sums = jax.lax.scan(frame, jnp.zeros_like(light), None, length=2)
        return jnp.sum(jnp.square(last)) + jnp.sum(sums)

    def batch(scales):
        return jnp.sum(jax.vmap(clip, in_axes=(None, 0, 0, 0, 0))(scales, *arrays))

    found = jax.jit(jax.grad(batch))(PLAIN)
    alone = jax.jit(jax.grad(clip))
    each = [alone(PLAIN, *(array[index] for array in arrays)) for index in range(2)]
    for name, value in found.items():
        np.testing.assert_allclose(value, each[0][name] + each[1][name], rtol=2e-3)
