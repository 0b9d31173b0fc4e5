"""Fixes that a logger has filled in while it lost the IMU's rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphnav
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.detectors import detect
from graphnav.estimation import pipeline
from graphnav.estimation.alignment import align
from graphnav.estimation.noise.chords import find_filled_gaps
from graphnav.estimation.noise.unmeasured import UnmeasuredRows, drop_in_gaps
from graphnav.estimation.problem import build_problem
from graphnav.recording import Recording

GAP = 1.6  # s


def lose_rows(recording: Recording, fill: bool, every: float = 25.0) -> tuple[Recording, int]:
    """The recording without the IMU's rows around some fixes, which are filled in or not, and how many these are."""
    imu, gnss = recording.imu, recording.gnss
    assert gnss is not None
    k = np.arange(20, len(gnss.t) - 2, round(every / np.median(np.diff(gnss.t))))
    begin = gnss.t[k] - 0.7
    lost = np.any((imu.t[:, None] > begin) & (imu.t[:, None] < begin + GAP), axis=1)
    inside = np.any((gnss.t[:, None] > begin) & (gnss.t[:, None] < begin + GAP), axis=1)
    llh, frame = gnss.llh.copy(), LocalFrame(gnss.llh[0])
    if fill:
        p = frame.from_llh(gnss.llh)
        for b in begin:
            ends = np.array([[np.interp(t, gnss.t, axis) for axis in p.T] for t in (b, b + GAP)])
            own = (gnss.t > b) & (gnss.t < b + GAP)
            llh[own] = frame.to_llh(ends[0] + ((gnss.t[own] - b) / GAP)[:, None] * (ends[1] - ends[0]))
    rows = replace(imu, t=imu.t[~lost], gyro=imu.gyro[~lost], accel=imu.accel[~lost])
    return replace(recording, imu=rows, gnss=replace(gnss, llh=llh)), int(inside.sum())


def find(recording: Recording) -> int:
    """How many fixes are filled in by `find_filled_gaps`."""
    settings, frame = Settings(), LocalFrame(recording.gnss.llh[0])  # type: ignore[union-attr]
    stationary = detect(recording, settings).stationary
    start = align(recording, settings, frame, stationary)
    problem = build_problem(recording, settings, frame, start.state, start.sigma, stationary)
    gaps, _ = find_filled_gaps(problem, start.until)
    return drop_in_gaps(recording, gaps, UnmeasuredRows())[1].filled


@pytest.mark.parametrize("fill", [True, False])
def test_fixes_in_gaps_are_used_unless_they_cut_the_curves(shared_data: Path, fill: bool) -> None:
    """A simulated drive with one fix a second, good to centimetres."""
    lost, count = lose_rows(graphnav.load(shared_data / "oracle_drive").crop(50.0, 300.0), fill)
    assert count > 5
    assert find(lost) == (count if fill else 0)


def test_a_logger_that_stalls_fills_in_its_fixes() -> None:
    """KITTI's unsynchronised logs: rows of IMU and GNSS on straight lines, for one and a half seconds at a time."""
    solution = pipeline.run(graphnav.load("kitti").crop(0.0, 300.0), solvers=("rts",))["rts"]
    assert "gnss.filled" in [getattr(note, "key", "") for note in solution.notes]
