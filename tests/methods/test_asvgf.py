"""A-SVGF: its gradients against float64 loops, and what they are for: light that changes is seen at once."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.core.frame import Frame
from jaxdn.denoisers import asvgf, svgf
from jaxdn.filters import gradients
from jaxdn.filters.accumulation import accumulate
from jaxdn.filters.atrous import stencil
from jaxdn.filters.edge_stopping import depth_weight, normal_weight
from tests.gradients import check_gradients
from tests.methods.test_svgf import LUMINANCE, moving_frames, reference_average, reference_slopes

HEIGHT, WIDTH = 48, 63
STRATA = (16, 21)
# One program each, and not one for each of their operations.
stratum_sums, stratum_centers = jax.jit(gradients.stratum_sums), jax.jit(gradients.stratum_centers)
compare_replayed = jax.jit(gradients.compare_replayed)
blend = jax.jit(accumulate, static_argnames=("alpha", "alpha_moments", "history_max"))


def by_strata(plane, each=np.sum):
    """A plain loop over strata of 3x3 pixels."""
    rows, columns = (-(-size // 3) for size in plane.shape[:2])
    return np.array([
        [each(plane[3 * r : 3 * r + 3, 3 * c : 3 * c + 3]) for c in range(columns)] for r in range(rows)
    ])  # fmt: skip


def sparse_gradient(rng, shape, *, old=None, new=None):
    """One sample in each stratum: luminances before and after, by default random and with a third of zeros."""
    gradient = np.zeros((*shape, 2))
    for row in range(0, shape[0], 3):
        for column in range(0, shape[1], 3):
            y, x = min(row + rng.integers(3), shape[0] - 1), min(column + rng.integers(3), shape[1] - 1)
            first, second = (
                each[y, x] if each is not None else rng.exponential() * (rng.random() > 0.3) for each in (old, new)
            )
            gradient[y, x] = second - first, max(first, second)
    return gradient


# The formulas.


@pytest.mark.parametrize("shape", [(10, 13), (3, 3), (1, 1), (2, 9)])
def test_strata_match_a_loop(shape, rng):
    plane = rng.normal(size=shape)
    np.testing.assert_allclose(stratum_sums(jnp.asarray(plane)), by_strata(plane), rtol=1e-5, atol=1e-6)
    gradient = sparse_gradient(rng, shape)
    change = compare_replayed(jnp.asarray(gradient))
    np.testing.assert_allclose(change.delta, by_strata(gradient[..., 0]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(change.size, by_strata(gradient[..., 1]), rtol=1e-5, atol=1e-6)
    centers = stratum_centers(jnp.asarray(plane)[..., None])[..., 0]
    middle = by_strata(plane, lambda part: part[min(1, part.shape[0] - 1), min(1, part.shape[1] - 1)])
    np.testing.assert_allclose(centers, middle, rtol=1e-6)


def test_the_observed_change_matches_a_loop(rng):
    shape = (8, 10)
    now, hit = rng.exponential(size=shape), rng.random(shape) < 0.8
    past = rng.exponential(size=(6, *shape))
    past[5] = rng.integers(0, 3, shape)
    change = jax.jit(gradients.compare_with_history)(jnp.asarray(now), jnp.asarray(past), jnp.asarray(hit))
    there = hit & (past[5] > 0)
    count = np.maximum(by_strata(there), 1)
    new, old = by_strata(now * there) / count, by_strata(past[3] * there) / count
    np.testing.assert_allclose(change.delta, new - old, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(change.size, np.maximum(new, old), rtol=1e-5)


@pytest.mark.parametrize("significance", [0.0, 1.0])
def test_the_reconstruction_matches_a_loop(significance, rng, x64):
    frame = moving_frames(rng, 1, np.float64)[0]
    depth, ids, normal = frame.depth[..., 0], frame.ids[..., 0], frame.normal
    size = rng.exponential(size=depth.shape)
    delta = rng.uniform(-1, 1, depth.shape) * size
    delta[5:, 7:], size[5:, 7:] = 0.0, 0.0  # a corner where nothing was replayed
    hit = ids >= 0

    @jax.jit
    def reconstruct(change, hit, frame):
        weights = [depth_weight(frame.depth, frame.ids, sigma=1.0, height=len(frame.depth))]
        weights.append(normal_weight(frame.normal, sigma=128.0))
        return gradients.reconstruct(change, hit, weights, levels=3, significance=significance)

    found = reconstruct(gradients.Change(delta, size), hit, frame)

    geometry = (hit, depth, reference_slopes(depth, ids), normal)
    fields, variance = np.stack([delta, size], -1), delta**2
    for level in range(3):
        filtered, spread = fields.copy(), variance.copy()
        for p in np.ndindex(depth.shape):
            if hit[p]:
                filtered[p], spread[p] = reference_average(fields, stencil(1), p, geometry, 3**level, None, variance)
        fields, variance = filtered, spread
    share = np.minimum(np.abs(fields[..., 0]) / np.maximum(fields[..., 1], 1e-8), 1.0)
    if significance:
        share *= np.clip(np.abs(fields[..., 0]) / (significance * np.sqrt(np.maximum(variance, 1e-16))) - 1, 0, 1)
    np.testing.assert_allclose(found[hit], share[hit], rtol=1e-6, atol=1e-9)
    assert np.mean(share[hit] > 0) > 0.1
    assert share.max() < 1


def test_enlarging_matches_a_loop(rng):
    share = rng.random((4, 5))
    largest = np.zeros_like(share)
    for r, c in np.ndindex(4, 5):
        largest[r, c] = share[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].max()
    expected = np.zeros((11, 13))
    for y, x in np.ndindex(11, 13):
        row, column = np.clip((y + 0.5) / 3 - 0.5, 0, 3), np.clip((x + 0.5) / 3 - 0.5, 0, 4)
        top, left = min(int(row), 2), min(int(column), 3)
        down, right = row - top, column - left
        for dy, dx in np.ndindex(2, 2):
            weight = (down if dy else 1 - down) * (right if dx else 1 - right)
            expected[y, x] += weight * largest[top + dy, left + dx]
    found = jax.jit(gradients.to_pixels, static_argnums=(1, 2))(jnp.asarray(share), 11, 13)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_blending_by_the_share_that_changed_matches_the_formula(rng):
    past, now, change = rng.exponential(size=(6, 4, 5)), rng.exponential(size=(3, 4, 5)), rng.random((4, 5))
    past[5] = rng.integers(0, 9, (4, 5))
    change[0, :2] = 0.0, 1.0
    found = blend(*map(jnp.asarray, (past, now)), alpha=0.2, alpha_moments=0.3, history_max=6, change=change)
    length = np.minimum(past[5] + 1, 6)
    light = np.einsum("chw,c->hw", now, LUMINANCE)
    for planes, least, values in ((slice(0, 3), 0.2, now), (slice(3, 5), 0.3, np.stack([light, light**2]))):
        share = (1 - change) * np.maximum(least, 1 / length) + change
        np.testing.assert_allclose(found[planes], (1 - share) * past[planes] + share * values, rtol=2e-5)
    np.testing.assert_allclose(found[5], 1 / ((1 - change) / length + change), rtol=1e-5)
    # Without a change of light it is what svgf computes, bit for bit.
    plain = [
        blend(*map(jnp.asarray, (past, now)), alpha=0.2, alpha_moments=0.3, history_max=6, change=none)
        for none in (None, jnp.zeros((4, 5)))
    ]
    np.testing.assert_array_equal(*plain)


@pytest.mark.slow
def test_gradients_of_the_formulas(rng, x64):
    change = gradients.Change(jnp.asarray(rng.normal(size=(4, 5))), jnp.asarray(rng.uniform(3, 4, (4, 5))))
    depth = jnp.asarray(rng.uniform(4, 5, (4, 5, 1)))

    def share(delta, size, depth):
        weights = [depth_weight(depth, None, sigma=1.0, height=len(depth))]
        return gradients.to_pixels(
            gradients.reconstruct(gradients.Change(delta, size), None, weights, levels=2, significance=0.5), 11, 14
        )

    check_gradients(share, (*change, depth))
    past, now = jnp.asarray(rng.uniform(1, 2, (6, 8, 7))), jnp.asarray(rng.uniform(1, 2, (3, 8, 7)))

    def blended(past, now, change):
        return accumulate(past, now, alpha=0.1, alpha_moments=0.2, history_max=32, change=change)

    check_gradients(blended, (past, now, jnp.asarray(rng.uniform(0.1, 0.9, (8, 7)))))
    check_gradients(lambda now, past: gradients.compare_with_history(now, past, None), (now[0], past))


# The gradients' meaning.


def whole_share(gradient, *, levels=3, significance=2.0):
    return np.asarray(compiled_share(np.float32(gradient), levels, significance))


@partial(jax.jit, static_argnums=(1, 2))
def compiled_share(gradient, levels, significance):
    return gradients.reconstruct(compare_replayed(gradient), None, [], levels=levels, significance=significance)


@pytest.mark.parametrize(("new", "expected"), [(1.0, 0.0), (2.0, 0.5), (0.5, 0.5), (0.0, 1.0)])
@pytest.mark.parametrize("exposure", [1.0, 1e-3, 1e3])
def test_the_share_is_the_relative_change_at_any_exposure(new, expected, exposure, rng):
    light = exposure * rng.uniform(0.5, 1.5, (HEIGHT, WIDTH))
    share = whole_share(sparse_gradient(rng, light.shape, old=light, new=new * light))
    np.testing.assert_allclose(share, expected, rtol=1e-4, atol=1e-6)


def test_paths_that_differ_by_chance_are_no_change(rng):
    """Sparse light of independent paths: as large differences as of a light that is switched off, but of both signs."""
    light = [rng.exponential(size=(HEIGHT, WIDTH)) * (rng.random((HEIGHT, WIDTH)) < 0.3) for _ in range(2)]
    chance = sparse_gradient(rng, (HEIGHT, WIDTH), old=light[0], new=light[1])
    assert whole_share(chance).mean() < 0.01
    assert whole_share(chance, significance=0.0).mean() > 0.05
    one = np.zeros((HEIGHT, WIDTH, 2))
    one[20, 30] = -1.0, 1.0
    assert not whole_share(one).any()
    assert whole_share(one, significance=0.0).max() == 1.0


def test_nothing_replayed_is_nothing_known(rng):
    assert not whole_share(np.zeros((7, 8, 2))).any()
    left = sparse_gradient(rng, (HEIGHT, WIDTH), old=np.ones((HEIGHT, WIDTH)), new=np.zeros((HEIGHT, WIDTH)))
    left[:, 9:] = 0.0
    share = whole_share(left, levels=2, significance=0.0)
    assert (share[:, :3] == 1).all()
    assert not share[:, 7:].any()


# The denoiser.


def run(denoiser, frames):
    """The states and images of a list of frames."""
    step = jax.jit(denoiser.step)
    state, found = jax.jit(denoiser.start)({}, frames[0]), []
    for frame in frames:
        state, image = step({}, state, frame)
        found.append((state, np.asarray(image)))
    return found


def still(rng, levels, *, samples):
    """Frames of one flat surface under light of the given levels, and gradient samples of its changes."""
    frames = []
    before = np.zeros((24, 30, 3))
    for index, level in enumerate(levels):
        radiance = level * rng.uniform(0.5, 1.5, (24, 30, 1)) * np.ones(3)
        old = before @ LUMINANCE
        new = old * level / levels[index - 1]
        gradient = sparse_gradient(rng, old.shape, old=old, new=new).astype(np.float32) if samples else None
        frames.append(Frame(radiance.astype(np.float32), luminance_gradient=gradient))
        before = radiance
    return frames


def frames_until_close(denoiser, *, samples):
    """Frames after light has doubled until the image is within 5 % of the new light: 1 is the first of them."""
    frames = still(np.random.default_rng(1), [1.0] * 12 + [2.0] * 16, samples=samples)
    levels = np.array([image.mean() for _, image in run(denoiser, frames)])
    close = np.abs(levels[12:] / 2 - 1) < 0.05
    return int(np.argmax(close)) + 1


@pytest.mark.slow
def test_light_that_doubles_is_followed_at_once():
    slow = frames_until_close(svgf(), samples=False)
    assert slow >= 9
    assert 3 * frames_until_close(asvgf(), samples=True) <= slow
    assert 3 * frames_until_close(asvgf(), samples=False) <= slow  # nine pixels of little noise suffice here
    # The paper's mapping leaves half of the history.
    assert frames_until_close(asvgf(significance=0.0, antilag=1.0), samples=True) > slow / 3


@pytest.mark.parametrize("samples", [True, False])
def test_the_variance_of_a_still_scene_falls_as_one_over_the_number_of_frames(samples, rng):
    denoiser = asvgf(levels=0, feedback_level=0, short_history=0, alpha=0.125)
    frames = still(rng, [1.0] * 24, samples=samples)
    found = run(denoiser, frames)
    single = np.var(frames[0].radiance)
    for index, (_, image) in enumerate(found[:8]):
        assert np.var(image) * (index + 1) / single == pytest.approx(1.0, rel=0.12), index
    # From then on the mean is exponential: alpha / (2 - alpha).
    assert np.var(found[-1][1]) / single == pytest.approx(0.125 / 1.875, rel=0.3)


@pytest.mark.slow
def test_without_a_change_of_light_it_is_svgf(rng):
    frames = moving_frames(rng)
    unchanged = np.zeros((*frames[0].radiance.shape[:2], 2), np.float32)
    unchanged[..., 1] = 1.0
    options = {"levels": 2, "alpha": 0.2}
    mine = run(asvgf(**options), [frame._replace(luminance_gradient=unchanged) for frame in frames])
    for (_, image), (_, other) in zip(mine, run(svgf(**options), frames), strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("gradient", [0.0, 0.3])
def test_a_constant_image_stays(gradient, rng):
    frame = moving_frames(rng, 1)[0]
    frame = frame._replace(radiance=frame.albedo * 0 + np.float32(0.37), albedo=np.full_like(frame.albedo, 0.6))
    plane = np.full((*frame.radiance.shape[:2], 1), gradient, np.float32)
    frame = frame._replace(luminance_gradient=np.concatenate([plane, 2 * plane], -1))
    for _, image in run(asvgf(levels=2), [frame] * 3):
        np.testing.assert_allclose(image, 0.37, rtol=1e-5)


@pytest.mark.slow
def test_no_samples_are_those_of_the_neutral_value(rng):
    frames = moving_frames(rng)
    zeros = np.zeros((*frames[0].radiance.shape[:2], 2), np.float32)
    absent, neutral = (
        run(asvgf(levels=1, significance=0.5), [frame._replace(luminance_gradient=given) for frame in frames])
        for given in (None, zeros)
    )
    for (_, image), (_, other) in zip(absent, neutral, strict=True):
        np.testing.assert_allclose(image, other, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_no_buffer_has_to_be_there(rng):
    """That of a frame without any of them is finite is a slow test."""
    denoiser = asvgf(levels=1)
    frames = [frame._replace(luminance_gradient=np.full((10, 12, 2), 0.5, np.float32)) for frame in moving_frames(rng)]

    def shape_of(frame):
        return jax.eval_shape(lambda frame: denoiser.step({}, denoiser.start({}, frame), frame)[1], frame).shape

    for name in denoiser.reads:
        assert shape_of(frames[0]._replace(**{name: None})) == (10, 12, 3)


@pytest.mark.slow
def test_without_any_buffer_images_are_finite(rng):
    denoiser = asvgf(levels=1)
    bare = [Frame(frame.radiance) for frame in moving_frames(rng)]
    assert all(np.isfinite(image).all() for _, image in run(denoiser, bare))


@pytest.mark.slow
def test_a_larger_luminance_that_is_smaller_than_the_change_is_mended(rng):
    """Noise in a file may have either sign in both channels."""
    frame = moving_frames(rng, 1)[0]
    frames = [frame._replace(luminance_gradient=rng.normal(size=(10, 12, 2)).astype(np.float32))] * 3
    assert all(np.isfinite(image).all() for _, image in run(asvgf(levels=1, significance=0.0), frames))


@pytest.mark.parametrize(
    ("options", "word"),
    [({"antilag": 0.5}, "antilag"), ({"gradient_levels": 9}, "gradient_levels"), ({"feedback_level": 6}, "feedback")],
)
def test_options_out_of_range_raise(options, word):
    with pytest.raises(ValueError, match=word):
        asvgf(**options)
