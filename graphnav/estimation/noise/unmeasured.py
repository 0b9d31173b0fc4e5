"""Rows of fixes that are no measurements: copies of the one before, and points on a line that a logger has drawn.

A receiver that takes a slow vehicle to stand holds its position, and a logger that runs faster than the receiver writes
the last fix again, or interpolates. A copy is of the time of the first of them: it says nothing of a vehicle that
stands, and the wrong of one that moves. A line cuts every corner. Were such rows used, lever arm and stamps would be
bent to them before any test could find them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import bdtrc

from graphnav.constraints.gnss import GnssPosition
from graphnav.core.earth import A, LocalFrame
from graphnav.core.findings import find_runs
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.noise.tails import CHANCE
from graphnav.estimation.solution import ExcludedSpan
from graphnav.recording import Gnss, Recording

_FINEST = 1e-4  # m, the smallest step of positions that receivers write
_KINK = 10.0  # steps of rounding off the line between its neighbours, by which a row is none of it
# the other rows beside such a one are within one step by chance with this probability at most: it being of three sigmas
_BY_CHANCE = 0.24


@dataclass(frozen=True)
class UnmeasuredRows:
    """Rows of fixes that are not used, because they are no measurements."""

    copies: tuple[ExcludedSpan, ...] = ()
    interpolated: int = 0
    filled: int = 0  # in gaps of the IMU

    def list_held(self, spacing: float) -> tuple[ExcludedSpan, ...]:
        """Copies that take a fix away where one is used every `spacing`, s; others stand beside the fix they repeat."""
        return tuple(one for one in self.copies if one.t_end - one.t_start >= spacing)


def drop_unmeasured(recording: Recording) -> tuple[Recording, UnmeasuredRows]:
    """A recording without rows of fixes within the IMU's time that are no measurements, and what these are."""
    recording, copies = _drop_copies(recording)
    gnss = recording.gnss
    if gnss is None:
        return recording, UnmeasuredRows()
    between = mark_interpolated(gnss)
    if between.any():
        recording = replace(recording, gnss=pick_fixes(gnss, ~between))
    return recording, UnmeasuredRows(copies, int(between.sum()))


def drop_in_gaps(recording: Recording, gaps: Array, before: UnmeasuredRows) -> tuple[Recording, UnmeasuredRows]:
    """A recording without the fixes in gaps (g, 2) of the IMU, s, and all rows that are dropped."""
    gnss = recording.gnss
    assert gnss is not None
    filled = np.any((gnss.t[:, None] >= gaps[:, 0]) & (gnss.t[:, None] <= gaps[:, 1]), axis=1)
    return replace(recording, gnss=pick_fixes(gnss, ~filled)), replace(before, filled=int(filled.sum()))


def _drop_copies(recording: Recording) -> tuple[Recording, tuple[ExcludedSpan, ...]]:
    gnss = recording.gnss
    if gnss is None:
        return recording, ()
    within = (gnss.t >= recording.start) & (gnss.t <= recording.end)
    copied = np.zeros(len(gnss.t), dtype=bool)
    copied[within] = mark_copies(pick_fixes(gnss, within))
    spans = tuple(
        ExcludedSpan(GnssPosition.name, float(gnss.t[a]), float(gnss.t[b - 1]), b - a, "copies of the fix before")
        for a, b in find_runs(copied)
    )
    return (replace(recording, gnss=pick_fixes(gnss, ~copied)) if spans else recording), spans


def describe_unmeasured(rows: UnmeasuredRows, recording: Recording) -> tuple[str, ...]:
    """Sentences on fixes that are copies or interpolated."""
    gnss, notes = recording.gnss, list[str]()
    if rows.copies and gnss is not None:
        many = f"{format_count(sum(one.count for one in rows.copies), 'fix', 'fixes')} of {len(gnss.t)}"
        longest = max(rows.copies, key=lambda one: one.t_end - one.t_start)
        begin, end = longest.t_start - recording.start, longest.t_end - recording.start
        sentence = (
            f"gnss: {many} left out as copies of the one before, longest from {begin:.1f} to {end:.1f} "
            "s: a receiver holds its position where it seems to stand, and a fast logger writes it again"
        )
        notes.append(Note("gnss.copies", sentence))
    if rows.interpolated and gnss is not None:
        sentence = (
            f"gnss: {format_count(rows.interpolated, 'row')} of {len(gnss.t)} lie on the line between the rows before "
            "and after: interpolated and not measured, so not used"
        )
        notes.append(Note("gnss.interpolated", sentence))
    if rows.filled and gnss is not None:
        sentence = (
            f"gnss: {format_count(rows.filled, 'fix', 'fixes')} in gaps of the IMU lie on the line from end to end of "
            "a gap and not on the path: interpolated by the logger, so not used"
        )
        notes.append(Note("gnss.filled", sentence))
    return tuple(notes)


def mark_copies(gnss: Gnss) -> Array:
    """(M,) mask of fixes that repeat the position before to the last digit, too often for rounding to explain it.

    Two white errors of sigma fall on the same step q of a log's digits with a probability of q / (2 sqrt(pi) sigma).
    """
    copied = np.zeros(len(gnss.t), dtype=bool)
    if len(gnss.t) < 2:
        return copied
    step = np.sqrt(12.0) * np.array(gnss.rounding)
    alike = np.log(np.clip(step / (2.0 * np.sqrt(np.pi) * gnss.sd[1:]), 1e-300, 1.0)).sum(axis=1)
    same = (gnss.llh[1:] == gnss.llh[:-1]).all(axis=1)
    for a, b in find_runs(np.concatenate([[False], same])):
        copied[a:b] = alike[a - 1 : b - 1].sum() < np.log(CHANCE)
    return copied


def mark_interpolated(gnss: Gnss) -> Array:
    """(M,) mask of rows on the line between their neighbours, of a log that is interpolated.

    There a row is either on that line, as far as digits and the curvature of the earth let it, or far from it: where
    there was a fix. Of measured rows, errors and accelerations take their neighbours off the line as well.
    """
    out = np.zeros(len(gnss.t), dtype=bool)
    rows = np.flatnonzero(np.isfinite(gnss.llh).all(axis=1))
    if len(rows) < 5:
        return out
    t, p = gnss.t[rows], LocalFrame(gnss.llh[rows[0]]).from_llh(gnss.llh[rows])
    share = ((t[1:-1] - t[:-2]) / (t[2:] - t[:-2]))[:, None]
    off = np.abs(p[1:-1] - (1.0 - share) * p[:-2] - share * p[2:])
    step = np.maximum(np.sqrt(12.0) * np.array(gnss.rounding), _FINEST)
    curved = np.sum((p[2:] - p[:-2]) ** 2, axis=1)[:, None] / A
    steps = np.max(off / (step + curved), axis=1)
    on_line = steps <= 1.0
    kinks = np.flatnonzero(steps[1:-1] > _KINK) + 1
    beside = int(np.sum(on_line[kinks - 1]) + np.sum(on_line[kinks + 1]))
    if beside and bdtrc(beside - 1, 2 * len(kinks), _BY_CHANCE) < CHANCE:
        out[rows[1:-1]] = on_line
    return out
