"""Estimate minus truth, epoch by epoch; `graphnav.evaluation.evaluate` is the entry point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame, enu_axes, llh_to_ecef
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import (
    differentiate,
    fill_covariance,
    fit_yaw,
    interpolate,
    pick_nearest,
    place_on_earth,
)
from graphnav.core.notes import Notes
from graphnav.core.rotation import Array
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation.conventions import find_other_axes, find_other_heights, require_right_handed
from graphnav.evaluation.fitted import propagate_fit
from graphnav.evaluation.metrics import Closure, Errors

MAX_GAP = 3.0  # s; the widest gap that is interpolated over
_LARGER = 1.05  # ratio to the stated sigma above which it is noted
_LEAST_SPEED = 0.5  # m/s; below, the direction of travel is undefined


def compute_errors(
    trajectory: Trajectory,
    truth: Trajectory,
    *,
    lever_arm: Array | None = None,
    max_gap: float = MAX_GAP,
    at: Array | None = None,
    from_start: bool | None = None,
) -> Errors:
    """Estimate minus truth at every epoch of the sparser of the two to which the other can be interpolated.

    Thus the attitude of one-second keyframes, which cannot be interpolated through a turn, is compared at the keyframes
    when the truth has ten rows a second, and a dense estimate at the truth's epochs.

    Parameters
    ----------
    trajectory, truth
        Either may be in a local frame; the yaw and offset that fit best are then found first. A local
        truth without height (NaN) is compared in two dimensions.
    lever_arm
        (3,) m, RFU: from the estimate's point to the truth's; (K, 3) where each of its rows has its own.
    max_gap
        s; the estimate is not interpolated over wider gaps.
    at
        (M,) s; compare at these times only, where the estimate has rows and is not interpolated at all.
    from_start
        Whether the estimate's covariance counts from its own start, as without any fix; a fit then changes it
        (`graphnav.evaluation.fitted`). Unless told: of an estimate in a local frame.

    Raises
    ------
    RecordingError
        If no epoch is shared, or a local frame cannot be fitted because nothing moves.
    """
    lever_arm = lever_arm if lever_arm is not None and np.any(lever_arm) else None
    notes = Notes([*trajectory.notes, *truth.notes, *_list_shortcomings(trajectory, lever_arm)])
    flat = truth.frame == "local" and bool(np.isnan(truth.llh[:, 2]).all())
    if "local" not in (trajectory.frame, truth.frame):
        from_start = False
    else:
        from_start = trajectory.frame == "local" if from_start is None else from_start
        trajectory, truth = _fit_frames(trajectory, truth, lever_arm, max_gap, at, notes)
    estimate, seen, travel, epochs = _pair_epochs(trajectory, truth, lever_arm, max_gap, at)
    if measure_spacing(truth.t) < measure_spacing(trajectory.t) if at is None else _are_between(seen.t, truth.t):
        notes.add(
            "truth.interpolated", "compared at the estimate's own epochs, to which the denser truth is interpolated"
        )
    p = np.einsum("kij,kj->ki", enu_axes(seen.llh), llh_to_ecef(estimate.llh) - llh_to_ecef(seen.llh))
    if flat:
        p[:, 2] = np.nan
    missing = np.full((len(seen), 3), np.nan)
    v = missing if estimate.v is None or seen.v is None else estimate.v - seen.v
    rph, theta = _subtract_attitudes(estimate, seen, notes)
    notes += find_other_heights(p[:, 2])
    cov = _find_covariance(estimate, seen, from_start, notes)
    with np.errstate(divide="ignore", invalid="ignore"):
        per_axis = p**2 / np.diagonal(cov, axis1=-2, axis2=-1)[:, :3]
    if truth.v is None:
        notes.add("truth.no_velocity", "the truth has no velocity: its direction of travel is taken from its positions")
    dof = 2 if flat else 3
    return Errors(
        t=seen.t,
        p=p,
        track=_turn_along_track(p, travel),
        v=v,
        rph=rph,
        sd_p=missing if estimate.sd_p is None else estimate.sd_p,
        sd_v=missing if estimate.sd_v is None else estimate.sd_v,
        sd_rph=missing if estimate.sd_rph is None else estimate.sd_rph,
        nees_p=_compute_nees(p[:, :dof], cov[:, :dof, :dof]),
        nees_axis=np.where(np.isfinite(per_axis), per_axis, np.nan),
        nees_v=_compute_nees(v, cov[:, 3:6, 3:6]),
        nees_rph=_compute_attitude_nees(theta, estimate, cov),
        distance=measure_distance(seen.t, seen.llh),
        dof_p=dof,
        epochs=epochs,
        notes=tuple(dict.fromkeys(notes)),
        nees_heading=_compute_nees(rph[:, 2:], cov[:, 8:, 8:]),
    )


def _list_shortcomings(trajectory: Trajectory, lever_arm: Array | None) -> Notes:
    """What an estimate lacks for its lever arm to the truth's point, and for its NEES."""
    notes = Notes()
    if lever_arm is not None and trajectory.rph is None:
        arm = float(np.max(np.linalg.norm(lever_arm, axis=-1)))
        notes.add(
            "truth.lever_arm",
            f"the estimate has no attitude, so the lever arm of {arm:.2f} m to the truth's point is ignored",
        )
    elif lever_arm is not None and trajectory.covariance is None and trajectory.sd_rph is None:
        notes.add(
            "truth.lever_arm_sigma",
            "the estimate has no attitude sigma, so the lever arm adds nothing to its position sigma",
        )
    if trajectory.covariance is None and trajectory.sd_p is not None:
        notes.add(
            "nees.no_correlations", "NEES from the sigmas alone: the estimate comes without correlations between axes"
        )
    return notes


def _subtract_attitudes(estimate: Trajectory, seen: Trajectory, notes: Notes) -> tuple[Array, Array]:
    """Roll, pitch and heading (N, 3) of the estimate minus the truth's, and the rotation vector (N, 3) between them.

    By the rotation, not the angles: these are strongly nonlinear where a foot points down.
    """
    if estimate.rph is None or seen.rph is None:
        missing = np.full((len(seen), 3), np.nan)
        return missing, missing
    mine, theirs = rotation.from_rph(estimate.rph), rotation.from_rph(seen.rph)
    notes += find_other_axes(mine, theirs, None if estimate.sd_rph is None else estimate.sd_rph[:, 2])
    return rotation.wrap(estimate.rph - seen.rph), rotation.log(np.swapaxes(mine, -1, -2) @ theirs)


def _find_covariance(estimate: Trajectory, seen: Trajectory, from_start: bool, notes: Notes) -> Array:
    """The covariance (N, 9, 9) of the errors, to which the sigmas of the truth are added; NaN where unknown."""
    cov = fill_covariance(estimate)
    cov = np.full((len(seen), 9, 9), np.nan) if cov is None else cov
    if from_start:
        cov = _subtract_fit(cov, estimate, notes)
    of_truth = fill_covariance(replace(seen, covariance=None))
    return cov if of_truth is None else cov + np.nan_to_num(of_truth)


def _turn_along_track(p: Array, travel: Array) -> Array:
    """Errors (N, 2) along the horizontal velocity `travel` (N, 2) m/s, and to its right; NaN where it is slow."""
    speed = np.linalg.norm(travel, axis=1)
    moving = speed > _LEAST_SPEED
    along = np.where(moving[:, None], travel / np.where(moving, speed, 1.0)[:, None], np.nan)
    return np.column_stack(
        [p[:, 0] * along[:, 0] + p[:, 1] * along[:, 1], p[:, 0] * along[:, 1] - p[:, 1] * along[:, 0]]
    )


def measure_closure(trajectory: Trajectory) -> Closure:
    """Distance of the last row from the first, for a loop that ends where it began."""
    p = trajectory.llh if trajectory.frame == "local" else LocalFrame(trajectory.llh[0]).from_llh(trajectory.llh)
    gap, length = p[-1] - p[0], float(np.sum(np.linalg.norm(np.diff(p[:, :2], axis=0), axis=1)))
    h = float(np.hypot(gap[0], gap[1]))
    return Closure(h, float(gap[2]), length, 100.0 * h / length if length > 0 else float("nan"))


def measure_distance(t: Array, llh: Array) -> Array:
    """Horizontal distance (N,) m since the first of the points (N, 3), along points half a second apart.

    Summed over every point, the noise of a standing receiver would count as travel.
    """
    _, first = np.unique(np.floor((t - t[0]) / 0.5), return_index=True)
    knots = np.unique(np.append(first, len(t) - 1))
    p = LocalFrame(llh[0]).from_llh(llh[knots])
    # chords in the plane at the first point; the drop of the Earth's surface below it is no distance travelled
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1) ** 2 - np.diff(llh[knots, 2]) ** 2
    return np.interp(t, t[knots], np.concatenate([[0.0], np.cumsum(np.sqrt(np.maximum(steps, 0.0)))]))


def _fit_frames(
    trajectory: Trajectory,
    truth: Trajectory,
    lever_arm: Array | None,
    max_gap: float,
    at: Array | None,
    notes: Notes,
) -> tuple[Trajectory, Trajectory]:
    """Place both on the Earth, fitting the local one to the other by yaw and offset (the truth to the estimate if both
    are).
    """
    if trajectory.frame == truth.frame:
        # neither has a place on the Earth: any will do, and lengths stay unchanged
        trajectory = place_on_earth(trajectory, LocalFrame(np.zeros(3)), 0.0, np.zeros(3))
    estimate, seen, _, _ = _pair_epochs(trajectory, truth, lever_arm, max_gap, at)
    mine, theirs = estimate.llh, seen.llh
    frame = LocalFrame(mine[0] if trajectory.frame == "geodetic" else theirs[0])
    truth_is_local = truth.frame == "local"
    source, target = (theirs, frame.from_llh(mine)) if truth_is_local else (mine, frame.from_llh(theirs))
    spread = np.sqrt(np.mean(np.sum((source[:, :2] - source[:, :2].mean(0)) ** 2, axis=1)))
    if spread < 0.1:
        raise RecordingError(
            f"the {len(source)} common epochs extend over {spread:.3f} m only: too little to fit a yaw",
            key="truth.too_little",
        )
    require_right_handed("the truth" if truth_is_local else trajectory.name or "the estimate", source, target)
    yaw, offset = fit_yaw(source, target)
    notes.add(
        "truth.fitted",
        f"{'truth' if truth_is_local else 'estimate'} in a local frame: fitted by {np.rad2deg(yaw):.2f} deg of "
        "yaw and "
        f"an offset over {len(source)} epochs before scoring",
    )
    if truth_is_local:
        if np.isnan(offset[2]):
            level = np.where(np.isnan(truth.llh), target[:, 2].mean(), truth.llh)
            truth = replace(truth, llh=np.column_stack([truth.llh[:, :2], level[:, 2]]))
            offset[2] = 0.0
        return trajectory, place_on_earth(truth, frame, yaw, offset)
    return place_on_earth(trajectory, frame, yaw, offset), truth


def _subtract_fit(cov: Array, estimate: Trajectory, notes: Notes) -> Array:
    """The covariance (N, 9, 9) after a fit, for errors that count from the estimate's own start."""
    if not np.isfinite(cov).all():
        notes.add(
            "nees.fit_unknown", "NEES ignores the fit: there is no covariance of position and heading at every epoch"
        )
        return cov
    rest, larger = propagate_fit(cov, LocalFrame(estimate.llh[0]).from_llh(estimate.llh), estimate.v)
    by = f", which takes sigmas {larger:.2f} times as large as stated" if larger > _LARGER else ""
    notes.add(
        "nees.after_fit",
        "NEES is of the errors after the fit; errors of position and heading are assumed to persist as in dead "
        f"reckoning{by}",
    )
    return rest


def _pair_epochs(
    trajectory: Trajectory, truth: Trajectory, lever_arm: Array | None, max_gap: float, at: Array | None
) -> tuple[Trajectory, Trajectory, Array, int]:
    """Estimate and truth at their common epochs, the truth's horizontal velocity there (N, 2), and the number of
    epochs.
    """
    moving = truth if truth.v is not None else replace(truth, v=differentiate(truth, max_gap))
    if at is not None:
        seen, _ = interpolate(moving, at[np.isin(at, trajectory.t)], max_gap=max_gap)
        epochs = len(at)
    elif measure_spacing(truth.t) < measure_spacing(trajectory.t):
        seen, _ = interpolate(moving, trajectory.t, max_gap=max_gap)
        epochs = len(trajectory)
    else:
        seen, epochs = moving, len(truth)
    estimate, reached = interpolate(trajectory, seen.t, max_gap=max_gap, lever_arm=lever_arm)
    if not reached.any():
        raise RecordingError(_explain_no_overlap(trajectory, truth, max_gap), key="truth.no_overlap")
    seen = seen.take(reached)
    assert seen.v is not None
    return estimate, seen if truth.v is not None else replace(seen, v=None), seen.v[:, :2], epochs


def measure_spacing(t: Array) -> float:
    """Typical time between rows at t (N,), s, to 0.1 ms so that rounding decides nothing; infinite for one row."""
    return float(np.round(np.median(np.diff(t)), 4)) if len(t) > 1 else np.inf


def _are_between(t: Array, rows: Array) -> bool:
    """Whether some of the times are not those of rows, to 0.1 ms."""
    return bool((np.abs(t - rows[pick_nearest(rows, t)]) > 1e-4).any())


def _compute_nees(e: Array, cov: Array) -> Array:
    """e' P^-1 e for each row; NaN where something is missing or P is not positive definite."""
    out = np.full(len(e), np.nan)
    rows = np.flatnonzero(np.isfinite(e).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    diagonal = np.diagonal(cov[rows], axis1=-2, axis2=-1)
    rows = rows[(diagonal > 0).all(axis=1)]
    # scaled to unit diagonal, so that the test for singularity is independent of units
    sd = np.sqrt(np.diagonal(cov[rows], axis1=-2, axis2=-1))
    unit = cov[rows] / (sd[:, :, None] * sd[:, None, :])
    good = np.linalg.eigvalsh(unit)[:, 0] > 1e-12 if len(rows) else np.zeros(0, dtype=bool)
    rows, unit, w = rows[good], unit[good], (e[rows] / sd)[good]
    out[rows] = np.sum(w * np.linalg.solve(unit, w[..., None])[..., 0], axis=1)
    return out


def _compute_attitude_nees(theta: Array, estimate: Trajectory, cov: Array) -> Array:
    """NEES (N,) of the rotation vectors (N, 3), whose covariance is that of roll, pitch and heading, turned."""
    if estimate.rph is None:
        return np.full(len(theta), np.nan)
    to_theta = np.linalg.inv(rotation.rph_jacobian(estimate.rph))
    return _compute_nees(theta, to_theta @ cov[:, 6:9, 6:9] @ np.swapaxes(to_theta, -1, -2))


def _explain_no_overlap(trajectory: Trajectory, truth: Trajectory, max_gap: float) -> str:
    name = trajectory.name or "the trajectory"
    if trajectory.t[-1] < truth.t[0] or truth.t[-1] < trajectory.t[0]:
        return f"{name}: {list_ranges(trajectory, truth)}"
    return (
        f"{name}: nothing to compare; no row of the sparser file lies between two rows of the other at most "
        f"{max_gap:g} s apart"
    )


def list_ranges(trajectory: Trajectory, truth: Trajectory) -> str:
    return (
        f"its times {trajectory.t[0]:.3f} to {trajectory.t[-1]:.3f} s do not overlap the truth's "
        f"{truth.t[0]:.3f} to {truth.t[-1]:.3f} s"
    )
