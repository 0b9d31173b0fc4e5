"""Functions on arrays, compiled to machine code where Numba is installed.

The same source serves both: without Numba, or with the environment variable GRAPHNAV_COMPILE=0, the same functions run
as they stand, several times more slowly. Machine code is kept on disk: in NUMBA_CACHE_DIR if that is set, beside the
module, or where that folder cannot be written in the user's folder for caches.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, TypeVar, cast

from graphnav.core.progress import tell

Function = TypeVar("Function", bound=Callable[..., Any])


def can_compile() -> bool:
    """Whether functions are compiled here."""
    return os.environ.get("GRAPHNAV_COMPILE") != "0" and find_spec("numba") is not None


def compile_once(function: Function) -> Function:
    """The function, compiled when it is called first.

    Functions that call each other must be in one module, because the cache on disk is only checked against that
    module's file. Arguments must be numbers and arrays: for other types the cache holds the name of their class and
    fails once it is renamed.
    """
    if not can_compile():
        return function
    import numba

    _report_compiling()
    try:
        return cast(Function, numba.njit(function, cache=True, nogil=True))
    except RuntimeError:  # there is no folder to keep it in
        return cast(Function, numba.njit(function, nogil=True))


@cache
def _report_compiling() -> None:
    """Report compilation, which takes a minute without a cache on disk, as a stage of the progress."""
    from numba.core import event

    class Report(event.Listener):  # type: ignore[misc]
        def on_start(self, event: object) -> None:
            tell("compiling (once)")

        def on_end(self, event: object) -> None:
            pass

    event.register("numba:compile", Report())
