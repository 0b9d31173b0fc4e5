"""Increments of angle and velocity in CSV files are the rates they came from."""

from __future__ import annotations

from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import assert_told, refused

from graphnav.app import cli
from graphnav.core.errors import RecordingError
from graphnav.online.lines import make_setup
from graphnav.recording.formats import columns, read

RECORDING, _ = logs.simulated(60.0)
RATES = ["t", "gx", "gy", "gz", "ax", "ay", "az"]
TOML = """format = "graphnav-recording/1"
platform = "vehicle"
[imu]
file = "imu.csv"
{imu}
[gnss]
file = "gnss.csv"
"""


def put(folder: Path, names: list[str], angle: float, without: slice = slice(0, 0)) -> np.ndarray:
    """Write increments, those of angle times `angle`; returns the rates and forces of the rows written."""
    imu, gnss = RECORDING.imu, RECORDING.gnss
    dt = np.diff(imu.t, prepend=imu.t[0] - 0.02)[:, None]
    rows = np.column_stack([imu.t, imu.gyro * angle * dt, imu.accel * dt])
    kept = np.delete(np.arange(len(rows)), without)
    (folder / "imu.csv").write_text(
        "\n".join([",".join(names), *(",".join(f"{x:.15g}" for x in row) for row in rows[kept])]) + "\n"
    )
    fixes = np.column_stack([gnss.t, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2], gnss.sd])
    head = "t,lat,lon,h,sd_e,sd_n,sd_u"
    (folder / "gnss.csv").write_text("\n".join([head, *(",".join(f"{x:.15g}" for x in row) for row in fixes)]) + "\n")
    return np.column_stack([imu.gyro, imu.accel])[kept]


@pytest.mark.parametrize(("unit", "angle"), [("rad", 1.0), ("deg", 180.0 / np.pi)])
def test_units_say_that_a_file_holds_increments(tmp_path, unit, angle):
    rates = put(tmp_path, RATES, angle, slice(1000, 1100))
    (tmp_path / "recording.toml").write_text(TOML.format(imu=f'units = {{ gyro = "{unit}", accel = "m/s" }}'))
    recording = read(tmp_path)
    assert np.abs(np.column_stack([recording.imu.gyro, recording.imu.accel]) - rates).max() < 1e-9
    assert_told(recording.remarks, "imu.increments_after_gap")


@pytest.mark.parametrize(
    ("names", "angle"),
    [
        ("time,dtheta_x,dtheta_y,dtheta_z,dvel_x,dvel_y,dvel_z", 1.0),
        ("t,deltaAngleX,deltaAngleY,deltaAngleZ,deltaVelocityX,deltaVelocityY,deltaVelocityZ", 1.0),
        ("t,delta_theta_x_deg,delta_theta_y_deg,delta_theta_z_deg,delta_v_x,delta_v_y,delta_v_z", 180.0 / np.pi),
        ("t,dang_x,dang_y,dang_z,dv_x,dv_y,dv_z", 1.0),
    ],
)
def test_a_draft_knows_them_by_their_names(tmp_path, names, angle):
    header = names.split(",")
    found = columns.match_columns(header)
    assert found.sensor == "imu"
    assert "speed" not in found.names
    rates = put(tmp_path, header, angle)
    assert cli.run(["init", str(tmp_path), "-o", str(tmp_path / "recording.toml"), "--quiet"]) == 0
    imu = read(tmp_path).imu
    assert np.abs(np.column_stack([imu.gyro, imu.accel]) - rates).max() < 1e-6


def test_a_live_source_has_rates():
    with refused("key.value", RecordingError, "imu.units.gyro"):
        make_setup({"imu": {"units": {"gyro": "rad"}}})
