"""The ablation's presets: every run can begin, and the report says what it began with."""

import jax
import numpy as np
import pytest

from experiments.papers import ablation
from jaxdn.methods.registry import method_named
from jaxdn.zoo.weights import load_weights, starting_params


@pytest.mark.parametrize("name", ablation.PRESETS)
def test_every_run_can_begin(name: str) -> None:
    preset, method = ablation.PRESETS[name], method_named(ablation.METHOD)
    for run in preset.runs:
        recipe = preset.recipe(method, run)
        assert recipe.steps == run.steps
        assert bool(recipe.objective.reads) == (run.label == "C"), "only the occlusion loss needs buffers of its own"
        if preset.start is not None:
            denoiser = method.factory(**run.options)
            params = starting_params(preset.start, denoiser, factory=method.name, options=run.options)
            jax.tree.map(np.testing.assert_array_equal, params, load_weights(preset.start)[1])


def test_runs_differ_in_what_the_ablation_is_about() -> None:
    for preset in ablation.PRESETS.values():
        a, b, c = (run for run in preset.runs if run.label in "ABC")
        assert (a.options["motion"], b.options["motion"], c.options["motion"]) == ("traditional", "dual", "dual")
        assert a.recipe == b.recipe != c.recipe
        assert a.steps == b.steps == c.steps
