"""The logs of a draft: selection among several of one sensor, and combination of those that belong together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.core.timescales import DAY, NEAR, UNIX, gps_to_utc
from graphnav.recording.draft import guesses, motion
from graphnav.recording.draft.guesses import Guess
from graphnav.recording.draft.logs import CALLED, NoSensorError, has_gravity, read_log
from graphnav.recording.draft.parts import join_parts
from graphnav.recording.draft.raw import RawFiles, separate_raw, tell_kind
from graphnav.recording.draft.references import separate_reference
from graphnav.recording.draft.tables import WANTED, Source
from graphnav.recording.formats import columns as matching
from graphnav.recording.formats import list_formats
from graphnav.recording.formats.schema import SPEED
from graphnav.sensors.tables import ANGLE

JOINED = "joined_imu.csv.gz"  # the file combined from a gyro's and an accelerometer's; no log has this name

_TEXT_ENDINGS = (".csv", ".txt", ".tsv", ".dat", ".asc", ".log")  # of files of a folder that are considered

_PROSE = re.compile(r"licen[cs]e|readme|copying|notice", re.IGNORECASE)  # names of files beside logs
_TRACKS = (".gpx", ".kml", ".kmz", ".fit", ".tcx", ".geojson")
_OF_RECEIVERS = (".rtcm", ".rtcm2", ".rtcm3", ".sbf", ".t02", ".t04", ".jps", ".gps", ".bnx")  # their own forms
_POSITIONS = re.compile(r"(?:^|[^a-z])(?:gnss|gps|rtk|location|position|track|fix)(?:$|[^a-rt-z])", re.IGNORECASE)


@dataclass
class LogsFound:
    """The contents of logs, by sensor, and a sentence for each file that is left out or added to another."""

    sensors: dict[str, Source]
    notes: list[str]
    raw: RawFiles


def find_logs(paths: Sequence[Path], topics: Sequence[str] = ()) -> LogsFound:
    """The contents of logs by sensor; of a folder all that is in it. Files without sensor data are left out.

    Raises
    ------
    RecordingError
        If the only file holds nothing that is known, if one of a sensor cannot be read, if two hold the same, or none
        an IMU.
    """
    raw, files = separate_raw([file for path in paths for file in _list_logs(path)])
    if not files:
        raise RecordingError(f"{paths[0]}: observations of GNSS, and no IMU beside them", key="draft.no_imu")
    every, unread = _read_logs(paths, files, topics, alone=not raw.observed)
    others = _name_others(paths, [*files, *raw.observed, *(path for some in raw.placing.values() for path in some)])
    left = [f"{others}: no logs of a kind that is known"] if others else []
    left += unread.list_notes()
    every["gnss"], reference = separate_reference(every.get("gnss", []))
    sensors = {
        sensor: chosen for sensor, some in every.items() if (chosen := _choose_source(sensor, some, left)) is not None
    }
    if reference is not None:
        sensors["truth"] = reference
    if "imu" not in sensors and "gyro" in sensors:
        _make_imu(sensors, every, left)
    if "imu" not in sensors:
        there = ", ".join([*sensors, *(["raw GNSS"] if raw.observed else [])]) or "nothing"
        cause = _explain_no_imu(every, unread, "" if raw.observed else others)
        raise RecordingError(
            f"{paths[0]}: no IMU in these logs (found: {there}); three gyro and three force columns are one{cause}",
            key="draft.no_imu",
        )
    if not sensors.keys() & {"gnss", "odometer"} and not raw.observed:
        named = {path: why for path, why in unread.refused.items() if path in paths}
        _check_unread(paths, {path: unread.nothing[path.name] for path in files if path.name in unread.nothing}, named)
    _date_times_of_day(sensors)
    _tell_gps_from_unix(sensors)
    parts = [s.path.name for name in ("gyro", "accel", "gravity") for s in every.get(name, ())]
    if "imu" in every and parts:
        left.append(f"left out: {', '.join(parts)}: {sensors['imu'].path.name} holds both")
    if (air := sensors.get("barometer")) is not None and guess_file_pressure_unit(air) is None:
        left.append(f"left out: {air.path.name}: its pressures are not those of air in any unit")
        del sensors["barometer"]
    return LogsFound(
        {name: sensors[name] for name in ("imu", "gnss", "odometer", "barometer", "truth") if name in sensors},
        left,
        raw,
    )


@dataclass(frozen=True)
class _Unread:
    """Files without a known sensor, with the reasons."""

    nothing: dict[str, str] = field(default_factory=dict)  # by the names of files
    refused: dict[Path, str] = field(default_factory=dict)  # those of them that are no tables

    def list_notes(self) -> list[str]:
        """A sentence for those that are tables, and for each that is none."""
        unknown = ", ".join(name for name, why in self.nothing.items() if why not in self.refused.values())
        tables = f"left out: {unknown}: no sensor is recognised in the columns; names that are: {CALLED}"
        return [*([tables] if unknown else []), *(f"left out: {why}" for why in self.refused.values())]


def _read_logs(
    paths: Sequence[Path], files: Sequence[Path], topics: Sequence[str], alone: bool
) -> tuple[dict[str, list[Source]], _Unread]:
    """The logs of each sensor, and the files that hold none.

    Raises
    ------
    RecordingError
        If the only file holds none, where nothing else was found (`alone`), or one of `paths` cannot be read.
    """
    every: dict[str, list[Source]] = {}
    unread = _Unread()
    for path in files:
        try:
            found = read_log(path, topics)
        except NoSensorError as error:
            if len(files) == 1 and alone:
                raise
            unread.nothing[path.name if path.exists() else str(error)] = str(error)
            if isinstance(error.__cause__, RecordingError) or error.key == "draft.no_time":
                unread.refused[path] = str(error)
            if path in paths and isinstance(error.__cause__, RecordingError) and error.key != "table.separator":
                raise
            continue
        for sensor, source in found.items():
            every.setdefault(sensor, []).append(source)
    return every, unread


def _make_imu(sensors: dict[str, Source], every: Mapping[str, list[Source]], left: list[str]) -> None:
    """Add the IMU of a gyro's log and an accelerometer's, with a log of gravity if its own forces are without.

    Raises
    ------
    RecordingError
        If no forces are those of an accelerometer.
    """
    if "accel" not in sensors and "accel" in every and "gravity" in sensors:
        sensors["accel"] = _add_gravity(every["accel"][0], sensors["gravity"], left)
    if "accel" in sensors:
        sensors["imu"] = _join_imu(sensors["gyro"], sensors["accel"])
        if (pull := every.get("gravity")) and sensors["accel"] in every["accel"]:
            left.append(f"left out: {pull[0].path.name}: {sensors['accel'].path.name} has gravity in it")
    elif "accel" in every:
        worst = every["accel"][0]
        guesses.guess_accel_unit(worst.path, worst.stack("ax", "ay", "az"), worst.find_unit("ax", "accel"))


def _explain_no_imu(every: Mapping[str, list[Source]], unread: _Unread, others: str) -> str:
    """The likely cause of a missing IMU, in brackets: lines or files that were not read; '' where there is none."""
    logs = [source.log for some in every.values() for source in some if source.log is not None]
    if skipped := [note for log in logs for note in log.remarks if get_key(note) == "log.broken_lines"]:
        return f" ({skipped[0]}; lines of an IMU belong in a table of their own, with a header)"
    if unread.refused:
        return f" ({next(iter(unread.refused.values()))})"
    return f" ({others})" if others else ""


def _date_times_of_day(sensors: dict[str, Source]) -> None:
    """Times of day get the date of another log, if one has dates."""
    dates = {s.path: unix for s in sensors.values() if (unix := _find_unix_start(s)) is not None}
    for source in sensors.values():
        if dates and source.plain is not None and source.plain.daily == source.columns.names["t"]:
            path, begin = next(iter(dates.items()))
            days = round((begin - float(source.t[0])) / DAY)
            source.values["t"] = source.values["t"] + DAY * days
            words = f"{source.plain.words}; CHECK: taken as UTC, of the date of {path.name}"
            source.plain = replace(source.plain, words=words)


def _tell_gps_from_unix(sensors: dict[str, Source]) -> None:
    """Decide what stamps count from that are dates both since the GPS epoch and in Unix time: by the other logs."""
    is_open = {name: s.log is None and s.week == 0 and float(s.t[0]) > UNIX for name, s in sensors.items()}
    known = [unix for name, s in sensors.items() if not is_open[name] and (unix := _find_unix_start(s)) is not None]
    for source in (s for name, s in sensors.items() if is_open[name]):
        as_unix = float(source.t[0])
        as_gps = _find_unix_start(source)
        gps, unix = (any(t is not None and abs(x - t) < NEAR for x in known) for t in (as_gps, as_unix))
        stamps = source.columns.names["t"]
        if unix and not gps:
            why = f"'{stamps}' is Unix time, by the date of the other log"
            source.week = None
        elif gps:
            why = f"'{stamps}' counts from the GPS epoch, by the date of the other log"
        else:
            why = f"CHECK: '{stamps}' is taken as s since the GPS epoch, of which it is a date as in Unix time"
        source.t_unit = replace(source.t_unit, why=why)


def _check_unread(paths: Sequence[Path], tables: Mapping[Path, str], named: Mapping[Path, str]) -> None:
    """Refuse to take for a walk without fixes what has positions in a form that is not read, for the reasons given.

    Parameters
    ----------
    tables : those of no known sensor, with the reasons.
    named : files that were asked for and are no tables, with the reasons.

    Raises
    ------
    RecordingError
        Naming the file.
    """
    inside = [p for path in paths if path.is_dir() for p in sorted(path.iterdir())]
    unread = [p for p in inside if p.suffix.lower() in (*_TRACKS, *_OF_RECEIVERS)]
    unread += [p for p in tables if _POSITIONS.search(p.name) or p in named]
    if unread:
        why = "write them as CSV with t, lat and lon in deg and h in m"
        if unread[0].suffix.lower() in _OF_RECEIVERS:
            why = "write its observations as RINEX, as RTKLIB's convbin does"
        why = tables.get(unread[0], why)
        raise RecordingError(
            f"{unread[0]}: its positions are not read ({why}); else leave the file out",
            key="draft.positions_unread",
        )


def _find_unix_start(source: Source) -> float | None:
    """Unix time of the first row of a log with a known date, s."""
    if source.log is None:
        begin = float(source.t[0])
        if source.week is None:
            return begin if guesses.is_date(source.t) else None
    else:
        begin = next(sensor.t[0] for sensor in source.held)
    if source.gps_zero is None:
        return None
    utc = gps_to_utc(np.array([source.gps_zero + begin]))[0]
    return float((utc - np.datetime64(0, "s")) / np.timedelta64(1, "us")) * 1e-6


def _list_logs(path: Path) -> list[Path]:
    """A log by itself, or those in a folder that is not a log itself."""
    if not path.is_dir() or any(known.load is not None and known.recognises(path) for known in list_formats().values()):
        return [path]
    every = [p for p in path.iterdir() if not p.name.startswith(".") and p.exists()]  # no links that lead nowhere
    made = {JOINED, "recording.toml"}  # written by an earlier draft
    made |= {name_plain_file(p, sensor) for p in every for sensor in WANTED}
    inside = sorted(p for p in every if p.name not in made and not _PROSE.match(p.name))
    logs = [
        p
        for p in inside
        if p.name.lower().removesuffix(".gz").endswith(_TEXT_ENDINGS) or _is_known(p) or tell_kind(p)[0]
    ]
    if not logs:
        there = f" ({others})" if (others := _name_others([path], [])) else ""
        if deeper := sorted(p.name for p in inside if p.is_dir()):
            there += f"; folders in it are not looked into: name {', '.join(deeper[:5])} itself"
        raise RecordingError(
            f"{path}: no log in this folder: no CSV file, and none of a kind that is known{there}", key="draft.no_log"
        )
    return logs


def name_plain_file(path: Path, sensor: str) -> str:
    """The CSV file for a sensor's part of a table of another form."""
    return f"{Path(path.name.removesuffix('.gz')).stem}-{sensor}.csv.gz"


def _name_others(paths: Sequence[Path], files: Sequence[Path]) -> str:
    """The files of folders that are no logs, in words; '' where there are none."""
    known = {*(p.name for p in files), *(name_plain_file(p, s) for p in files for s in WANTED), JOINED}
    every = {p.name for path in paths if path.is_dir() and path not in files for p in path.iterdir() if p.is_file()}
    others = sorted(
        n for n in every - known if not n.startswith(".") and not n.endswith(".toml") and not _PROSE.match(n)
    )
    return f"not read: {', '.join(others[:5])}{', ...' if len(others) > 5 else ''}" if others else ""


def _is_known(path: Path) -> bool:
    return path.suffix != ".toml" and any(
        known.load is not None and known.recognises(path) for known in list_formats().values()
    )


def _choose_source(sensor: str, some: list[Source], left: list[str]) -> Source | None:
    """The log to use of several of one sensor; the others are noted with the reason."""
    if sensor == "accel":
        with_gravity = [s for s in some if has_gravity(s)]
        if len(with_gravity) < len(some) and with_gravity:
            names = ", ".join(s.path.name for s in some if s not in with_gravity)
            left.append(f"left out: {names}: accelerations without gravity")
        some = with_gravity
    if not some:
        return None
    if len(some) > 1 and (whole := join_parts(some)) is not None:
        return whole
    if sensor == "imu" and len(some) > 1:
        raise RecordingError(
            f"{some[1].path}: a second imu, at the same time as {some[0].path}; name only one of them",
            key="draft.two_imus",
        )
    # uncalibrated readings come second: they are the same sensor, on some phones in other units
    best = min(some, key=lambda s: ("uncalibrated" in s.path.name.lower(), -len(s)))
    if sensor == "odometer":
        best = some[0]  # a receiver's speed beside a wheel's
    others = [s.path.name for s in some if s is not best and s.path != best.path]
    if others:
        left.append(f"left out: {', '.join(others)}: a second {sensor}, beside {best.path.name}")
    return best


def _add_gravity(accel: Source, gravity: Source, left: list[str]) -> Source:
    """Accelerations without gravity plus the gravity that the phone subtracted."""
    values = {"t": accel.values["t"]}
    for x in "xyz":
        pull = np.interp(accel.t, gravity.t, gravity.values[f"pull_{x}"])
        values[f"a{x}"] = accel.values[f"a{x}"] + pull
    left.append(f"{accel.path.name} is without gravity: the forces are the sum of it and {gravity.path.name}")
    whole = Source(accel.path, accel.columns, values, t_unit=accel.t_unit)
    guesses.guess_accel_unit(accel.path, whole.stack("ax", "ay", "az"), None)
    return whole


def _join_imu(gyro: Source, accel: Source) -> Source:
    """One IMU from two files, as phones write them: forces interpolated to the times of the rates, in s."""
    t, at = gyro.t, accel.t
    inside = (t >= at[0]) & (t <= at[-1])
    if inside.sum() < 2:
        raise RecordingError(f"{gyro.path} and {accel.path}: do not overlap in time", key="draft.no_overlap")
    values = {"t": t[inside], **{f"g{x}": gyro.values[f"g{x}"][inside] for x in "xyz"}}
    values |= {f"a{x}": np.interp(t[inside], at, accel.values[f"a{x}"]) for x in "xyz"}
    units = {k: u for s in (gyro, accel) for k, u in s.columns.units.items() if k != "t"}
    joined = Source(gyro.path, matching.FileColumns({name: name for name in values}, units), values)
    joined.joined_from, joined.week = (gyro.path, accel.path), gyro.week
    joined.t_unit = Guess("s", f"made of {gyro.columns.names['t']} in {gyro.t_unit.value}: {gyro.t_unit.why}")
    return joined


def read_fixes(source: Source) -> tuple[Array, Array, Array | None]:
    """Times (N,), positions (N, 3) and horizontal velocities (N, 2), or None, of a GNSS log."""
    if source.log is not None:
        gnss = source.log.gnss
        assert gnss is not None
        return gnss.t, gnss.llh, None if gnss.v is None else gnss.v[:, :2]
    values = source.values
    if {"ve", "vn"} <= values.keys():
        return source.t, source.llh, source.stack("ve", "vn") * SPEED[source.find_unit("ve", "speed") or "m/s"]
    if {"speed", "course"} <= values.keys():
        speed = values["speed"] * SPEED[str(guess_fix_speed_unit(source).value)]
        course = values["course"] * ANGLE["rad" if source.find_unit("course", "angle") == "rad" else "deg"]
        return source.t, source.llh, np.stack([speed * np.sin(course), speed * np.cos(course)], -1)
    return source.t, source.llh, None


def guess_fix_speed_unit(source: Source) -> Guess:
    """The unit of a receiver's speed, by its positions."""
    course = motion.compute_course(source.t, source.llh, None)
    return guesses.guess_speed_unit(source.t, source.values["speed"], course, source.find_unit("speed", "speed"))


def guess_file_pressure_unit(source: Source) -> Guess | None:
    """The unit of a barometer's pressures; None where they are not those of air in any."""
    pressure = source.values["pressure"]
    return guesses.guess_pressure_unit(pressure, source.find_unit("pressure", "pressure"))
