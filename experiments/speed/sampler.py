"""Where the processor time of a command goes: the stack of its main thread, looked at every few milliseconds.

    python -m experiments.speed.sampler OUT.json denoise FRAME.exr -o OUT

Imports nothing of the project before the command does. Each sample counts as much as all threads of the process have
computed since the one before, so that a machine with other work gives the same picture. What threads do is counted
where the main thread waits for them.
"""

import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType

PAUSE_S = 0.004
OTHER = "other"
GARBAGE = "search for garbage"
_LIBRARIES = ("jax", "jaxlib", "numba", "llvmlite", "numpy", "jaxdn", "OpenEXR", "tyro", "rich")
_STAGES = (
    ("jax/_src/lib/__init__.py", "_xla_gc_callback", GARBAGE),
    ("jaxdn/data/", "", "reading"),
    ("jaxdn/runtime/overlap.py", "finish", "writing"),
    ("jaxdn/runtime/overlap.py", "__exit__", "writing"),
    ("jaxdn/zoo/", "", "weights"),
    ("jax/_src/compiler.py", "compile_or_get_cached", "loading programs"),
    ("jax/_src/interpreters/mlir.py", "", "lowering"),
    ("jax/_src/pjit.py", "_infer_params", "tracing"),
    ("jaxdn/sequence/frame_denoiser.py", "blend_fallback", "safe blend"),
    ("jaxdn/sequence/frame_denoiser.py", "__call__", "denoising"),
    ("jaxdn/commands/", "", "command line"),
    ("tyro/", "", "command line"),
)
"""Part of a file's name, function ("" for each), stage. The innermost function that is listed says the stage."""

Place = tuple[str, str]
"""File and function."""


def stage_of(stack: Sequence[Place]) -> str:
    """The stage of a stack, innermost function first: an import, or one of :data:`_STAGES`."""
    for file, function in stack:
        if function == "<module>" and file != __file__ and (library := _library_of(file)):
            return f"importing {library}"
        for part, name, stage in _STAGES:
            if part in file.replace("\\", "/") and name in ("", function):
                return stage
    return OTHER


def _library_of(file: str) -> str:
    """The library that a module belongs to, "others" for small ones; "" for what is run and not imported."""
    parts = Path(file).parts
    found = [part.removesuffix(".py") for part in parts if part.removesuffix(".py") in _LIBRARIES]
    if found:
        return found[-1]
    return "others" if "site-packages" in parts else ""


def sample(call: Callable[[], object]) -> dict[str, float]:
    """Stage -> processor seconds of all threads while ``call`` runs in this one."""
    found: defaultdict[str, float] = defaultdict(float)
    main, ended = threading.get_ident(), threading.Event()

    def watch() -> None:
        spent, own = time.process_time(), time.thread_time()
        while not ended.wait(PAUSE_S):
            frame = sys._current_frames().get(main)
            stage = stage_of(_places(frame))
            now, mine = time.process_time(), time.thread_time()
            found[stage] += max(0.0, now - spent - (mine - own))
            spent, own = now, mine

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        call()
    finally:
        ended.set()
        thread.join()
    return dict(found)


def _places(frame: FrameType | None) -> list[Place]:
    """The stack of a frame, the innermost first."""
    places = []
    while frame is not None:
        places.append((frame.f_code.co_filename, frame.f_code.co_name))
        frame = frame.f_back
    return places


def main(out: str, arguments: list[str]) -> None:
    """Run the command line and write the stages."""

    def run() -> None:
        from jaxdn.commands.main import main as command

        command(arguments)

    before = time.process_time()
    found = sample(run)
    Path(out).write_text(json.dumps({"starting Python": before, **found}))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
