"""Removal of invalid rows from other programs' logs: not finite, impossible positions or times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, format_count
from graphnav.recording import Gnss, take_rows
from graphnav.recording.formats.places import is_on_earth
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.repair import VAGUEST, VAGUEST_V
from graphnav.sensors.tables import LATEST


def drop_unsound_rows(log: Log, path: Path) -> Log:
    """The log without unusable rows; each kind of them is remarked on.

    Raises
    ------
    RecordingError
        If nothing of a sensor is left.
    """
    remarks = Notes(log.remarks)
    imu, gnss, odometer, truth = log.imu, log.gnss, log.odometer, log.truth

    def check_rows(what: str, good: NDArray[np.bool_], why: str) -> bool:
        if good.all():
            return True
        if good.sum() < (2 if what == "IMU" else 1):
            raise RecordingError(f"{path}: {what}: no usable row among {len(good)}: {why}", key="table.none_sound")
        remarks.add(
            f"{what.lower()}.rows_left_out",
            f"{what}: {format_count(int(np.sum(~good)), 'row')} of {len(good)} left out: {why}",
        )
        return False

    if imu is not None:
        finite = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
        good = finite & (np.abs(imu.t) <= LATEST)
        if not check_rows("IMU", good, "values or times that are no numbers"):
            imu = take_rows(imu, good)
    if gnss is not None:
        gnss = _clean_gnss(gnss, check_rows)
    if odometer is not None:
        good = np.isfinite(odometer.speed) & (np.abs(odometer.t) <= LATEST)
        if not check_rows("odometer", good, "values or times that are no numbers"):
            odometer = take_rows(odometer, good)
    if truth is not None and truth.llh is not None:
        good = is_on_earth(*truth.llh.T) & (np.abs(truth.t) <= LATEST)
        if not check_rows("truth", good, "positions nowhere on Earth, or times that are no numbers"):
            truth = take_rows(truth, good)
    return replace(log, imu=imu, gnss=gnss, odometer=odometer, truth=truth, remarks=tuple(remarks))


def _clean_gnss(gnss: Gnss, check_rows: Callable[[str, NDArray[np.bool_], str], bool]) -> Gnss:
    """The fixes at possible positions, with the precision of a valid fix."""
    there: NDArray[np.bool_] = np.asarray(is_on_earth(*gnss.llh.T) & (np.abs(gnss.t) <= LATEST))
    first = gnss.llh[~there][:1]
    at = "".join(f" (the first at {np.degrees(p[0]):.7g}, {np.degrees(p[1]):.7g} deg, {p[2]:.7g} m)" for p in first)
    if not check_rows("GNSS", there, f"positions nowhere on Earth, or times that are no numbers{at}"):
        gnss = take_rows(gnss, there)
    sure: NDArray[np.bool_] = np.asarray(((gnss.sd > 0.0) & (gnss.sd <= VAGUEST)).all(axis=1))
    if not check_rows("GNSS", sure, f"sigmas that are not above 0, or beyond {VAGUEST:g} m"):
        gnss = take_rows(gnss, sure)
    if gnss.v is None or gnss.sd_v is None:
        return gnss
    with np.errstate(invalid="ignore"):
        known = np.isfinite(gnss.v) & (np.abs(gnss.v) <= VAGUEST_V) & (gnss.sd_v > 0.0) & (gnss.sd_v <= VAGUEST_V)
    blank = ~np.asarray(known.all(axis=1))[:, None]
    return replace(gnss, v=np.where(blank, np.nan, gnss.v), sd_v=np.where(blank, np.nan, gnss.sd_v))
