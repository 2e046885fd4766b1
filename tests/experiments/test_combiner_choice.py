"""The second network of combiner, trained alone on clips of Cycles."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.cycles import combiner_choice
from experiments.cycles.combiner_choice import Options, draw, find_errors, main, square
from jaxdn.zoo.weights import load_weights
from tests.experiments.test_cycles_training import write_cycles_clip
from tests.needs import require


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
        first, second = draw({"one": {1: stored, 4: stored, 16: stored}}, rng)
        np.testing.assert_array_equal(second["light"] - first["light"], 1000)
        np.testing.assert_array_equal(first["light"], first["targets"])
        assert set(first["light"].ravel() % 1000) == set(place.ravel())
        channel = int(np.argwhere(first["light"][0, :, 0, 0] % 1000 < 32)[0, 0])
        np.testing.assert_array_equal(first["light"][0, channel], first["number"])
        seen.add(tuple(first["light"][0, :, 0, 0] % 1000))
    assert len(seen) > 8


@pytest.mark.slow
def test_training_changes_the_second_network_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    require("pyoidn")
    for name in ("sun-0000", "sun-0100"):
        write_cycles_clip(tmp_path / "train" / name, "train")
    start = Path(combiner_choice.__file__).parents[2] / "jaxdn/zoo/shipped/combiner-high.safetensors"
    assert main(Options(tmp_path / "train", start, tmp_path / "out.safetensors", minutes=0.0)) == 0
    said = capsys.readouterr().out
    assert "before, 1 samples" in said
    assert "after 1 updates, 16 samples" in said
    before, after = load_weights(start)[1], load_weights(tmp_path / "out.safetensors")[1]
    for name in before.keys() - {"choice"}:
        jax.tree.map(np.testing.assert_array_equal, before[name], after[name])
    changed = jax.tree.map(lambda old, new: bool(np.any(old != new)), before["choice"], after["choice"])
    assert any(jax.tree.leaves(changed))


def test_clips_for_tests_are_not_trained_on(tmp_path: Path) -> None:
    write_cycles_clip(tmp_path / "test" / "sun-9000", "test")
    with pytest.raises(ValueError, match="nothing is trained on"):
        main(Options(tmp_path / "test", Path("combiner-high"), tmp_path / "out.safetensors"))
