"""The startup profile: which stage a stack is, and a real run."""

import json
import sys
import time
from pathlib import Path

import pytest

from experiments.results_page import read_results, results_page
from experiments.speed import sampler, startup

SITE = "/usr/lib/python3.11/site-packages"
TRACED = (f"{SITE}/jax/_src/pjit.py", "_infer_params")
CALLED = ("/x/jaxdn/sequence/frame_denoiser.py", "__call__")


@pytest.mark.parametrize(
    ("stack", "stage"),
    [
        ([(f"{SITE}/numba/core/types.py", "<module>"), TRACED, CALLED], "importing numba"),
        ([("/x/jaxdn/zoo/weights.py", "<module>"), ("/x/jaxdn/commands/denoise.py", "<module>")], "importing jaxdn"),
        ([(f"{SITE}/rich/console.py", "<module>")], "importing rich"),
        ([(f"{SITE}/typeguard/__init__.py", "<module>")], "importing others"),
        ([(f"{SITE}/jax/_src/lib/__init__.py", "_xla_gc_callback"), TRACED, CALLED], sampler.GARBAGE),
        ([("/x/jaxdn/ops/warp.py", "warp"), TRACED, CALLED], "tracing"),
        ([("/usr/lib/python3.11/threading.py", "wait"), CALLED], "denoising"),
        ([("/x/jaxdn/data/exr/file.py", "decode"), ("/x/jaxdn/commands/denoise.py", "_show_job")], "reading"),
        ([("/x/experiments/speed/sampler.py", "main")], sampler.OTHER),
    ],
)
def test_the_innermost_known_function_says_the_stage(stack: list[sampler.Place], stage: str) -> None:
    assert sampler.stage_of(stack) == stage


def test_what_is_computed_is_counted_and_what_sleeps_is_not() -> None:
    def work() -> None:
        end = time.process_time() + 0.2
        while time.process_time() < end:
            sum(range(1000))

    assert 0.1 < sum(sampler.sample(work).values()) < 0.4
    assert sum(sampler.sample(lambda: time.sleep(0.2)).values()) < 0.1


def test_the_largest_stage_comes_first_and_the_sums_last() -> None:
    runs = {"a": [{"tracing": 1.0, "reading": 3.0}, {"tracing": 2.0}, {"tracing": 2.0, "reading": 1.0, "other": 0.001}]}
    assert startup.rows(runs) == [("tracing", [2.0]), ("reading", [1.0]), ("all (the median run)", [3.001])]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="paths of the environment differ")
def test_a_profile_of_real_runs_is_on_the_results_page(tmp_path: Path) -> None:
    out = tmp_path / "startup.json"
    startup.main(startup.Settings(methods=["taa"], size="48x32", runs=1, out=out))
    stages = dict(json.loads(out.read_text())["rows"])
    assert {"importing jax", "tracing", "starting Python"} <= set(stages)
    assert 0.1 < stages["importing jax"] < stages["all (the median run)"]
    assert stages.get(sampler.OTHER, 0.0) < 0.2 * stages["all (the median run)"]
    assert "| importing jax |" in results_page(read_results(tmp_path))
