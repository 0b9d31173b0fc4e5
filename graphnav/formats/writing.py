"""Writes a recording as a folder of graphnav's own form: recording.toml and a gzipped CSV file per sensor."""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.formats.schema import ANGLE, WHEELS
from graphnav.recording import Recording
from graphnav.rotation import Array

# digits after the point, each far below what any sensor resolves
_T, _RATE, _FORCE, _LAT_LON, _M, _M_S, _DEG = 6, 9, 7, 10, 4, 5, 7
_ROWS = 20_000  # formatted at a time


def rounded(recording: Recording) -> Recording:
    """The recording with the digits that `write_folder` keeps: what is written is what is read again."""
    imu = recording.imu
    imu = replace(imu, t=_cut(imu.t, _T), gyro=_cut(imu.gyro, _RATE), accel=_cut(imu.accel, _FORCE))
    gnss, odometer, truth = recording.gnss, recording.odometer, recording.truth
    if gnss is not None:
        v, sd_v = gnss.v, gnss.sd_v
        gnss = replace(
            gnss, t=_cut(gnss.t, _T), llh=_cut_llh(gnss.llh), sd=_cut(gnss.sd, _M),
            v=None if v is None else _cut(v, _M_S), sd_v=None if sd_v is None else _cut(sd_v, _M_S),
        )  # fmt: skip
    if odometer is not None:
        wheels = None if odometer.wheels is None else _cut(odometer.wheels, _M_S)
        odometer = replace(odometer, t=_cut(odometer.t, _T), speed=_cut(odometer.speed, _M_S), wheels=wheels)
    if truth is not None and truth.llh is not None:
        v, rph = truth.v, truth.rph
        truth = replace(
            truth, t=_cut(truth.t, _T), llh=_cut_llh(truth.llh), v=None if v is None else _cut(v, _M_S),
            rph=None if rph is None else _degrees(rph) * ANGLE["deg"],
        )  # fmt: skip
    return replace(recording, imu=imu, gnss=gnss, odometer=odometer, truth=truth)


def write_folder(recording: Recording, folder: str | Path, notes: Sequence[str] = ()) -> list[Path]:
    """Write `recording` into `folder` (made if need be); `notes` become comments of recording.toml.

    Times, sensors, lever arms and noise figures are kept; what its own source was and what loading it found are not.
    Returns the files.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    imu, gnss, odometer, truth = recording.imu, recording.gnss, recording.odometer, recording.truth
    lines = [*(f"# {note}" for note in notes), 'format = "graphnav-recording/1"']
    lines += [f"name = {json.dumps(recording.name)}", f'platform = "{recording.platform}"', ""]
    lines += ["[imu]", 'file = "imu.csv.gz"', 'axes = "RFU"', ""]
    if not imu.noise_assumed:
        lines += ["[imu.noise]", *(f"{f.name} = {float(getattr(imu.noise, f.name))!r}" for f in fields(imu.noise)), ""]
    _write(folder / "imu.csv.gz", "t,gx,gy,gz,ax,ay,az", [(imu.t, _T), (imu.gyro, _RATE), (imu.accel, _FORCE)])
    files = [folder / "recording.toml", folder / "imu.csv.gz"]
    if gnss is not None:
        header = "t,lat,lon,h,sd_e,sd_n,sd_u"
        columns = [(gnss.t, _T), *_place(gnss.llh), (gnss.sd, _M)]
        for names, values in ((",ve,vn,vu", gnss.v), (",sd_ve,sd_vn,sd_vu", gnss.sd_v)):
            if values is not None:
                header, columns = header + names, [*columns, (values, _M_S)]
        _write(folder / "gnss.csv.gz", header, columns)
        lines += ["[gnss]", 'file = "gnss.csv.gz"', f"lever_arm = {_numbers(gnss.lever_arm)}", ""]
        files.append(folder / "gnss.csv.gz")
    if odometer is not None:
        header, columns = "t,speed", [(odometer.t, _T), (odometer.speed, _M_S)]
        lines += ["[odometer]", 'file = "odometer.csv.gz"', f"lever_arm = {_numbers(odometer.lever_arm)}"]
        if odometer.way is not None:
            header, columns = header + ",pulses", [*columns, (np.round(odometer.way / odometer.pulse), 0)]
            lines += [f"metres_per_pulse = {float(odometer.pulse)!r}", 'pulses = "cumulative"']
        if odometer.wheels is not None:
            header, columns = ",".join([header, *WHEELS]), [*columns, (odometer.wheels, _M_S)]
        _write(folder / "odometer.csv.gz", header, columns)
        lines += [f"scale_sigma = {float(odometer.scale_sigma)!r}", f"signed = {str(odometer.signed).lower()}"]
        if odometer.speed_sigma is not None:
            lines.append(f"speed_sigma = {float(odometer.speed_sigma)!r}")
        lines += [f"delay_sigma = {float(odometer.delay_sigma)!r}", ""]
        files.append(folder / "odometer.csv.gz")
    if truth is not None and truth.llh is not None:
        header, columns = "t,lat,lon,h", [(truth.t, _T), *_place(truth.llh)]
        if truth.v is not None:
            header, columns = header + ",ve,vn,vu", [*columns, (truth.v, _M_S)]
        if truth.rph is not None:
            header += ",roll,pitch,heading"
            columns = [*columns, (_degrees(truth.rph), _DEG)]
        _write(folder / "truth.csv.gz", header, columns)
        lines += ["[truth]", 'file = "truth.csv.gz"', f'of = "{truth.of}"', ""]
        files.append(folder / "truth.csv.gz")
    (folder / "recording.toml").write_text("\n".join(lines), encoding="utf-8")
    return files


def _cut(values: Array, digits: int) -> Array:
    return np.round(values, digits)


def _cut_llh(llh: Array) -> Array:
    return np.column_stack([np.round(llh[:, :2] / ANGLE["deg"], _LAT_LON) * ANGLE["deg"], np.round(llh[:, 2], _M)])


def _degrees(rph: Array) -> Array:
    """Roll and pitch as they are, heading from 0 to below 360."""
    degrees = _cut(rph / ANGLE["deg"], _DEG)
    degrees[:, 2] = _cut(np.mod(degrees[:, 2], 360.0), _DEG) % 360.0
    return degrees


def _place(llh: Array) -> list[tuple[Array, int]]:
    return [(llh[:, :2] / ANGLE["deg"], _LAT_LON), (llh[:, 2], _M)]


def _numbers(v: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in v) + "]"


def _write(path: Path, header: str, columns: Sequence[tuple[Array, int]]) -> None:
    """One file: values (N,) or (N, k) with so many digits, NaN as a blank cell."""
    rows = np.column_stack([values for values, _ in columns])
    digits = [d for values, d in columns for _ in range(1 if values.ndim == 1 else values.shape[1])]
    form = ",".join(f"%.{d}f" for d in digits) + "\n"
    # no time stamp in the archive: the same recording is the same file
    with path.open("wb") as raw, gzip.GzipFile("", "wb", compresslevel=4, fileobj=raw, mtime=0) as out:
        out.write(f"{header}\n".encode())
        for a in range(0, len(rows), _ROWS):
            part = rows[a : a + _ROWS]
            text = (form * len(part)) % tuple(part.ravel().tolist())
            out.write((text.replace("nan", "") if np.isnan(part).any() else text).encode())


def write_facts(path: Path, facts: Mapping[str, Any]) -> Path:
    """What is known of a recording and no sensor says, as JSON beside it."""
    path.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return path
