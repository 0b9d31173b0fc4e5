"""The antenna is found where it is, whatever the recording says of it, and so is the rate of the clocks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import oracle
import pytest
from helpers import refused

from graphnav import run
from graphnav.config import parse_settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET
from graphnav.constraints.odometer import ODOMETER_DELAY
from graphnav.core import beside
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.notes import get_key
from graphnav.estimation import joint_estimate
from graphnav.estimation.antenna import find_antenna
from graphnav.estimation.contradictions import compute_evidence_gain, free, widen
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.solvers.ekf import refilter
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.passes import reuse_points

ARM = np.array([0.3, -0.5, 1.2])


@pytest.fixture(scope="module")
def drive():
    """Three minutes with turns, of another simulator, fixes of 2 cm."""
    recording, _ = oracle.drive(oracle.vehicle_path(180.0, 50.0), seed=5, lever_arm=tuple(ARM))
    return recording


@pytest.fixture(scope="module")
def right(drive):
    """What every solver makes of it; nothing changes a solution."""
    return run(drive)


@pytest.mark.parametrize("stated", [ARM, -ARM, np.zeros(3)], ids=["right", "signs", "none"])
def test_the_antenna_is_found(drive, stated):
    found = find_antenna(replace(drive, gnss=replace(drive.gnss, lever_arm=stated)))
    assert (np.abs(found.found - ARM) < 4.0 * found.sigma).all()
    assert np.abs(found.found - ARM)[:2] == pytest.approx(0.0, abs=0.06)
    assert found.agrees is (stated is ARM)
    assert found.finding.severity == ("note" if stated is ARM else "warning")


def test_without_fixes_there_is_none_to_find(drive):
    with refused("antenna.no_gnss", EstimationError):
        find_antenna(drive.without("gnss"))


def state_arm(recording, off):
    """The recording with an arm stated that is off."""
    return replace(recording, gnss=replace(recording.gnss, lever_arm=recording.gnss.lever_arm + off))


@pytest.fixture(scope="module")
def solved(drive):
    """Recordings that contradict what they state, and what the smoother and the filter make of them."""
    recordings = {
        "arm": state_arm(drive, np.array([0.5, 0.0, 0.0])),
        "clocks": stretch_stamps(drive, 2e-4),
        "stamps": replace(drive, gnss=replace(drive.gnss, t=drive.gnss.t + 0.12)).crop(0.0, drive.duration),
    }
    return cache(lambda name: (recordings[name], run(recordings[name])))


@pytest.mark.parametrize("off", [(0.5, 0.0, 0.0), (-0.3, 0.8, 0.5)])
def test_a_drive_with_a_wrong_arm_is_solved_as_with_the_right_one(drive, right, solved, off):
    wrong = solved("arm")[1] if off == (0.5, 0.0, 0.0) else run(state_arm(drive, np.array(off)))
    stated = run(state_arm(drive, np.array(off)), noise="stated")
    for name in ("ekf", "rts", "batch"):
        assert not right[name].noise.freed
        apart, before = (
            np.linalg.norm((x[name].states.p - right[name].states.p)[:, :2], axis=1) for x in (wrong, stated)
        )
        assert np.sqrt(np.mean(before**2)) > 0.3
        assert np.sqrt(np.mean(apart**2)) < 0.05
        one = wrong[name].parameters[LEVER_ARM]
        freed = np.array(wrong[name].noise.freed[LEVER_ARM].sigma) > 0.002
        assert (np.abs(one.value[-1] - ARM)[freed] < 4.0 * one.sigma[-1][freed]).all()
        assert "gnss.lever_arm_used" in map(get_key, wrong[name].notes)
        assert not stated[name].noise.freed


@pytest.mark.parametrize("wrong", ["arm", ""])
def test_a_second_process_changes_no_solution(drive, right, solved, monkeypatch, wrong):
    """It filters with all constants as stated, before these are tested."""
    recording, alone = solved(wrong) if wrong else (drive, right)
    monkeypatch.setattr(beside, "_allowed", True)
    together = run(recording, solvers=("ekf", "rts"))
    for name in ("ekf", "rts"):
        np.testing.assert_array_equal(together[name].states.p, alone[name].states.p)
        np.testing.assert_array_equal(together[name].covariance, alone[name].covariance)


def stretch_stamps(recording, rate):
    """The recording with a receiver whose clock gains on the IMU's."""
    return replace(recording, gnss=replace(recording.gnss, t=recording.gnss.t + rate * recording.gnss.t))


def interpolate_path(solution, begin=5.0, end=175.0):
    """(N, 3) m, every tenth of a second from the drive's `begin` to its `end` (s)."""
    found = solution.trajectory(rate=50.0)
    p = LocalFrame(np.array([0.0, 0.0, 0.0])).from_llh(found.llh)
    return np.stack([np.interp(np.arange(begin, end, 0.1), found.t - found.t[0], x) for x in p.T], axis=-1)


@pytest.mark.parametrize("rate", [2e-4, -1e-3])
def test_clocks_that_drift_apart_are_solved_as_one_clock(drive, right, solved, rate):
    apart = solved("clocks")[1] if rate == 2e-4 else run(stretch_stamps(drive, rate), solvers=("ekf", "rts"))
    stated = run(stretch_stamps(drive, rate), parse_settings({"gnss": {"clock_rate_sigma": 0.0}}), ("rts",))["rts"]
    for name in ("ekf", "rts"):
        freed = apart[name].noise.freed[CLOCK_RATE]
        assert freed.value[0] == pytest.approx(-rate, abs=4.0 * freed.sigma[0])
        path, true = (interpolate_path(x[name]) for x in (apart, right))
        assert np.sqrt(np.mean((path - true) ** 2)) < 0.02
        assert "gnss.clock_rate_used" in map(get_key, apart[name].notes)
    assert not right["rts"].noise.freed
    assert CLOCK_RATE not in stated.noise.freed


def test_late_stamps_spoil_neither_the_start_nor_another_constant():
    whole, _ = oracle.drive(oracle.vehicle_path(180.0, 50.0), seed=6, lever_arm=tuple(ARM))
    moving = whole.crop(60.0, 180.0)
    right = run(moving, solvers=("ekf", "rts"))
    late = run(replace(moving, gnss=replace(moving.gnss, t=moving.gnss.t + 0.28)), solvers=("ekf",))["ekf"]
    assert list(late.noise.freed) == [TIME_OFFSET]
    assert late.noise.freed[TIME_OFFSET].value[0] == pytest.approx(-0.28, abs=0.005)
    true, clean, path = (interpolate_path(one, 2.0, 30.0) for one in (right["rts"], right["ekf"], late))
    assert np.sqrt(np.mean((path - true) ** 2)) < 1.1 * np.sqrt(np.mean((clean - true) ** 2))


@pytest.mark.parametrize("wrong", ["arm", "clocks", "stamps"])
def test_what_was_freed_is_in_the_noise_model_of_the_run(solved, tmp_path, wrong):
    recording, solutions = solved(wrong)
    found = solutions["rts"]
    noise = read_noise(write_noise(tmp_path / "noise.json", found.noise))
    assert noise.freed == found.noise.freed
    again = run(recording, solvers=("rts",), noise=noise)["rts"]
    assert (again.states.p == found.states.p).all()


def test_an_arm_whose_prior_is_stated_is_estimated_by_it(drive):
    settings = parse_settings({"gnss": {"lever_arm_sigma": 0.01}})
    found = run(state_arm(drive, np.array([0.5, 0.0, 0.0])), settings, ("rts",))["rts"]
    assert LEVER_ARM not in found.noise.freed
    assert found.parameters[LEVER_ARM].prior_sigma == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("name", "off", "rate", "late"),
    [
        (LEVER_ARM, 0.0, 0.0, 0.0),
        (LEVER_ARM, 0.4, 0.0, 0.0),
        (CLOCK_RATE, 0.0, 5e-4, 0.0),
        (TIME_OFFSET, 0.0, 0.0, 0.0),
        (TIME_OFFSET, 0.0, 0.0, 0.1),
    ],
)
def test_evidence_of_what_is_freed_is_that_of_the_innovations(drive, monkeypatch, name, off, rate, late):
    """The closed form against filters of all keyframes, with one prior of the constants and with the other."""
    asked = []
    monkeypatch.setattr(joint_estimate, "find_contradicted_constants", lambda *given: asked.append(given) or {})
    damaged = stretch_stamps(state_arm(drive.crop(0.0, 90.0), np.array([0.3, -off, 0.0]) if off else 0.0), rate)
    run(replace(damaged, gnss=replace(damaged.gnss, t=damaged.gnss.t + late)), solvers=("ekf",))
    base, best, _, _ = asked[-1]
    problem, about = apply_noise(base, best.noise), best.points
    wide = widen(problem, {name})
    freed = free(problem, wide)
    one, other = refilter(problem, about), refilter(freed, reuse_points(about, problem, freed))
    at, prior = freed.columns[name], np.array(wide[name].sigma)
    change, known = other.values[-1, shift(at)] - wide[name].value, np.zeros(len(prior))
    if name in problem.parameters:
        known = problem.parameters[name].sigma
    gain = other.log_likelihood.sum() - one.log_likelihood.sum()
    found = compute_evidence_gain(change, other.P[-1, at, at], prior, prior, known)
    assert found == pytest.approx(gain, abs=0.02 + 0.002 * abs(gain))
    if name != TIME_OFFSET:  # its prior is as wide as the noise model has it
        assert (gain > 0.0) == bool(off or rate)


@pytest.mark.parametrize("late", [0.12, -0.2])
def test_late_stamps_are_known_to_the_filter(drive, right, solved, late):
    wrong = replace(drive, gnss=replace(drive.gnss, t=drive.gnss.t + late)).crop(0.0, drive.duration)
    found = (solved("stamps")[1] if late == 0.12 else run(wrong, solvers=("ekf",)))["ekf"]
    freed = found.noise.freed[TIME_OFFSET]
    assert freed.value[0] == pytest.approx(-late, abs=4.0 * freed.sigma[0])
    assert not right["ekf"].noise.freed
    assert "gnss.time_offset_used" in map(get_key, found.notes)
    assert np.sqrt(np.mean((interpolate_path(found) - interpolate_path(right["ekf"]))[100:] ** 2)) < 0.1 * 10.0 * abs(
        late
    )


@pytest.fixture(scope="module")
def wheels():
    """A drive with wheels and without fixes for a minute, and what solvers make of it."""
    made, _ = oracle.drive(oracle.vehicle_path(180.0, 50.0), seed=5, lever_arm=tuple(ARM), odometer_rate=20.0)
    dark = made.without("gnss", (80.0, 140.0))
    return dark, run(dark, solvers=("ekf", "rts"))


@pytest.mark.parametrize("late", [-0.1, 0.2, 0.6])
def test_an_odometer_whose_readings_are_late_is_read_earlier(wheels, late):
    """As accurate without fixes for a minute as if its readings were on time."""
    recording, right = wheels
    delayed = replace(recording, odometer=replace(recording.odometer, t=recording.odometer.t + late))
    found, stated = (run(delayed, solvers=("ekf", "rts"), noise=noise) for noise in (None, "stated"))
    freed = found["rts"].noise.freed
    assert set(freed) == {ODOMETER_DELAY}
    assert not right["rts"].noise.freed
    assert freed[ODOMETER_DELAY].value[0] == pytest.approx(late, abs=min(4.0 * freed[ODOMETER_DELAY].sigma[0], 0.02))
    assert "odometer.delay_used" in map(get_key, found["rts"].notes)
    for name in ("ekf", "rts"):
        apart, before = (
            np.max(np.linalg.norm(x[name].states.p - right[name].states.p, axis=1)) for x in (found, stated)
        )
        assert apart < 0.2 * before


def test_an_arm_that_is_wrong_in_one_number_is_not_trusted_in_the_others(drive, right):
    """Hardly observable ones have an honest sigma, and the position with them."""
    wrong = state_arm(drive, np.array([0.5, 0.0, 0.3]))
    found = run(wrong, solvers=("rts",))["rts"]
    arm = found.parameters[LEVER_ARM]
    assert (arm.sigma[-1] > 0.001).all()
    assert (np.abs(arm.value[-1] - ARM) < 4.0 * arm.sigma[-1]).all()
    up = np.abs(found.states.p[:, 2] - right["rts"].states.p[:, 2])
    assert (up < 4.0 * np.sqrt(found.covariance[:, 5, 5])).all()
    late = run(replace(wrong, gnss=replace(wrong.gnss, t=wrong.gnss.t + 0.1)), solvers=("rts",))["rts"]
    assert set(late.noise.freed) == {LEVER_ARM, TIME_OFFSET}


def test_constants_are_not_tested_again_with_the_model_they_were_tested_with(drive, monkeypatch):
    asked, find = [], joint_estimate.find_contradicted_constants

    def count(base, best, freed, names):
        asked.append(best.noise)
        return find(base, best, freed, names)

    monkeypatch.setattr(joint_estimate, "find_contradicted_constants", count)
    run(drive.crop(0.0, 90.0), solvers="ekf")
    assert len(asked) == len({id(noise) for noise in asked}) > 0
