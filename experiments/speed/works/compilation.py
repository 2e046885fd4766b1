"""The compile time of a program, each time in a separate process: cold, and from the cache on disk.

    python -m experiments.speed.works.compilation xla step-large-720p     # run by a child process: prints seconds

Programs are named like the workloads; ``train-large-64-remat`` is the rematerialised step. Tracing, lowering and
compilation are counted; starting Python and importing are not. PyTorch compiles on its first run, so its figure
includes one run.
"""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

Program = tuple[str, str]
"""Compiler, "xla" or "torch", and a program's name."""
Seconds = float | str
"""How long it took, or why there is no figure."""


def environment(cache: Path) -> dict[str, str]:
    """The variables with which jax and PyTorch keep compiled programs in the folder ``cache``."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str(cache / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "TORCHINDUCTOR_CACHE_DIR": str(cache / "torch"),
    }


def warm(programs: Sequence[Program], cache: Path, *, limit_s: float) -> dict[Program, Seconds]:
    """Compile into the caches in ``cache``, one process per core, and return the seconds that each took.

    They slow each other down a little, all equally.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        seconds = pool.map(lambda pair: compile_seconds(pair[0], pair[1], cache, limit_s=limit_s), programs)
        return dict(zip(programs, seconds, strict=True))


def compile_seconds(compiler: str, program: str, cache: Path, *, limit_s: float) -> Seconds:
    """Compile in a separate process with its cache in the folder ``cache``."""
    command = [sys.executable, "-m", "experiments.speed.works.compilation", compiler, program]
    try:
        done = subprocess.run(
            command, env=os.environ | environment(cache), capture_output=True, text=True, timeout=limit_s, check=False
        )
    except subprocess.TimeoutExpired:
        return f"it did not compile within {limit_s:.0f} s"
    if done.returncode:
        return f"it did not compile: {''.join(done.stderr.strip().splitlines()[-1:])}"
    return float(done.stdout.split()[-1])


def _xla(program: str) -> float:
    import jax

    from experiments.speed.works import steps, train_steps
    from jaxdn.training.step import init_state, make_train_step

    kind, size, detail, *remat = program.split("-")
    denoiser = steps.METHOD.factory(size=size, **steps.PLAIN)
    recipe = train_steps.RECIPE._replace(rematerialize=bool(remat))
    step: Any
    arguments: tuple[Any, ...]
    if kind == "step":
        frame = steps.frame_of(steps.HEIGHT, steps.WIDTH)
        params = denoiser.init(jax.random.key(0), frame)
        step, arguments = steps.program(denoiser), (params, denoiser.start(params, frame), frame)
    else:
        batch = train_steps.batch_of(int(detail))
        state = init_state(denoiser, recipe, batch)
        step, arguments = make_train_step(denoiser, recipe), (state, batch)
    began = time.perf_counter()
    step.lower(*arguments).compile()
    return time.perf_counter() - began


def _torch(program: str) -> float:
    from experiments.speed.works import steps, train_steps

    kind, size, detail = program.split("-")
    if kind == "step":
        call = steps.pytorch(size, steps.HEIGHT, steps.WIDTH, compiled=True)
    else:
        call = train_steps.pytorch(size, int(detail), compiled=True)
    began = time.perf_counter()
    call()
    return time.perf_counter() - began


if __name__ == "__main__":
    compiler, program = sys.argv[1:]
    print({"xla": _xla, "torch": _torch}[compiler](program))
