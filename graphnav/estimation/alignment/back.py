"""From the start of the first motion back to the first sample."""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import SAME_TIME
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.estimation.alignment.first import LEVELLING, STANDING, Alignment
from graphnav.estimation.solution import Solution
from graphnav.imu.preintegration import integrate_prefix
from graphnav.imu.samples import Samples, bridge_gaps
from graphnav.recording import Recording

_FIRST_SPAN = 5.0  # s between the fixes that give the first velocity
_CHANGE = 2.0  # m/s^2, bound on the change of speed where it is not measured
_CERTAIN = -np.log(0.01)  # log-likelihood ratio that outweighs that one drive in a hundred begins in reverse


def carry_back(
    recording: Recording,
    settings: Settings,
    solution: Solution,
    R: Array,
    wide: Array,
    own: Array,
    begin: float,
    stationary: Array,
    notes: tuple[str, ...],
) -> Alignment:
    """Carry the state back from the start of the short problem to the first sample of the recording."""
    imu, noise = recording.imu, recording.imu.noise
    bg, ba = solution.states.bg[0], solution.states.ba[0]
    p, v = solution.states.p[0], solution.states.v[0]
    sd = np.sqrt(np.diag(solution.covariance[0]))
    sd_bg = sd[12:15]
    sd_p, sd_v = np.full(3, 1.0) + 10.0 * sd[3:6], np.full(3, 0.5) + 10.0 * sd[6:9]
    if begin - recording.start > 0.05:
        still, samples = min(_find_stand_end(recording, stationary, begin), begin), bridge_gaps(imu)
        stood, back = still - recording.start, begin - still
        drift = np.zeros(3)
        if back > 0.05:
            dR, dV, dP = integrate_prefix(samples, still, np.array([begin]), ba, bg)
            R = rotation.exp(solution.frame.omega_n * back) @ R @ dR[0].T  # the Earth has turned meanwhile
            g = solution.frame.gravity_n(p)
            v0 = v - g * back - R @ dV[0]
            p = p - v0 * back - 0.5 * g * back**2 - R @ dP[0]
            v = v0
            drift = sd_bg * back
            tilt = 9.8 * float(np.max(wide[:2] + drift[:2])) + float(np.max(sd[9:12]))
            sd_v, sd_p = sd_v + tilt * back, sd_p + sd_v * back + 0.5 * tilt * back**2
            notes = (
                *notes,
                Note("alignment.carried_back", f"carried back {back:.1f} s by the gyro to the first sample"),
            )
        if stood > 0.0:
            rest = imu.t <= still
            bg = imu.gyro[rest].mean(axis=0) - solution.frame.omega_n @ R
            v, sd_v = np.zeros(3), np.minimum(sd_v, STANDING)
            drift = np.hypot(drift, noise.gyro_noise_density * np.sqrt(stood))
            notes = (
                *notes,
                Note(
                    "alignment.stands_first",
                    f"stationary for the first {stood:.0f} s; the attitude is from the first motion",
                ),
            )
            sd_bg = np.full(3, noise.gyro_noise_density / np.sqrt(stood) + noise.gyro_bias_walk * np.sqrt(stood))
        p, sd_p, v, sd_v = _refine_by_fixes(recording, solution.frame, R, (p, sd_p, v, sd_v))
        if recording.odometer is not None:
            there = solution.states.p[0], 1.0 + 10.0 * sd[3:6]
            p, sd_p, v, sd_v = _refine_by_wheels(recording, samples, begin, R, bg, wide, there, (p, sd_p, v, sd_v))
        wide = np.hypot(wide, settings.alignment.prior_inflation * drift)
        own = np.hypot(own, np.abs(rotation.rph_jacobian(rotation.to_rph(R))) @ drift)
    sigma = np.concatenate(
        [wide, sd_p, sd_v, [noise.accel_bias_sigma] * 3, np.maximum(noise.gyro_bias_sigma, 5.0 * sd_bg)]
    )
    state = States(R[None], p[None], v[None], ba[None], bg[None])
    return Alignment(state, np.minimum(sigma, np.r_[[np.pi] * 3, [1e6] * 12]), own, notes)


def find_first_stop_end(recording: Recording, stationary: Array) -> float:
    """End (s) of the stop that a recording begins with, of `stationary` (N, 2) s; its start where there is none."""
    first = float(recording.imu.t[0]) + SAME_TIME
    return float(max((b for a, b in stationary if a <= first), default=recording.start))


def _find_stand_end(recording: Recording, stationary: Array, begin: float) -> float:
    """End (s) of the stand at the start: by the detectors, or, where no fix from the start on shows motion before
    `begin` and no wheel turns, as far as the IMU is quiet. That alone is no stand: a steady drive shakes no more than
    an idle engine.
    """
    gnss, odometer, detected = recording.gnss, recording.odometer, find_first_stop_end(recording, stationary)
    if gnss is None or not len(gnss.t) or gnss.t[0] > recording.start + LEVELLING:
        return detected
    if odometer is not None and (turning := np.abs(odometer.speed) > STANDING).any():
        begin = min(begin, float(odometer.t[np.argmax(turning)]))
    return max(detected, _find_quiet_end(recording, begin))


def _find_quiet_end(recording: Recording, end: float) -> float:
    """End (s) of the initial span with nothing but vibration: one-second means hardly differ. The start if there is
    none.

    The last second before the first that differs is left out as well, as motion may have begun in it.
    """
    imu, start = recording.imu, recording.start
    rows = imu.t <= end
    blocks = max(1, int(end - start))
    size = np.count_nonzero(rows) // blocks
    if size < 2 or blocks < 2:
        return start
    force = imu.accel[rows][: size * blocks].reshape(blocks, size, 3).mean(axis=1)
    rate = imu.gyro[rows][: size * blocks].reshape(blocks, size, 3).mean(axis=1)
    moves = np.any((_measure_range(force) > 0.25) | (_measure_range(rate) > 0.02), axis=1)
    if not moves.any():
        return end
    stood = int(np.argmax(moves)) - 1
    return float(imu.t[size * stood - 1]) if stood >= 2 else start


def _measure_range(x: Array) -> Array:
    """(N, k) maximum minus minimum so far."""
    return np.maximum.accumulate(x, axis=0) - np.minimum.accumulate(x, axis=0)


def _refine_by_wheels(
    recording: Recording,
    samples: Samples,
    begin: float,
    R: Array,
    bg: Array,
    wide: Array,
    there: tuple[Array, Array],
    found: tuple[Array, Array, Array, Array],
) -> tuple[Array, Array, Array, Array]:
    """Position and velocity at the start, each with its sigma: as found, or by the odometer if these are better.

    Dead reckoning by the odometer up to `there`, the position at `begin` and its sigma; an attitude error rotates the
    whole path.
    """
    p, sd_p, v, sd_v = found
    odometer = recording.odometer
    assert odometer is not None
    inside = (odometer.t > recording.start) & (odometer.t < begin) & np.isfinite(odometer.speed)
    t, speed = odometer.t[inside], odometer.speed[inside]
    if len(t) < 2 or t[0] - recording.start > 1.0:
        return found
    off = float(np.max(wide)) + (0.0 if odometer.signed else 2.0)  # rad; motion in reverse is off by twice the distance
    sd_v_wheels = np.full(3, STANDING + abs(speed[0]) * off)
    if np.linalg.norm(sd_v_wheels) < np.linalg.norm(sd_v):
        v, sd_v = speed[0] * R[:, 1], sd_v_wheels
    elif not odometer.signed and 2.0 * abs(speed[0] * (R[:, 1] @ v)) < _CERTAIN * (R[:, 1] ** 2 @ sd_v**2):
        v = speed[0] * R[:, 1]  # where v may be of either sign, the filter would take the reading for that of its mean
    step = np.diff(np.append(t, begin))
    sd_p_wheels = there[1] + float(np.sum(step * np.abs(speed))) * off
    if np.linalg.norm(sd_p_wheels) < np.linalg.norm(sd_p):
        dR, _, _ = integrate_prefix(samples, recording.start, t, np.zeros(3), bg)
        p, sd_p = there[0] - R @ np.sum(dR[:, :, 1] * (step * speed)[:, None], axis=0), sd_p_wheels
    return p, sd_p, v, sd_v


def _refine_by_fixes(
    recording: Recording, frame: LocalFrame, R: Array, found: tuple[Array, Array, Array, Array]
) -> tuple[Array, Array, Array, Array]:
    """Position and velocity at the start, each with its sigma: as found, or by the first fixes if these are better.

    Inertial sensors lose the position within a minute or so; fixes from before the first motion are still valid.
    """
    p, sd_p, v, sd_v = found
    gnss = recording.gnss
    assert gnss is not None
    inside = np.flatnonzero((gnss.t >= recording.start - 0.5) & np.isfinite(gnss.llh).all(axis=1))
    i, later = inside[0], inside[gnss.t[inside] >= gnss.t[inside[0]] + _FIRST_SPAN]
    fix = frame.from_llh(gnss.llh[i]) - R @ gnss.lever_arm
    v_fix, sd_v_fix = v, np.full(3, np.inf)
    if len(later):
        j, dt = later[0], float(gnss.t[later[0]] - gnss.t[i])
        v_fix = (frame.from_llh(gnss.llh[j]) - frame.from_llh(gnss.llh[i])) / dt
        sd_v_fix = 3.0 * np.hypot(gnss.sd[i], gnss.sd[j]) / dt + _CHANGE * dt
    if np.linalg.norm(sd_v_fix) < np.linalg.norm(sd_v):
        v, sd_v = v_fix, sd_v_fix
    away = abs(float(gnss.t[i]) - recording.start)
    sd_fix = 1.0 + 10.0 * gnss.sd[i] + (np.linalg.norm(v) + sd_v) * away + 0.5 * _CHANGE * away**2
    if np.linalg.norm(sd_fix) < np.linalg.norm(sd_p):
        p, sd_p = fix - v * (gnss.t[i] - recording.start), sd_fix
    return p, sd_p, v, sd_v
