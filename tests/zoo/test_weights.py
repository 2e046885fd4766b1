"""Weights on disk: they come back as they went, and a damaged or foreign file is told plainly."""

import json
import subprocess
import sys

import jax
import numpy as np
import pytest

import jaxdn
from jaxdn.core.frame import Frame
from jaxdn.denoisers import ntd
from jaxdn.methods.registry import method_named
from jaxdn.zoo.ready import find_model
from jaxdn.zoo.weights import describe, flatten, save_weights, shipped_names, starting_params, unflatten

TINY = ((4,), (4,), (4,), (4,), (4,))

SAVED = {"size": TINY, "kernels": "guided", "background": "pass"}
FRAME = Frame(radiance=np.ones((16, 16, 3), np.float32))


@pytest.fixture
def saved(tmp_path):
    params = ntd(size=TINY).init(jax.random.key(0), FRAME)
    path = save_weights(tmp_path / "w", params, factory="ntd", options=SAVED, record={"note": "test"})
    return path, params


def start_of(path, factory, **options):
    """The parameters that training of a method would start from."""
    denoiser = method_named(factory).factory(**options)
    return starting_params(path, denoiser, factory=factory, options=options)


def test_round_trip(saved):
    path, params = saved
    denoiser, loaded = jaxdn.load_weights(path)
    jax.tree.map(np.testing.assert_array_equal, params, loaded)
    _, image = jax.eval_shape(lambda params: denoiser.step(params, denoiser.start(params, FRAME), FRAME), loaded)
    assert image.shape == (16, 16, 3)


def test_defaults_are_recorded(tmp_path):
    """A later version may have other defaults: those of the version that wrote the weights stay with them."""
    options = {"size": TINY}
    params = ntd(**options).init(jax.random.key(0), FRAME)
    path = save_weights(tmp_path / "w", params, factory="ntd", options=options, record={})
    assert jaxdn.zoo.weights.describe(path)["options"]["kernels"] == "guided"
    assert set(jaxdn.load_weights(path)[1]) == set(params)


def test_guided_kernels_continue_from_plain_ones(tmp_path):
    """The precisions start from their initial values, here and where the kernels see more guides than before."""
    options = {"size": TINY, "kernels": "plain"}
    params = ntd(**options).init(jax.random.key(0), FRAME)
    assert "guide" not in params
    path = save_weights(tmp_path / "plain", params, factory="ntd", options=options, record={})
    with pytest.raises(ValueError, match=r"that kernels=guided needs, .* guide/albedo: .*jaxdn train --start"):
        jaxdn.load_weights(path, kernels="guided")
    guided = start_of(path, "ntd", size=TINY)
    np.testing.assert_array_equal(guided["guide"]["depth"], np.full((3, 1), 6.0))
    jax.tree.map(np.testing.assert_array_equal, {n: guided[n] for n in params}, params)
    assert set(guided) == {*params, "guide"}

    guided["guide"]["depth"] = guided["guide"]["depth"] - 1
    path = save_weights(tmp_path / "guided", guided, factory="ntd", options=SAVED, record={})
    more = start_of(path, "ntd", size=TINY, guides="materials")["guide"]
    np.testing.assert_array_equal(more["depth"], np.full((3, 1), 5.0))
    np.testing.assert_array_equal(more["reflectance"], np.full((3, 3), 3.0))


@pytest.mark.slow
def test_training_continues_from_weights_that_see_less(tmp_path, rng):
    """New guides begin with weights of zero: the first image is that of the old weights, whatever the guides show."""
    options = {"size": TINY, "kernels": "plain", "background": "filter", "demodulate": "albedo"}
    params = ntd(**options).init(jax.random.key(0), FRAME)
    path = save_weights(tmp_path / "w", params, factory="ntd", options=options, record={})
    old, more = jaxdn.load_weights(path)[0], ntd(**options, guides="materials")
    grown = start_of(path, "ntd", **options, guides="materials")
    frame = FRAME._replace(
        radiance=rng.exponential(size=(16, 16, 3)).astype(np.float32),
        albedo=rng.uniform(0.2, 1, (16, 16, 3)).astype(np.float32),
        reflectance=rng.uniform(0.2, 1, (16, 16, 3)).astype(np.float32),
        roughness=rng.uniform(size=(16, 16, 1)).astype(np.float32),
    )
    images = [
        jax.jit(denoiser.step)(weights, denoiser.start(weights, frame), frame)[1]
        for denoiser, weights in ((old, params), (more, grown))
    ]
    np.testing.assert_allclose(images[1], images[0], rtol=1e-5)
    jax.tree.map(np.testing.assert_array_equal, start_of(path, "ntd", **options), params)


@pytest.mark.parametrize(
    "options",
    [{"size": ((2,), *TINY[1:])}, {"size": (*TINY[:4], (4, 4))}, {"size": TINY, "alpha_at": "fine"}],
)
def test_weights_of_another_network_are_no_start(tmp_path, options):
    size = ((4,), (4,), (4,), (4,), (4, 4, 4))
    params = ntd(size=size).init(jax.random.key(0), FRAME)
    path = save_weights(tmp_path / "w", params, factory="ntd", options={"size": size}, record={})
    with pytest.raises(ValueError, match=r"expected a network that training can continue from, but .* is \("):
        start_of(path, "ntd", **options)


@pytest.mark.parametrize(
    ("factory", "options", "told"),
    [
        ("svgf", {}, r"sigma_normal=128\.0.* sigma_normal=16\.0"),
        ("svgf", {"preset": "paper", "alpha": 0.1}, r"alpha=0\.2.* alpha=0\.1"),
        ("asvgf", {"preset": "paper", "alpha": 0.2, "alpha_moments": 0.2}, "weights of asvgf, .* those of svgf"),
    ],
)
def test_offsets_of_other_values_are_no_start(tmp_path, factory, options, told):
    """What a filter learns is how far its options move: from other values the same numbers lead elsewhere."""
    fitted = method_named("svgf").factory(preset="paper").init(jax.random.key(0), FRAME)
    path = save_weights(tmp_path / "w", fitted, factory="svgf", options={"preset": "paper"}, record={})
    same = start_of(path, "svgf", preset="paper", antialiasing=False)
    jax.tree.map(np.testing.assert_array_equal, same, fitted)
    with pytest.raises(ValueError, match=told):
        start_of(path, factory, **options)


def test_a_run_s_weights_are_called_after_their_folder_from_anywhere(saved, tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    for ending in (".safetensors", ".json"):
        saved[0].with_suffix(ending).rename(tmp_path / "mine" / f"weights{ending}")
    monkeypatch.chdir(tmp_path / "mine")
    for name in ("weights.safetensors", "../mine/weights.safetensors", tmp_path / "mine" / "weights.safetensors"):
        assert find_model(str(name)).label == "mine"


def test_flatten_and_back():
    nested = {"a": {"b": np.ones(2), "c": {"d": np.zeros(1)}}, "e": np.arange(3.0)}
    assert set(flatten(nested)) == {"a/b", "a/c/d", "e"}
    jax.tree.map(np.testing.assert_array_equal, unflatten(flatten(nested)), nested)


def test_an_unknown_name_says_which_are_shipped():
    with pytest.raises(ValueError, match="expected one of"):
        jaxdn.load_weights("ntd-gigantic")


def test_sizes_that_no_machine_can_hold(saved):
    path, _ = saved
    described = json.loads(path.with_suffix(".json").read_text())
    described["options"]["size"] = [[4], [4], [4], [4], [10**30]]
    path.with_suffix(".json").write_text(json.dumps(described))
    with pytest.raises(ValueError, match=r"w\.json: expected sizes of layers that fit in memory"):
        jaxdn.load_weights(path)


def test_truncated_weights(saved):
    path, _ = saved
    whole = path.read_bytes()
    for cut in (0, 4, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match="whole safetensors file"):
            jaxdn.load_weights(path)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "in the same folder"),
        ("{", "in the same folder"),
        ('{"factory": "evil", "options": {}}', "'evil'"),
    ],
)
def test_bad_description(saved, content, told):
    path, _ = saved
    description = path.with_suffix(".json")
    description.unlink() if content is None else description.write_text(content)
    with pytest.raises(ValueError, match=told):
        jaxdn.load_weights(path)


def test_the_json_says_how_they_came_to_be(saved):
    assert json.loads(saved[0].with_suffix(".json").read_text())["note"] == "test"


@pytest.mark.parametrize("name", [pytest.param("ntd-large", marks=pytest.mark.slow), "ntd-small", "steady-balanced"])
def test_shipped_weights_work(name):
    assert name in shipped_names()
    denoiser, params = jaxdn.load_weights(name)
    rng = np.random.default_rng(0)
    noisy = rng.exponential(size=(32, 32, 3)).astype(np.float32)
    clip = jaxdn.Clip(Frame(radiance=np.stack([noisy, rng.permutation(noisy)])))
    image = jaxdn.denoise(denoiser, params, clip)
    # A flat grey wall under exponential noise of standard deviation 1: anything that denoises gets far below that.
    assert float(np.std(image[1])) < 0.5
    assert abs(float(np.mean(image[1])) - 1.0) < 0.25


@pytest.mark.parametrize("name", ["ntd-small", "steady-balanced"])
@pytest.mark.parametrize("size", [(72, 128), (33, 57), (1, 1)])
def test_shipped_weights_take_any_size(size, name):
    # 72 x 128 was found on a real room: the coarsest level, 5 x 8 there, was pooled once too often.
    denoiser, params = jaxdn.load_weights(name)
    frame = Frame(radiance=np.ones((*size, 3), np.float32))
    _, image = jax.eval_shape(lambda p, f: denoiser.step(p, denoiser.start(p, f), f), params, frame)
    assert image.shape == (*size, 3)


@pytest.mark.slow
def test_what_trains_is_not_imported_to_denoise():
    """Flax, which holds the weights, brings optax."""
    load = "import sys, jaxdn; jaxdn.load_weights('steady-balanced'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", load], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "jaxdn.networks.unet" in loaded
    assert not loaded & {"orbax", "grain", "matplotlib", "mitsuba"}


def test_the_best_combiner_has_the_weights_of_the_other():
    best, high = (flatten(jaxdn.load_weights(name)[1]) for name in ("combiner-best", "combiner-high"))
    jax.tree.map(np.testing.assert_array_equal, best, high)
    assert describe("combiner-best")["options"] == describe("combiner-high")["options"] | {"prefilter": True}
