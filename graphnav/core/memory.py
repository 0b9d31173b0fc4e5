"""The memory of this process."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)
# bytes: more than the covariances of an hour with a keyframe a second and sixty error states; while a drive is solved
# in parts, whose results need the memory; what is kept in all
_LARGEST, _LARGEST_OF_PARTS, _KEPT = 2**27, 2**26, 2**30
_keeps = False


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


def keep_memory() -> None:
    """Let the C library use free memory again, of large arrays too, until `return_memory`.

    Each pass over a drive needs the same arrays; memory anew from the system is cleared page by page, which was a
    twentieth of all processor time.
    """
    global _keeps
    _keeps = True
    with suppress(AttributeError, OSError, TypeError):  # of another C library
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, _LARGEST)
        library.mallopt(_TRIM_THRESHOLD, _KEPT)


def return_memory() -> None:
    """Return free memory to the system, and from now on that of the largest arrays at once."""
    with suppress(AttributeError, OSError, TypeError):  # of another C library
        library = ctypes.CDLL(None)
        library.malloc_trim(0)
        if _keeps:
            library.mallopt(_MMAP_THRESHOLD, _LARGEST_OF_PARTS)


@contextmanager
def pause_collector() -> Iterator[None]:
    """Disable garbage collection in this context, and freeze what exists at its end: modules are permanent, and
    scanning them repeatedly takes a fifth of the time of importing them.
    """
    searched = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if searched:
            gc.freeze()
            gc.enable()
