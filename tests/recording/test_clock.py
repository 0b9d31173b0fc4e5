"""How far the clocks of an IMU and its fixes are apart: the stated error is kept to, and everybody says the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphnav.core.earth import LocalFrame
from graphnav.recording.checks import crosschecks, lags, tracks
from graphnav.recording.checks.clock import measure_clock_offsets
from graphnav.recording.draft.agreement import compare_with_fixes
from graphnav.recording.formats import read

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "tokyo"


def lasting(rng: np.random.Generator, n: int, steps: float) -> np.ndarray:
    """White noise that was smoothed, of variance one."""
    kernel = np.exp(-0.5 * (np.arange(-4 * steps, 4 * steps + 1) / steps) ** 2)
    x = np.convolve(rng.normal(size=n + len(kernel)), kernel, "same")[:n]
    return x / x.std()


@pytest.mark.parametrize("misfit_lasts", [1.0, 5.0, 15.0])  # rows of 0.2 s
def test_the_error_of_a_lag_is_as_large_as_stated(misfit_lasts: float) -> None:
    n, step, late = 600, 0.2, 0.13
    t = step * np.arange(n)
    off, sigma = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        moved = np.linspace(-10.0, t[-1] + 10.0, 2800)
        x = lasting(rng, len(moved), 16.0)
        y = np.interp(t + late, moved, x) + 0.7 * lasting(rng, n, misfit_lasts)

        def x_at(rows: np.ndarray, lag: lags.Lags, moved: np.ndarray = moved, x: np.ndarray = x) -> np.ndarray:
            return np.interp(np.add.outer(lag, t[rows]), moved, x)[..., None]

        lag, spread = lags.refine_lag(t, y, x_at, lambda lag: np.ones(n, dtype=bool), np.arange(n), 0.0, 20)
        off.append(lag - late)
        sigma.append(spread)
    z = np.array(off) / np.array(sigma)
    assert 0.4 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(z).max() < 4.5


def test_nothing_is_known_of_a_lag_where_nothing_changes() -> None:
    t = 0.2 * np.arange(300)
    y = np.random.default_rng(1).normal(size=300)

    def x_at(rows: np.ndarray, lag: lags.Lags) -> np.ndarray:
        return np.add.outer(lag, t[rows])[..., None] * 1e-3

    _, sigma = lags.refine_lag(t, y, x_at, lambda lag: np.ones(300, dtype=bool), np.arange(300), 0.0, 20)
    assert sigma > 1.0


def test_fixes_that_jump_turn_no_axis_and_no_clock() -> None:
    """One in ten off by up to 200 m: their speeds are alike from one second to the next, and say nothing."""
    drive = read(SHIPPED)
    gnss = drive.gnss
    assert gnss is not None
    rng = np.random.default_rng(4)
    wrong = rng.choice(len(gnss.t), len(gnss.t) // 10, replace=False)
    frame = LocalFrame(gnss.llh[0])
    p = frame.from_llh(gnss.llh)
    p[wrong] += rng.uniform(5.0, 200.0, (len(wrong), 1)) * [0.6, 0.8, 0.0]
    plain = replace(gnss, v=None, sd_v=None)
    fits = []
    for some in (plain, replace(plain, llh=frame.to_llh(p))):
        track = tracks.compute_track(some)
        assert track is not None
        fit = crosschecks.fit_forward(drive.imu, track)
        assert fit is not None
        fits.append(fit)
    clean, dirty = fits
    assert dirty.correlation > 0.95 * clean.correlation
    assert abs(dirty.lag - clean.lag) < 0.1
    np.testing.assert_allclose(dirty.coefficients, clean.coefficients, atol=0.05)


@pytest.mark.parametrize("name", ["oracle_drive", "tokyo_20201105"])  # stamps right to 0.02 s, as their READMEs say
def test_parts_of_a_drive_keep_to_the_error(shared_data: Path, name: str) -> None:
    drive = read(shared_data / name)
    z = []
    for a in np.arange(0.0, min(drive.duration, 900.0) - 60.0, 60.0):
        part = drive.crop(a, a + 60.0)
        assert part.gnss is not None
        track = tracks.compute_track(part.gnss)
        fit = None if track is None else crosschecks.fit_forward(part.imu, track)
        if fit is not None and fit.correlation > 0.6:
            z.append(max(abs(fit.lag) - 0.02, 0.0) / fit.spread)
    assert len(z) >= 6
    assert max(z) < 4.0
    assert np.sqrt(np.mean(np.square(z))) < 1.5


@pytest.mark.parametrize(
    ("name", "shift"),
    [
        ("boulder_drive_20250708", -0.6),
        ("boulder_drive_20250708", 0.0),
        ("dresden_car_20140326", 0.6),
        ("oracle_drive", 0.0),
        ("oracle_drive", 0.6),
    ],
)
def test_a_draft_and_the_checks_say_the_same(shared_data: Path, name: str, shift: float) -> None:
    drive = read(shared_data / name).crop(0.0, 300.0)
    imu, gnss = replace(drive.imu, t=drive.imu.t + shift), drive.gnss
    assert gnss is not None
    up = crosschecks.find_up(imu)
    drafted = compare_with_fixes(
        imu.t, imu.gyro, imu.accel, up, (gnss.t, gnss.llh, None if gnss.v is None else gnss.v[:, :2])
    )
    said = measure_clock_offsets(imu, gnss).late
    assert (drafted.offset is None) == (said is None)
    if drafted.offset is not None and said is not None:
        assert drafted.offset[0] == pytest.approx(said.lag, abs=1e-6)
        # what is then left is no longer complained of
        assert measure_clock_offsets(imu, replace(gnss, t=gnss.t + drafted.offset[0])).late is None
    # of dresden, whose receiver wanders, it is not sure
    assert (said is not None) == (shift != 0.0) or name.startswith("dresden")
