"""`graphnav init` with raw observations: which file is what, and what t = 0 of the IMU is."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from helpers import refused

from graphnav.app import cli
from graphnav.core.errors import RecordingError
from graphnav.gnss.load import Sources, load_raw
from graphnav.recording.draft import draft
from graphnav.recording.draft.raw import tell_kind
from graphnav.recording.formats import read

DATA = Path(__file__).resolve().parents[2] / "data" / "kamakura_rtk"
WEEK_SECONDS = 282600.0  # of GPS week 2176 at t = 0
UNIX = 1632292182.0
LEAP = 18.0


@pytest.fixture
def folder(tmp_path):
    """A drive without a description, its IMU stamped by a given clock."""

    def make(shift: float, *names: str) -> Path:
        rows = np.loadtxt(DATA / "imu.csv.gz", delimiter=",", skiprows=1)
        rows[:, 0] += shift
        np.savetxt(tmp_path / "imu.csv", rows, "%.6f", ",", header="t,gx,gy,gz,ax,ay,az", comments="")
        for name in names:
            shutil.copy(DATA / name, tmp_path / name)
        return tmp_path

    return make


@pytest.mark.parametrize(
    ("rover", "shift", "clock"),
    [("rover.obs.gz", WEEK_SECONDS, "gps week 2176"), ("rover.ubx", UNIX, "unix")],
)
def test_files_are_told_by_what_is_in_them(folder, rover, shift, clock):
    """A base is what stands; forward is where the accelerations of single-point fixes are felt."""
    path = folder(shift, rover, "base.obs.gz", "nav.gz")
    renamed = {rover: "a.bin", "base.obs.gz": "b.bin", "nav.gz": "c.bin"}
    for old, new in renamed.items():
        (path / old).rename(path / new)
    text = draft([path], path).text
    found = tomllib.loads(text)
    assert (found["raw_gnss"]["rover"], found["raw_gnss"]["base"], found["raw_gnss"]["nav"]) == tuple(renamed.values())
    assert found["clock"] == clock
    assert found["platform"] == "vehicle"
    assert found["imu"]["axes"] == "RFU"
    assert "time_offset" not in found["raw_gnss"]
    (path / "recording.toml").write_text(text)
    recording = read(path)
    assert recording.raw_gnss is not None
    assert np.isfinite(recording.raw_gnss.difference).sum() > 1000
    assert len(recording.gnss.t) == 41


@pytest.mark.parametrize("moving", [True, False])
def test_what_a_log_holds_of_satellites_places_those_of_the_other_file(folder, moving):
    """No navigation file, and ephemerides in one of two files: the rover's log, or a base's beside a rover's RINEX."""
    path = folder(UNIX, "rover.ubx", "base.obs.gz" if moving else "rover.obs.gz")
    if moving:
        found = tomllib.loads(draft([path], path).text)["raw_gnss"]
        assert (found["rover"], found["base"], found.get("nav")) == ("rover.ubx", "base.obs.gz", None)
    else:  # the same antenna moves in both
        with refused("draft.raw_roles", RecordingError, "both"):
            draft([path], path)


def test_a_log_may_be_given_for_its_ephemerides(folder):
    """As `nav`: to a rover whose own file has none, the same places as by a navigation file."""
    placed = []
    for nav in ("rover.ubx", "nav.gz"):
        path = folder(0.0, "rover.obs.gz", nav)
        sources = Sources(rover=(path / "rover.obs.gz",), nav=(path / nav,))
        placed.append(load_raw(sources)[1])
    far = np.linalg.norm(placed[0].p - placed[1].p, axis=1)
    assert np.isfinite(far).sum() > 35
    assert np.nanmedian(far) < 2.0  # of fewer satellites, whose messages were all received


def test_stamps_of_utc_among_seconds_of_the_week_are_told(folder):
    path = folder(WEEK_SECONDS - LEAP, "rover.obs.gz", "nav.gz")
    found = tomllib.loads(draft([path], path).text)
    assert found["raw_gnss"]["time_offset"] == pytest.approx(-LEAP, abs=0.1)


def test_a_clock_that_nothing_tells_is_asked_for(folder):
    path = folder(0.0, "rover.obs.gz", "nav.gz")
    text = draft([path], path).text
    assert "clock" not in tomllib.loads(text)
    (path / "recording.toml").write_text(text)
    with refused("clock.unknown", RecordingError):
        read(path)


def test_init_writes_the_draft_whose_clock_is_to_be_filled_in(folder, capsys):
    path = folder(0.0, "rover.obs.gz", "nav.gz")
    assert cli.run(["init", str(path), "-o", str(path), "--json"]) == 3
    out = json.loads(capsys.readouterr().out)
    assert out["refused"]["key"] == "clock.unknown"
    assert not [line for line in out["decisions"] if line.startswith("not read")]  # observations are
    draft_file = path / "recording.toml"
    text = draft_file.read_text()
    draft_file.write_text(re.sub(r'^# clock = "..."', 'clock = "2021-09-22T06:29:42Z"', text, flags=re.MULTILINE))
    assert len(read(path).gnss.t) == 41


@pytest.mark.parametrize(
    ("shift", "names", "key"),
    [
        (WEEK_SECONDS, ("rover.obs.gz", "rover.ubx", "nav.gz"), "draft.raw_roles"),  # one receiver, twice
        (WEEK_SECONDS, ("rover.obs.gz", "rover.ubx", "base.obs.gz", "nav.gz"), "draft.raw_roles"),
        (UNIX + 86400.0, ("rover.obs.gz", "base.obs.gz", "nav.gz"), "draft.raw_time"),
        (WEEK_SECONDS, ("rover.obs.gz", "base.obs.gz"), "raw.no_ephemerides"),
    ],
)
def test_what_is_not_clear_is_refused(folder, shift, names, key):
    path = folder(shift, *names)
    with refused(key, RecordingError):
        draft([path], path)


def test_observations_alone_are_no_recording(tmp_path):
    shutil.copy(DATA / "rover.obs.gz", tmp_path / "rover.obs.gz")
    with refused("draft.no_imu", RecordingError, "IMU"):
        draft([tmp_path], tmp_path)
    (tmp_path / "LICENSE.txt").write_text("terms")
    (tmp_path / "terms.txt").write_text("terms, of use\n1, 2\n")
    with refused("draft.no_imu", RecordingError, "IMU", "raw GNSS"):
        draft([tmp_path], tmp_path)


@pytest.mark.parametrize("first", [f"{'':5}3.00{'':11}{'C':<40}", f"{'3.04':<21}{'C':<44}"])
def test_clocks_are_told_by_either_of_their_headers(tmp_path, first):
    """That of version 3.04 is wider by five columns."""
    path = tmp_path / "a.clk"
    path.write_text(f"{first}RINEX VERSION / TYPE\n")
    assert tell_kind(path) == ("clk", False)
