"""Impossible fixes: out of reach, frozen heights, sigmas that contradict the scatter, two groups, late stamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from graphnav.core.earth import LocalFrame
from graphnav.core.findings import Finding, find_runs
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.core.running import run_mean, run_median
from graphnav.recording import Gnss, Recording, take_rows

FASTEST = 150.0  # m/s; the fastest cars that can be bought reach 490 km/h, 136 m/s
# A receiver cannot follow a reflection that comes more than one and a half code chips late (GPS C/A: 293 m a chip).
MISLED = 440.0  # m
_IMPROBABLE = 5.0 * np.sqrt(2.0)  # ratio of a distance between two fixes to their scatter
_CACHED = 60.0  # s; a receiver that is switched on outputs fixes at least that often
_FROZEN = (60.0, 300.0)  # s, and m driven: within these a road or receiver noise changes a height
_STEEPEST = 0.1  # steepest road: bound on the deviation of a height
_FINEST_PHASE = 1e-3  # m: a two-hundredth of the carrier's wavelength (0.19 m), the resolution of its phase
_WAVE = 0.19  # m, of L1
_ACCELERATION = 2.0  # m/s^2, typical acceleration of vehicles
_WANDER = 30.0  # m, by which fixes of a place may wander
_UNBELIEVED = 10.0  # ratio to the scatter of adjacent fixes that no true sigma has: errors last, scatter is smaller
_SMOOTH = 2e-3  # of the sigma; filtered fixes of phones scatter by five thousandths
GRIP = 8.0  # m/s^2, grip of tyres
_MEAN_OF = 11  # fixes in a window in which most steps are right even where half of the fixes are off
_MINORITY = 0.2  # share of the fixes: smaller groups are outvoted by the rest
_ISOLATED_STEPS = 0.01  # share of the steps
_STEP_SPREAD = 0.25  # relative spread of the steps between two groups; those of multipath vary more
_LEAST_SPEED = 3.0  # m/s, below which a step carries little information on its duration


def screen_fixes(recording: Recording) -> tuple[Recording, list[Finding]]:
    """The recording without fixes out of reach and with large sigmas for frozen heights, and findings."""
    gnss = recording.gnss
    assert gnss is not None
    findings: list[Finding] = []
    if cached := count_cached_fixes(gnss.t, recording.start):
        early = recording.start - gnss.t[0]
        findings.append(
            Finding(
                "note",
                f"{format_count(cached, 'fix', 'fixes')} from up to {early:.0f} s before the IMU starts left out: the "
                "receiver repeats its last position until it has a new one",
                "gnss.cached",
            )
        )
        gnss = take_rows(gnss, np.arange(len(gnss.t)) >= cached)
    p = _compute_positions(gnss)
    off = find_out_of_reach(gnss.t, p)
    if off.any():
        findings.append(_drop_unreachable(gnss, p, off, recording.start))
        gnss = take_rows(gnss, ~off)
        p = _compute_positions(gnss)
    if (away := _measure_misled(gnss, p)) > _WANDER:
        words = f"the fixes state the same velocity throughout and move otherwise, by {away:.3g} m"
        findings.append(Finding("warning", f"{words}: it was not logged; not used", "gnss.velocity_constant"))
        gnss = replace(gnss, v=None, sd_v=None)
    for a, b in find_frozen_heights(gnss, p):
        driven = float(np.hypot(*np.diff(p[a:b, :2], axis=0).T).sum())
        sd = gnss.sd.copy()
        sd[a:b, 2] = np.maximum(sd[a:b, 2], _STEEPEST * driven)
        h, begin, end = gnss.llh[a, 2], gnss.t[a] - recording.start, gnss.t[b - 1] - recording.start
        gnss = replace(gnss, sd=sd)
        findings.append(
            Finding(
                "warning",
                f"the heights of the fixes stay at {h:.4g} m from {begin:.1f} to {end:.1f} s, over {driven:.0f} m: "
                "frozen or not logged; they are given a sigma of "
                f"{_STEEPEST * driven:.0f} m there (a slope of a tenth)",
                "gnss.height_frozen",
            )
        )
    if len(gnss.t) >= 10:
        findings += check_sigmas(gnss, p)
        findings += check_two_groups(gnss, p)
        findings += check_arrival_stamps(gnss, p)
    return replace(recording, gnss=gnss), findings


def _measure_misled(gnss: Gnss, p: Array) -> float:
    """Distance (m) of a tenth of the fixes from where a velocity that is the same in all leads, beyond their sigmas."""
    if gnss.v is None:
        return 0.0
    known = np.isfinite(gnss.v[:, :2]).all(axis=1) & np.isfinite(p).all(axis=1)
    if known.sum() < 10 or np.ptp(gnss.v[known][:, :2], axis=0).any():
        return 0.0
    off = p[known, :2] - np.outer(gnss.t[known], gnss.v[known][0, :2])
    sd = float(np.median(gnss.sd[known, :2]))
    return max(float(np.percentile(np.linalg.norm(off - np.median(off, axis=0), axis=1), 90.0)) - 5.0 * sd, 0.0)


def count_cached_fixes(t: Array, start: float) -> int:
    """Number of the first fixes at t (M,) s that precede the IMU's start by long, with none for as long after them."""
    before = np.flatnonzero((t[:-1] < start - _CACHED) & (np.diff(t) > _CACHED))
    return int(before[-1]) + 1 if len(before) and t[-1] > start else 0


def _compute_positions(gnss: Gnss) -> Array:
    """ENU metres around the middle fix, which hardly ever is an outlier, (M, 3)."""
    middle = np.median(gnss.llh[np.isfinite(gnss.llh).all(axis=1)], axis=0) if len(gnss.t) else np.zeros(3)
    return LocalFrame(middle if np.isfinite(middle).all() else np.zeros(3)).from_llh(gnss.llh)


def find_out_of_reach(t: Array, p: Array) -> NDArray[np.bool_]:
    """Fixes at p (M, 3) m, t (M,) s, that cannot be reached from the largest consistent set.

    Where that set itself scatters so much that its fixes may be as far apart, it is the noise, and no fix is wrong.
    """
    error = MISLED
    while True:
        lost = _find_unreachable(t, p, error)
        scatter = _measure_scatter(t[~lost], p[~lost])
        if not lost.any() or not _IMPROBABLE * scatter > error:
            return lost
        error = _IMPROBABLE * scatter  # of a set from which less is cut, so that it scatters more


def _find_unreachable(t: Array, p: Array, error: float) -> NDArray[np.bool_]:
    """Fixes outside the largest set in which each is reached from the one before, with `error` m between them."""
    lost = np.zeros(len(t), dtype=bool)
    there = np.flatnonzero(np.isfinite(p).all(axis=1))
    if len(there) < 3:
        return lost
    t, p = t[there], p[there]
    far = np.linalg.norm(np.diff(p, axis=0), axis=1) > FASTEST * np.diff(t) + error
    if not far.any():
        return lost
    edges = np.r_[0, np.flatnonzero(far) + 1, len(t)]
    first, last = edges[:-1], edges[1:] - 1
    # the chain of parts with the most fixes, each of which can be reached from the one before
    best, before = (last - first + 1).astype(float), np.full(len(first), -1)
    for k in range(1, len(first)):
        apart = np.linalg.norm(p[first[k]] - p[last[:k]], axis=1)
        count = np.where(apart <= FASTEST * (t[first[k]] - t[last[:k]]) + error, best[:k], 0.0)
        if count.max() > 0.0:
            before[k] = int(np.argmax(count))
            best[k] += count.max()
    kept = np.zeros(len(t), dtype=bool)
    k = int(np.argmax(best))
    while k >= 0:
        kept[first[k] : last[k] + 1] = True
        k = int(before[k])
    lost[there[~kept]] = True
    return lost


def _drop_unreachable(gnss: Gnss, p: Array, off: NDArray[np.bool_], start: float) -> Finding:
    k = int(np.flatnonzero(off)[0])
    kept = np.flatnonzero(~off & np.isfinite(p).all(axis=1))
    near = kept[np.argmin(np.abs(gnss.t[kept] - gnss.t[k]))]
    away = float(np.linalg.norm(p[k] - p[near]))
    many = format_count(off.sum(), "fix", "fixes")
    sure = len(kept) > 0.5 * len(off)
    rest = "" if sure else "; what is left is fewer than half of them, so the result is not to be trusted"
    return Finding(
        "warning" if sure else "unreliable",
        f"{many} out of reach of the others, the first {away / 1e3:.4g} km away at {gnss.t[k] - start:.1f} s from the "
        f"start (nothing on land is faster than {FASTEST:g} m/s): not used{rest}",
        "gnss.out_of_reach",
    )


def find_frozen_heights(gnss: Gnss, p: Array) -> list[tuple[int, int]]:
    """[first, end) of the fixes whose height is constant to the last digit while the vehicle drives."""
    same = np.diff(gnss.llh[:, 2]) == 0.0
    distance = np.r_[0.0, np.cumsum(np.nan_to_num(np.hypot(*np.diff(p[:, :2], axis=0).T)))]
    lasting, driven = _FROZEN
    return [
        (a, b + 1)
        for a, b in find_runs(same)
        if gnss.t[b] - gnss.t[a] >= lasting and distance[b] - distance[a] >= driven
    ]


def _compute_steps(t: Array) -> tuple[Array, float, NDArray[np.bool_]]:
    """Time steps, their median, and which are not gaps."""
    dt = np.diff(t)
    period = float(np.median(dt)) if len(dt) else np.nan
    return dt, period, dt < 1.9 * period


def _measure_scatter(t: Array, p: Array) -> float:
    """Standard deviation (m) per horizontal axis of fixes at p (M, 3) about their neighbours; NaN of too few."""
    near = _compute_steps(t)[2]
    bend = (p[2:] - 2.0 * p[1:-1] + p[:-2])[near[1:] & near[:-1], :2]
    bend = bend[np.isfinite(bend).all(axis=1)]
    # white errors of s have second differences of s sqrt(6)
    return float(np.median(np.abs(bend))) / 0.6745 / np.sqrt(6.0) if len(bend) >= 10 else float("nan")


def check_sigmas(gnss: Gnss, p: Array) -> Iterator[Finding]:
    """Sigmas below the resolution of a carrier phase, or contradicted by the scatter of the fixes; they are not
    changed.
    """
    sd = float(np.median(gnss.sd[:, :2]))
    scatter = _measure_scatter(gnss.t, p)
    driven = _ACCELERATION * _compute_steps(gnss.t)[1] ** 2 / np.sqrt(6.0)
    if sd < _FINEST_PHASE:
        yield Finding(
            "warning",
            f"the 1-sigma of the fixes is {sd:.2g} m, less than a carrier's phase can be measured to "
            f"({_FINEST_PHASE:g} m): look at the unit of the sigmas",
            "gnss.sigma_small",
        )
    elif scatter - driven > _UNBELIEVED * sd:
        yield Finding(
            "warning",
            f"neighbouring fixes scatter by {scatter:.2g} m where their 1-sigma is {sd:.2g} m: look at the unit of the "
            "sigmas, or at sd in [gnss]",
            "gnss.sigma_small",
        )
    elif _FINEST_PHASE <= scatter < _SMOOTH * sd:  # below, positions are held or interpolated, not measured
        yield Finding(
            "warning",
            f"neighbouring fixes scatter by {scatter:.2g} m only where their 1-sigma is {sd:.2g} m: look at the unit "
            "of the sigmas, or at sd in [gnss]",
            "gnss.sigma_large",
        )
    if gnss.type is not None and (fixed := gnss.type == 1).sum() >= 10:
        sd = float(np.median(gnss.sd[fixed, :2]))
        if sd > _WAVE:
            yield Finding(
                "warning",
                f"the 1-sigma of the fixed solutions is {sd:.2g} m, more than the carrier's wavelength "
                f"({_WAVE:g} m), whose cycles they resolve: look at the unit of the sigmas",
                "gnss.sigma_large",
            )


def check_two_groups(gnss: Gnss, p: Array) -> Iterator[Finding]:
    """Fixes that alternate between two places a constant step apart, which leaves open which are right."""
    there: NDArray[np.bool_] = np.asarray(np.isfinite(p).all(axis=1))
    there[1:] &= (np.diff(gnss.llh, axis=0) != 0.0).any(axis=1)  # a place that is held is no group
    if there.sum() < 2 * _MEAN_OF:
        return
    gnss, p = take_rows(gnss, there), p[there, :2]
    dt, period, _ = _compute_steps(gnss.t)
    jump = _find_jumps(p, dt)
    sd = np.hypot(gnss.sd[:, 0], gnss.sd[:, 1])
    # the speed changes by the grip of tyres over half the window; steps over a long gap are not used
    limit = 5.0 * np.hypot(sd[1:], sd[:-1]) + GRIP * np.maximum(0.5 * _MEAN_OF * period, dt) * dt
    big = np.flatnonzero(np.linalg.norm(jump, axis=1) > limit)
    if not len(big):
        return
    axis = np.linalg.svd(jump[big], full_matrices=False)[2][0]
    sign = np.sign(jump[big] @ axis)
    step = np.median(sign[:, None] * jump[big], axis=0)
    size = float(np.linalg.norm(step))
    for _ in range(3):  # the motion is clearer without the steps, and the steps without the motion
        group = _find_groups(jump @ (step / size), size)
        jump = _find_jumps(p - group[:, None] * step, dt)
    left = np.linalg.norm(jump, axis=1)
    alike = float((left[np.diff(group) != 0] < _STEP_SPREAD * size).mean())
    share = np.array([(group == 0).mean(), (group == 1).mean()])
    if (left > limit).sum() > _MINORITY * len(big) or alike < 1.0 - _MINORITY or share.min() < _MINORITY:
        return
    yield Finding(
        "unreliable",
        f"the fixes are of two groups {size:.0f} m apart ({100 * share.min():.0f} and {100 * share.max():.0f} % of "
        "them), each consistent in itself: which of them is right is unknown, and the result cannot be trusted",
        "gnss.two_groups",
    )


def _find_jumps(p: Array, dt: Array) -> Array:
    """Deviation of steps between fixes at p (M, 2) m from the typical velocity around them, (M - 1, 2) m."""
    rate = run_median(np.diff(p, axis=0) / dt[:, None], _MEAN_OF)
    return np.asarray(np.diff(p, axis=0) - rate * dt[:, None])


def _find_groups(jump: Array, size: float) -> NDArray[np.intp]:
    """Group (M,) 0 or 1 of every fix: the one for which jumps (M - 1,) along a step of that size fit best."""
    cost = np.abs(jump[:, None, None] - size * np.array([[0.0, 1.0], [-1.0, 0.0]]))  # from, to
    best, came = np.zeros(2), np.zeros((len(jump), 2), dtype=np.intp)
    for k, one in enumerate(cost):
        total = best[:, None] + one
        came[k] = total.argmin(axis=0)
        best = total.min(axis=0)
    group = np.zeros(len(jump) + 1, dtype=np.intp)
    group[-1] = int(best.argmin())
    for k in range(len(jump), 0, -1):
        group[k - 1] = came[k - 1, group[k]]
    return group


def check_arrival_stamps(gnss: Gnss, p: Array) -> Iterator[Finding]:
    """Stamps that are uneven where positions advance evenly: those of arrival, not of measurement."""
    dt = np.diff(gnss.t)
    p = p[:, :2]
    # the mean steps: for fixes that arrive in bursts the median is useless
    period = float(np.median(run_mean(dt, _MEAN_OF)))
    near = (dt < 3.5 * period) & np.isfinite(p[1:]).all(axis=1) & np.isfinite(p[:-1]).all(axis=1)
    step = np.diff(p, axis=0)
    step[~near] = 0.0
    count = np.maximum(run_mean(near, _MEAN_OF), 0.5 / _MEAN_OF)
    pace = np.maximum(run_mean(np.where(near, dt, 0.0), _MEAN_OF) / count, 1e-9)
    typical = run_mean(step, _MEAN_OF) / count[:, None]
    typical_size = np.linalg.norm(typical, axis=1)
    moving = near & (typical_size > _LEAST_SPEED * pace)
    if moving.sum() < 2 * _MEAN_OF:
        return
    uneven = (dt / pace - 1.0)[moving]
    ahead = (np.sum(step * typical, axis=1)[moving] / typical_size[moving] ** 2) - 1.0
    # for most stamps: missing fixes make steps uneven, too
    spread = float(np.median(np.abs(uneven - np.median(uneven)))) / 0.6745
    speed = float(np.median(typical_size[moving] / pace[moving]))
    sd = float(np.median(gnss.sd[:, :2]))
    late = spread * period / np.sqrt(2.0)  # two stamps make a step
    if speed * late < sd or spread == 0.0:
        return
    # stamps so late that fixes overtook each other: against the motion by more than sigmas explain
    back = float((ahead + 1.0 < -5.0 * np.sqrt(2.0) * sd / typical_size[moving]).mean())
    ahead = np.clip(ahead, -3.0, 3.0)
    slope = float(uneven @ ahead / (uneven @ uneven))
    error = float(np.std(ahead - slope * uneven)) / float(np.linalg.norm(uneven))
    if slope + 4.0 * error < 0.5 or back > _ISOLATED_STEPS:  # closer to no part than to the full part in the advance
        seen = f"go back in {100 * back:.0f} % of the steps" if back > _ISOLATED_STEPS else "advance evenly"
        yield Finding(
            "warning",
            f"the stamps of the fixes are uneven by {late:.2g} s where the positions {seen}: they are "
            f"of the arrival and not of the measurement, {speed * late:.2g} m at the usual speed; log the receiver's "
            "own time",
            "gnss.stamped_on_arrival",
        )
