"""Checks of the rows of a running drive: units, axes, clocks. They leave the estimate unchanged.

The checks are those of a recording before it is solved (`graphnav.recording.checks.overview`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

from graphnav.core.findings import SEVERITIES, Finding
from graphnav.core.notes import Note, format_count
from graphnav.online.sensors import Sensors
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect
from graphnav.recording.formats.stamps import describe_set_back
from graphnav.recording.plausibility.filled import describe_filled

_OF_STREAM = ("imu.filled", "gnss.clock_back")  # keys of what only the order of rows tells
_FEWEST_IMU_ROWS = 50  # rows of the IMU, at least
_MOST_LEFT_OUT = 0.5  # share of a sensor's rows; above it they are not single outliers
# causes of rejected rows, and what makes all rows of a sensor so
_CAUSES = {
    "nowhere on Earth": "latitude, longitude (in deg in lines, in rad in Python) and height (m), in this order?",
    "stamp in the future": "are all times in s, and of one clock?",
    "too late": "are all times in s, and of one clock?",
    "beyond any sensor": "are rates in rad/s, forces in m/s^2, speeds in m/s?",
    "not a number": "are all fields there, and the sigmas above zero?",
    "a sigma too large to carry information": "are the sigmas in m, and standard deviations?",
    "out of reach": "are they positions of one drive, with latitude and longitude in their order?",
}


def check_rows(recording: Recording) -> tuple[Finding, ...]:
    """Findings on rows that are impossible or unlikely, the most severe first; none while there are too few rows."""
    if len(recording.imu.t) < _FEWEST_IMU_ROWS:
        return ()
    try:
        findings = inspect(recording).findings
    except Exception:  # a background check must never end the drive
        return ()
    until = f"rows sent up to {recording.end:.1f} s"
    keys = " (keys of a live source are in its first line)" if recording.source is None else ""
    return tuple(replace(f, sentence=f"{until}: {f.sentence}{keys}") for f in findings if f.severity != "note")


def add_stream(found: Iterable[Finding], sensors: Sensors) -> tuple[Finding, ...]:
    """Findings and those that only the order of rows tells, the most severe first: rows of the IMU that no sensor
    measured, and a clock of fixes that was set back.
    """
    out, filled, back = [f for f in found if f.key not in _OF_STREAM], sensors.filled, sensors.gnss.arrivals.set_back
    if back is not None:
        out.append(Finding("refused", f"the {describe_set_back('GNSS', *back)}", "gnss.clock_back"))
    if filled.count:
        span, at = filled.longest
        out.append(describe_filled(filled.count, filled.stretches, span, f"{at:.1f} s"))
    return tuple(sorted(out, key=lambda one: SEVERITIES.index(one.severity)))


def check_counts(counts: Counter[str]) -> tuple[Note, ...]:
    """Notes on sensors most of whose rows are rejected; `counts` are rows by sensor, and by sensor and reason."""
    out = []
    for sensor in dict.fromkeys(key.partition(":")[0] for key in counts):
        lost = {why: counts[f"{sensor}: {why}"] for why in _CAUSES}
        total = counts[sensor] + sum(lost.values())
        if sum(lost.values()) > _MOST_LEFT_OUT * total:
            why = max(lost, key=lambda one: lost[one])
            out.append(
                Note(
                    f"{sensor}.left_out",
                    f"{sensor}: left out {sum(lost.values())} of {format_count(total, 'row')}, {lost[why]} of them as "
                    f'"{why}": {_CAUSES[why]}',
                )
            )
    return tuple(out)
