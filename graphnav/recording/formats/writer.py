"""Writer of recording folders: SI, degrees for angles, body axes RFU; all numbers read back unchanged."""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.core.progress import tell
from graphnav.core.rotation import Array
from graphnav.core.timescales import format_clock
from graphnav.recording import ImuNoise, Odometer, Recording
from graphnav.recording.formats.registry import Log
from graphnav.recording.formats.schema import NOISE_UNITS, WHEELS
from graphnav.sensors import Series

_DEG = np.pi / 180.0


@dataclass(frozen=True)
class _File:
    name: str
    header: list[str]
    columns: list[Array]


def write_recording(log: Log, folder: Path) -> list[Path]:
    """Write `log` into `folder`, which is created if need be; returns the files, recording.toml first.

    Without an IMU the folder is not a recording yet: its recording.toml names an imu.csv that must be added.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [
        f
        for f in (
            _write_imu(log),
            _write_gnss(log),
            _write_odometer(log),
            *map(_write_series, log.sensors.values()),
            _write_truth(log),
        )
        if f is not None
    ]
    for file in files:
        write_csv(folder / file.name, file.header, file.columns)
    path = folder / "recording.toml"
    path.write_text(_write_toml(log), encoding="utf-8")
    return [path, *(folder / file.name for file in files)]


def write_folder(recording: Recording, folder: str | Path, notes: Sequence[str] = ()) -> list[Path]:
    """Write a recording; `notes` become comments of recording.toml."""
    r = recording
    log = Log(
        r.name,
        r.imu,
        r.gnss,
        r.odometer,
        r.truth,
        r.platform,
        gps_zero=r.gps_zero,
        remarks=tuple(notes),
        sensors=r.sensors,
    )
    return write_recording(log, Path(folder))


def convert_to_degrees(angle: Array) -> Array:
    """Degrees that, times pi/180, give the radians bit for bit if such exist.

    They do where the radians were converted from degrees; those with the fewest digits are chosen. Otherwise the result
    is the nearest, with an error of a part in 1e16.
    """
    plain = np.asarray(angle, dtype=float) / _DEG
    best = plain.copy()
    todo = plain * _DEG != angle
    for step in (1, -1, 2, -2):
        near = plain
        for _ in range(abs(step)):
            near = np.nextafter(near, np.inf * step)
        fits = todo & (near * _DEG == angle)
        best[fits], todo = near[fits], todo & ~fits
    for digits in range(13, 5, -1):
        short = np.round(plain, digits)
        fits = short * _DEG == angle
        best[fits] = short[fits]
    return best


def _write_imu(log: Log) -> _File | None:
    if log.imu is None:
        return None
    columns = [log.imu.t, *log.imu.gyro.T, *log.imu.accel.T]
    return _File("imu.csv.gz", ["t", "gx", "gy", "gz", "ax", "ay", "az"], columns)


def _write_gnss(log: Log) -> _File | None:
    if log.gnss is None:
        return None
    gnss = log.gnss
    columns = [gnss.t, *convert_to_degrees(gnss.llh[:, :2]).T, gnss.llh[:, 2], *gnss.sd.T]
    header = ["t", "lat", "lon", "h", "sd_e", "sd_n", "sd_u"]
    if gnss.v is not None:
        columns += [*gnss.v.T]
        header += ["ve", "vn", "vu"]
        if gnss.sd_v is not None:
            columns += [*gnss.sd_v.T]
            header += ["sd_ve", "sd_vn", "sd_vu"]
    if gnss.type is not None:
        columns, header = [*columns, np.where(gnss.type > 0, gnss.type, np.nan)], [*header, "type"]
    if gnss.satellites is not None:
        columns, header = [*columns, gnss.satellites], [*header, "satellites"]
    if gnss.residual_rms is not None:
        columns, header = [*columns, gnss.residual_rms], [*header, "resid_rms_m"]
    return _File("gnss.csv.gz", header, columns)


def _write_odometer(log: Log) -> _File | None:
    if log.odometer is None:
        return None
    odometer = log.odometer
    header, columns = ["t", "speed"], [odometer.t, odometer.speed]
    if odometer.counted is not None:
        header, columns = [*header, "pulses"], [*columns, np.round(odometer.counted / odometer.pulse)]
    if odometer.wheels is not None:
        header, columns = [*header, *WHEELS], [*columns, *odometer.wheels.T]
    return _File("odometer.csv.gz", header, columns)


def _write_series(series: Series) -> _File:
    """Its columns in their default units; columns without values are omitted."""
    header, columns = ["t"], [series.t]
    for column in series.sensor.columns:
        values, size = series[column.name], next(iter(column.units.values()))
        if np.isfinite(values).any():
            columns.append(convert_to_degrees(values) if size == _DEG else values / size)
            header.append(column.name)
    return _File(f"{series.sensor.name}.csv.gz", header, columns)


def _write_truth(log: Log) -> _File | None:
    truth = log.truth
    if truth is None or truth.closed_loop_sigma is not None:
        return None
    header, columns = ["t"], [truth.t]
    if truth.llh is not None:
        header += ["lat", "lon", "h"]
        columns += [*convert_to_degrees(truth.llh[:, :2]).T, truth.llh[:, 2]]
    elif truth.xyz is not None:
        header += ["x", "y", "z"][: truth.xyz.shape[1]]
        columns += [*truth.xyz.T]
    for names, values in (("ve vn vu", truth.v), ("roll pitch heading", truth.rph)):
        if values is not None:
            header += names.split()
            columns += [*(values if names[0] == "v" else convert_to_degrees(values)).T]
    return _File("truth.csv.gz", header, columns)


def write_csv(path: Path, header: list[str], columns: list[Array]) -> None:
    """Write columns as gzipped CSV; NaN is blank."""
    table = np.column_stack(columns)
    row = ",".join(["%r"] * len(header)) + "\n"
    # no time stamp in the file, so that the same log gives the same bytes
    with path.open("wb") as raw, gzip.GzipFile("", "wb", 4, raw, mtime=0) as file:
        file.write((",".join(header) + "\n").encode())
        for start in range(0, len(table), 2000):
            tell(f"writing {path.name}", start / len(table))
            part = table[start : start + 2000]
            text = row * len(part) % tuple(part.ravel().tolist())
            file.write(text.replace("nan", "").encode())


def _write_toml(log: Log) -> str:
    lines = [*(f"# {line}" for line in log.remarks), ""] if log.remarks else []
    lines += [
        'format = "graphnav-recording/1"',
        f"name = {quote(log.name)}",
        f'platform = "{log.platform}"',
    ]
    if log.gps_zero is not None:
        lines.append(f'clock = "{format_clock(log.gps_zero)}"'.ljust(31) + "# what t counts from")
    lines += ["", "[imu]"]
    if log.imu is None:
        lines += ['file = "imu.csv"               # missing: the log holds no IMU. t,gx,gy,gz,ax,ay,az; s, rad/s, m/s2']
        lines += ['axes = "RFU"                   # where its x, y, z point']
    else:
        lines += ['file = "imu.csv.gz"            # t,gx,gy,gz,ax,ay,az; s, rad/s, m/s2']
        lines += ['axes = "RFU"                   # x right, y forward, z up, whatever they were in the log']
        lines += _write_noise(log.imu.noise, log.imu.noise_assumed)
    if log.gnss is not None:
        lines += [
            "",
            "[gnss]",
            'file = "gnss.csv.gz"           # t,lat,lon,h,...; s, deg, m, m/s; 1-sigmas in m and m/s',
        ]
        lines += [
            f"lever_arm = {_format_list(log.gnss.lever_arm)}    # from the IMU to the antenna, m: right, forward, up"
        ]
        if log.gnss.velocity_offset:
            lines += [
                f"velocity_offset = {log.gnss.velocity_offset!r}".ljust(31) + "# s from t to the times of velocities"
            ]
    if log.odometer is not None:
        lines += ["", "[odometer]", 'file = "odometer.csv.gz"       # t,speed; s, m/s, forward positive']
        lines += [
            f"lever_arm = {_format_list(log.odometer.lever_arm)}    # to the point that does not slip sideways, m"
        ]
        lines += _write_odometer_keys(log.odometer)
    for name, series in log.sensors.items():
        units = ", ".join(f"{c.name} in {next(iter(c.units))}" for c in series.sensor.columns)
        lines += ["", f"[{name}]", f'file = "{name}.csv.gz"'.ljust(31) + f"# t in s; {units}"]
        lines += [
            f"{key} = {_format_toml(value)}" for key, value in series.figures.model_dump(exclude_none=True).items()
        ]
    if log.truth is not None:
        lines += ["", "[truth]                        # only for evaluation"]
        if log.truth.closed_loop_sigma is not None:
            lines += [f"closed_loop_sigma = {log.truth.closed_loop_sigma!r}       # m; the end is the start"]
        else:
            lines += ['file = "truth.csv.gz"']
        lines += (
            ['frame = "local"                # metres, of unknown origin and yaw'] if log.truth.xyz is not None else []
        )
        lines += [f"of = {_format_toml(log.truth.of)}"]
    return "\n".join(lines) + "\n"


def _write_odometer_keys(odometer: Odometer) -> list[str]:
    lines = []
    if odometer.counted is not None:
        lines += [f"metres_per_pulse = {float(odometer.pulse)!r}", 'pulses = "cumulative"']
    lines += [f"scale_sigma = {float(odometer.scale_sigma)!r}", f"signed = {str(odometer.signed).lower()}"]
    if odometer.speed_sigma is not None:
        lines.append(f"speed_sigma = {float(odometer.speed_sigma)!r}".ljust(31) + "# m/s, of one reading")
    if odometer.delay_sigma:
        lines.append(f"delay_sigma = {float(odometer.delay_sigma)!r}".ljust(31) + "# s, of the stamps")
    return lines


def _write_noise(noise: ImuNoise, assumed: bool) -> list[str]:
    if assumed:
        return [
            "# no noise figures are in the log: those of a consumer IMU are assumed until [imu.noise] or model is given"
        ]
    lines = ["", "[imu.noise]                    # 1-sigma"]
    for f in fields(noise):
        value = float(getattr(noise, f.name))
        lines.append(f"{f.name} = {value!r}".ljust(48) + f"# {NOISE_UNITS[f.name]}")
    return lines


def _format_toml(value: Any) -> str:
    """JSON's numbers, strings and lists are valid TOML."""
    return quote(value) if isinstance(value, str) else json.dumps(value)


def _format_list(values: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in values) + "]"


def quote(text: str) -> str:
    """A TOML string."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'
