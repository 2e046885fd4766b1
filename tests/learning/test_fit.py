"""The training loop: stopped at any moment and started again, it continues as if never stopped."""

import json
from functools import partial

import jax
import numpy as np
import pytest

from jaxdn.clips import training_batches, write_clip
from jaxdn.commands.fit import Start, fit
from jaxdn.commands.log import read_curve, read_log
from jaxdn.denoisers import ntd
from jaxdn.methods.table import method_named
from tests.learning.test_training import TINY, make_clip

pytestmark = pytest.mark.usefixtures("plain_programs")

METHOD = method_named("ntd")
PLAIN = {"kernels": "plain", "background": "filter"}
"""Compiles sooner, and the loop is the same."""
RECIPE = METHOD.recipe_named(None)._replace(steps=6, batch=2, crop=16, frames=4)


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    for seed in range(3):
        write_clip(make_clip(seed, size=20, frames=5), folder / f"clip-{seed}")
    return sorted(folder.iterdir())


def batches(clips):
    return training_batches(clips, batch=2, crop=16, frames=4, seed=0)


class Stopping:
    """Batches that end in Ctrl-C after so many."""

    def __init__(self, source, after):
        self.source, self.left = source, after

    def __next__(self):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        return next(self.source)

    def get_state(self):
        return self.source.get_state()

    def set_state(self, state):
        self.source.set_state(state)


def run_on(engine, clips, folder, **options):
    denoiser, source = ntd(size=TINY, **PLAIN, implementation=engine), options.pop("source", batches(clips))
    return fit(denoiser, RECIPE, source, folder, label="t", log_every=1, **options)


run = partial(run_on, None)


@pytest.mark.slow
@pytest.mark.parametrize("engine", dict.fromkeys(("reference", METHOD.engine("training") or "reference")))
def test_interrupted_training_ends_in_bit_identical_weights(engine, clips, tmp_path):
    run = partial(run_on, engine)
    whole = run(clips, tmp_path / "whole", checkpoint_every=100)
    with pytest.raises(KeyboardInterrupt):
        run(clips, tmp_path / "stopped", source=Stopping(batches(clips), 4), checkpoint_every=2)
    assert read_curve(tmp_path / "stopped").step == [1, 2, 3]  # one batch of the four only gave the shapes
    continued = run(clips, tmp_path / "stopped", checkpoint_every=2)
    jax.tree.map(np.testing.assert_array_equal, whole.params, continued.params)
    assert read_curve(tmp_path / "whole") == read_curve(tmp_path / "stopped")


@pytest.mark.slow
def test_a_finished_run_is_not_trained_again(clips, tmp_path):
    first = run(clips, tmp_path)
    again = run(clips, tmp_path, source=Stopping(batches(clips), 1))
    jax.tree.map(np.testing.assert_array_equal, first.params, again.params)


def test_another_recipe_in_the_same_folder_is_refused(clips, tmp_path):
    (tmp_path / "recipe.json").write_text(json.dumps({**RECIPE.record(), "learning_rate": 7.0}))
    with pytest.raises(ValueError, match=r"learning_rate 7.0 -> 0.001"):
        run(clips, tmp_path)


def test_a_torn_log_line_is_left_out(tmp_path):
    (tmp_path / "log.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "lo')
    assert read_log(tmp_path / "log.jsonl") == [{"step": 1, "loss": 2.0}]


@pytest.mark.slow
def test_training_begins_with_given_weights_and_refuses_others_for_the_same_run(clips, tmp_path):
    one = run(clips, tmp_path / "one")
    # The warm-up's first update has a learning rate of zero.
    short = RECIPE._replace(steps=1)
    again = partial(fit, ntd(size=TINY, **PLAIN), short, folder=tmp_path / "two", label="t")
    state = again(batches(clips), start=Start("one", one.params))
    jax.tree.map(np.testing.assert_array_equal, state.params, one.params)
    with pytest.raises(ValueError, match="start 'one' -> 'another'"):
        again(batches(clips), start=Start("another", one.params))


@pytest.mark.slow
def test_training_stops_at_its_time_limit_and_goes_on_from_there(clips, tmp_path, capsys):
    stopped = run(clips, tmp_path / "limited", time_limit=1e-9)
    assert int(stopped.step) == 0
    assert "time is over after 0 of 6 steps" in capsys.readouterr().out
    whole, continued = run(clips, tmp_path / "whole"), run(clips, tmp_path / "limited")
    assert int(continued.step) == 6
    jax.tree.map(np.testing.assert_array_equal, whole.average, continued.average)
