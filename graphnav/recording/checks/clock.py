"""Clock offset between IMU and fixes, for `graphnav info` and `graphnav init`."""

from __future__ import annotations

from dataclasses import dataclass, replace

from graphnav.recording import Gnss, Imu
from graphnav.recording.checks import crosschecks, tracks
from graphnav.recording.checks.crosschecks import Fit

CLEAR, FAIR = 0.8, 0.6  # correlations: certain, likely
ODOMETER_AGREES = 0.9  # correlation of speeds
_MATTERS = 0.05  # s; the smoother estimates smaller offsets itself (`gnss.time_offset_sigma`, 2.5 sigma)
_SIGNIFICANT = 3.0  # sigma


@dataclass(frozen=True)
class ClockOffsets:
    """Delays of the IMU's stamps against velocities and positions of the fixes; None where unknown."""

    by_velocity: Fit | None
    by_places: Fit | None
    between: Fit | None  # delay of velocities against positions
    by_odometer: Fit | None = None  # delay of the odometer's stamps against the fixes'

    @property
    def of_imu(self) -> bool | None:
        """Whether the IMU's clock is off, because the odometer agrees with the fixes; None where it tells nothing."""
        late, odometer = self.late, self.by_odometer
        if late is None or odometer is None or odometer.correlation < ODOMETER_AGREES:
            return None
        return bool(abs(odometer.lag - late.lag) > 0.5 * abs(late.lag))

    @property
    def apart(self) -> float | None:
        """Offset between the stamps of velocities and positions, s, where it is certain."""
        fit = self.between
        return abs(fit.lag) if fit is not None and fit.correlation > CLEAR and is_certain(fit) else None

    @property
    def late(self) -> Fit | None:
        """The certain delay of the IMU's stamps against the fixes': by velocities if there are any."""
        velocity, places = self.by_velocity, self.by_places
        if velocity is None or places is None:
            one = velocity or places
            return one if one is not None and one.correlation >= FAIR and is_certain(one) else None
        if self.apart is not None and (velocity.lag * places.lag <= 0.0 or abs(places.lag) < _MATTERS):
            return None  # between the two, or right for the positions
        sure = [fit for fit in (velocity, places) if fit.correlation >= FAIR and is_certain(fit)]
        shared = velocity.lag * places.lag > 0.0 and abs(velocity.lag) >= _MATTERS and velocity.correlation >= FAIR
        return velocity if velocity in sure or (sure and shared) else None


def is_certain(fit: Fit) -> bool:
    """Whether a lag is significant and large enough to matter."""
    return abs(fit.lag) >= _MATTERS + _SIGNIFICANT * fit.spread


def measure_clock_offsets(imu: Imu, gnss: Gnss) -> ClockOffsets:
    """Delays from the force along the direction of travel and changes of speed; None where the drive has none."""
    places = tracks.compute_track(replace(gnss, v=None))
    by_places = None if places is None else crosschecks.fit_forward(imu, places)
    track = tracks.compute_track(gnss) if gnss.v is not None else None
    if track is None or not track.instant:
        return ClockOffsets(None, by_places, None)
    between = None if places is None else crosschecks.fit_velocity(track, places)
    return ClockOffsets(crosschecks.fit_forward(imu, track), by_places, between)
