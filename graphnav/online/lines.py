"""The line protocol of a live source: text, one row per line, described in docs/online.md.

graphnav-online/1 {"platform": "vehicle", "imu": {"noise": {...}}, "gnss": {"lever_arm": [0, 0, 1.2]}}
I,t,gx,gy,gz,ax,ay,az
G,t,lat,lon,h,sd_e,sd_n,sd_u[,ve,vn,vu,sd_ve,sd_vn,sd_vu]
O,t,speed
R,t,place and clock;satellite,signal,...;...   raw observations, one epoch per line (`graphnav.online.raw_lines`)
S,name,t,...                  another sensor (`graphnav.sensors`): its columns, in the default units of files
E
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from graphnav.core.complaints import describe_invalid, suggest_nearest
from graphnav.core.errors import RecordingError
from graphnav.core.files import parse_json, parse_number
from graphnav.online.raw import RAW
from graphnav.online.raw_lines import LiveRaw, describe_live_raw, format_epoch, parse_epoch
from graphnav.online.replay import list_rows
from graphnav.online.sensors import Row
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer, Recording
from graphnav.recording.formats.schema import Noise
from graphnav.sensors import Column, Series, list_sensors
from graphnav.sensors.tables import NotNegative, Positive, Vector

PROTOCOL = "graphnav-online/1"
END = "E"
_NONE, _ROWS = np.empty(0), np.empty((0, 3))
_BLANK = (float("nan"),) * 6


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Imu(_Part):
    noise: Noise = Noise()  # type: ignore[valid-type]


class _Gnss(_Part):
    lever_arm: Vector = (0.0, 0.0, 0.0)


class _Odometer(_Part):
    lever_arm: Vector = (0.0, 0.0, 0.0)
    scale_sigma: Positive = 0.02
    signed: bool = True
    speed_sigma: Positive | None = None
    delay_sigma: NotNegative = 0.0


class _Setup(_Part):
    name: str = "online"
    platform: Literal["vehicle", "foot"] = "vehicle"
    imu: _Imu = _Imu()
    gnss: _Gnss | None = None
    odometer: _Odometer | None = None
    raw_gnss: LiveRaw | None = None


def parse_setup(line: str) -> Recording:
    """The sensors described by the first line of a source.

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
    known = list_sensors()
    others: Any = {name: (sensor.figures | None, None) for name, sensor in known.items()}
    model = create_model("_Setup", __base__=_Setup, **others)
    try:
        found = model.model_validate(parse_json(text or "{}"))
    except ValidationError as error:
        raise RecordingError(describe_invalid("line 1: setup", error, model)) from None
    except ValueError as error:
        raise RecordingError(f"line 1: the setup is not JSON ({error})", key="online.setup_json") from None
    stated = found.imu.noise.model_dump(exclude_none=True)  # type: ignore[attr-defined]
    gnss = odometer = None
    if found.gnss is not None:
        derived = found.raw_gnss is not None  # fixes are used for the start
        gnss = Gnss(_NONE, _ROWS, _ROWS, lever_arm=np.array(found.gnss.lever_arm), derived=derived)
    if (o := found.odometer) is not None:
        odometer = Odometer(
            _NONE, _NONE, np.array(o.lever_arm), o.scale_sigma,
            signed=o.signed, speed_sigma=o.speed_sigma, delay_sigma=o.delay_sigma,
        )  # fmt: skip
    imu = Imu(_NONE, _ROWS, _ROWS, ImuNoise(**stated), noise_assumed=not stated)
    sensors = {
        name: Series(sensor, _NONE, np.empty((0, len(sensor.names))), figures)
        for name, sensor in known.items()
        if (figures := getattr(found, name)) is not None
    }
    raw = None if found.raw_gnss is None else found.raw_gnss.make_setup()
    return Recording(found.name, found.platform, imu, gnss, odometer, sensors=sensors, raw_gnss=raw)


def parse_row(line: str) -> Row | None:
    """Parse a row; None for an empty line or a comment.

    Raises
    ------
    ValueError
        In a few words, if it is neither.
    """
    line = line.strip()
    if not line or line.startswith("#"):
        return None
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
    if kind == "G" and len(numbers) in (7, 13):
        place = (np.radians(numbers[1]), np.radians(numbers[2]), *numbers[3:7])
        return "gnss", numbers[0], (*map(float, place), *(numbers[7:] or _BLANK))
    if kind == "O" and len(numbers) == 2:
        return "odometer", numbers[0], (numbers[1], *_BLANK[:5])
    wanted = {"I": "7", "G": "7 or 13", "O": "2"}.get(kind)
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
    return name, t, tuple(x * _tell_scale(c) for x, c in zip(numbers, sensor.columns, strict=True))


def _tell_scale(column: Column) -> float:
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
        numbers = [x / _tell_scale(column) for x, column in zip(values, columns, strict=True)]
        return f"S,{sensor},{t!r}," + ",".join("" if np.isnan(x) else repr(x) for x in numbers)
    lat, lon = float(np.degrees(values[0])), float(np.degrees(values[1]))
    rest = values[2:6] if np.isnan(values[6]) else values[2:]
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
