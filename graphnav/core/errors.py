"""Errors that a user can cause, each a plain sentence: where, what is wrong, and how to correct it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from graphnav.core.notes import get_key


class GraphnavError(Exception):
    """Base of every error a user can cause; the command line prints it and exits with code 2.

    Attributes
    ----------
    key : str
        What went wrong, such as "table.column": it stays the same whatever the sentence is, for scripts and tests.
    """

    def __init__(self, sentence: str = "", *, key: str = "") -> None:
        """Take the sentence and its key; a `Note` carries its key already."""
        super().__init__(sentence)
        self.key = key or get_key(sentence)


class RecordingError(GraphnavError):
    """A recording, or one of its files, cannot be used as it is."""


class ConfigError(GraphnavError):
    """Settings contain an unknown key or an invalid value."""


class PartlyWrittenError(GraphnavError):
    """Some files of the results, `missing`, could not be written; all others were."""

    def __init__(self, sentence: str, *, key: str, missing: Iterable[Path]) -> None:
        super().__init__(sentence, key=key)
        self.missing = tuple(missing)


class EstimationError(GraphnavError):
    """The data do not determine what was asked for (no motion to align with, a disconnected graph, ...)."""
