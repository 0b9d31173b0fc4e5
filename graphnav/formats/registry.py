"""How a log format makes itself known: its module in this package holds one `FORMAT`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from graphnav.recording import Recording


@dataclass(frozen=True)
class Format:
    """One way a recording can be stored.

    `recognises` must be cheap and must not raise; `read` raises RecordingError for anything it cannot use.
    """

    name: str
    about: str  # one sentence
    recognises: Callable[[str | Path], bool]
    read: Callable[[str | Path], Recording]
    builtin: bool = False  # a name that is always there, such as "kitti", rather than a path
