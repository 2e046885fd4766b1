"""How XLA compiles for CPUs in tests: without fusion emitters and in one piece, in less than half of the time.

The emitters are how users' programs fuse operations. In one piece, one thread makes the code, and not
32 pieces whose overhead is a fifth of the time; that results are the same was not compared.

XLA ends a process whose ``XLA_FLAGS`` have a flag that it does not know: hence the version.
"""

import jax

_KNOWN = jax.__version_info__ < (0, 11)

FLAGS = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1" if _KNOWN else ""
"""For ``XLA_FLAGS``: without emitters, in one piece."""
AS_USERS: dict[str, bool] = {"xla_cpu_use_fusion_emitters": True} if _KNOWN else {}
"""Options of one program: with them, whatever the flags of the process."""
SOON: dict[str, bool] = {"xla_cpu_use_fusion_emitters": False} if _KNOWN else {}
"""Options of one program: without."""
