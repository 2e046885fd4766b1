"""Timing and the benchmark's rows, on workloads that take milliseconds."""

import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.speed import bench, peers, roofline
from experiments.speed.timing import Timing, measure, peak_mib
from experiments.speed.works import Work, operations, scene, steps
from jaxdn.denoisers import ntd

CEILINGS = roofline.Ceilings(copy_gb_s=10.0, matmul_gflop_s=100.0)
PROBE = roofline.Probe(lambda: time.sleep(1e-3), 1e7, lambda: time.sleep(1e-3), 1e8)
KEYS = ["work", "implementation", "median_ms", "min_ms", "max_ms", "peak_mib", "against", "ratio"]


def test_calls_are_timed_interleaved():
    order = []
    timings = measure({name: lambda name=name: order.append(name) for name in "ab"}, rounds=3)
    assert order == list("ab" * 4)
    assert timings["a"].rounds == 3
    assert timings["a"].min_ms <= timings["a"].median_ms <= timings["a"].max_ms


def test_the_first_call_is_separate_and_the_budget_ends_the_rounds():
    naps = iter([0.2] + [0.03] * 100)
    timing = measure({"nap": lambda: time.sleep(next(naps))}, rounds=100, budget_s=0.3)["nap"]
    assert timing.first_ms > 190
    assert 25 < timing.median_ms < 150
    assert 2 <= timing.rounds < 12


def test_peak_memory_is_what_a_call_touches():
    def allocate():
        return np.ones(8 << 20, np.float64).sum()

    peak = peak_mib(allocate)
    if peak is None:
        pytest.skip("this system does not report the peak of resident memory")
    assert 60 < peak < 90  # 64 MiB


def test_rows_of_a_real_workload(tmp_path, monkeypatch):
    lacking = {"torch-compiled": "not compiled in a fast test", **peers.missing()}
    monkeypatch.setattr(peers, "missing", lambda: lacking)
    work = next(operations.warp_works(24, 32, "24p"))
    rows = bench.run(work, PROBE, budget_s=0.5, say=lambda line: None)
    assert rows
    medians = {row["implementation"]: row["median_ms"] for row in rows}
    against = next(row for row in rows if row["against"] == "roofline")
    medians["roofline"] = against["median_ms"] / against["ratio"]
    assert 0.1 < medians["roofline"] / roofline.milliseconds(work.roofline, CEILINGS) < 10
    for row in rows:
        assert list(row) == KEYS
        assert row["work"] == "warp-24p"
        assert row["ratio"] == pytest.approx(row["median_ms"] / medians[row["against"]])
        assert row["peak_mib"] is None or row["peak_mib"] >= 0
    report = bench.Report(tmp_path / "runs" / "bench.json")
    report.add(rows[:1])
    report.add(rows[1:])
    assert json.loads(report.path.read_text()) == rows
    assert [path.name for path in report.path.parent.iterdir()] == ["bench.json"]
    assert bench.table(rows).row_count == len(medians) - 1


def test_every_implementation_is_compared_with_every_peer():
    timings = {name: Timing(ms, ms, ms, ms, 1) for name, ms in (("xla", 2.0), ("xla-remat", 3.0), ("torch-eager", 4.0))}
    rows = bench.compare("train", timings, dict.fromkeys(timings, 1.0), ["torch-eager"], 0.5)
    found = {(row["implementation"], row["against"]): row["ratio"] for row in rows}
    assert found == {
        ("xla", "torch-eager"): 0.5,
        ("xla", "roofline"): 4.0,
        ("xla-remat", "torch-eager"): 0.75,
        ("xla-remat", "roofline"): 6.0,
        ("torch-eager", "roofline"): 8.0,
    }


def test_what_cannot_run_here_is_left_out_with_a_message():
    def refuse():
        raise ValueError("there is no such engine")

    said = []
    work = Work("nothing", {"xla": lambda: lambda: None, "engine": refuse}, {}, [roofline.Cost(1e6, 1e6)])
    rows = bench.run(work, PROBE, budget_s=0.1, say=said.append)
    assert [row["implementation"] for row in rows] == ["xla"]
    assert "engine is left out: there is no such engine" in said[0]


def test_the_roofline_counts_what_the_network_computes():
    for size, widths in steps.WIDTHS.items():
        params = jax.eval_shape(ntd(size=size, kernels="plain").init, jax.random.key(0), None)
        total = 0
        for name, layers in params.items():
            kernels = [leaf for leaf in jax.tree.leaves(layers) if leaf.ndim == 4]
            total += sum(2 * kernel.size for kernel in kernels) * (720 * 1280 >> 2 * int(name[-1]))
        assert sum(cost.operations for cost in roofline.network(widths, 720, 1280)) == total
    cost = roofline.convolution(1, 720, 1280, 32, 32)
    assert cost.operations == pytest.approx(17e9, rel=0.01)
    assert roofline.milliseconds([cost], CEILINGS) == pytest.approx(169.9, rel=0.01)
    assert roofline.milliseconds([roofline.Cost(0, 1e9)], CEILINGS) == pytest.approx(100)


def test_the_recurrent_call_carries_its_state():
    _, work = steps.works(height=16, width=32, title="16p")
    assert work.name == "step-small-16p"
    call = work.ours["xla"]()
    first, second = np.asarray(call()), np.asarray(call())
    assert first.shape == (16, 32, 3)
    assert not np.array_equal(first, second)


def test_the_scene_looks_like_a_clip():
    clip = scene.clip(2, 32, 48)
    frames = clip.frames
    assert clip.reference.shape == frames.radiance.shape == (2, 32, 48, 3)
    np.testing.assert_allclose(np.linalg.norm(frames.normal, axis=-1), 1, rtol=1e-5)
    changed = np.any(frames.motion != frames.dual_motion, axis=-1)
    assert 0 < changed.mean() < 0.2
    assert bool(jnp.isfinite(frames.depth).all())
