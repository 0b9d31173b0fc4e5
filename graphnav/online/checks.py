"""What the rows of a running drive show of themselves: units, axes, clocks. It is noted; the estimate is untouched.

The checks are those that a recording goes through before it is solved (`graphnav.recording.checks.overview`).
"""

from __future__ import annotations

from collections import Counter

from graphnav.core.notes import Note
from graphnav.recording import Recording
from graphnav.recording.checks.overview import inspect

_FEWEST_ROWS = 50  # of the IMU
_MOST_LEFT_OUT = 0.5  # of a sensor's rows; more are no odd ones among right ones
# why rows are left out, by what they are counted as, and what makes all of them so
_CAUSES = {
    "nowhere on Earth": "latitude, longitude (in deg in lines, in rad in Python) and height (m), in this order?",
    "stamp in the future": "are all times in s, and of one clock?",
    "too late": "are all times in s, and of one clock?",
    "beyond any sensor": "are rates in rad/s, forces in m/s^2, speeds in m/s?",
    "not a number": "are all fields there, and the sigmas above zero?",
    "a sigma that says nothing": "are the sigmas in m, and standard deviations?",
    "out of reach": "are they of one place, and latitude and longitude in their order?",
}


def check_rows(recording: Recording) -> tuple[Note, ...]:
    """Notes of what cannot be, or is likely not to be, as the rows so far say; none where these are too few."""
    if len(recording.imu.t) < _FEWEST_ROWS:
        return ()
    try:
        findings = inspect(recording).findings
    except Exception:  # of what nobody waits for, nothing may end the drive
        return ()
    return tuple(
        Note(f.key, f"rows sent up to {recording.end:.1f} s: {f.sentence}") for f in findings if f.severity != "note"
    )


def check_counts(counts: Counter[str]) -> tuple[Note, ...]:
    """Notes of sensors most of whose rows are left out; `counts` are rows by sensor, and by sensor and why not."""
    out = []
    for sensor in dict.fromkeys(key.partition(":")[0] for key in counts):
        lost = {why: counts[f"{sensor}: {why}"] for why in _CAUSES}
        total = counts[sensor] + sum(lost.values())
        if sum(lost.values()) > _MOST_LEFT_OUT * total:
            why = max(lost, key=lambda one: lost[one])
            out.append(
                Note(
                    f"{sensor}.left_out",
                    f"{sensor}: {sum(lost.values())} of {total} rows are left out, {lost[why]} of them as "
                    f'"{why}": {_CAUSES[why]}',
                )
            )
    return tuple(out)
