"""What the digits of a log round off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest

from graphnav import Settings, load, run
from graphnav.config import parse_settings
from graphnav.constraints.gnss import count_repeats
from graphnav.evaluation.evaluate import evaluate_recording
from graphnav.evaluation.scoring import compute_errors
from graphnav.recording.formats.rounding import find_step, measure_rounding

HERE = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("digits", [0, 1, 3, 7, 9])
def test_a_step_is_found_in_values_that_are_rounded(digits: int) -> None:
    x = np.radians(np.round(139.7 + 10.0 ** (1 - digits) * np.random.default_rng(digits).standard_normal(500), digits))
    assert find_step(np.degrees(x)) == pytest.approx(10.0**-digits)


def test_no_step_is_found_where_there_is_none() -> None:
    x = 35.0 + np.random.default_rng(0).standard_normal(100)
    assert find_step(x) == 0.0
    assert find_step(np.full(100, 120.0)) == 0.0  # of which nothing tells how far the digits go
    assert find_step(np.round(x) / 3.0) == 0.0


def test_two_heights_tell_a_step() -> None:
    assert find_step(np.repeat([39.0, 40.0], 30)) == 1.0


def test_a_step_of_minutes_is_found() -> None:
    minutes = 60.0 * 48.0 + np.round(10.0 * np.random.default_rng(2).random(100), 4)
    llh = np.column_stack([np.radians(minutes / 60.0), np.full(100, 0.1), np.zeros(100)])
    found = np.sqrt(12.0) * np.array(measure_rounding(llh))
    assert found[1] == pytest.approx(0.185, rel=0.01)  # of 1852 m a minute
    assert found[0] == found[2] == 0.0


def test_the_deviation_is_that_of_the_error() -> None:
    rng = np.random.default_rng(1)
    llh = np.column_stack([np.radians(60.0 + 0.01 * rng.random(4000)), np.radians(10.0 + 0.01 * rng.random(4000)),
                           80.0 + 40.0 * rng.random(4000)])  # fmt: skip
    rounded = np.column_stack([np.radians(np.round(np.degrees(llh[:, :2]), 5)), np.round(llh[:, 2], 1)])
    away = (rounded - llh) * [6.371e6, 6.371e6 * np.cos(np.radians(60.0)), 1.0]
    np.testing.assert_allclose(measure_rounding(rounded), np.std(away, axis=0)[[1, 0, 2]], rtol=0.05)


def test_fixes_better_than_their_digits_leave_a_consistent_solution() -> None:
    """Fixes good to 2 cm, written with six decimals of a degree and whole metres of height."""
    drive = load(HERE.parent / "data" / "tokyo").crop(0.0, 100.0)
    assert drive.gnss is not None
    llh = np.column_stack([np.radians(np.round(np.degrees(drive.gnss.llh[:, :2]), 6)), np.round(drive.gnss.llh[:, 2])])
    rounded = replace(drive, gnss=replace(drive.gnss, llh=llh, rounding=measure_rounding(llh)))
    tracks = (run(one, Settings(), ("rts",))["rts"].trajectory() for one in (drive, rounded))
    whole, some = (np.mean(evaluate_recording(track, drive).errors.nees_p) for track in tracks)
    assert some < 1.5 * whole


def test_a_rounding_error_that_repeats_counts_once() -> None:
    """Fixes of a vehicle that stands, in whole metres: no better after two minutes than at once."""
    values = np.array([[1.0, 5.0], [1.0, 5.0], [2.0, 5.0], [2.0, 6.0], [2.0, 5.0]])
    np.testing.assert_array_equal(count_repeats(values), [[2.0, 3.0], [2.0, 3.0], [3.0, 3.0], [3.0, 1.0], [3.0, 1.0]])
    away = []
    for seed in range(12):
        path = oracle.vehicle_path(duration=120, rate=50.0, seed=seed)
        drive, truth = oracle.drive(path, seed=seed)
        assert drive.gnss is not None
        llh = drive.gnss.llh.copy()
        llh[:, 2] = np.round(llh[:, 2] + 0.083 * seed)
        llh[:, 2] -= 0.083 * seed
        rounded = replace(drive, gnss=replace(drive.gnss, llh=llh, rounding=(0.0, 0.0, float(np.sqrt(1.0 / 12.0)))))
        found = run(rounded, parse_settings({"noise": {"mode": "stated"}}), ("rts",))["rts"].trajectory()
        off = compute_errors(found, truth).p[:, 2]
        sigma = np.asarray(found.sd_p)[: len(off), 2]
        away.append(np.mean((off / sigma) ** 2))
    assert np.mean(away) < 1.5


@pytest.mark.parametrize(("digits", "minutes"), [(8, 4), (7, 3), (9, 5)])
def test_degrees_that_were_converted_from_minutes(digits: int, minutes: int) -> None:
    """As by a logger of NMEA sentences that writes degrees with more digits than the receiver's."""
    x = 42.0 + np.random.default_rng(3).uniform(0.0, 0.01, 60)
    written = np.round(np.round(60.0 * x, minutes) / 60.0, digits)
    found = np.sqrt(12.0) * np.array(measure_rounding(np.column_stack([np.radians(written), np.zeros(60), x])))
    assert found[1] == pytest.approx(np.radians(10.0**-minutes / 60.0) * 6378137.0)
    other = np.sqrt(12.0) * np.array(
        measure_rounding(np.column_stack([np.radians(np.round(x, digits)), np.zeros(60), x]))
    )
    assert other[1] == pytest.approx(np.radians(10.0**-digits) * 6378137.0)
