"""The script that times single frames: what it times, and what it refuses."""

import json

import pytest

from experiments.results_page import BACKEND_COLUMNS, read_results, results_page
from experiments.speed.frames import OIDN, Settings, builds, main, measurement, parsed
from jaxdn.networks.backends import BACKENDS
from jaxdn.ops.dispatch import numba_call


def test_every_backend_for_inference_that_runs_here_is_timed():
    backends = [name for name in ("onednn-bfloat16", "onednn-float32", "onnxruntime") if BACKENDS[name].available()]
    found = set(builds(["svgf", "steady-fast"], 32, 48)) - {OIDN}
    methods = ("svgf", "steady-fast")
    without = [f"{name}, reference" for name in methods if not numba_call.unavailable()]
    assert found == {*(f"{name}, xla" for name in methods), *without, *(f"steady-fast, {name}" for name in backends)}
    assert {label.partition(", ")[2] for label in found} <= BACKEND_COLUMNS.keys(), (
        "each has its column on the page of results"
    )


def test_the_page_of_results_reads_what_is_saved(tmp_path):
    settings = Settings(["svgf", "taa"], ["8x4"], 3)
    times = {"svgf, xla": 2.5, "svgf, reference": 5.0, "taa, xla": 1.0}
    rows = [{"run": 1, "width": 8, "height": 4, "implementation": name, "ms": ms} for name, ms in times.items()]
    (tmp_path / "frames.json").write_text(json.dumps(measurement(settings, rows)))
    page = results_page(read_results(tmp_path))
    assert "| `svgf` | 1 | 2.5 | 5.0 |  |" in page, "without Open Image Denoise there are no ratios"
    assert "Medians of 3 interleaved turns" in page
    assert "`python -m experiments.speed.frames --methods svgf taa --sizes 8x4 --rounds 3`" in page


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_figures_are_printed_and_saved(tmp_path, capsys):
    main(Settings(["taa"], ["48x32"], 2, tmp_path / "frames.json"))
    (result,) = read_results(tmp_path)
    (own,) = [row for row in result["rows"] if row["implementation"] == "taa, xla"]
    assert (own["width"], own["height"]) == (48, 32)
    assert own["ms"] > 0
    printed = capsys.readouterr().out
    assert "taa, xla" in printed
    assert f"{1e6 * own['ms'] / (48 * 32):,.0f}" in printed


@pytest.mark.parametrize("size", ["720", "1280x", "0x720", "1280x720x3", "axb"])
def test_other_sizes_are_refused(size):
    with pytest.raises(ValueError, match="expected WIDTHxHEIGHT in pixels, such as 1280x720"):
        parsed(size)


def test_the_noisy_image_has_no_time():
    with pytest.raises(ValueError, match="expected a denoiser, got the noisy image"):
        builds(["noisy"], 32, 48)
