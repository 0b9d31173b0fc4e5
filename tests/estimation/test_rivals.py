"""Sets of fixes of which either may be wrong: found, told, and in the sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest

from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.core.state import BLOCKS
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.faults.segments import compare_wrong_segments
from graphnav.estimation.faults.watch import MINUTE
from graphnav.estimation.noise.model import NoiseModel, Rival, StampOffsets
from graphnav.estimation.noise.spans import mask_times
from graphnav.estimation.pipeline import choose_origin, run
from graphnav.estimation.problem import build_problem
from graphnav.estimation.solution import Solution, _join_noise
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.passes import reuse_points
from graphnav.estimation.stamps import shift_to_imu_clock
from graphnav.recording import Recording
from graphnav.report.doubts import list_doubts

POSITION = "gnss_position"
STEP = np.array([2.4, -1.8, 3.0])  # m
HALF = 95.0  # s


@pytest.fixture(scope="module")
def drive() -> tuple[Recording, Trajectory]:
    recording, truth = oracle.drive(oracle.vehicle_path(duration=2.0 * HALF, rate=50.0, seed=11), seed=3)
    return recording, truth


def moved(recording: Recording, begin: float, end: float) -> Recording:
    """The recording with its fixes from `begin` to `end` (s from its start) moved."""
    assert recording.gnss is not None
    frame, t = LocalFrame(choose_origin(recording)), recording.gnss.t - recording.start
    p = frame.from_llh(recording.gnss.llh)
    p[(t >= begin) & (t < end)] += STEP
    return replace(recording, gnss=replace(recording.gnss, llh=frame.to_llh(p)))


@pytest.fixture(scope="module")
def halves(drive: tuple[Recording, Trajectory]) -> dict[str, Solution]:
    return run(moved(drive[0], HALF, np.inf), None, ("ekf", "rts", "batch"))


def list_keys(solution: Solution) -> list[str]:
    """Keys of its doubts."""
    return [get_key(one) for one in list_doubts({solution.solver: solution}, {})]


def test_nothing_tells_which_half_of_the_fixes_is_right(halves: dict[str, Solution]) -> None:
    solution = halves["rts"]
    (rival,) = solution.noise.rivals
    t = solution.records[POSITION].t
    one, other = (mask_times(t, some[POSITION]) for some in (solution.noise.excluded, rival.excluded))
    assert one.any()
    assert np.array_equal(one, ~other)
    assert rival.probability == pytest.approx(0.5, abs=0.02)
    for each in halves.values():
        assert "doubt.rival" in list_keys(each)


@pytest.mark.parametrize("name", ["ekf", "rts", "batch"])
def test_sigmas_hold_what_may_be_wrong(
    halves: dict[str, Solution], drive: tuple[Recording, Trajectory], name: str
) -> None:
    """Of an error d that is there with a probability p, whichever part is right, d^T (P + p d d^T)^-1 d is below 1 / p,
    beside which two numbers are left."""
    solution, truth = halves[name], drive[1]
    frame = solution.frame
    p = frame.from_llh(truth.llh)
    right = np.stack([np.interp(solution.t, truth.t, column) for column in p.T], axis=-1)
    P = solution.covariance[:, 3:6, 3:6]
    for step in (0.0, STEP):
        error = solution.states.p - right - step
        squares = np.einsum("ki,ki->k", error, np.linalg.solve(P, error[..., None])[..., 0])
        assert np.mean(squares) < 1.0 / solution.noise.rivals[0].probability + 2.0
    between = solution.at(solution.t[:-1] + 0.5 * np.diff(solution.t))[2]
    assert np.all(between[:, 3:6, 3:6].trace(axis1=1, axis2=2) > 0.5 * P[:-1].trace(axis1=1, axis2=2))


def test_a_run_with_the_noise_model_says_the_same(
    halves: dict[str, Solution], drive: tuple[Recording, Trajectory]
) -> None:
    again = run(moved(drive[0], HALF, np.inf), None, ("rts",), noise=halves["rts"].noise)["rts"]
    assert np.array_equal(again.covariance, halves["rts"].covariance)
    assert "doubt.rival" in list_keys(again)


@pytest.mark.parametrize(("begin", "end"), [(80.0, 100.0), (0.0, 0.0)])
def test_a_fault_of_a_short_span_is_no_matter_of_doubt(
    drive: tuple[Recording, Trajectory], begin: float, end: float
) -> None:
    solution = run(moved(drive[0], begin, end), None, ("rts",))["rts"]
    assert bool(solution.noise.excluded.get(POSITION)) == (end > begin)
    assert solution.noise.rivals == ()
    assert list_keys(solution) == []


@pytest.mark.parametrize("begin", [40.0, HALF, 150.0])
def test_only_how_long_faults_last_decides_between_two_parts(drive: tuple[Recording, Trajectory], begin: float) -> None:
    settings, recording = parse_settings({"gnss": {"time_offset_sigma": 0.0}}), moved(drive[0], begin, np.inf)
    frame = LocalFrame(choose_origin(recording))
    found = align(drive[0], settings, frame)
    stationary, sigma = detect(recording, settings).stationary, found.sigma.copy()
    sigma[BLOCKS["p"]] = 100.0  # m: nothing but the fixes tells where the drive begins
    right, problem = (
        build_problem(one, settings, frame, found.state, sigma, stationary) for one in (drive[0], recording)
    )
    rows = next(c for c in problem.constraints if c.name == POSITION)
    t = problem.t[rows.keyframe]
    edge = float(t[np.searchsorted(t, recording.start + begin)])
    about = reuse_points(ekf(right).linearised, right, problem)
    _, sets = compare_wrong_segments(problem, about, [float(t[0]), edge], [POSITION])

    def get_odds(first: bool) -> float:
        spans = ((float(t[0]), float(t[t < edge][-1])) if first else (edge, float(t[-1])),)
        return max(one.log_odds for one in sets if one.spans == {POSITION: spans})

    assert max(sets, key=lambda one: one.log_odds).large
    before, behind = edge - float(t[0]), float(problem.t[-1]) - edge
    prior = 2.0 * np.log((1.0 + before / MINUTE) / (1.0 + behind / MINUTE))
    assert get_odds(False) - get_odds(True) == pytest.approx(prior, abs=0.05)


def test_rivals_are_on_the_clock_of_what_is_excluded() -> None:
    spans = {POSITION: ((10.0, 20.0),)}
    noise = NoiseModel(excluded=spans, rivals=(Rival(0.3, spans),), stamps=StampOffsets(0.2, 0.1, rate=1e-3, since=5.0))
    shifted = shift_to_imu_clock(noise)
    assert shifted.excluded != spans
    assert shifted.rivals[0].excluded == shifted.excluded


def test_rivals_of_a_piece_exclude_what_others_do() -> None:
    one = NoiseModel(excluded={POSITION: ((0.0, 1.0),)}, rivals=(Rival(0.3, {POSITION: ((2.0, 3.0),)}),))
    two = NoiseModel(excluded={POSITION: ((7.0, 8.0),)})
    (rival,) = _join_noise([one, two]).rivals
    assert rival.excluded == {POSITION: ((2.0, 3.0), (7.0, 8.0))}
