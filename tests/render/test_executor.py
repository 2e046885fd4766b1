"""Clips rendered by an executor: frames, records and files are those of the local processes, whatever is killed."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from jaxdn.commands import main
from jaxdn.data.clip.folder import frame_path, is_clip, read_record
from jaxdn.render import executor, worker_pool
from jaxdn.render.bad_samples import note_bad_samples
from jaxdn.render.clip import finish_clip, render_clip
from jaxdn.render.clip_job import ClipJob, UnplannedClip
from jaxdn.render.mitsuba.errors import RenderError
from jaxdn.render.separate_process import ClipTask, render_apart
from jaxdn.render.settings import RenderSettings
from jaxdn.sequence.render_jobs import ClipSource, plan_jobs, render
from tests.render.render_scenes import Stage

SETTINGS = RenderSettings(width=24, height=16, reference_spp=16, variant="scalar_rgb", max_depth=3)
FRAMES = 5
"""Of the first clip; of the others one."""
CLIPS = 4
PATIENCE_S = 900
ROOT = Path(__file__).parents[2]


def list_jobs(out: Path, clips: int = 2) -> list[ClipJob]:
    return [
        ClipJob(
            {"family": "edge", "seed": seed},
            str(out / f"edge-{seed}"),
            1 if seed else FRAMES,
            replace(SETTINGS, seed=seed),
        )
        for seed in range(clips)
    ]


def count_frames(clips: int) -> int:
    return FRAMES + clips - 1


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def stamps(folder: Path) -> dict[str, int]:
    """When each frame that is there was written."""
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("frame_*.exr")}


def wait_until(true: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


def find_renderers(process: int) -> list[psutil.Process]:
    """The processes below another one that render a clip."""
    found = []
    for child in psutil.Process(process).children(recursive=True):
        with suppress(psutil.NoSuchProcess, psutil.ZombieProcess):
            if "jaxdn.render.separate_process" in child.cmdline():
                found.append(child)
    return found


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of the clips that processes of this machine have rendered."""
    out = tmp_path_factory.mktemp("local")
    worker_pool.render_clips(list_jobs(out, CLIPS), workers=2, progress=False)
    return contents(out)


@pytest.mark.slow
def test_threads_render_what_processes_do_after_a_renderer_is_killed(local: dict[str, bytes], tmp_path: Path) -> None:
    (job,) = list_jobs(tmp_path, 1)
    renderers: list[psutil.Process] = []

    def kill() -> None:
        wait_until(lambda: frame_path(job.folder, 0).is_file())
        renderers.extend(find_renderers(os.getpid()))
        for renderer in renderers:
            renderer.kill()

    with ThreadPoolExecutor(1) as threads:
        killer = threading.Thread(target=kill)
        killer.start()
        with pytest.raises(RenderError, match=r"1 of 1(.|\n)*edge-0(.|\n)*frame \d: the renderer's process died: SIG"):
            worker_pool.render_clips([job], executor=threads, progress=False)
        killer.join()
        before = stamps(tmp_path)
        assert len(renderers) == 1
        assert 1 <= len(before) < FRAMES
        assert not is_clip(job.folder)
        seen: list[tuple[int, int]] = []
        worker_pool.render_clips(
            [job], executor=threads, frames_per_task=3, progress=lambda *counts: seen.append(counts)
        )
    assert seen[-1] == (FRAMES, FRAMES)
    assert contents(tmp_path) == {name: file for name, file in local.items() if name.startswith("edge-0")}
    assert before.items() <= stamps(tmp_path).items()


@pytest.mark.slow
def test_two_renderers_of_one_clip_at_once_leave_one_set_of_files(local: dict[str, bytes], tmp_path: Path) -> None:
    (job,) = list_jobs(tmp_path, 1)
    task = ClipTask(job, None, 2, None, os.getcwd())
    with ThreadPoolExecutor(2) as threads:
        both = [threads.submit(render_apart, task) for _ in range(2)]
        wait_until(lambda: len(find_renderers(os.getpid())) == 2)
        assert [one.result() for one in both] == [None, None]
    assert contents(tmp_path) == {name: file for name, file in local.items() if name.startswith("edge-0")}


THREADS = "from concurrent.futures import ThreadPoolExecutor as Threads\nwith Threads(2) as executor:"
CLUSTER = "from jaxdn.commands.scheduler import open_scheduler\nwith open_scheduler({file!r}) as executor:"


def start_client(out: Path, begin: str, clips: int, frames_per_task: int | None = None) -> subprocess.Popen[str]:
    """A process that renders so many clips by the executor that ``begin`` opens."""
    program = (
        "from pathlib import Path; from tests.render.test_executor import list_jobs\n"
        f"from jaxdn.render import render_clips\njobs = list_jobs(Path({str(out)!r}), {clips})\n"
        f"{begin} render_clips(jobs, executor=executor, frames_per_task={frames_per_task})"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.Popen(
        [sys.executable, "-c", program], env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


@pytest.mark.slow
def test_threads_render_only_what_is_missing_after_their_client_is_killed(
    local: dict[str, bytes], tmp_path: Path
) -> None:
    clips = 2
    first = Path(list_jobs(tmp_path, clips)[0].folder)
    client = start_client(tmp_path, THREADS, clips)
    wait_until(lambda: frame_path(first, 0).is_file())
    renderers = find_renderers(client.pid)
    client.kill()
    client.wait()
    psutil.wait_procs(renderers, PATIENCE_S)
    before = stamps(tmp_path)
    assert len(renderers) in (1, 2)
    assert not is_clip(first)  # a renderer ends with its client, and does not go on to the end of its clip
    assert not frame_path(first, FRAMES - 1).is_file()
    assert not any(renderer.is_running() for renderer in renderers)

    client = start_client(tmp_path, THREADS, clips)
    said, _ = client.communicate(timeout=PATIENCE_S)
    assert client.returncode == 0, said
    frames = count_frames(clips)
    assert f"rendered {frames} of {frames} frames" in said
    assert contents(tmp_path) == {name: file for name, file in local.items() if name.startswith(("edge-0", "edge-1"))}
    assert before.items() <= stamps(tmp_path).items()


@contextmanager
def start_cluster(folder: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """A scheduler and two workers with nannies on loopback, as the commands of Dask start them."""
    file = folder / "scheduler.json"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    dask = [sys.executable, "-m", "distributed.cli"]
    dask[-1] += ".dask_scheduler"
    options = ["--host", "127.0.0.1", "--no-dashboard", "--scheduler-file", str(file)]
    processes = [subprocess.Popen([*dask, "--port", "0", *options], **quiet)]
    try:
        wait_until(file.is_file)
        dask[-1] = "distributed.cli.dask_worker"
        options += ["--nthreads", "1", "--local-directory", str(folder)]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        processes += [subprocess.Popen([*dask, *options], env=environment, **quiet) for _ in range(2)]
        yield processes
    finally:
        for process in processes:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.slow
@pytest.mark.needs("distributed", "fcntl")
def test_a_cluster_renders_the_same_whatever_is_killed(local: dict[str, bytes], tmp_path: Path) -> None:
    out, cluster = tmp_path / "out", CLUSTER.format(file=str(tmp_path / "scheduler.json"))
    frames = count_frames(CLIPS)

    with start_cluster(tmp_path) as (_, *workers):
        client = start_client(out, cluster, CLIPS, 4)
        wait_until(lambda: len(stamps(out)) >= 1)
        client.kill()
        client.wait()
        wait_until(lambda: not any(find_renderers(worker.pid) for worker in workers))
        before = stamps(out)
        assert 1 <= len(before) < frames
        assert not is_clip(out / f"edge-{CLIPS - 1}")

        client = start_client(out, cluster, CLIPS, 4)

        def wait_for_renderer() -> tuple[subprocess.Popen[bytes], psutil.Process]:
            wait_until(lambda: any(find_renderers(worker.pid) for worker in workers))
            return next((worker, *found[:1]) for worker in workers if (found := find_renderers(worker.pid)))

        _, renderer = wait_for_renderer()
        renderer.kill()  # Dask begins its task again
        renderer.wait(PATIENCE_S)
        lost, _ = wait_for_renderer()
        processes = psutil.Process(lost.pid).children(recursive=True)
        lost.kill()
        for process in processes:  # a lost machine: nanny, worker and renderer
            with suppress(psutil.NoSuchProcess):
                process.kill()
        workers.remove(lost)
        nanny, renderer = wait_for_renderer()
        renderer.parent().kill()  # its nanny starts another worker
        renderer.wait(PATIENCE_S)  # the renderer of a killed worker ends with it
        assert psutil.Process(nanny.pid).is_running()
        said, _ = client.communicate(timeout=PATIENCE_S)
    assert client.returncode == 0, said
    assert f"rendered {frames} of {frames} frames" in said
    assert contents(out) == local
    assert before.items() <= stamps(out).items()


class Submitted(Executor):
    """Keeps what is submitted, and answers each task by a function of it."""

    def __init__(self, answer: Callable[["Future[None]"], None]) -> None:
        self.tasks: list[ClipTask] = []
        self.futures: list[Future[None]] = []
        self._answer = answer

    def submit(self, call: Any, task: ClipTask) -> "Future[None]":  # type: ignore[override]
        assert call is render_apart
        self.tasks.append(pickle.loads(pickle.dumps(task)))
        self.futures.append(Future())
        self._answer(self.futures[-1])
        return self.futures[-1]


@pytest.mark.slow
def test_a_thousand_clips_are_submitted_without_planning_one(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    farm = Submitted(lambda future: future.set_exception(RenderError("not today")))
    source = ClipSource("fruit", range(1024), FRAMES)
    begun = time.monotonic()
    with pytest.raises(RenderError, match=r"1024 of 1024 clips failed:\nnot today"):
        render(source, tmp_path, SETTINGS, executor=farm, threads=4)
    assert time.monotonic() - begun < 60
    assert "on all machines; each clip is planned where it is rendered" in capsys.readouterr().out
    assert {task.threads for task in farm.tasks} == {4}
    last = farm.tasks[-1].clip
    assert isinstance(last, UnplannedClip)
    (planned,) = plan_jobs(source._replace(seeds=[1023]), tmp_path, SETTINGS)
    assert last.plan() == planned
    assert (last.folder, last.frames) == (planned.folder, planned.frames)


def test_what_no_plan_can_be_made_of_is_refused_before_it_is_submitted(tmp_path: Path) -> None:
    farm = Submitted(lambda future: None)
    for wrong in (
        {"scene": "castle"},
        {"animation": Path("walk.json")},
        {"denoiser": "nobody"},
        {"scene": "castle.xml", "randomised": True},
    ):
        with pytest.raises(ValueError, match=r"castle|walk\.json|nobody"):
            render(ClipSource(**{"scene": "fruit", **wrong}), tmp_path, SETTINGS, executor=farm)
    assert not farm.tasks


def test_the_variant_is_that_of_the_machine_that_submits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXDN_VARIANT", "cuda_ad_rgb")  # it need not run here
    farm = Submitted(lambda future: future.set_exception(RenderError("not today")))
    jobs = [job._replace(settings=replace(job.settings, variant=None)) for job in list_jobs(tmp_path)]
    render_clip(Stage(), jobs[1].folder, replace(SETTINGS, variant="scalar_rgb"), frames=1)  # begun before
    with pytest.raises(RenderError):
        worker_pool.render_clips(jobs, executor=farm, progress=False)
    clips = [task.clip for task in farm.tasks if isinstance(task.clip, ClipJob)]
    assert [clip.settings.variant for clip in clips] == ["cuda_ad_rgb", "scalar_rgb"]
    monkeypatch.setenv("JAXDN_VARIANT", "vulkan_rgb")
    with pytest.raises(ValueError, match="expected one of cuda_ad_rgb"):
        worker_pool.render_clips(jobs[:1], executor=farm, progress=False)


def test_a_machine_without_the_variant_or_the_files_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DRJIT_LIBLLVM_PATH", "_JAXDN_VARIANT_FOUND_LLVM_AD_RGB"):
        monkeypatch.setenv(name, "missing")
    monkeypatch.setattr("jaxdn.render.mitsuba.variant._choice", {})
    (job,) = list_jobs(tmp_path, 1)
    task = ClipTask(job, None, 2, "llvm_ad_rgb", str(tmp_path))
    with pytest.raises(RenderError, match=r"clip in .*edge-0, on .*: variant: 'llvm_ad_rgb' does not run here"):
        render_apart(task)
    with pytest.raises(RenderError, match="machines of a farm must see the same files under the same paths"):
        render_apart(task._replace(directory=str(tmp_path / "elsewhere")))


def test_frames_that_others_wrote_to_another_disk_are_no_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "_SEEN_WITHIN_S", 0.0)
    with pytest.raises(RenderError, match="0 of 5 are seen from here; the machines must share this disk"):
        worker_pool.render_clips(
            list_jobs(tmp_path, 1), executor=Submitted(lambda future: future.set_result(None)), progress=False
        )


def test_what_another_disk_has_is_waited_for_once_however_many_clips_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(executor, "_SEEN_WITHIN_S", 1.0)
    farm, begun = Submitted(lambda future: future.set_result(None)), time.monotonic()
    with pytest.raises(RenderError, match="12 of 12 clips failed"):
        worker_pool.render_clips(list_jobs(tmp_path, 12), executor=farm, progress=False)
    assert 1 <= time.monotonic() - begun < 6


def test_ctrl_c_cancels_what_has_not_begun(tmp_path: Path) -> None:
    farm = Submitted(lambda future: None)

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        worker_pool.render_clips(list_jobs(tmp_path), executor=farm, progress=interrupt)
    assert len(farm.futures) == 2
    assert all(future.cancelled() for future in farm.futures)


def test_options_of_the_other_way_are_refused(tmp_path: Path) -> None:
    farm, jobs = Submitted(lambda future: None), list_jobs(tmp_path)
    with pytest.raises(ValueError, match="workers: expected none with an executor"):
        worker_pool.render_clips(jobs, executor=farm, workers=2)
    with pytest.raises(ValueError, match="frames_per_task: expected none without an executor"):
        worker_pool.render_clips(jobs, frames_per_task=2)
    with pytest.raises(ValueError, match="threads: expected at least 2, got 1"):
        worker_pool.render_clips(jobs, threads=1)
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        worker_pool.render_clips(jobs, workers=0)
    assert not farm.tasks


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "told"),
    [(["--frames-per-task", "2"], "--frames-per-task: expected none without --scheduler"),
     (["--scheduler", "tcp://127.0.0.1:9", "--workers", "2"], "--workers: expected none with --scheduler"),
     (["--scheduler", "missing.json"], "missing.json: there is no such file; start `dask scheduler"),
     (["--scheduler", "tcp://127.0.0.1:9"], "tcp://127.0.0.1:9: none answers"),
     (["--threads-per-clip", "1"], "--threads-per-clip: expected at least 2")],
)  # fmt: skip
@pytest.mark.needs("distributed")
def test_the_command_refuses_in_words(
    words: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("jaxdn.commands.scheduler._CONNECT_S", 0.3)
    out = tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        main.main(["render", "edge", "-o", str(out), "--frames", "1", "--width", "8", "--height", "8", *words])
    assert ended.value.code == 2
    assert told in capsys.readouterr().err
    assert not out.exists()


def test_ranges_of_a_clip_are_bit_equal_to_the_whole(tmp_path: Path) -> None:
    settings = replace(SETTINGS, reference_spp=2)
    render_clip(Stage(), tmp_path / "whole", settings, frames=4)
    seen: list[int] = []
    render_clip(Stage(), tmp_path / "parts", settings, frames=4, only=range(2, 4), progress=seen.append)
    assert seen == [2, 3]
    assert not is_clip(tmp_path / "parts")
    assert not finish_clip(tmp_path / "parts")
    render_clip(Stage(), tmp_path / "parts", settings, frames=4, only=range(0, 2))
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    with pytest.raises(ValueError, match="only: expected frames from 0 to 3"):
        render_clip(Stage(), tmp_path / "parts", settings, frames=4, only=range(3, 5))


def test_samples_that_are_not_finite_are_counted_over_all_ranges(tmp_path: Path) -> None:
    settings = replace(SETTINGS, reference_spp=2)
    render_clip(Stage(), tmp_path, settings, frames=3, only=range(0, 1))
    for frame, count in ((0, 5), (1, 7), (1, 7)):  # the second frame was rendered again after a kill
        note_bad_samples(tmp_path, frame, count)
    render_clip(Stage(), tmp_path, settings, frames=3, only=range(1, 3))
    record = read_record(tmp_path)
    assert record["bad_samples"] == 12
    assert sorted(contents(tmp_path)) == ["clip.json", *(f"frame_{frame:04d}.exr" for frame in range(3))]


def test_a_renderer_that_is_killed_after_another_has_finished_the_clip_leaves_it(tmp_path: Path) -> None:
    settings = replace(SETTINGS, reference_spp=2)

    def overtaken(frame: int) -> None:
        if frame == 1:  # the other one finishes the clip, and removes what it has finished
            render_clip(Stage(), tmp_path, settings, frames=3)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_clip(Stage(), tmp_path, settings, frames=3, progress=overtaken)
    assert is_clip(tmp_path)
    assert sorted(contents(tmp_path)) == ["clip.json", *(f"frame_{frame:04d}.exr" for frame in range(3))]
