"""The templates of examples/farm: chunks of a shot, run by what they are for, are the whole shot."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import tyro

from jaxdn.clips import write_clip
from jaxdn.commands.arguments import COMMANDS
from tests.needs import require
from tests.training.test_training import make_clip

ROOT = Path(__file__).parents[2]
FARM = ROOT / "examples" / "farm"
JAXDN = f"{sys.executable} -m jaxdn.commands.main"


def run(*command: str | Path, **environment: str) -> str:
    """What a command prints; it has to end with 0."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"} | environment
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_a_shot_in_chunks_by_openjd_is_the_whole_shot_and_a_slurm_array_has_nothing_left_to_do(tmp_path):
    require("openjd", "bash")
    shot, whole, chunks = (str(tmp_path / name) for name in ("shot", "whole", "chunks"))
    write_clip(make_clip(0, frames=6, size=40), shot)
    run(*JAXDN.split(), "denoise", shot, "-o", whole, "--method", "svgf")
    parameters = {"Input": shot, "Output": chunks, "Frames": "0-5", "ChunkSize": "3", "Method": "svgf", "Jaxdn": JAXDN}
    options = [word for name, value in parameters.items() for word in ("-p", f"{name}={value}")]
    said = run(sys.executable, "-m", "openjd", "run", FARM / "openjd.yaml", *options)
    assert "Chunks run: 2" in said
    assert [said.count(f"openjd_progress: {share}") for share in ("33.3", "66.7", "100.0")] == [2, 2, 2]
    # The second chunk reads the frames before it, of which there are fewer than 16.
    files = {path.name: path.read_bytes() for path in Path(whole).iterdir()}
    assert sum(name.endswith(".exr") for name in files) == 6
    assert {path.name: path.read_bytes() for path in Path(chunks).iterdir()} == files
    slurm = {"SLURM_ARRAY_TASK_ID": "1", "CHUNK": "3", "FIRST": "0", "METHOD": "svgf", "JAXDN": JAXDN}
    said = run("bash", FARM / "slurm.sh", shot, chunks, **slurm)
    assert "3 frames are there already" in said
    assert "nothing to do" in said


def test_the_openjd_template_is_one():
    require("openjd")
    assert "passes validation checks" in run(sys.executable, "-m", "openjd", "check", FARM / "openjd.yaml")


def test_deadline_is_given_a_command_that_jaxdn_reads():
    require("bash")
    said = run("bash", FARM / "deadline.sh", "/shots/a", "/denoised/a", "1-400", DEADLINE="echo", CHUNK="48")
    assert "-chunksize 48 " in said
    assert "-frames 1-400 " in said
    words = said.split("-arguments ")[1].split(" -frames 1-400")[0]
    words = words.replace("<QUOTE>", "").replace("<STARTFRAME>", "1").replace("<ENDFRAME>", "48").split()
    options = tyro.cli(COMMANDS, args=words)
    assert (options.clips, options.out, options.frames) == ([Path("/shots/a")], Path("/denoised/a"), ["1-48"])
    assert options.skip_existing


PROGRAM = """
from pathlib import Path
from jaxdn.commands.progress import reporter
with reporter("svgf") as report:
    for done in (1, 2):
        report.on_frame(Path("a.exr"), done, 2)
        input()
"""


def test_progress_goes_through_a_pipe_line_by_line():
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAXDN_PROGRESS": "openjd"}
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    watchdog = threading.Timer(120, process.kill)  # a line that is kept back would be waited for without end
    watchdog.start()
    told = []
    for _ in range(2):
        told += [process.stdout.readline(), process.stdout.readline()]
        process.stdin.write("\n")
        process.stdin.flush()
    assert process.wait() == 0
    watchdog.cancel()
    assert told[0].startswith("frame 1 of 2: a.exr, ")
    assert told[0].endswith("; Progress: 50%\n")
    assert told[1] == "openjd_progress: 50.0\n"
    assert told[2].endswith("; Progress: 100%\n")
    assert told[3] == "openjd_progress: 100.0\n"
