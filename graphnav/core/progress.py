"""Progress of long work: stages report the share that is done, and a listener set by the caller shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Progress = Callable[[str, float], None]  # a stage, and the share of it that is done, 0 to 1

_LISTENER: ContextVar[Progress | None] = ContextVar("graphnav_progress", default=None)


@contextmanager
def send_progress(listener: Progress | None) -> Iterator[None]:
    """Within this context, reports go to `listener`."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def tell(stage: str, share: float = 0.0) -> None:
    """Report the share of a stage that is done; without a listener nothing happens."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(stage, share)
