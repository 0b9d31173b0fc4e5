"""Console output: text, JSON or none; progress; one line for an error."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from graphnav.core.progress import Progress, send_progress

if TYPE_CHECKING:
    from graphnav.evaluation.gates import Verdict

BAD_INPUT, INTERNAL, NOT_MET, INTERRUPTED, PIPE_CLOSED = 2, 1, 3, 130, 141
_MAX_LENGTH = 1500  # characters of an error line
DEBUG = "GRAPHNAV_DEBUG"  # if set, a traceback is shown


class Interrupted(Exception):
    """Ctrl-C ended a command that reports something itself."""


def insist(verdicts: Sequence[Verdict]) -> None:
    """Exit with `NOT_MET` and one line with the reason, unless all requirements are met."""
    missed = [verdict.sentence for verdict in verdicts if not verdict.met]
    if missed:
        print(f"graphnav: not met: {'; '.join(missed)}", file=sys.stderr)
        raise typer.Exit(NOT_MET)


def print_out(
    text: Callable[[], str],
    values: Callable[[], Any],
    quiet: bool,
    json: bool,
    doubts: Callable[[], Iterable[str]] = tuple,
) -> None:
    """Print the result of a command: for people, for programs, or only `doubts`, lines that both of them contain."""
    if json:
        from graphnav.core.jsonable import format_json

        say(format_json(values()))
    elif quiet:
        warn(doubts())
    else:
        say(text().rstrip("\n"))


def warn(lines: Iterable[str]) -> None:
    """Print lines to stderr, whatever else is printed."""
    for line in lines:
        print(f"graphnav: {_strip_controls(line)}", file=sys.stderr)


@contextmanager
def show_progress(quiet: bool, *work: str) -> Iterator[Progress | None]:
    """Progress on a terminal within this context."""
    from graphnav.app.terminal import show_progress_bar

    with show_progress_bar(quiet, work) as progress, send_progress(progress):
        yield progress


def say(text: str, flush: bool = True) -> None:
    """Print to stdout; the reader may close it early."""
    try:
        print(_strip_controls(text), flush=flush)
    except BrokenPipeError:
        # the buffered rest would fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PIPE_CLOSED) from None


def fail(reason: str, code: int, debug: bool) -> int:
    """Print the one line that states the reason; returns the exit code."""
    if debug:
        traceback.print_exc()
    line = _strip_controls(" ".join(reason.split()))
    print(f"graphnav: {line if len(line) <= _MAX_LENGTH else line[:_MAX_LENGTH] + '...'}", file=sys.stderr)
    return code


def _strip_controls(text: str) -> str:
    """The text without terminal control characters, which words quoted from a file may contain."""
    return "".join(c if c in "\n\t" or c.isprintable() else "\ufffd" for c in text) if not text.isprintable() else text
