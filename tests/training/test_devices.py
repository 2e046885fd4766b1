"""A batch divided among eight devices: the weights of one device, and one exchange of gradients an update."""

import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from jaxdn.commands import main
from jaxdn.training.devices import make_mesh
from tests import compiling
from tests.compiling import join_flags

ROOT = Path(__file__).parents[2]

# Compiled without LLVM's expensive passes: what is exchanged is decided before.
FLAGS = join_flags(
    compiling.FLAGS,
    "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true --xla_dump_hlo_module_re=train_step --xla_dump_to=",
)

PROGRAM = """
import json, sys
from pathlib import Path
import jax, numpy as np
from jaxdn.clips import training_batches, write_clip
from jaxdn.denoisers import ntd
from jaxdn.methods.registry import method_named
from jaxdn.training.devices import make_mesh
from jaxdn.training.loop import Every, fit
from tests.training.test_loop import SHORT, Stopping
from tests.training.test_training import TINY, gain, make_clip

def main(folder):
    for seed in range(4):
        write_clip(make_clip(seed, size=24, frames=3), folder / "clips" / f"clip-{seed}")
    shape = {"steps": 3, "batch": 8, "crop": 16, "frames": 2, "rematerialize": False}
    network = ntd(size=TINY, prediction="direct"), method_named("ntd").recipe_named(None)
    number = gain(), SHORT

    def run(name, what, devices, updates=3):
        denoiser, recipe = what[0], what[1]._replace(**shape)
        batches = training_batches(
            folder / "clips", batch=8, crop=16, frames=2, seed=0, buffers=denoiser.reads | recipe.objective.reads
        )
        source = Stopping(batches, updates + 1)  # one more gives the shapes
        every = Every(1, checkpoint=1)
        try:
            state = fit(denoiser, recipe, source, folder / name, label=name, every=every, devices=devices)
        except KeyboardInterrupt:
            return None
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves((state.params, state.average))])

    def compare(one, many):
        return float(np.linalg.norm(many - one) / np.linalg.norm(one))

    one, eight = run("network-1", network, 1), run("network-8", network, 8)
    whole = run("number", number, 1)
    for devices, updates in ((2, 1), (8, 1)):  # a run goes on with another number of devices each time
        assert run("moved", number, devices, updates) is None
    moved = run("moved", number, 1)
    try:
        make_mesh(8, 12)
    except ValueError as error:
        refused = str(error)
    told = {"network": compare(one, eight), "moved": compare(whole, moved), "weights": one.size // 2}
    (folder / "told.json").write_text(json.dumps(told | {"refused": refused}))

if __name__ == "__main__":
    main(Path(sys.argv[1]))
"""

KINDS = "all-reduce|all-gather|all-to-all|collective-permute|reduce-scatter|collective-broadcast"


def find_exchanges(text: str) -> list[tuple[str, int, bool]]:
    """Each exchange of a compiled program: its kind, the bytes of its result, whether a loop repeats it."""
    calls, found, current = defaultdict(set), [], ""
    for line in text.splitlines():
        if begun := re.match(r"^(?:ENTRY )?%?([\w.\-]+) .*\{$", line):
            current = begun[1]
        for called in re.findall(r"(?:calls|to_apply|body|condition|branch_computations)=\{?%?([\w.\-]+)", line):
            calls[current].add(called)
        if one := re.search(rf"= (.*?) ({KINDS})(?:-start)?\(", line):
            shapes = re.findall(r"f32\[([\d,]*)\]", one[1])
            size = sum(4 * int(np.prod([int(side) for side in shape.split(",") if side])) for shape in shapes)
            found.append((current, one[2], size))
    repeated, left = set(), set(re.findall(r"body=%?([\w.\-]+)", text))
    while left:
        name = left.pop()
        repeated.add(name)
        left |= calls[name] - repeated
    return [(kind, size, where in repeated) for where, kind, size in found]


@pytest.mark.slow
def test_eight_devices_learn_what_one_does_with_one_exchange_an_update(tmp_path):
    environment = os.environ | {
        "XLA_FLAGS": FLAGS + str(tmp_path / "programs"),
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["refused"] == "batch: expected a multiple of the 8 devices, got 12; change one of them."
    assert told["network"] < 1e-6
    assert told["moved"] < 1e-6
    programs = sorted((tmp_path / "programs").glob("*train_step*after_optimizations.txt"))
    alone, eight, *_ = [find_exchanges(program.read_text()) for program in programs]
    assert alone == []
    ((kind, size, repeated),) = eight
    assert kind == "all-reduce"
    assert 4 * told["weights"] < size <= 4 * told["weights"] + 64
    assert not repeated


def test_a_number_of_devices_that_does_not_fit_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main.main(["train", str(tmp_path / "clips"), "-o", str(tmp_path / "run"), "--devices", "4096"])
    assert ended.value.code == 2
    assert "devices: expected 1 to " in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    with pytest.raises(ValueError, match="devices: expected 1 to"):
        make_mesh(0, 8)
    assert make_mesh(1, 7) is None
