"""graphnav's own format: a folder with recording.toml and CSV files, or such a .toml."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.core.complaints import resolve_beside
from graphnav.core.earth import ecef_to_llh, enu_axes
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Notes, get_key
from graphnav.core.timescales import parse_clock
from graphnav.gnss.series import RawGnss
from graphnav.recording import Gnss, Imu, Odometer, Recording, Truth
from graphnav.recording.formats import schema
from graphnav.recording.formats.csv_sensors import (
    build_gnss,
    build_imu,
    build_odometer,
    build_series,
    build_truth,
    list_needed,
)
from graphnav.recording.formats.registry import Format, Log
from graphnav.recording.formats.repair import select_usable_rows
from graphnav.recording.formats.table import Table, read_table
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.sensors import list_sensors

if TYPE_CHECKING:
    from graphnav.gnss.series import Observations
    from graphnav.gnss.single_point import SinglePoint

_SETTLED = {  # assumptions of a log's reader, and the keys that replace them
    "axes_assumed": {"axes", "forward", "up"},
    "lever_arm_unknown": {"lever_arm"},
    "sigma_assumed": {"sd"},
}
_RAW_FILES = ("rover", "nav", "sp3", "clk", "antex", "base")


def read_folder(source: str | Path, allow_outside: bool = False) -> Recording:
    """Read a recording from a folder with recording.toml, or from such a .toml.

    Parameters
    ----------
    allow_outside : whether files that it names may lie outside its folder.

    Raises
    ------
    RecordingError
        For anything that cannot be used, naming file, line and field.
    """
    path = Path(source)
    path = path / "recording.toml" if path.is_dir() else path
    d = schema.read_description(path)
    reader = _Reader(path, d, allow_outside)
    imu = reader.read_sensor("imu", build_imu, _complete_imu)
    gnss = reader.read_sensor("gnss", build_gnss, _complete_gnss)
    odometer = reader.read_sensor("odometer", build_odometer, _complete_odometer)
    sensors = {
        name: reader.read_sensor(name, partial(build_series, one), lambda _, held: held)
        for name, one in reader.known.items()
        if name in reader.sections
    }
    gps_zero = parse_clock(d.clock, float(imu.t[0])) if d.clock else next(iter(reader.zeros), None)
    raw = None
    if d.raw_gnss is not None:
        raw, fixes = _load_raw(reader, d.raw_gnss, gps_zero)
        if gnss is None:
            gnss = fixes
            words = f"no [gnss]: {len(fixes.t)} single-point fixes of the raw observations are used"
            reader.remarks.add("gnss.of_raw", words)
    truth = None if d.truth is None else _read_truth(reader, d.truth, imu)
    name = d.name or (path.resolve().parent.name if path.name == "recording.toml" else path.stem)
    return Recording(
        name,
        d.platform,
        imu,
        gnss,
        odometer,
        truth,
        path,
        tuple(reader.files),
        gps_zero,
        tuple(reader.remarks),
        raw_gnss=raw,
        sensors=sensors,
    )


class _Reader:
    """Reads what the tables of a recording.toml name, and keeps what concerns the whole recording."""

    def __init__(self, path: Path, d: schema.RecordingFile, allow_outside: bool) -> None:
        self.path, self.d, self.allow_outside = path, d, allow_outside
        self.known = list_sensors()
        self.sections: dict[str, Any] = {
            name: section
            for name in ("imu", "gnss", "odometer", *self.known)
            if (section := getattr(d, name)) is not None
        }
        self.remarks = Notes()
        self.files = [path]
        self.zeros: list[float] = []  # s since the GPS epoch, at which the clocks of logs begin
        self._logs: dict[str, Log | None] = {}  # by file; one log may contain several sensors
        self._settled = {  # assumptions of logs that the .toml replaces
            f"{name}.{figure}"
            for name, section in self.sections.items()
            for figure, keys in _SETTLED.items()
            if keys & section.model_fields_set
        }

    def resolve(self, file: str, key: str) -> Path:
        """The path of a file that a key names."""
        return resolve_beside(self.path, file, key, self.allow_outside)

    def read_sensor(
        self, name: str, of_table: Callable[[Any, Table, Notes], Any], of_log: Callable[[Any, Any], Any]
    ) -> Any:
        """The sensor of a table of the .toml, from its CSV file or from the log of another program; None without it."""
        section = self.sections.get(name)
        if section is None:
            return None
        log = self._read_log(name, section.file)
        if section.topic and not (log and log.topics):
            raise RecordingError(
                f"{self.path}: '{name}.topic' is only for ROS bags, and {section.file} is none", key="key.not_here"
            )
        if log is None:
            return of_table(section, self.read_rows(name), self.remarks)
        held = log.sensors.get(name) if name in self.known else getattr(log, name)
        if held is None:
            raise RecordingError(f"{self.path}: '{name}.file': {section.file} holds no {name}", key="log.no_sensor")
        for key in ("columns", "units", "keep"):
            if key in section.model_fields_set:
                raise RecordingError(
                    f"{self.path}: '{name}.{key}' is only for CSV files, and {section.file} is none", key="key.not_here"
                )
        self.remarks.extend(r for r in log.remarks if r not in self.remarks and get_key(r) not in self._settled)
        if log.gps_zero is not None:
            self.zeros.append(log.gps_zero - section.time_offset)
        return of_log(section, held)

    def read_rows(self, name: str) -> Table:
        """The usable rows of the CSV file of a table."""
        section = getattr(self.d, name)
        file = self.resolve(section.file, f"{name}.file")
        self.files.append(file)
        required, optional, keep = section.required, section.optional, section.keep
        if name == "truth":
            position = ("x", "y") if section.frame == "local" else ("lat", "lon", "h")
            required, optional = (*required, *position), tuple(c for c in optional if c not in position)
        rows = read_table(file, required, optional, section.columns, keep.column if keep else None)
        if name == "odometer":  # the columns needed depend on those present
            required = (*required, *section.list_readings(tuple(rows.columns)))
            if not all(column in rows for column in required):
                read_table(file, required, (), section.columns)  # raises an error that says what is missing
        if name in self.known:
            required = (*required, *list_needed(self.known[name], rows))
        return select_usable_rows(rows, name, required, keep, section.units.t, section.time_offset, self.remarks)

    def _read_log(self, name: str, file: str) -> Log | None:
        """The log of another program that a table names, read once; None for a CSV file."""
        if file not in self._logs:
            topics = (topic for one in self.sections.values() if one.file == file for topic in one.topic)
            path = self.resolve(file, f"{name}.file")
            self._logs[file] = read_other_log(path, tuple(topics), self.allow_outside)
        log = self._logs[file]
        if log is not None:
            self.files.extend(one for one in log.files if one not in self.files)
        return log


def _load_raw(reader: _Reader, d: schema.RawGnssTable, zero: float | None) -> tuple[RawGnss, Gnss]:
    """The raw observations of [raw_gnss], and single-point fixes computed from them."""
    if zero is None:
        raise RecordingError(
            f"{reader.path}: 'clock': [raw_gnss] needs to know what t = 0 is: "
            'set clock = "gps week 2130" or a UTC date',
            key="clock.unknown",
        )
    from graphnav.gnss.load import Sources, load_raw
    from graphnav.gnss.placing import Corrected

    some = {
        name: tuple(reader.resolve(file, f"raw_gnss.{name}") for file in getattr(d, name) or ()) for name in _RAW_FILES
    }
    corrected = Corrected(clock="clock" in d.corrected, troposphere="troposphere" in d.corrected)
    sources = Sources(
        **some, base_position=d.base_position, corrected=corrected, nominal_stamps=d.stamps == "nominal",
        lever_arm=d.lever_arm,
    )  # fmt: skip
    reader.files.extend(sources.files)
    raw, found, notes = load_raw(sources, zero - d.time_offset, _read_observations(reader, d, sources.rover, zero))
    reader.remarks.extend(notes)
    return raw, _make_fixes(found, d.lever_arm)


def _read_observations(
    reader: _Reader, d: schema.RawGnssTable, rover: Sequence[Path], zero: float
) -> Observations | None:
    """The rover's observations if its file is CSV, else None."""
    from graphnav.gnss import columns

    if not rover[0].name.endswith((".csv", ".csv.gz")):
        if d.columns:
            raise RecordingError(
                f"{reader.path}: 'raw_gnss.columns' is only for a CSV file, and {d.rover[0]} is none",
                key="key.not_here",
            )
        return None
    if len(rover) > 1:
        raise RecordingError(f"{reader.path}: 'raw_gnss.rover': one CSV file, not {len(rover)}", key="key.value")
    rows = read_table(rover[0], columns.REQUIRED, columns.OPTIONAL, d.columns)
    return columns.make_observations(rows.columns, zero, rover[0].name)


def _make_fixes(found: SinglePoint, lever_arm: Sequence[float]) -> Gnss:
    """Fixes of the single-point solutions there are."""
    good = np.isfinite(found.p[:, 0])
    sd = np.sqrt(np.diagonal(found.covariance[good], axis1=1, axis2=2))
    v = np.einsum("nij,nj->ni", enu_axes(ecef_to_llh(found.p[good])), found.v[good])
    sd_v = np.sqrt(np.diagonal(found.covariance_v[good], axis1=1, axis2=2))
    known = np.isfinite(v).any()
    return Gnss(
        found.t[good], ecef_to_llh(found.p[good]), sd, v if known else None, sd_v if known else None,
        np.array(lever_arm), derived=True,
    )  # fmt: skip


def _read_truth(reader: _Reader, d: schema.TruthTable, imu: Imu) -> Truth:
    """The truth of a CSV file, of a trajectory file of another program, or that a loop closes."""
    if d.closed_loop_sigma:
        return Truth(imu.t[[0, -1]], of=d.of, closed_loop_sigma=d.closed_loop_sigma)
    if d.file is None or Path(d.file).suffix not in (".nav", ".pos", ".tum"):
        return build_truth(d, reader.read_rows("truth"), reader.remarks)
    file = reader.resolve(d.file, "truth.file")
    reader.files.append(file)
    for key in ("columns", "units", "keep"):
        if key in d.model_fields_set:
            raise RecordingError(f"{file}: 'truth.{key}' is only for CSV files", key="key.not_here")
    track = read_trajectory(file)
    reader.remarks.extend(track.notes)
    local = track.frame == "local"
    llh, xyz = (None, track.llh) if local else (track.llh, None)
    return Truth(track.t + d.time_offset, llh, xyz, track.v, track.rph, d.of)


def read_other_log(file: Path, topics: Sequence[str] = (), allow_outside: bool = False) -> Log | None:
    """The log of another program, or None for a CSV file or a missing one.

    Parameters
    ----------
    topics : for a ROS bag.
    allow_outside : whether files that it names may lie outside its folder.
    """
    from graphnav.recording.formats import list_formats  # which imports this module

    if file.name.endswith((".csv", ".csv.gz")) or not file.exists():
        return None
    for known in list_formats().values():
        if known.load is not None and known.recognises(file):
            if topics and known.choose is not None:
                return known.choose(file, topics)
            return known.load(file, allow_outside)
    return None


def _complete_imu(d: schema.ImuTable, imu: Imu) -> Imu:
    """The IMU of another program's log, completed by the .toml."""
    if {"axes", "forward", "up"} & d.model_fields_set:
        turn = d.R_bs @ imu.R_bs.T  # the .toml refers to the file's own axes
        imu = replace(imu, gyro=imu.gyro @ turn.T, accel=imu.accel @ turn.T, R_bs=d.R_bs)
    stated = d.figures if d.noise or d.model else {}
    return replace(
        imu, t=imu.t + d.time_offset, noise=replace(imu.noise, **stated), noise_assumed=imu.noise_assumed and not stated
    )


def _complete_gnss(d: schema.GnssTable, gnss: Gnss) -> Gnss:
    lever_arm = np.array(d.lever_arm) if "lever_arm" in d.model_fields_set else gnss.lever_arm
    sd = gnss.sd if d.sd is None else np.tile(d.sd, (len(gnss.t), 1))
    sd_v = gnss.sd_v
    if gnss.v is not None and d.sd_v is not None:
        sd_v = np.where(np.isnan(gnss.v), np.nan, np.array(d.sd_v))
    offset = d.velocity_offset if "velocity_offset" in d.model_fields_set else gnss.velocity_offset
    return replace(gnss, t=gnss.t + d.time_offset, lever_arm=lever_arm, sd=sd, sd_v=sd_v, velocity_offset=offset)


def _complete_odometer(d: schema.OdometerTable, odometer: Odometer) -> Odometer:
    lever_arm = np.array(d.lever_arm) if "lever_arm" in d.model_fields_set else odometer.lever_arm
    return replace(odometer, t=odometer.t + d.time_offset, lever_arm=lever_arm, scale_sigma=d.scale_sigma)


FORMAT = Format(
    name="folder",
    about="a folder holding recording.toml and CSV files, or a .toml of that form",
    recognises=lambda source: Path(source).suffix == ".toml" or (Path(source) / "recording.toml").is_file(),
    read=read_folder,
)
