"""Mistakes that people make with recordings, files, settings and commands, and what graphnav must say of each.

`python tests/mistakes_made.py` makes them all and writes docs/mistakes.md anew.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mistakes import (
    ROOT,
    Mistake,
    Table,
    both,
    change,
    finding,
    made,
    nothing,
    page,
    scaled,
    settings,
    swapped,
    text,
    toml,
)

SMOOTH = ("smooth", "drive", "-o", "out", "--solver", "ekf")
CONFIG = (*SMOOTH, "--config", "settings.toml")
STATED = (*SMOOTH, "--noise", "stated")


def _no_gravity(c: Table) -> None:
    c["az"] -= 9.6


def _repeated(c: Table) -> Table:
    return {k: np.repeat(v, 2) for k, v in c.items()}


def _holes(c: Table) -> None:
    c["ax"][100:110] = np.nan


def _shuffled(c: Table) -> Table:
    order = np.arange(len(c["t_s"]))
    order[200:220] = order[200:220][::-1]
    return {k: v[order] for k, v in c.items()}


def _minutes(c: Table) -> None:
    for name in ("lat_deg", "lon_deg"):
        whole = np.floor(c[name])
        c[name] = 100 * whole + 60 * (c[name] - whole)


def _metres(c: Table) -> None:
    east, north = (c["lon_deg"] - c["lon_deg"][0]) * 90_000, (c["lat_deg"] - c["lat_deg"][0]) * 111_000
    c["lat_deg"], c["lon_deg"] = np.clip(east, -89, 89), north


def _rounded(c: Table) -> None:
    for name in ("lat_deg", "lon_deg"):
        c[name] = np.round(c[name], 4)


def _elsewhere(c: Table) -> None:
    c["lat_deg"] = c["lat_deg"] + 0.3


def _seconds(c: Table) -> None:
    c["t_s"] = np.floor(c["t_s"])


def _numbered(c: Table) -> None:
    c["t_s"] = np.arange(len(c["t_s"])) + 700.0


def _row(name: str, column: str, row: int, value: float) -> Callable[[Path], None]:
    """One value of a column."""

    def how(c: Table) -> None:
        c[column][row] = value

    return change(name, how)


def _dead(column: str) -> Callable[[Path], None]:
    return change("imu", lambda c: {**c, column: np.full(len(c[column]), c[column][0])})


def _filled(c: Table) -> None:
    """A second and a half of the IMU, interpolated and written with the digits of the others."""
    a, b = 3000, 3000 + int(1.5 / np.median(np.diff(c["t_s"])))
    for name in ("gx", "gy", "gz", "ax", "ay", "az"):
        c[name][a : b + 1] = np.round(np.interp(c["t_s"][a : b + 1], c["t_s"][[a, b]], c[name][[a, b]]), 6)


def _away(c: Table) -> None:
    c["lon_deg"][0] -= 110.0  # 9000 km


def _two_groups(c: Table) -> None:
    off = np.random.default_rng(1).random(len(c["t_s"])) < 0.48
    c["lat_deg"][off] += 50.0 / 111_000.0


def _frozen(c: Table) -> None:
    rows = (c["t_s"] > 1610.0) & (c["t_s"] < 1700.0)
    c["h_m"][rows] = c["h_m"][rows][0]


def _exchanged(c: Table) -> None:
    c["lat_deg"], c["lon_deg"] = c["lon_deg"] - 100.0, c["lat_deg"].copy()


def _clock_jump(seconds: float) -> Callable[[Path], None]:
    return change("odometer", lambda c: {**c, "t_s": c["t_s"] + seconds * (c["t_s"] > 1645.0)})


def _doubled(c: Table) -> None:
    c["speed_mps"][(c["t_s"] > 1640.0) & (c["t_s"] < 1663.0)] *= 2.0


def _on_arrival(c: Table) -> None:
    late = np.random.default_rng(2).uniform(0.0, 0.6, len(c["t_s"]))
    c["t_s"] = np.maximum.accumulate(c["t_s"] + late) + 1e-4 * np.arange(len(late))  # one after the other


def _sigmas(sd: float, zeros: bool = False) -> Callable[[Path], None]:
    def how(c: Table) -> None:
        for name in ("sd_e", "sd_n", "sd_u"):
            c[name] = np.full(len(c["t_s"]), sd)
            c[name][: 100 if zeros else 0] = 0.0

    return change("gnss", how)


def _later(name: str, seconds: float) -> Callable[[Path], None]:
    return change(name, lambda c: {**c, "t_s": c["t_s"] + seconds})


MISTAKES: dict[str, list[Mistake]] = {
    "Files": [
        Mistake("the folder's name mistyped", nothing, ("no such file or folder",), ("info", "drvie"), True),
        Mistake(
            "a sensor's file is missing",
            lambda f: (f / "imu.csv.gz").unlink(),
            ("imu.csv.gz", "no such file"),
            error=True,
        ),
        Mistake("a folder where a file is meant", toml('"gnss.csv.gz"', '"."'), ("is a folder",), error=True),
        Mistake("an empty file", text("gnss", lambda s: ""), ("gnss.csv", "is empty"), error=True),
        Mistake(
            "a header and no rows",
            text("gnss", lambda s: s.split("\n")[0]),
            ("gnss.csv", "header and no rows"),
            error=True,
        ),
        Mistake(
            "a log given in place of the recording",
            nothing,
            ("not a recording", "graphnav init"),
            ("info", "drive/imu.csv.gz"),
            True,
        ),
        Mistake(
            "a spreadsheet (.xlsx) renamed .csv",
            text("imu", lambda s: b"PK\x03\x04" + bytes(200)),
            ("imu.csv", "spreadsheet"),
            error=True,
        ),
        Mistake(
            "saved as UTF-16", text("imu", lambda s: s.encode("utf-16")), ("imu.csv", "UTF-16", "UTF-8"), error=True
        ),
        Mistake(
            "semicolons and decimal commas",
            text("imu", lambda s: s.replace(",", ";").replace(".", ",")),
            ("imu.csv, line 1", "commas", "points"),
            error=True,
        ),
        Mistake(
            "decimal commas in a file of commas",
            text("imu", lambda s: s.replace(".", ",")),
            ("imu.csv, line 2", "fields", "header has 7"),
            error=True,
        ),
        Mistake(
            "no header", text("imu", lambda s: s.split("\n", 1)[1]), ("line 1", "must name the columns"), error=True
        ),
        Mistake(
            "a column called something else",
            text("imu", lambda s: s.replace("t_s", "time", 1)),
            ("no column 't_s'", "time"),
            error=True,
        ),
        Mistake(
            "a word among the numbers",
            text("gnss", lambda s: s.replace("1580.2,", "ERROR,", 1)),
            ("line 3", "'ERROR' is not a number"),
            error=True,
        ),
        Mistake(
            "a line of units under the header",
            text("odometer", lambda s: s.replace("\n", "\ns,m/s,-\n", 1)),
            ("line 2", "units"),
            error=True,
        ),
        Mistake(
            "two logs in one file",
            text("imu", lambda s: s + s),
            ("header is there again",),
            error=True,
        ),
        Mistake(
            "hours, minutes and seconds for seconds",
            text("gnss", lambda s: s.replace("\n1580.0,", "\n00:26:20.0,", 1)),
            ("line 2", "time of day"),
            error=True,
        ),
        Mistake(
            "blanks between the fields",
            text("imu", lambda s: s.replace(",", " ")),
            ("separated by blanks",),
            error=True,
        ),
        Mistake(
            "the file is cut off",
            lambda f: (f / "imu.csv.gz").write_bytes((f / "imu.csv.gz").read_bytes()[:50_000]) and None,
            ("imu.csv.gz", "cut off"),
            error=True,
        ),
    ],
    "Times": [
        Mistake("milliseconds beside an IMU in s", scaled("gnss", "t_s", 1e3), ("fixes are in ms", 't = "ms"')),
        Mistake("milliseconds, not said", scaled("imu", "t_s", 1e3), ("imu.csv.gz", 't = "ms"'), error=True),
        Mistake(
            "the IMU in UTC, the fixes in GPS time", _later("imu", -18.0), ("leap seconds", "time_offset in [imu]")
        ),
        Mistake(
            "the IMU in local time, nine hours ahead", _later("imu", 32400.0), ("GNSS", "do not overlap", "local time")
        ),
        Mistake(
            "the IMU in local time, smoothed all the same",
            _later("imu", 32400.0),
            ("GNSS", "do not overlap", "local time"),
            SMOOTH,
            True,
        ),
        Mistake("row numbers for times", change("imu", _numbered), ("1 s apart",), error=True),
        Mistake(
            "whole seconds: the fraction was lost",
            change("imu", _seconds),
            ("imu", "fraction of the seconds", "milliseconds"),
            error=True,
        ),
        Mistake("rows twice", change("imu", _repeated), ("6501 IMU rows", "dropped")),
        Mistake("rows out of order", change("imu", _shuffled), ("out of order", "sorted")),
        Mistake("NaN or blanks for missing values", change("imu", _holes), ("10 IMU rows", "NaN", "dropped")),
        Mistake(
            "the fixes a second late, against IMU and odometer",
            _later("gnss", 1.0),
            ("IMU stamps are early", "time_offset in [gnss]"),
        ),
        Mistake(
            "fixes stamped when they arrived, up to 0.6 s late",
            change("gnss", _on_arrival),
            ("uneven", "of the arrival and not of the measurement"),
        ),
        Mistake(
            "the odometer's clock jumps ahead by 18 s midway",
            _clock_jump(18.0),
            ("odometer's clock jumps by +18", "leap seconds", "after it is not used"),
        ),
        Mistake(
            "the odometer's clock is set back by 18 s midway",
            _clock_jump(-18.0),
            ("odometer.csv.gz", "set back by 18"),
            error=True,
        ),
        Mistake(
            "the odometer's delay not taken off",
            toml("time_offset = -0.65", "time_offset = 0.0"),
            ("odometer stamps are late", "time_offset in [odometer]"),
        ),
    ],
    "Units": [
        Mistake("g for m/s2", scaled("imu", "ax ay az", 1 / 9.80665), ("seems to be in g", 'accel = "g"')),
        Mistake("deg/s for rad/s", scaled("imu", "gx gy gz", 57.29578), ("57 times too large", 'gyro = "deg/s"')),
        Mistake(
            "deg/s said, rad/s meant",
            toml('axes = "RFU"', 'axes = "RFU"\nunits = { gyro = "deg/s" }'),
            ("57 times too small", "leave out units.gyro"),
        ),
        Mistake(
            "g for m/s2, and smoothed all the same",
            scaled("imu", "ax ay az", 1 / 9.80665),
            ("seems to be in g", 'accel = "g"'),
            SMOOTH,
            True,
        ),
        Mistake("increments for rates", scaled("imu", "gx gy gz ax ay az", 0.02), ("increments", 'accel = "m/s"')),
        Mistake("ft/s2 for m/s2", scaled("imu", "ax ay az", 1 / 0.3048), ("in ft/s2", 'accel = "ft/s2"')),
        Mistake(
            "the accelerometer at half its scale", scaled("imu", "ax ay az", 0.5), ("2 times too small", "multiply")
        ),
        Mistake("gravity taken out, as phones do", change("imu", _no_gravity), ("gravity seems to have been removed",)),
        Mistake(
            "GNSS sigmas a thousand times too small",
            toml("sd = [0.05, 0.05, 0.10]", "sd = [5e-5, 5e-5, 1e-4]"),
            ("less than a carrier's phase can be measured to", "unit of the sigmas"),
        ),
        Mistake(
            "GNSS sigmas a hundred times too large",
            toml("sd = [0.05, 0.05, 0.10]", "sd = [5.0, 5.0, 10.0]"),
            ("neighbouring fixes scatter by", "unit of the sigmas"),
        ),
        Mistake("GNSS sigmas printed as 0.00", _sigmas(0.05, zeros=True), ("sigma sd_e is 0 in 100", "rounded away")),
        Mistake("wheel speed in km/h", scaled("odometer", "speed_mps", 3.6), ("in km/h", 'speed = "km/h"')),
        Mistake(
            "GGA's quality taken for the type of a fix",
            change("gnss", lambda c: {**c, "type": np.full(len(c["t_s"]), 4.0)}),
            ("GGA's qualities", 'type = "nmea"'),
        ),
        Mistake(
            "a quality that is no type of fix",
            change("gnss", lambda c: {**c, "type": np.full(len(c["t_s"]), 9.0)}),
            ("line 2, column 'type'", "9 is no type of fix", "1 fixed", "5 single"),
            error=True,
        ),
        Mistake("GNSS velocity in km/h", scaled("gnss", "ve_mps vn_mps vu_mps", 3.6), ("km/h", 'speed = "km/h"')),
        Mistake(
            "latitude and longitude in radians",
            scaled("gnss", "lat_deg lon_deg", np.pi / 180),
            ("radians", 'angle = "rad"'),
            error=True,
        ),
        Mistake(
            "latitude and longitude as NMEA's degrees and minutes, 3539.78",
            change("gnss", _minutes),
            ("is not a latitude", "minutes"),
            error=True,
        ),
        Mistake("latitude and longitude to four digits", change("gnss", _rounded), ("rounded", "m")),
        Mistake("height in millimetres", scaled("gnss", "h_m", 1e3), ("millimetres",), error=True),
        Mistake(
            "the lever arm in centimetres", toml("[0.0, 0.0, 0.6]", "[0.0, 0.0, 60.0]"), ("lever arm", "60", "metres")
        ),
        Mistake(
            "0.5 for 0.5 deg/sqrt(h)",
            toml("gyro_noise_density = 1.5e-4", "gyro_noise_density = 0.5"),
            ("gyro_noise_density", "deg/sqrt(h)"),
        ),
        Mistake(
            "a unit that is none",
            toml("gyro_noise_density = 1.5e-4", 'gyro_noise_density = "0.5 deg/h"'),
            ("gyro_noise_density", "deg/sqrt(h)"),
            error=True,
        ),
    ],
    "Axes and signs": [
        Mistake(
            "the IMU's axes are not as stated",
            toml('axes = "RFU"', 'axes = "FRD"'),
            ("axes", 'axes = "RFU" would agree'),
        ),
        Mistake(
            "a triple that no sensor has", toml('axes = "RFU"', 'axes = "FRU"'), ("left-handed", "FRD"), error=True
        ),
        Mistake("x and y of the accelerometer exchanged", swapped("imu", "ax", "ay"), ("axes",)),
        Mistake("the gyro left-handed", scaled("imu", "gx gy gz", -1.0), ("gyro's sign is reversed", "negate")),
        Mistake("the gyro's forward axis reversed", scaled("imu", "gy", -1.0), ("gyro rolls against", "negate gy")),
        Mistake(
            "an accelerometer that reads -9.8 at rest",
            scaled("imu", "ax ay az", -1.0),
            ("accelerometer's sign is reversed", 'accel = "-g"'),
        ),
        Mistake(
            "the accelerometer's vertical axis reversed",
            scaled("imu", "az", -1.0),
            ("accelerometer's vertical axis is reversed", "negate"),
        ),
        Mistake(
            "the accelerometer's forward axis reversed",
            scaled("imu", "ay", -1.0),
            ("forward axis is reversed", "cannot express", "negate ay"),
        ),
        Mistake(
            "the accelerometer's right axis reversed",
            scaled("imu", "ax", -1.0),
            ("turn rate and speed require", "cannot express", "negate ax"),
        ),
        Mistake(
            "the IMU built in the other way round",
            scaled("imu", "ax ay gx gy", -1.0),
            ("forward force falls when the speed rises", 'axes = "LBU" would agree'),
        ),
        Mistake(
            "latitude and longitude exchanged",
            swapped("gnss", "lat_deg", "lon_deg"),
            ("is not a latitude", "swapped"),
            error=True,
        ),
        Mistake(
            "the two exchanged where both are below 90 deg",
            change("gnss", _exchanged),
            ("refused", "latitude and longitude are exchanged"),
        ),
        Mistake(
            "the two exchanged, without velocities",
            both(change("gnss", _exchanged), toml(', ve = "ve_mps", vn = "vn_mps", vu = "vu_mps"', "")),
            ("refused", "latitude and longitude are exchanged"),
        ),
        Mistake(
            "the west's sign lost",
            scaled("gnss", "lon_deg", -1.0),
            ("refused", "the longitudes have the wrong sign"),
        ),
        Mistake(
            "the south's sign lost",
            scaled("gnss", "lat_deg", -1.0),
            ("refused", "the latitudes have the wrong sign"),
        ),
        Mistake(
            "a sign lost, without velocities",
            both(scaled("gnss", "lat_deg", -1.0), toml(', ve = "ve_mps", vn = "vn_mps", vu = "vu_mps"', "")),
            ("refused", "latitudes or longitudes have the wrong sign"),
        ),
        Mistake(
            "the antenna below the IMU, not above",
            toml("[0.0, 0.0, 0.6]", "[0.0, 0.0, -0.6]"),
            ("up part of lever_arm in [gnss]", "wrong sign"),
            ("info", "drive"),
        ),
        Mistake(
            "the antenna half a metre from where it is",
            toml("[0.0, 0.0, 0.6]", "[0.0, 0.6, 0.6]"),
            ("antenna: the drive finds it at", "as stated"),
            ("info", "drive"),
        ),
        Mistake(
            "the rear axle before the IMU, not behind",
            toml("[0.0, -1.8, 0.0]", "[0.0, 1.8, 0.0]"),
            ("forward part of lever_arm in [odometer]", "wrong sign"),
            ("info", "drive"),
        ),
        Mistake("north and east velocity exchanged", swapped("gnss", "ve_mps", "vn_mps"), ("velocit", "exchanged")),
        Mistake("velocity down taken for up", scaled("gnss", "vu_mps", -1.0), ("upward velocity", "vd")),
        Mistake(
            "the odometer counts backward", scaled("odometer", "speed_mps", -1.0), ("odometer's sign is reversed",)
        ),
        Mistake(
            "a foot's platform on a car",
            toml('platform = "vehicle"', 'platform = "foot"'),
            ("too fast for a foot", 'platform = "vehicle"'),
        ),
    ],
    "Sensors": [
        Mistake("one force of 1e4 m/s2", _row("imu", "ax", 3000, 1e4), ("1 IMU row", "1e+04 m/s2", "left out")),
        Mistake("one turn rate of 1e300 rad/s", _row("imu", "gz", 3000, 1e300), ("1 IMU row", "1e+300", "left out")),
        Mistake(
            "IMU rows filled in over 1.5 s", change("imu", _filled), ("in 1 stretch", "straight lines", "not measured")
        ),
        Mistake("an axis of the gyro is dead", _dead("gz"), ("gyro z", "defective", "throughout")),
        Mistake(
            "an axis of the accelerometer is dead, and smoothed all the same",
            _dead("ay"),
            ("accelerometer y", "defective"),
            SMOOTH,
            True,
        ),
        Mistake("the first fix is 9000 km away", change("gnss", _away), ("1 fix out of reach", "not used")),
        Mistake(
            "every other fix is 50 m off, all the same way",
            change("gnss", _two_groups),
            ("two groups 50 m apart", "cannot be trusted"),
        ),
        Mistake("the heights freeze", change("gnss", _frozen), ("heights", "frozen", "sigma of")),
        Mistake(
            "all heights are zero",
            change("gnss", lambda c: {**c, "h_m": 0.0 * c["h_m"]}),
            ("heights", "stay at 0 m", "frozen or not logged"),
        ),
        Mistake(
            "one odometer reading of 1e300 m/s",
            _row("odometer", "speed_mps", 2000, 1e300),
            ("1 odometer reading beyond", "not used"),
        ),
        Mistake(
            "an infinite odometer reading",
            _row("odometer", "speed_mps", 2000, np.inf),
            ("1 odometer row", "infinite", "dropped"),
        ),
        Mistake(
            "the odometer reads double for a while",
            change("odometer", _doubled),
            ("odometer reads 2", "times", "not used there"),
        ),
    ],
    "recording.toml and settings": [
        Mistake(
            "a key mistyped",
            toml("lever_arm", "leverarm"),
            ("line", "unknown key 'gnss.leverarm'", "did you mean 'lever_arm'?"),
            error=True,
        ),
        Mistake(
            "a negative sigma",
            toml("scale_sigma = 0.02", "scale_sigma = -0.02"),
            ("line", "'odometer.scale_sigma' = -0.02", "greater than 0"),
            error=True,
        ),
        Mistake(
            "two numbers for a lever arm",
            toml("[0.0, 0.0, 0.6]", "[0.0, 0.6]"),
            ("'gnss.lever_arm'", "three numbers"),
            error=True,
        ),
        Mistake(
            "an IMU's name mistyped",
            toml('axes = "RFU"', 'axes = "RFU"\nmodel = "ADIS16456"'),
            ("'ADIS16456'", "did you mean"),
            error=True,
        ),
        Mistake("text without quotes", toml('"vehicle"', "vehicle"), ("not valid TOML", "line 4"), error=True),
        Mistake(
            "a setting mistyped",
            settings("[keyframes]\nrat = 2.0\n"),
            ("settings.toml, line 2", "did you mean 'rate'?"),
            CONFIG,
            True,
        ),
        Mistake(
            "a setting in another's table",
            settings("[gnss]\nzero_velocity = false\n"),
            ("did you mean 'zero_velocity' in [standstill]?",),
            CONFIG,
            True,
        ),
        Mistake(
            "an impossible setting",
            settings("[keyframes]\nrate = 0\n"),
            ("'keyframes.rate' = 0", "greater than 0", "Hz"),
            CONFIG,
            True,
        ),
        Mistake(
            "the profile of another platform",
            nothing,
            ("profile 'foot'", "vehicle"),
            (*SMOOTH, "--profile", "foot"),
            True,
        ),
    ],
    "Truth": [
        Mistake("the truth of another day", _later("truth", 86400.0), ("truth", "overlap in time", "another day")),
        Mistake("the truth of another place", change("truth", _elsewhere), ("truth", "km from the fixes")),
        Mistake(
            "east and north in metres for latitude and longitude",
            change("truth", _metres),
            ("truth", "km from the fixes", 'frame = "local"'),
        ),
        Mistake("the truth in UTC, the fixes in GPS time", _later("truth", -18.0), ("truth", "18", "leap seconds")),
    ],
    "Commands": [
        Mistake(
            "a solver that is none",
            nothing,
            ("no solver 'kalman'", "known: ekf"),
            ("smooth", "drive", "-o", "out", "--solver", "kalman"),
            True,
        ),
        Mistake("a span without a sensor", nothing, ("gnss:40-60",), (*SMOOTH, "--without", "40-60"), True),
        Mistake(
            "logs for a recording",
            nothing,
            ("graphnav init drive/imu.csv.gz drive/gnss.csv.gz",),
            ("info", "drive/imu.csv.gz", "drive/gnss.csv.gz"),
            True,
        ),
        Mistake("a source mistyped", nothing, ("did you mean 'gnss'?",), (*SMOOTH, "--without", "gns:10-20"), True),
        Mistake("no such scenario", nothing, ("'city'", "urban"), ("simulate", "city", "-o", "simulated"), True),
        Mistake(
            "a span outside the recording",
            nothing,
            ("lies outside 'tokyo'", "130.0 s"),
            (*SMOOTH, "--without", "gnss:740-800"),
            True,
        ),
        Mistake(
            "a start after the end",
            nothing,
            ("--start 700: lies outside", "130.0 s"),
            (*SMOOTH, "--start", "700"),
            True,
        ),
        Mistake(
            "a part by the option of another program",
            nothing,
            ("--window", "--start", "--end"),
            (*SMOOTH, "--window", "10-60"),
            True,
        ),
        Mistake("no folder to write into", nothing, ("-o",), ("smooth", "drive"), True),
        Mistake(
            "a file where a folder is meant",
            nothing,
            ("-o drive/README.md: is a file",),
            ("smooth", "drive", "-o", "drive/README.md"),
            True,
        ),
        Mistake(
            "a draft over a recording.toml that is there",
            nothing,
            ("is there already", "--force"),
            ("init", "drive/imu.csv.gz", "-o", "drive"),
            True,
        ),
        Mistake(
            "converted into its own folder",
            nothing,
            ("name another folder",),
            ("convert", "drive", "-o", "drive"),
            True,
        ),
        Mistake("no space left for the results", nothing, ("-o out: cannot be written", "unchanged"), STATED, True),
        Mistake(
            "no permission to write there", nothing, ("no permission",), ("smooth", "drive", "-o", "/proc/1/out"), True
        ),
        Mistake(
            "a requirement on a number that is none",
            nothing,
            ("did you mean h_rms",),
            (*SMOOTH, "--require", "h_rsm<1"),
            True,
        ),
    ],
}


if __name__ == "__main__":
    rows = {}
    for head, some in MISTAKES.items():
        rows[head] = {}
        for one in some:
            with tempfile.TemporaryDirectory() as scratch:
                rows[head].setdefault(finding(one, made(one, Path(scratch))[1]), []).append(one.what)
    (ROOT / "docs" / "mistakes.md").write_text(page(rows), encoding="utf-8")
