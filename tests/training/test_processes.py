"""Training in several processes: real ones, with the weights of one process; stopped, killed and gone on from."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from jaxdn.clips import write_clip
from jaxdn.commands import main
from jaxdn.training.log import read_log
from jaxdn.training.loop import read_resumed_from
from tests.compiling import join_flags
from tests.training.test_training import make_clip

pytestmark = pytest.mark.usefixtures("plain_processes")  # what processes exchange does not depend on optimisation
ROOT = Path(__file__).parents[2]
UPDATES = 5

# The method of another package, which compiles at once. It says which files its process opens to write.
METHOD = '''
import os, sys
from dataclasses import dataclass
import jax, jax.numpy as jnp
from jaxdn import Core, recurrent
from jaxdn.methods.registry import method
from jaxdn.recipes.objectives import Objective
from jaxdn.recipes.recipe import Recipe

def told(event, arguments):
    if event == "open" and isinstance(arguments[1], str) and set(arguments[1]) & set("wax"):
        print("writes", arguments[0], file=sys.stderr)

sys.addaudithook(told)

@dataclass(frozen=True)
class Options:
    width: int = 3

def squares(images, clip, progress):
    return jnp.mean((images - clip.reference) ** 2)

@method(Options, title="A learned kernel", recipes={"usual": Recipe(Objective("squares", squares), decay=False)})
def kernel(options):
    """A kernel."""
    def step(params, state, frame, first, statistics):
        image = jax.lax.conv_general_dilated(
            frame.radiance[None], params["kernel"], (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))[0]
        image = 0.5 * (image + jnp.where(first, image, state))
        return image, image, 0
    def init(key, frame):
        return {"kernel": 0.2 * jax.random.normal(key, (options.width, options.width, 3, 3))}
    return recurrent(Core(lambda params, frame: frame.radiance, step, frozenset(), init))
'''

ALONE = """
import sys
from jaxdn.commands.main import main
for run in sys.argv[1:]:
    main(run.split("|"))
"""


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def have_devices(count: int) -> str:
    """``XLA_FLAGS`` of a process with so many devices."""
    return join_flags(os.environ.get("XLA_FLAGS"), f"--xla_force_host_platform_device_count={count}")


def give(clips: Path, run: Path, *more: object) -> list[str]:
    options = ["--method", "learned_kernel:kernel", "--batch", "8", "--crop", "16", "--frames", "2"]
    return ["train", str(clips), "-o", str(run), *options, *map(str, more)]


class Pair:
    """Two processes of one run."""

    def __init__(
        self, home: Path, arguments: Sequence[str], *, second: Sequence[object] = (), devices: tuple[int, int] = (1, 1)
    ) -> None:
        """``second``: what only the second is told besides; ``devices``: how many each of them has."""
        place = f"127.0.0.1:{free_port()}"
        environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": f"{ROOT}{os.pathsep}{home}"}
        self.errors = [home / f"errors-{time.monotonic_ns()}-{index}" for index in range(2)]
        self.processes = []
        for index, errors in enumerate(self.errors):
            command = [sys.executable, "-m", "jaxdn.commands.main", *arguments, "--distributed"]
            command += ["--coordinator", place, "--processes", "2", "--process", str(index)]
            command += [str(word) for word in second if index == 1]
            own = environment | {"XLA_FLAGS": have_devices(devices[index])}
            with errors.open("w") as out:
                self.processes.append(subprocess.Popen(command, env=own, stdout=out, stderr=out))

    def wait_for(self, run: Path, step: int) -> None:
        end = time.monotonic() + 300
        while not any(entry["step"] >= step for entry in read_log(run / "log.jsonl")):
            assert all(process.poll() is None for process in self.processes), self.tell()
            assert time.monotonic() < end, self.tell()
            time.sleep(0.05)

    def end(self, seconds: float = 300) -> list[int]:
        """The exit codes."""
        end = time.monotonic() + seconds
        try:
            return [process.wait(max(0.1, end - time.monotonic())) for process in self.processes]
        except subprocess.TimeoutExpired as error:
            raise AssertionError(self.tell()) from error
        finally:
            for process in self.processes:
                process.kill()

    def tell(self) -> str:
        return "\n".join(path.read_text()[-3000:] for path in self.errors)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("processes")
    for seed in range(4):
        write_clip(make_clip(seed, size=20, frames=4), home / "clips" / f"clip-{seed}")
    (home / "learned_kernel.py").write_text(METHOD)
    return home


def run_alone(home: Path, *runs: Sequence[str]) -> None:
    """Runs one after the other in one process of eight devices."""
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": have_devices(8),
        "PYTHONPATH": f"{ROOT}{os.pathsep}{home}",
    }
    command = [sys.executable, "-c", ALONE, *("|".join(run) for run in runs)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def weights(run: Path) -> np.ndarray:
    arrays = load_file(run / "weights.safetensors")
    return np.concatenate([np.ravel(arrays[name]) for name in sorted(arrays)])


def distance(run: Path, other: Path) -> float:
    return float(np.linalg.norm(weights(run) - weights(other)) / np.linalg.norm(weights(other)))


@pytest.mark.slow
def test_two_processes_and_any_number_of_devices_learn_the_same(home: Path) -> None:
    pair = Pair(home, give(home / "clips", home / "two", "--steps", UPDATES, "--validation", home / "clips"))
    assert pair.end() == [0, 0], pair.tell()
    first, second = (path.read_text() for path in pair.errors)
    assert f"writes {home / 'two'}" in first
    assert f"{home / 'two'}" not in second
    assert "step 5/5" in first
    assert "step" not in second
    steps = ("--steps", UPDATES)
    run_alone(
        home,
        give(home / "clips", home / "one", *steps),
        give(home / "clips", home / "devices-2", *steps, "--devices", 2),
        give(home / "clips", home / "devices-8", *steps, "--devices", 8),
        give(home / "clips", home / "moved", "--steps", 1),
    )
    moved = Pair(home, give(home / "clips", home / "moved", "--steps", 3), devices=(2, 2))
    assert moved.end() == [0, 0], moved.tell()
    run_alone(home, give(home / "clips", home / "moved", *steps, "--devices", 8))
    assert read_resumed_from(home / "moved") == [1, 3]
    assert np.ptp(weights(home / "one")) > 0.1
    for name in ("two", "devices-2", "devices-8", "moved"):
        assert distance(home / name, home / "one") < 1e-6, name
    one, two = (read_log(home / name / "log.jsonl") for name in ("one", "two"))
    assert [entry["loss"] for entry in one if "loss" in entry] == pytest.approx(
        [entry["loss"] for entry in two if "loss" in entry], rel=1e-6
    )
    assert [entry["step"] for entry in two if "validation_psnr" in entry] == [UPDATES]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of Unix")
def test_a_signal_at_one_process_stops_both_and_a_lost_one_ends_the_other(home: Path) -> None:
    long = give(home / "clips", home / "long", "--steps", 10**6)
    pair = Pair(home, long)
    pair.wait_for(home / "long", 20)
    pair.processes[1].send_signal(signal.SIGTERM)
    assert pair.end() == [143, 143], pair.tell()
    saved = max(int(path.name) for path in (home / "long" / "checkpoints").iterdir())
    assert f"stopped after {saved} of 1000000 steps; the same command continues there" in pair.tell()

    again = Pair(home, long)
    again.wait_for(home / "long", saved + 21)
    again.processes[0].send_signal(signal.SIGINT)
    assert again.end() == [130, 130], again.tell()
    newer = max(int(path.name) for path in (home / "long" / "checkpoints").iterdir())
    assert newer > saved

    killed = Pair(home, long)
    killed.wait_for(home / "long", newer + 101)
    killed.processes[1].kill()
    codes = killed.end(120)
    assert codes[1] == -signal.SIGKILL
    assert codes[0] in (1, 134, -signal.SIGABRT), killed.tell()
    newest = max(int(path.name) for path in (home / "long" / "checkpoints").iterdir() if path.name.isdigit())
    assert newest > newer
    run_alone(home, give(home / "clips", home / "long", "--steps", 10**6, "--time-limit", "0.00001"))
    assert json.loads((home / "long" / "weights.json").read_text())["updates"] == newest


@pytest.mark.slow
def test_processes_that_are_not_given_the_same_are_refused(home: Path) -> None:
    run = give(home / "clips", home / "unlike", "--steps", 2)
    unlike = Pair(home, run, second=("--learning-rate", 0.5, "--start", home / "nothing.safetensors"))
    assert unlike.end(120) == [2, 2], unlike.tell()
    uneven = Pair(home, run, devices=(2, 1))
    assert uneven.end(120) == [2, 2], uneven.tell()
    told = [[" ".join(path.read_text().split()) for path in pair.errors] for pair in (unlike, uneven)]
    assert all("got another start, learning_rate in one of them" in each for each in told[0])
    assert all("devices: expected as many in each process, got 2, 1; give --devices 1" in each for each in told[1])
    assert not any("Traceback" in each for pair in told for each in pair)
    assert not (home / "unlike").exists()


@pytest.mark.slow
def test_an_error_of_one_process_is_told_there_and_ends_the_other(home: Path) -> None:
    run = give(home / "clips", home / "failing", "--steps", 2)
    of_first = Pair(home, [*run, "--validation", str(home / "nothing")])  # which the first alone reads
    of_second = Pair(home, run, second=("--implementation", "nothing"))
    for pair, failing, what in ((of_first, 0, "nothing: there is no such folder"), (of_second, 1, "'implementation'")):
        codes = pair.end(120)
        assert codes[failing] == 2, pair.tell()
        assert codes[1 - failing] in (1, 134, -signal.SIGABRT), pair.tell()
        told = pair.errors[failing].read_text()
        assert what in told.partition("jaxdn: ")[2]
        assert "stack trace" not in told


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        (["--coordinator", "127.0.0.1:1"], "expected --distributed too"),
        (["--distributed", "--coordinator", "127.0.0.1:1"], "expected all of --coordinator, --processes and --process"),
        (
            ["--distributed", "--coordinator", "head", "--processes", "2", "--process", "0"],
            "--coordinator: expected HOST:PORT, such as head:5731, got head",
        ),
        (["--scale-rate", "linear", "--learning-rate", "0.1"], "--scale-rate: expected none with --learning-rate"),
    ],
)
def test_what_does_not_fit_together_is_refused(
    more: list[str], problem: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main.main(["train", str(tmp_path / "clips"), "-o", str(tmp_path / "run"), *more])
    assert ended.value.code == 2
    assert problem in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


def start_joined(port: int, work: str, *, processes: int = 1, process: int = 0) -> subprocess.Popen[str]:
    """A process of a run, which does some work."""
    program = f"""
import time
import jax, jax.numpy as jnp
from jaxdn.commands.distributed import Place, join_processes
from jaxdn.commands.errors import plain_errors
from jaxdn.runtime.interrupt import Stopped, Terminated, exit_on_interrupt

def stop(value):
    raise KeyboardInterrupt

with exit_on_interrupt(), plain_errors(), join_processes(Place("localhost:{port}", {processes}, {process})):
    {work}
"""
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    run = [sys.executable, "-c", program]
    return subprocess.Popen(run, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def run_joined(port: int, work: str) -> subprocess.CompletedProcess[str]:
    """The one process of a run."""
    with start_joined(port, work) as process:
        out, errors = process.communicate(timeout=120)
        return subprocess.CompletedProcess([], process.returncode, out, errors)


@pytest.mark.parametrize(("late", "stopped", "code"), [(1, "Stopped", 130), (0, "Terminated", 143)])
def test_processes_that_stop_together_wait_for_the_last_to_leave(late: int, stopped: str, code: int) -> None:
    port = free_port()
    works = [f"time.sleep({3 * (index == late)}); raise {stopped}" for index in range(2)]
    pair = [start_joined(port, work, processes=2, process=index) for index, work in enumerate(works)]
    told = [process.communicate(timeout=120)[1] for process in pair]
    assert [process.returncode for process in pair] == [code, code], told


@pytest.mark.parametrize(
    ("work", "code", "told"),
    [
        ("print(jnp.zeros(1 << 50, jnp.int8)[0])", 1, "RESOURCE_EXHAUSTED"),
        ("jax.jit(lambda x: jax.pure_callback(stop, x, x))(jnp.ones(3)).block_until_ready()", 130, "interrupted"),
    ],
)
def test_full_memory_and_an_interrupted_callback_are_not_blamed_on_other_processes(
    work: str, code: int, told: str
) -> None:
    done = run_joined(free_port(), work)
    assert done.returncode == code, done.stderr
    assert told in done.stderr
    assert "another process" not in done.stderr


def test_an_exchange_that_fails_in_another_way_is_a_lost_process() -> None:
    done = run_joined(free_port(), "raise ValueError('UNKNOWN: Gloo AllGather failed: Connection reset by peer')")
    assert done.returncode == 1, done.stderr
    assert "another process of this run has gone" in done.stderr


def test_a_port_that_is_taken_is_one_message() -> None:
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        done = run_joined(taken.getsockname()[1], "print('joined')")
    assert done.returncode == 2
    assert "jaxdn: --coordinator: expected a free port of process 0's machine, got localhost:" in done.stderr
    assert "Traceback" not in done.stderr
    assert "joined" not in done.stdout
