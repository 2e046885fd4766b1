"""What eight devices exchange in an update of kernels that XLA does not know, and in one without: the gradient, once.

Of a filter without its compiled loops the program that XLA is given is read: there the exchanges stand as jax asked for
them. XLA makes one of them (:func:`find_exchanges` holds it for the others), and adds none, as it does not divide what
``shard_map`` has divided. The filter stands for all: what is exchanged is the update's, whatever a method computes.
"""

import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from tests.compiling import FLAGS, join_flags
from tests.training.test_devices import ROOT, find_exchanges

# Only lowered or compiled, without LLVM's expensive passes: what is exchanged is decided before.
PROGRAM = """
import json, sys
import jax, numpy as np
from jax.sharding import NamedSharding
from jaxdn.methods.registry import method_named
from jaxdn.training.devices import DIVIDED, ON_ALL, make_mesh
from jaxdn.training.step import init_state, make_train_step
from tests.training.test_exchanges import find_exchanges_asked_for
from tests.training.test_training import TINY, make_clip

name, options, out, asked_for = sys.argv[1:]
method = method_named(name)
small = {"ntd": {"size": TINY}, "steady": {"quality": TINY}, "svgf": {"levels": 2}}
denoiser = method.factory(**small[name], **json.loads(options))
recipe = method.recipe_named(None)._replace(steps=5, batch=8, crop=32, frames=2, rematerialize=False)
batch = jax.tree.map(lambda leaf: np.stack([leaf] * 8), make_clip(0, size=32, frames=2))
mesh = make_mesh(8, recipe.batch)

def shapes(tree, spec):
    place = NamedSharding(mesh, spec)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=place), tree)

state = jax.eval_shape(lambda: init_state(denoiser, recipe, batch))
step = make_train_step(denoiser, recipe, mesh)
lowered = step.lower(shapes(state, ON_ALL), shapes(batch, DIVIDED))
open(out, "w").write((lowered if asked_for else lowered.compile()).as_text())
asked = find_exchanges_asked_for(lowered.compiler_ir("stablehlo")) if asked_for else None
print(json.dumps({"weights": [leaf.size for leaf in jax.tree.leaves(state.params)], "asked": asked}))
"""


def make_update(name: str, options: str, out: Path, *, asked_for: bool = False, **variables: str) -> dict[str, Any]:
    """The sizes of the weights; writes the compiled update of one of eight devices.

    Or, ``asked_for``, that before it is compiled, and adds what :func:`find_exchanges_asked_for` finds in it.
    """
    environment = os.environ | {
        "XLA_FLAGS": join_flags(
            FLAGS,
            "--xla_force_host_platform_device_count=8 --xla_backend_optimization_level=0",
            "--xla_llvm_disable_expensive_passes=true",
        ),
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
        **variables,
    }
    command = [sys.executable, "-c", PROGRAM, name, options, str(out), "yes" if asked_for else ""]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


ASKED = "all_reduce|all_gather|all_to_all|collective_permute|reduce_scatter|collective_broadcast"


def find_exchanges_asked_for(module: Any) -> list[tuple[str, int, bool]]:
    """Each exchange of a program before it is compiled: its kind, the bytes of its result, whether a loop repeats it.

    ``module``: as ``lowered.compiler_ir("stablehlo")`` gives it.
    """
    calls, found = defaultdict(set), []

    def walk(operation: Any, function: str, *, repeated: bool) -> None:
        name = operation.name
        if name == "func.func":
            function = operation.attributes["sym_name"].value
        elif name in ("call", "func.call"):
            calls[function].add((operation.attributes["callee"].value, repeated))
        elif kind := re.fullmatch(rf"stablehlo\.({ASKED})", name):
            shapes = [re.fullmatch(r"tensor<((?:\d+x)*)f32>", str(result.type)) for result in operation.results]
            size = sum(4 * int(np.prod([int(side) for side in shape[1].split("x") if side])) for shape in shapes)
            found.append((function, kind[1], size, repeated))
        for region in operation.regions:
            for block in region.blocks:
                for one in block.operations:
                    walk(one.operation, function, repeated=repeated or name == "stablehlo.while")

    walk(module.operation, "", repeated=False)
    in_loops: set[str] = set()
    left = {name for some in calls.values() for name, repeated in some if repeated}
    while left:
        function = left.pop()
        in_loops.add(function)
        left |= {name for name, _ in calls[function]} - in_loops
    return [(kind, size, repeated or function in in_loops) for function, kind, size, repeated in found]


def test_an_exchange_in_a_loop_is_found() -> None:
    @jax.jit
    def mean(values: jax.Array) -> jax.Array:
        return jax.lax.pmean(values, "all")

    def work(values: jax.Array) -> jax.Array:
        once = jax.lax.psum(values[0], "all")
        looped = jax.lax.scan(lambda sums, one: (mean(sums) + one, one), values[0], values)[0]
        return once + looped + jax.lax.all_gather(values, "all").sum()

    mesh = jax.make_mesh((1,), ("all",))
    divide = partial(jax.shard_map, mesh=mesh, in_specs=PartitionSpec(), out_specs=PartitionSpec(), check_vma=False)
    module = jax.jit(divide(work)).lower(jnp.ones((3, 2))).compiler_ir("stablehlo")
    found = sorted(find_exchanges_asked_for(module))
    assert found == [("all_gather", 24, False), ("all_reduce", 8, False), ("all_reduce", 8, True)]


@pytest.mark.slow
def test_a_filter_without_compiled_loops_asks_for_the_gradient_and_nothing_else(tmp_path: Path) -> None:
    given = make_update("svgf", "{}", tmp_path / "update.txt", asked_for=True, JAXDN_IMPLEMENTATION="reference")
    text = (tmp_path / "update.txt").read_text()
    assert "host_call" not in text
    assert "stablehlo.while" in text  # over frames, of which no exchange is a part
    sizes = [4 * size for size in (*given["weights"], 1, 1)]  # the loss and its PSNR are exchanged, too
    assert sorted(given["asked"]) == sorted(["all_reduce", size, False] for size in sizes)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "kernels"),
    [
        pytest.param(
            "ntd", '{"implementation": "onednn", "prediction": "direct"}', "callback", marks=pytest.mark.needs("onednn")
        ),
        pytest.param("steady", "{}", "host_call", marks=pytest.mark.needs("numba")),
    ],
)
def test_eight_devices_exchange_the_gradient_and_nothing_else(
    name: str, options: str, kernels: str, tmp_path: Path
) -> None:
    weights = sum(make_update(name, options, tmp_path / "update.txt")["weights"])
    text = (tmp_path / "update.txt").read_text()
    assert re.search(rf'custom_call_target="\w*{kernels}', text)  # XLA cannot divide it
    assert "while(" in text  # over frames, of which no exchange is a part
    ((kind, size, repeated),) = find_exchanges(text)
    assert kind == "all-reduce"
    assert 4 * weights < size <= 4 * weights + 64
    assert not repeated
