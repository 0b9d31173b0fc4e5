"""The memory of this process."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress
from pathlib import Path


def read_peak_memory_mb() -> float:
    """Peak memory of this process, MB of 2^20 bytes."""
    try:
        # preferred where it exists: ru_maxrss of a forked process includes its parent's memory
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 1024.0, 1)
    except (OSError, ValueError):
        pass
    import resource  # on Windows

    size = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(size / (1024.0**2 if sys.platform == "darwin" else 1024.0), 1)


def return_memory() -> None:
    """Return free memory to the system; by itself the C library keeps that of arrays of less than 32 MB."""
    with suppress(AttributeError, OSError, TypeError):  # of another C library
        ctypes.CDLL(None).malloc_trim(0)
