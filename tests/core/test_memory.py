"""Memory that is free is used again, without the system clearing it."""

from __future__ import annotations

import subprocess
import sys

import pytest

REPEATED = """
import resource, sys
import numpy as np
from graphnav.core.memory import keep_memory, return_memory
if sys.argv[1] != "never":
    keep_memory()
if sys.argv[1] == "parts":
    return_memory()
for _ in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    some = np.ones((12, 2**20))
    del some
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the C library is another one")
def test_large_arrays_are_not_cleared_again_once_memory_is_kept() -> None:
    faults = {
        how: int(subprocess.run([sys.executable, "-c", REPEATED, how], capture_output=True, check=True).stdout)
        for how in ("kept", "parts", "never")
    }
    assert 10 * faults["kept"] < min(faults["parts"], faults["never"])
