"""The renderer's reflectance, against Monte Carlo averages, white furnaces and albedos."""

import functools
import warnings

import numpy as np
import pytest

from experiments.papers import reflectance as paper
from experiments.speed.small_rooms import CASES
from jaxdn import effects
from jaxdn.render.frame import render_frame
from jaxdn.render.mitsuba.variant import choose_variant, use_variant
from jaxdn.render.open_scene import open_scene
from jaxdn.render.settings import RenderSettings

FAST = choose_variant().variant
NAMES = (
    *("diffuse", "diffuse, textured", "conductor", "roughconductor, GGX", "roughconductor, Beckmann"),
    *("roughconductor, anisotropic", "roughconductor, textured", "plastic", "roughplastic", "roughplastic, textured"),
    *("principled", "principled, textured", "principled, clearcoat", "blendbsdf", "blendbsdf, textured", "mask"),
    *("bumpmap", "normalmap", "twosided", "dielectric", "thindielectric", "roughdielectric"),
)
FIRST = {"diffuse, textured", "roughconductor, GGX", "roughplastic", "principled", "mask", "bumpmap", "dielectric"}
"""One of each kind, with the fast tests; the others with the slow ones."""
IN_TURN = [pytest.param(name, marks=[pytest.mark.slow] * (name not in FIRST)) for name in NAMES]
AVERAGED = {name for name in NAMES if "textured" in name or "anisotropic" in name or name in ("bumpmap", "normalmap")}
needs_fast = pytest.mark.needs("llvm")  # scalar_rgb takes minutes


@pytest.fixture
def fast():
    use_variant(FAST)


@pytest.fixture
def scalar():
    use_variant("scalar_rgb")
    yield
    use_variant(FAST)


def found(name):
    from jaxdn.render.buffers.gbuffer import trace_gbuffer

    there = trace_gbuffer(paper.ball(paper.materials()[name]), reflectance=True)
    assert there.reflectance is not None
    return there


@functools.cache
def measured(name):
    """Measurements of a material, which two tests look at."""
    return paper.measure(paper.materials()[name])


def test_every_material_of_the_experiment_is_tested(fast):
    assert set(NAMES) == set(paper.materials())


@needs_fast
@pytest.mark.parametrize("name", IN_TURN)
def test_reflectance_is_the_mean_of_independent_samples(fast, name):
    # Monte Carlo's own standard error at 4096 samples is about 0.003; 32 fixed samples are good to a few percent.
    result = measured(name)
    mean, worst = (0.015, 0.12) if name in AVERAGED else (0.004, 0.03)
    assert result.mean < mean
    assert result.worst < worst


@needs_fast
@pytest.mark.parametrize("name", [each for each in IN_TURN if each.values[0] != "mask"])
def test_a_white_furnace_divided_by_the_reflectance_is_white(fast, name):
    # The furnace's noise at 1024 samples is 0.01 to 0.02. Light inside rough glass is partly lost on its way out.
    most = 0.06 if name in AVERAGED or name == "roughdielectric" else 0.03
    assert measured(name).furnace < most


@pytest.mark.parametrize("name", ["diffuse", "diffuse, textured"])
def test_a_diffuse_surface_has_its_albedo_bit_for_bit(fast, name):
    there = found(name)
    np.testing.assert_array_equal(there.reflectance, there.albedo)


def test_a_diffuse_surface_has_its_albedo_in_the_slow_variant(scalar):
    there = found("diffuse, textured")
    np.testing.assert_array_equal(there.reflectance, there.albedo)


@needs_fast
@pytest.mark.parametrize("name", [each for each in IN_TURN if "roughd" not in each.values[0]])
def test_both_variants_find_the_same(name):
    # The slow one makes its tables of 256 samples.
    images = []
    for variant in (FAST, "scalar_rgb"):
        use_variant(variant)
        images.append(found(name).reflectance)
    use_variant(FAST)
    assert np.mean(np.abs(images[0] - images[1])) < 0.005


def test_it_is_a_fraction_and_1_where_nothing_is_hit(fast):
    there = found("principled, clearcoat")  # a few percent more than all light: the BSDF's own flaw
    assert 0 <= there.reflectance.min() <= there.reflectance.max() <= 1
    assert np.all(there.reflectance[there.ids[..., 0] < 0] == 1)


def test_it_does_not_depend_on_the_seed(fast, tmp_path):
    scene = open_scene(CASES["a ball: textured roughness"].write(tmp_path))
    frames = [render_frame(scene, 0, RenderSettings(width=24, height=16, seed=seed)).frame for seed in (0, 1)]
    assert not np.array_equal(frames[0].radiance, frames[1].radiance)
    np.testing.assert_array_equal(frames[0].reflectance, frames[1].reflectance)


def test_a_table_is_made_once_for_a_material_and_again_for_another(fast, monkeypatch):
    from jaxdn.render.buffers import reflectance

    made = []
    make = reflectance._make_table_at_once if FAST != "scalar_rgb" else reflectance._make_table_one_by_one
    monkeypatch.setattr(reflectance, make.__name__, lambda *args: made.append(1) or make(*args))
    monkeypatch.setattr(reflectance, "_made", {})
    base = paper.materials()["roughplastic"]
    for alpha in (0.2, 0.2, 0.2000001, 0.5):
        for _ in range(2):
            scene = paper.ball({**base, "alpha": alpha})
            reflectance.Reflectances(scene)
    assert len(made) == 3


def test_a_material_that_cannot_be_averaged_is_named_once_and_its_albedo_used(fast, monkeypatch):
    from jaxdn.render.buffers import reflectance

    monkeypatch.setattr(reflectance, "_KNOWN", frozenset())
    monkeypatch.setattr(reflectance, "_can_sample", lambda bsdf: False)
    with pytest.warns(UserWarning, match="ball: the reflectance of its material cannot be averaged"):
        there = found("roughplastic")
    np.testing.assert_array_equal(there.reflectance, there.albedo)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found("roughplastic")


def test_a_material_that_cannot_be_sampled_is_detected(fast):
    import mitsuba as mi

    from jaxdn.render.buffers.reflectance import _can_sample

    class Broken:
        def sample(self, *args):
            raise NotImplementedError

    assert not _can_sample(Broken())
    assert _can_sample(mi.load_dict({"type": "roughplastic"}))


@pytest.mark.parametrize(
    ("case", "there"),
    [("static textured box", False), ("a ball: bumpy", False), ("a ball: rough metal", True), ("a ball: mirror", True)]
    + [("a ball: metal of roughness 1", True), ("instances", True)],
)
def test_a_scene_of_diffuse_surfaces_stores_the_albedo_alone(fast, tmp_path, case, there):
    scene = CASES[case].write(tmp_path)
    plan = effects.plan(effects.inspect(scene, width=24, height=16))
    assert ("reflectance" in plan.buffers) == there
    frame = render_frame(open_scene(scene), 0, RenderSettings(width=24, height=16, plan=plan)).frame
    assert (frame.reflectance is not None) == there
    assert frame.albedo is not None
