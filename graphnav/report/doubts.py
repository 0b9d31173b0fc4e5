"""Reasons why a result cannot be trusted; imports nothing that draws."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from graphnav.core.notes import Note, get_key
from graphnav.core.sample_size import chi_square_quantile
from graphnav.core.state import BLOCKS
from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import select_own
from graphnav.evaluation.sigmas import BY_CHANCE
from graphnav.report.consistency import summarise_record
from graphnav.report.wording import join_words

if TYPE_CHECKING:
    from graphnav.evaluation.metrics import Errors

_FAR = 3.0  # sigmas, rms, of a separation; smaller significant ones are only in the verdict
# m/s; largest 1-sigma of a heading that counts as known, a twelfth of a turn
_MOVING, _DIRECTED = 1.0, np.radians(30.0)
FEWEST_ROWS = 10  # rows needed to judge a sigma
_BY_INFORMATION = "batch rts isam2 incremental ekf"  # the most first
_BRIEF = 0.01  # share of a drive in which chance events of a filter (an outlier, a gap's first fix) are tolerated
_NEGLIGIBLE_VARIANCE = 1e-12  # m^2, a micrometre
_LARGEST_EXCLUDED_SHARE = 0.5  # share of the fixes' information; above it most measurements contradict the result
TOO_LARGE = {"innovation": 1.5, "residual": 1.15}  # RMS over sigma; a fit reduces residuals


def find_departures(solutions: Mapping[str, Solution]) -> dict[str, Note]:
    """The solvers whose positions are farther from those of the most informed solver than chance allows, and how far.

    Solvers of one recording use the same measurements, so the covariance of the less informed one bounds that of the
    difference.
    """
    out = {}
    solutions = select_own(solutions)
    for name, one in solutions.items():
        solver, dash, coupling = name.partition("-")
        others = [better + dash + coupling for better in _BY_INFORMATION.partition(solver)[0].split()]
        best = next((other for other in others if other in solutions), None)
        if best is None or not np.array_equal(one.t, solutions[best].t):
            continue
        off = one.states.p - solutions[best].states.p
        P = one.covariance[:, BLOCKS["p"], BLOCKS["p"]]
        known = np.isfinite(P).all(axis=(1, 2))
        off, P = off[known], P[known] + _NEGLIGIBLE_VARIANCE * np.eye(3)
        over = np.sqrt(np.einsum("ki,ki->k", off, np.linalg.solve(P, off[:, :, None])[:, :, 0]))
        size = np.linalg.norm(off, axis=1)
        beyond = np.flatnonzero(over > np.sqrt(chi_square_quantile(1.0 - BY_CHANCE, 3)))
        if len(beyond) > _BRIEF * len(off):
            k = beyond[np.argmax(size[beyond])]
            far = f"up to {size[k]:.2g} m from {best}, {over[k]:.2g} times its own sigma"
            out[name] = Note("doubt.solver", f"The trajectory of {name} cannot be trusted: {far}")
    return out


def list_doubts(solutions: Mapping[str, Solution], errors: Mapping[str, Errors]) -> tuple[str, ...]:
    """Reasons why a result cannot be trusted, as sentences; none if there are none."""
    from graphnav.evaluation.sigmas import find_separation, judge_sigmas, select_verdict

    out: list[str] = list(find_departures(solutions).values())
    solutions = select_own(solutions)
    errors = {name: e for name, e in errors.items() if name in solutions}
    for solution in solutions.values():
        fixes = solution.records.get("gnss_position")
        left_out = (
            0.0 if fixes is None else 1.0 - float(np.mean(select_weights(fixes.t, solution.noise, "gnss_position")))
        )
        if left_out > _LARGEST_EXCLUDED_SHARE:
            words = f"This result cannot be trusted: {100 * left_out:.0f} % of the fixes' information contradicts the "
            out.append(Note("doubt.left_out", words + "other measurements and is left out"))
            break  # all solvers use the same noise model
    notes = dict.fromkeys(note for solution in solutions.values() for note in solution.notes)
    out += [Note(key, note) for note in notes if (key := get_key(note)).startswith("doubt.")]
    out += [note for s in solutions.values() if (note := _describe_sliding(s)) is not None][:1]
    for solution in solutions.values():
        if (vague := _describe_vague(solution)) is not None:
            out.append(vague)
            break
    sizes: dict[str, list[str]] = {}
    for name, e in errors.items():
        for j in select_verdict(judge_sigmas(e), "too small"):
            sizes.setdefault(j.block, []).append(f"{j.size:.2g}" + (f" ({name})" if len(errors) > 1 else ""))
    wrong = [f"{block} errors are {join_words(each)} times their sigma" for block, each in sizes.items()]
    if not errors:
        filters = [s for s in solutions.values() if any(r.kind == "innovation" for r in s.records.values())]
        for solution in filters or solutions.values():
            kind, size, used = measure_consistency(solution)
            if used >= FEWEST_ROWS and size > TOO_LARGE[kind]:
                wrong.append(f"{solution.solver}: {kind}s are {size:.2f} times their sigma")
        apart = find_separation(next((s.separation for s in solutions.values()), None))  # the same for all solvers
        if apart is not None and apart.size > _FAR:
            words = f"forward filter and later measurements are {apart.size:.2g} times their sigma apart"
            wrong.append(f"{words} ({apart.block})")
    if wrong:
        whose = "Sigmas" if len(solutions) > 1 else "The result's sigmas"
        words = f"{whose} cannot be trusted: {'; '.join(wrong)}; count on errors larger by that factor"
        out.append(Note("doubt.sigma", words))
    return tuple(out)


def _describe_sliding(solution: Solution) -> Note | None:
    """A doubt where most of what was taken for a stance is none."""
    record = solution.records.get("stance")
    if record is None or len(record.t) < FEWEST_ROWS:
        return None
    # without the kernel's weights, which the squares of innovations include
    squares = record.nis / np.maximum(record.weight, 1e-9) if record.kind == "innovation" else record.nis
    size = float(np.sqrt(np.median(squares) / chi_square_quantile(0.5, len(record.axes))))
    if size <= TOO_LARGE[record.kind]:
        return None
    words = f"in its steps nothing stands still as a shoe on the floor does (speeds of {size:.2g} sigma in the median)"
    return Note("doubt.stances", f"This result cannot be trusted: {words}: is the IMU on a foot, and never clipped?")


def _describe_vague(solution: Solution) -> Note | None:
    """A reservation where nothing has moved, or the fixes do not determine the heading of a moving vehicle."""
    track = solution.trajectory(joint=False)
    moving = np.linalg.norm(solution.states.v, axis=1) > _MOVING
    if not moving.any() and any(get_key(note) == "alignment.no_motion" for note in solution.notes):
        words = (
            "without motion it is not observable, as its sigma says, and what a lever arm makes of it in the position"
        )
        return Note("doubt.heading", f"The heading cannot be trusted: {words}")
    if "gnss_position" not in solution.records or track.sd_rph is None or track.sd_p is None or moving.mean() < 0.5:
        return None
    heading = float(np.median(track.sd_rph[:, 2]))
    if not heading > _DIRECTED:
        return None
    far = float(np.median(np.hypot(track.sd_p[:, 0], track.sd_p[:, 1])))
    words = f"the fixes do not determine the heading: its 1-sigma is {np.degrees(heading):.0f} deg in the median"
    return Note("doubt.heading", f"This result cannot be trusted: {words}, and that of the position {far:.2g} m")


def measure_consistency(solution: Solution) -> tuple[str, float, int]:
    """Kind, RMS over sigma and number of rows of each of a solution's records."""
    every = [summarise_record(record) for record in solution.records.values() if len(record.t)]
    every = [c for c in every if np.isfinite(c.mean_nis)]
    used = sum(c.count - c.rejected for c in every)
    if not used:
        return "residual", float("nan"), 0
    return every[0].kind, float(np.sqrt(sum((c.count - c.rejected) * c.mean_nis / c.dof for c in every) / used)), used
