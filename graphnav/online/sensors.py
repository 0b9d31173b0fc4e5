"""Rows received from all sensors: checked, in order of time, and bounded."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from graphnav.config.raw_gnss import RawGnssSettings
from graphnav.core.complaints import shorten, suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.online.buffers import SAME, Buffer
from graphnav.online.fixes import Fixes
from graphnav.online.neighbours import FILLED, FilledRows, Neighbours
from graphnav.online.raw import RAW, RawEpochs
from graphnav.online.sanity import (
    ClockGuard,
    Reach,
    Row,
    can_imu_read,
    can_odometer_read,
    drop_insane_velocity,
    find_fix_fault,
)
from graphnav.recording import Imu, Odometer, Recording
from graphnav.recording.formats.repair import LATEST

AHEAD = 60.0  # s; stamps of other sensors that are further before the IMU's are wrong
_ROW_WIDTH = {"imu": 6, "gnss": 12, "odometer": 6}
_LONGER = {"gnss": 14}  # of a fix that states the rms of its residuals and its satellites
_IDENTIFYING = {"gnss": 3, "odometer": 1}  # number of values by which a repeated row is recognised


@dataclass
class Sensors:
    """Buffers of all sensors.

    Parameters
    ----------
    setup : a recording without rows: platform, noise figures, lever arms.
    longest_gap : s between IMU rows beyond which a stamp is wrong, or the IMU was away.
    raw_settings : of raw observations; which epochs and satellites are used.
    """

    setup: Recording
    longest_gap: float = 2.0
    raw_settings: RawGnssSettings = field(default_factory=RawGnssSettings)
    counts: Counter[str] = field(default_factory=Counter)
    imu: Buffer = field(default_factory=lambda: Buffer(_ROW_WIDTH["imu"]))
    gnss: Fixes = field(init=False)
    odometer: Buffer = field(default_factory=lambda: Buffer(_ROW_WIDTH["odometer"]))
    others: dict[str, Buffer] = field(init=False)  # of the sensors of `Recording.sensors`
    raw: RawEpochs | None = field(init=False)  # of a receiver whose raw observations are used in place of its fixes
    oldest: float = -np.inf  # s; rows up to here are too late
    set_back: list[Row] = field(default_factory=list)  # the first rows of a clock that was set back
    # time (s) from which fixes are out of reach of all earlier ones, and their number
    moved: tuple[float, int] | None = None
    released: list[Row] = field(default_factory=list)  # held rows that are to be processed now
    _clock: ClockGuard = field(default_factory=ClockGuard)
    _reach: Reach = field(default_factory=Reach)
    _before: set[tuple[str | float, ...]] = field(default_factory=set)  # fixes and readings of the earlier clock
    _neighbours: Neighbours = field(init=False)
    _widths: dict[str, int] = field(init=False)  # number of values of a row, by sensor

    def __post_init__(self) -> None:
        self.others = {name: Buffer(len(series.sensor.names)) for name, series in self.setup.sensors.items()}
        self._widths = _ROW_WIDTH | {name: len(series.sensor.names) for name, series in self.setup.sensors.items()}
        self.gnss = Fixes(self.setup.gnss)
        # for a foot, of rates only: an impact lasts for less than a row
        self._neighbours = Neighbours(3 if self.setup.platform == "foot" else 6)
        self.filled: FilledRows = self._neighbours.filled
        raw, tight = self.setup.raw_gnss, self.setup.is_tight(self.raw_settings.coupling)
        self.raw = RawEpochs(raw, self.raw_settings) if raw is not None and tight else None

    @property
    def aiding(self) -> dict[str, Buffer | RawEpochs]:
        """The buffers of all sensors except the IMU, by name."""
        of_raw = {} if self.raw is None else {RAW: self.raw}
        return {"gnss": self.gnss, "odometer": self.odometer, **self.others, **of_raw}

    @property
    def _all(self) -> dict[str, Buffer | RawEpochs]:
        return {"imu": self.imu, **self.aiding}

    def check_form(self, row: Row) -> None:
        """Raise an error for what is no row, before anything is done with it.

        Raises
        ------
        RecordingError
            If it names no sensor, or its values are not as many numbers as the sensor's rows have.
        """
        try:
            sensor, t, values = row
            width, count = self._widths.get(sensor), len(values)
            math.isnan(sum(() if sensor == RAW else values, t))  # fails unless all are numbers
        except (TypeError, ValueError, OverflowError):
            raise RecordingError(f"no row (sensor, time, numbers): {shorten(row)}", key="row.form") from None
        if width is None and sensor != RAW:
            known = suggest_nearest(str(sensor), (*self._widths, RAW))
            raise RecordingError(f"row at t = {t}: no sensor '{sensor}'; {known}", key="row.name")
        if width is not None and count not in (width, _LONGER.get(sensor)):
            raise RecordingError(
                f"{sensor} row at t = {t}: needs {width} numbers, not {count}; Fix, ImuSample, WheelSpeed and Reading "
                "of graphnav.online make rows",
                key="row.form",
            )

    def find_newest(self, sensor: str) -> float:
        """Newest time of a sensor, s."""
        if sensor == RAW and self.raw is None:
            return -np.inf
        return self.imu.newest if sensor == "imu" else self.aiding[sensor].newest

    def needs_keyframes(self, sensor: str) -> bool:
        """Whether each row of a sensor needs a keyframe."""
        if sensor in self.others:
            return self.setup.sensors[sensor].sensor.keyframes
        return sensor == ("gnss" if self.raw is None else RAW)

    def list_keyframe_times(self) -> Array:
        """Times (N,) of the rows that need a keyframe, s."""
        times = [self.gnss.used] if self.needs_keyframes("gnss") else []
        times += [b.t for name, b in self.aiding.items() if name != "gnss" and self.needs_keyframes(name)]
        return np.unique(np.concatenate([*times, np.empty(0)]))

    def add(self, sensor: str, t: float, values: tuple[float, ...], released: bool = False) -> bool:
        """Process a row; False if it is rejected (`counts` states the reason), or held until an IMU row shows its
        clock.

        The values are gyro and force of an IMU (rad/s, m/s^2); latitude, longitude (rad), height, three sigmas,
        velocity and its sigmas (NaN where there is none) of a fix, and where known the rms of its residuals (m) and the
        number of its satellites; speed, counted distance and four wheels of an
        odometer; of other sensors their columns in SI, NaN where there is none. Rows of `released` were held before and
        are not held again.
        """
        if sensor in self.others:
            return self._add_other(sensor, t, values, released)
        if sensor == RAW:
            return self._add_epoch(t, values, released)
        if sensor != "imu" and getattr(self.setup, sensor) is None:
            self.counts[f"{sensor}: not in the setup"] += 1
            return False
        known = values[: 6 if sensor != "odometer" else 1]
        if not math.isfinite(sum(known)) or not abs(t) <= LATEST or (sensor == "gnss" and min(values[3:6]) <= 0.0):
            self.counts[f"{sensor}: not a number"] += 1
            return False
        if (odd := self._find_fault(sensor, values)) is not None:
            self.counts[f"{sensor}: {odd}"] += 1
            return False
        buffer: Buffer = getattr(self, sensor)
        if sensor == "imu":
            return self._add_imu(t, values)
        if not self._is_in_time(sensor, t, values, released):
            return False
        if sensor == "gnss":
            values, without = drop_insane_velocity(values)
            if without:
                self.counts["gnss: a velocity that no vehicle has"] += 1
            others = self._reach.take(t, values)
            if others is None:
                self.counts["gnss: out of reach"] += 1
                return False
            if others:  # the vehicle is at the new position, and the earlier fixes were wrong
                self.counts["gnss"] -= len(self.gnss)
                self.counts["gnss: out of reach"] += len(self.gnss) - len(others) + 1
                self.gnss.drop_before(np.inf)
                self.gnss.forget_typical()
                self.moved, self.released = (others[0][1], len(others)), others
                return False
            values = self.gnss.complete(t, values)
        if not buffer.add(t, values):
            self.counts[f"{sensor}: repeated"] += 1
            return False
        self.counts[sensor] += 1
        return self.gnss.choose(t) if sensor == "gnss" else True

    def _is_in_time(self, sensor: str, t: float, values: tuple[float, ...], released: bool) -> bool:
        """Whether a row arrives in time to be used, and is not repeated."""
        if _identify(sensor, t, values) in self._before:  # a sender that restarts before that step
            self.counts[f"{sensor}: repeated"] += 1
            return False
        far_ahead = bool(len(self.imu)) and t > self.imu.newest + AHEAD
        if not released and (far_ahead or t < self.imu.newest - self.longest_gap):
            (self._clock.hold_early if far_ahead else self._clock.hold)((sensor, t, values))
            self._sort_out()
            return False
        if t <= self.oldest:
            self.counts[f"{sensor}: too late"] += 1
            return False
        if far_ahead:
            self.counts[f"{sensor}: stamp in the future"] += 1
            return False
        return True

    def _add_other(self, name: str, t: float, values: tuple[float, ...], released: bool) -> bool:
        sensor = self.setup.sensors[name].sensor
        row = np.array(values, dtype=float)[None]
        why = None
        if row.shape[1] != len(sensor.names) or not abs(t) <= LATEST or not sensor.mask_usable(row)[0]:
            why = "not a number"
        elif not sensor.mask_usable(row := sensor.mask_outside_bounds(row))[0]:
            why = "beyond any sensor"
        elif not self._is_in_time(name, t, values, released):
            return False
        elif not self.others[name].add(t, tuple(row[0].tolist())):
            why = "repeated"
        self.counts[name if why is None else f"{name}: {why}"] += 1
        return why is None

    def _add_epoch(self, t: float, values: tuple[float, ...], released: bool) -> bool:
        if self.raw is None:
            why: str | None = "fixes are used in place of them"
        elif not abs(t) <= LATEST:
            why = "not a number"
        elif (why := self.raw.find_fault(values)) is not None:
            pass
        elif not self._is_in_time(RAW, t, values, released):
            return False
        elif not self.raw.is_wanted(t):
            why = "closer than they are used"
            self.raw.add(t, values, used=False)
        else:
            self.raw.add(t, values)
        self.counts[RAW if why is None else f"{RAW}: {why}"] += 1
        return why is None

    def add_next(self, t: float, values: tuple[float, ...], newest: float) -> bool:
        """Process an IMU row if it is regular; returns False to leave it to `add`. `newest` is the time before it."""
        if not newest + SAME < t <= newest + self.longest_gap or t <= self.oldest or self._clock.undecided:
            return False
        if len(values) != _ROW_WIDTH["imu"] or not can_imu_read(values) or self._neighbours.frozen:
            return False
        self._clock.remember(t, values)
        self.imu.append(t, values)
        self.counts["imu"] += 1
        return True

    def compare_newest(self) -> float | None:
        """Remove the IMU row before the newest if its neighbours show that no sensor measured it; returns the time of
        the row before that.
        """
        newest = self.imu.rows[-1].tolist()
        found = self._neighbours.compare(newest[0], tuple(newest[1:]), self.imu)
        if found is None:
            return None
        before, t, why = found
        self._take_back([(t, why)])
        return before

    def learn(self, until: float, stops: Array) -> None:
        """Learn from the rows up to a time (s), except those in stops (M, 2), how far readings deviate from their
        neighbours.
        """
        self._neighbours.learn(self.imu, until, stops)

    def drop_unmeasured(self) -> None:
        """Remove the IMU rows that no sensor measured, by their neighbours, as far as that is known."""
        self._take_back(self._neighbours.find(self.imu))

    def _take_back(self, found: list[tuple[float, str]]) -> None:
        for t, why in found:
            self.imu.drop(t)
            self.counts.update({"imu": -1, f"imu: {why}": 1})
            if why == FILLED:
                self.gnss.leave_out_filled(t, self.imu.t)

    def release(self) -> None:
        """No more IMU rows will arrive: release the held rows."""
        self._clock.release()
        self._sort_out()

    def _sort_out(self) -> None:
        """Classify the held rows as far as possible."""
        clock = self._clock
        for sensor, _, _ in clock.known:
            self.counts[f"{sensor}: repeated"] += 1
        self.released += clock.released
        clock.known, clock.released = [], []

    def forget_time(self) -> None:
        """The clock has changed: forget what depends on times of rows."""
        self._reach = Reach()
        self.gnss.forget_typical()
        self._neighbours.forget_time()

    def _find_fault(self, sensor: str, values: tuple[float, ...]) -> str | None:
        """The fault of a row by itself, under the name it is counted by."""
        if sensor == "gnss":
            return find_fix_fault(values)
        reads = can_imu_read(values[:6]) if sensor == "imu" else can_odometer_read(values)
        return None if reads else "beyond any sensor"

    def _add_imu(self, t: float, values: tuple[float, ...]) -> bool:
        if t > self.imu.newest and self._neighbours.skip_frozen(t, values):
            self.counts[f"imu: {FILLED}"] += 1
            return False
        if t <= self.oldest or (t < self.imu.newest - SAME and not self._clock.fits(t, self.imu.t)):
            self.counts[self._name_passed(t)] += 1
            if self._clock.hold(("imu", t, values)):
                self.set_back = self._clock.set_back()  # counted when they are processed
                self.counts -= Counter(self._name_passed(when) for sensor, when, _ in self.set_back if sensor == "imu")
                for name, buffer in self.aiding.items():
                    again = {_identify(name, *row) for row in buffer.list_after(-math.inf)}
                    self._before = {one for one in self._before if one[0] != name} | again
            self._sort_out()
            return False
        if len(self.imu) and t > self.imu.newest + self.longest_gap:
            held = self._clock.hold_ahead(t, values)
            if held is not None:
                self.counts["imu: repeated"] += 1 - len(held)
                self.released += held
                return False
        if len(self.imu) and t > self.imu.newest + self.longest_gap:
            rows = self._clock.hold_leap(t, values, self.longest_gap)
            self.counts["imu: stamp in the future"] += 1 - len(rows)
            for _, when, what in rows:
                self._clock.remember(when, what)
                self.imu.append(when, what)
            self.counts["imu"] += len(rows)
            self._neighbours.forget_newest()
            self._sort_out()
            return bool(rows)
        if t > self.imu.newest:
            self._clock.remember(t, values)
            self._clock.go_on()
            self._sort_out()
        if not self.imu.add(t, values):
            self.counts["imu: repeated"] += 1
            return False
        self.counts["imu"] += 1
        return True

    def _name_passed(self, t: float) -> str:
        """The count that an IMU row at a time that has passed belongs to."""
        repeated = t > self.oldest and bool(np.any(np.abs(self.imu.t - t) <= SAME))
        return "imu: repeated" if repeated else "imu: too late"

    def drop_before(self, t: float) -> None:
        """Drop rows before a time."""
        for buffer in self._all.values():
            buffer.drop_before(t)

    def cut_after(self, t: float) -> dict[str, list[tuple[float, tuple[float, ...]]]]:
        """Remove the rows after a time (s), by sensor; `put_back` adds them again."""
        later = {name: buffer.list_after(t) for name, buffer in self._all.items()}
        for buffer in self._all.values():
            buffer.drop_after(t)
        return later

    def put_back(self, later: dict[str, list[tuple[float, tuple[float, ...]]]]) -> None:
        """Add rows again that were removed."""
        for name, buffer in self._all.items():
            for row in later[name]:
                buffer.add(*row)

    def find_imu_until(self, t: float) -> float:
        """Time of the first IMU row at or after a time, s: only that row shows that the IMU was silent."""
        rows = self.imu.t
        return float(rows[min(int(np.searchsorted(rows, t - SAME)), len(rows) - 1)]) if len(rows) else t

    def make_imu(self, begin: float = -np.inf, end: float = np.inf) -> Imu:
        """The rows of the IMU between two times, s."""
        rows = self.imu.copy_between(begin, end)
        return replace(self.setup.imu, t=rows[:, 0], gyro=rows[:, 1:4], accel=rows[:, 4:7])

    def make_recording(self, begin: float = -np.inf, end: float = np.inf, every: bool = False) -> Recording:
        """The rows between two times as a recording; with `every` also the fixes that are not used."""
        sensors = {}
        for name, buffer in self.others.items():
            rows = buffer.copy_between(begin, end)
            sensors[name] = replace(self.setup.sensors[name], t=rows[:, 0], values=rows[:, 1:])
        raw = None if self.raw is None else self.raw.build_between(begin, end)
        return replace(
            self.setup,
            imu=self.make_imu(begin, end),
            gnss=self.gnss.select_as_gnss(begin, end, every),
            odometer=self._make_odometer(begin, end),
            sensors=sensors,
            raw_gnss=raw,
        )

    def _make_odometer(self, begin: float, end: float) -> Odometer | None:
        rows = self.odometer.copy_between(begin, end)
        if self.setup.odometer is None or len(rows) < 2:
            return None
        way = rows[:, 2] if np.isfinite(rows[:, 2]).all() else None
        wheels = rows[:, 3:7] if np.isfinite(rows[:, 3:7]).any() else None
        return replace(self.setup.odometer, t=rows[:, 0], speed=rows[:, 1], counted=way, wheels=wheels)


def _identify(sensor: str, t: float, values: tuple[float, ...]) -> tuple[str | float, ...]:
    """What a repeated row is recognised by: its first values, those that are numbers, or how many an epoch has."""
    if sensor == RAW:
        return sensor, t, len(values)
    some = values[: _IDENTIFYING[sensor]] if sensor in _IDENTIFYING else filter(math.isfinite, values)
    return (sensor, t, *some)
