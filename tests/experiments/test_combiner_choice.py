"""The second network of combiner, trained alone on clips of Cycles."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.cycles import combiner_choice
from experiments.cycles.combiner_choice import (
    RATE,
    WARM_UP,
    Options,
    Sequence,
    collect,
    draw,
    fetch_result,
    find_errors,
    find_rate,
    main,
    make_results,
    square,
)
from experiments.cycles.record import RECORD, read_record
from jaxdn.core.frame import Frame
from jaxdn.denoisers import combiner
from jaxdn.methods.combiner.candidates import CANDIDATES
from jaxdn.methods.combiner.choice import INITIAL_LOGITS
from jaxdn.methods.combiner.history import Past, fetch_past, keep_history, measure_now
from jaxdn.methods.combiner.method import Options as Settings
from jaxdn.methods.combiner.method import build_candidate_step
from jaxdn.zoo.weights import load_weights
from tests.experiments.test_cycles_training import write_cycles_clip
from tests.needs import require

START = Path(combiner_choice.__file__).parents[2] / "jaxdn/zoo/shipped/combiner-high.safetensors"


def test_the_mean_square_has_none_of_the_references_noise(rng: np.random.Generator) -> None:
    truth, image = rng.uniform(0.2, 0.8, (2, 3, 200, 200))
    halves = truth / (1 + truth) + rng.normal(0, 0.1, (2, *truth.shape))
    targets = np.stack([halves.mean(axis=0), *halves])
    found = square(find_errors(jnp.asarray(image), {"targets": jnp.asarray(targets)}))
    expected = np.mean((image / (1 + image) - truth / (1 + truth)) ** 2)
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_a_draw_is_two_neighbours_that_are_turned_alike(rng: np.random.Generator) -> None:
    """Each pixel of the light tells its place, its channel and its frame."""
    place = np.arange(3 * 4 * 8, dtype=np.float32).reshape(3, 4, 8)
    light = np.stack([place + 1000 * frame for frame in range(5)])
    stored = {"light": light[:, None], "targets": light[:, None], "number": light[:, 0], "gain": np.ones(5)}
    seen = set()
    for _ in range(40):
        first, second = draw({"one": dict.fromkeys((1, 4, 16), Sequence(stored, []))}, rng)
        np.testing.assert_array_equal(second["light"] - first["light"], 1000)
        np.testing.assert_array_equal(first["light"], first["targets"])
        assert set(first["light"].ravel() % 1000) == set(place.ravel())
        channel = int(np.argwhere(first["light"][0, :, 0, 0] % 1000 < 32)[0, 0])
        np.testing.assert_array_equal(first["light"][0, channel], first["number"])
        seen.add(tuple(first["light"][0, :, 0, 0] % 1000))
    assert len(seen) > 8


def draw_frame(rng: np.random.Generator) -> Frame:
    """On two planes, of which the nearer one is in the middle; all moves by parts of a pixel."""
    depth = np.full((24, 32, 1), 5.0, np.float32)
    depth[8:16, 8:20] = 2.0
    motion = np.broadcast_to(np.float32([1.5, -0.25]), (24, 32, 2))
    frame = Frame(rng.exponential(size=(24, 32, 3)).astype(np.float32), depth=depth, motion=motion)
    return jax.tree.map(jnp.asarray, frame)


@pytest.mark.slow
def test_the_last_result_is_fetched_as_the_denoiser_does_it(rng: np.random.Generator) -> None:
    then, now, gain = draw_frame(rng), draw_frame(rng), jnp.float32(0.7)
    result, prior = jnp.asarray(rng.exponential(size=(2, 3, 24, 32)), jnp.float32)

    @jax.jit
    def fetch() -> tuple[Past, jax.Array]:
        kept = keep_history(then, measure_now(then, prior), result)
        past = fetch_past(kept, now, measure_now(now, prior), jnp.asarray(False))
        return past, fetch_result(result, then, now, jnp.log1p(gain * prior), gain)

    past, found = fetch()
    assert 0.5 < np.mean(past.valid) < 1.0
    np.testing.assert_allclose(jnp.expm1(found) / gain, past.result, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("trusted", "expected"), [("prior", [0, 0, 1, 2]), ("last result", [0, 0, 0, 0])])
def test_results_are_made_in_the_order_of_frames(rng: np.random.Generator, trusted: str, expected: list[int]) -> None:
    """Nothing moves: the last result of a frame is the prior of the frame before, or for ever the first one."""
    require("pyoidn")
    params = combiner().init(jax.random.key(0), Frame(jnp.zeros((16, 16, 3))))["choice"]
    bias = [0.0 if name == trusted else -1e3 for name in CANDIDATES]
    head = {"kernel": jnp.zeros_like(params["head_0"]["kernel"]), "bias": jnp.asarray(bias, jnp.float32)}
    light = rng.uniform(0.2, 1.0, (4, len(CANDIDATES) + 1, 3, 24, 32)).astype(np.float16)
    light[:, CANDIDATES.index("last result")] = light[:, 0]
    planes = {name: np.ones((4, 3, 24, 32), np.float16) for name in ("albedo", "normal")}
    stored = {"light": light.copy(), **planes, "number": planes["albedo"][:, 0], "gain": np.ones(4, np.float32)}
    frames = [draw_frame(rng)._replace(motion=jnp.zeros((24, 32, 2))) for _ in range(4)]
    make_results({"one": {4: Sequence(stored, frames)}}, {**params, "head_0": head})
    found = stored["light"][:, CANDIDATES.index("last result")].astype(np.float32)
    np.testing.assert_allclose(found, light[expected, 0].astype(np.float32), rtol=2e-3)


@pytest.mark.slow
def test_training_changes_the_second_network_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    require("pyoidn")
    for name in ("sun-0000", "sun-0100"):
        write_cycles_clip(tmp_path / "train" / name, "train")
    assert main(Options(tmp_path / "train", START, tmp_path / "out.safetensors", minutes=0.0)) == 0
    said = capsys.readouterr().out
    assert "before, 1 samples" in said
    assert "after 1 updates, 16 samples" in said
    before, after = load_weights(START)[1], load_weights(tmp_path / "out.safetensors")[1]
    for name in before.keys() - {"choice"}:
        jax.tree.map(np.testing.assert_array_equal, before[name], after[name])
    changed = jax.tree.map(lambda old, new: bool(np.any(old != new)), before["choice"], after["choice"])
    assert any(jax.tree.leaves(changed))
    assert main(Options(tmp_path / "train", START, tmp_path / "out.safetensors", minutes=0.0, anew=True)) == 0
    begun = load_weights(tmp_path / "out.safetensors")[1]["choice"]["head_0"]["bias"]
    np.testing.assert_allclose(begun, [INITIAL_LOGITS[name] for name in CANDIDATES], atol=0.01)


def test_steps_grow_from_nearly_nothing_and_fall_to_nothing() -> None:
    """A network that begins anew and takes whole steps at once, may be stuck after ten: all shares are 0 or 1."""
    assert find_rate(0, 0.0) == pytest.approx(RATE / WARM_UP)
    assert find_rate(WARM_UP // 2 - 1, 0.0) == pytest.approx(RATE / 2)
    assert find_rate(10 * WARM_UP, 0.0) == pytest.approx(RATE)
    assert find_rate(10 * WARM_UP, 0.5) == pytest.approx(RATE / 2)
    assert find_rate(10 * WARM_UP, 1.0) == 0.0


@pytest.mark.slow
def test_the_prior_stands_for_what_is_left_out(tmp_path: Path) -> None:
    require("pyoidn")
    write_cycles_clip(tmp_path / "sun-0000", "train")
    frames = (read_record(tmp_path / "sun-0000" / RECORD) or {})["frames"]
    find, params = jax.jit(build_candidate_step(Settings())), load_weights(START)[1]
    sequence = collect(tmp_path / "sun-0000", find, params, frames, ["prior mean", "last result"])[1]
    prior, correction, mean, last = np.moveaxis(sequence.stored["light"][:, :-1], 1, 0)
    np.testing.assert_array_equal(mean, prior)
    np.testing.assert_array_equal(last, prior)
    assert np.any(correction != prior)
    held = sequence.stored["light"].copy()
    make_results({"one": {1: sequence}}, params["choice"])
    np.testing.assert_array_equal(sequence.stored["light"], held)


def test_clips_for_tests_are_not_trained_on(tmp_path: Path) -> None:
    write_cycles_clip(tmp_path / "test" / "sun-9000", "test")
    with pytest.raises(ValueError, match="nothing is trained on"):
        main(Options(tmp_path / "test", Path("combiner-high"), tmp_path / "out.safetensors"))
