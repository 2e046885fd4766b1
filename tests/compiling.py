"""How XLA compiles for CPUs in tests: without fusion emitters, soon and in one piece, in less than half of the time.

The emitters are how users' programs fuse operations. In one piece, one thread makes the code, and not
32 pieces whose overhead is a fifth of the time; that results are the same was not compared. XLA's preset for those who
wait for the compiler takes a sixth less, on jax 0.12, and a tenth on 0.10.

XLA ends a process whose ``XLA_FLAGS`` have a flag that it does not know: hence the version. jax 0.12's has none for
the emitters.
"""

import threading
from typing import Any

import jax
from jax._src.interpreters import mlir

_KNOWN = jax.__version_info__ < (0, 11)

IN_ONE_PIECE = "--xla_cpu_parallel_codegen_split_count=1"
"""For ``XLA_FLAGS``: a tenth of the time less, and what is compiled is what users have."""
_PRESET = "CPU_OPT_PRESET_FAST_COMPILE"
FLAGS = ("--xla_cpu_use_fusion_emitters=false " if _KNOWN else "") + f"--xla_cpu_opt_preset={_PRESET} {IN_ONE_PIECE}"
"""For ``XLA_FLAGS``: without emitters where they can be left out, in one piece, soon."""
AS_USERS: dict[str, bool | str] = {"xla_cpu_opt_preset": "CPU_OPT_PRESET_DEFAULT"} | (
    {"xla_cpu_use_fusion_emitters": True} if _KNOWN else {}
)
"""Options of one program: with them, whatever the flags of the process."""
SOON: dict[str, bool] = {"xla_cpu_use_fusion_emitters": False} if _KNOWN else {}
"""Options of one program: without."""
PLAIN: dict[str, bool | int] = {"xla_backend_optimization_level": 0, **SOON}
"""Options of a program that runs once: LLVM does not optimise it, which takes a fifth of the time."""


def join_flags(*flags: str | None) -> str:
    """A value of ``XLA_FLAGS`` with all of these, of which None and empty ones are left out.

    XLA takes a value that does not begin with ``--``, be it a single space, for the name of a file of flags, and ends
    the process if there is no such file.
    """
    return " ".join(words for some in flags if (words := (some or "").strip()))


compiled: list[float] = []
"""How long each program took that this process has compiled, or loaded, since the list was cleared; seconds."""


def count_programs() -> None:
    """From now on :data:`compiled` grows."""

    def append(event: str, seconds: float, **more: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(append)


CONTEXT_USES = 10
"""Programs that are lowered in one context: what it has interned lives as long as it does."""


def share_contexts() -> None:
    """From now on programs are lowered in an MLIR context that a thread uses for several of them.

    jax 0.12 does so by itself. Before, each program has a context of its own, into which all dialects are loaded: a
    quarter of the time of a small program.
    """
    if jax.__version_info__ >= (0, 12):
        return
    make, here = mlir.make_ir_context, threading.local()

    def reuse() -> Any:
        here.left = getattr(here, "left", 0) - 1
        if here.left < 0:
            here.context, here.left = make(), CONTEXT_USES - 1
        return here.context

    mlir.make_ir_context = reuse
