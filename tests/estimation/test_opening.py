"""The opening is filtered twice: what that changes, and what it must not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import oracle
import pytest
from test_solvers import NO_WHEELS, WHITE, nearly_linear, sigmas

from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.estimation.alignment import align
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE, subtract_points
from graphnav.estimation.solvers.rts import rts, smooth_backward, smooth_points
from graphnav.evaluation.scoring import compute_errors


@dataclass(frozen=True)
class Start:
    problem: Problem  # of 200 s, of which the vehicle stands for 89
    cut: Problem  # of the first 150 s
    opening: float


def built(shared_data: Path, seed: int) -> Start:
    recording, _ = oracle.oracle_drive(shared_data, seed, odometer=False)
    settings = parse_settings({"gnss": WHITE, "vehicle": NO_WHEELS})
    frame = LocalFrame(recording.gnss.llh[0])
    aligned = align(recording, settings, frame)
    assert aligned.until is not None
    assert aligned.motion < recording.start + 90.0 < aligned.until < recording.start + 140.0
    long, short = (
        build_problem(recording.crop(0.0, seconds), settings, frame, aligned.state, aligned.sigma)
        for seconds in (200.0, 150.0)
    )
    return Start(long, short, aligned.until)


@pytest.fixture(scope="module")
def start(shared_data: Path) -> Start:
    return built(shared_data, 0)


def test_the_smoother_is_the_batch_solution_where_the_vehicle_stood(shared_data: Path) -> None:
    """The filter's heading wanders by degrees there; linearised along the way, the smoother may be sigmas off."""

    def off(start: Start, opening: float | None) -> float:
        smoothed = rts(start.problem, ekf(start.problem, opening=opening))
        solved = batch(start.problem, smoothed.states, {n: p.value for n, p in smoothed.parameters.items()})
        return float(np.abs(smoothed.states.minus(solved.states) / sigmas(solved)).max())

    drives = [built(shared_data, seed) for seed in range(3)]
    assert max(off(drive, None) for drive in drives) > 1.0  # or the test would show nothing
    assert max(off(drive, drive.opening) for drive in drives) < 0.2


def test_after_the_opening_the_filter_depends_on_nothing_later(start: Start) -> None:
    long, short = (ekf(p, opening=start.opening).solution for p in (start.problem, start.cut))
    K = len(short.t) - 1  # the last keyframe is the end of the recording
    np.testing.assert_array_equal(long.t[:K], short.t[:K])
    assert short.t[K - 1] > start.opening + 20.0
    np.testing.assert_allclose(long.states[:K].minus(short.states[:K]) / sigmas(short)[:K], 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", [1, 5, 7])
def test_it_lasts_until_the_heading_is_known(shared_data: Path, seed: int) -> None:
    """Position fixes of a vehicle that goes straight on do not tell it: behind the first bend attitudes are within
    their sigmas, and depend on nothing later.
    """
    recording, truth = oracle.oracle_drive(shared_data, seed, odometer=False)
    part = recording.crop(211.5, 300.0)
    settings = parse_settings({"gnss": WHITE, "vehicle": NO_WHEELS})
    frame = LocalFrame(part.gnss.llh[0])
    aligned = align(part, settings, frame)
    assert aligned.own_sigma[2] > LINEAR_ATTITUDE  # or the test would show nothing
    long, short = (
        ekf(build_problem(some, settings, frame, aligned.state, aligned.sigma), opening=aligned.until).solution
        for some in (part, part.crop(0.0, 80.0))
    )
    k = np.flatnonzero((short.t > aligned.until + 10.0) & (short.t < short.t[-1]))
    np.testing.assert_allclose(long.states[k].minus(short.states[k]) / sigmas(short)[k], 0.0, atol=1e-6)
    errors = compute_errors(long.trajectory(), truth)
    assert np.mean(errors.nees_rph[errors.t > aligned.until + 10.0]) / 3.0 < 3.0


def test_innovations_are_as_large_as_stated(start: Start) -> None:
    """Three axes, some hundred fixes: their mean is 3 to a standard deviation of 0.25."""
    record = ekf(start.problem, opening=start.opening).solution.records["gnss_position"]
    inside = record.t <= start.opening
    assert np.count_nonzero(inside) > 100
    assert 2.3 < np.mean(record.nis[inside]) < 3.7


@pytest.mark.parametrize("kind", ["states", "constants", "slow"])
def test_it_changes_nothing_where_the_problem_is_linear(kind: str) -> None:
    problem = nearly_linear(kind).problem
    once = rts(problem, ekf(problem))
    for share in (0.5, 1.0):
        twice = rts(problem, ekf(problem, opening=problem.t[0] + share * (problem.t[-1] - problem.t[0])))
        np.testing.assert_allclose(twice.states.minus(once.states) / sigmas(once), 0.0, atol=1e-3)
        np.testing.assert_allclose(sigmas(twice), sigmas(once), rtol=1e-4)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_points_are_smoothed_without_covariances_as_with_them(share: float) -> None:
    problem = nearly_linear("slow").problem
    forward = ekf(problem, opening=problem.t[0] + share * (problem.t[-1] - problem.t[0]))
    alone, whole = smooth_points(forward), smooth_backward(problem, forward)
    np.testing.assert_allclose(subtract_points(alone, whole) / np.sqrt(whole.variance), 0.0, atol=1e-7)


def test_an_opening_before_the_first_keyframe_is_none(start: Start) -> None:
    a, b = ekf(start.cut), ekf(start.cut, opening=start.cut.t[0] - 1.0)
    np.testing.assert_array_equal(a.P, b.P)
