"""Detectors: statistics against their definitions, lines against their closed form, stops against truth."""

from __future__ import annotations

import csv
import functools
import gzip
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers import refuse_command
from road import MG, made, with_gnss

from graphnav.app import cli
from graphnav.config import Settings
from graphnav.config.detectors import FftSettings, FusionSettings
from graphnav.core.notes import get_key
from graphnav.core.running import sum_rows
from graphnav.detectors import base, detect, fft, find_stops, glrt, motion, spectrum, thresholds, windows
from graphnav.recording import Imu, ImuNoise, Odometer, Recording
from graphnav.recording.formats import read
from graphnav.recording.formats.writing import write_folder
from graphnav.simulation import simulate


def covered(t, spans):
    return base.mask_inside(t, spans)


def rates(spans, stops, start, end):
    """(share of stopped seconds found, share of moving seconds called stationary)."""
    t = np.arange(start, end, 0.01)
    still, found = covered(t, stops), covered(t, spans)
    return found[still].mean(), found[~still].mean()


@functools.cache
def load(source):
    return read(source)


# ---- statistics


def test_statistics_are_the_sums_of_skog():
    rng = np.random.default_rng(1)
    accel = rng.standard_normal((60, 3)) + np.array([0.3, -0.5, 9.7])
    gyro = 0.2 * rng.standard_normal((60, 3))
    N, s_a, s_w, g = 7, 0.11, 0.013, 9.79
    want = {name: [] for name in glrt.STATISTICS}
    for k in range(60 - N + 1):
        f, w = accel[k : k + N], gyro[k : k + N]
        mean = f.mean(axis=0)
        u = mean / np.linalg.norm(mean)
        want["glrt"].append(sum(np.sum((a - g * u) ** 2) / s_a**2 + b @ b / s_w**2 for a, b in zip(f, w, strict=True)))
        want["acceleration_variance"].append(sum(np.sum((a - mean) ** 2) for a in f) / s_a**2)
        want["acceleration_magnitude"].append(sum((np.linalg.norm(a) - g) ** 2 for a in f) / s_a**2)
        want["angular_rate_energy"].append(sum(b @ b for b in w) / s_w**2)
    for name, values in want.items():
        found = glrt.compute_glrt(accel, gyro, N, s_a, s_w, g, name)
        np.testing.assert_allclose(found, np.array(values) / N, rtol=1e-9)
    assert len(glrt.compute_glrt(accel[:5], gyro[:5], N, s_a, s_w, g)) == 0


def test_running_sums_keep_their_digits_over_hours():
    rng = np.random.default_rng(2)
    rows = 96.0 + 1e-3 * rng.standard_normal((2_000_000, 1))
    means = sum_rows(rows).compute_means(50)
    assert np.abs(means[-1] - rows[-50:].mean()) < 1e-9
    assert len(means) == len(rows) - 49


def test_noise_alone_makes_of_the_low_band_statistic_what_it_says():
    # density, low-pass gain and window against each other: S is near 1 less what the window's own mean takes
    rng = np.random.default_rng(3)
    rate, n = 200.0, 400_000
    noise = ImuNoise(gyro_noise_density=1e-3, accel_noise_density=2e-2)
    imu = Imu(
        np.arange(1, n + 1) / rate,
        noise.gyro_noise_density * np.sqrt(rate) * rng.standard_normal((n, 3)),
        noise.accel_noise_density * np.sqrt(rate) * rng.standard_normal((n, 3)) + [0, 0, 9.8],
        noise,
    )
    low = windows.low_pass(windows.average_blocks(imu, 1.0 / rate))
    for columns, density in ((slice(0, 3), noise.accel_noise_density), (slice(3, 6), noise.gyro_noise_density)):
        np.testing.assert_allclose(low.rows[:, columns].std(axis=0), low.gain * density, rtol=0.03)


@pytest.mark.parametrize("rate", [50.0, 100.0, 104.0, 200.0, 400.0])
def test_the_low_pass_leaves_nothing_of_an_engine(rate):
    size = max(1, int(rate / windows.BLOCK_RATE + 1e-6))
    h = windows.make_kernel(size / rate)
    f = np.linspace(0.0, 0.5 * rate / size, 2000)
    response = np.abs(np.exp(-2j * np.pi * np.outer(f, np.arange(len(h))) * size / rate) @ h)
    assert abs(response[0] - 1.0) < 1e-12
    assert response[f < 1.0].min() > 0.8
    assert response[f > 8.0].max() < 2e-3


def test_a_valley_is_found_between_two_populations_only():
    rng = np.random.default_rng(4)
    low, high = rng.normal(-0.5, 0.2, 800), rng.normal(3.0, 0.6, 9000)
    found = thresholds.find_valley(np.concatenate([low, high]), -1.0, 2.0, 30)
    assert found is not None
    assert low.max() - 0.3 < found < high.min() + 0.5
    assert thresholds.find_valley(high, -1.0, 5.0, 30) is None
    assert thresholds.find_valley(low, -3.0, 2.0, 30) is None


def test_spans_are_sets():
    rng = np.random.default_rng(5)
    grid = np.arange(0.0, 100.0, 0.013)

    def some():
        a = rng.uniform(0.0, 95.0, 12)
        return np.stack([a, a + rng.uniform(0.1, 6.0, 12)], -1)

    one, other = some(), some()
    in_one = np.any([(grid >= a) & (grid <= b) for a, b in one], axis=0)
    in_other = np.any([(grid >= a) & (grid <= b) for a, b in other], axis=0)
    joined, taken = base.merge_spans(one), base.merge_spans(other)
    assert (joined[1:, 0] > joined[:-1, 1]).all()
    np.testing.assert_array_equal(covered(grid, joined), in_one)
    np.testing.assert_array_equal(covered(grid, base.subtract_spans(joined, taken)), in_one & ~in_other)
    assert len(base.subtract_spans(joined, np.array([[-1.0, 200.0]]))) == 0
    shared = [np.sum(in_one & (grid >= a) & (grid <= b)) * 0.013 for a, b in taken]
    np.testing.assert_allclose(base.measure_overlap(joined, taken), shared, atol=0.013 * 2 * len(joined))
    np.testing.assert_allclose(base.measure_overlap(joined, joined), np.diff(joined).ravel())
    runs = base.find_spans(in_one, grid)
    assert len(runs) == len(joined)
    assert np.abs(runs - joined).max() < 0.013


# ---- spectrum


def test_a_line_between_two_bins_is_read_as_it_is():
    rate, n = 200.0, 600
    t = np.arange(n) / rate
    for frequency in (12.495, 24.991, 14.5, 11.84, 19.1667):
        x = 3.1 * np.sin(2 * np.pi * frequency * t + 0.4)
        w = spectrum.Windows((x, x, x), n, n, rate)
        ((_, a),) = w.compute_amplitudes()
        where, height = spectrum.find_peaks(a[0, 0], w.frequencies, 10.0, 30.0)
        assert abs(where - frequency) < 0.005
        assert abs(height / 3.1 - 1.0) < 0.005
    # without the interpolation the worst of them reads 15 % low
    assert spectrum.find_peaks(a[0, 0], w.frequencies, 10.0, 30.0)[1] > 1.1 * a[0, 0].max()


def test_braking_does_not_leak_into_the_bands_of_an_engine():
    # a push of 1 m/s^2 within the window: what leaks of it into 10 to 30 Hz is far below an idle line of 1 mg
    t = np.arange(600) / 200.0
    x = 1.0 / (1.0 + np.exp(-(t - 1.7) / 0.15))
    w = spectrum.Windows((x, x, x), 600, 600, 200.0)
    ((_, a),) = w.compute_amplitudes()
    inside = (w.frequencies > 10.0) & (w.frequencies < 30.0)
    assert a[0, 0, inside].max() < 0.1 * MG
    assert np.abs(np.fft.rfft(x))[inside].max() * 2.0 / 600 > 0.7 * MG


@pytest.mark.parametrize("engine", [8.5, 12.495, 21.3, 33.0, 40.0])
def test_the_idle_line_is_found_wherever_it_is(engine):
    recording, _, _ = made(6, [(60, 0), (8, 12), (30, 12), (8, 0), (40, 0)], engine=engine)
    found = detect(recording)["fft"]
    assert abs(found.details["idle_line"][0] - engine) < 0.03
    assert "detectors.fft.line" in map(get_key, found.notes)
    stops = np.array([[0.0, 60.0], [106.5, 146.0]])
    right, wrong = rates(found.intervals, stops, 0.0, 146.0)
    assert right > 0.93
    assert wrong < 0.01


def test_without_an_engine_the_answer_is_a_sentence():
    recording, _, _ = made(7, [(30, 0), (8, 12), (30, 12), (8, 0), (30, 0)], engine=0.0)
    found = detect(recording)
    assert "detectors.fft.no_line" in map(get_key, found.notes)
    assert not found["fft"].mask.any()
    assert len(found.stationary) == 2


def test_at_fifty_hertz_the_bands_are_cut_and_a_sentence_says_so():
    recording, _, _ = made(8, [(40, 0), (8, 12), (30, 12), (8, 0), (40, 0)], rate=50.0, engine=18.0)
    found = detect(recording)
    assert "detectors.fft.bands_cut" in map(get_key, found.notes)
    assert abs(found["fft"].details["idle_line"][0] - 18.0) < 0.05
    assert len(found.stationary) == 2


def test_the_papers_rule_by_hand():
    # amplitudes of table 4, mean: forward, up (mg) and pitch (deg/s); then each condition broken by itself
    height = np.array([[[0.369, 2.509, 3.078], [0.108, 4.389, 3.592], [0.002, 0.294, 0.004]]])
    height[0, :2] *= MG
    height[0, 2] = np.radians(height[0, 2])
    s = FftSettings()
    assert (fft._compute_quotients(height, s) < 1.0).all()
    for channel, band, factor, broken in (
        (0, 1, 6.0, {0}), (1, 2, 5.0, {1}), (2, 1, 2.5, {2}), (0, 1, 0.09, {3}), (0, 2, 0.07, {4}), (1, 1, 0.016, {5}),
        (1, 2, 0.02, {6}), (2, 1, 0.04, {7}),
    ):  # fmt: skip
        changed = height.copy()
        changed[0, channel, band] *= factor
        assert set(np.flatnonzero(fft._compute_quotients(changed, s)[0] >= 1.0).tolist()) == broken


# ---- stops against truth


@pytest.mark.parametrize(("seed", "engine"), [(1, 12.4955), (2, 8.0), (5, 40.0)])
def test_idling_with_passengers_is_one_stop(seed, engine):
    drive = simulate("li2024", seed=seed, engine_hz=engine, short=True)
    edges = np.array(drive.facts["stop_edges"])
    for recording in (drive.recording, replace(drive.recording, gnss=None)):
        found = detect(recording)
        right, wrong = rates(found.stationary, drive.stops, recording.start, recording.end)
        assert right > 0.988
        assert wrong < 1e-3
        for a, b in edges:
            (inside,) = [s for s in found.stationary if s[1] > a and s[0] < b]
            assert a - 0.1 < inside[0] < a + 1.0
            assert b - 1.0 < inside[1] < b + 0.1


def test_edges_hold_no_motion():
    for seed in range(3):
        recording, t, v = made(seed, [(20, 0), (6, 9), (15, 9), (5, 0), (12, 0), (4, 6), (5, 6), (3, 0), (10, 0)])
        found = detect(recording).stationary
        assert len(found) == 3
        assert np.abs(v[covered(t, found)]).max() < 2e-3
        assert rates(found, base.find_spans(v == 0.0, t), t[0], t[-1])[0] > 0.95


@pytest.mark.parametrize("speed", [0.1, 0.2, 0.3])
@pytest.mark.parametrize("road", [0.0, 1.0])
def test_crawling_between_two_stops_is_no_stop(speed, road):
    recording, t, v = made(11, [(20, 0), (1, speed), (20, speed), (1, 0), (20, 0)], road=road)
    found = detect(recording)
    assert len(found.stationary) == 2
    assert np.abs(v[covered(t, found.stationary)]).max() < 5e-3


def test_a_cruise_holds_no_stop():
    recording, _, _ = made(12, [(1, 30), (200, 30), (5, 33), (200, 33)], road=0.1)
    assert len(detect(recording).stationary) == 0


def test_a_recording_at_rest_is_one_stop():
    recording, t, _ = made(13, [(120, 0)], engine=0.0)
    np.testing.assert_allclose(detect(recording).stationary, [[t[0], t[-1]]], atol=0.02)


def test_a_passenger_is_bridged_and_a_hop_forward_is_not():
    shaken, t, _ = made(14, [(60, 0)], shakes=((25.0, 4.0, 0.3),))
    found = detect(shaken)
    assert (found["low_band_glrt"].statistic > found["low_band_glrt"].threshold).any()
    np.testing.assert_allclose(found.stationary, [[t[0], t[-1]]], atol=0.02)
    assert len(found["fused"].details["disturbed"]) == 1
    hop, t, v = made(14, [(25, 0), (2, 0.5), (2, 0), (31, 0)])
    found = detect(hop)
    assert len(found.stationary) == 2
    assert np.abs(v[covered(t, found.stationary)]).max() < 2e-3


def test_turning_on_the_spot_is_no_stop():
    """A tracked robot turns without vibration at a constant rate, its odometer at zero."""
    recording, t, _ = made(17, [(30, 0), (10, 0), (20, 0), (12, 0), (30, 0)], engine=0.0)
    rate = np.radians(np.interp(t, [30, 31, 39, 40, 60, 61, 71, 72], [0, 20, 20, 0, 0, -30, -30, 0]))
    gyro = recording.imu.gyro + np.outer(rate, [0.0, 0.0, 1.0])
    turning = replace(recording, imu=replace(recording.imu, gyro=gyro))
    stops = np.array([(0.0, 30.0), (40.0, 60.0), (72.0, 102.0)])
    found, false = rates(detect(turning).stationary, stops, 0.0, 102.0)
    assert found > 0.95
    assert false < 0.02
    np.testing.assert_allclose(detect(recording).stationary, [[t[0], t[-1]]], atol=0.02)


def test_a_measured_speed_overrules_a_smooth_ride():
    # a road without any unevenness: the IMU alone cannot tell, the fixes can, and in their outage still the force
    recording, t, v = made(15, [(20, 0), (8, 15), (90, 15), (8, 0), (20, 0), (8, 15), (30, 15)], road=0.0, engine=0.0)
    for outage in ((np.inf, np.inf), (60.0, 90.0)):
        found = detect(with_gnss(recording, t, v, outage))
        assert np.abs(v[covered(t, found.stationary)]).max() < 2e-3
        assert rates(found.stationary, base.find_spans(v == 0.0, t), t[0], t[-1])[0] > 0.85
        assert "detectors.speed_known" in map(get_key, found.notes)


@pytest.mark.parametrize("stop", [False, True])
def test_a_smooth_road_without_fixes_is_no_stop_after_a_measured_speed(stop):
    # rough roads before and after, so that the smooth one is the exception
    legs = [(20, 0), (8, 15), (66, 15), *([(8, 0), (10, 0), (8, 15)] if stop else [(26, 15)]), (10, 10), (40, 12)]
    rough, t, v = made(21, legs)
    smooth, _, _ = made(21, legs, road=0.0)
    even = covered(t, np.array([[90.0, 98.0 if stop else 114.0]]))[:, None]
    imu = replace(
        rough.imu,
        gyro=np.where(even, smooth.imu.gyro, rough.imu.gyro),
        accel=np.where(even, smooth.imu.accel, rough.imu.accel),
    )
    recording = replace(rough, imu=imu)
    found = detect(with_gnss(recording, t, v, (90.0, 130.0)))
    assert np.abs(v[covered(t, found.stationary)]).max() < 2e-3
    assert rates(found.stationary, base.find_spans(v == 0.0, t), t[0], t[-1])[0] > 0.85
    assert "detectors.speed_felt" in map(get_key, found.notes)


def test_an_odometer_late_quantised_or_unplugged_costs_no_stop():
    recording, t, v = made(16, [(20, 0), (8, 10), (30, 10), (6, 0), (25, 0), (6, 10), (20, 10)])
    alone = detect(recording).stationary
    at = np.arange(t[0], t[-1], 0.05)
    speed = 0.2 * np.floor(np.interp(at, t, v) / 0.2)
    for odometer in (
        Odometer(at, speed), Odometer(at + 0.7, speed), Odometer(at, np.zeros(len(at))), Odometer(at[:0], speed[:0]),
    ):  # fmt: skip
        np.testing.assert_allclose(detect(replace(recording, odometer=odometer)).stationary, alone, atol=0.25)


def test_what_wanders_as_much_as_it_says_is_no_motion():
    rng = np.random.default_rng(17)
    t = np.arange(0.0, 60.0, 0.2)
    lies = np.where(rng.random(len(t)) < 0.3, 5.0, 0.02)[:, None] * rng.standard_normal((len(t), 2))
    truth = np.tile([8.0, 1.0], (len(t), 1)) + 0.05 * rng.standard_normal((len(t), 2))
    limit = np.full(len(t), 0.15)
    span = np.array([10.0, 40.0])
    assert motion.Speeds(t, lies, limit).measure_speed(span) == 0.0
    assert abs(motion.Speeds(t, truth, limit).measure_speed(span) - np.hypot(8.0, 1.0)) < 0.05
    assert np.isnan(motion.Speeds(t, truth, limit).measure_speed(np.array([70.0, 80.0])))
    assert len(motion.find_moving([motion.Speeds(t, truth, limit)])) == 1


def test_a_gap_ends_a_stop():
    recording, _, _ = made(18, [(60, 0)])
    keep = (recording.imu.t < 20.0) | (recording.imu.t > 26.0)
    imu = replace(recording.imu, **{k: getattr(recording.imu, k)[keep] for k in ("t", "gyro", "accel")})
    found = detect(replace(recording, imu=imu)).stationary
    assert len(found) == 2
    assert found[0, 1] <= 20.0
    assert found[1, 0] >= 26.0


@pytest.mark.parametrize("rate", [1.0, 10.0, 20.0, 50.0, 104.3, 1000.0])
@pytest.mark.parametrize("rows", [2, 40, 400, 4000])
@pytest.mark.parametrize("what", ["noise", "zeros"])
def test_nothing_makes_it_fail(rate, rows, what):
    rng = np.random.default_rng(19)
    x = rng.standard_normal((rows, 6)) if what == "noise" else np.zeros((rows, 6))
    recording = Recording("odd", "vehicle", Imu(np.arange(1, rows + 1) / rate, x[:, 3:], x[:, :3]))
    found = detect(recording)
    if recording.duration < 3.0:
        assert len(found.stationary) == 0
        assert get_key(found.notes[0]) == "detectors.too_short"
    for d in found.all:
        assert len(d.t) == len(d.statistic) == len(d.mask)
        assert d.intervals.shape == (len(d.intervals), 2)
        assert (np.diff(d.intervals.ravel()) >= 0.0).all()


def test_settings_reach_the_answer():
    recording, _, _ = made(20, [(20, 0), (6, 9), (15, 9), (5, 0), (4, 0), (4, 6), (20, 6)])
    from graphnav.config import parse_settings

    everything = detect(recording).stationary
    assert len(everything) == 2
    longer = detect(recording, parse_settings({"detectors": {"fusion": {"min_duration": 10.0}}})).stationary
    np.testing.assert_array_equal(longer, everything[:1])
    margin = detect(recording, parse_settings({"detectors": {"fusion": {"margin": 0.4}}})).stationary
    np.testing.assert_allclose(margin[1] - everything[1], [0.3, -0.3], atol=1e-9)
    assert FusionSettings().margin == 0.1


# ---- real drives


@pytest.mark.parametrize("without", [(), ("odometer",), ("gnss",), ("gnss", "odometer")])
def test_tokyo_stops(shared_data, without):
    recording = load(str(shared_data / "tokyo_20201105"))
    stops = np.array(json.loads((shared_data / "tokyo_20201105" / "meta.json").read_text())["stops_s"])
    used = functools.reduce(lambda r, source: r.without(source), without, recording)
    found = detect(used)
    stops = np.minimum(stops, recording.end)
    t = np.arange(recording.start, recording.end, 0.02)
    still, called = covered(t, stops), covered(t, found.stationary)
    # the published ends are late by the odometer's delay, and two "stops" may not be any: Doppler 0.1 to 0.45 m/s
    assert called[still].mean() > 0.945
    assert still[called].mean() > 0.999
    ok = np.isfinite(recording.gnss.v[:, 0])
    doppler = np.hypot(recording.gnss.v[ok, 0], recording.gnss.v[ok, 1])[
        covered(recording.gnss.t[ok], found.stationary)
    ]
    assert np.quantile(doppler, 0.99) < 0.2


@pytest.mark.parametrize(
    ("name", "seconds"),
    [("boulder_drive_20250708", (60.0, 71.5)), ("comma_highway_20180802", (0.0, 0.0)), ("kitti", (0.0, 0.0))],
)
def test_no_false_stop_while_moving(shared_data, name, seconds):
    recording = load(name if name == "kitti" else str(shared_data / name))
    for used in (recording, replace(recording, gnss=None, odometer=None)):
        found = detect(used).stationary
        assert seconds[0] <= np.diff(found).sum() <= seconds[1]
        if len(found):
            v = recording.gnss.v[covered(recording.gnss.t, found)]
            assert np.hypot(v[:, 0], v[:, 1]).max() < 0.05


# ---- the command


def test_the_command_writes_what_it_promises(tmp_path, capsys):
    out = tmp_path / "out"
    recording, _, _ = made(21, [(30, 0), (6, 9), (15, 9), (5, 0), (24, 0)])
    write_folder(recording, tmp_path / "drive", ["made"])
    assert cli.run(["detect", str(tmp_path / "drive"), "-o", str(out), "--end", "75"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"\b12\.5", said)  # Hz, the idle line
    assert re.search(r"\b2 ", said)
    with (out / "detections.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["start", "end", "detector", "fired", "rows"]
    fused = np.array([[float(r["start"]), float(r["end"])] for r in rows if r["detector"] == "fused"])
    np.testing.assert_allclose(fused, [[0.0, 30.0], [56.0, 75.0]], atol=0.6)
    with gzip.open(out / "statistics.csv.gz", "rt") as file:
        table = list(csv.DictReader(file))
    assert {"t", "low_band_glrt", "glrt_threshold", "fft_stationary", "fused"} <= set(table[0])
    told = [(float(r["t"]), r["fused_stationary"] == "1") for r in table if r["fused_stationary"]]
    t, called = (np.array(column) for column in zip(*told, strict=True))
    assert len(t) > 700
    clear = np.abs(t[:, None] - fused.ravel()).min(axis=1) > 0.1  # the table's rows are the nearest windows
    np.testing.assert_array_equal(called[clear], covered(t, fused)[clear])
    assert "<figure" in (out / "detections.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "key", "name"),
    [
        (["detect", "nowhere", "-o", "out"], "file.missing", "nowhere"),
        (["detect", "kitti", "-o", "out", "--start", "9000"], "option.span_outside", "--start 9000"),
        (["detect", "kitti", "-o", "out", "--start", "50", "--end", "40"], "option.value", "--end 40"),
        (["detect", "kitti", "-o", "out", "--without", "odometer"], "withhold.none", "'odometer'"),
        (["detect", "kitti"], "", "-o"),
        (["detect", "kitti", "-o", "out", "--detectors", "fft,sway"], "option.unknown_name", "'sway'"),
        (["detect", "kitti", "-o", "out", "--detectors", "fft,fused"], "detectors.fused_alone", "fft,fused"),
        (["smooth", "kitti", "-o", "out", "--detectors", ","], "option.no_name", "--detectors"),
    ],
)
def test_bad_input_is_one_line(arguments, key, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert name in refuse_command(capsys, key, *arguments)
    assert not (tmp_path / "out").exists()


def test_an_unknown_setting_is_named(tmp_path, capsys):
    config = tmp_path / "settings.toml"
    config.write_text("[detectors.fft]\nwindows = 3.0\n")
    out = tmp_path / "out"
    assert "'window'" in refuse_command(capsys, "key.unknown", "detect", "kitti", "-o", out, "--config", config)


# ---- while the drive happens


@pytest.mark.parametrize("without", [(), ("gnss",), ("odometer",)])
def test_stops_are_those_of_detect_wherever_they_are_asked_for(shared_data, without):
    """Looks at half a minute of Tokyo; silent only where no stop is, or none that the last look did not know."""
    recording = load(str(shared_data / "tokyo_20201105"))
    recording = functools.reduce(lambda r, source: r.without(source), without, recording)
    settings = Settings()
    silent = some = 0
    for now in np.arange(95.0, 700.0, 7.0):
        look = recording.crop(now - 30.0, now)
        since, until = look.end - 25.0, look.end - 1.0
        whole = np.clip(detect(look, settings).stationary, since, until)
        whole = whole[whole[:, 1] > whole[:, 0]]
        found = find_stops(look, settings, since, until, base.NONE, since)
        if found is None:
            silent += 1
            assert not len(whole)
        else:
            some += len(found) > 0
            np.testing.assert_allclose(found, whole)
        newer = find_stops(look, settings, since, until, base.NONE, until - 2.0)
        if newer is None:
            assert not np.any(whole[:, 1] > until - 2.0)
    assert some > 20
    assert silent > 0 or "odometer" in without


def test_a_share_is_a_quantile():
    rng = np.random.default_rng(4)
    for shape in ((7,), (100, 3), (1, 2)):
        x = rng.standard_normal(shape)
        for share in (0.0, 0.3, 0.5, 0.95, 1.0):
            np.testing.assert_allclose(windows.compute_share(x, share), np.quantile(x, share, axis=0), atol=1e-14)
