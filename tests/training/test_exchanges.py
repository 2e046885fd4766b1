"""What eight devices exchange in an update of kernels that XLA does not know: the gradient, once."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.compiling import FLAGS, join_flags
from tests.training.test_devices import ROOT, find_exchanges

# Only compiled, without LLVM's expensive passes: what is exchanged is decided before.
PROGRAM = """
import json, sys
import jax, numpy as np
from jax.sharding import NamedSharding
from jaxdn.methods.registry import method_named
from jaxdn.training.devices import DIVIDED, ON_ALL, make_mesh
from jaxdn.training.step import init_state, make_train_step
from tests.training.test_training import TINY, make_clip

name, options, out = sys.argv[1:]
method = method_named(name)
denoiser = method.factory(**{"size" if name == "ntd" else "quality": TINY, **json.loads(options)})
recipe = method.recipe_named(None)._replace(steps=5, batch=8, crop=32, frames=2, rematerialize=False)
batch = jax.tree.map(lambda leaf: np.stack([leaf] * 8), make_clip(0, size=32, frames=2))
mesh = make_mesh(8, recipe.batch)

def shapes(tree, spec):
    place = NamedSharding(mesh, spec)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), tree)

state = jax.eval_shape(lambda: init_state(denoiser, recipe, batch))
step = make_train_step(denoiser, recipe, mesh)
text = step.lower(shapes(state, ON_ALL), shapes(batch, DIVIDED)).compile().as_text()
open(out, "w").write(text)
print(sum(leaf.size for leaf in jax.tree.leaves(state.params)))
"""


def compile_update(name: str, options: str, out: Path) -> tuple[int, str]:
    """The number of weights, and the compiled update of one of eight devices."""
    environment = os.environ | {
        "XLA_FLAGS": join_flags(
            FLAGS,
            "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0",
            "--xla_llvm_disable_expensive_passes=true",
        ),
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-c", PROGRAM, name, options, str(out)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return int(done.stdout), out.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "kernels"),
    [
        pytest.param("ntd", '{"implementation": "onednn"}', "callback", marks=pytest.mark.needs("onednn")),
        pytest.param("steady", "{}", "host_call", marks=pytest.mark.needs("numba")),
    ],
)
def test_eight_devices_exchange_the_gradient_and_nothing_else(
    name: str, options: str, kernels: str, tmp_path: Path
) -> None:
    weights, text = compile_update(name, options, tmp_path / "update.txt")
    assert re.search(rf'custom_call_target="\w*{kernels}', text)  # XLA cannot divide it
    assert "while(" in text  # over frames, of which no exchange is a part
    ((kind, size, repeated),) = find_exchanges(text)
    assert kind == "all-reduce"
    assert 4 * weights < size <= 4 * weights + 64
    assert not repeated
