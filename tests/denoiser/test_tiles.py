"""Tiles: the image of the whole frame, for every method whose receptive field is known, and what decides about it."""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxdn import color
from jaxdn.core.frame import FAR, Frame, only
from jaxdn.denoiser import Core, Denoiser, recurrent, stages_of
from jaxdn.denoiser.rollout import stream
from jaxdn.denoiser.statistics import FrameStatistics, measure_frame
from jaxdn.denoiser.tiles import GRID, find_history_halo, map_tiles, split_axis, stream_tiled
from jaxdn.denoisers import asvgf, ntasd, ntd, steady, svgf, taa
from jaxdn.sequence.james_stein import REACH, combine, measure_level
from tests.methods.steady.short import TINY, short_steady

METHODS: dict[str, Any] = {
    "svgf": lambda: svgf(levels=3),
    "steady": lambda: steady(quality=TINY),
    "ntd": lambda: ntd(size=TINY),
    "taa after svgf": lambda: taa(after=svgf(levels=2)),
}
HEIGHT = 38
"""One window high, and not a multiple of the blocks that networks work on."""


def frames(count: int, width: int, *, height: int = HEIGHT, seed: int = 0) -> list[Frame]:
    """Things of several materials before the sky that move by up to 6 pixels, with light that falls off to one side.

    Only on the left is the reflectance another than the albedo, and only on the right is there sky.
    """
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:height, :width]
    things = (rows // 11 + columns // 17) % 5
    sky = (things == 4) & (columns > width // 2)
    directions = rng.normal(size=(5, 3))
    normal = (directions / np.linalg.norm(directions, axis=1, keepdims=True))[things]
    albedo = rng.uniform(0.02, 0.95, (5, 3))[things]
    reflectance = np.where(columns[..., None] < 40, 0.5 * albedo, albedo)
    depth = np.where(sky, FAR, 2.0 + 0.4 * things + columns / 200)[..., None]
    motion = np.stack([2.3 + 0.9 * things, -1.7 + 0.0 * rows], axis=-1)
    motion[3:6, :20] = np.nan
    brightness = np.exp(columns / width * 3)[..., None]
    same = {"albedo": albedo, "reflectance": reflectance, "normal": normal, "depth": depth, "motion": motion}
    same |= {"dual_motion": motion + 1.0, "previous_depth": depth, "roughness": 0.3 + 0.0 * depth}
    held: dict[str, Any] = {name: np.asarray(buffer, np.float32) for name, buffer in same.items()}
    held["ids"] = np.where(sky, -1, things)[..., None].astype(np.int32)

    def light() -> np.ndarray:
        return (rng.gamma(0.5, 2.0, (height, width, 3)) * albedo * brightness).astype(np.float32)

    return [Frame(radiance=light(), **held) for _ in range(count)]


def doubled(frame: Frame) -> Frame:
    return jax.tree.map(lambda x: x.astype(np.float64) if x.dtype == np.float32 else x, frame)


def random_params(denoiser: Denoiser, frame: Frame) -> Any:
    """Decisions that differ from pixel to pixel; those of a filter are its own."""
    params = denoiser.init(jax.random.key(0), frame)
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), max(len(leaves), 1))
    moved = [leaf + 0.2 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=False)]
    return jax.tree.unflatten(tree, moved) if jnp.size(leaves[0]) > 1 else params


@given(st.integers(1, 3000), st.integers(0, 200), st.integers(0, 900))
@settings(max_examples=300, deadline=None)
def test_windows_cover_all_and_have_their_margins(length: int, halo: int, more: int) -> None:
    side = 2 * (halo + GRID) + GRID + more
    found = split_axis(length, side, halo)
    assert found[0].keep_start == 0
    assert found[-1].keep_stop == length
    for one, following in itertools.pairwise(found):
        assert one.keep_stop == following.keep_start
    for one in found:
        assert 0 <= one.start <= one.keep_start < one.keep_stop <= one.stop <= length
        assert one.stop - one.start == found[0].stop - found[0].start <= side
        assert one.start % GRID == 0
        assert one.start == 0 or one.keep_start - one.start >= halo
        assert one.stop == length or one.stop - one.keep_stop >= halo
    with pytest.raises(ValueError, match=f"got room for {2 * halo + GRID}"):
        split_axis(length + 2 * halo + 2 * GRID, 2 * halo + GRID, halo)


LEFT_OUT = frozenset({"reflectance", "normal", "motion", "dual_motion", "ids", "depth", "previous_depth"})
"""Of few buffers: what is left hardly stops a filter."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "without"),
    [
        # `taa after svgf` does all that `svgf` does; how far that reaches alone the test below looks at, and so it does
        # at `steady` with few buffers.
        *(pytest.param(name, frozenset(), id=f"{name}-all buffers") for name in METHODS if name != "svgf"),
        *(pytest.param(name, LEFT_OUT, id=f"{name}-few buffers") for name in ("ntd", "taa after svgf")),
    ],
)
def test_tiles_make_the_image_of_the_whole_frame(
    name: str, without: frozenset[str], x64: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With few buffers too: then few guides stop a filter. In float64: what is left is rounding alone."""
    denoiser = short_steady(monkeypatch) if name == "steady" else METHODS[name]()
    field = denoiser.receptive_field
    side = 2 * (field + 10 + GRID) + 3 * GRID
    width = side + 5 * GRID + 7
    some = [doubled(only(frame, frozenset(Frame._fields) - without)) for frame in frames(2, width)]
    params = random_params(denoiser, some[0])
    whole, tiles = stream(denoiser, params), stream_tiled(denoiser, params, side, (HEIGHT, width))
    for frame in some:
        expected, image = np.asarray(whole(frame)), tiles(frame)
        np.testing.assert_allclose(image, expected, rtol=1e-9, atol=1e-12)
    assert tiles.sanitized == whole.sanitized
    assert tiles.beyond_halo == 0
    assert len(tiles.programs) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_nothing_beyond_the_receptive_field_decides_about_a_pixel(name: str, x64: None) -> None:
    """Everything to the right of a column is other than it was, but not what is measured of the frame.

    Of ``steady`` with few buffers: less of what it sees stops its filter.
    """
    denoiser = METHODS[name]()
    reads = denoiser.reads - LEFT_OUT if name == "steady" else denoiser.reads
    stages, field, at = stages_of(denoiser), denoiser.receptive_field, 48
    assert field is not None
    width = at + field + 4 * GRID
    cut = at + field + 7  # and 6.8 pixels as far as motion fetches
    one, other = (doubled(only(each[0], reads)) for each in (frames(1, width), frames(1, width, seed=1)))
    changed = jax.tree.map(lambda a, b: np.concatenate([a[:, :cut], b[:, cut:]], axis=1), one, other)
    params = random_params(denoiser, one)
    state = jax.tree.map(jnp.zeros_like, stages.start(params, one))
    statistics = jax.jit(stages.prepare)(one)[0]

    @jax.jit
    def step(state: Any, frame: Frame) -> Any:
        return stages.step(params, state, stages.prepare(frame)[1], jnp.asarray(False), statistics)

    state = jax.tree.map(jnp.asarray, step(state, one)[0])
    images = []
    for frame in (one, changed):
        after, image, _ = step(state, frame)
        images.append((after, image))
    kept = [jax.tree.map(lambda x: np.asarray(x)[:, :at], each) for each in images]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), *kept)
    assert not np.allclose(images[0][1][:, cut + 8 :], images[1][1][:, cut + 8 :])


@pytest.mark.slow
def test_history_from_too_far_away_is_counted_and_begins_anew() -> None:
    denoiser = svgf(levels=2)
    side = 2 * (denoiser.receptive_field + 20 + GRID) + GRID
    clip = frames(2, 500)
    for frame in clip:
        # Ten stripes to the right there is the same thing, farther away.
        frame.motion[10:14, 100:120] = (170.0, 0.0)
        frame.previous_depth[10:14, 100:120] = frame.depth[10:14, 270:290]
        frame.motion[20:24, 480:490] = (170.0, 0.0)  # leaves the frame: has no history anyway
    tiles = stream_tiled(denoiser, {}, side, (HEIGHT, 500))
    whole = stream(denoiser, {})
    for frame in clip:
        image, expected = tiles(frame), np.asarray(whole(frame))
    assert tiles.beyond_halo == 4 * 20
    far = denoiser.receptive_field
    apart = np.abs(image - expected).max(axis=-1) > 1e-3 * expected.mean()
    assert apart[10:14, 100:120].any()
    assert not apart[:, : 100 - far].any()
    assert not apart[:, 120 + far :].any()


def test_the_smallest_tiles_have_room_for_what_stands_still() -> None:
    field = 10
    core = Core(
        lambda params, frame: jnp.zeros_like(frame.radiance),
        lambda params, state, frame, first, statistics: (frame.radiance, frame.radiance, 0),
        frozenset({"motion"}),
        receptive_field=field,
    )
    side = 2 * (field + 3 + GRID)
    size = (6, side + 2 * GRID)
    tiles = stream_tiled(recurrent(core), {}, side, size)
    frame = Frame(np.ones((*size, 3), np.float32), motion=np.zeros((*size, 2), np.float32))
    tiles(frame)
    assert tiles.beyond_halo == 0
    frame.motion[3, 5] = 1.5, 0
    tiles(frame)
    assert tiles.beyond_halo == 1


def test_how_far_history_is_fetched() -> None:
    frame = only(frames(1, 200)[0], frozenset({"albedo"}))
    assert find_history_halo(frame, 100) == (3, 0)
    motion = np.zeros((HEIGHT, 200, 2), np.float32)
    motion[5, 50], motion[6, 60], motion[7, 10], motion[8, 8] = (-17.5, 0), (0, 12), (-60, 0), (np.inf, 0)
    frame = frame._replace(motion=motion)
    assert find_history_halo(frame, 100) == (21, 0)
    assert find_history_halo(frame, 20) == (15, 1)
    assert find_history_halo(frame._replace(shadow_motion=2 * motion), 100) == (38, 0)


def test_what_cannot_be_tiled_is_refused() -> None:
    with pytest.raises(ValueError, match="tiles: expected a denoiser whose receptive_field is known, got None"):
        stream_tiled(asvgf(), {}, 1024, (HEIGHT, 2000))
    with pytest.raises(ValueError, match="tiles: expected a denoiser that requests no samples"):
        stream_tiled(ntasd(size=TINY, budget=2.0), {}, 1024, (HEIGHT, 2000))
    with pytest.raises(ValueError, match="got room for 128"):
        stream_tiled(svgf(), {}, 128, (HEIGHT, 2000))
    stream_tiled(svgf(), {}, 128, (HEIGHT, 128))


def test_sums_of_tiles_are_those_of_the_frame() -> None:
    frame = frames(1, 4 * GRID, height=2 * GRID)[0]
    tiles = [jax.tree.map(lambda x, c=c: x[:, c : c + GRID], frame) for c in range(0, 4 * GRID, GRID)]
    measure = jax.jit(lambda one: measure_frame(one.radiance, one.depth, one))
    sums = jax.device_get([measure(one) for one in (frame, *tiles)])
    total: FrameStatistics = jax.tree.map(lambda *each: sum(each), *sums[1:])
    whole = sums[0]
    for name in ("exposure", "mean_depth", "mean_inverse_depth", "reflectance_differs"):
        np.testing.assert_allclose(getattr(total, name), getattr(whole, name), rtol=1e-5)
    np.testing.assert_allclose(whole.exposure, color.exposure(frame.radiance), rtol=1e-6)
    known = frame.depth[frame.depth < FAR].astype(np.float64)
    np.testing.assert_allclose(whole.mean_depth, np.exp(np.log(known).mean()), rtol=1e-5)
    np.testing.assert_allclose(whole.mean_inverse_depth, (1 / known).mean(), rtol=1e-5)
    differs = np.any(frame.reflectance != frame.albedo, axis=-1)
    assert whole.reflectance_differs == differs.sum() > 0
    assert measure_frame(frame.radiance, None, frame._replace(albedo=None)).reflectance_differs == 0


@pytest.mark.parametrize("size", [(260, 20), (20, 260)])
def test_a_last_tile_of_less_than_a_block_is_measured_as_in_the_whole_frame(size: tuple[int, int]) -> None:
    """The whole frame drops the 4 rows or columns: a core shows the exposure that it is given."""

    def step(params: Any, state: Any, frame: Frame, first: jax.Array, statistics: FrameStatistics) -> Any:
        return state, jnp.full_like(frame.radiance, statistics.exposure), 0

    denoiser = recurrent(Core(lambda params, frame: (), step, frozenset(), receptive_field=0))
    light = np.ones((260, 20, 3), np.float32)
    light[256:] = 1000.0
    frame = Frame(light if size[0] == 260 else light.transpose(1, 0, 2))
    image = stream_tiled(denoiser, {}, 128, size)(frame)
    np.testing.assert_allclose(image, stream(denoiser, {})(frame), rtol=1e-6)
    np.testing.assert_allclose(image, 0.18, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("samples", [4, 4096])
def test_the_safe_mixture_in_tiles_is_that_of_the_whole_frame(samples: int) -> None:
    rng = np.random.default_rng(0)
    height, width = 300, 411
    columns = np.arange(width, dtype=np.float32)
    truth = np.broadcast_to((1 + np.sin(columns / 9))[None, :, None], (height, width, 3))
    noisy = (truth * rng.gamma(samples, 1 / samples, truth.shape)).astype(np.float32)
    denoised = (truth + 0.05 * np.cos(columns / 50)[None, :, None]).astype(np.float32)
    level = measure_level(jnp.asarray(denoised))
    found, others = map_tiles(
        lambda given: (combine(*given, level), None), (noisy, denoised), (height, width), side=288, halo=REACH
    )
    assert len(others) == 4
    expected = jax.jit(combine)(noisy, denoised)
    for name in ("noisy_weight", "noise", "image"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, atol=1e-4)
