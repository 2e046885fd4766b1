"""The table of methods and their options: what a factory accepts, refuses and documents."""

import dataclasses
import importlib
import inspect
import types
from dataclasses import dataclass
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxdn
from jaxdn.core.frame import Frame
from jaxdn.core.options import Range, describe, make, parse
from jaxdn.denoiser import Core, Denoiser, recurrent
from jaxdn.methods import registry
from jaxdn.methods.ntd import PAPER, Options
from jaxdn.methods.registry import method, method_named, methods
from jaxdn.networks.backends import BACKENDS, Backend
from jaxdn.ops.onednn import library
from jaxdn.recipes.objectives import indirect_illumination
from jaxdn.recipes.recipe import Recipe
from jaxdn.sequence.run import select_backend
from jaxdn.zoo.weights import save_weights
from tests.methods.test_ntd import TINY
from tests.needs import require


@dataclass(frozen=True)
class Toys:
    """One option of every kind."""

    share: Annotated[float, Range(0, 1, without_low=True)] = 0.5
    count: Annotated[int, Range(1)] = 3
    way: Literal["up", "down"] = "up"
    again: bool = False
    widths: tuple[tuple[int, ...], ...] = ((1,), (2, 3))
    precision: Literal["float32", "bfloat16"] | None = None
    either: Literal["small"] | tuple[int, ...] = "small"


# Accepted and refused values.


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("share", value) for value in (0.0, -0.1, 1.001, "0.5", True, None, float("nan"), float("inf"), [0.5])),
        *(("count", value) for value in (0, -1, 1.0, 2.5, True, "3", None)),
        *(("way", value) for value in ("left", "Up", 0, None, True, ["up"])),
        *(("again", value) for value in (0, 1, "False", None)),
        *(("widths", value) for value in ((), ((),), (1, 2), ((1.5,),), "large", None, ((True,),))),
        *(("precision", value) for value in ("float16", 32, False)),
        *(("either", value) for value in ("large", (), 3, None, ("small",))),
    ],
)
def test_a_value_that_an_option_cannot_have_raises(name, value):
    with pytest.raises(ValueError, match=rf"^toy {name}: expected .*, got "):
        make(Toys, {name: value}, method="toy")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("share", value) for value in (1e-9, 0.5, 1, 1.0)),
        *(("count", value) for value in (1, 10**6)),
        *(("way", value) for value in ("up", "down")),
        *(("again", value) for value in (True, False)),
        *(("widths", value) for value in (((4,),), ((1, 2), (3,)))),
        *(("precision", value) for value in (None, "float32", "bfloat16")),
        *(("either", value) for value in ("small", (3,), (1, 2))),
    ],
)
def test_a_value_that_an_option_can_have_is_kept(name, value):
    made = make(Toys, {name: value}, method="toy")
    assert getattr(made, name) == value
    assert dataclasses.replace(made, **{name: getattr(Toys(), name)}) == Toys()


def test_an_unknown_option_says_which_there_are():
    with pytest.raises(ValueError, match=r"^toy: expected options out of share, count, way, .*, got 'shade', 'x'\.$"):
        make(Toys, {"shade": 1, "count": 2, "x": 3}, method="toy")


def test_lists_of_json_become_tuples():
    made = make(Toys, {"widths": [[1], [2, 3]], "either": [4, 5]}, method="toy")
    assert made.widths == ((1,), (2, 3))
    assert made.either == (4, 5)
    hash(made)


def test_values_take_the_place_of_those_of_the_base():
    base = Toys(share=0.25, way="down")
    made = make(Toys, {"way": "up", "count": 7}, method="toy", base=base)
    assert made == Toys(share=0.25, way="up", count=7)
    assert base == Toys(share=0.25, way="down")


def test_what_is_out_of_range_says_the_range():
    with pytest.raises(ValueError, match=r"share: expected a number in \(0, 1\], got 2"):
        make(Toys, {"share": 2}, method="toy")
    with pytest.raises(ValueError, match=r"count: expected a whole number >= 1, got 0"):
        make(Toys, {"count": 0}, method="toy")
    with pytest.raises(ValueError, match=r"way: expected one of 'up', 'down', got 'left'"):
        make(Toys, {"way": "left"}, method="toy")


def test_command_line_words_become_values():
    words = ["size=small", "levels=3", "alpha=0.25", "occlusion=false", "truncate=True", "widths=[[1], [2]]"]
    found = parse([*words, "compute_dtype=null", "preset=None", "a=b=c", 'name="3"', "empty="])
    assert found == {
        **{"size": "small", "levels": 3, "alpha": 0.25, "occlusion": False, "truncate": True},
        **{"widths": [[1], [2]], "compute_dtype": None, "preset": None, "a": "b=c", "name": "3", "empty": ""},
    }
    assert parse([]) == {}
    for wrong in ("size", "=small", ""):
        with pytest.raises(ValueError, match=r"--channels '.*': expected name=value"):
            parse([wrong], option="--channels")


# The factories.


def built(monkeypatch, factory_of_ntd):
    """The options that a factory builds from its arguments."""
    seen = []
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))

    @method(Options, title="A spy", presets={"paper": PAPER})
    def spy(options):
        seen.append(options)
        return recurrent(Core(lambda p, f: 0, lambda p, s, f, first, statistics: (s, f.radiance, 0), frozenset()))

    factory_of_ntd(spy)
    return seen[-1]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, Options()),
        ({"preset": None}, Options()),
        ({"preset": "paper"}, PAPER),
        ({"preset": "paper", "down": "mean"}, dataclasses.replace(PAPER, down="mean")),
        ({"preset": "paper", "demodulate": "albedo"}, dataclasses.replace(PAPER, demodulate="albedo")),
        ({"size": [[4], [4]], "down": "max"}, Options(size=((4,), (4,)), down="max")),
    ],
)
def test_presets_are_what_the_given_options_override(given, expected, monkeypatch):
    assert built(monkeypatch, lambda factory: factory(**given)) == expected


@pytest.mark.slow
def test_ntds_own_preset_is_that_of_the_paper(rng):
    """Not the spy's: with the options of PAPER written out it computes the same, and with others it does not."""
    frame = Frame(jnp.asarray(rng.exponential(size=(16, 16, 3)), jnp.float32), depth=jnp.full((16, 16, 1), 4.0))
    names = ("down", "depth_scale", "border", "first_frame", "missing_history")
    names += ("kernels", "background", "exposure", "initialization", "demodulate")
    written = {name: getattr(PAPER, name) for name in names}
    assert dataclasses.replace(Options(), **written) == PAPER
    ntd = jaxdn.denoisers.ntd
    images = []
    for options in ({"preset": "paper"}, written, {**written, "down": "mean"}, {"preset": "paper", "down": "mean"}):
        denoiser = ntd(size=TINY, **options)
        params = denoiser.init(jax.random.key(0), frame)
        images.append(np.asarray(jax.jit(denoiser.step)(params, denoiser.start(params, frame), frame)[1]))
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_array_equal(images[2], images[3])
    assert np.abs(images[0] - images[2]).max() > 1e-4
    with pytest.raises(ValueError, match="ntd preset: expected one of paper, got 'parity'"):
        ntd(preset="parity")


def test_a_method_without_presets_has_no_such_option(toy):
    with pytest.raises(ValueError, match=r"toy: expected options out of .*'preset'"):
        toy(preset="paper")


@pytest.mark.parametrize("row", methods().values(), ids=lambda row: row.name)
def test_a_factory_lists_its_options_and_takes_nothing_by_position(row):
    signature = inspect.signature(row.factory)
    fields = {field.name: field.default for field in dataclasses.fields(row.options)}
    expected = fields | ({"preset": None} if row.presets else {})
    assert {name: parameter.default for name, parameter in signature.parameters.items()} == expected
    assert {parameter.kind for parameter in signature.parameters.values()} <= {inspect.Parameter.KEYWORD_ONLY}
    assert signature.return_annotation is Denoiser
    document = inspect.getdoc(row.factory)
    for name in expected:
        assert f"* ``{name}``: " in document, name
    assert describe(row.options) in document
    assert row.factory.__name__ == row.name
    with pytest.raises(TypeError):
        row.factory("large")


@pytest.mark.parametrize("row", methods().values(), ids=lambda row: row.name)
def test_every_default_preset_and_variant_is_one_that_its_factory_takes(row):
    assert isinstance(row.factory(), Denoiser)
    for name in row.presets:
        assert isinstance(row.presets[name], row.options)
        assert isinstance(row.factory(preset=name), Denoiser)
    for options in row.variants.values():
        assert isinstance(row.factory(**options), Denoiser)
    for field in dataclasses.fields(row.options):
        default = getattr(row.options(), field.name)
        assert make(row.options, {field.name: default}, method=row.name) == row.options()


# The table.


def test_the_table_finds_the_methods_of_its_package():
    found = methods()
    assert {"ntd", "svgf"} <= set(found)
    assert list(found) == sorted(found)
    assert all(row.name == name and row.title for name, row in found.items())
    assert {name for name, row in found.items() if row.filter} >= {"svgf", "asvgf", "taa"}
    assert {name for name, row in found.items() if row.learns} >= {"ntd", "steady", "svgf", "asvgf"}
    assert not found["ntd"].filter
    assert not found["taa"].learns
    assert found["ntd"].has_option("implementation")
    assert not found["svgf"].has_option("implementation")


def test_factories_and_modules_do_not_shadow_one_another():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("jaxdn.denoisers.ntd")
    import jaxdn.methods.ntd as room
    from jaxdn.denoisers import ntd

    assert callable(ntd)
    assert ntd is method_named("ntd").factory
    assert isinstance(room, types.ModuleType)
    assert room.ntd is ntd
    assert jaxdn.denoisers.ntd is ntd
    assert set(jaxdn.denoisers.NAMES) == set(methods())
    assert {*methods(), "demodulated"} <= set(dir(jaxdn.denoisers))
    with pytest.raises(AttributeError, match="svgf"):
        jaxdn.denoisers.ntx  # noqa: B018


def test_an_unknown_name_says_which_there_are():
    ntd, svgf = method_named("ntd"), method_named("svgf")
    with pytest.raises(ValueError, match=r"method 'magic': expected one of .*ntd.*svgf"):
        method_named("magic")
    with pytest.raises(ValueError, match=r"ntd: expected a recipe out of usual, .*, got 'wild'"):
        ntd.recipe_named("wild")
    with pytest.raises(ValueError, match=r"ntd: expected a variant out of ntd-large, ntd-small, got 'ntd-huge'"):
        ntd.variant_named("ntd-huge")
    with pytest.raises(ValueError, match="taa: expected a method that learns"):
        methods()["taa"].recipe_named(None)
    assert svgf.variant_named(None) == {}
    assert ntd.variant_named(None) == ntd.variants["ntd-small"]  # the fastest
    assert ntd.recipe_named(None) is ntd.recipes["usual"]


def backends(monkeypatch, **available):
    """Only these backends are available."""
    for name in BACKENDS:
        there = available.get(name, False)
        monkeypatch.setitem(BACKENDS, name, Backend(name, BACKENDS[name].purpose, lambda there=there: there))


@pytest.mark.parametrize(("purpose", "expected"), [("inference", "onnxruntime"), ("training", "onednn")])
def test_the_backend_is_the_fastest_for_the_purpose(purpose, expected, monkeypatch):
    ntd, svgf = method_named("ntd"), method_named("svgf")
    backends(monkeypatch, onnxruntime=True, onednn=True)
    assert ntd.backend(purpose) == expected
    assert svgf.backend(purpose) is None
    backends(monkeypatch, **{"onednn-bfloat16": True, "onnxruntime": True, "onednn": True})
    assert ntd.backend(purpose) == ("onednn-bfloat16" if expected == "onnxruntime" else expected)
    backends(monkeypatch, **{"onednn-float32": True, "onnxruntime": True, "onednn": True})
    assert ntd.backend(purpose) == ("onednn-float32" if expected == "onnxruntime" else expected)
    backends(monkeypatch)
    assert ntd.backend(purpose) is None


def test_a_backend_that_is_slower_here_is_used_on_request_alone(monkeypatch):
    for faster in (True, False):
        monkeypatch.setitem(
            BACKENDS, "onednn", Backend("onednn", "training", lambda: True, lambda faster=faster: faster)
        )
        assert method_named("ntd").backend("training") == ("onednn" if faster else None)


@pytest.mark.parametrize(("isa", "faster"), [(0x7, False), (0x1F, False), (0x27, True), (0xFEF, True)])
def test_onednn_trains_faster_with_avx512(isa, faster, monkeypatch):
    """AVX2, AVX2 with VNNI, AVX-512, AMX, as the library numbers them."""
    monkeypatch.setattr(library, "available", lambda: True)
    fake = types.SimpleNamespace(dnnl_get_effective_cpu_isa=lambda: isa)
    monkeypatch.setattr(library, "library", lambda: fake)
    assert library.training_is_faster() == faster
    assert BACKENDS["onednn"].faster() == faster


# A method from outside the package.


@dataclass(frozen=True)
class Gains:
    """Two numbers."""

    gain: Annotated[float, Range(0)] = 1.0


@pytest.fixture
def toy(monkeypatch):
    """A learned method that has neither a network nor backends, in the table for one test."""
    monkeypatch.setattr(registry, "_METHODS", dict(registry._METHODS))

    @method(Gains, title="A toy", recipes={"usual": Recipe(indirect_illumination())})
    def toy(options):
        """Radiance times a learned number."""

        def step(params, state, frame, first, statistics):
            return state, params["gain"] * frame.radiance, 0

        def init(key, frame):
            return {"gain": jnp.full((3,), options.gain)[None, None, :]}

        return recurrent(Core(lambda params, frame: jnp.zeros(()), step, frozenset(), init))

    return toy


def test_a_registered_method_is_found_everywhere(toy):
    row = method_named("toy")
    assert row.learns
    assert row.factory is toy
    assert jaxdn.denoisers.toy is toy
    assert "toy" in jaxdn.denoisers.NAMES
    assert toy.__doc__.startswith("Radiance times a learned number.")
    assert row.backend("inference") is None
    assert row.variant_named(None) == {}


def test_a_custom_learned_method_can_denoise(toy, tmp_path, monkeypatch, rng):
    """Where ONNX Runtime is installed, `jaxdn denoise` must not pass it to a method without this option."""
    backends(monkeypatch, onnxruntime=True, onednn=True)
    frame = Frame(jnp.asarray(rng.exponential(size=(4, 5, 3)), jnp.float32))
    params = {"gain": jnp.asarray([[[0.5, 1.0, 2.0]]], jnp.float32)}
    path = save_weights(tmp_path / "run" / "weights", params, factory="toy", options={"gain": 0.25}, record={})
    for implementation in ("auto", "reference"):
        found, backend = select_backend(str(path), implementation)
        assert backend == "reference"
        assert (found.label, found.method.name, dict(found.options)) == ("run", "toy", {"gain": 0.25})
        _, image = found.denoiser.step(found.params, found.denoiser.start(found.params, frame), frame)
        np.testing.assert_allclose(image, frame.radiance * params["gain"], rtol=1e-6)
    with pytest.raises(ValueError, match="which has no choice, got 'onnxruntime'"):
        select_backend(str(path), "onnxruntime")


def test_a_learned_method_needs_weights(toy):
    with pytest.raises(ValueError, match="method 'toy': expected its weights"):
        select_backend("toy")


@pytest.mark.parametrize(("installed", "backend"), [(True, "onnxruntime"), (False, "reference")])
def test_weights_of_a_network_run_on_the_available_backend(installed, backend, monkeypatch, tmp_path):
    if installed:
        require("onnxruntime")
    backends(monkeypatch, onnxruntime=installed, onednn=True)
    denoiser = jaxdn.denoisers.ntd(size=TINY, kernels="plain")
    params = denoiser.init(jax.random.key(0), Frame(jnp.ones((16, 16, 3))))
    options = {"size": TINY, "kernels": "plain"}
    path = save_weights(tmp_path / "tiny", params, factory="ntd", options=options, record={})
    found, taken = select_backend(str(path))
    assert taken == backend
    assert found.options.get("implementation") == (backend if installed else None)


def test_layer_names_are_always_strings():
    assert parse(["albedo=3", "ids=null", "depth=[1]"], option="--channels", words=True) == {
        "albedo": "3",
        "ids": "null",
        "depth": "[1]",
    }
    with pytest.raises(ValueError, match="--channels 'albedo'"):
        parse(["albedo"], option="--channels", words=True)
