"""What is written is read back to the last digit, whatever the numbers are."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import logs
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from graphnav.config import format_settings, parse_settings, read_settings
from graphnav.config.gnss import GnssSettings
from graphnav.core.rotation import Array
from graphnav.online.lines import format_line, parse_row
from graphnav.recording import Gnss, Imu, ImuNoise, Odometer
from graphnav.recording.exporters import write_as
from graphnav.recording.formats import read
from graphnav.recording.formats.table import read_table
from graphnav.recording.formats.trajectories import read_trajectory
from graphnav.recording.formats.writer import write_csv, write_folder

BASE, _ = logs.simulated(5.0)
FEW = settings(max_examples=25, deadline=None)


def numbers(columns: int, size: float = 1e6) -> st.SearchStrategy[Array]:
    cells = st.floats(-size, size, allow_subnormal=False) | st.floats(-1.0, 1.0, allow_subnormal=False)
    return arrays.arrays(float, st.tuples(st.integers(2, 12), st.just(columns)), elements=cells)


def times(count: int, first: float) -> Array:
    return first + 0.01 * np.arange(1, count + 1)


@FEW
@given(values=numbers(6, 900.0), first=st.floats(-1e6, 1e9), figure=st.floats(1e-12, 1e3))
def test_imu_rows_and_figures(values: Array, first: float, figure: float) -> None:
    t = times(len(values), first)
    noise = ImuNoise(gyro_noise_density=figure, accel_bias_walk=figure / 3.0)
    recording = replace(BASE, imu=Imu(t, values[:, :3], values[:, 3:], noise), gnss=None, odometer=None, truth=None)
    with tempfile.TemporaryDirectory() as folder:
        write_folder(recording, folder)
        found = read(folder).imu
    np.testing.assert_array_equal(found.t, t)
    np.testing.assert_array_equal(found.gyro, values[:, :3])
    np.testing.assert_array_equal(found.accel, values[:, 3:])
    assert found.noise == noise


@FEW
@given(
    place=arrays.arrays(float, (6, 2), elements=st.floats(-1.5, 1.5).filter(lambda x: abs(x) > 0.1)),
    h=arrays.arrays(float, 6, elements=st.floats(-400.0, 8000.0)),
    sd=arrays.arrays(float, (6, 3), elements=st.floats(1e-4, 1e3)),
    v=arrays.arrays(float, (6, 3), elements=st.floats(-80.0, 80.0)),  # land vehicles reach 150 m/s
    arm=arrays.arrays(float, 3, elements=st.floats(-3.0, 3.0)),
)
def test_fixes_and_readings(place: Array, h: Array, sd: Array, v: Array, arm: Array) -> None:
    llh = np.column_stack([place, h])
    gnss = Gnss(times(6, 0.0), llh, sd, v, sd, arm)
    odometer = Odometer(times(6, 0.0), v[:, 0], arm, signed=True)
    recording = replace(BASE, gnss=gnss, odometer=odometer, truth=None)
    with tempfile.TemporaryDirectory() as folder:
        write_folder(recording, folder)
        found = read(folder)
    np.testing.assert_allclose(found.gnss.llh[:, :2], llh[:, :2], rtol=3e-16)  # degrees are what is written
    np.testing.assert_array_equal(found.gnss.llh[:, 2], h)
    for name in ("t", "sd", "v", "sd_v", "lever_arm"):
        np.testing.assert_array_equal(getattr(found.gnss, name), getattr(gnss, name))
    np.testing.assert_array_equal(found.odometer.speed, odometer.speed)
    np.testing.assert_array_equal(found.odometer.lever_arm, arm)


@FEW
@given(values=numbers(5, 1e300))
def test_plain_tables(values: Array) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.csv.gz"
        write_csv(path, list("abcde"), list(values.T))
        found = read_table(path, list("abcde"))
    np.testing.assert_array_equal(found.stack(*"abcde"), values)


@FEW
@given(values=arrays.arrays(float, (4, 9), elements=st.floats(0.1, 1.4)), first=st.floats(-1e6, 1e9))
def test_trajectories_to_the_digits_that_are_written(values: Array, first: float) -> None:
    track = replace(
        logs.simulated(5.0)[1].take(np.arange(4)), t=np.round(times(4, first), 6), llh=values[:, :3], v=values[:, 3:6],
        rph=values[:, 6:], sd_p=values[:, :3], sd_v=values[:, 3:6], sd_rph=values[:, 6:],
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.csv"
        write_as("csv", track, path)
        once = read_trajectory(path)
        write_as("csv", once, path)
        twice = read_trajectory(path)
    np.testing.assert_allclose(once.llh, values[:, :3], atol=1e-4)
    for name in ("t", "llh", "v", "rph", "sd_p", "sd_v", "sd_rph"):
        np.testing.assert_allclose(getattr(once, name), getattr(twice, name), rtol=1e-9, err_msg=name)


@given(
    gate=st.sampled_from(["off", "on", "automatic"]) | st.floats(1e-6, 1e6),
    lag=st.floats(1.0, 1e6),
    slow=st.tuples(st.floats(1.0, 1e3), st.floats(1.0, 1e5)),
)
@settings(max_examples=40, deadline=None)
def test_settings(gate: str | float, lag: float, slow: tuple[float, float]) -> None:
    made = parse_settings({"gnss": {"gate": gate, "slow_times": slow}, "solver": {"lag": lag}})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s.toml"
        path.write_text(format_settings(made), encoding="utf-8")
        assert read_settings(path) == made
    assert isinstance(made.gnss, GnssSettings)


@given(
    t=st.floats(-1e9, 1e9), values=st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=6, max_size=6)
)
@settings(max_examples=100, deadline=None)
def test_lines_of_a_live_source(t: float, values: list[float]) -> None:
    assert parse_row(format_line(("imu", t, tuple(values)))) == ("imu", t, tuple(values))
    assert parse_row(format_line(("odometer", t, tuple(values))))[2][0] == values[0]
