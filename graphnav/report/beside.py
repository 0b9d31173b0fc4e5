"""What is drawn beside a solution, in its frame: the fixes, and the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import fit_yaw, make_yaw_matrix
from graphnav.core.rotation import Array
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import select_own
from graphnav.recording import FIX_TYPES, Recording
from graphnav.report import plots


def has_place(solution: Solution) -> bool:
    """Whether a solution has a place on the Earth; otherwise position and heading count from the start."""
    return any(kind.startswith("gnss") for kind in solution.records)


def select_fixes(recording: Recording, solution: Solution) -> plots.DrawnFixes | None:
    """The fixes in metres, the kind of each, and those that the solver did not use though they were not withheld."""
    if recording.gnss is None or not has_place(solution):
        return None
    gnss, t = recording.gnss, recording.gnss.t
    out = np.zeros(len(t), dtype=bool)
    record = solution.records.get("gnss_position")
    if record is not None and len(record.t):
        gone = record.t[record.weight <= 1e-9]
        out |= np.isin(np.round(t, 3), np.round(gone, 3))
    for part in solution.excluded:
        if part.kind in ("gnss", "gnss_position"):
            out |= (t >= part.t_start) & (t <= part.t_end)
    kinds = {"GNSS fix": np.ones(len(t), dtype=bool)}
    if gnss.type is not None:
        kinds = {FIX_TYPES[k]: gnss.type == k for k in (1, 2, 6, 4, 3, 5, 0) if np.any(gnss.type == k)}
    elif gnss.sd is not None:
        sd = np.hypot(gnss.sd[:, 0], gnss.sd[:, 1])
        classes = {
            "sigma below 0.1 m": sd < 0.1,
            "sigma 0.1 to 1 m": (sd >= 0.1) & (sd < 1.0),
            "sigma 1 m and more": ~(sd < 1.0),
        }
        present = {name: rows for name, rows in classes.items() if rows.any()}
        kinds = present if len(present) > 1 else kinds
    return plots.DrawnFixes(t - recording.start, solution.frame.from_llh(gnss.llh), out, kinds)


def locate_truth(recording: Recording, solutions: Mapping[str, Solution]) -> tuple[Array, Array] | None:
    """Times (M,) and positions (M, 2 or 3) of the truth, in metres of the first solution's frame, while it lasts.

    A row without a position, NaN, is where the truth has a gap.
    """
    truth, first = recording.truth, next(iter(solutions.values()))
    if truth is None or (truth.llh is None and truth.xyz is None):
        return None
    if truth.llh is not None and has_place(first):
        during = (truth.t >= first.t[0]) & (truth.t <= first.t[-1])
        found: tuple[Array, Array] | None = truth.t[during], first.frame.from_llh(truth.llh[during])
    else:
        own = truth.xyz if truth.llh is None else LocalFrame(truth.llh[0]).from_llh(truth.llh)
        assert own is not None
        found = _lay_on(truth.t, own, list(select_own(solutions).values())[-1])
    if found is None or not len(found[0]):
        return None
    t, *p = plots.insert_breaks(found[0], np.arange(len(found[0])), *found[1].T)
    return t, np.stack(p, axis=-1)


def _lay_on(t: Array, xyz: Array, solution: Solution) -> tuple[Array, Array] | None:
    """A truth (M, 2 or 3) in another frame, fitted to a solution by yaw and offset: times (N,) and positions (N, 2 or
    3).
    """
    shared = (t >= solution.t[0]) & (t <= solution.t[-1]) & np.isfinite(xyz).all(axis=1)
    if shared.sum() < 2:
        return None
    p = np.column_stack([np.interp(t[shared], solution.t, x) for x in solution.states.p.T])
    own = np.zeros_like(p)
    own[:, : xyz.shape[1]] = xyz[shared]
    yaw, offset = fit_yaw(own, p)
    return t[shared], np.asarray((own @ make_yaw_matrix(yaw).T + offset)[:, : xyz.shape[1]])
