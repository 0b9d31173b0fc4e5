"""Allan variance: against allantools, against noise of known figures, and what is refused."""

from __future__ import annotations

import json

import allantools
import numpy as np
import pytest
from helpers import refuse_command, refused

from graphnav.app import cli
from graphnav.core.errors import RecordingError
from graphnav.recording import allan

RATE = 50.0


def at_rest(seconds, N=(2e-4, 3e-3), K=(0.0, 0.0), seed=0):
    """An IMU at rest with white noise N and walks K of gyro and accelerometer."""
    rng = np.random.default_rng(seed)
    n = round(seconds * RATE)
    t = np.arange(1, n + 1) / RATE
    sensors = []
    for white, walk in zip(N, K, strict=True):
        x = rng.normal(0.0, white * np.sqrt(RATE), (n, 3)) + np.cumsum(rng.normal(0.0, walk / np.sqrt(RATE), (n, 3)), 0)
        sensors.append(x)
    return t, sensors[0] + [1e-3, -2e-3, 5e-4], sensors[1] + [0.1, 0.05, 9.8]


def test_deviations_are_those_of_allantools():
    t, gyro, accel = at_rest(400.0, K=(1e-5, 1e-4))
    found = allan.compute_allan(t, gyro, accel)
    m = allan.list_averaging(len(t))
    for axis in range(3):
        for mine, samples in ((found.gyro, gyro), (found.accel, accel)):
            tau, theirs, _, _ = allantools.oadev(samples[:, axis], RATE, "freq", m / RATE)
            assert tau == pytest.approx(found.tau, rel=1e-12)
            assert mine[:, axis] == pytest.approx(theirs, rel=1e-9)


def test_white_noise_and_walk_are_recovered():
    N, K = (2e-4, 3e-3), (2e-5, 2e-4)
    found = allan.compute_allan(*at_rest(7200.0, N, K, seed=1))
    for noise, white, walk in zip((found.gyro_noise, found.accel_noise), N, K, strict=True):
        assert noise.white == pytest.approx(np.full(3, white), rel=0.03)
        assert noise.walk == pytest.approx(np.full(3, walk), rel=0.35)
        # where N^2/tau and K^2 tau/3 are equal
        assert np.median(noise.floor) == pytest.approx(np.sqrt(3) * white / walk, rel=0.8)


def test_flicker_noise_is_seen_as_bias_instability():
    n, B = 1 << 18, 5e-5
    rng = np.random.default_rng(7)
    f = np.fft.rfftfreq(n, 1 / RATE)
    # IEEE Std 952, C.1.3: B^2 / (2 pi f) for each sign of f
    density = np.concatenate([[0.0], B**2 / (np.pi * f[1:])])
    drawn = (rng.normal(size=(len(f), 3)) + 1j * rng.normal(size=(len(f), 3))) / np.sqrt(2)
    gyro = np.fft.irfft(drawn * np.sqrt(density * RATE * n / 2.0)[:, None], n, axis=0)
    found = allan.compute_allan(np.arange(1, n + 1) / RATE, gyro, at_rest(n / RATE)[2][:n])
    middle = found.gyro[(found.tau > 1.0) & (found.tau < 100.0)]
    assert np.sqrt(np.mean(middle**2)) == pytest.approx(B * np.sqrt(2 * np.log(2) / np.pi), rel=0.05)
    assert found.gyro_noise.instability == pytest.approx(np.full(3, B), rel=0.2)


def test_lines_can_be_pasted(tmp_path, capsys):
    t, gyro, accel = at_rest(300.0)
    np.savetxt(
        tmp_path / "rest.csv", np.column_stack([t, gyro, accel]), "%.9g", ",", header="t,gx,gy,gz,ax,ay,az", comments=""
    )
    assert cli.run(["allan", str(tmp_path / "rest.csv"), "-o", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "[imu.noise]" in shown
    text = (tmp_path / "out" / "noise.toml").read_text()
    head, *rows = (tmp_path / "out" / "allan.csv").read_text().splitlines()
    assert head == "tau,gx,gy,gz,ax,ay,az"
    assert len(rows) == len(allan.list_averaging(len(t)))
    (tmp_path / "recording.toml").write_text(
        'format = "graphnav-recording/1"\nplatform = "vehicle"\n[imu]\nfile = "rest.csv"\n' + text
    )
    from graphnav.recording.formats import read

    noise = read(tmp_path).imu.noise
    assert noise.gyro_noise_density == pytest.approx(2e-4, rel=0.05)
    assert noise.accel_noise_density == pytest.approx(3e-3, rel=0.05)
    # white noise alone: the floor of the deviation bounds the walk
    assert 0 < noise.gyro_bias_walk < 2e-5


def test_what_is_not_at_rest_or_too_short_is_refused(tmp_path, capsys):
    t, gyro, accel = at_rest(100.0)
    accel[3000:3500, 1] += 0.5
    with refused("allan.moves", RecordingError, "60 s"):
        allan.compute_allan(t, gyro, accel)
    with refused("allan.short", RecordingError, "50 s"):
        allan.compute_allan(t[:2500], gyro[:2500], accel[:2500])
    t[2000:] += 0.5
    with refused("allan.gaps", RecordingError, "0.520 s", "40.0 s"):
        allan.compute_allan(t[:3000], gyro[:3000], accel[:3000])
    assert "kitti" in refuse_command(capsys, "allan.gaps", "allan", "kitti", "-o", tmp_path)


def test_the_units_that_were_taken_are_told(tmp_path, capsys):
    """Of a log at rest nothing shows the gyro's: the name of its columns does, or it is a guess."""
    t, gyro, accel = at_rest(300.0)
    rows = np.column_stack([t, np.degrees(0.1 * gyro), accel])  # a quiet one
    for k, unit in enumerate(("", "_deg_s")):
        names = [f"gyro_{x}{unit}" for x in "xyz"] + [f"acc_{x}" for x in "xyz"]
        np.savetxt(tmp_path / "rest.csv", rows, "%.9g", ",", header=",".join(["t", *names]), comments="")
        assert cli.run(["allan", str(tmp_path / "rest.csv"), "-o", str(tmp_path / f"out{k}"), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert [one.partition(":")[0] for one in found["units"]] == [
            f"gyro in {'deg' if k else 'rad'}/s",
            "accel in m/s2",
        ]
        assert found["noise"]["gyro_noise_density"] == pytest.approx(2e-5 * (1.0 if k else np.degrees(1.0)), rel=0.05)
