"""The line protocol of a live source: text, one row per line, described in docs/online.md.

graphnav-online/1 {"platform": "vehicle", "imu": {"noise": {...}}, "gnss": {"lever_arm": [0, 0, 1.2]}}
I,t,gx,gy,gz,ax,ay,az
G,t,lat,lon,h,sd_e,sd_n,sd_u[,ve,vn,vu,sd_ve,sd_vn,sd_vu[,resid_rms_m,nsat]]
O,t,speed
R,t,place and clock;satellite,signal,...;...   raw observations, one epoch per line (`graphnav.online.raw_lines`)
S,name,t,...                  another sensor (`graphnav.sensors`): its columns
E

All in the default units of files, and axes of the body, unless the first line states others.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError, create_model

from graphnav.core.complaints import describe_invalid, suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_json, parse_number
from graphnav.core.rotation import Array
from graphnav.online.raw import RAW
from graphnav.online.raw_lines import LiveRaw, describe_live_raw, format_epoch, parse_epoch
from graphnav.online.replay import list_rows
from graphnav.online.sensors import Row
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, Recording
from graphnav.recording.formats.schema import (
    FORCE,
    HEIGHT,
    RATE_UNITS,
    SPEED,
    GnssUnits,
    ImuDescription,
    OdometerUnits,
)
from graphnav.sensors import Column, Sensor, Series, list_sensors
from graphnav.sensors.tables import ANGLE, TIME_UNITS, NotNegative, Number, Positive, TomlTable, Vector

PROTOCOL = "graphnav-online/1"
END = "E"
_NONE, _ROWS = np.empty(0), np.empty((0, 3))
_BLANK = (float("nan"),) * 6


class _Imu(ImuDescription):
    time_offset: Number = 0.0


class _Gnss(TomlTable):
    time_offset: Number = 0.0
    units: GnssUnits = GnssUnits()
    lever_arm: Vector = (0.0, 0.0, 0.0)


class _Odometer(TomlTable):
    time_offset: Number = 0.0
    units: OdometerUnits = OdometerUnits()
    lever_arm: Vector = (0.0, 0.0, 0.0)
    scale_sigma: Positive = 0.02
    signed: bool = True
    speed_sigma: Positive | None = None
    delay_sigma: NotNegative = 0.0


class _Setup(TomlTable):
    name: str = "online"
    platform: Literal["vehicle", "foot"] = "vehicle"
    imu: _Imu = _Imu()
    gnss: _Gnss | None = None
    odometer: _Odometer | None = None
    raw_gnss: LiveRaw | None = None


@dataclass(frozen=True)
class LineUnits:
    """Units and axes of the numbers in a source's lines, by sensor; those of rows where a sensor is not named."""

    times: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # size of the unit and offset, s
    sizes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # of the units of its numbers, in SI
    R_bs: Array | None = None  # body (RFU) from the IMU's axes, (3, 3); None: they are those of the body

    def convert(self, row: Row) -> Row:
        """A row in SI and body axes of one in the source's units, on the clock that its offsets make common."""
        sensor, t, values = row
        if sensor in self.times:
            size, offset = self.times[sensor]
            t = size * t + offset
        if sensor in self.sizes:
            values = tuple(x * size for x, size in zip(values, self.sizes[sensor], strict=False))
        if sensor == "imu" and self.R_bs is not None:
            values = (*(self.R_bs @ values[:3]).tolist(), *(self.R_bs @ values[3:]).tolist())
        return sensor, t, values


def parse_setup(line: str) -> Recording:
    """The sensors described by the first line of a source, as `read_setup`."""
    return read_setup(line)[0]


def read_setup(line: str) -> tuple[Recording, LineUnits]:
    """The sensors described by the first line of a source, and the units of the lines that follow.

    Raises
    ------
    RecordingError
        In one plain sentence, if it is not such a line.
    """
    word, _, text = line.strip().partition(" ")
    if word != PROTOCOL:
        raise RecordingError(
            f"line 1: a live source begins with '{PROTOCOL}' and a setup as JSON, not with '{line[:40]}'",
            key="online.first_line",
        )
    try:
        keys = parse_json(text or "{}")
    except ValueError as error:
        raise RecordingError(f"line 1: the setup is not JSON ({error})", key="online.setup_json") from None
    return make_setup(keys, "line 1: setup")


def make_setup(keys: Mapping[str, Any], where: str = "setup") -> tuple[Recording, LineUnits]:
    """The sensors described by the keys of the first line of a source, and the units of its numbers.

    Parameters
    ----------
    keys
        Tables of recording.toml without files: ``{"imu": {"axes": "FRD", "units": {"gyro": "deg/s"}}, "gnss": {}}``.
    where
        They stand, for errors.

    Returns
    -------
    setup : Recording
        Without rows, as `Online` needs it.
    units : LineUnits
        For `ImuSample`, `Fix`, `WheelSpeed` and `Reading`.

    Raises
    ------
    RecordingError
        In one plain sentence, if a key or value is none.
    """
    known = list_sensors()
    others: Any = {name: (_describe_live(sensor) | None, None) for name, sensor in known.items()}
    model = create_model("_Setup", __base__=_Setup, **others)
    try:
        found = model.model_validate(keys)
    except ValidationError as error:
        raise RecordingError(describe_invalid(where, error, model)) from None
    try:
        R_bs = found.imu.R_bs
    except ValueError as error:
        raise RecordingError(f"{where}: 'imu.axes', 'forward' or 'up' {error}", key="key.value") from None
    stated = found.imu.figures
    gnss = odometer = None
    if found.gnss is not None:
        derived = found.raw_gnss is not None  # fixes are used for the start
        gnss = Gnss(_NONE, _ROWS, _ROWS, lever_arm=np.array(found.gnss.lever_arm), derived=derived)
    if (o := found.odometer) is not None:
        odometer = Odometer(
            _NONE, _NONE, np.array(o.lever_arm), o.scale_sigma,
            signed=o.signed, speed_sigma=o.speed_sigma, delay_sigma=o.delay_sigma,
        )  # fmt: skip
    imu = Imu(_NONE, _ROWS, _ROWS, ImuNoise(**stated), R_bs, noise_assumed=not stated)
    others = {name: (sensor, one) for name, sensor in known.items() if (one := getattr(found, name)) is not None}
    sensors = {
        name: Series(
            sensor,
            _NONE,
            np.empty((0, len(sensor.names))),
            sensor.figures(**{key: getattr(one, key) for key in sensor.figures.model_fields}),
        )
        for name, (sensor, one) in others.items()
    }
    raw = None if found.raw_gnss is None else found.raw_gnss.make_setup()
    recording = Recording(found.name, found.platform, imu, gnss, odometer, sensors=sensors, raw_gnss=raw)
    return recording, _find_units(found, others)


def _describe_live(sensor: Sensor) -> type[TomlTable]:
    """The model of a sensor in the first line: its figures, and the units of its columns."""
    units = sensor.table.model_fields["units"]
    make: Any = create_model  # whose fields are not known statically
    return make(  # type: ignore[no-any-return]
        f"{sensor.name}_live",
        __base__=(sensor.figures,),
        units=(units.annotation, units.default),
        time_offset=(Number, 0.0),
    )


def _find_units(found: Any, others: Mapping[str, tuple[Sensor, Any]]) -> LineUnits:
    """The units that a setup states, of those sensors where they are not the units of rows."""
    given = {"imu": found.imu, "gnss": found.gnss, "odometer": found.odometer}
    given |= {name: one for name, (_, one) in others.items()}
    given = {name: one for name, one in given.items() if one is not None}
    times = {name: (TIME_UNITS[one.units.t], one.time_offset) for name, one in given.items()}
    sizes: dict[str, tuple[float, ...]] = {
        "imu": (RATE_UNITS[found.imu.units.gyro],) * 3 + (FORCE[found.imu.units.accel],) * 3
    }
    if (gnss := found.gnss) is not None:
        angle = ANGLE[gnss.units.angle or "deg"] / ANGLE["deg"]
        sizes["gnss"] = angle, angle, HEIGHT[gnss.units.height], *(1.0,) * 3, *(SPEED[gnss.units.speed],) * 6, 1.0, 1.0
    if found.odometer is not None:
        sizes["odometer"] = (SPEED[found.odometer.units.speed],) * 6
    for name, (sensor, one) in others.items():
        sizes[name] = tuple(c.units[getattr(one.units, c.name)] / tell_scale(c) for c in sensor.columns)
    R_bs = found.imu.R_bs
    return LineUnits(
        {name: time for name, time in times.items() if time != (1.0, 0.0)},
        {name: size for name, size in sizes.items() if set(size) != {1.0}},
        None if np.array_equal(R_bs, np.eye(3)) else R_bs,
    )


def parse_row(line: str, units: LineUnits | None = None) -> Row | None:
    """Parse a row into SI; None for an empty line or a comment.

    Raises
    ------
    ValueError
        In a few words, if it is neither.
    """
    line = line.strip()
    if not line or line.startswith("#"):
        return None
    row = _parse_line(line)
    return row if units is None else units.convert(row)


def _parse_line(line: str) -> Row:
    """A row in the units of a source that states none."""
    kind, *cells = line.split(",")
    if kind == "S":
        return _parse_series_row(cells)
    if kind == "R":
        t, _, text = line[2:].partition(",")
        return RAW, parse_number(t), parse_epoch(text)
    try:
        numbers = [parse_number(cell) if cell.strip() else float("nan") for cell in cells]
    except ValueError:
        raise ValueError(f"'{line[:40]}' holds something that is no number") from None
    if kind == "I" and len(numbers) == 7:
        return "imu", numbers[0], tuple(numbers[1:])
    if kind == "G" and len(numbers) in (7, 13, 15):
        place = (np.radians(numbers[1]), np.radians(numbers[2]), *numbers[3:7])
        return "gnss", numbers[0], (*map(float, place), *(numbers[7:] or _BLANK))
    if kind == "O" and len(numbers) == 2:
        return "odometer", numbers[0], (numbers[1], *_BLANK[:5])
    wanted = {"I": "7", "G": "7, 13 or 15", "O": "2"}.get(kind)
    raise ValueError(
        f"'{kind}' needs {wanted} numbers, not {len(numbers)}" if wanted else f"no rows of kind '{kind[:10]}'"
    )


def _parse_series_row(cells: list[str]) -> Row:
    name, sensor = cells[0] if cells else "", list_sensors().get(cells[0] if cells else "")
    if sensor is None:
        raise ValueError(f"no sensor '{name[:20]}' is known; {suggest_nearest(name, tuple(list_sensors()))}")
    if len(cells) != 2 + len(sensor.names):
        raise ValueError(f"'S,{name}' needs {1 + len(sensor.names)} numbers, not {len(cells) - 1}")
    try:
        t, *numbers = (parse_number(cell) if cell.strip() else float("nan") for cell in cells[1:])
    except ValueError:
        raise ValueError(f"'S,{','.join(cells)[:40]}' holds something that is no number") from None
    return name, t, tuple(x * tell_scale(c) for x, c in zip(numbers, sensor.columns, strict=True))


def tell_scale(column: Column) -> float:
    """Size in SI of the default unit of files."""
    return next(iter(column.units.values()))


def format_head(recording: Recording) -> str:
    """The first line that describes the sensors of a recording."""
    setup: dict[str, object] = {"name": recording.name, "platform": recording.platform}
    setup["imu"] = {"noise": asdict(recording.imu.noise)}
    if recording.gnss is not None:
        setup["gnss"] = {"lever_arm": recording.gnss.lever_arm.tolist()}
    o = recording.odometer
    if o is not None:
        setup["odometer"] = {
            "lever_arm": o.lever_arm.tolist(), "scale_sigma": o.scale_sigma, "signed": o.signed,
            "speed_sigma": o.speed_sigma, "delay_sigma": o.delay_sigma,
        }  # fmt: skip
    if recording.raw_gnss is not None:
        setup["raw_gnss"] = describe_live_raw(recording.raw_gnss)
    setup |= {name: series.figures.model_dump() for name, series in recording.sensors.items()}
    return f"{PROTOCOL} {json.dumps(setup)}"


def format_line(row: Row) -> str:
    """The line of a row; every number reads back exactly."""
    sensor, t, values = row
    if sensor == "imu":
        return f"I,{t!r}," + ",".join(map(repr, values))
    if sensor == "odometer":
        return f"O,{t!r},{values[0]!r}"
    if sensor == RAW:
        return f"R,{t!r},{format_epoch(values)}"
    if sensor != "gnss":
        columns = list_sensors()[sensor].columns
        numbers = [x / tell_scale(column) for x, column in zip(values, columns, strict=True)]
        return f"S,{sensor},{t!r}," + ",".join("" if np.isnan(x) else repr(x) for x in numbers)
    lat, lon = float(np.degrees(values[0])), float(np.degrees(values[1]))
    rest = values[2:6] if np.isnan(values[6]) and len(values) == 12 else values[2:]
    return f"G,{t!r},{lat!r},{lon!r}," + ",".join("" if np.isnan(x) else repr(x) for x in rest)


def format_lines(recording: Recording) -> Iterator[tuple[float, str]]:
    """A recording as a live source would send it: time and line, including the first line and the end."""
    yield recording.start, format_head(recording)
    for row in list_rows(recording)[1]:
        yield row[1], format_line(row)
    yield recording.end, END


def split(chunks: Iterable[bytes]) -> Iterator[str]:
    """Complete lines of a stream that arrives in chunks; anything after the last line end is dropped."""
    rest = b""
    for chunk in chunks:
        *whole, rest = (rest + chunk).split(b"\n")
        for line in whole:
            yield line.decode("utf-8", "replace")
