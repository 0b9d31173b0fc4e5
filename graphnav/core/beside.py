"""Work beside the rest, in a second process: most of Python, and GTSAM, hold the interpreter's lock.

The process is a fork of this one, so that it has all data at no cost, and what it returns is pickled; but not what the
work was given as arguments and returns as it is, which is here already. A library must not fork a program that it knows
nothing of: only within `allow_second_process`, as by the command line, on Linux with a second processor, and
while this process is small. Elsewhere the same work is done in its turn.
"""

from __future__ import annotations

import ctypes
import io
import os
import pickle
import signal
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from typing import Any, Generic, TypeVar

import numpy as np

from graphnav.core.memory import read_peak_memory_mb
from graphnav.core.progress import send_progress
from graphnav.core.staging import defer_interrupts

T = TypeVar("T")
_LARGEST = 1500.0  # MB of peak memory up to which a second process is begun: it may need as much again
_PARENT_DEATH_SIGNAL = 1  # of prctl(2)
_allowed = False


@contextmanager
def allow_second_process() -> Iterator[None]:
    """Let work be done in a second process within this context."""
    global _allowed
    before, _allowed = _allowed, True
    try:
        yield
    finally:
        _allowed = before


def may_begin() -> bool:
    """Whether work is begun in a second process now."""
    several = sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1
    return _allowed and several and read_peak_memory_mb() < _LARGEST


def begin_beside(work: Callable[[], T]) -> Beside[T] | Later[T]:
    """Begin some work in a second process; where there is to be none, it is done when its result is wanted."""
    if may_begin():
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

    def end(self) -> None:
        """Nothing was begun."""


class Beside(Generic[T]):
    """Work that a second process has begun; it ends with this object, or with this process."""

    def __init__(self, work: Callable[[], T]) -> None:
        self._work, self._given = work, _list_arguments(work)
        self._found: tuple[T, Exception | None]
        with defer_interrupts():  # what Python calls at a fork, logging's locks, would lose them
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
                _work_and_exit(work, self._given, begin)
            os.close(begin)
            self._end = end
            self._stop = weakref.finalize(self, _stop, process, end)

    def get_result(self) -> T:
        """Wait for the result; what the work raised is raised here.

        If the process was ended or killed, the work is done in this one.
        """
        if not hasattr(self, "_found"):
            try:
                with os.fdopen(self._end, "rb", closefd=False) as pipe:
                    self._found = _Receiver(self._given, pipe).load()  # of a process of our own
            except Exception:  # it was killed, or this is not to be sent
                self._stop()
                self._found = self._work(), None
            self._stop()
        result, error = self._found
        if error is not None:
            raise error
        return result

    def end(self) -> None:
        """End the process: its result is not wanted any more."""
        self._stop()


def _list_arguments(work: Callable[[], object]) -> list[object]:
    """Everything in the arguments of work that can be large, in an order that depends on nothing else."""
    found: dict[int, object] = {}
    waiting: list[object] = [*work.args, *work.keywords.values()] if isinstance(work, partial) else []
    while waiting:
        one = waiting.pop()
        if id(one) in found or isinstance(one, type):
            continue
        if isinstance(one, tuple | list):
            waiting += one
        elif isinstance(one, dict):
            waiting += one.values()
        elif hasattr(one, "__dict__"):
            waiting += vars(one).values()
        elif not isinstance(one, np.ndarray):
            continue
        found[id(one)] = one
    return list(found.values())


class _Sender(pickle.Pickler):
    """Writes a result, of what was given its number only."""

    def __init__(self, given: list[object], pipe: io.BufferedIOBase) -> None:
        super().__init__(pipe, protocol=5)
        self._numbers = {id(one): number for number, one in enumerate(given)}

    def persistent_id(self, one: object) -> int | None:
        return self._numbers.get(id(one))


class _Receiver(pickle.Unpickler):
    """Reads what a `_Sender` wrote."""

    def __init__(self, given: list[object], pipe: io.BufferedIOBase) -> None:
        super().__init__(pipe)
        self._given = given

    def persistent_load(self, number: Any) -> object:
        return self._given[number]


def _work_and_exit(work: Callable[[], object], given: list[object], begin: int) -> None:
    """Work, write the result into a pipe, and end without anything that this process has registered for its end."""
    try:
        for what in (signal.SIGINT, signal.SIGTERM):
            signal.signal(what, signal.SIG_DFL)  # the other one says that it was interrupted
        with suppress(OSError):
            ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
        with send_progress(None):
            try:
                found: tuple[object, Exception | None] = work(), None
            except Exception as error:
                found = None, error
        with os.fdopen(begin, "wb") as pipe:
            _Sender(given, pipe).dump(found)
    finally:
        os._exit(0)


def _stop(process: int, end: int) -> None:
    """End a process, if it is still there, and what it writes into."""
    os.close(end)
    with suppress(OSError):
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
