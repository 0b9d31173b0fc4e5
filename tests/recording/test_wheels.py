"""Odometers: read as they come, worth what they are worth, and not believed where they are wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.recording import Odometer, Recording
from graphnav.recording.checks import overview as checks
from graphnav.recording.formats import read
from graphnav.recording.odometer import (
    MeanSpeed,
    estimate_reading_sigma,
    find_gaps,
    find_pulse_length,
    find_quantum,
    find_wrong_readings,
)
from graphnav.recording.odometer.faults import FROZEN, GAP, STUCK, WILD
from graphnav.simulation import simulate

REAL = ("tokyo_20201105", "comma_highway_20180802", "oracle_drive")


def speed_at(t: Array) -> Array:
    """A speed whose integral is known."""
    return 9.0 + 4.0 * np.sin(0.21 * t) + 2.0 * np.sin(0.9 * t + 1.0)


def way_to(t: Array) -> Array:
    return 9.0 * t - 4.0 / 0.21 * np.cos(0.21 * t) - 2.0 / 0.9 * np.cos(0.9 * t + 1.0)


def made(tmp_path: Path, table: str, header: str, rows: Array) -> Odometer:
    """The odometer of a recording folder with these lines in [odometer] and these rows."""
    imu = np.column_stack([np.arange(100) / 100.0, np.zeros((100, 5)), np.full(100, 9.8)])
    np.savetxt(tmp_path / "imu.csv", imu, delimiter=",", header="t,gx,gy,gz,ax,ay,az", comments="", fmt="%.6f")
    np.savetxt(tmp_path / "odometer.csv", rows, delimiter=",", header=header, comments="", fmt="%.12g")
    text = f'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "imu.csv"\n[odometer]\n{table}\n'
    (tmp_path / "recording.toml").write_text(text + 'file = "odometer.csv"\n', encoding="utf-8")
    recording = read(tmp_path)
    assert recording.odometer is not None
    return replace(recording.odometer)


T = np.arange(0.0, 60.0, 0.05)
PULSES = np.floor(way_to(T) / 0.02) - np.floor(way_to(T[0]) / 0.02)
PER_ROW = np.r_[0.0, np.diff(PULSES)]
CUMULATIVE = 'metres_per_pulse = 0.1\npulses = "cumulative"\nsigned = true'


# --- reading ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "key"),
    [
        (PULSES, ""),
        (PER_ROW, ""),
        (PULSES, 'pulses = "cumulative"'),
        (PER_ROW, 'pulses = "per_row"'),
        (np.mod(PULSES + 200.0, 2**8), ""),  # 600 m of 0.02 m run over a byte a hundred times
        (np.mod(PULSES + 65000.0, 2**16), "signed = false"),
        (np.mod(PULSES + 2.0**32 - 500.0, 2**32), ""),
    ],
    ids=["cumulative", "per-row", "said-cumulative", "said-per-row", "8-bit", "16-bit", "32-bit"],
)
def test_pulses_become_the_same_way_however_they_were_counted(tmp_path: Path, count: Array, key: str) -> None:
    o = made(tmp_path, f"metres_per_pulse = 0.02\n{key}", "t,pulses", np.column_stack([T, count]))
    assert o.counted is not None
    assert np.allclose(o.counted, 0.02 * PULSES, atol=1e-6)
    assert np.abs(o.speed - speed_at(T))[1:-1].max() < 0.02 / 0.1 + 0.01  # one pulse over two periods
    assert o.pulse == 0.02


def test_a_counter_that_counts_back_and_runs_over(tmp_path: Path) -> None:
    true = np.round(300.0 * np.sin(0.2 * T))  # forward and backward across both ends of the byte
    o = made(tmp_path, CUMULATIVE, "t,pulses", np.column_stack([T, np.mod(true, 256)]))
    assert o.counted is not None
    assert np.allclose(o.counted, 0.1 * (true - true[0]), atol=1e-6)
    assert o.signed
    assert o.speed.min() < -5.0


def test_wheels_make_the_speed_of_the_axle_asked_for(tmp_path: Path) -> None:
    wheels = np.outer(speed_at(T), [1.01, 1.03, 0.99, 1.00])
    rows = np.column_stack([T, wheels])
    header = "t,speed_fl,speed_fr,speed_rl,speed_rr"
    for key, factor in (("", 0.995), ('use = "front"', 1.02), ('use = "all"', 1.0075)):
        o = made(tmp_path, key, header, rows)
        assert np.allclose(o.speed, factor * speed_at(T), atol=1e-6)
    assert o.wheels is not None
    assert np.allclose(o.wheels, wheels, atol=1e-6)
    both = made(tmp_path, "", f"{header},speed", np.column_stack([rows, np.full(len(T), 3.0)]))
    assert (both.speed == 3.0).all()  # a speed column is what it says


def test_blank_readings_are_dropped_and_figures_kept(tmp_path: Path) -> None:
    rows = np.column_stack([T, speed_at(T), np.full(len(T), np.nan)])
    rows[10:13, 1] = np.nan
    o = made(tmp_path, "speed_sigma = 0.07\ndelay_sigma = 0.2", "t,speed,speed_rl", rows)
    assert len(o.t) == len(T) - 3
    assert (o.speed_sigma, o.delay_sigma, o.signed) == (0.07, 0.2, False)
    assert estimate_reading_sigma(o) == 0.07


@pytest.mark.parametrize(
    ("table", "header", "words"),
    [
        ('pulses = "per_row"', "t,speed", ["metres_per_pulse"]),
        ("metres_per_pulse = 0.02", "t,speed", ["odometer.csv", "no column 'pulses'"]),
        ("metres_per_pulse = 0.02\nuse = 'rear'", "t,pulses", ["metres_per_pulse", "use"]),
        ('use = "rear"', "t,speed_rl", ["no column 'speed_rr'"]),
        ("", "t,velocity", ["no column 'speed'", "velocity"]),
        ("speed_sigma = 0.0", "t,speed", ["odometer.speed_sigma"]),
        ("signed = 1", "t,speed", ["odometer.signed"]),
    ],
)
def test_what_cannot_be_read_is_said(tmp_path: Path, table: str, header: str, words: list[str]) -> None:
    with pytest.raises(RecordingError) as error:
        made(tmp_path, table, header, np.column_stack([T, speed_at(T)]))
    assert all(word in str(error.value) for word in words)


# --- what a reading is worth -----------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.19625, 0.01 / 3.6, 0.5, 0.0])
@pytest.mark.parametrize("digits", [5, 12])
def test_the_step_of_rounded_readings_is_found(step: float, digits: int) -> None:
    for seed in range(3):
        v = speed_at(T) + 0.03 * np.random.default_rng(seed).standard_normal(len(T))
        read_as = np.round(np.round(v / step) * step, digits) if step else v
        assert find_quantum(read_as) == pytest.approx(step, rel=1e-3)


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.3])
def test_the_noise_of_readings_is_found_whatever_the_motion(sigma: float) -> None:
    t = np.arange(0.0, 300.0, 0.05)
    v = speed_at(t) + sigma * np.random.default_rng(4).standard_normal(len(t))
    assert estimate_reading_sigma(Odometer(t, v)) == pytest.approx(sigma, rel=0.05)


def errors_over_sigma(odometer: Odometer, window: float) -> tuple[float, float]:
    """RMS of the errors of the mean speed over its sigma, and of the errors, m/s."""
    mean_speed = MeanSpeed.of(odometer)
    a = np.arange(5.0, odometer.t[-1] - 10.0, 0.37)
    error = mean_speed(a, a + window)[0] - (way_to(a + window) - way_to(a)) / window
    whitened = error / mean_speed.compute_sigma(a, a + window)
    return float(np.sqrt(np.mean(whitened**2))), float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("rate", [10.0, 20.0, 100.0])
def test_the_sigma_of_a_mean_is_that_of_its_errors(rate: float) -> None:
    rng = np.random.default_rng(7)
    t = np.arange(0.0, 400.0, 1.0 / rate)
    noisy = speed_at(t) + 0.05 * rng.standard_normal(len(t))
    way = np.floor(way_to(t) / 0.1) * 0.1
    edges = np.append(t, t[-1] + 1.0 / rate) - 0.5 / rate
    per_row = np.diff(np.floor(way_to(edges) / 0.1) * 0.1) * rate
    for window in (0.5, 1.0, 5.0):
        white, _ = errors_over_sigma(Odometer(t, noisy), window)
        assert 0.85 < white < 1.15
        rounded, _ = errors_over_sigma(Odometer(t, np.round(noisy / 0.2) * 0.2), window)
        assert 0.6 < rounded < 1.15
        counted, error = errors_over_sigma(Odometer(t, np.gradient(way, t), counted=way, pulse=0.1), window)
        assert 0.7 < counted < 1.1
        assert error < 0.1 / np.sqrt(6.0) / window * 1.1
        told, _ = errors_over_sigma(Odometer(t, per_row), window)
        assert 0.6 < told < 1.1


def test_pulses_in_a_column_of_speeds_are_recognised() -> None:
    t = np.arange(0.0, 400.0, 0.05)
    way = np.floor(way_to(t) / 0.02) * 0.02
    per_row = np.diff(way, prepend=way[0]) * 20.0
    assert find_pulse_length(Odometer(t, per_row)) == pytest.approx(0.02, rel=1e-3)
    rng = np.random.default_rng(1)
    assert (
        find_pulse_length(Odometer(t, np.round((speed_at(t) + 0.1 * rng.standard_normal(len(t))) / 0.2) * 0.2)) == 0.0
    )
    assert find_pulse_length(Odometer(t, np.round(speed_at(t) / 0.2) * 0.2)) == 0.0
    # counted over the last second, as some loggers do: the errors of neighbours are nearly the same
    over_a_second = (np.floor(way_to(t) / 0.2) - np.floor(way_to(t - 1.0) / 0.2)) * 0.2
    assert find_pulse_length(Odometer(t, over_a_second)) == 0.0


# --- the mean over a window ------------------------------------------------------------------------------------


def test_means_are_exact_for_a_speed_straight_between_readings() -> None:
    t = np.sort(np.random.default_rng(3).uniform(0.0, 30.0, 200))
    v = np.random.default_rng(4).normal(8.0, 3.0, 200)
    a = np.linspace(t[0], 20.0, 57)
    b = a + np.linspace(0.01, 8.0, 57)
    fine = [np.linspace(x, y, 200_001) for x, y in zip(a, b, strict=True)]
    expected = [np.trapezoid(np.interp(f, t, v), f) / (f[-1] - f[0]) for f in fine]
    whole = Odometer(t, v)
    assert np.diff(t).max() < 3.5 * np.percentile(np.diff(t), 95.0)
    mean_speed = MeanSpeed.of(whole)
    assert np.allclose(mean_speed(a, b)[0], expected, atol=1e-6)
    # a delay moves the window, and its derivative is that of the mean
    assert np.allclose(mean_speed(a, b, 0.3)[0], mean_speed(a + 0.3, b + 0.3)[0])
    inside = a > t[0] + 1e-3
    difference = (mean_speed(a, b, 1e-5)[0] - mean_speed(a, b, -1e-5)[0]) / 2e-5
    assert np.allclose(mean_speed(a, b)[1][inside], difference[inside], atol=2e-2, rtol=1e-3)


def test_no_mean_where_readings_are_missing_or_wrong() -> None:
    t = np.arange(0.0, 100.0, 0.1)
    t = t[(t < 40.0) | (t > 45.0)]
    mean_speed = MeanSpeed.of(Odometer(t, speed_at(t)), np.array([[70.0, 72.0]]))
    a = np.arange(-1.0, 101.0, 0.05)
    none = np.isnan(mean_speed(a, a + 1.0)[0])
    first_good, last_bad = 72.0, 69.9  # the readings beside the span
    beside = ((a + 1.0 > 39.9) & (a < 45.1)) | ((a + 1.0 > last_bad) & (a < first_good))
    expected = (a < 0.0) | (a + 1.0 > t[-1]) | beside
    edge = np.min(np.abs(np.subtract.outer(a, [0.0, t[-1] - 1.0, 38.9, 45.1, 68.9, 72.0])), axis=1) < 0.06
    assert (none == expected)[~edge].all()
    assert np.allclose(find_gaps(t), [[40.0, 45.1]], atol=0.11)


def test_the_sigma_of_a_mean_does_not_ask_what_comes_after_its_window() -> None:
    t = np.arange(0.0, 10.01, 0.5)
    window = np.array([3.0]), np.array([8.0])
    readings = [Odometer(t[:end], speed_at(t[:end]), speed_sigma=0.1) for end in (17, len(t))]
    ends, goes_on = (MeanSpeed.of(o).compute_sigma(*window) for o in readings)
    assert readings[0].t[-1] == window[1]
    np.testing.assert_allclose(ends, 0.1 / np.sqrt(10.0))
    np.testing.assert_array_equal(ends, goes_on)


def test_few_readings_give_no_means() -> None:
    for n in (0, 1):
        o = Odometer(np.zeros(n), np.zeros(n))
        assert np.isnan(MeanSpeed.of(o)(np.zeros(3), np.ones(3))[0]).all()
        assert len(find_wrong_readings(o).spans) == 0


# --- what is wrong ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def town() -> Callable[[int], Recording]:
    """Six minutes of a simulated town that ends backwards in a parking place; the odometer is signed, 10 Hz."""
    known: dict[int, Recording] = {}

    def drive(seed: int) -> Recording:
        if seed not in known:
            known[seed] = simulate("urban", seed=seed, duration=360.0, rate=50.0).recording
        return known[seed]

    return drive


def odometer_of(recording: Recording) -> Odometer:
    assert recording.odometer is not None
    return recording.odometer


VARIANTS: dict[str, Callable[[Odometer], Odometer]] = {
    "as it is": lambda o: o,
    "unsigned": lambda o: replace(o, speed=np.abs(o.speed), signed=False),
    "late": lambda o: replace(o, t=o.t + 0.65),
    "coarse": lambda o: replace(o, speed=np.round(o.speed / 0.5) * 0.5),
    "rows lost": lambda o: _rows(o, np.random.default_rng(0).random(len(o.t)) > 0.05),
    "jitter": lambda o: replace(o, t=np.sort(o.t + np.random.default_rng(0).uniform(-0.04, 0.04, len(o.t)))),
    "averaged": lambda o: replace(o, speed=np.convolve(o.speed, np.full(10, 0.1))[: len(o.t)]),
    "deaf": lambda o: replace(o, speed=np.where(np.abs(o.speed) < 0.7, 0.0, o.speed)),
}


def _rows(o: Odometer, kept: Array) -> Odometer:
    return replace(o, t=o.t[kept], speed=o.speed[kept])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_nothing_is_wrong_with_a_sound_odometer(
    town: Callable[[int], Recording], seed: int, variant: Callable[[Odometer], Odometer]
) -> None:
    o = variant(odometer_of(town(seed)))
    assert find_wrong_readings(o, town(seed).imu).reasons == ()
    assert find_wrong_readings(o).reasons == ()


@pytest.mark.parametrize("name", REAL)
def test_nothing_is_wrong_with_real_odometers(shared_data: Path, name: str) -> None:
    recording = read(shared_data / name)
    o = odometer_of(recording)
    for variant in (o, replace(o, t=o.t + 0.65), replace(o, t=o.t[::5], speed=o.speed[::5], signed=False)):
        assert find_wrong_readings(variant, recording.imu).reasons == ()


def moving_at(o: Odometer, speed: float, seconds: float, rng: np.random.Generator) -> int:
    """A reading from which on the vehicle is faster than `speed` for so long."""
    n = round(seconds / float(np.median(np.diff(o.t))))
    fast = np.lib.stride_tricks.sliding_window_view(np.abs(o.speed) > speed, n).all(axis=1)
    return int(rng.choice(np.flatnonzero(fast)[5:]))


@pytest.mark.parametrize("late", [0.0, 0.65])
@pytest.mark.parametrize("seed", range(3))
def test_stuck_at_zero_is_found_to_the_reading(town: Callable[[int], Recording], seed: int, late: float) -> None:
    o, imu = odometer_of(town(seed)), town(seed).imu
    o = replace(o, t=o.t + late)
    i = moving_at(o, 4.0, 8.0, np.random.default_rng(seed))
    j = i + 70
    stuck = replace(o, speed=np.where((np.arange(len(o.t)) >= i) & (np.arange(len(o.t)) < j), 0.0, o.speed))
    for found in (find_wrong_readings(stuck, imu), find_wrong_readings(stuck)):
        assert found.reasons == (STUCK,)
        assert np.allclose(found.spans, [[o.t[i], o.t[j]]], atol=0.11)


def test_unplugged_at_a_stop_and_back_in_motion(town: Callable[[int], Recording]) -> None:
    o, imu = odometer_of(town(1)), town(1).imu
    starts = np.flatnonzero((o.speed[:-1] == 0.0) & (o.speed[1:] != 0.0))
    k = next(k for k in starts if (o.speed[k + 40 : k + 60] > 4.0).all() and (o.speed[k - 20 : k] == 0.0).all())
    speed = o.speed.copy()
    speed[k - 10 : k + 50] = 0.0
    found = find_wrong_readings(replace(o, speed=speed), imu)
    assert found.reasons == (STUCK,)
    # what it read at the stop was true; a stop is told from a slow start only when that has reached a walking speed
    assert found.spans[0, 0] > o.t[k] - 1.5
    assert np.interp(found.spans[0, 0], o.t, o.speed) < 1.0
    assert found.spans[0, 1] == pytest.approx(o.t[k + 50], abs=0.11)


@pytest.mark.parametrize("seed", range(3))
def test_a_frozen_odometer_is_found(town: Callable[[int], Recording], seed: int) -> None:
    """From before a stop, where the speed changes, until after it; without the IMU the end tells."""
    o, imu = odometer_of(town(seed)), town(seed).imu
    stops = np.flatnonzero((o.speed[:-1] > 0.0) & (o.speed[1:] == 0.0))
    stop = next(k for k in stops if k > 100 and (o.speed[k - 60 : k - 40] > 5.0).all())
    i, j = stop - 50, stop + 30
    speed = o.speed.copy()
    speed[i:j] = o.speed[i - 1]
    found = find_wrong_readings(replace(o, speed=speed), imu)
    assert found.reasons == (FROZEN,)
    assert np.allclose(found.spans, [[o.t[i], o.t[j]]], atol=0.25)


def test_a_noisy_odometer_that_freezes_at_even_speed_is_found_by_its_silence() -> None:
    t = np.arange(0.0, 300.0, 0.05)
    speed = 20.0 + 0.05 * np.random.default_rng(2).standard_normal(len(t))
    assert find_wrong_readings(Odometer(t, speed)).reasons == ()
    speed[1000:1040] = speed[999]
    found = find_wrong_readings(Odometer(t, speed))
    assert found.reasons == (FROZEN,)
    assert np.allclose(found.spans, [[t[1000], t[1040]]])
    # every reading logged five times over, as a fast logger does with a slow sensor
    slow = np.repeat(20.0 + 0.05 * np.random.default_rng(2).standard_normal(1200), 5)
    assert find_wrong_readings(Odometer(t, slow)).reasons == ()


def test_spikes_and_gaps(town: Callable[[int], Recording]) -> None:
    o, imu = odometer_of(town(2)), town(2).imu
    i = moving_at(o, 4.0, 10.0, np.random.default_rng(0))
    speed = o.speed.copy()
    speed[i : i + 3] = 45.0
    kept = (np.arange(len(o.t)) < i + 20) | (np.arange(len(o.t)) > i + 50)
    found = find_wrong_readings(_rows(replace(o, speed=speed), kept), imu)
    assert found.reasons == (WILD, GAP)
    assert np.allclose(found.spans, [[o.t[i], o.t[i + 3]], [o.t[i + 20], o.t[i + 51]]], atol=0.11)


def test_clocks_far_apart_or_wrong_axes_do_not_accuse_the_odometer(town: Callable[[int], Recording]) -> None:
    o, imu = odometer_of(town(0)), town(0).imu
    assert find_wrong_readings(replace(o, t=o.t + 18.0), imu).reasons == ()
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert find_wrong_readings(o, replace(imu, accel=imu.accel @ turned, gyro=imu.gyro @ turned)).reasons == ()
    assert find_wrong_readings(o, replace(imu, accel=0.0 * imu.accel, gyro=0.0 * imu.gyro)).reasons == ()


def test_an_odometer_that_never_turns_is_found(town: Callable[[int], Recording]) -> None:
    o = odometer_of(town(0))
    found = find_wrong_readings(replace(o, speed=np.zeros(len(o.t))), town(0).imu)
    assert found.reasons == (STUCK,)
    assert float(np.sum(np.diff(found.spans))) > 0.8 * (o.t[-1] - o.t[0])


def test_real_odometers_with_made_faults(shared_data: Path) -> None:
    recording = read(shared_data / "tokyo_20201105")
    o = odometer_of(recording)
    cases = ((1011.0, 15.0, 0.0, STUCK), (1649.8, 15.0, None, FROZEN), (238.4, 0.3, 35.0, WILD))
    for at, seconds, value, reason in cases:
        i, j = np.searchsorted(o.t, [at, at + seconds])
        speed = o.speed.copy()
        speed[i:j] = speed[i - 1] if value is None else value
        found = find_wrong_readings(replace(o, speed=speed), recording.imu)
        assert found.reasons == (reason,)
        assert np.allclose(found.spans, [[o.t[i], o.t[j]]], atol=0.1)


# --- what is said ----------------------------------------------------------------------------------------------


def test_info_says_what_is_odd(shared_data: Path, town: Callable[[int], Recording]) -> None:
    found = checks.inspect(read(shared_data / "tokyo_20201105"))
    assert found.facts["odometer"]["step_mps"] == pytest.approx(0.19625, abs=1e-5)  # its README
    assert any(f.key == "odometer.steps" and "0.196" in f.sentence for f in found.findings)
    assert "odometer.unsigned" in {f.key for f in found.findings}
    recording = town(1)
    o = odometer_of(recording)
    i = moving_at(o, 4.0, 8.0, np.random.default_rng(1))
    speed = o.speed.copy()
    speed[i : i + 70] = 0.0
    wheels = np.outer(o.speed, [1.0, 1.0, 1.0, 0.93])
    found = checks.inspect(replace(recording, odometer=replace(o, speed=speed, wheels=wheels)))
    at = o.t[i] - recording.start
    stuck = [f.sentence for f in found.findings if f.key == "odometer.stuck_at_zero"]
    assert any("7.00" in one and f"{at:.1f}" in one for one in stuck), found.findings
    assert any(f.key == "odometer.wheel" and "7.0 %" in f.sentence for f in found.findings)
    assert "odometer.unsigned" not in {f.key for f in found.findings}


def test_four_real_wheels_agree(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "comma_highway_20180802"
    text = (source / "recording.toml").read_text(encoding="utf-8")
    names = "speed_fl = 'fl_mps', speed_fr = 'fr_mps', speed_rl = 'rl_mps', speed_rr = 'rr_mps'"
    text = text.replace('columns = { t = "t_s", speed = "speed_mps" }', f"columns = {{ t = 't_s', {names} }}")
    for file in ("imu", "gnss", "odo", "truth"):
        text = text.replace(f'"{file}.csv.gz"', f'"{source / file}.csv.gz"')
    (tmp_path / "recording.toml").write_text(text, encoding="utf-8")
    recording = read(tmp_path, allow_outside=True)
    found = checks.inspect(recording)
    assert odometer_of(recording).wheels is not None
    # its README: true/recorded 1.0095 and 1.0099 of the rear wheels against the pose, 1.0088 of all four
    assert found.facts["odometer"]["true_over_recorded"] == pytest.approx(1.0093, abs=0.001)
    assert "odometer.wheel" not in {f.key for f in found.findings}
