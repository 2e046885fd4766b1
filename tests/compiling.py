"""How XLA fuses operations on CPUs: with the emitters that users' programs have, or in half of the time without.

XLA ends a process whose ``XLA_FLAGS`` have a flag that it does not know: hence the version.
"""

import jax

_KNOWN = jax.__version_info__ < (0, 11)

FLAG = "--xla_cpu_use_fusion_emitters=false" if _KNOWN else ""
"""For ``XLA_FLAGS``: without emitters."""
AS_USERS: dict[str, bool] = {"xla_cpu_use_fusion_emitters": True} if _KNOWN else {}
"""Options of one program: with them, whatever the flags of the process."""
SOON: dict[str, bool] = {"xla_cpu_use_fusion_emitters": False} if _KNOWN else {}
"""Options of one program: without."""
