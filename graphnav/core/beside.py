"""Work beside the rest, in a second process: most of Python, and GTSAM, hold the interpreter's lock.

The process is a fork of this one, so that it has all data at no cost, and what it returns is pickled. A library must
not fork a program that it knows nothing of: only where `allow_second_process` was called, as by the command line, on
Linux with a second processor, and while this process is small. Elsewhere the same work is done in its turn.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
import warnings
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import cached_property
from typing import Generic, TypeVar

from graphnav.core.memory import read_peak_memory_mb
from graphnav.core.progress import send_progress

T = TypeVar("T")
_LARGEST = 1500.0  # MB of peak memory up to which a second process is begun: it may need as much again
_PARENT_DEATH_SIGNAL = 1  # of prctl(2)
_allowed = False


def allow_second_process() -> None:
    """Let work be done in a second process from now on."""
    global _allowed
    _allowed = True


def begin_beside(work: Callable[[], T]) -> Beside[T] | Later[T]:
    """Begin some work in a second process; where there is to be none, it is done when its result is wanted."""
    several = sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1
    if _allowed and several and read_peak_memory_mb() < _LARGEST:
        with suppress(OSError):  # no more processes, files or memory
            return Beside(work)
    return Later(work)


class Later(Generic[T]):
    """Work that is done when its result is wanted first."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work

    @cached_property
    def _result(self) -> T:
        return self._work()

    def get_result(self) -> T:
        """The result."""
        return self._result


class Beside(Generic[T]):
    """Work that a second process has begun; it ends with this object, or with this process."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work = work
        end, begin = os.pipe()
        with warnings.catch_warnings():  # of other threads, which hold no lock that the work needs
            warnings.simplefilter("ignore", DeprecationWarning)
            try:
                process = os.fork()
            except OSError:
                os.close(end)
                os.close(begin)
                raise
        if not process:
            _work_and_exit(work, begin)
        os.close(begin)
        self._end = end
        self._found: tuple[T, Exception | None]
        self._stop = weakref.finalize(self, _stop, process, end)

    def get_result(self) -> T:
        """Wait for the result; what the work raised is raised here.

        If the process was killed, the work is done in this one.
        """
        if self._stop.alive:
            try:
                with os.fdopen(self._end, "rb", closefd=False) as pipe:
                    self._found = pickle.load(pipe)  # of a process of our own, and never twice in memory
            except Exception:  # it was killed, or this is not to be sent
                self._stop()
                self._found = self._work(), None
            self._stop()
        result, error = self._found
        if error is not None:
            raise error
        return result


def _work_and_exit(work: Callable[[], object], begin: int) -> None:
    """Work, write the result into a pipe, and end without anything that this process has registered for its end."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # the other one says that it was interrupted
        with suppress(OSError):
            ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
        with send_progress(None):
            try:
                found: tuple[object, Exception | None] = work(), None
            except Exception as error:
                found = None, error
        with os.fdopen(begin, "wb") as pipe:
            pickle.dump(found, pipe, protocol=5)
    finally:
        os._exit(0)


def _stop(process: int, end: int) -> None:
    """End a process, if it is still there, and what it writes into."""
    os.close(end)
    with suppress(OSError):
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
