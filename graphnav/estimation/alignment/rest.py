"""The first state without motion over ground: levelled, the heading by two antennas, unknown, or zero."""

from __future__ import annotations

import numpy as np

from graphnav.config import Settings
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.detectors.base import NONE
from graphnav.estimation.alignment.antennas import measure_baseline_heading
from graphnav.estimation.alignment.back import find_first_stop_end
from graphnav.estimation.alignment.first import LEVELLING, STANDING, Alignment, level
from graphnav.imu.preintegration import integrate_prefix
from graphnav.imu.samples import bridge_gaps
from graphnav.recording import Recording

_FIRST_STANCE = 0.05  # s from the start within which a foot counts as standing there
_OPENING = 10  # stances of a walk by which tilt and accelerometer bias are separated
_DRIVING = 20.0  # m/s, 1-sigma of the initial velocity of a vehicle in motion that nothing measures
_WALKING = 3.0  # m/s, 1-sigma of the initial velocity of a foot in the air


def level_at_rest(recording: Recording, settings: Settings, frame: LocalFrame, stationary: Array) -> Alignment:
    """Levelled attitude; the heading is that of two antennas or unknown. For a foot, `stationary` (N, 2) s are its
    stances.
    """
    noise, gnss = recording.imu.noise, recording.gnss
    stances = stationary if recording.platform == "foot" else NONE
    begin, seconds = _find_stand(recording, stances)
    R = rotation.from_rph(np.array([*level(recording, begin, seconds), 0.0]))
    tilt, sd_v = noise.accel_bias_sigma / 9.8 + np.radians(1.0), 0.5
    bias, sd_bias = np.zeros(3), noise.gyro_bias_sigma
    if settings.alignment.gyro_bias is not None:
        bias, sd_bias = np.array(settings.alignment.gyro_bias), settings.alignment.gyro_bias_sigma
    if begin > recording.start:
        dR, _, _ = integrate_prefix(bridge_gaps(recording.imu), recording.start, np.array([begin]), np.zeros(3), bias)
        R = R @ dR[0].T
        R = rotation.from_rph(rotation.to_rph(R) * [1.0, 1.0, 0.0])
        tilt, sd_v = np.hypot(tilt, sd_bias * (begin - recording.start)), _WALKING
    v, known = np.zeros(3), None
    if gnss is None or not recording.placed:
        # without fixes the first pose defines the frame: position and heading are exact by definition
        p, sd_p, sd_heading = np.zeros(3), np.full(3, 1e-3), 1e-4
        note = Note("alignment.no_gnss", "no GNSS: levelled at the start; position and heading are set to zero there")
        speed, felt = _measure_motion(recording, seconds)
        if abs(speed) > STANDING:
            tilt += felt / 9.8  # levelling takes it for gravity
            v, sd_v = speed * R[:, 1], STANDING + abs(speed) * settings.alignment.prior_inflation * tilt
        elif recording.platform == "vehicle" and not speed and find_first_stop_end(recording, stationary) <= begin:
            sd_v = _DRIVING
            note = Note(
                "alignment.speed_unknown",
                "no GNSS and no odometer, and in motion at the start: the speed there is unknown; position and "
                "heading are set to zero",
            )
    else:
        sd_p, sd_heading = 10.0 * gnss.sd[0] + 1.0, np.pi
        known = measure_baseline_heading(recording, settings, stationary)
        if known is None:
            note = Note(
                "alignment.no_motion",
                "no motion in the GNSS fixes: levelled at the start, the heading sought all around",
            )
        else:
            sd_heading = settings.alignment.prior_inflation * known.sigma
            R = rotation.from_rph(np.array([*rotation.to_rph(R)[:2], known.heading]))
            note = Note(
                "alignment.antennas",
                f"stands at the start: levelled there, heading by two antennas to {np.degrees(known.sigma):.2g} deg",
            )
        p = frame.from_llh(gnss.llh[0]) - R @ gnss.lever_arm
    state = States(
        R[None],
        p[None],
        v[None],
        np.zeros((1, 3)),
        bias[None],
    )
    sigma = np.concatenate(
        [
            [settings.alignment.prior_inflation * tilt] * 2,
            [sd_heading],
            sd_p,
            [sd_v] * 3,
            [noise.accel_bias_sigma] * 3,
            [sd_bias] * 3,
        ]
    )
    own = np.array([tilt, tilt, np.pi if known is None else known.sigma])
    if known is not None:
        return Alignment(state, sigma, own, (note,), known.until, known.until)
    until = float(stances[:_OPENING][-1, 1]) if len(stances) else None
    return Alignment(state, sigma, own, (note,), until=until, heading_unknown=sd_heading == np.pi)


def _measure_motion(recording: Recording, seconds: float) -> tuple[float, float]:
    """Speed at the start by the odometer, m/s, and the largest acceleration in the first seconds, m/s^2, beside
    gravity, along and across the direction of travel. Zero without an odometer's rows there.
    """
    odometer, imu = recording.odometer, recording.imu
    if odometer is None:
        return 0.0, 0.0
    first = (odometer.t >= recording.start) & (odometer.t <= recording.start + seconds) & np.isfinite(odometer.speed)
    t, speed = odometer.t[first], odometer.speed[first]
    if len(t) < 2:
        return 0.0, 0.0
    turn = np.linalg.norm(imu.gyro[imu.t <= recording.start + seconds].mean(axis=0))
    along, across = abs(speed[-1] - speed[0]) / (t[-1] - t[0]), float(np.abs(speed).max() * turn)
    return float(speed[0]), float(np.hypot(along, across))


def _find_stand(recording: Recording, stances: Array) -> tuple[float, float]:
    """Start (s) and duration of the span for levelling: from the start, or, for a foot that starts in the air, its
    first stance.

    The middle half of a stance is used.
    """
    if len(stances) and stances[0, 0] > recording.start + _FIRST_STANCE:
        length = float(stances[0, 1] - stances[0, 0])
        return float(stances[0, 0]) + 0.25 * length, min(LEVELLING, 0.5 * length)
    return recording.start, LEVELLING
