"""Numbers that stand for none, and stamps that were rounded away, in logs that are otherwise sound."""

from __future__ import annotations

import gzip
from dataclasses import replace

import logs
import numpy as np
from helpers import assert_told

from graphnav.recording.formats import read
from graphnav.recording.formats.writer import write_folder

RECORDING, _ = logs.simulated(40.0)


def test_velocities_that_stand_for_none_are_left_out_and_those_in_another_unit_are_not(tmp_path):
    gnss = RECORDING.gnss
    v = gnss.v.copy()
    v[3:6] = 999.0
    write_folder(replace(RECORDING, gnss=replace(gnss, v=v)), tmp_path / "none")
    found = read(tmp_path / "none")
    assert np.flatnonzero(np.isnan(found.gnss.v).all(1)).tolist() == [3, 4, 5]
    assert np.abs(found.gnss.v[6:] - v[6:]).max() < 1e-3
    assert_told(found.remarks, "gnss.velocity_beyond", "3 ")
    write_folder(replace(RECORDING, gnss=replace(gnss, v=gnss.v * 1000.0)), tmp_path / "mm")
    assert not np.isnan(read(tmp_path / "mm").gnss.v).any()


def test_stamps_of_single_precision_are_told(tmp_path):
    imu, gnss = RECORDING.imu, RECORDING.gnss
    t = imu.t + 372000.0
    shifted = replace(RECORDING, imu=replace(imu, t=t), gnss=replace(gnss, t=gnss.t + 372000.0))
    write_folder(replace(shifted, odometer=None, truth=None), tmp_path)
    lines = (tmp_path / "imu.csv.gz", tmp_path / "imu.csv")
    rows = gzip.decompress(lines[0].read_bytes()).decode().splitlines()
    head = next(k for k, line in enumerate(rows) if line.startswith("t,"))
    rounded = [f"{float(np.float32(line.split(',', 1)[0])):.6f},{line.split(',', 1)[1]}" for line in rows[head + 1 :]]
    lines[1].write_text("\n".join([*rows[: head + 1], *rounded]) + "\n")
    text = (tmp_path / "recording.toml").read_text().replace("imu.csv.gz", "imu.csv")
    (tmp_path / "recording.toml").write_text(text)
    assert_told(read(tmp_path).remarks, "imu.packets", "single-precision", "0.03125")
