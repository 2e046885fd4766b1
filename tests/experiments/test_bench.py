"""Timing, workers in real processes, and the benchmark's rows, on workloads that take milliseconds."""

import os
import pickle
import signal
import subprocess
import sys
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.results_page import read_results, results_page
from experiments.speed import bench, peers, roofline
from experiments.speed.timing import Timing, measure, peak_mib
from experiments.speed.workers import Team, Worker, WorkerError, apart
from experiments.speed.works import Work, operations, scene, steps, train_steps
from jaxdn.denoisers import ntd
from tests.needs import require

CEILINGS = roofline.Ceilings(copy_gb_s=10.0, matmul_gflop_s=100.0)
PROBES = {
    "copy": roofline.Probe(partial(roofline.copy_by_threads, 1 << 20), 8 << 20, 0),
    "matrix product": roofline.Probe(partial(roofline.product_by_numpy, 64), 0, 2 * 64**3),
}
linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
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


@pytest.mark.slow
def test_peak_memory_is_what_a_call_touches():
    def allocate():
        return np.ones(8 << 20, np.float64).sum()

    require("peak memory")
    peak = peak_mib(allocate)
    assert peak is not None
    assert 60 < peak < 90  # 64 MiB


# Builds that another process can unpickle without importing jax, to be quick.
NAP = partial(partial, time.sleep, 0.02)
END = partial(partial, signal.raise_signal, signal.SIGTERM if sys.platform == "win32" else signal.SIGKILL)
"""The call ends its process, as the system does when memory runs out."""
REFUSE = partial(int, "such a backend")


def state_of(pid):
    """As /proc says: "T" is stopped, "S" waits, "R" runs."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.fixture
def worker():
    with closing(Worker(NAP)) as made:
        yield made


def wait_until(true, seconds=20.0):
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    assert true()


@linux
def test_a_worker_is_stopped_between_its_turns_and_ends_when_closed(worker):
    first, peak = worker.first()
    pid = worker._pid.result()
    assert pid != os.getpid()
    wait_until(lambda: state_of(pid) == "T")
    assert 20 <= first < 2000
    assert peak > 10
    assert 20 <= worker.turn() < 200
    wait_until(lambda: state_of(pid) == "T")
    worker.close()
    assert not Path(f"/proc/{pid}").exists()


@linux
def test_a_stopped_worker_ends_with_the_program_that_started_it():
    code = (
        "import os, signal, time; from functools import partial; from experiments.speed.workers import Worker\n"
        "worker = Worker(partial(partial, time.sleep, 0.01)); worker.first()\n"
        "print(worker._pid.result(), flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    wait_until(lambda: not Path(f"/proc/{int(done.stdout)}").exists() or state_of(int(done.stdout)) == "Z")


@pytest.mark.parametrize("before", [None, "glibc.malloc.hugetlb=1:glibc.malloc.arena_max=3"], ids=["unset", "set"])
def test_huge_pages_only_where_they_are_asked_for(before, monkeypatch):
    """Whatever this process was started with: workers get their environment when they start."""
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    if before:
        monkeypatch.setenv("GLIBC_TUNABLES", before)
    assert apart(os.getenv, "GLIBC_TUNABLES") == ("glibc.malloc.arena_max=3" if before else "")
    with closing(Worker(NAP, huge_pages=True)) as worker:
        found = worker.ask(os.getenv, "GLIBC_TUNABLES")
    assert found == ("glibc.malloc.arena_max=3:" if before else "") + "glibc.malloc.hugetlb=1"
    assert os.environ.get("GLIBC_TUNABLES") == before


@linux
def test_a_worker_that_ended_while_it_was_stopped_is_reported(worker):
    """The system chooses whom to end when memory runs out."""
    worker.first()
    os.kill(worker._pid.result(), signal.SIGKILL)
    with pytest.raises(WorkerError, match="its process ended"):
        worker.turn()


def test_what_fails_is_said_and_the_rest_goes_on(tmp_path):
    permission, said = tmp_path / "allowed", []
    permission.touch()
    with Team("work", said.append) as team:
        first = team.start({"good": NAP, "bad": REFUSE, "dead": END, "brief": partial(partial, os.stat, permission)})
        assert list(first) == ["good", "brief"]
        permission.unlink()
        samples = team.turns(rounds=3, budget_s=10)
        assert list(samples) == ["good"]
        assert len(samples["good"]) == 3
        peak = team.peak("good", None)
        assert peak is None or 0 <= peak < 50
    assert said[0] == "work: bad is left out: invalid literal for int() with base 10: 'such a backend'"
    assert said[1] == "work: dead is left out: its process ended, perhaps for want of memory"
    assert said[2].startswith("work: brief is left out: FileNotFoundError: ")
    assert len(said) == 3


def test_what_does_not_fit_into_memory_is_left_out(monkeypatch):
    said = []
    monkeypatch.setattr("experiments.speed.workers.available_mib", lambda: 1.0)
    with Team("work", said.append) as team:
        found = team.start({"one": NAP, "two": NAP})
    assert "two" not in found or sys.platform != "linux"
    assert said[0].startswith("work: two is left out: 1 MiB of memory are free") or sys.platform != "linux"


def test_an_answer_that_does_not_come_is_not_awaited_for_ever(worker, monkeypatch):
    worker.first()
    monkeypatch.setattr("experiments.speed.workers.LIMIT_S", 0.001)
    with pytest.raises(WorkerError, match="no answer within"):
        worker.turn()


@pytest.mark.slow
def test_rows_of_a_real_workload(tmp_path, monkeypatch):
    lacking = {"torch-compiled": "not compiled in a fast test", **peers.missing()}
    monkeypatch.setattr(peers, "missing", lambda: lacking)
    work = next(operations.warp_works(24, 32, "24p"))
    rows = bench.run(work, PROBES, budget_s=0.5, say=lambda line: None)
    assert rows
    medians = {row["implementation"]: row["median_ms"] for row in rows}
    against = next(row for row in rows if row["against"] == "roofline")
    medians["roofline"] = against["median_ms"] / against["ratio"]
    assert medians["roofline"] > 0
    for row in rows:
        assert list(row) == KEYS
        assert row["work"] == "warp-24p"
        assert row["ratio"] == pytest.approx(row["median_ms"] / medians[row["against"]])
        assert row["peak_mib"] is None or row["peak_mib"] >= 0
    report = bench.Report(tmp_path / "runs" / "bench.json", "make bench")
    report.add(rows[:1])
    report.add(rows[1:])
    (result,) = read_results(report.path.parent)
    assert result["rows"] == rows
    assert f"| warp-24p | {rows[0]['implementation']} |" in results_page([result])
    assert [path.name for path in report.path.parent.iterdir()] == ["bench.json"]
    assert bench.table(rows).row_count == len(medians) - 1


def test_every_workload_can_be_sent_to_another_process():
    for work in (*steps.works(), *operations.works(), *train_steps.works()):
        pickle.dumps((work.ours, work.peers, dict(work.alone)))
        assert set(work.alone) <= set(work.peers)
        assert work.huge_pages <= set(work.ours)


def test_the_ceilings_are_the_highest_rates():
    probes = {"copy": roofline.Probe(NAP, 2e9, 0), "a": roofline.Probe(NAP, 0, 3e9), "b": roofline.Probe(NAP, 0, 3e9)}
    reached = roofline.ceilings(probes, {"copy": 100.0, "a": 30.0, "b": 20.0})
    assert reached == pytest.approx(roofline.Ceilings(copy_gb_s=20.0, matmul_gflop_s=150.0))


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


@pytest.mark.slow
def test_without_ceilings_there_are_no_rows_of_the_roofline():
    said = []
    work = Work("nothing", {"xla": NAP, "backend": REFUSE}, {"peer": NAP}, [roofline.Cost(1e6, 1e6)])
    rows = bench.run(work, {**PROBES, "copy": roofline.Probe(END, 1, 0)}, budget_s=0.1, say=said.append)
    assert [(row["implementation"], row["against"]) for row in rows] == [("xla", "peer")]
    assert any(line.startswith("nothing: backend is left out: invalid literal") for line in said)
    assert any(line.startswith("nothing: copy is left out: its process ended") for line in said)


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


@pytest.mark.slow
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
