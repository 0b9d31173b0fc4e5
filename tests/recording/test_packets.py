"""Times of rows by their stamps alone."""

import numpy as np
import pytest

from graphnav.recording import Imu
from graphnav.recording.formats.stamps import find_repeats, spread_packets
from graphnav.recording.plausibility.screening import spread_rows_read_at_once

PERIOD = 0.01
T = 100.0 + PERIOD * np.arange(3000)
NEW = np.zeros(len(T) - 1, dtype=bool)


def stamp_on_reading(t: np.ndarray, latency: float) -> np.ndarray:
    """A program that reads every `latency` s, and takes 20 us for a row."""
    read = np.ceil(t / latency) * latency
    return read + 2e-5 * (np.arange(len(t)) - np.searchsorted(read, read))


@pytest.mark.parametrize("latency", [0.016, 0.05, 0.5, 0.9])
def test_packets_are_spread(latency: float) -> None:
    stamps = stamp_on_reading(T, latency)
    found = spread_packets(stamps, NEW)
    assert found is not None
    times, at_once = found
    assert at_once == pytest.approx(latency / PERIOD, rel=0.04)
    late = (times - T)[stamps < stamps[-1] - 0.5 * latency]  # the last packet is not whole
    assert np.all(np.diff(times) > 0.0)
    assert late.min() > -0.01 * PERIOD
    assert late.max() < min(latency, 2.0 * PERIOD)


def test_packets_of_hundreds_of_rows() -> None:
    t = T[0] + 0.1 * (T - T[0])
    stamps = stamp_on_reading(t, 0.9)
    found = spread_packets(stamps, NEW)
    assert found is not None
    late = (found[0] - t)[stamps < stamps[-1] - 0.5]
    assert np.ptp(late) < 0.1 * 0.9
    assert np.abs(late).max() < 0.9


def test_lost_rows_are_not_spread_over() -> None:
    keep = (T < 110.0) | (T > 112.0)
    times = spread_packets(stamp_on_reading(T[keep], 0.05), NEW[: keep.sum() - 1])
    assert times is not None
    assert np.abs(times[0] - T[keep]).max() < 2.0 * PERIOD


def test_regular_and_scattered_stamps_stay() -> None:
    rng = np.random.default_rng(0)
    assert spread_packets(T, NEW) is None
    assert spread_packets(np.sort(T + 0.3 * PERIOD * rng.standard_normal(len(T))), NEW) is None


def test_a_log_that_writes_rows_twice_has_no_packets() -> None:
    t, x = np.repeat(T, 2), np.repeat(np.sin(T), 2)
    repeats = find_repeats({"t": t, "x": x})
    assert np.count_nonzero(repeats) == len(T)
    assert spread_packets(t, repeats) is None
    assert spread_packets(t, np.zeros(len(t) - 1, dtype=bool)) is not None


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_rows(n: int) -> None:
    assert spread_packets(T[:n], NEW[: max(n - 1, 0)]) is None


def test_packets_of_a_recording_made_by_a_program() -> None:
    """Those of files are spread by their reader."""
    x = np.random.default_rng(0).standard_normal((len(T), 3))
    imu = Imu(stamp_on_reading(T, 0.05), x, x)
    spread, findings = spread_rows_read_at_once(imu)
    assert [finding.key for finding in findings] == ["imu.packets"]
    assert np.ptp(np.diff(spread.t)[10:-10]) < 0.5 * PERIOD
    assert spread_rows_read_at_once(Imu(T, x, x))[0].t is T
