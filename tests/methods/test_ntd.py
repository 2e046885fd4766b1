"""The neural temporal denoiser: its data flow against NumPy, hard cases, and gradients through time."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn import brdf
from jaxdn.core.frame import FAR, Frame, frame_at, only
from jaxdn.denoiser import Denoiser, Recurrent
from jaxdn.denoiser.rollout import unroll
from jaxdn.denoiser.statistics import geometric_mean_depth, sum_depths
from jaxdn.filters.surface_test import depth_feature
from jaxdn.methods.ntasd import ntasd
from jaxdn.methods.ntd import guided_features, ntd

TINY = ((4,), (4,), (5,), (5,), (6,))
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper": {"preset": "paper"},
    "fine": {"alpha_at": "fine", "up": "nearest", "first_frame": "noisy"},
    "max": {"down": "max", "depth_scale": "unit", "missing_history": "blend"},
    "plain": {"kernels": "plain", "background": "filter", "exposure": "given"},
    "materials": {"guides": "materials"},
    "traditional": {"motion": "traditional", "demodulate": "none"},
}
SELDOM = sorted(VARIANTS.keys() - {"default", "plain"})
"""Those that only the slow tests go through one by one: each is another program."""


@functools.cache
def tiny(**options: Any) -> Denoiser:
    """The same one for the same options, so that its programs are compiled once."""
    return ntd(size=TINY, **options)


def random_frames(rng: np.random.Generator, size: tuple[int, int] = (16, 16), count: int = 2) -> Frame:
    """All buffers of a clip; vectors of a pixel or two."""
    shape = (count, *size)

    def buffer(values: np.ndarray) -> jax.Array:
        return jnp.asarray(values, jnp.float32)

    motion = rng.normal(size=(*shape, 2))
    return Frame(
        radiance=buffer(rng.exponential(size=(*shape, 3))),
        albedo=buffer(rng.uniform(size=(*shape, 3))),
        normal=buffer(rng.normal(size=(*shape, 3))),
        depth=buffer(rng.uniform(1, 9, size=(*shape, 1))),
        motion=buffer(motion),
        dual_motion=buffer(motion + rng.normal(size=(*shape, 2))),
    )


def initial(denoiser: Denoiser, key: jax.Array, frames: Frame) -> Any:
    """Parameters with non-zero biases."""
    params = denoiser.init(key, frame_at(frames, 0))
    return jax.tree.map(lambda leaf: 1.5 * leaf + 0.1 * jax.random.normal(key, leaf.shape), params)


@functools.cache
def run(denoiser: Denoiser) -> Callable[[Any, Frame], jax.Array]:
    """Images of params and frames."""
    return jax.jit(lambda params, frames: unroll(denoiser, params, frames))


@functools.cache
def stepped(denoiser: Denoiser) -> Callable[[Any, Any, Frame], Any]:
    return jax.jit(denoiser.step)


def loss(denoiser: Denoiser, params: Any, frames: Frame) -> tuple[jax.Array, jax.Array]:
    """A sum that the light of bright pixels does not rule, and the images."""
    images = unroll(denoiser, params, frames)
    return jnp.sum(jnp.log1p(images)), images


@functools.cache
def learning(denoiser: Denoiser) -> Callable[[Any, Frame], Any]:
    """The loss with the images, and its gradient by params: one program for all tests that want either."""
    return jax.jit(jax.value_and_grad(functools.partial(loss, denoiser), has_aux=True))


# The processing of a frame, in NumPy.


def box(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    padded = np.pad(image, ((2, 2), (2, 2), (0, 0)), mode="edge")
    return sum(kernel[5 * i + j] * padded[i : i + height, j : j + width] for i in range(5) for j in range(5))


def half(image: np.ndarray, down: str = "mean") -> np.ndarray:
    height, width, channels = image.shape
    blocks = image.reshape(height // 2, 2, width // 2, 2, channels)
    return blocks.mean(axis=(1, 3)) if down == "mean" else blocks.max(axis=(1, 3))


def double(image: np.ndarray, up: str = "bilinear") -> np.ndarray:
    for axis in (0, 1):
        length = image.shape[axis]
        position = (np.arange(2 * length) + 0.5) / 2 - 0.5
        low = np.floor(position).astype(int)
        weight = np.expand_dims(position - low, [other for other in range(3) if other != axis])
        below, above = (image.take(np.clip(low + step, 0, length - 1), axis) for step in (0, 1))
        image = np.repeat(image, 2, axis) if up == "nearest" else (1 - weight) * below + weight * above
    return image


def softmax(logits: np.ndarray) -> np.ndarray:
    return np.exp(logits) / np.exp(logits).sum()


def sigmoid(logit: float) -> float:
    return 1 / (1 + np.exp(-logit))


@pytest.mark.parametrize(
    "options",
    [{}, {"alpha_at": "fine", "up": "nearest", "down": "max"}, {"preset": "paper"}],
    ids=["default", "fine", "paper"],
)
def test_data_flow_with_known_heads(options: dict[str, Any], rng: np.random.Generator) -> None:
    """Zero weights and chosen biases: the heads are constants, and the image can be computed by hand."""
    denoiser = tiny(**options)
    fine = options.get("alpha_at") == "fine"
    down = "max" if options else "mean"
    up = options.get("up", "bilinear")
    noisy, history = rng.exponential(size=(2, 16, 32, 3))
    frame = Frame(jnp.asarray(noisy, jnp.float32))
    params = jax.tree.map(jnp.zeros_like, denoiser.init(jax.random.key(0), frame))
    heads = [rng.normal(size=params[f"head_{level}"]["bias"].shape) for level in range(3)]
    assert [len(head) for head in heads] == ([52, 26, 25] if fine else [51, 26, 26])
    for level, head in enumerate(heads):
        params[f"head_{level}"]["bias"] = jnp.asarray(head, jnp.float32)
    state = Recurrent(jnp.asarray(history, jnp.float32), jnp.asarray(3), jnp.asarray(0))
    after, image = stepped(denoiser)(params, state, frame)

    scales = [noisy, half(noisy, "mean"), half(half(noisy, "mean"), "mean")]
    full, middle, coarse = (box(scale, softmax(head[:25])) for scale, head in zip(scales, heads, strict=True))
    for finer, alpha in ((middle, heads[1][25] if fine else heads[2][25]), (full, heads[0][51 if fine else 0])):
        if not fine and finer is full:
            alpha = heads[1][25]
        coarse = finer - sigmoid(alpha) * double(half(finer, down), up) + sigmoid(alpha) * double(coarse, up)
    temporal = box(history, softmax(heads[0][25:50]))
    current = sigmoid(heads[0][50])
    wanted = np.maximum(current * coarse + (1 - current) * temporal, 0)
    np.testing.assert_allclose(image, wanted, atol=1e-5)
    np.testing.assert_array_equal(after.core, image)
    assert after.age == 4


@pytest.mark.parametrize("prediction", ["three-scales", "one-scale", "direct"])
def test_less_than_all_kernels_with_known_heads(prediction: Any, rng: np.random.Generator) -> None:
    """The ladder of Hasselgren et al. 2020: constant heads, and the image by hand; the history has no kernel."""
    denoiser = tiny(prediction=prediction, kernels="plain", exposure="given")
    noisy, history = rng.exponential(size=(2, 16, 32, 3))
    frame = Frame(jnp.asarray(noisy, jnp.float32))
    params = jax.tree.map(jnp.zeros_like, denoiser.init(jax.random.key(0), frame))
    names = [name for name in params if name.startswith("head")]
    heads = {name: rng.normal(size=params[name]["bias"].shape) for name in names}
    sizes = {"three-scales": [25, 26, 26], "one-scale": [25], "direct": [3]}
    assert [len(heads[name]) for name in sorted(heads)] == sizes[prediction]
    for name, head in heads.items():
        params[name]["bias"] = jnp.asarray(head, jnp.float32)
    state = Recurrent(jnp.asarray(history, jnp.float32), jnp.asarray(3), jnp.asarray(0))
    _, image = stepped(denoiser)(params, state, frame)
    if prediction == "direct":
        wanted = np.broadcast_to(np.expm1(np.maximum(heads["head_0"], 0) ** 2.2), noisy.shape)
    else:
        wanted = box(noisy, softmax(heads["head_0"][:25]))
    if prediction == "three-scales":
        scales = [half(noisy), half(half(noisy))]
        middle, coarse = (box(each, softmax(heads[f"head_{i}"][:25])) for i, each in enumerate(scales, 1))
        for finer, alpha in ((middle, heads["head_2"][25]), (wanted, heads["head_1"][25])):
            coarse = finer - sigmoid(alpha) * double(half(finer)) + sigmoid(alpha) * double(coarse)
        wanted = np.maximum(coarse, 0)
    np.testing.assert_allclose(image, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("prediction", ["three-scales", "one-scale", "direct"])
def test_less_than_all_kernels_begins_plausibly_and_learns(prediction: Any, rng: np.random.Generator) -> None:
    denoiser, frames = tiny(prediction=prediction), random_frames(rng)
    params = denoiser.init(jax.random.key(0), frame_at(frames, 0))
    (_, images), slopes = learning(denoiser)(params, frames)
    assert 0.3 < float(jnp.mean(images) / jnp.mean(frames.radiance)) < 3
    assert all(np.abs(slopes[name]["kernel"]).max() > 0 for name in slopes if name.startswith("head"))
    assert ("guide" in params) == (prediction != "direct")


@pytest.mark.parametrize(("method", "buffer"), [(ntd, "dual_motion"), (ntasd, "motion")], ids=["ntd", "ntasd"])
def test_the_history_lies_where_the_vector_points(method: Any, buffer: str, rng: np.random.Generator) -> None:
    """Of a pixel p at p + vector, x to the right and y down: heads that show the history alone."""
    denoiser = method(size=TINY, kernels="plain", demodulate="none")
    noisy, history = rng.exponential(size=(2, 16, 32, 3)).astype(np.float32)
    vectors = {"motion": jnp.zeros((16, 32, 2)), "dual_motion": jnp.zeros((16, 32, 2))}
    vectors[buffer] = jnp.broadcast_to(jnp.asarray([3.0, -2.0]), (16, 32, 2))
    frame = Frame(jnp.asarray(noisy), **vectors, sample_count=jnp.ones((16, 32, 1)))
    frame = only(frame, denoiser.reads)
    params = jax.tree.map(jnp.zeros_like, denoiser.init(jax.random.key(0), frame))
    network = params["denoiser"] if method is ntasd else params
    bias = network["head_0"]["bias"]
    network["head_0"]["bias"] = bias.at[25 + 12].set(50.0).at[50].set(-50.0)
    state = Recurrent(jnp.asarray(history), jnp.asarray(3), jnp.asarray(0))
    _, image = stepped(denoiser)(params, state, frame)
    np.testing.assert_allclose(image[2:, :-3], history[:-2, 3:], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("preset", [None, "paper"])
def test_without_a_history_every_frame_is_a_first_one(
    preset: str | None, rng: np.random.Generator, key: jax.Array
) -> None:
    """Whatever came before; the networks without recurrence that papers compare with."""
    denoiser, usual = (tiny(preset=preset, **more) for more in ({"history": "none"}, {}))
    assert usual.reads & {"motion", "dual_motion"}
    assert not denoiser.reads & {"motion", "dual_motion"}
    frames = random_frames(rng)
    params, frame = initial(usual, key, frames), frame_at(frames, 1)
    start = usual.start(params, frame)
    later = start._replace(core=jnp.full_like(start.core, 7.0), age=start.age + 3)
    _, expected = stepped(usual)(params, start, frame)
    np.testing.assert_allclose(stepped(denoiser)(params, later, frame)[1], expected, rtol=1e-5, atol=1e-6)
    assert np.abs(stepped(usual)(params, later, frame)[1] - expected).max() > 0.01


def blending(params: Any, logit: float) -> Any:
    """The same parameters with alpha^t the same everywhere."""
    head = params["head_0"]
    kernel, bias = head["kernel"].at[..., 50].set(0.0), head["bias"].at[50].set(logit)
    return {**params, "head_0": {"kernel": kernel, "bias": bias}}


@pytest.mark.slow
def test_alpha_weighs_the_current_frame_and_missing_history_is_not_used(
    rng: np.random.Generator, key: jax.Array
) -> None:
    denoiser = tiny(demodulate="none")
    frames = random_frames(rng)
    params, frame = initial(denoiser, key, frames), frame_at(frames, 1)
    broken = frame.dual_motion.at[4, 5].set(jnp.nan).at[9, 9].set(jnp.asarray([40.0, 0.0]))
    frame = frame._replace(dual_motion=jnp.clip(broken, -1e3, 1e3))
    step = stepped(denoiser)

    def image(logit: float, level: float) -> np.ndarray:
        state = Recurrent(jnp.full((16, 16, 3), level), jnp.asarray(1), jnp.asarray(0))
        return np.asarray(step(blending(params, logit), state, frame)[1])

    # A history of 1000 against a noise of about 1: where it is used, it shows.
    brightest = image(-50.0, 1000.0)
    assert np.median(brightest) > 500
    assert brightest[4, 5].max() < 20
    assert brightest[9, 9].max() < 20
    assert image(50.0, 1000.0).max() < 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["default", "plain", *(pytest.param(name, marks=pytest.mark.slow) for name in SELDOM)])
def test_constant_radiance_stays(name: str, rng: np.random.Generator, key: jax.Array) -> None:
    """Softmax kernels, means and maxima keep a constant, including the border, whatever the network predicts."""
    denoiser = tiny(**VARIANTS[name])
    frames = random_frames(rng, (19, 21))
    frames = frames._replace(radiance=jnp.full_like(frames.radiance, 0.7))
    if name == "paper":  # the paper's zeros beyond the border are not constant
        frames = frames._replace(motion=None, dual_motion=None)
    usual = "none" if name == "paper" else "brdf"
    if VARIANTS[name].get("demodulate", usual) != "none":  # divided radiance is what is constant here
        frames = frames._replace(radiance=0.7 * brdf.divisor(frames.albedo))
    images = run(denoiser)(initial(denoiser, key, frames), frames)
    np.testing.assert_allclose(images, frames.radiance, rtol=3e-5)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1, 1), (33, 57)])
def test_any_size(size: tuple[int, int], rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny()
    frames = random_frames(rng, size)
    images = np.asarray(run(denoiser)(initial(denoiser, key, frames), frames))
    assert images.shape == (2, *size, 3)
    assert np.all(np.isfinite(images))
    assert images.min() >= 0
    assert np.std(images) > 0


@pytest.mark.slow
@pytest.mark.parametrize("preset", [None, "paper"])
def test_none_is_the_neutral_value_written_out(preset: str | None, rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny(preset=preset)
    frames = random_frames(rng)
    bare = Frame(frames.radiance)
    zero = jnp.zeros_like(frames.motion)
    written = Frame(
        frames.radiance,
        albedo=jnp.ones_like(frames.albedo),
        normal=jnp.zeros_like(frames.normal),
        depth=jnp.zeros_like(frames.depth),
        motion=zero,
        dual_motion=zero,
    )
    params = initial(denoiser, key, frames)
    assert jax.tree.all(jax.tree.map(lambda a, b: a.shape == b.shape, params, denoiser.init(key, frame_at(bare, 0))))
    forward = run(denoiser)
    np.testing.assert_allclose(forward(params, bare), forward(params, written), atol=1e-5)
    flops = [forward.lower(params, each).cost_analysis()["flops"] for each in (bare, written)]
    assert flops[0] < flops[1]
    assert len(forward.lower(params, bare).as_text()) < len(forward.lower(params, written).as_text())


def test_without_motion_nothing_is_gathered(rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny()
    frame = frame_at(random_frames(rng), 0)
    params = jax.eval_shape(denoiser.init, key, frame)

    def text(frame: Frame) -> str:
        return stepped(denoiser).lower(params, jax.eval_shape(denoiser.start, params, frame), frame).as_text()

    assert "gather" in text(frame)
    assert "gather" not in text(frame._replace(motion=None, dual_motion=None))


@pytest.mark.slow
def test_dual_motion_falls_back_and_traditional_ignores_it(rng: np.random.Generator, key: jax.Array) -> None:
    frames = random_frames(rng)
    dual, traditional = tiny(), tiny(motion="traditional")
    assert dual.reads == {"albedo", "reflectance", "normal", "depth", "motion", "dual_motion"}
    assert traditional.reads == dual.reads - {"dual_motion"}
    params = initial(dual, key, frames)
    with_dual = run(dual)(params, frames)
    fallen_back = run(dual)(params, frames._replace(dual_motion=None))
    np.testing.assert_array_equal(run(traditional)(params, frames), fallen_back)
    assert np.abs(with_dual - fallen_back).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("preset", [None, "paper"])
def test_first_frame_uses_no_history_and_no_motion(
    preset: str | None, rng: np.random.Generator, key: jax.Array
) -> None:
    denoiser = tiny(preset=preset)
    frames = random_frames(rng)
    params, frame = initial(denoiser, key, frames), frame_at(frames, 0)
    step = stepped(denoiser)
    start = denoiser.start(params, frame)
    _, image = step(params, start, frame)
    poisoned = start._replace(core=jnp.full_like(start.core, jnp.nan))
    elsewhere = frame._replace(motion=3 * frame.motion, dual_motion=jnp.full_like(frame.motion, 7.3))
    np.testing.assert_array_equal(step(params, poisoned, elsewhere)[1], image)


POISON = (np.nan, np.inf, -np.inf, 1e30, -1.0)


@pytest.mark.slow
def test_poison_stays_finite_and_is_counted(rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny()
    frames = random_frames(rng)
    params, step = initial(denoiser, key, frames), stepped(denoiser)
    for name in ("radiance", "albedo", "normal", "depth", "motion", "dual_motion"):
        for value in POISON:
            buffer = getattr(frames, name).at[0, 3, 4, 0].set(value)
            poisoned = frames._replace(**{name: buffer})
            (total, _), slope = learning(denoiser)(params, poisoned)
            assert np.isfinite(total), (name, value)
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope)), (name, value)
    first = frame_at(frames, 0)
    broken = first._replace(radiance=first.radiance.at[3, 4].set(jnp.nan))
    state, image = step(params, denoiser.start(params, broken), broken)
    assert state.sanitized == 3
    assert np.all(np.isfinite(image))
    state = state._replace(core=state.core.at[2, 2].set(jnp.nan).at[3, 3].set(jnp.inf))
    state, image = step(params, state, first)
    assert np.all(np.isfinite(image))
    assert np.all(np.isfinite(state.core))
    assert image.max() <= 65504


@pytest.mark.slow
@pytest.mark.parametrize("name", ["default", "paper"])
def test_gradient_through_time(name: str, rng: np.random.Generator, key: jax.Array, x64: None) -> None:
    """It agrees with central differences along random directions; what it is of, with a loop over steps.

    The loop is of the smaller network, as it is the scan that is looked at. Its gradient is another program.
    """
    denoiser = tiny(**VARIANTS[name])
    frames = jax.tree.map(lambda buffer: jnp.asarray(buffer, jnp.float64), random_frames(rng))
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), initial(denoiser, key, frames))
    weights = jnp.asarray(rng.normal(size=frames.radiance.shape))

    def scanned(params: Any) -> jax.Array:
        return jnp.mean(weights * unroll(denoiser, params, frames))

    value_and_gradient = jax.jit(jax.value_and_grad(scanned))
    value, gradient = value_and_gradient(params)
    flat = jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(gradient)])
    assert jnp.linalg.norm(flat) > 1e-3
    if name == "paper":
        state, images = denoiser.start(params, frame_at(frames, 0)), []
        for index in range(2):
            state, image = stepped(denoiser)(params, state, frame_at(frames, index))
            images.append(image)
        np.testing.assert_allclose(jnp.mean(weights * jnp.stack(images)), value, rtol=0, atol=1e-12)
    for seed in range(3):
        keys = jax.random.split(jax.random.key(seed), len(jax.tree.leaves(params)))
        keys = jax.tree.unflatten(jax.tree.structure(params), list(keys))
        way = jax.tree.map(lambda key, leaf: jax.random.normal(key, leaf.shape, leaf.dtype), keys, params)
        ahead, behind = (jax.tree.map(lambda p, d, s=s: p + s * d, params, way) for s in (1e-7, -1e-7))
        measured = (value_and_gradient(ahead)[0] - value_and_gradient(behind)[0]) / 2e-7
        claimed = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(way), strict=True))
        np.testing.assert_allclose(measured, claimed, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_batch_is_each_clip_alone(rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny()
    clips = [random_frames(rng) for _ in range(2)]
    batch = jax.tree.map(lambda *buffers: jnp.stack(buffers), *clips)
    params = initial(denoiser, key, clips[0])
    losses = jax.vmap(functools.partial(loss, denoiser), (None, 0))
    value, slope = jax.jit(jax.value_and_grad(lambda params: jnp.mean(losses(params, batch)[0])))(params)
    alone, slopes = zip(*[learning(denoiser)(params, clip) for clip in clips], strict=True)
    np.testing.assert_allclose(value, sum(total for total, _ in alone) / 2, rtol=1e-5)
    for whole, first, second in zip(*map(jax.tree.leaves, (slope, *slopes)), strict=True):
        np.testing.assert_allclose(whole, (first + second) / 2, atol=1e-4 * max(1e-3, np.abs(whole).max()))


@pytest.mark.slow
def test_a_clip_is_one_program(rng: np.random.Generator, key: jax.Array) -> None:
    denoiser, traced = tiny(), []

    def step(*arguments: Any) -> Any:
        traced.append(arguments)
        return denoiser.step(*arguments)

    counted = run(denoiser._replace(step=step))
    frames = random_frames(rng, count=5)
    params = initial(denoiser, key, frames)
    counted(params, frames)
    counted(params, random_frames(rng, count=5))
    assert counted._cache_size() == 1
    assert len(traced) == 1


@pytest.mark.parametrize("guides", ["geometry", "materials"])
def test_parameters_of_the_guides(guides: str, rng: np.random.Generator, key: jax.Array) -> None:
    """One logarithm for each scale and channel, the same whatever buffers the frame has; none for plain kernels."""
    frame = frame_at(random_frames(rng), 0)
    options = {"guides": guides}
    params, plain = tiny(**options).init(key, frame), tiny(**options, kernels="plain").init(key, frame)
    channels = {"albedo": 3, "normal": 3, "depth": 1} | (
        {"reflectance": 3, "roughness": 1} if guides == "materials" else {}
    )
    assert {name: leaf.shape for name, leaf in params["guide"].items()} == {n: (3, c) for n, c in channels.items()}
    assert set(params) - set(plain) == {"guide"}
    assert np.all(params["guide"]["depth"] == 6.0)
    bare = tiny(**options).init(key, Frame(frame.radiance))
    jax.tree.map(np.testing.assert_array_equal, bare, params)


def test_features_of_the_guides_are_scaled_means(rng: np.random.Generator) -> None:
    albedo, depth = rng.random((8, 16, 3)), rng.random((8, 16, 1))
    precisions = {"albedo": rng.normal(size=(3, 3)), "normal": np.zeros((3, 3)), "depth": rng.normal(size=(3, 1))}
    features = guided_features(
        jax.tree.map(jnp.asarray, precisions), {"albedo": jnp.asarray(albedo), "normal": None, "depth": depth}
    )
    means = albedo, half(albedo), half(half(albedo))
    distances = depth, half(depth), half(half(depth))
    for scale in range(3):
        wanted = [np.exp(precisions["albedo"][scale] / 2) * means[scale]]
        wanted.append(np.exp(precisions["depth"][scale] / 2) * distances[scale])
        np.testing.assert_allclose(features[scale], np.concatenate(wanted, axis=-1), rtol=1e-5)
    assert guided_features(precisions, dict.fromkeys(precisions)) == [None] * 3


@pytest.mark.slow
def test_guided_kernels_keep_two_surfaces_apart(rng: np.random.Generator) -> None:
    """Dark and bright walls at a right angle, equal noise, a network that predicts nothing: the mean of each stays."""
    right = (np.arange(64) >= 32).astype(np.float32)[None, :, None]
    normal = np.concatenate([1 - right, right, 0 * right], axis=-1)
    light = 1 + 9 * right + rng.normal(0, 0.5, (64, 64, 3)).astype(np.float32)
    frame = Frame(
        jnp.asarray(np.maximum(light, 0)),
        normal=jnp.asarray(np.broadcast_to(normal, (64, 64, 3))),
        depth=jnp.full((64, 64, 1), 3.0),
    )
    errors = {}
    for kernels in ("guided", "plain"):
        denoiser = tiny(kernels=kernels)
        params = denoiser.init(jax.random.key(0), frame)
        params = {
            name: part if name == "guide" else jax.tree.map(jnp.zeros_like, part) for name, part in params.items()
        }
        _, image = stepped(denoiser)(params, denoiser.start(params, frame), frame)
        errors[kernels] = np.abs(np.asarray(image) - (1 + 9 * right))[:, 16:48].max()
    assert errors["guided"] < 0.5
    assert errors["plain"] > 1.5


@pytest.mark.slow
def test_the_background_passes_through_and_gives_surfaces_no_light(rng: np.random.Generator, key: jax.Array) -> None:
    """Also in the second frame, when surfaces have moved over it."""
    frames = random_frames(rng)
    sky = rng.random((2, 16, 16, 1)) < 0.3
    frames = frames._replace(depth=jnp.where(sky, FAR, frames.depth))
    brighter = frames._replace(radiance=jnp.where(sky, 50 * frames.radiance + 7, frames.radiance))
    denoiser = tiny()
    params, step = initial(denoiser, key, frames), run(denoiser)
    images, others = (np.asarray(step(params, each)) for each in (frames, brighter))
    for found, given in ((images, frames), (others, brighter)):
        np.testing.assert_allclose(*(np.where(sky, each, 0) for each in (found, given.radiance)), rtol=1e-6)
    np.testing.assert_array_equal(*(np.where(sky, 0, each) for each in (images, others)))
    filtering = tiny(background="filter")
    first, second = (np.where(sky, 0, run(filtering)(params, each)) for each in (frames, brighter))
    assert np.abs(first - second).max() > 0.1
    assert denoiser.reads == filtering.reads
    without = frames._replace(depth=None)
    np.testing.assert_array_equal(step(params, without), run(filtering)(params, without))


def mean_depth(depth: jax.Array) -> jax.Array:
    return geometric_mean_depth(sum_depths(depth))


def test_depth_feature_is_independent_of_units(rng: np.random.Generator) -> None:
    depth = rng.uniform(0.5, 40, size=(6, 7, 1)).astype(np.float32)
    depth[0, 0] = FAR

    @jax.jit
    def feature_of(depth: jax.Array) -> jax.Array:
        return depth_feature(depth, mean_depth(depth))

    feature = np.asarray(feature_of(depth))
    middle = np.exp(np.mean(np.log(np.delete(np.asarray(depth, np.float64).ravel(), 0))))
    np.testing.assert_allclose(feature, depth / (depth + middle), rtol=1e-5)
    other = np.where(depth == FAR, np.float32(FAR), 1000 * depth)
    np.testing.assert_allclose(np.asarray(feature_of(other))[1:], feature[1:], rtol=1e-5)
    slope = jax.jit(jax.grad(lambda depth: jnp.sum(feature_of(depth))))
    for empty in (0.0, FAR):
        assert np.all(np.isfinite(slope(np.full((2, 2, 1), empty, np.float32))))
    assert not np.any(depth_feature(jnp.zeros((2, 2, 1)), 1.0))


@pytest.mark.parametrize(
    "options",
    [
        *({name: "nonsense"} for name in ("size", "motion", "preset", "alpha_at", "down", "up")),
        *({name: "nonsense"} for name in ("depth_scale", "border", "first_frame", "missing_history")),
        *({name: "nonsense"} for name in ("demodulate", "kernels", "background")),
    ],
    ids=lambda options: next(iter(options)),
)
def test_unknown_options_raise(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        ntd(**options)


def test_wrong_shapes_raise(rng: np.random.Generator, key: jax.Array) -> None:
    denoiser = tiny()
    frames = random_frames(rng)
    frame = frame_at(frames, 0)
    params = denoiser.init(key, frame)
    state = denoiser.start(params, frame)
    with pytest.raises(ValueError, match=r"frame\.radiance: expected \[H, W, C\]"):
        denoiser.step(params, state, frames)
    with pytest.raises(ValueError, match=r"frame\.albedo"):
        denoiser.step(params, state, frame._replace(albedo=frame.albedo[:8]))
