"""What can go wrong, said in one plain line: where, what, and how to mend it."""

from __future__ import annotations


class GraphnavError(Exception):
    """Base of every error a user can cause; the command line prints it and exits with 2."""


class RecordingError(GraphnavError):
    """A recording, or a file of it, that cannot be used as it is."""


class ConfigError(GraphnavError):
    """Settings that name an unknown key or hold an impossible value."""


class PartlyWrittenError(GraphnavError):
    """Results of which one file could not be written; all others are there."""


class EstimationError(GraphnavError):
    """The data do not determine what was asked for (no motion to align with, a cut graph, ...)."""
