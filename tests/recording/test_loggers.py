"""Tables as more loggers write them: each is read as the same drive in a plain CSV file, or refused by its key."""

from __future__ import annotations

import gzip
import json
import re
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
import stranger
from helpers import refuse_command

from graphnav.app import cli
from graphnav.core.timescales import unix_to_gps
from graphnav.recording.draft import draft
from graphnav.recording.draft.clocks import read_clock_seconds, read_serial_days
from graphnav.recording.draft.logs import read_log
from graphnav.recording.formats import read
from graphnav.recording.formats.table import read_table

Rows = list[list[str]]


@pytest.fixture(scope="module")
def plain(shared_data):
    """The IMU's and the fixes' tables of a minute with turns: header and rows of text."""
    return stranger.tables(stranger.cuts(shared_data / "tokyo_20201105", [(600.0, 660.0)])[0])


def read_drafted(folder: Path, *tables):
    """What is read from tables after `init`."""
    stranger.write_tables(folder, *tables)
    assert cli.run(["init", str(folder), "-o", str(folder), "--quiet"]) == 0
    return read(folder)


def write_dms(angle: float, sides: str) -> str:
    whole, rest = divmod(abs(angle) * 3600.0, 3600.0)
    minutes, seconds = divmod(rest, 60.0)
    return f"{whole:.0f}°{minutes:02.0f}'{seconds:.6f}\"{sides[angle < 0.0]}"


@pytest.mark.parametrize("form", ["letter", "degrees", "column", "minutes"])
def test_hemispheres_and_minutes_are_read_as_signs_and_degrees(plain, tmp_path, form):
    """South and west: whoever drops these is on the other side of the Earth."""
    imu, (header, rows) = plain
    imu = imu[0], [[t, *w[:2], f"{-float(w[2])}", *f] for t, *w, f1, f2, f3 in imu[1] for f in [(f1, f2, f3)]]
    south = [[t, f"-{lat}", lon, h] for t, lat, lon, h in rows]  # mirrored once, so turns are, too
    if form == "minutes":
        joined = [[t, *(f"{float(x) // 1 * 100 + float(x) % 1 * 60:.8f}" for x in place), h] for t, *place, h in rows]
        shown = "t,lat,ns,lon,ew,h", [[t, lat, "S", lon, "E", h] for t, lat, lon, h in joined]
    elif form == "column":
        shown = "t,lat,N/S,lon,E/W,h", [[t, lat, "S", lon, "E", h] for t, lat, lon, h in rows]
    elif form == "letter":
        shown = header, [[t, f"{lat}S", f"{lon}E", h] for t, lat, lon, h in rows]
    else:
        shown = header, [[t, write_dms(-float(lat), "NS"), write_dms(float(lon), "EW"), h] for t, lat, lon, h in rows]
    want = read_drafted(tmp_path / "plain", imu, (header, south)).gnss
    assert want.llh[0, 0] < 0.0
    assert read_drafted(tmp_path / "shown", imu, shown).gnss.llh == pytest.approx(want.llh, abs=1e-10)


@pytest.mark.parametrize(
    ("imu_header", "gnss_header"),
    [
        (
            "Zeit,Drehrate X,Drehrate Y,Drehrate Z,Beschleunigung X,Beschleunigung Y,Beschleunigung Z",
            "Zeit,Breitengrad,Längengrad,Höhe",
        ),
        (
            "Temps (s),Vitesse angulaire x (rad/s),Vitesse angulaire y (rad/s),Vitesse angulaire z (rad/s),"
            "Accélération x (m/s²),Accélération y (m/s²),Accélération z (m/s²)",
            "Temps (s),Latitude (°),Longitude (°),Altitude (m)",
        ),
        ("tiempo,giro_x,giro_y,giro_z,aceleracion_x,aceleracion_y,aceleracion_z", "tiempo,latitud,longitud,altitud"),
    ],
)
def test_headers_in_other_languages(plain, tmp_path, imu_header, gnss_header):
    (_, rows), (_, fixes) = plain
    want, found = (
        read_drafted(tmp_path / name, (imu, rows), (gnss, fixes))
        for name, imu, gnss in (("plain", plain[0][0], plain[1][0]), ("other", imu_header, gnss_header))
    )
    assert np.array_equal(found.imu.gyro, want.imu.gyro)
    assert np.array_equal(found.imu.accel, want.imu.accel)
    assert np.array_equal(found.gnss.llh, want.gnss.llh)


@pytest.mark.parametrize("sensor", [0, 1])
def test_files_that_follow_on_each_other_are_one(plain, tmp_path, sensor):
    want = read_drafted(tmp_path / "whole", *plain)
    folder = stranger.write_tables(tmp_path / "parts", *plain)
    header, rows = plain[sensor]
    whole = folder / ("imu.csv", "gnss.csv")[sensor]
    whole.unlink()
    for name, part in (("b_first", rows[: len(rows) // 2]), ("a_second", rows[len(rows) // 2 :])):
        (folder / f"{name}.csv").write_text("\n".join([header, *(",".join(row) for row in part)]) + "\n")
    assert cli.run(["init", str(folder), "-o", str(folder), "--quiet"]) == 0
    found = read(folder)
    assert np.array_equal(found.imu.t, want.imu.t)
    assert np.array_equal(found.gnss.t, want.gnss.t)


def test_two_imus_at_once_are_refused_and_a_second_in_the_same_file_is_named(plain, tmp_path, capsys):
    (header, rows), fixes = plain
    folder = stranger.write_tables(tmp_path / "files", (header, rows), fixes)
    (folder / "imu_2.csv").write_bytes((folder / "imu.csv").read_bytes())
    refuse_command(capsys, "draft.two_imus", "init", folder, "-o", folder)
    names = [f"{one}_{kind}_{x}" for one in ("front", "rear") for kind in ("gyro", "acc") for x in "xyz"]
    folder = stranger.write_tables(tmp_path / "file", (",".join(["t", *names]), [r + r[1:] for r in rows]), fixes)
    drafted = draft([folder], folder)
    assert [line for line in drafted.decisions if "rear_gyro_x" in line and "rear_acc_z" in line and "CHECK" in line]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("track.gpx", "<gpx/>"),
        ("gps.csv", "t,easting,northing\n0,1,2\n1,2,3\n"),
        ("rover.rtcm3", "\xd3"),
    ],
)
def test_positions_that_are_not_read_do_not_make_a_walk(plain, tmp_path, capsys, name, text):
    folder = stranger.write_tables(tmp_path, plain[0], plain[1])
    (folder / name).write_text(text)
    assert cli.run(["init", str(folder), "-o", str(folder), "--quiet"]) == 0  # beside others they may be
    (folder / "gnss.csv").unlink()
    assert name in refuse_command(capsys, "draft.positions_unread", "init", folder, "-o", folder, "--force")


def test_a_draft_that_info_would_refuse_is_written_and_says_so(plain, tmp_path, capsys):
    imu, (header, rows) = plain
    fixes = header, [[t, lat, lon, f"{1e3 * float(h)}"] for t, lat, lon, h in rows]
    folder = stranger.write_tables(tmp_path, imu, fixes)
    assert cli.run(["init", str(folder), "-o", str(folder), "--json"]) == 3
    out, said = capsys.readouterr()
    assert json.loads(out)["refused"]["key"] == "table.height"
    assert said.startswith("graphnav: ")
    assert said.count("\n") == 1
    assert (folder / "recording.toml").exists()


@pytest.mark.parametrize("step", [0.2, 0.9])
@pytest.mark.parametrize("apart", [0.0, 1e-4])
def test_rows_that_a_program_stamps_in_packets(plain, tmp_path, step, apart):
    """Several rows read at once, with one stamp or with ones that are a moment apart."""
    (header, rows), fixes = plain
    t = np.array([float(row[0]) for row in rows])
    packet = np.floor((t - t[0]) / step + 1e-6)
    place = np.arange(len(t)) - np.searchsorted(packet, packet)
    stamped = t[0] + packet * step + apart * place
    packed = [[f"{s:.6f}", *row[1:]] for s, row in zip(stamped, rows, strict=True)]
    folder = stranger.write_tables(tmp_path, (header, packed), fixes)
    assert cli.run(["init", str(folder), "-o", str(folder), "--quiet"]) == 0
    recording = read(folder)
    assert "imu.packets" in {remark.key for remark in recording.remarks}
    late = (recording.imu.t - t)[packet < packet[-1]]  # the last packet is not whole
    assert np.ptp(late) < 1.1 * np.median(np.diff(t)) + 2.0 * apart * place.max()
    assert np.abs(late).max() < step


def test_rates_in_counts_are_not_drafted(plain, tmp_path, capsys):
    (header, rows), fixes = plain
    counts = [[row[0], *(f"{7506 * float(x):.0f}" for x in row[1:4]), *row[4:]] for row in rows]
    folder = stranger.write_tables(tmp_path, (header, counts), fixes)
    refuse_command(capsys, "draft.raw_counts", "init", folder, "-o", folder)
    assert not (folder / "recording.toml").exists()


def test_a_course_in_radians_is_told_by_the_positions(plain, tmp_path):
    imu, (header, rows) = plain
    p = np.array(rows, dtype=float)
    north, east = np.gradient(p[:, 1]) * 111e3, np.gradient(p[:, 2]) * 111e3 * np.cos(np.radians(p[0, 1]))
    course, speed = np.arctan2(east, north) % (2.0 * np.pi), np.hypot(east, north)
    found = [
        read_drafted(
            tmp_path / name, imu,
            (f"{header},speed,course", [[*row, f"{a}", f"{b}"] for row, a, b in zip(rows, speed, one, strict=True)]),
        ).gnss.v
        for name, one in (("deg", np.degrees(course)), ("rad", course))
    ]  # fmt: skip
    assert found[1] == pytest.approx(found[0], abs=1e-6)


@pytest.mark.parametrize(
    ("names", "scales", "more"),
    [
        ("lat,lon,alt,vel_n,vel_e,vel_d", (1e7, 1e7, 1e3, 1e2, 1e2, 1e2), "v"),  # as MAVLink
        ("lat,lon,height,hAcc,vAcc,velN,velE,velD", (1e7, 1e7, *[1e3] * 6), "v"),  # as u-blox
        ("lat,lon,alt,vel_n,vel_e,vel_d", (1e7, 1e7, 1e3, 1e5, 1e5, 1e5), ""),  # in no unit
        ("lat,lon,hMSL [mm],hacc_mm,vacc_mm,velN_mm_s,velE_mm_s,velD_mm_s", (1, 1, 1e3, *[1e3] * 5), "v"),
        ("lat,lon,alt_mm,hacc_mm,vacc_mm,velN_mm_s,velE_mm_s,velD_mm_s", (1e7, 1e7, *[1e3] * 6), "v"),
        ("lat,lon,alt,NedVelX,NedVelY,NedVelZ", (1,) * 6, "v"),
        ("lat,lon,alt,vx,heading", (1,) * 5, ""),  # of which axes is not said: no speed along the heading
    ],
    ids=[
        "whole degrees",
        "whole degrees and mm",
        "no unit",
        "millimetres",
        "whole degrees and stated mm",
        "axes in the name",
        "axes unknown",
    ],
)
def test_units_and_axes_that_the_names_of_columns_state(plain, tmp_path, names, scales, more):
    imu, (_, rows) = plain
    t, *place = np.array(rows, dtype=float).T
    moves = np.gradient(np.column_stack([place[0], place[1], place[2]]), t, axis=0)
    north, east = np.radians(moves[:, 0]) * 6.371e6, np.radians(moves[:, 1]) * 6.371e6 * np.cos(np.radians(place[0]))
    own = {"vn": north, "ve": east, "vd": -moves[:, 2], "sd": np.full(len(t), 0.03)}
    columns = [*place, *(own[x] for x in (["sd"] * 2 if "acc" in names.lower() else []) + ["vn", "ve", "vd"])]
    digits = 9 if scales[0] == 1 else 0
    cells = [[x, *(f"{y * s:.{digits}f}" for y, s in zip(row, scales, strict=False))]
             for (x, *_), row in zip(rows, zip(*columns, strict=True), strict=True)]  # fmt: skip
    gnss = read_drafted(tmp_path, imu, (f"t,{names}", cells)).gnss
    assert gnss.llh == pytest.approx(np.column_stack([*np.radians(place[:2]), place[2]]), abs=1e-3)
    assert gnss.llh[:, :2] == pytest.approx(np.radians(place[:2]).T, abs=2e-9)
    assert (gnss.v is not None) == (more == "v")
    if more:
        rounded = 0.51 / scales[-1] if digits == 0 else 1e-4
        assert gnss.v == pytest.approx(np.column_stack([east, north, moves[:, 2]]), abs=rounded)
    if "acc" in names.lower():
        assert gnss.sd == pytest.approx(np.full((len(t), 3), 0.03))


def test_each_conversion_of_a_table_is_noted(tmp_path):
    stamps = [f"{100000 + 100 * (k // 60) + k % 60}" for k in range(150)]
    rows = [f"{t};{3540.0 + 1e-3 * k:.5f};{13946.0 + 1e-3 * k:.5f};40" for k, t in enumerate(stamps)]
    (tmp_path / "gnss.csv").write_text("\n".join(["utc;latitude;longitude;height", *rows]) + "\n")
    found = read_log(tmp_path / "gnss.csv")["gnss"]
    np.testing.assert_allclose(np.diff(found.t), 1.0)
    assert all(f"'{name}'" in found.plain.words for name in ("utc", "latitude", "longitude"))


def test_first_rows_in_which_little_is_known_are_no_header(plain, tmp_path):
    (header, rows), gnss = plain
    first = [[t, *["#N/A"] * (len(rest))] for t, *rest in rows[:3]]
    assert len(read_drafted(tmp_path, (header, [*first, *rows[3:]]), gnss).imu.t) == len(rows) - 3


@pytest.mark.parametrize("of", ["position_covariance_{}", "field.position_covariance{}", "position_covariance[{}]"])
def test_a_table_of_ros_is_stamped_by_its_messages_and_its_variances_are_sigmas(plain, tmp_path, of):
    imu, (_, rows) = plain
    whole = read_drafted(tmp_path / "as it was", imu, ("t,lat,lon,h", [row[:4] for row in rows]))
    late = [f"{1.7e9 + float(t) + 0.15:.6f}" for t, *_ in rows]
    stamps = [(f"{1.7e9 + np.floor(float(t)):.0f}", f"{1e9 * (float(t) % 1.0):.0f}") for t, *_ in rows]
    cells = [
        [arrival, *stamp, *row[1:4], "0.04", "0", "0", "0", "0.09", "0", "0", "0", "0.25"]
        for arrival, stamp, row in zip(late, stamps, rows, strict=True)
    ]
    head = ["Time", "header.stamp.secs", "header.stamp.nsecs", "latitude", "longitude", "altitude"]
    moved = imu[0], [[f"{1.7e9 + float(t):.6f}", *rest] for t, *rest in imu[1]]
    gnss = read_drafted(tmp_path / "ros", moved, (",".join([*head, *map(of.format, range(9))]), cells)).gnss
    np.testing.assert_allclose(gnss.t - 1.7e9, whole.gnss.t, atol=1e-5)
    np.testing.assert_allclose(gnss.sd, np.tile([0.2, 0.3, 0.5], (len(gnss.t), 1)))


@pytest.mark.parametrize(
    "header", ["GForceX,GForceY,GForceZ", "accelerometer_m_s2[0],accelerometer_m_s2[1],accelerometer_m_s2[2]"]
)
def test_more_names_of_an_imu_and_what_is_not_used_is_said(plain, tmp_path, capsys, header):
    (_, rows), gnss = plain
    stranger.write_tables(
        tmp_path, (f"t,gyro[0],gyro[1],gyro[2],{header},q0,mag", [[*r, "1", "2"] for r in rows]), gnss
    )
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path), "--json"]) == 0
    (unused,) = [line for line in json.loads(capsys.readouterr().out)["decisions"] if "q0" in line]
    assert unused.startswith("[imu] imu.csv: ")
    assert unused.endswith(" q0, mag")
    assert len(read(tmp_path).imu.t) == len(rows)


def test_rows_that_a_written_file_lacks_are_counted(plain, tmp_path, capsys):
    """Nobody tells later: what is written is whole."""
    (header, rows), gnss = plain
    some = [*rows[:9], rows[8], *rows[9:]]
    some[20:22] = [[*row[:3], "NaN", *row[4:]] for row in some[20:22]]
    stranger.write_tables(tmp_path, (header, some), gnss, mark=";")
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path), "--json"]) == 0
    (made,) = [x for x in json.loads(capsys.readouterr().out)["decisions"] if x.startswith("[imu] imu-imu.csv.gz")]
    assert {f"2 of {len(rows) + 1} ", f"1 of {len(rows) - 1} "} <= set(re.findall(r"\d+ of \d+ ", made))
    assert len(read(tmp_path).imu.t) == len(rows) - 2


def test_the_speed_of_a_wheel_beside_fixes_is_an_odometer_and_makes_no_new_fixes(plain, tmp_path):
    (header, rows), (_, fixes) = plain
    t, at = np.array([float(r[0]) for r in rows]), np.array([float(r[0]) for r in fixes])
    k = np.maximum(np.searchsorted(at, t + 1e-6) - 1, 0)
    speed = 10.0 + np.sin(t)
    one = [[*row, *fixes[j][1:], "90.0", f"{3.6 * x:.4f}"] for row, j, x in zip(rows, k, speed, strict=True)]
    (tmp_path / "log.csv").write_text("\n".join(map(",".join, [[header, "lat,lon,h,heading,obd_speed_kmh"], *one])))
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path), "--quiet"]) == 0
    got = read(tmp_path)
    assert got.gnss.v is None
    assert len(got.gnss.t) == len(np.unique(k))
    assert got.odometer.speed == pytest.approx(speed, abs=1e-3)


@pytest.mark.parametrize("name", ["imu.csv.gz", "imu.txt.gz"])
def test_a_packed_table_may_have_dates(plain, tmp_path, name):
    (header, rows), gnss = plain
    dated = [[datetime.fromtimestamp(float(t), UTC).isoformat(), *rest] for t, *rest in rows]
    stranger.write_tables(tmp_path, (header, dated), gnss)
    (tmp_path / name).write_bytes(gzip.compress((tmp_path / "imu.csv").read_bytes()))
    (tmp_path / "imu.csv").unlink()
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path), "--quiet"]) == 0
    assert read(tmp_path).imu.t == pytest.approx(np.array([float(t) for t, *_ in rows]), abs=1e-5)


@pytest.mark.parametrize("order", ["linear, total", "linear, gravity"])
def test_forces_without_gravity_are_not_taken_where_the_table_has_it(plain, tmp_path, order):
    (_, rows), gnss = plain
    imu = np.array(rows, dtype=float)
    force, pull = imu[:, 4:], np.tile(imu[:, 4:].mean(axis=0), (len(imu), 1))
    header = "t,gx,gy,gz,lin_acc_x,lin_acc_y,lin_acc_z"
    header += ",acc_x,acc_y,acc_z" if "total" in order else ",gravity_x,gravity_y,gravity_z"
    both = np.column_stack([imu[:, :4], force - pull, force if "total" in order else pull])
    got = read_drafted(tmp_path, (header, [[f"{x:.8f}" for x in row] for row in both]), gnss).imu
    assert got.accel @ got.R_bs == pytest.approx(force, abs=1e-6)


def test_one_table_has_one_clock(plain, tmp_path):
    """At 100 Hz in ms: a fix in every row, 10 apart, might be one every ten seconds."""
    (header, rows), (_, fixes) = plain
    t, at = np.array([float(r[0]) for r in rows]), np.array([float(r[0]) for r in fixes])
    k = np.maximum(np.searchsorted(at, t + 1e-6) - 1, 0)
    one = [[f"{10 * i + 5000}", *row[1:], *fixes[j][1:]] for i, (row, j) in enumerate(zip(rows, k, strict=True))]
    text = "\n".join(map(",".join, [[header.replace("t,", "time,"), "lat,lon,h"], *one]))
    (tmp_path / "log.csv").write_text(text + "\n")
    found = draft([tmp_path / "log.csv"], tmp_path)
    assert found.text.count('t = "ms"') == 2


def test_lines_of_an_imu_among_nmea_are_pointed_at(tmp_path, capsys):
    body = "GPGGA,120000.00,4000.000,N,10500.000,W,4,12,0.8,1600.0,M,-20.0,M,1.0,0001"
    sentence = f"${body}*{reduce(xor, body.encode()):02X}"
    later = sentence.replace("120000.00", "120001.00")
    later = f"{later[:-2]}{int(later[-2:], 16) ^ 1:02X}"
    (tmp_path / "log.txt").write_text(f"{sentence}\nIMU,0,0,0,9.8,0,0,0\n{later}\nIMU,1,0,0,9.8,0,0,0\n")
    said = refuse_command(capsys, "draft.no_imu", "init", tmp_path, "-o", tmp_path)
    assert "log.txt, line 2: " in said


@pytest.mark.parametrize(
    ("height", "geoid", "added"),
    [
        ("alt", "geoid_sep", True),
        ("altitude_msl_m", "Geoid separation (m)", True),
        ("h", "geoid", False),
        ("height_ell", "undulation", False),
        ("alt_ft", "geoid_sep_m", False),
    ],
)
def test_a_height_above_the_sea_and_the_geoids_add_up(plain, tmp_path, height, geoid, added):
    """A blank separation is that of its neighbours; where h is above the ellipsoid already, it is left alone."""
    imu, (_, rows) = plain
    fixes = [
        [t, lat, lon, f"{float(h) - 40.0:.3f}", "" if k == 7 else "40.0"] for k, (t, lat, lon, h) in enumerate(rows)
    ]
    got = read_drafted(tmp_path, imu, (f"t,lat,lon,{height},{geoid}", fixes))
    unit = 0.3048 if height.endswith("ft") else 1.0
    want = [unit * (float(h) - (0.0 if added else 40.0)) for *_, h in rows]
    assert got.gnss.llh[:, 2] == pytest.approx(np.array(want), abs=2e-3)


@pytest.mark.parametrize("year", [2009, 2013, 2020])
@pytest.mark.parametrize("scale", ["GPS", "Unix"])
def test_a_receivers_seconds_are_told_from_unix_time_by_the_other_logs_date(plain, tmp_path, year, scale):
    """In 2013 either is a date in the past; leap seconds are those of the date."""
    (header, rows), (fixed, fixes) = plain
    begin = datetime(year, 5, 1, tzinfo=UTC).timestamp()
    unix = [[f"{begin + float(t) - float(rows[0][0]):.3f}", *r] for t, *r in rows]
    places = [begin + float(t) - float(rows[0][0]) for t, *_ in fixes]
    stamps = unix_to_gps(np.array(places)) if scale == "GPS" else places
    theirs = [[f"{t:.3f}", *r] for t, (_, *r) in zip(stamps, fixes, strict=True)]
    got = read_drafted(tmp_path, (header, unix), (f"gps_time,{fixed.partition(',')[2]}", theirs))
    assert got.gnss.t == pytest.approx(np.array(places), abs=0.01)


def test_stamps_since_the_gps_epoch_are_no_unix_time(plain, tmp_path):
    """A receiver's beside an IMU's in Unix time: the clocks are known, and nothing need be found."""
    (header, rows), (_, fixes) = plain
    unix = float(rows[0][0])
    zero = float(unix_to_gps(np.array([unix]))[0])
    gps = [[f"{1e9 * (float(t) - unix + zero):.0f}", *place] for t, *place in fixes]
    got = read_drafted(tmp_path / "fixes", (header, rows), ("TimeGps,lat,lon,h", gps))
    assert got.gnss.t == pytest.approx(np.array([float(t) for t, *_ in fixes]), abs=1e-3)
    both = read_drafted(
        tmp_path / "both",
        (header.replace("t,", "gps_time_ns,"), [[f"{1e9 * (float(t) - unix + zero):.0f}", *r] for t, *r in rows]),
        ("TimeGps,lat,lon,h", gps),
    )
    assert both.gps_zero + both.imu.t[0] == pytest.approx(zero, abs=0.1)


def test_stamps_that_are_one_number():
    t = np.arange(0.0, 150.0, 0.01)
    assert read_clock_seconds(t[(t < 50.0) | (t >= 110.0)]) is None  # a pause of a minute
    clock = 100_000.0 + 100.0 * (t // 60.0) + t % 60.0
    assert read_clock_seconds(clock) == pytest.approx(36000.0 + t)
    assert read_serial_days(25569.0 + (1.7e9 + t) / 86400.0) == pytest.approx(1.7e9 + t, abs=1e-5)
    assert read_serial_days(45000.0 + t) is None


def test_words_for_nothing_are_blank(tmp_path):
    (tmp_path / "a.csv").write_text("t,x\n1,N/A\n2,--\n3,null\n4,5\n")
    assert np.array_equal(read_table(tmp_path / "a.csv", ("x",))["x"], [np.nan, np.nan, np.nan, 5.0], equal_nan=True)
