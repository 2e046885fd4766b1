"""The loops that Numba compiles against the operations in jax that they stand for, and when they are used."""

import errno
import functools
import os
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import brdf, color
from jaxdn.core.frame import FAR, Frame
from jaxdn.denoiser.statistics import sum_depths
from jaxdn.filters.reproject import reproject, reproject_along
from jaxdn.filters.surface_test import ExpectedSurface, Guides, guides_of
from jaxdn.methods.steady.accumulation import (
    FilteredLight,
    History,
    RunningMean,
    assemble_network_input,
    suppress_fireflies,
    update_history,
    update_mean,
)
from jaxdn.methods.steady.levels import LEVELS
from jaxdn.methods.steady.method import FEATURES, HALF_FEATURES, INITIAL, split_heads
from jaxdn.ops.affinity.filter import Guide, affinity_filter
from jaxdn.ops.affinity.joint_upsample import joint_bilateral_upsample
from jaxdn.ops.dispatch import numba_call
from jaxdn.ops.dispatch.operation import implementation
from jaxdn.ops.scales import fill_holes, join_pixels, join_planes

pytestmark = pytest.mark.needs("numba")


@functools.lru_cache(8)
def program_of(function, name):
    """The function, jitted apart from all else that is jitted of it."""
    return jax.jit(lambda *given: function(*given))


@pytest.fixture
def both():
    """The results of a function of arrays, once with the loops and once without: one program each for its shapes."""

    def run(function, *arguments):
        found = []
        for name, calls in (("auto", 1), ("reference", 0)):
            with implementation(name):
                program = program_of(function, name)
                assert (str(program.trace(*arguments).jaxpr).count("ffi_call[") > 0) == calls
                found.append(jax.tree.map(np.asarray, program(*arguments)))
        return found

    return run


def drawn(rng, height, width, features=4):
    """A guide with edges, pixels that nobody trusts, and one whose features are far from all others."""
    planes = rng.uniform(-1, 1, (features, height, width)).round().astype(np.float32)
    planes[:, height // 2, width // 2] = 50.0
    confidence = rng.uniform(0, 1, (height, width)) * (rng.random((height, width)) > 0.2)
    slanted = 0.3 * rng.normal(size=(3, height, width))
    return Guide(*(jnp.asarray(each, jnp.float32) for each in (planes, slanted, confidence)))


@pytest.mark.parametrize(
    ("size", "step"),
    [*(((33, 70), step) for step in (1, 2)), *((size, 8) for size in [(1, 1), (3, 40), (37, 5), (33, 70)])],
)
def test_a_level_of_the_filter(size, step, rng, both):
    image = jnp.asarray(10.0 ** rng.uniform(-4, 4, (3, *size)), jnp.float32)
    guide = drawn(rng, *size)._replace(scales=jnp.asarray([0.5, 1.0, 2.0, 0.1, 3.0]))

    def filtered(image, guide):
        return affinity_filter(image, guide, step=step), affinity_filter(image, guide.scaled(), step=step)

    (found, multiplied), (wanted, _) = both(filtered, image, guide)
    np.testing.assert_allclose(found, wanted, rtol=3e-5)  # where all are unlike: a distance of 80 is rounded to 5e-6
    np.testing.assert_allclose(found, multiplied, rtol=3e-5)


@pytest.mark.parametrize("size", [(2, 9), (17, 21)])  # test_operations.py has a single pixel
def test_the_enlarged_image(size, rng, both):
    coarse = jnp.asarray(10.0 ** rng.uniform(-4, 4, (3, *size)), jnp.float32)
    there, here = drawn(rng, *size), drawn(rng, 2 * size[0], 2 * size[1])
    here = here._replace(scales=jnp.asarray([0.5, 1.0, 2.0, 0.1, 3.0]))
    (image, weight), (wanted, sums) = both(joint_bilateral_upsample, coarse, there, here)
    np.testing.assert_allclose(weight, sums, rtol=3e-6, atol=1e-7)
    np.testing.assert_allclose(image, wanted, rtol=1e-5)
    assert ((weight == 0) == (sums == 0)).all()


SELDOM = [pytest.param(name, marks=pytest.mark.slow) for name in ("depth", "normal", "ids", "previous_depth")]


@pytest.mark.parametrize("left_out", ["", "motion", "depth normal ids", *SELDOM])
@pytest.mark.parametrize("search_neighbours", [False, True])
def test_the_recalled_history(left_out, search_neighbours, rng, both):
    height, width = 23, 31
    normal = rng.normal(size=(height, width, 3)).round()
    frame = Frame(
        radiance=np.zeros((height, width, 3)),
        normal=normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6),
        depth=rng.choice([1.0, 1.01, 3.0, FAR], (height, width, 1)),
        previous_depth=rng.choice([1.0, 3.0], (height, width, 1)),
        ids=rng.integers(-1, 2, (height, width, 1)),
        motion=rng.choice([-2.5, -1.0, 0.0, 0.3, 1e6, np.nan], (height, width, 2), p=[0.1, 0.2, 0.3, 0.3, 0.05, 0.05]),
    )._replace(**dict.fromkeys(left_out.split()))
    frame = jax.tree.map(lambda each: jnp.asarray(each, jnp.int32 if each.dtype == np.int64 else jnp.float32), frame)
    history = rng.uniform(0, 1, (height, width, 8)).astype(np.float32)
    history[3, 4, 2], history[5, 6, 0], history[7, 7, 7], history[9, 9] = np.nan, -1.0, np.inf, -0.0

    def recalled(history, frame, first):
        return reproject(history, guides_of(frame), frame, first, search_neighbours=search_neighbours)

    for first in (False, True):
        found, wanted = both(recalled, jnp.asarray(history), frame, jnp.asarray(first))
        np.testing.assert_array_equal(found.valid, wanted.valid)
        np.testing.assert_allclose(found.history, wanted.history, rtol=1e-5, atol=1e-7)
        assert found.invalid == wanted.invalid
        assert first == (not found.valid.any())


def test_the_recalled_history_where_any_normal_is_right(rng, both):
    """Where none is wanted; elsewhere normals that are all alike leave nothing else to be right."""
    shape = (23, 31)
    normal = jnp.zeros((*shape, 3)).at[..., 2].set(1.0)
    free = jnp.asarray(rng.random(shape) < 0.3)
    wanted = jnp.where(free[..., None], jnp.nan, jnp.zeros((*shape, 3)).at[..., 0].set(1.0))
    history = jnp.asarray(rng.uniform(0, 1, (*shape, 8)), jnp.float32)
    vectors = jnp.asarray(rng.choice([-1.0, 0.0, 0.3], (*shape, 2)), jnp.float32)

    def recalled(history, vectors, first):
        expected = ExpectedSurface(None, None, wanted, None)
        rules = {"normal_threshold": 0.9, "search_neighbours": True}
        return reproject_along(history, Guides(None, normal, None), vectors, expected, first, **rules)

    found, other = both(recalled, history, vectors, jnp.asarray(False))
    np.testing.assert_array_equal(found.valid, other.valid)
    np.testing.assert_allclose(found.history, other.history, rtol=1e-5, atol=1e-7)
    inside = np.asarray(free)[1:-1, 1:-1]
    np.testing.assert_array_equal(found.valid[1:-1, 1:-1, 0], inside)


def of_earlier_frames(rng, height, width, light=1.0):
    """A history of steady, a fifth of which is not known."""
    valid = rng.random((height, width)) > 0.2
    mean, shown = (light * rng.uniform(0, 1, (height, width, 3)) for _ in range(2))
    square = light**2 * rng.uniform(0, 2, (height, width, 1))
    values = np.concatenate([mean, square, rng.uniform(1, 32, (height, width, 1)), shown], axis=-1)
    return History(jnp.asarray(np.where(valid[..., None], values, 0.0), jnp.float32), jnp.asarray(valid))


SEEN = functools.partial(assemble_network_input, multiple=16)


@pytest.mark.slow
@pytest.mark.parametrize("gain", [1e-6, 1.0, 1e6, 1e30])
@pytest.mark.parametrize("size", [(14, 38), (32, 64)])
def test_what_a_network_sees(gain, size, rng, both):
    light = 10.0 ** rng.uniform(-12, 4.8, (*size, 3))
    light[:2], light[2:4] = 0.0, 65504.0
    geometry = tuple(jnp.asarray(rng.normal(size=(*size, count)), jnp.float32) for count in (3, 1))
    history, hit = of_earlier_frames(rng, *size), jnp.asarray(rng.random(size) > 0.1)
    given = geometry, jnp.asarray(light, jnp.float32), history, hit, jnp.float32(gain)
    found, wanted = both(SEEN, *given)
    assert found.shape[0] % 16 == found.shape[1] % 16 == 0
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found[..., 16:19], wanted[..., 16:19], rtol=3e-6, atol=1e-12)  # light
    assert wanted[..., 16:19].max() > 1e-4


def test_the_running_mean(rng, both):
    light = jnp.asarray(10.0 ** rng.uniform(-4, 4, (14, 38, 3)), jnp.float32)
    history, hit = of_earlier_frames(rng, 14, 38), jnp.asarray(rng.random((14, 38)) > 0.1)
    follow = jnp.asarray(rng.uniform(0, 1, (14, 38)).round(1), jnp.float32)
    found, wanted = both(functools.partial(update_mean, most=20.0), light, history, hit, follow)
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-3)
    assert np.all(found.sample_count[~np.asarray(history.valid)] == 1)
    assert 19.0 < found.sample_count.max() <= 20.0


@pytest.mark.parametrize("changed", [False, True])
def test_what_is_remembered(changed, rng, both):
    planes = [jnp.asarray(rng.uniform(-0.1, 2, (3, 14, 38)), jnp.float32) for _ in range(4)]
    square, number, feedback, blend = (jnp.asarray(rng.uniform(0, 1, (14, 38)), jnp.float32) for _ in range(4))
    mean = RunningMean(planes[0], square, number, jnp.zeros((3, 7, 19)))
    shown, history = FilteredLight(*planes[1:3], planes[3] if changed else None), of_earlier_frames(rng, 14, 38)
    program = functools.partial(update_history, most=1.5)
    found, wanted = both(program, mean, shown, history, feedback, blend)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found[..., 3], square)
    assert found.min() == 0
    assert found[..., 5:].max() == 1.5


@pytest.mark.parametrize("hue", [False, True])
def test_the_texture_that_a_division_leaves(hue, rng, both):
    reflectance = rng.uniform(0, 1, (14, 38, 3)) ** 4
    reflectance[0], reflectance[1, :, 1:], reflectance[2] = 0.0, 0.0, 1.0
    light = rng.uniform(0, 9, (14, 38, 3)) * (rng.random((14, 38, 1)) > 0.3)
    light[3] *= [1.0, 0.0, 0.0]
    given = jnp.asarray(reflectance, jnp.float32), jnp.asarray(light, jnp.float32), jnp.asarray(hue)
    found, wanted = both(brdf.texture_or_hue, *given)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)
    assert wanted.min() < 0.3
    assert (wanted[0] == 1).any()  # a lamp that reflects nothing


def test_single_bright_pixels(rng, both):
    height, width = 19, 38
    light = rng.uniform(0, 1, (3, height, width)) ** 8
    light[:, 9:12] = 0.0
    level = np.einsum("c,cyx->yx", color.LUMINANCE, light)
    mean = RunningMean(
        light, level**2 * rng.uniform(0.9, 1.5, level.shape), rng.choice([1.0, 2.0, 30.0], level.shape), light
    )
    hit = rng.random((height, width)) > 0.2
    hit[4:7, 4:7] = np.eye(3)[1] * np.eye(3)[1][:, None] > 0  # a pixel without neighbours
    image = jnp.asarray(light * rng.uniform(0.5, 2, light.shape), jnp.float32)
    found, wanted = both(suppress_fireflies, image, jnp.asarray(hit), jax.tree.map(jnp.float32, mean))
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-9)
    kept = wanted.sum(0) / np.maximum(image.sum(0), 1e-30)
    assert kept[5, 5] == 1
    assert (kept < 0.9).mean() > 0.03


def test_what_is_decided(rng, both):
    blocks, channels = (7, 19), 4 * (FEATURES + len(INITIAL)) + HALF_FEATURES + 1 + LEVELS + 1
    head = jnp.asarray(rng.normal(scale=30.0, size=(16, 32, channels)), jnp.float32)
    found, wanted = both(lambda head: split_heads(head, blocks), head)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-12)
    np.testing.assert_array_equal(wanted[0].features, head[:7, :19, : 4 * FEATURES])


def test_the_sums_of_depth(rng, both):
    depth = 10.0 ** rng.uniform(-3, 3, (14, 38, 1))
    depth[rng.random(depth.shape) < 0.1] = FAR
    depth[0], depth[1] = 0.0, -1.0
    found, wanted = both(sum_depths, jnp.asarray(depth, jnp.float32))
    known = depth[(depth > 0) & (depth < FAR)]
    np.testing.assert_allclose(found, [np.log(known).sum(), (1 / known).sum(), known.size], rtol=1e-5)
    np.testing.assert_allclose(wanted, found, rtol=1e-5)


def test_arrays_of_all_layouts_as_planes(rng, both):
    shapes = {
        "planes": (2, 8, 12),
        "pixels": (8, 12, 3),
        "blocks": (4, 6, 8),
        "corners": (8, 12, 4),
        "means": (16, 24, 2),
    }
    arrays = [jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes.values()]
    found, wanted = both(lambda *arrays: join_planes(list(zip(shapes, arrays, strict=True))), *arrays)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)
    assert found.shape == (2 + 3 + 2 + 1 + 2, 8, 12)
    np.testing.assert_array_equal(found[5:7], np.asarray(unfolded(arrays[2])))


def unfolded(blocks):
    """Planes of which :func:`jaxdn.ops.scales.space_to_depth` made the blocks."""
    height, width, channels = blocks.shape
    planes = np.zeros((channels // 4, 2 * height, 2 * width), np.float32)
    for channel, row, column in np.ndindex(channels // 4, 2, 2):
        planes[channel, row::2, column::2] = blocks[..., 4 * channel + 2 * row + column]
    return planes


def test_planes_as_pixels(rng, both):
    """Of odd sides, whose last row and column are repeated; the result is padded to multiples of four."""
    height, width = 5, 7
    shapes = {"planes": (2, 3, 4), "blocks": (1, height, width), "means": (2, height, width)}
    arrays = [rng.normal(size=shape).astype(np.float32) for shape in shapes.values()]
    found, wanted = both(lambda *given: join_pixels(list(zip(shapes, given, strict=True)), multiple=4), *arrays)
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)
    expected = np.zeros((4, 4, 2 + 4 + 2))
    for y, x in np.ndindex(4, 4):
        row, column = min(y, 2), min(x, 3)
        rows, columns = [2 * row, min(2 * row + 1, height - 1)], [2 * column, min(2 * column + 1, width - 1)]
        block = np.stack([arrays[1][0, i, j] for i in rows for j in columns])
        means = [np.mean([plane[i, j] for i in rows for j in columns]) for plane in np.float64(arrays[2])]
        expected[y, x] = [*arrays[0][:, row, column], *block, *means]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_pixels_that_are_not_known(rng, both):
    image = jnp.asarray(rng.uniform(0, 1, (12, 24, 3)), jnp.float32)
    known = rng.random((12, 24, 1)) > 0.5
    known[4:8, :8], known[8:, 8:10] = False, False
    found, wanted = both(fill_holes, image, jnp.asarray(known))
    np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-7)
    assert np.all(found[4:8, :8] == 0)
    with pytest.raises(ValueError, match="image and known: expected the same size"):
        fill_holes(image, jnp.asarray(known[:, :4]))


@pytest.mark.slow
def test_the_gradient_of_a_level_of_the_filter(rng, both):
    """Taps eight pixels apart; test_operations.py has one and two, and other sizes."""
    size, step = (33, 70), 8
    image, cotangent = (jnp.asarray(rng.uniform(-1, 1, (3, *size)), jnp.float32) for _ in range(2))
    guide = drawn(rng, *size)._replace(scales=jnp.asarray([0.5, 1.0, 0.7, 0.1, 1.5]))

    def gradient(image, guide, cotangent):
        return jax.vjp(lambda image, guide: affinity_filter(image, guide, step=step), image, guide)[1](cotangent)

    found, wanted = both(gradient, image, guide, cotangent)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * max(np.abs(other).max(), 0.1))
    assert all(np.abs(each).max() > 0 for each in jax.tree.leaves(wanted))


def test_gradients_of_batches_that_share_their_scales(rng, both):
    images, guides = jnp.asarray(rng.random((2, 3, 9, 12)), jnp.float32), [drawn(rng, 9, 12) for _ in range(2)]
    guides = jax.tree.map(lambda *each: jnp.stack(each), *guides)
    scales = jnp.asarray([0.5, 1.0, 0.7, 0.1, 1.5])

    def loss(scales, images, guides):
        each = jax.vmap(lambda image, guide: affinity_filter(image, guide._replace(scales=scales)) ** 2)(images, guides)
        return each.sum()

    found, wanted = both(jax.grad(loss, argnums=(0, 1, 2)), scales, images, guides)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)
    assert np.abs(wanted[0]).min() > 1e-3


@pytest.mark.parametrize(
    ("join", "name", "numbers"), [(join_planes, "join_rows", 4), (join_pixels, "join_pixel_rows", 20)]
)
def test_parts_are_joined_by_one_loop_however_many_there_are(rng, join, name, numbers):
    """Another loop for each number takes half a second each, on a first run."""
    from jaxdn.ops import numba_scales

    loop, planes = getattr(numba_scales, name), jnp.asarray(rng.random((2 * numbers, 1, 4, 6)), jnp.float32)
    jax.block_until_ready(join([("planes", planes[0])]))
    before = list(loop.signatures)
    for number in (2, 3, numbers):
        found = join([("planes", plane) for plane in planes[:number]])
        wanted = planes[:number, 0] if join is join_planes else planes[:number, 0].transpose(1, 2, 0)
        np.testing.assert_array_equal(found, wanted)
    assert list(loop.signatures) == before
    more = join([("planes", plane) for plane in planes[: numbers + 1]])
    assert more.size == planes[: numbers + 1].size


@pytest.mark.slow
def test_what_has_no_loop_for_its_gradient_is_left_to_jax(rng, both):
    coarse, there = jnp.asarray(rng.random((2, 4, 6)), jnp.float32), drawn(rng, 4, 6)
    fine = drawn(rng, 8, 12)

    def loss(coarse, there, fine):
        enlarged, weight = joint_bilateral_upsample(coarse, there, fine)
        return (enlarged**2).sum() + weight.sum()

    given = coarse, there, fine
    program = jax.grad(loss, argnums=(0, 1, 2))
    assert "ffi_call[" not in str(jax.make_jaxpr(program)(*given))
    found = program(*given)
    with implementation("reference"):
        expected = program(*given)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)

    two = jax.tree.map(lambda each: jnp.stack([each, each[..., ::-1]]), given)
    batched = jax.vmap(joint_bilateral_upsample)
    assert "ffi_call[" not in str(jax.make_jaxpr(batched)(*two))
    alone = both(joint_bilateral_upsample, *jax.tree.map(lambda each: each[1], two))[0]
    np.testing.assert_allclose(batched(*two)[0][1], alone[0], rtol=3e-5)


def test_an_error_in_a_loop_is_raised(rng):
    def fails(top, bottom, image, out):
        raise RuntimeError("the tile is torn")

    with pytest.raises(jax.errors.JaxRuntimeError, match="the tile is torn"):
        jax.block_until_ready(numba_call.call(fails, [(4, 4)], [jnp.ones((4, 4))], rows=4))


def test_no_tile_is_written_any_more_after_an_error(monkeypatch):
    written, begun, pool = [], threading.Event(), ThreadPoolExecutor(1)
    monkeypatch.setattr(numba_call, "_pool", lambda: (pool, 2))

    def fails_first(top, bottom, image, out):
        if top == 0:
            begun.wait(20)
            raise RuntimeError("the tile is torn")
        begun.set()
        time.sleep(0.1)
        out[top:bottom] = 1
        written.append(top)

    with pytest.raises(jax.errors.JaxRuntimeError, match="the tile is torn"):
        jax.block_until_ready(numba_call.call(fails_first, [(16, 4)], [jnp.ones((16, 4))], rows=16))
    there = list(written)
    time.sleep(0.5)
    assert written == there != []


def test_a_small_image_is_one_tile_and_a_large_one_several(monkeypatch):
    """Eight tiles of 256 x 144 pixels took threads twice as long to take up as to fill."""
    monkeypatch.setattr(numba_call, "TILE", 1 << 16)
    calls = []

    def counts(top, bottom, image, out):
        out[top:bottom] = image[top:bottom] + 1
        calls.append((top, bottom))

    for rows, tiles in ((144, 1), (1024, 4)):
        calls.clear()
        (found,) = numba_call.call(counts, [(rows, 256)], [jnp.zeros((rows, 256))], rows=rows)
        np.testing.assert_array_equal(found, 1)
        assert len(calls) == tiles
        assert sorted(calls)[0][0] == 0
        assert sorted(calls)[-1][1] == rows


def test_every_row_belongs_to_one_tile():
    def counts(top, bottom, image, out):
        out[top:bottom] = image[top:bottom] + 1

    for rows in (1, 2, 7, 8, 9, 1000):
        (found,) = numba_call.call(counts, [(rows, 3)], [jnp.zeros((rows, 3))], rows=rows)
        np.testing.assert_array_equal(found, 1)


def test_loops_are_compiled_where_no_folder_can_be_written():
    script = "from jaxdn.ops.dispatch.numba_rows import loop\nloop(lambda top, bottom: None)(0, 1)\nprint('compiled')"
    nowhere = {**os.environ, "NUMBA_CACHE_DIR": f"{os.devnull}/folder"}
    done = subprocess.run([sys.executable, "-c", script], env=nowhere, capture_output=True, text=True, check=False)
    assert done.stdout == "compiled\n", done.stderr


def _double(top, bottom, values):
    for x in range(top, bottom):
        values[x] *= 2


@pytest.fixture
def loop(tmp_path, monkeypatch):
    """The decorator of loops, which are kept in an empty folder."""
    from jaxdn.ops.dispatch import numba_rows

    monkeypatch.setenv("JAXDN_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(numba_rows._numba, "CACHE_DIR", "")
    return numba_rows.loop


def test_half_a_file_of_a_loop_is_written_again(loop, tmp_path):
    """As a machine leaves it that crashes."""
    values = np.ones(3, np.float32)
    loop(_double)(0, 3, values)
    for ending in ("nbc", "nbi"):
        (file,) = tmp_path.glob(f"loops/*/*_double-*.{ending}")
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
        loop(_double)(0, 3, values)
    kept = loop(_double)
    kept(0, 3, values)
    np.testing.assert_array_equal(values, 16)
    assert sum(kept.stats.cache_hits.values()) == 1


def test_a_full_disk_ends_no_loop(loop, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", refuse)
    values = np.ones(3, np.float32)
    loop(_double)(0, 3, values)
    np.testing.assert_array_equal(values, 2)


def test_what_was_compiled_with_other_functions_of_rows_is_not_used(loop, monkeypatch):
    """Whatever the times of the files are, and where they cannot be written, too."""
    from jaxdn.ops.dispatch import numba_rows

    def count():
        kept = loop(_double)
        kept(0, 3, np.ones(3, np.float32))
        return sum(kept.stats.cache_hits.values()), sum(kept.stats.cache_misses.values())

    assert count() == (0, 1)
    assert count() == (1, 0)
    assert loop(_double)._cache.has_any()
    monkeypatch.setattr(numba_rows, "_ROWS", "another")
    assert not loop(_double)._cache.has_any()
    assert count() == (0, 1)


def test_a_file_of_other_arguments_is_not_used(loop, tmp_path):
    """Two processes that save two signatures at once may give both the same file."""
    kinds = np.float32, np.float64
    for kind in kinds:
        loop(_double)(0, 3, np.ones(3, kind))
    one, other = tmp_path.glob("loops/*/*_double-*.nbc")
    other.write_bytes(one.read_bytes())
    for kind in kinds * 2:
        values = np.ones(3, kind)
        kept = loop(_double)
        kept(0, 3, values)
        np.testing.assert_array_equal(values, 2)
    assert sum(kept.stats.cache_hits.values()) == 1


_LOOP = """
import numpy as np
from jaxdn.ops.numba_scales import fill_rows
image, out = np.ones((4, 4, 1), np.float32), np.zeros((4, 4, 1), np.float32)
fill_rows(0, 1, image, np.ones((4, 4), np.float32), out)
assert (out == 1).all()
print(sum(fill_rows.stats.cache_hits.values()), sum(fill_rows.stats.cache_misses.values()))
"""
"""Prints how often a loop was found compiled, and how often not."""
_DROP, _WRITES_ANYTHING = 24, 1
"""PR_CAPBSET_DROP and CAP_DAC_OVERRIDE of Linux."""


def _reader():
    """How a process is started that may not write what is read-only, which the superuser otherwise may."""
    if os.geteuid():
        return [sys.executable]
    drop = f"ctypes.CDLL(None).prctl({_DROP}, {_WRITES_ANYTHING}, 0, 0, 0)"
    start = "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    return [sys.executable, "-c", f"import ctypes, os, sys; {drop}; {start}"]


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform == "win32" or (sys.platform != "linux" and os.geteuid() == 0),
    reason="the mode of a folder does not make it read-only, or the superuser may write everything",
)
def test_loops_are_kept_in_the_folder_of_programs_and_found_there_when_it_is_read_only():
    """As in a container's image: filled once, and then read by users who may not write it."""
    reader = _reader()
    with tempfile.TemporaryDirectory() as place:
        usual = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
        environment = {**usual, "JAXDN_CACHE_DIR": place}

        def run(python):
            command = [*python, "-c", _LOOP]
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
            return done.stdout.split()

        def set_mode(mode):
            for folder in [Path(place), *Path(place).glob("loops"), *Path(place).glob("loops/*")]:
                folder.chmod(mode)

        assert run([sys.executable]) == ["0", "1"]
        kept = list(Path(place).glob("loops/*/numba_scales.fill_rows-*"))
        assert kept
        set_mode(0o555)
        try:
            assert run(reader) == ["1", "0"]
            set_mode(0o755)
            for file in kept:
                file.unlink()
            set_mode(0o555)
            # What is not there is compiled, and nobody fails for want of a place.
            assert run(reader) == ["0", "1"]
        finally:
            set_mode(0o755)
        assert not list(Path(place).glob("loops/*/numba_scales.fill_rows-*"))
