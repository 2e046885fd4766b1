"""Training under faults: invalid clips, a diverging learning rate, a truncated checkpoint, a killed process."""

import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.stability import kills
from jaxdn.core.frame import RADIANCE_MAX
from jaxdn.denoiser import Denoiser
from jaxdn.denoiser.sanitize import sanitize_image
from jaxdn.training.checkpoint import Checkpoints
from jaxdn.training.log import Log, read_curve
from jaxdn.training.loop import Every, fit
from jaxdn.training.step import clip_loss, init_state
from tests.training import test_loop
from tests.training.test_checkpoint import torn
from tests.training.test_training import make_clip

clips = test_loop.clips


def test_a_reference_is_bounded_like_the_denoised_image():
    bad = jnp.asarray([np.nan, np.inf, -np.inf, -1.0, 1e30, 0.25], jnp.float32)
    safe = sanitize_image(bad)
    np.testing.assert_array_equal(safe, [0, 0, 0, 0, RADIANCE_MAX, 0.25])
    clip = make_clip(0)
    reference = clip.reference.copy()
    reference.reshape(-1)[: bad.size] = bad
    mended = clip._replace(reference=np.asarray(sanitize_image(reference)))
    params, objective = {"gain": jnp.full((), 0.1)}, test_loop.RECIPE.objective
    losses = [
        clip_loss(brighter(), params, each, objective)[0] for each in (clip._replace(reference=reference), mended)
    ]
    assert np.isfinite(losses[0])
    assert losses[0] == losses[1]


def brighter():
    """A denoiser with one weight, which compiles quickly: radiance times 1 + gain^2."""

    def step(params, state, frame):
        return state + 1, frame.radiance * (1 + params["gain"] ** 2)

    def start(params, frame):
        return jnp.zeros((), jnp.int32)

    return Denoiser(lambda key, frame: {"gain": jnp.full((), 0.1)}, start, step, frozenset({"radiance"}))


def run(clips, folder, recipe=test_loop.RECIPE, source=None, every=2):
    batches = test_loop.batches(clips) if source is None else source
    return fit(brighter(), recipe, batches, folder, label="t", every=Every(1, checkpoint=every))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # 1e39 is infinite in single precision
@pytest.mark.parametrize(("rate", "kept"), [(1e30, 1), (1e39, 0)])
def test_a_diverging_learning_rate_ends_with_advice_and_finite_weights(clips, tmp_path, rate, kept):
    recipe = test_loop.RECIPE._replace(learning_rate=rate, decay=False)
    told = rf"nothing was learned in the updates {kept + 1} to {kept + 3}.*learning rate"
    with pytest.raises(ValueError, match=told):
        run(clips, tmp_path, recipe, every=1)
    with pytest.raises(ValueError, match="learning rate"):  # a restart does not continue either
        run(clips, tmp_path, recipe, every=1)
    kept_state, _ = Checkpoints(tmp_path / "checkpoints").restore(
        init_state(brighter(), recipe, next(test_loop.batches(clips)))
    )
    assert np.isfinite(kept_state.params["gain"])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("learning_rate", value) for value in (np.inf, np.nan, 0.0, -1e-3, "fast")),
        *((name, value) for name in ("steps", "batch", "crop", "frames") for value in (0, -1, 2.5)),
        *(("clip_norm", value) for value in (-1.0, np.inf)),
        ("seed", -1),
        ("decay", 1),
    ],
)
def test_an_impossible_recipe_is_refused_by_name_before_anything_is_written(clips, tmp_path, name, value):
    with pytest.raises(ValueError, match=rf"^recipe {name}: expected .*, got "):
        run(clips, tmp_path, test_loop.RECIPE._replace(**{name: value}))
    assert not list(tmp_path.iterdir())


def test_a_log_is_strict_json_whatever_the_loss(tmp_path):
    log = Log(tmp_path / "log.jsonl", keep_until=0)
    log.write(step=1, loss=float("nan"))
    log.write(step=2, loss=0.5)
    log.close()
    for line in (tmp_path / "log.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=pytest.fail)
    np.testing.assert_array_equal(read_curve(tmp_path).loss, [np.nan, 0.5])


@pytest.mark.slow
def test_with_the_newest_checkpoint_truncated_it_continues_from_the_previous_one_to_the_same_weights(clips, tmp_path):
    whole = run(clips, tmp_path / "whole", every=100)
    stopping = test_loop.Stopping(test_loop.batches(clips), 5)
    with pytest.raises(KeyboardInterrupt):
        run(clips, tmp_path / "stopped", source=stopping)
    (tmp_path / "stopped" / "checkpoints").rename(tmp_path / "kept")
    torn(tmp_path / "kept", tmp_path / "stopped" / "checkpoints", 4)
    with pytest.warns(UserWarning, match="continues from the checkpoint after 2 updates"):
        continued = run(clips, tmp_path / "stopped")
    jax.tree.map(np.testing.assert_array_equal, whole.params, continued.params)
    assert read_curve(tmp_path / "whole") == read_curve(tmp_path / "stopped")


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_a_killed_process_loses_only_the_steps_since_its_last_checkpoint(tmp_path):
    kills.make_clips(tmp_path / "clips")
    sizes = kills.Sizes(steps=100, checkpoint_every=5)
    kills.start(tmp_path / "clips", tmp_path / "calm", sizes).communicate()
    process = kills.start(tmp_path / "clips", tmp_path / "shot", sizes)
    until = time.monotonic() + 300
    while kills.logged(tmp_path / "shot") < 23 and process.poll() is None and time.monotonic() < until:
        time.sleep(0.002)
    process.kill()
    process.communicate()
    seen, kept = kills.logged(tmp_path / "shot"), kills.newest(tmp_path / "shot")
    assert 23 <= seen < 100
    assert seen - kept <= 2 * sizes.checkpoint_every  # one may not have been complete yet
    said, _ = kills.start(tmp_path / "clips", tmp_path / "shot", sizes).communicate()
    assert kills.same(tmp_path / "calm", tmp_path / "shot"), said
