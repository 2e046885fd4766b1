"""The templates of examples/farm: chunks of a shot, run by what they are for, are the whole shot."""

import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import tyro

from jaxdn.clips import write_clip
from jaxdn.commands.arguments import COMMANDS
from tests.needs import require, require_module
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
    run(*JAXDN.split(), "denoise", shot, "-o", whole, "--method", "taa")
    parameters = {"Input": shot, "Output": chunks, "Frames": "0-5", "ChunkSize": "3", "Method": "taa", "Jaxdn": JAXDN}
    options = [word for name, value in parameters.items() for word in ("-p", f"{name}={value}")]
    said = run(sys.executable, "-m", "openjd", "run", FARM / "openjd.yaml", *options)
    assert "Chunks run: 2" in said
    assert [said.count(f"openjd_progress: {share}") for share in ("33.3", "66.7", "100.0")] == [2, 2, 2]
    # The second chunk reads the frames before it, of which there are fewer than 16.
    files = {path.name: path.read_bytes() for path in Path(whole).iterdir()}
    assert sum(name.endswith(".exr") for name in files) == 6
    assert {path.name: path.read_bytes() for path in Path(chunks).iterdir()} == files
    slurm = {"SLURM_ARRAY_TASK_ID": "1", "CHUNK": "3", "FIRST": "0", "METHOD": "taa", "JAXDN": JAXDN}
    said = run("bash", FARM / "slurm.sh", shot, chunks, **slurm)
    assert "3 frames are there already" in said
    assert "nothing to do" in said


def test_the_openjd_template_is_one():
    require("openjd")
    assert "passes validation checks" in run(sys.executable, "-m", "openjd", "check", FARM / "openjd.yaml")


def read_denoise(words: list[str]) -> list[str]:
    """What the frames are of a command that denoises /shots/a into /denoised/a and leaves out what is there."""
    options = tyro.cli(COMMANDS, args=words)
    assert (options.clips, options.out) == ([Path("/shots/a")], Path("/denoised/a"))
    assert options.skip_existing
    return list(options.frames)


def test_deadline_is_given_what_it_documents_and_a_command_that_jaxdn_reads():
    require("bash")
    farm = {"DEADLINE": "printf %s\\n", "CHUNK": "48"}
    job, *words = run("bash", FARM / "deadline.sh", "/shots/a", "/denoised/a", "1-400", **farm).splitlines()
    given = dict(zip(words[::2], words[1::2], strict=True))
    # The words of Deadline 10's manual, Manual Job Submission.
    assert job == "-SubmitCommandLineJob"
    assert list(given) == ["-executable", "-arguments", "-frames", "-chunksize", "-name"]
    assert (given["-executable"], given["-frames"], given["-chunksize"]) == ("jaxdn", "1-400", "48")
    assert set(re.findall("<.*?>", given["-arguments"])) == {"<QUOTE>", "<STARTFRAME>", "<ENDFRAME>"}
    words = given["-arguments"].replace("<QUOTE>", "").replace("<STARTFRAME>", "1").replace("<ENDFRAME>", "48").split()
    assert read_denoise(words) == ["1-48"]


FLAMENCO = """
const fs = require("fs"), vm = require("vm");
// Sorted frames in chunks; of consecutive ones three or more are a range.
function frameChunker(range, size) {
  const frames = range.split(",").flatMap((part) => {
    const [first, last = first] = part.split("-").map(Number);
    return Array.from({ length: last - first + 1 }, (_, step) => first + step);
  });
  const chunks = [];
  for (let from = 0; from < frames.length; from += size) {
    const runs = [];
    for (const frame of frames.slice(from, from + size)) {
      if (runs.length && runs.at(-1).at(-1) === frame - 1) runs.at(-1).push(frame);
      else runs.push([frame]);
    }
    chunks.push(runs.map((run) => (run.length > 2 ? `${run[0]}-${run.at(-1)}` : run.join(","))).join(","));
  }
  return chunks;
}
const author = {
  Task: (name, type) => ({ name, type, commands: [], addCommand(command) { this.commands.push(command); } }),
  Command: (name, parameters) => ({ name, parameters }),
};
const job = { settings: JSON.parse(process.argv[2]), tasks: [], addTask(task) { this.tasks.push(task); } };
const scope = vm.createContext({ frameChunker, author, job });
vm.runInContext(fs.readFileSync(process.argv[1], "utf8"), scope);
const type = vm.runInContext("JOB_TYPE", scope);
for (const { key, default: usual } of type.settings) job.settings[key] ??= usual;
vm.runInContext("compileJob(job)", scope);
console.log(JSON.stringify({ type, tasks: job.tasks }));
"""


def test_flamenco_is_given_tasks_that_jaxdn_reads():
    require("node")
    settings = {"input": "/shots/a", "output": "/denoised/a", "frames": "1-10,20", "chunk_size": 4}
    said = json.loads(run("node", "-e", FLAMENCO, "--", FARM / "flamenco.js", json.dumps(settings)))
    assert {setting["type"] for setting in said["type"]["settings"]} <= {"string", "int32", "float", "bool"}
    assert {task["type"] for task in said["tasks"]} == {"misc"}  # a worker runs it without being configured
    commands = [command for task in said["tasks"] for command in task["commands"]]
    assert {(command["name"], command["parameters"]["exe"]) for command in commands} == {("exec", "jaxdn")}
    read = [read_denoise(command["parameters"]["args"]) for command in commands]
    assert read == [["1-4"], ["5-8"], ["9", "10", "20"]]


def test_kubernetes_is_given_commands_that_jaxdn_reads():
    require("bash")
    jobs = list(require_module("yaml").safe_load_all((FARM / "kubernetes.yaml").read_text()))
    said = {}
    for job in jobs:
        assert job["spec"]["completionMode"] == "Indexed"
        (container,) = job["spec"]["template"]["spec"]["containers"]
        shell, option, command = container["command"]
        assert (shell, option, command[:11]) == ("sh", "-c", "exec jaxdn ")
        told = run("sh", "-c", command.replace("exec jaxdn", "echo"), JOB_COMPLETION_INDEX="1")
        said[job["metadata"]["name"]] = told.replace("/shared/", "/").split()
    assert read_denoise(said["denoise-shot"]) == ["201-400"]
    rendered = tyro.cli(COMMANDS, args=said["render-parlour"])
    assert (rendered.scene, rendered.out, rendered.seeds) == ("parlour", Path("/train"), ["1"])


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
