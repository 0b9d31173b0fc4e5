"""The antenna is found where it is, whatever the recording says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import refused

from graphnav import run
from graphnav.config import parse_settings
from graphnav.constraints.gnss import LEVER_ARM
from graphnav.core.errors import EstimationError
from graphnav.core.notes import get_key
from graphnav.estimation import preparation
from graphnav.estimation.antenna import find_antenna
from graphnav.estimation.lever_arm import ARM_SIGMA, compute_evidence_gain, free_arm, get_stated_arm
from graphnav.estimation.noise.files import read_noise, write_noise
from graphnav.estimation.noise.model import LeverArm
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


@pytest.mark.parametrize("off", [(0.5, 0.0, 0.0), (-0.3, 0.8, 0.5)])
def test_a_drive_with_a_wrong_arm_is_solved_as_with_the_right_one(drive, right, off):
    wrong = run(state_arm(drive, np.array(off)))
    stated = run(state_arm(drive, np.array(off)), noise="stated")
    for name in ("ekf", "rts", "batch"):
        assert right[name].noise.lever_arm is None
        apart, before = (
            np.linalg.norm((x[name].states.p - right[name].states.p)[:, :2], axis=1) for x in (wrong, stated)
        )
        assert np.sqrt(np.mean(before**2)) > 0.3
        assert np.sqrt(np.mean(apart**2)) < 0.05
        one = wrong[name].parameters[LEVER_ARM]
        freed = np.array(wrong[name].noise.lever_arm.sigma) > 0.002
        assert (np.abs(one.value[-1] - ARM)[freed] < 4.0 * one.sigma[-1][freed]).all()
        assert "gnss.lever_arm_used" in map(get_key, wrong[name].notes)
        assert stated[name].noise.lever_arm is None


def test_an_arm_that_was_freed_is_in_the_noise_model_of_the_run(drive, tmp_path):
    recording = state_arm(drive, np.array([0.5, 0.0, 0.0]))
    found = run(recording, solvers=("rts",))["rts"]
    noise = read_noise(write_noise(tmp_path / "noise.json", found.noise))
    assert noise.lever_arm == found.noise.lever_arm
    again = run(recording, solvers=("rts",), noise=noise)["rts"]
    assert (again.states.p == found.states.p).all()


def test_an_arm_whose_prior_is_stated_is_estimated_by_it(drive):
    settings = parse_settings({"gnss": {"lever_arm_sigma": 0.01}})
    found = run(state_arm(drive, np.array([0.5, 0.0, 0.0])), settings, ("rts",))["rts"]
    assert found.noise.lever_arm is None
    assert found.parameters[LEVER_ARM].prior_sigma == pytest.approx(0.01)


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.3, -0.4, 0.0)])
def test_evidence_of_a_free_arm_is_that_of_the_innovations(drive, monkeypatch, off):
    """The closed form against filters of all keyframes, with and without the arm as a parameter."""
    asked = []
    monkeypatch.setattr(preparation, "find_contradicted_arm", lambda *given: asked.append(given))
    run(state_arm(drive.crop(0.0, 90.0), np.array(off)), solvers=("ekf",))
    ((problem, about),) = asked
    stated = get_stated_arm(problem)
    freed = free_arm(problem, LeverArm(tuple(stated), (ARM_SIGMA,) * 3))
    one, other = refilter(problem, about), refilter(freed, reuse_points(about, problem, freed))
    at = freed.columns[LEVER_ARM]
    change = other.values[-1, shift(at)] - stated
    gain = other.log_likelihood.sum() - one.log_likelihood.sum()
    assert compute_evidence_gain(change, other.P[-1, at, at]) == pytest.approx(gain, abs=0.02 + 0.002 * abs(gain))
    assert (gain > 0.0) == any(off)
