"""Fixes that are copies of the one before, and so no measurements.

A receiver that takes a slow vehicle to stand holds its position, and a logger that runs faster than the receiver writes
the last fix again. Such a row is of the time of the first of them: it says nothing of a vehicle that stands, and the
wrong of one that moves. Were they used, lever arm and stamps would be bent to them before any test could find them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.constraints.gnss import GnssPosition
from graphnav.core.findings import find_runs
from graphnav.core.notes import Note, format_count
from graphnav.core.rotation import Array
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.noise.outliers import CHANCE
from graphnav.estimation.solution import ExcludedSpan
from graphnav.recording import Gnss, Recording


def drop_copies(recording: Recording) -> tuple[Recording, tuple[ExcludedSpan, ...]]:
    """A recording without fixes that are copies of one within the IMU's time, and the spans of these."""
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


def describe_copies(copies: tuple[ExcludedSpan, ...], recording: Recording) -> tuple[str, ...]:
    """A sentence on fixes that are copies."""
    if not copies or recording.gnss is None:
        return ()
    many = f"{format_count(sum(one.count for one in copies), 'fix', 'fixes')} of {len(recording.gnss.t)}"
    longest = max(copies, key=lambda one: one.t_end - one.t_start)
    begin, end = longest.t_start - recording.start, longest.t_end - recording.start
    sentence = (
        f"gnss: {many} repeat the one before to the last digit, longest from {begin:.1f} to {end:.1f} s: not used, "
        "since a receiver holds its position where it seems to stand, and a fast logger writes it again"
    )
    return (Note("gnss.copies", sentence),)


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
