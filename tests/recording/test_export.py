"""Trajectories for other programs: GPX, KF-GINS .nav and NMEA, of any point and at any rate."""

from __future__ import annotations

import datetime
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import gpxpy
import numpy as np
import pymap3d
import pynmeagps
import pytest
from helpers import refuse_command, refused
from test_exporters import DEG, made

from graphnav.app import cli, convert
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.timescales import gps_to_utc
from graphnav.core.trajectory import Trajectory
from graphnav.recording.exporters import write_as
from graphnav.recording.formats import load
from graphnav.recording.formats.trajectories import read_trajectory

WEEK = 2200


def utc_of(track: Trajectory):
    return gps_to_utc(track.t + WEEK * 604800.0)


def test_gpx_is_read_by_gpxpy_and_keeps_the_schema(tmp_path: Path) -> None:
    track = made()
    write_as("gpx", track, tmp_path / "a.gpx", utc_of(track))
    text = (tmp_path / "a.gpx").read_text()
    points = gpxpy.parse(text).tracks[0].segments[0].points
    assert [p.latitude for p in points] == pytest.approx(track.llh[:, 0] / DEG, abs=1e-10)
    assert [p.longitude for p in points] == pytest.approx(track.llh[:, 1] / DEG, abs=1e-10)
    assert [p.elevation for p in points] == pytest.approx(track.llh[:, 2], abs=1e-4)
    # 5 days into the week that began on 6 March 2022, 18 s before midnight UTC
    assert points[0].time.replace(tzinfo=None) == datetime.datetime(2022, 3, 10, 23, 59, 42)
    # GPX 1.1: a version, a creator, its namespace, and within trkpt ele before time
    root = ET.fromstring(text)
    assert root.tag == "{http://www.topografix.com/GPX/1/1}gpx"
    assert root.attrib["version"] == "1.1"
    assert root.attrib["creator"]
    point = root.find(".//{*}trkpt")
    assert [child.tag.split("}")[1] for child in point] == ["ele", "time"]


def test_gpx_without_a_clock_has_no_times_and_says_so(tmp_path: Path) -> None:
    write_as("gpx", made(), tmp_path / "a.gpx")
    track = gpxpy.parse((tmp_path / "a.gpx").read_text()).tracks[0]
    assert track.segments[0].points[0].time is None
    write_as("gpx", made(), tmp_path / "b.gpx", utc_of(made()))
    assert track.description != gpxpy.parse((tmp_path / "b.gpx").read_text()).tracks[0].description


def test_nav_reads_back(tmp_path: Path) -> None:
    track = made()
    write_as("nav", track, tmp_path / "a.nav", utc_of(track))
    back = read_trajectory(tmp_path / "a.nav")
    assert np.loadtxt(tmp_path / "a.nav")[0, :2] == pytest.approx([WEEK, 432000.0])
    assert back.t == pytest.approx(track.t, abs=2e-6)
    assert back.llh[:, :2] == pytest.approx(track.llh[:, :2], abs=1e-12)
    assert back.v == pytest.approx(track.v, abs=1e-5)
    assert rotation.wrap(back.rph - track.rph) == pytest.approx(0.0, abs=1e-8)
    write_as("nav", track, tmp_path / "b.nav")
    assert np.loadtxt(tmp_path / "b.nav")[0, :2].tolist() == [0.0, 432000.0]  # as KF-GINS itself
    with refused("export.no_attitude", RecordingError):
        write_as("nav", Trajectory(track.t, track.llh), tmp_path / "c.nav")


def test_nmea_sentences_are_sound_and_read_back(tmp_path: Path) -> None:
    track = made()
    write_as("nmea", track, tmp_path / "a.nmea", utc_of(track))
    lines = (tmp_path / "a.nmea").read_bytes().splitlines(keepends=True)
    assert len(lines) == 3 * len(track)
    messages = [pynmeagps.NMEAReader.parse(line, validate=pynmeagps.VALCKSUM) for line in lines]
    assert {m.msgID for m in messages} == {"GGA", "RMC", "GST"}
    assert messages[1].date == datetime.date(2022, 3, 10)
    assert messages[1].spd == pytest.approx(np.hypot(*track.v[0, :2]) * 3600 / 1852, abs=1e-4)
    log = load(tmp_path / "a.nmea")  # by the package's own reader, which pynmeagps does the parsing for
    assert log.gps_zero == WEEK * 604800.0
    assert log.gnss.t == pytest.approx(track.t, abs=0.6e-3)
    assert log.gnss.llh[:, :2] == pytest.approx(track.llh[:, :2], abs=3e-11)
    assert log.gnss.llh[:, 2] == pytest.approx(track.llh[:, 2], abs=1e-4)
    assert log.gnss.sd == pytest.approx(track.sd_p, abs=1e-4)
    with refused("export.time_of_day", RecordingError):
        write_as("nmea", track, tmp_path / "b.nmea")


def test_minutes_that_round_up_to_sixty_carry_over(tmp_path: Path) -> None:
    llh = np.array([[47.99999999999 * DEG, -8.0 * DEG, 0.0]])
    write_as("nmea", Trajectory(np.array([0.0]), llh), tmp_path / "a.nmea", gps_to_utc(np.array([1.3e9])))
    message = pynmeagps.NMEAReader.parse((tmp_path / "a.nmea").read_bytes().splitlines()[0])
    assert message.lat == pytest.approx(48.0)
    assert message.lon == pytest.approx(-8.0)


def turning() -> Trajectory:
    """Standing on the spot and turning clockwise at 0.2 rad/s, 20 Hz."""
    t = np.arange(0.0, 30.0, 0.05)
    rph = np.column_stack([np.zeros_like(t), np.zeros_like(t), np.mod(0.2 * t, 2 * np.pi)])
    llh = np.tile([0.8, 0.2, 300.0], (len(t), 1))
    return Trajectory(t, llh, v=np.zeros((len(t), 3)), rph=rph, sd_p=np.full((len(t), 3), 0.02),
                      sd_rph=np.full((len(t), 3), 0.001), sd_v=np.full((len(t), 3), 0.01))  # fmt: skip


def test_another_point_moves_around_the_imu() -> None:
    track = turning()
    arm = np.array([0.0, 2.0, 1.0])  # 2 m ahead, 1 m up
    (moved,) = convert.move_to_point(track, arm)
    p = LocalFrame(track.llh[0]).from_llh(moved.llh)
    heading = track.rph[:, 2]
    assert p == pytest.approx(
        np.column_stack([2 * np.sin(heading), 2 * np.cos(heading), np.ones_like(heading)]), abs=1e-6
    )
    east, north, _ = pymap3d.geodetic2enu(
        moved.llh[:, 0] / DEG, moved.llh[:, 1] / DEG, moved.llh[:, 2], 0.8 / DEG, 0.2 / DEG, 300.0
    )
    assert np.hypot(east, north) == pytest.approx(2.0, abs=1e-6)
    v = 0.4 * np.column_stack([np.cos(heading), -np.sin(heading), 0 * heading])
    assert moved.v[1:-1] == pytest.approx(v[1:-1], abs=1e-4)
    # the heading's sigma swings the point sideways by 2 m times it
    assert moved.sd_p[0, 0] == pytest.approx(np.hypot(0.02, np.hypot(2 * 0.001, 0.001)), rel=1e-3)


def test_a_trajectory_at_another_rate() -> None:
    (moved,) = convert.move_to_point(turning(), None, rate=100.0)
    assert np.diff(moved.t) == pytest.approx(0.01, abs=1e-9)
    assert moved.rph[:, 2] == pytest.approx(np.mod(0.2 * moved.t, 2 * np.pi), abs=1e-6)


@pytest.mark.parametrize("arm", [None, np.array([0.0, 2.0, 1.0])])
def test_parts_of_a_trajectory_are_those_of_the_whole(arm, monkeypatch) -> None:
    track = turning()
    (whole,) = convert.move_to_point(track, arm, rate=33.0)
    monkeypatch.setattr(convert, "_ROWS_AT_ONCE", 100)
    parts = list(convert.move_to_point(track, arm, rate=33.0))
    assert len(parts) == 10
    for name in ("t", "llh", "v", "rph", "sd_p"):
        np.testing.assert_allclose(
            np.concatenate([getattr(one, name) for one in parts]), getattr(whole, name), atol=1e-9
        )


@pytest.mark.parametrize(("text", "arm"), [("1,2,3", [1, 2, 3]), ("-0.5, 0, 1e0", [-0.5, 0, 1])])
def test_points_are_three_numbers(text, arm) -> None:
    assert convert.parse_point(text).tolist() == arm


@pytest.mark.parametrize("text", ["roof", "1,2", "1,2,nan", ""])
def test_other_points_are_refused(text) -> None:
    with refused("option.point", ConfigError):
        convert.parse_point(text)


# ---- the commands


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short part of the built-in drive, solved, with exports."""
    out = tmp_path_factory.mktemp("run")
    assert (
        cli.run(
            ["smooth", "kitti", "--end", "40", "-o", str(out), "--quiet", "--export", "gpx,nav", "--point", "0,0,1.5"]
        )
        == 0
    )
    return out


def test_smooth_exports_a_point_beside_the_usual_files(run) -> None:
    imu, point = read_trajectory(run / "trajectory.csv"), read_trajectory(run / "point.nav")
    assert point.t == pytest.approx(imu.t, abs=1e-5)
    assert point.llh[:, 2] - imu.llh[:, 2] == pytest.approx(1.5, abs=0.05)
    assert len(gpxpy.parse((run / "point.gpx").read_text()).tracks[0].segments[0].points) == len(imu)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["antenna_lever_arm"] == [0.0, 0.0, 0.0]
    assert summary["gps_zero"] is None


def test_convert_writes_a_trajectory_for_other_programs(run, tmp_path, capsys) -> None:
    source = str(run / "trajectory.csv")
    track = read_trajectory(source)
    assert cli.run(["convert", source, "-o", str(tmp_path / "a.gpx"), "--point", "antenna"]) == 0
    assert len(gpxpy.parse((tmp_path / "a.gpx").read_text()).tracks[0].segments[0].points) == len(track)
    assert cli.run(["convert", source, "-o", str(tmp_path / "out"), "--export", "nav,tum,kml", "--rate", "10"]) == 0
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {f"trajectory.{kind}" for kind in ("nav", "tum", "kml")}
    assert (
        cli.run(["convert", source, "-o", str(tmp_path / "out"), "--export", "nmea", "--clock", "gps week 2200"]) == 0
    )
    assert load(tmp_path / "out" / "trajectory.nmea").gps_zero == 2200 * 604800.0
    assert cli.run(["convert", str(run), "-o", str(tmp_path / "run"), "--export", "nav", "--rate", "10"]) == 0
    assert (tmp_path / "run" / "trajectory.nav").read_bytes() == (tmp_path / "out" / "trajectory.nav").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "key", "name"),
    [
        (["--format", "gpz", "-o", "OUT"], "log.format_unknown", "gpz"),
        (["--format", "gpx", "-o", "OUT"], "log.format_unknown", "--export gpx"),
        (["--export", "gpz", "-o", "OUT"], "option.unknown_name", "gpx"),
        (["-o", "OUT.gpx", "--export", "nav"], "option.not_here", "--export nav"),
        (["-o", "OUT.gpx", "--point", "roof"], "option.point", "--point roof"),
        (["-o", "OUT.gpx", "--rate", "0"], "option.value", "--rate 0"),
        (["-o", "OUT.gpx", "--clock", "noon"], "option.clock", "--clock noon"),
        (["-o", "OUT.nmea"], "export.time_of_day", "NMEA"),
    ],
)
def test_bad_exports_are_one_line_and_exit_code_2(run, tmp_path, capsys, arguments, key, name, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert name in refuse_command(capsys, key, "convert", run / "trajectory.csv", *arguments)


def test_a_csv_trajectory_without_a_summary_has_no_antenna(tmp_path, capsys) -> None:
    write_as("csv", made(), tmp_path / "a.csv")
    asked = ["convert", tmp_path / "a.csv", "-o", tmp_path / "a.gpx", "--point", "antenna"]
    assert "a.csv" in refuse_command(capsys, "option.point", *asked)


@pytest.mark.parametrize("name", ["csv", "tum", "kml", "gpx", "nav", "nmea"])
def test_every_format_is_written_by_name(tmp_path, name) -> None:
    track = made()
    write_as(name, track, tmp_path / f"a.{name}", utc_of(track))
    assert (tmp_path / f"a.{name}").stat().st_size > 1000
