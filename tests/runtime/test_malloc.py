"""Memory that is freed and taken again is not cleared by the system in between."""

import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from jaxdn.runtime.malloc import tune_malloc

kept = sys.argv[1] == "keep" and tune_malloc()
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    array = np.ones(2**23)  # 64 MiB
    faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    del array
print(int(kept), faults)
"""


def faults(argument):
    """Whether memory is kept, and the page faults of the third array in a process of its own."""
    done = subprocess.run([sys.executable, "-c", SCRIPT, argument], capture_output=True, text=True, check=True)
    return tuple(map(int, done.stdout.split()))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the C library of other systems has no such setting")
def test_kept_memory_costs_no_page_faults():
    kept, few = faults("keep")
    assert kept
    _, many = faults("leave")
    assert few < 0.01 * many
