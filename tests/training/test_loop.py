"""The training loop: stopped at any moment and started again, it continues as if never stopped."""

import json
import os
import re
import signal
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxdn.clips import read_clip, training_batches, write_clip
from jaxdn.denoiser.rollout import denoise
from jaxdn.denoisers import ntd
from jaxdn.methods.registry import method_named
from jaxdn.recipes.augmentation import Augmentation
from jaxdn.recipes.objectives import Objective
from jaxdn.recipes.recipe import Recipe
from jaxdn.runtime.interrupt import Stopped, Terminated
from jaxdn.runtime.locks import LOCK, lock_folder
from jaxdn.training import loop as loop
from jaxdn.training.checkpoint import Checkpoints
from jaxdn.training.log import Log, read_curve, read_log
from jaxdn.training.loop import Every, InitialWeights, fit, read_resumed_from
from jaxdn.training.step import init_state, make_train_step
from jaxdn.training.train import train
from jaxdn.training.validation import load_validation
from jaxdn.zoo.ready import find_model
from tests.training.test_training import TINY, gain, make_clip

METHOD = method_named("ntd")
PLAIN = {"prediction": "direct"}
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


def run_on(backend, clips, folder, *, source=None, checkpoint_every):
    denoiser, every = ntd(size=TINY, **PLAIN, implementation=backend), Every(1, checkpoint=checkpoint_every)
    return fit(denoiser, RECIPE, source or batches(clips), folder, label="t", every=every)


@pytest.mark.slow
def test_interrupted_training_ends_in_bit_identical_weights(clips, tmp_path):
    """By what trains fastest here; by XLA alone in :mod:`tests.training.test_training_hard`, where it is killed."""
    run = partial(run_on, METHOD.backend("training") or "reference")
    whole = run(clips, tmp_path / "whole", checkpoint_every=100)
    with pytest.raises(KeyboardInterrupt):
        run(clips, tmp_path / "stopped", source=Stopping(batches(clips), 4), checkpoint_every=2)
    assert read_curve(tmp_path / "stopped").step == [1, 2, 3]  # one batch of the four only gave the shapes
    continued = run(clips, tmp_path / "stopped", checkpoint_every=2)
    jax.tree.map(np.testing.assert_array_equal, whole.params, continued.params)
    assert read_curve(tmp_path / "whole") == read_curve(tmp_path / "stopped")


@pytest.mark.slow
def test_the_options_of_a_filter_are_fitted_and_its_weights_denoise(clips, tmp_path):
    method = method_named("svgf")
    recipe = method.recipe_named(None)._replace(steps=4, batch=2, crop=16, frames=3)
    weights = train(method, recipe, clips, tmp_path, options={"levels": 1})
    fitted = find_model(str(weights))
    assert {name: array.shape for name, array in fitted.params.items()} == {
        **dict.fromkeys(("alpha", "alpha_moments"), ()),
        **dict.fromkeys(("sigma_depth", "sigma_normal", "sigma_luminance"), (1,)),
    }
    assert 0 < float(jnp.max(jnp.abs(fitted.params["sigma_luminance"]))) < 1
    clip = read_clip(clips[0])._replace(reference=None)
    image, plain = (denoise(fitted.denoiser, params, clip) for params in (fitted.params, {}))
    assert jnp.isfinite(image).all()
    assert float(jnp.max(jnp.abs(image - plain))) > 1e-5
    before = weights.read_bytes(), weights.with_suffix(".json").read_bytes()
    with pytest.raises(ValueError, match=r"got option alpha 0.2 -> 0.5;"):  # these weights are offsets from 0.2
        train(method, recipe, clips, tmp_path, options={"levels": 1, "alpha": 0.5})
    assert before == (weights.read_bytes(), weights.with_suffix(".json").read_bytes())


def test_an_impossible_recipe_makes_no_folder(clips, tmp_path):
    method = method_named("svgf")
    with pytest.raises(ValueError, match="learning_rate"):
        train(method, method.recipe_named(None)._replace(learning_rate=-1.0), clips, tmp_path / "run", options={})
    assert not (tmp_path / "run").exists()


def test_a_folder_in_which_another_process_trains_is_refused(clips, tmp_path):
    method = method_named("svgf")
    recipe = method.recipe_named(None)._replace(steps=1, batch=2, crop=16, frames=3)
    problem = r"a folder in which no other process trains, one does; .*--out"
    with lock_folder(tmp_path, ""), pytest.raises(ValueError, match=problem):
        train(method, recipe, clips, tmp_path, options={"levels": 1})
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


def test_another_recipe_in_the_same_folder_is_refused(clips, tmp_path):
    (tmp_path / "recipe.json").write_text(json.dumps({**SHORT.record(), "learning_rate": 7.0}))
    with pytest.raises(ValueError, match=r"learning_rate 7.0 -> 0.001"):
        run_gain(clips, tmp_path)


def test_a_run_goes_on_with_the_method_and_options_it_began_with(clips, tmp_path):
    made = {"method": "gain", "options": {"sizes": (1, 2), "alpha": 0.2}}
    run_gain(clips, tmp_path, method=made)
    run_gain(clips, tmp_path, method=made, source=Stopping(batches(clips), 1))
    for other, change in (
        ({"method": "gain", "options": {"sizes": (1, 2), "alpha": 0.5}}, r"got option alpha 0.2 -> 0.5;"),
        (
            {"method": "loss", "options": {"sizes": (1, 3)}},
            "got method 'gain' -> 'loss', option alpha 0.2 -> None, opt",
        ),
    ):
        with pytest.raises(ValueError, match=change):
            run_gain(clips, tmp_path, method=other)


def test_a_run_of_before_methods_were_kept_goes_on(clips, tmp_path):
    (tmp_path / "recipe.json").write_text(json.dumps({**SHORT.record(), "start": None}))
    assert int(run_gain(clips, tmp_path, method={"method": "gain", "options": {}}).step) == SHORT.steps


def test_a_torn_log_line_is_left_out(tmp_path):
    (tmp_path / "log.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "lo')
    assert read_log(tmp_path / "log.jsonl") == [{"step": 1, "loss": 2.0}]


SQUARES = Objective("squares", lambda images, clip, progress: jnp.mean((images - clip.reference) ** 2))
SHORT = Recipe(SQUARES, steps=4, batch=2, crop=16, frames=4)


def run_gain(clips, folder, recipe=SHORT, source=None, **options):
    checkpoints = options.pop("checkpoint_every", 100)
    return fit(
        gain(),
        recipe,
        source or batches(clips),
        folder,
        label="gain",
        every=Every(2, checkpoint=checkpoints),
        **options,
    )


def test_a_finished_run_is_not_trained_again(clips, tmp_path):
    first = run_gain(clips, tmp_path)
    again = run_gain(clips, tmp_path, source=Stopping(batches(clips), 1))
    jax.tree.map(np.testing.assert_array_equal, first.params, again.params)


def test_training_begins_with_given_weights_and_refuses_others_for_the_same_run(clips, tmp_path):
    one = run_gain(clips, tmp_path / "one")
    assert float(one.params["gain"]) != 0.5, "what training would begin with else"
    # The warm-up's first update has a learning rate of zero.
    again = partial(fit, gain(), SHORT._replace(steps=1), folder=tmp_path / "two", label="t")
    state = again(batches(clips), start=InitialWeights("one", one.params))
    jax.tree.map(np.testing.assert_array_equal, state.params, one.params)
    with pytest.raises(ValueError, match="start 'one' -> 'another'"):
        again(batches(clips), start=InitialWeights("another", one.params))


def test_training_stops_at_its_time_limit_and_goes_on_from_there(clips, tmp_path, capsys):
    stopped = run_gain(clips, tmp_path / "limited", time_limit=1e-9)
    assert int(stopped.step) == 0
    assert "time is over after 0 of 4 steps" in capsys.readouterr().out
    whole, continued = run_gain(clips, tmp_path / "whole"), run_gain(clips, tmp_path / "limited")
    assert int(continued.step) == 4
    jax.tree.map(np.testing.assert_array_equal, whole.average, continued.average)


def test_an_update_varies_its_clips_as_they_were_drawn(clips):
    variation = Augmentation(shadow=0.5)
    recipe, given = SHORT._replace(variation=variation), {"batch": 2, "crop": 16, "frames": 4, "seed": 0}
    drawn = next(training_batches(clips, **given, variation=variation, vary_later=True))
    at_once = next(training_batches(clips, **given, variation=variation))
    step = make_train_step(gain(), recipe)
    losses = [float(step(init_state(gain(), recipe, batch), batch)[1].loss) for batch in (drawn, at_once, drawn.clip)]
    assert losses[0] == pytest.approx(losses[1], rel=2e-3)
    assert losses[0] != pytest.approx(losses[2], rel=0.1)


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, Stopped), (signal.SIGTERM, Terminated)])
def test_a_signal_on_a_logging_step_keeps_its_log_entry(number, error, clips, tmp_path, monkeypatch):
    before = signal.getsignal(number)  # SIGINT is ignored in a process that a shell put into the background
    whole = run_gain(clips, tmp_path / "whole")
    write = Log.write

    def interrupted(log, **entry):
        if entry["step"] == 2:
            signal.raise_signal(number)
        write(log, **entry)

    monkeypatch.setattr(Log, "write", interrupted)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_gain(clips, tmp_path / "stopped")
    assert stopped.type is error
    assert read_curve(tmp_path / "stopped").step == [2]
    monkeypatch.undo()
    continued = run_gain(clips, tmp_path / "stopped")
    assert read_curve(tmp_path / "stopped") == read_curve(tmp_path / "whole")
    np.testing.assert_array_equal(continued.params["gain"], whole.params["gain"])
    assert signal.getsignal(number) is before


def test_a_second_ctrl_c_stops_at_once_and_the_run_still_ends_the_same(clips, tmp_path, monkeypatch):
    whole = run_gain(clips, tmp_path / "whole")
    make = loop.make_train_step

    def interrupting(*arguments):
        step = make(*arguments)

        def twice(state, batch):
            given = int(state.step)
            found = step(state, batch)  # the old state's memory is gone from here on
            if given == 2:
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGINT)
            return found

        return twice

    monkeypatch.setattr(loop, "make_train_step", interrupting)
    with pytest.raises(KeyboardInterrupt):
        run_gain(clips, tmp_path / "stopped", checkpoint_every=1)
    monkeypatch.undo()
    continued = run_gain(clips, tmp_path / "stopped")
    assert read_curve(tmp_path / "stopped") == read_curve(tmp_path / "whole")
    np.testing.assert_array_equal(continued.params["gain"], whole.params["gain"])


def test_a_finished_run_goes_on_with_more_steps_and_says_so(clips, tmp_path, capsys):
    first = run_gain(clips, tmp_path)
    assert read_resumed_from(tmp_path) == []
    longer = run_gain(clips, tmp_path, SHORT._replace(steps=8))
    assert "begun with 4 steps, goes on to 8" in capsys.readouterr().out
    assert int(longer.step) == 8
    assert read_curve(tmp_path).step == [2, 4, 6, 8]
    assert read_resumed_from(tmp_path) == [4]
    assert float(longer.params["gain"]) != float(first.params["gain"])
    run_gain(clips, tmp_path, SHORT._replace(steps=8))
    assert read_resumed_from(tmp_path) == [4]
    for other in (SHORT, SHORT._replace(steps=9, learning_rate=0.5)):
        with pytest.raises(ValueError, match="steps 8 -> "):
            run_gain(clips, tmp_path, other)
    assert read_resumed_from(tmp_path) == [4]


def test_a_run_whose_checkpoints_are_of_another_network_is_not_made_longer(clips, tmp_path, monkeypatch):
    run_gain(clips, tmp_path, SHORT._replace(steps=1))
    before = (tmp_path / "recipe.json").read_text()

    def misfit(*_):
        raise ValueError("other shapes")

    monkeypatch.setattr(Checkpoints, "_read", misfit)
    with pytest.raises(ValueError, match="expected the parameters of this network"):
        run_gain(clips, tmp_path, SHORT._replace(steps=2))
    assert (tmp_path / "recipe.json").read_text() == before


def test_the_validation_reaches_the_terminal(clips, tmp_path, capsys):
    run_gain(clips, tmp_path, validation=load_validation(gain(), [clips[0]]))
    psnr = read_curve(tmp_path).validation_psnr[-1]
    assert f"validation {psnr:.2f} dB" in capsys.readouterr().out


class Late:
    """Batches that each come so many seconds late."""

    def __init__(self, source, seconds):
        self.source, self.seconds = source, seconds
        self.get_state, self.set_state = source.get_state, source.set_state

    def __next__(self):
        time.sleep(self.seconds)
        return next(self.source)


@pytest.mark.parametrize(("seconds", "late", "least", "most"), [(0.0, 0.2, 60, 100), (0.1, 0.05, 0, 30)])
def test_the_terminal_says_how_long_training_waits_for_its_input(seconds, late, least, most, clips, tmp_path, capsys):
    """Every batch comes late; while an update takes longer, nobody waits."""
    every, recipe = Every(5, checkpoint=100), SHORT._replace(steps=10)
    fit(gain(seconds), recipe, Late(batches(clips), late), tmp_path, label="gain", every=every)
    (share,) = re.findall(r"step 10/10 .* waiting for input (\d+) %", capsys.readouterr().out)
    assert least <= int(share) <= most


def test_training_without_a_step_is_refused_before_anything_is_written(clips, tmp_path):
    with pytest.raises(ValueError, match=r"steps: expected a whole number >= 1, got 0"):
        run_gain(clips, tmp_path / "run", SHORT._replace(steps=0))
    assert not (tmp_path / "run").exists()
