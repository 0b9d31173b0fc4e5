"""What can go wrong, said in one plain line: where, what, and how to mend it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from graphnav.core.notes import key_of


class GraphnavError(Exception):
    """Base of every error a user can cause; the command line prints it and exits with 2.

    Attributes
    ----------
    key : str
        What went wrong, such as "table.column": it stays the same whatever the sentence is, for scripts and tests.
    """

    def __init__(self, sentence: str = "", *, key: str = "") -> None:
        """The sentence, and its key unless it is a `Note`, which has one."""
        super().__init__(sentence)
        self.key = key or key_of(sentence)


class RecordingError(GraphnavError):
    """A recording, or a file of it, that cannot be used as it is."""


class ConfigError(GraphnavError):
    """Settings that name an unknown key or hold an impossible value."""


class PartlyWrittenError(GraphnavError):
    """Results of which some files, `missing`, could not be written; all others are there."""

    def __init__(self, sentence: str, *, key: str, missing: Iterable[Path]) -> None:
        super().__init__(sentence, key=key)
        self.missing = tuple(missing)


class EstimationError(GraphnavError):
    """The data do not determine what was asked for (no motion to align with, a cut graph, ...)."""
