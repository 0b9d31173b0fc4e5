"""Fixes on another clock than the IMU: solved about stamps moved to where their offsets are estimated."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from graphnav import load, run
from graphnav.app.workflow import GivenNoise, Request, run_request
from graphnav.config import parse_settings
from graphnav.constraints.antenna_motion import LEVER_ARM, LINEAR_OFFSET
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array
from graphnav.estimation import stamps
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.noise.model import StampOffsets
from graphnav.estimation.offsets import move_stamps
from graphnav.estimation.solution import Solution
from graphnav.estimation.stamps import shift_to_imu_clock, shift_to_own_clocks
from graphnav.recording import Gnss, Recording, take_rows

TOKYO = Path(__file__).resolve().parents[2] / "data" / "tokyo"
LATE = 3.0  # s, as a receiver whose fixes are stamped that much later
END = 80.0  # s
# of the receiver's clock beside the IMU's: none, that of a poor crystal, and of a resonator, 0.4 s off in the end
RATES = {"none": 0.0, "crystal": 3e-4, "resonator": 5e-3}


@cache
def drive() -> Recording:
    return load(TOKYO).crop(0.0, END)


def delay_positions(gnss: Gnss, seconds: float) -> Gnss:
    """Positions of some time ago at the stamps that there are, velocities as they are."""
    frame = LocalFrame(gnss.llh[0])
    p = frame.from_llh(gnss.llh)
    held = np.stack([np.interp(gnss.t - seconds, gnss.t, x) for x in p.T], axis=-1)
    return replace(gnss, llh=frame.to_llh(held), rounding=(0.0, 0.0, 0.0))


@cache
def solved(case: str) -> Solution:
    settings = parse_settings({"gnss": {"clock_rate_sigma": 1e-4 if case in RATES else 0.0}})
    return run(late(case), settings, solvers=("rts",))["rts"]


def late(case: str) -> Recording:
    recording = drive()
    gnss = recording.gnss
    assert gnss is not None
    if case in RATES:
        drift = RATES[case] * (gnss.t - recording.start)
        return replace(recording, gnss=replace(gnss, t=gnss.t + drift)).crop(0.0, END)
    if case == "both":
        return replace(recording, gnss=replace(gnss, t=gnss.t + LATE))
    return replace(recording, gnss=delay_positions(gnss, LATE)) if case == "positions" else recording


def find_antenna_path(solution: Solution) -> Array:
    """(K, 3) m: that of the IMU hangs on a lever arm of which the height is hardly observed."""
    gnss = drive().gnss
    assert gnss is not None
    arm = solution.parameters[LEVER_ARM].value[-1] if LEVER_ARM in solution.parameters else gnss.lever_arm
    return solution.states.p + solution.states.R_nb @ arm


def distances(case: str) -> Array:
    """(K,) m between the antenna's path of a case and that of the fixes as they are, at the latter's keyframes."""
    one, other = solved(case), solved("as it is")
    p = np.stack([np.interp(other.t, one.t, x) for x in find_antenna_path(one).T], axis=-1)
    frame = LocalFrame(one.frame.to_llh(np.zeros((1, 3)))[0])
    return np.linalg.norm(p - frame.from_llh(other.frame.to_llh(find_antenna_path(other))), axis=1)


@pytest.mark.parametrize(("case", "of_velocities"), [("both", -LATE), ("positions", 0.0)])
def test_fixes_of_another_clock_lead_to_the_same_path(case: str, of_velocities: float) -> None:
    found = solved(case)
    known = solved("as it is").parameters
    for name, offset in (("gnss_time_offset", -LATE), ("gnss_velocity_time_offset", of_velocities)):
        whole = found.parameters[name].value[0, 0] - known[name].value[0, 0]
        assert whole == pytest.approx(offset, abs=4.0 * (found.parameters[name].sigma[0, 0] + 0.005)), name
    assert np.sqrt(np.mean(distances(case)[20:-20] ** 2)) < 0.05  # 5 to 7 m where the stamps stay as they are
    assert "gnss.stamps_moved" in map(get_key, found.notes)


@pytest.mark.parametrize("case", RATES)
def test_clocks_that_drift_apart_lead_to_the_same_path(case: str) -> None:
    found, known = (solved(name).parameters["gnss_clock_rate"] for name in (case, "none"))
    off = found.value[0, 0] - known.value[0, 0] + RATES[case] / (1.0 + RATES[case])
    assert off == pytest.approx(0.0, abs=4.0 * found.sigma[0, 0])
    assert np.sqrt(np.mean(distances(case)[20:-20] ** 2)) < 0.05
    assert (solved(case).noise.stamps.rate != 0.0) == (case == "resonator")


def test_a_clock_that_was_set_meanwhile_is_no_drift() -> None:
    recording = drive()
    gnss = recording.gnss
    assert gnss is not None
    later = replace(recording, gnss=replace(gnss, t=gnss.t + (gnss.t > recording.start + 0.3 * END))).crop(0.0, END)
    assert "doubt.clocks" in map(get_key, run(later, solvers=("ekf",))["ekf"].notes)
    assert "doubt.clocks" not in map(get_key, solved("resonator").notes)


def test_an_offset_is_no_smaller_for_vibration(shared_data: Path) -> None:
    """On boulder, where the force of single samples is noisy and the velocities are good to 5 cm/s. With the force of a
    tenth of a second for the acceleration, an offset of velocities is estimated a sixth too small.
    """
    recording = load(shared_data / "boulder_drive_20250708").crop(275.0, 441.0)
    gnss, by = recording.gnss, 0.1
    assert gnss is not None
    settings = parse_settings({"noise": {"mode": "stated"}, "gnss": {"time_offset_sigma": 1.0}})
    later = replace(recording, gnss=replace(gnss, t=gnss.t + by))
    found, known = (run(one, settings, solvers=("rts",))["rts"].parameters for one in (later, recording))
    for name in ("gnss_time_offset", "gnss_velocity_time_offset"):
        off = found[name].value[0, 0] - known[name].value[0, 0] + by
        assert abs(off) < 4.0 * found[name].sigma[0, 0], name


def test_stops_do_not_say_how_late_fixes_are(shared_data: Path) -> None:
    """Rows of stops are at keyframes, and these elsewhere with other stamps: their evidence is not that of stamps."""
    recording, rng, by = (
        load(shared_data / "oracle_drive").crop(37.0, 337.0).without("odometer"),
        np.random.default_rng(5),
        0.4,
    )
    gnss, imu = recording.gnss, recording.imu
    assert gnss is not None
    fixes = np.isin(np.arange(len(gnss.t)), np.unique(np.floor(gnss.t), return_index=True)[1])
    jitter = rng.uniform(-0.025, 0.025, len(gnss.t))
    later = take_rows(replace(gnss, t=gnss.t + by + jitter, v=None, sd_v=None), fixes)
    noisy = replace(
        imu,
        gyro=imu.gyro + rng.normal(0.0, 2e-3, imu.gyro.shape),
        accel=imu.accel + rng.normal(0.0, 0.03, imu.accel.shape),
    )
    found = run(replace(recording, gnss=later, imu=noisy), solvers=("ekf",))["ekf"]
    assert abs(found.noise.stamps.positions + by) < LINEAR_OFFSET
    offset = found.parameters["gnss_time_offset"]
    assert abs(offset.value[-1, 0] + by) < 4.0 * offset.sigma[-1, 0]


def test_right_stamps_are_left() -> None:
    assert solved("as it is").noise.stamps == StampOffsets()
    stated = run(late("both"), solvers=("ekf",), noise="stated")["ekf"]
    assert stated.noise.stamps == StampOffsets()


@pytest.mark.parametrize("guess", [-0.6, 1.5])
def test_a_wrong_guess_changes_nothing(guess: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stamps, "_guess_offsets", lambda clock: StampOffsets(guess, guess))
    settings = parse_settings({"gnss": {"clock_rate_sigma": 0.0}})
    found = run(late("as it is"), settings, solvers=("rts",))["rts"]
    assert (found.states.p == solved("as it is").states.p).all()


def test_what_is_said_of_fixes_is_on_their_own_clock() -> None:
    found, recording = solved("both"), late("both")
    assert recording.gnss is not None
    for name in ("gnss_position", "gnss_velocity"):
        t = found.records[name].t
        assert np.abs(t[:, None] - recording.gnss.t).min(axis=1).max() < 1e-6
        weights = found.noise.weights[name]
        assert np.abs(weights.t[:, None] - t).min(axis=1).max() < 1e-6


def test_the_noise_model_of_a_run_gives_the_same_bytes(tmp_path: Path) -> None:
    found = solved("both")
    assert found.noise.stamps.positions == pytest.approx(-LATE, abs=0.1)
    again = run(late("both"), solvers=("rts",), noise=read_noise(write_noise(tmp_path / "noise.json", found.noise)))
    assert (again["rts"].states.p == found.states.p).all()
    assert (again["rts"].parameters["gnss_time_offset"].value == found.parameters["gnss_time_offset"].value).all()


def test_moved_and_back() -> None:
    found, offsets = solved("as it is"), StampOffsets(-0.75, 0.25, 0.5, 1e-3, drive().start)
    moved = shift_to_own_clocks(found, offsets)
    assert moved.noise.stamps == offsets
    for name, by in (("gnss_position", -0.75), ("gnss_velocity", 0.25)):
        t = moved.records[name].t
        assert found.records[name].t == pytest.approx(t + by + 1e-3 * (t - drive().start))
        assert shift_to_imu_clock(moved.noise).weights[name].t == pytest.approx(found.noise.weights[name].t)
    recording = drive()
    changed = move_stamps(recording, offsets)
    assert changed.gnss is not None
    assert recording.gnss is not None
    drift = 1e-3 * (recording.gnss.t - recording.start)
    assert changed.gnss.t == pytest.approx(recording.gnss.t + drift - 0.75)
    assert changed.gnss.velocity_t == pytest.approx(recording.gnss.t + drift + 0.25)
    assert changed.odometer is not None
    assert recording.odometer is not None
    assert changed.odometer.t == pytest.approx(recording.odometer.t + 0.5)


def test_a_result_about_moved_stamps_is_not_unreliable(tmp_path: Path) -> None:
    shutil.copytree(TOKYO, tmp_path / "late")
    table = tmp_path / "late" / "recording.toml"
    table.write_text(table.read_text().replace("[gnss]\n", f"[gnss]\ntime_offset = {LATE}\n"))
    estimated = GivenNoise(solved("both").noise, tmp_path / "noise.json")
    for noise, severity in ((None, "unreliable"), (estimated, "warning")):
        request = Request(str(table), ("ekf",), parse_settings({"noise": {"mode": "stated"}}), end=END, noise=noise)
        outcome = run_request(request)
        assert [f.severity for f in outcome.checks if f.key == "imu.clock"] == [severity]
