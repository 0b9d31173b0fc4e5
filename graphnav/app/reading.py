"""The part of a recording that a run asks for, read and its rows screened beside all else that begins then.

What is imported here is what reading takes: the rest of the program is loaded while a second process reads.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from graphnav.core.beside import Beside, Later, begin_beside
from graphnav.core.errors import RecordingError
from graphnav.core.progress import tell
from graphnav.recording import Recording
from graphnav.recording.formats import read
from graphnav.recording.plausibility.screening import ScreenedRows, screen_rows

if TYPE_CHECKING:
    from graphnav.app.scores import Withheld


@dataclass(frozen=True)
class AskedPart:
    """A source, and the part of it to read; times in s from the recording's start."""

    source: str
    start: float | None = None
    end: float | None = None
    topics: tuple[str, ...] = ()  # of a ROS bag, and
    format: str | None = None  # of a log, and
    allow_outside: bool = False  # as for `graphnav.recording.formats.read`


@dataclass(frozen=True)
class ReadPart:
    """That part as read and its rows screened, its start from that of the whole, s, and the seconds that it took."""

    recording: Recording
    rows: ScreenedRows
    zero: float
    timings: dict[str, float]


def begin_reading(part: AskedPart) -> Beside[ReadPart] | Later[ReadPart]:
    """Begin to read a part and to screen its rows, in a second process where there may be one."""
    return begin_beside(partial(_read_and_screen, part))


def read_part(part: AskedPart, withheld: tuple[Withheld, ...] = ()) -> Recording:
    """The part of the recording without what is withheld, in s from the whole one's start.

    Raises
    ------
    GraphnavError
        In one plain sentence, if it cannot be read or there is no such part.
    """
    from graphnav.app.withholding import shift_spans, withhold

    recording, zero = _read(part)
    return withhold(recording, shift_spans(withheld, zero), zero)[0]


@contextmanager
def measure_time(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Report a stage, and add the seconds that it takes."""
    tell(stage)
    began = time.perf_counter()
    yield
    timings[stage] = timings.get(stage, 0.0) + time.perf_counter() - began


def _read(part: AskedPart) -> tuple[Recording, float]:
    """The part, and its start from that of the whole, s."""
    whole = read(part.source, part.topics, part.allow_outside, part.format)
    if (part.start or 0.0) >= whole.duration or (part.end is not None and part.end <= 0.0):
        option = f"--start {part.start:g}" if (part.start or 0.0) >= whole.duration else f"--end {part.end:g}"
        raise RecordingError(
            f"{option}: lies outside '{whole.name}', which runs from 0 to {whole.duration:.1f} s",
            key="option.span_outside",
        )
    recording = whole.crop(part.start, part.end)
    return recording, recording.start - whole.start if recording is not whole else 0.0


def _read_and_screen(part: AskedPart) -> ReadPart:
    timings: dict[str, float] = {}
    with measure_time(timings, "reading"):
        recording, zero = _read(part)
    with measure_time(timings, "checks"):
        rows = screen_rows(recording)
    return ReadPart(recording, rows, zero, timings)
