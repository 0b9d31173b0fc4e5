"""References beside fixes, in any columns and of any point: taken as the truth, never as fixes, and read exactly."""

from __future__ import annotations

from pathlib import Path

import logs
import numpy as np
import pytest
from helpers import refuse_command, refused

from graphnav.app import cli
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import RecordingError
from graphnav.core.interpolation import interpolate
from graphnav.core.trajectory import Trajectory
from graphnav.evaluation.evaluate import evaluate, find_truth
from graphnav.recording.draft import draft
from graphnav.recording.exporters import write_as
from graphnav.recording.formats import read
from graphnav.recording.formats.trajectories import read_trajectory

RECORDING, TRUTH = logs.simulated(60.0)
POINT = (0.7, -1.8, 0.4)  # m right, forward, up of the IMU
PLAIN = ("t", "lat", "lon", "h", "vn", "ve", "vd", "roll", "pitch", "heading")


def put(path: Path, names: list[str], columns: np.ndarray, mark: str = ",") -> None:
    lines = [mark.join(names), *(mark.join(f"{x:.12g}" for x in row) for row in columns)]
    path.write_text("\n".join(lines).replace(".", "," if mark == ";" else ".") + "\n", encoding="utf-8")


def reference(angle: float = 1.0, speed: float = 1.0) -> np.ndarray:
    """Rows (K, 10) of the true path of `POINT`: s, deg, m, m/s north, east, down, and angles times `angle`."""
    inside = TRUTH.t[(TRUTH.t > 12.0) & (TRUTH.t < 65.0)][::2]
    at, _ = interpolate(TRUTH, inside, lever_arm=np.array(POINT))
    v = at.v[:, [1, 0, 2]] * [1.0, 1.0, -1.0] * speed
    place = np.column_stack([np.degrees(at.llh[:, :2]), at.llh[:, 2]])
    return np.column_stack([at.t, place, v, np.degrees(at.rph) * angle])


def make_folder(folder: Path, name: str, names: list[str], rows: np.ndarray, mark: str = ",") -> None:
    imu, gnss = RECORDING.imu, RECORDING.gnss
    put(folder / "imu.csv", ["t", "gx", "gy", "gz", "ax", "ay", "az"], np.column_stack([imu.t, imu.gyro, imu.accel]))
    fixes = np.column_stack([gnss.t, np.degrees(gnss.llh[:, :2]), gnss.llh[:, 2], gnss.sd])
    put(folder / "receiver.csv", ["t", "lat", "lon", "h", "sd_e", "sd_n", "sd_u"], fixes)
    put(folder / name, names, rows, mark)


CASES = [
    ("span.csv", "GPSTime [s],Latitude [deg],Longitude [deg],H-Ell [m],VNorth,VEast,VDown,Roll,Pitch,Heading", {}),
    ("ins.csv", "time,latitude,longitude,height,vel_n,vel_e,vel_d,roll_rad,pitch_rad,yaw_rad", {"angle": np.pi / 180}),
    ("out.csv", "t,lat,lon,h,vn_kmh,ve_kmh,vd_kmh,roll,pitch,azimuth", {"speed": 3.6}),
]


@pytest.mark.parametrize(("name", "header", "units"), CASES)
@pytest.mark.parametrize("mark", [",", ";"])
def test_a_reference_is_the_truth_and_exact(tmp_path, name, header, units, mark):
    make_folder(tmp_path, name, header.split(","), reference(**units), mark)
    toml = tmp_path / "recording.toml"
    assert cli.run(["init", str(tmp_path), "-o", str(toml), "--quiet"]) == 0
    text = toml.read_text(encoding="utf-8")
    assert "receiver" in text.partition("[gnss]")[2].partition("[truth]")[0]
    toml.write_text(text.replace('of = "imu"', f"of = {list(POINT)}"), encoding="utf-8")
    truth, arm = find_truth(read(tmp_path))
    assert np.array_equal(arm, POINT)
    exact, _ = interpolate(TRUTH, truth.t, lever_arm=arm)
    frame = LocalFrame(TRUTH.llh[0])
    assert np.abs(frame.from_llh(truth.llh) - frame.from_llh(exact.llh)).max() < 1e-3
    assert np.abs(truth.v - exact.v).max() < 1e-6
    assert np.abs(np.angle(np.exp(1j * (truth.rph - exact.rph)))).max() < 1e-8


@pytest.mark.parametrize(("name", "header", "units"), CASES)
def test_a_file_with_other_columns_is_compared_with(tmp_path, name, header, units):
    write_as("csv", TRUTH, tmp_path / "estimate.csv")
    put(tmp_path / name, header.split(","), reference(**units))
    metrics = evaluate(tmp_path / "estimate.csv", tmp_path / name, lever_arm=np.array(POINT))
    assert metrics.components["3d"].max < 2e-3
    assert metrics.components["heading"].max < 1e-4
    assert any(getattr(note, "key", "") == "trajectory.columns" for note in metrics.notes)


def test_columns_of_graphnavs_own_names_need_no_note(tmp_path):
    put(tmp_path / "own.csv", list(PLAIN), reference())
    track = read_trajectory(tmp_path / "own.csv")
    assert isinstance(track, Trajectory)
    assert not track.notes


def test_a_receiver_alone_stays_fixes_and_a_named_file_is_a_truth(tmp_path):
    make_folder(tmp_path, "ground_truth.csv", list(PLAIN[:4]), reference()[:, :4])
    text = draft([tmp_path], tmp_path, "x").text
    assert 'file = "ground_truth.csv"' in text.partition("[truth]")[2]
    assert '\nof = "gnss"' in text.partition("[truth]")[2]
    (tmp_path / "receiver.csv").unlink()
    assert "[truth]" not in draft([tmp_path], tmp_path, "x").text


def test_what_is_no_point_and_what_has_no_heights_is_refused(tmp_path, capsys):
    make_folder(tmp_path, "truth.csv", list(PLAIN), reference())
    text = draft([tmp_path], tmp_path, "x").text
    (tmp_path / "recording.toml").write_text(text.replace('of = "imu"', 'of = "car"'), encoding="utf-8")
    with refused("key.value", RecordingError, "truth.of"):
        read(tmp_path)
    put(tmp_path / "flat.csv", ["time", "latitude", "longitude"], reference()[:, :3])
    with refused("table.column", RecordingError, "flat.csv", "'h'"):
        read_trajectory(tmp_path / "flat.csv")
    refuse_command(
        capsys, "option.point", "evaluate", tmp_path / "truth.csv", tmp_path / "truth.csv", "--point", "antenna"
    )
