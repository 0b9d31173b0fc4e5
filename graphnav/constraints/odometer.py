"""The forward speed that the odometer measured, as the mean over the interval that ends at a keyframe.

With u_v the velocity of the wheels (`constraints.vehicle`), s the mean of the readings and k their scale error, the
residual is u_v,y / (1 + k) - s.

The error is one of the reading s. As u_v,y - (1 + k) s it would vanish for k = -1 and an IMU that is mounted across,
and its likelihood would lack the factor 1 + k of each reading, so that noise figures grew likelier by ending there. Its
derivative by k is -u_v,y / (1 + k)^2; where the velocity is far off, as at the start, that would change the scale in
place of the velocity, so it is taken near the reading.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.base import BuildContext, Linearized
from graphnav.constraints.vehicle import IntervalMotion, Wheels, make_slow_error_parameter, make_wheel_parameters
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.recording import Recording
from graphnav.recording.odometer import MeanSpeed, ReadingStatistics, find_wrong_readings

ODOMETER_SCALE = "odometer_scale"
ODOMETER_DELAY = "odometer_delay"
ODOMETER_ERROR = "odometer_error"
LONGEST_DELAY = 1.0  # s, of readings over a vehicle's bus or a phone's adapter, where the delay is not stated
DELAY_SIGMAS = 4.0  # sigmas of the delay that the rows cover
_LEAST_FACTOR = 0.1  # of 1 + k: units are wrong by 3.6 at most, and a step may go further
_NEAR = 3.0  # sigmas of a reading within which its derivative by the scale is that of the velocity
_FORWARD = np.array([[[0.0, 1.0, 0.0]]])


def average_speed(recording: Recording, settings: Settings) -> MeanSpeed | None:
    """The odometer's mean speed over any intervals, without wrong readings; None where no odometer is used."""
    odometer = recording.odometer
    if recording.platform != "vehicle" or odometer is None or not settings.vehicle.odometer:
        return None
    figures = ReadingStatistics.of(odometer)
    return MeanSpeed.of(odometer, find_wrong_readings(odometer, recording.imu, figures).spans, figures)


@dataclass(frozen=True)
class OdometerSpeed(Wheels):
    """The forward speed that the odometer measured."""

    name: ClassVar[str] = "odometer"
    axes: ClassVar[tuple[str, ...]] = ("forward",)
    noise_axes: ClassVar[tuple[str, ...]] = ("forward",)
    unit: ClassVar[str] = "m/s"

    begin: Array = field(default_factory=lambda: np.empty(0))  # interval of each row, s
    end: Array = field(default_factory=lambda: np.empty(0))
    speed: MeanSpeed | None = None
    signed: bool = True  # False: it does not distinguish forwards from backwards
    reach: float = 0.0  # s, the longest delay for which the readings of all rows are available
    sigma: Array = field(default_factory=lambda: np.empty((0, 1)))

    @classmethod
    def build(cls, scene: BuildContext) -> OdometerSpeed | None:
        s, odometer = scene.settings.vehicle, scene.recording.odometer
        speed = scene.speed or average_speed(scene.recording, scene.settings)
        if speed is None or odometer is None:
            return None
        rows, past = scene.moving_rows, scene.interval_motion
        begin, end = scene.intervals.t0[rows], scene.intervals.t1[rows]
        reach = DELAY_SIGMAS * odometer.delay_sigma
        good = np.all([np.isfinite(speed(begin, end, d)[0]) for d in {-reach, 0.0, reach}], axis=0)
        if not good.all():
            rows, begin, end = rows[good], begin[good], end[good]
            past = IntervalMotion.of(scene.intervals, rows, scene.frame)
        if not len(rows):
            return None
        lever_arm, parameters = make_wheel_parameters(scene)
        walk = s.scale_walk / np.sqrt(60.0)
        parameters.append(Parameter.centred(ODOMETER_SCALE, 1, odometer.scale_sigma, "1", walk=walk))
        if odometer.delay_sigma > 0:
            parameters.append(Parameter.centred(ODOMETER_DELAY, 1, odometer.delay_sigma, "s"))
        density = np.atleast_1d(
            np.hypot(s.odometer_density, np.median(speed.compute_sigma(begin, end) * np.sqrt(end - begin)))
        )
        sigma = np.hypot(speed.compute_sigma(begin, end), s.odometer_density / np.sqrt(end - begin))
        return cls(
            keyframe=rows + 1,
            past=past,
            begin=begin,
            end=end,
            speed=speed,
            signed=odometer.signed,
            sigma=sigma[:, None],
            reach=reach,
            lever_arm=lever_arm,
            parameters=tuple(parameters),
            processes=(make_slow_error_parameter(ODOMETER_ERROR, density, cls),),
            **s.outliers,
        )

    def free_delay(self, value: Array, sigma: Array) -> OdometerSpeed:
        """These rows with their delay (1,), s, as a parameter."""
        others = (p for p in self.parameters if p.name != ODOMETER_DELAY)
        delay = Parameter(ODOMETER_DELAY, value, sigma, "s")
        return replace(self, parameters=(*others, delay), reach=LONGEST_DELAY)

    @cached_property
    def _read(self) -> Array:
        """(N,) mean of the readings over the interval of each row, m/s."""
        assert self.speed is not None
        return self.speed(self.begin, self.end)[0]

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        assert self.speed is not None
        found = self._compute_velocity(states, parameters, rows)
        if ODOMETER_DELAY in parameters:  # the current speed is read `delay` later
            delay = np.minimum(np.maximum(parameters[ODOMETER_DELAY][:, 0], -self.reach), self.reach)
            read, by_delay = self.speed(self.begin[rows], self.end[rows], delay)
            unread = np.isnan(read)  # beside gaps
            read, by_delay = np.where(unread, self._read[rows], read), np.where(unread, 0.0, by_delay)
        else:
            read = self._read[rows]
        factor = np.maximum(1.0 + parameters[ODOMETER_SCALE][:, 0], _LEAST_FACTOR)
        sign = np.ones(len(read)) if self.signed else np.where(found.u[:, 1] < 0.0, -1.0, 1.0)
        A = (sign / factor)[:, None, None] * _FORWARD
        residual = (sign / factor * found.u[:, 1] - read)[:, None]
        jacobians = found.differentiate(A, parameters)
        near = _NEAR * self.sigma[rows]
        expected = read + np.clip(residual, -near, near)[:, 0]
        jacobians[ODOMETER_SCALE] = -(expected / factor)[:, None, None]
        if ODOMETER_DELAY in parameters:
            jacobians[ODOMETER_DELAY] = -by_delay[:, None, None]
        if ODOMETER_ERROR in parameters:
            residual = residual + parameters[ODOMETER_ERROR]
            jacobians[ODOMETER_ERROR] = np.ones((len(residual), 1, 1))
        return Linearized(residual, jacobians, self.sigma[rows])
