"""Rounding of made recordings, and the facts beside them; `writer` writes the folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.rotation import Array
from graphnav.recording import Recording
from graphnav.recording.formats.rounding import measure_rounding
from graphnav.recording.formats.writer import write_folder
from graphnav.sensors.tables import ANGLE

__all__ = ["round_recording", "write_facts", "write_folder"]

# digits after the decimal point, each far below any sensor's resolution
_T, _RATE, _FORCE, _LAT_LON, _M, _M_S, _DEG = 6, 9, 7, 10, 4, 5, 7


def round_recording(recording: Recording) -> Recording:
    """The recording rounded to the digits of its files: what is written is what is read again."""
    imu = recording.imu
    imu = replace(imu, t=_round_to(imu.t, _T), gyro=_round_to(imu.gyro, _RATE), accel=_round_to(imu.accel, _FORCE))
    gnss, odometer, truth = recording.gnss, recording.odometer, recording.truth
    if gnss is not None:
        v, sd_v, llh = gnss.v, gnss.sd_v, _round_llh(gnss.llh)
        gnss = replace(
            gnss, t=_round_to(gnss.t, _T), llh=llh, sd=_round_to(gnss.sd, _M), rounding=measure_rounding(llh),
            v=None if v is None else _round_to(v, _M_S), sd_v=None if sd_v is None else _round_to(sd_v, _M_S),
            residual_rms=None if gnss.residual_rms is None else _round_to(gnss.residual_rms, _M),
        )  # fmt: skip
    if odometer is not None:
        wheels = None if odometer.wheels is None else _round_to(odometer.wheels, _M_S)
        odometer = replace(odometer, t=_round_to(odometer.t, _T), speed=_round_to(odometer.speed, _M_S), wheels=wheels)
    if truth is not None and truth.llh is not None:
        v, rph = truth.v, truth.rph
        truth = replace(
            truth, t=_round_to(truth.t, _T), llh=_round_llh(truth.llh), v=None if v is None else _round_to(v, _M_S),
            rph=None if rph is None else _convert_to_degrees(rph) * ANGLE["deg"],
        )  # fmt: skip
    return replace(recording, imu=imu, gnss=gnss, odometer=odometer, truth=truth)


def _round_to(values: Array, digits: int) -> Array:
    return np.round(values, digits)


def _round_llh(llh: Array) -> Array:
    return np.column_stack([np.round(llh[:, :2] / ANGLE["deg"], _LAT_LON) * ANGLE["deg"], np.round(llh[:, 2], _M)])


def _convert_to_degrees(rph: Array) -> Array:
    """Roll and pitch unchanged, heading from 0 to below 360."""
    degrees = _round_to(rph / ANGLE["deg"], _DEG)
    degrees[:, 2] = _round_to(np.mod(degrees[:, 2], 360.0), _DEG) % 360.0
    return degrees


def write_facts(path: Path, facts: Mapping[str, Any]) -> Path:
    """Write facts about a recording that no sensor measures, as JSON beside it."""
    path.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return path
