"""Work that is done beside other work, by a copy of this process, where there is a second processor.

A thread would not do: most of the time the interpreter's lock is held. The copy shares all memory as it is when it is
made, so that it costs little; only what it returns is sent back.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TypeVar

from graphnav.core.progress import listening

T = TypeVar("T")

_ALLOWED: ContextVar[bool] = ContextVar("graphnav_beside", default=False)


@contextmanager
def allow_beside() -> Iterator[None]:
    """Within this context `beside` makes copies; elsewhere, as in a program that calls the library, it does not."""
    several = sys.platform == "linux" and len(os.sched_getaffinity(0)) > 1
    token = _ALLOWED.set(several)
    try:
        yield
    finally:
        _ALLOWED.reset(token)


@contextmanager
def beside(work: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """Begin work; what is given returns or raises what it does, and waits until then.

    Where no copy can be made, or one has ended without a result, the work is done when its result is asked for.
    """
    if not _ALLOWED.get():
        yield work
        return
    read, write = os.pipe()
    try:
        copy = os.fork()
    except OSError:  # no memory for it, or no process
        os.close(read)
        os.close(write)
        yield work
        return
    if not copy:
        _work_and_end(work, write)
    os.close(write)

    def wait() -> T:
        with open(read, "rb", closefd=False) as answers:
            text = answers.read()
        try:
            done, value = pickle.loads(text)
        except (EOFError, pickle.UnpicklingError):
            return work()
        if done:
            return value  # type: ignore[no-any-return]
        raise value

    try:
        yield wait
    finally:
        os.close(read)
        with suppress(ProcessLookupError):
            os.kill(copy, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(copy, 0)


def _work_and_end(work: Callable[[], Any], write: int) -> None:
    """In the copy: do the work, send its result, and end without what the process itself does at its end."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        _ALLOWED.set(False)
        try:
            with listening(None):
                answer = True, work()
        except Exception as error:
            answer = False, error
        with open(write, "wb") as answers:
            answers.write(pickle.dumps(answer))
    finally:
        os._exit(0)
