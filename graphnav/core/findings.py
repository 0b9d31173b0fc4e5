"""A finding about a recording, and small helpers that every check uses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from graphnav.core.notes import format_count
from graphnav.core.rotation import Array

Severity = Literal["note", "warning", "unreliable", "refused"]
SEVERITIES: tuple[Severity, ...] = ("refused", "unreliable", "warning", "note")  # the most severe first
_GAP = 1.5  # sample periods between rows of an IMU above which some are lost


@dataclass(frozen=True)
class Finding:
    """One finding about a recording.

    A *note* changes nothing, results suffer from a *warning*, what is solved with an *unreliable* one may be wrong
    altogether whatever its sigmas say, and with a *refused* one nothing is solved.
    """

    severity: Severity
    sentence: str
    key: str = ""  # a stable identifier, such as "imu.spike"

    def to_dict(self) -> dict[str, str]:
        """The finding for JSON.

        Returns
        -------
        dict
            key, severity and sentence.
        """
        return {"key": self.key, "severity": self.severity, "sentence": self.sentence}


def compute_period(t: Array) -> float:
    """Median step of time stamps, s; NaN for fewer than two."""
    every = max(1, len(t) // 100_000)  # a hundred thousand steps are enough
    if len(t) < 2:
        return float("nan")
    steps = t[1::every] - t[:-1:every]
    half = len(steps) // 2
    steps.partition((max(half - 1, 0), half))  # np.median's own checks would double the time
    return float(steps[half] if len(steps) % 2 else 0.5 * (steps[half - 1] + steps[half]))


def find_gap_limit(t: Array) -> float:
    """The step between stamps (N,) of an IMU above which rows are lost, and are filled in for a solution, s."""
    return _GAP * compute_period(t)


def find_runs(mask: NDArray[Any]) -> list[tuple[int, int]]:
    """[start, end) of every run of True."""
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(np.int8), 0]))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def describe_gaps(sensor: str, length: Array, begin: Array) -> str:
    """Gaps of a sensor: their number, and the longest with its beginning, s."""
    k = int(np.argmax(length))
    which = "of" if len(length) == 1 else "the longest of"
    return f"{format_count(len(length), 'gap')} in {sensor}, {which} {length[k]:.3g} s at {begin[k]:.1f} s"
