"""Render settings: one value that is checked when it is made, and that a clip's record gives back."""

import dataclasses
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxdn import effects
from jaxdn.planning.catalogue import NAMES
from jaxdn.render.settings import RenderSettings

POWERS = st.sets(st.sampled_from([1, 2, 4, 8, 64]), min_size=1)


@st.composite
def settings(draw):
    light = draw(st.sampled_from(["indirect", "reflected"]))
    flags = {name: draw(st.booleans()) for name in ("jitter", "see_through")}
    names = draw(st.sets(st.sampled_from(NAMES)))
    plan = effects.plan(effects.choose_effects(names, draw(st.integers(1, 3))), light=light, **flags)
    return RenderSettings(
        width=draw(st.integers(1, 4096)),
        height=draw(st.integers(1, 4096)),
        layers=tuple(draw(POWERS)),
        reference_spp=draw(st.sampled_from([0, 2, 3, 1024])),
        draws=draw(st.integers(0, 6)) if light == "indirect" else 0,
        light=light,
        **flags,
        variant=draw(st.sampled_from([None, "scalar_rgb"])),
        max_depth=draw(st.none() | st.integers(1, 24)),
        plan=draw(st.sampled_from([None, plan])),
        seed=draw(st.integers(0, 2**31)),
    )


@given(settings())
def test_settings_round_trip_through_a_clips_record(settings):
    record = json.loads(json.dumps({"name": "clip", "frames": 3, **settings.record()}))
    assert RenderSettings.from_record(record) == settings


@given(settings())
def test_every_setting_is_recorded_by_its_name(settings):
    assert set(settings.record()) == {field.name for field in dataclasses.fields(RenderSettings)}


@given(POWERS, st.randoms())
def test_the_order_of_layers_does_not_matter(layers, random):
    shuffled = random.sample(sorted(layers), len(layers))
    assert RenderSettings(layers=tuple(shuffled)) == RenderSettings(layers=tuple(sorted(layers)))


def test_a_record_without_a_setting_is_refused_by_name():
    record = RenderSettings().record()
    del record["jitter"], record["seed"]
    with pytest.raises(ValueError, match="these are missing: jitter, seed"):
        RenderSettings.from_record(record)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 0}, "width: expected at least 1"),
        ({"layers": (3,)}, "layers: expected different powers of two"),
        ({"layers": (1, 1)}, "layers: expected different powers of two"),
        ({"reference_spp": 1}, "reference_spp: expected 0"),
        ({"draws": -1}, "draws: expected 0 or more"),
        ({"draws": 1, "light": "reflected"}, "draws: expected 0 with light 'reflected'"),
        ({"light": "direct"}, "light: expected one of"),
        ({"max_depth": 0}, "max_depth: expected at least 1"),
    ],
)
def test_wrong_settings_cannot_be_made_or_changed_to(wrong, message):
    with pytest.raises(ValueError, match=message):
        RenderSettings(**wrong)
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(RenderSettings(), **wrong)
    with pytest.raises(dataclasses.FrozenInstanceError):
        RenderSettings().width = 0


def test_a_plan_that_was_made_for_other_settings_is_refused():
    everything = effects.choose_all_effects(2)
    still = effects.plan(dataclasses.replace(effects.choose_effects(["indirect"], 2), shared_with=(0, 0)))
    for wrong, message in (
        ({"plan": effects.plan(everything), "light": "reflected"}, "pass light='reflected'"),
        ({"plan": still, "jitter": True}, "pass jitter=True"),
        ({"plan": effects.plan(everything), "see_through": True}, "pass see_through=True"),
    ):
        with pytest.raises(ValueError, match=message):
            RenderSettings(**wrong)
