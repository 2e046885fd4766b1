"""Frames rendered with another number of samples in each pixel, and ``jaxdn denoise SCENE``."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import jaxdn as library
from jaxdn import effects
from jaxdn.commands import main
from jaxdn.core.frame import Frame
from jaxdn.data.exr.exr import read_exr
from jaxdn.render import render_frame
from jaxdn.render.adaptive import render_sampled
from jaxdn.render.settings import RenderSettings
from jaxdn.render.tracing import vectorised_path_tracer
from jaxdn.zoo.weights import save_weights
from tests.render.render_scenes import HEIGHT, WIDTH, Stage, fast_variants

VECTORISED = [variant for variant in fast_variants() if not variant.startswith("scalar")]
pytestmark = pytest.mark.needs("llvm")  # scalar variants render whole images only

TINY = ((4,), (4,), (5,), (5,), (6,))
SIZE: dict[str, Any] = {"width": WIDTH, "height": HEIGHT}


def jaxdn(*arguments: Any) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "jaxdn.commands.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def told(capsys: pytest.CaptureFixture[str], *arguments: Any) -> str:
    """What is told about wrong arguments, in this process: another one needs seconds to begin."""
    with pytest.raises(SystemExit) as ended:
        main.main([*map(str, arguments)])
    shown = capsys.readouterr().err
    assert ended.value.code == 2, shown
    assert "Traceback" not in shown
    return " ".join(shown.split())


def planned(light="reflected"):
    return effects.plan(effects.inspect(Stage(), **SIZE, frames=2), library.denoisers.svgf(), light=light)


@pytest.mark.parametrize("light", ["indirect", "reflected"])
def test_every_pixel_has_the_first_samples_of_its_frame(light, rng):
    """n samples are the mean of the layer of one, of two and of four, as far as n has their samples."""
    options: dict[str, Any] = {**SIZE, "plan": planned(light), "seed": 5, "light": light}
    counts = rng.integers(0, 4, (HEIGHT, WIDTH, 1)) * 2 + 1  # 1, 3, 5, 7
    seen = []

    def ask(frame: Frame) -> np.ndarray:
        seen.append(frame)
        return counts

    found = render_sampled(Stage(), 1, ask, RenderSettings(**options))
    layers = render_frame(Stage(), 1, RenderSettings(layers=(1, 2, 4), **options)).layers
    np.testing.assert_array_equal(seen[0].radiance, layers[1])
    whole = {1: layers[1], 3: (layers[1] + 2 * layers[2]) / 3, 7: (layers[1] + 2 * layers[2] + 4 * layers[4]) / 7}
    for count, image in whole.items():
        where = counts[..., 0] == count
        assert where.any()
        np.testing.assert_allclose(found.frame.radiance[where], image[where], rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(found.frame.sample_count, counts)
    assert found.bad_samples == 0


@pytest.mark.slow
def test_without_a_first_sample_no_more_paths_are_traced_than_are_asked_for(rng, monkeypatch):
    """Camera rays alone before the question, then a path a sample; the image is the same as with the first sample."""
    settings = RenderSettings(**SIZE, plan=planned(), seed=5, light="reflected")
    counts = rng.integers(0, 3, (HEIGHT, WIDTH, 1)) * (rng.random((HEIGHT, WIDTH, 1)) < 0.4)
    with_first = render_sampled(Stage(), 1, lambda frame: counts, settings)
    traced, seen = {}, []
    trace = vectorised_path_tracer._trace_lanes

    def counting(scene, pixel, sample, key, max_depth, *more, **others):
        traced[max_depth] = traced.get(max_depth, 0) + len(np.asarray(pixel))
        return trace(scene, pixel, sample, key, max_depth, *more, **others)

    def ask(frame: Frame) -> np.ndarray:
        seen.append(frame)
        return counts

    monkeypatch.setattr(vectorised_path_tracer, "_trace_lanes", counting)
    found = render_sampled(Stage(), 1, ask, settings, sample_first=False)
    assert not np.any(seen[0].radiance)
    assert sum(number for depth, number in traced.items() if depth > 1) == counts.sum()
    for name, buffer in found.frame._asdict().items():
        other = getattr(with_first.frame, name)
        assert (buffer is None) == (other is None)
        if buffer is not None:
            np.testing.assert_allclose(buffer, other, rtol=1e-5, atol=1e-6, err_msg=name)


def test_settings_that_samples_for_each_pixel_do_not_have_are_refused():
    settings = RenderSettings(**SIZE, plan=planned(), light="reflected")
    wrong = ({"plan": None}, {"layers": (1, 2)}, {"reference_spp": 2}, {"jitter": True, "plan": None})
    for change in wrong:
        with pytest.raises(ValueError, match="samples for each pixel: expected a plan"):
            render_sampled(Stage(), 0, lambda frame: np.ones((HEIGHT, WIDTH, 1)), replace(settings, **change))


def test_pixels_without_samples_are_black():
    ask = lambda frame: np.indices((HEIGHT, WIDTH)).sum(0)[..., None] % 2  # noqa: E731
    found = render_sampled(Stage(), 0, ask, RenderSettings(**SIZE, plan=planned(), seed=1, light="reflected"))
    dark = found.frame.sample_count[..., 0] == 0
    assert not np.any(found.frame.radiance[dark])
    one = render_frame(Stage(), 0, RenderSettings(**SIZE, plan=planned(), seed=1, light="reflected"))
    np.testing.assert_allclose(found.frame.radiance[~dark], one.frame.radiance[~dark], rtol=1e-6)


def test_more_samples_are_nearer_to_the_reference():
    options: dict[str, Any] = {**SIZE, "plan": planned(), "light": "reflected"}
    reference = render_frame(Stage(), 0, RenderSettings(reference_spp=512, **options)).reference
    errors = []
    for count in (1, 4, 16):
        found = render_sampled(
            Stage(), 0, lambda frame, count=count: np.full((HEIGHT, WIDTH, 1), count), RenderSettings(**options)
        )
        errors.append(np.mean(np.square(found.frame.radiance - reference)))
    np.testing.assert_allclose(errors[0] / errors[1], 4, rtol=0.5)
    np.testing.assert_allclose(errors[1] / errors[2], 4, rtol=0.5)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a small ``ntasd`` that nobody has trained, with decisive biases."""
    denoiser = library.denoisers.ntasd(size=TINY)
    key = jax.random.key(3)
    params = denoiser.init(key, Frame(np.zeros((16, 16, 3), np.float32)))
    params = jax.tree.map(lambda leaf: leaf + 0.2 * jax.random.normal(key, leaf.shape), params)
    path = tmp_path_factory.mktemp("weights") / "tiny"
    return save_weights(path, params, factory="ntasd", options={"size": TINY}, record={})


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_a_scene_is_rendered_and_denoised_within_its_budget(weights, tmp_path):
    there = ("--width", "40", "--height", "24", "--frames", "0-2", "--budget", "3", "--preview")
    done = jaxdn("denoise", "fruit", "-o", tmp_path, "--method", weights, *there)
    assert done.returncode == 0, done.stderr
    assert "3 frames rendered" in done.stdout
    for index in range(3):
        channels = read_exr(tmp_path / f"frame_{index:04d}.exr")
        counts = channels["samples.Y"]
        assert counts.sum() == 3 * 24 * 40
        assert (len(np.unique(counts)) > 1) == (index > 0)  # the first frame is sampled evenly
        assert np.isfinite(channels["R"]).all()
        assert channels["R"].mean() >= channels["denoised.R"].mean() > 0
        assert (tmp_path / f"frame_{index:04d}.samples.png").is_file()
    assert "3 samples per pixel, 1 to" in done.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_a_filter_that_does_not_ask_gets_the_budget_everywhere(tmp_path):
    there = ("--width", "40", "--height", "24", "--frames", "1", "--budget", "2")
    done = jaxdn("denoise", "fruit", "-o", tmp_path, "--method", "taa", *there)
    assert done.returncode == 0, done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["frame_0001.exr"]
    np.testing.assert_array_equal(read_exr(tmp_path / "frame_0001.exr")["samples.Y"], 2)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_half_a_sample_is_one_in_every_second_pixel_and_the_picture_is_whole(tmp_path):
    """In two frames every pixel has one; only these paths are traced, and pixels without look like their neighbours."""
    there = ("--width", "40", "--height", "24", "--frames", "0-3", "--method", "steady-fast")
    for name, budget in (("half", "0.5"), ("whole", "1")):
        done = jaxdn("denoise", "fruit", "-o", tmp_path / name, *there, "--budget", budget)
        assert done.returncode == 0, done.stderr
    half, whole = (
        [read_exr(tmp_path / name / f"frame_{index:04d}.exr") for index in range(4)] for name in ("half", "whole")
    )
    counts = [frame["samples.Y"] for frame in half]
    for first in (0, 2):
        np.testing.assert_array_equal(counts[first] + counts[first + 1], 1)
    image, seen = half[3]["denoised.G"], counts[3] > 0
    assert image.mean() == pytest.approx(whole[3]["denoised.G"].mean(), rel=0.1)
    assert image[seen].mean() == pytest.approx(image[~seen].mean(), rel=0.05)


WRONG = {
    "a budget below one sample": (("fruit", "--budget", "0.5"), "budget: expected a mean number of samples above 0"),
    "no budget": (("fruit", "--budget", "0"), "budget: expected"),
    "a frame that is not there": (("fruit", "--frames", "400"), "--frames: expected some of 0 to"),
    "a frame before the first": (("fruit", "--frames=-1-1"), "--frames: expected some of 0 to"),
    "an option of files": (("fruit", "--layer", "View"), "--layer: expected frames that are there, got a scene"),
    "two sources": (("fruit", "robot"), "expected one scene and nothing else, got 2 sources"),
    "no such scene": (("nowhere.xml",), "nowhere.xml"),
}


@pytest.mark.slow
def test_wrong_arguments_end_a_process_with_a_message(weights, tmp_path):
    done = jaxdn("denoise", "fruit", "robot", "-o", tmp_path / "out", "--method", weights)
    assert done.returncode == 2
    assert "expected one scene and nothing else, got 2 sources" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("wrong", WRONG)
def test_what_cannot_be_rendered_is_told(wrong, weights, tmp_path, capsys):
    arguments, words = WRONG[wrong]
    size = ("--width", "32", "--height", "16")
    assert words in told(capsys, "denoise", *arguments, "-o", tmp_path / "out", "--method", weights, *size)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "budget", "words"),
    [
        ("svgf", "2.5", "expected a whole number of at least 1, as svgf"),
        ("svgf", "0", "fractions are for steady, and for weights of methods that do (ntasd, dasr)."),
        ("steady-fast", "0", "expected a number of samples above 0."),
    ],
)
def test_what_a_method_that_does_not_ask_cannot_have(method, budget, words, tmp_path, capsys):
    options = ("--method", method, "--frames", "0", "--budget", budget)
    found = told(capsys, "denoise", "fruit", "-o", tmp_path / "out", *options)
    assert f"--budget {budget}: " in found
    assert words in found


@pytest.mark.slow
def test_options_of_a_scene_do_not_fit_clips(weights, tmp_path, capsys):
    words = told(capsys, "denoise", tmp_path, "-o", tmp_path / "out", "--method", weights, "--width", "32")
    assert "--width: expected a scene to render, got frames that are there" in words
