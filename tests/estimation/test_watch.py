"""Faults of fixes found as the drive happens: the tests beside the newest message of the window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import at_rate
from test_faults import built, drive, moved, scattered

from graphnav.config import parse_settings
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.faults import watch
from graphnav.estimation.faults.watch import Bank
from graphnav.estimation.noise.apply import select_weights
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.ekf import ekf, refilter
from graphnav.estimation.solvers.linearise import list_node_steps
from graphnav.estimation.solvers.stages import Place
from graphnav.estimation.solvers.window import Window, make_first_message
from graphnav.online import Online, drop_rows, list_rows
from graphnav.recording import Recording

__all__ = ["built", "drive"]  # fixtures


@pytest.fixture(scope="module")
def live(drive: tuple[Recording, Trajectory]) -> tuple[Recording, Trajectory]:
    """As much of it as holds a burst, with half the rows of its IMU."""
    return at_rate(drive[0].crop(0.0, 160.0), 25.0), drive[1]


def likelihoods(slots: watch._Slots) -> Array:
    """(L,) T of every onset."""
    b = np.linalg.solve(slots.info, slots.score[..., None])[..., 0]
    return np.where(np.isnan(slots.first), np.nan, np.sum(slots.score * b, axis=1))


def test_tests_beside_a_message_are_those_of_the_filter(built: Problem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two derivations of one thing: a recursion beside a covariance, and columns of a QR."""
    rows = next(c for c in built.constraints if c.name == "gnss_position")
    problem = replace(built, constraints=(rows,))
    kept: list[Bank] = []
    follow = Bank.follow
    monkeypatch.setattr(Bank, "follow", lambda self, *a: (kept.append(self), follow(self, *a))[1])
    refilter(problem, ekf(problem), watch=True, drifts=False)
    mean = problem.prior.mean
    assert mean is not None
    message = make_first_message(mean, problem.prior.sigma[0])
    window = Window(replace(message, tests=watch.Watch([rows], 1.0, DIM)), np.inf)
    plain, steps = Window(message, np.inf), list_node_steps(problem)
    for k in range(len(problem.t)):
        for one in (window, plain):
            one.push(Place(float(problem.t[k]), problem, k, steps.get(k, ()), linked=k > 0))
    tests = window.newest.tests
    assert tests is not None
    mine, theirs = (likelihoods(x._slots[rows.name]) for x in (tests, kept[-1]))
    assert np.isfinite(theirs).sum() >= 8
    np.testing.assert_allclose(mine, theirs, rtol=0.02, atol=0.02)
    # and they do nothing to the estimate
    np.testing.assert_allclose(window.newest.state.p, plain.newest.state.p, atol=1e-7)
    np.testing.assert_allclose(window.newest.covariance, plain.newest.covariance, rtol=1e-6, atol=1e-9)


def settled(recording: Recording, **settings: dict[str, object]) -> tuple[Online, Array, Array]:
    """The smoother that runs as it drives, and the times and places (local frame, m) that it settled."""
    online = Online(drop_rows(recording), parse_settings(settings))
    parts = []
    for row in list_rows(recording)[1]:
        online.add(row)
        parts += online.settled()
    online.finish()
    parts += online.settled()
    assert online.frame is not None
    return online, np.concatenate([p.t for p in parts]), online.frame.from_llh(np.concatenate([p.llh for p in parts]))


def horizontal(driven: tuple[Recording, Trajectory], t: Array, p: Array, online: Online) -> Array:
    """(N,) horizontal, m."""
    assert online.frame is not None
    truth = online.frame.from_llh(driven[1].llh)
    return np.hypot(*(p[:, k] - np.interp(t, driven[1].t, truth[:, k]) for k in (0, 1)))


@pytest.mark.parametrize("seed", [3])  # two of the fixes at the first stop are wrong
def test_as_it_drives_a_burst_and_gross_errors_do_no_harm(live: tuple[Recording, Trajectory], seed: int) -> None:
    rng = np.random.default_rng(seed)
    recording, N = live[0], len(live[0].gnss.t)
    gross = np.sort(rng.choice(N, N // 10, replace=False))
    burst = np.arange(100, 130)
    by = np.concatenate([rng.uniform(5, 200, (len(gross), 1)) * [0.6, 0.8, 0.0], np.tile([6.0, 8.0, 0.0], (30, 1))])
    wrong, first = np.unique(np.concatenate([gross, burst]), return_index=True)
    dirty = moved(recording, wrong, by[first])
    clean, t, p = settled(recording)
    assert clean.excluded == ()
    usual = np.sqrt(np.mean(horizontal(live, t, p, clean) ** 2))
    online, t, p = settled(dirty)
    assert np.sqrt(np.mean(horizontal(live, t, p, online) ** 2)) < 1.2 * usual
    found = np.zeros(N, dtype=bool)
    for fault in online.excluded:
        found |= (recording.gnss.t >= fault.t_start) & (recording.gnss.t <= fault.t_end)
    # what an estimate has seen and taken for an outlier has hardly any weight
    assert online.tracker is not None
    found |= select_weights(recording.gnss.t, online.tracker.noise, "gnss_position") < 0.01
    assert found[wrong].mean() > 0.95
    assert wrong.size / found.sum() > 0.9


def test_as_it_drives_an_error_that_grows_is_found(drive: tuple[Recording, Trajectory]) -> None:
    rows = np.arange(100, 200)
    recording = at_rate(drive[0].crop(0.0, 225.0), 25.0)
    dirty = moved(recording, rows, np.column_stack([0.3 * np.arange(100.0), np.zeros((100, 2))]))
    online, t, p = settled(dirty)
    (fault,) = (one for one in online.excluded if one.kind == "gnss_position")
    assert fault.t_end == pytest.approx(199.0, abs=1.5)  # the first right fix may pass for the last wrong one
    assert fault.t_start < 110.0
    # a tenth of what the fixes are wrong by at last, where a smoother that believes them ends
    assert horizontal(drive, t, p, online).max() < 0.1 * 29.7


# ---------------------------------------------------------------------------------------------------------- noise


def test_as_it_drives_noise_is_weighed_down(drive: tuple[Recording, Trajectory]) -> None:
    """A minute of fixes that scatter ten times as much as they state."""
    recording = at_rate(drive[0].crop(0.0, 210.0), 25.0)
    t = recording.gnss.t - recording.start
    bad = (t >= 110.0) & (t < 170.0)
    noisy = scattered(recording, bad, 10.0, 3)

    def rms(mode: str) -> float:
        online, at, p = settled(noisy, noise={"mode": mode})
        return float(np.sqrt(np.mean(horizontal(drive, at, p, online) ** 2)))

    # where faults are looked for the first of those fixes pass for one, and are left out
    assert rms("estimated") < 0.5 * rms("stated")
