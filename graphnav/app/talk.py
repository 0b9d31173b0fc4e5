"""What the program says and how: for people, for programs, or nothing; progress; one line for an error."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from graphnav.core.progress import Progress, listening

if TYPE_CHECKING:
    from graphnav.evaluation.gates import Verdict

BAD_INPUT, INTERNAL, NOT_MET, INTERRUPTED, PIPE_CLOSED = 2, 1, 3, 130, 141
_LONGEST = 1500  # characters of a line that says why
DEBUG = "GRAPHNAV_DEBUG"  # set, a traceback is shown


class Interrupted(Exception):
    """Ctrl-C ended a command that has more to say of it."""


def insist(verdicts: Sequence[Verdict]) -> None:
    """Leave with `NOT_MET`, and one line that says why, unless all is as required."""
    missed = [verdict.sentence for verdict in verdicts if not verdict.met]
    if missed:
        print(f"graphnav: not met: {'; '.join(missed)}", file=sys.stderr)
        raise typer.Exit(NOT_MET)


def show(text: Callable[[], str], values: Callable[[], Any], quiet: bool, json: bool) -> None:
    """Print what came of a command: for people, for programs, or not at all."""
    if json:
        from graphnav.core.jsonable import json_text

        say(json_text(values()))
    elif not quiet:
        say(text().rstrip("\n"))


@contextmanager
def bar(quiet: bool, *work: str) -> Iterator[Progress | None]:
    """Progress on a terminal while it lasts, of what is told too."""
    from graphnav.app.terminal import progress_bar

    with progress_bar(quiet, work) as progress, listening(progress):
        yield progress


def say(text: str, flush: bool = True) -> None:
    """Print to stdout; the reader may close it early."""
    try:
        print(_strip_controls(text), flush=flush)
    except BrokenPipeError:
        # what is still in the buffer would fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PIPE_CLOSED) from None


def fail(reason: str, code: int, debug: bool) -> int:
    """Print the one line that says why; returns the exit code."""
    if debug:
        traceback.print_exc()
    line = _strip_controls(" ".join(reason.split()))
    print(f"graphnav: {line if len(line) <= _LONGEST else line[:_LONGEST] + '...'}", file=sys.stderr)
    return code


def _strip_controls(text: str) -> str:
    """The text without characters that steer a terminal: words of a file may hold any."""
    return "".join(c if c in "\n\t" or c.isprintable() else "\ufffd" for c in text) if not text.isprintable() else text
