"""A drive filtered again at given points, and looked at again once it is known which fixes are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import random_states, truth_states
from test_faults import OFF, scattered
from test_solvers import sigmas

from graphnav.config import Settings
from graphnav.constraints.gnss import TIME_OFFSET
from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import pick_nearest
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.model import NoiseModel, VarianceComponent
from graphnav.estimation.pipeline import choose_origin, run
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solvers.ekf import ekf, refilter, smooth_near
from graphnav.estimation.solvers.linearise import Points, advance, linearise, scale_at
from graphnav.estimation.solvers.passes import carry_points, split_values
from graphnav.estimation.solvers.points import Linearisation, PointFilter
from graphnav.estimation.solvers.recursion import move_columns
from graphnav.estimation.solvers.rts import smooth_backward
from graphnav.estimation.solvers.stack import Stack
from graphnav.recording import Recording

Drive = tuple[Recording, Trajectory]


@pytest.fixture(scope="module")
def drive() -> Drive:
    return oracle.drive(
        oracle.vehicle_path(duration=200, rate=50.0, seed=7),
        seed=5,
        gnss_velocity_sd=(0.1, 0.1, 0.1),
        odometer_rate=20.0,
    )


@pytest.fixture(scope="module")
def built(drive: Drive) -> Problem:
    """Every constraint of a vehicle, fixes with velocities and errors that last."""
    recording, _ = drive
    settings = Settings()
    frame = LocalFrame(choose_origin(recording))
    found = align(recording, settings, frame)
    base = build_problem(recording, settings, frame, found.state, found.sigma, detect(recording, settings).stationary)
    lasting = (f"gnss_position.{time}.{axis}" for time in ("minutes", "hours") for axis in ("horizontal", "up"))
    return apply_noise(base, NoiseModel({name: VarianceComponent(float(np.log(0.25))) for name in lasting}))


def scattered_points(problem: Problem, seed: int) -> Points:
    """Points that no vehicle goes through: far enough apart that a step between them turns and jumps."""
    rng = np.random.default_rng(seed)
    width = sum(at.stop - at.start for at in problem.columns.values())
    return Points(random_states(rng, len(problem.t)), 0.01 * rng.standard_normal((len(problem.t), width)))


def derivative(f: object, width: int, eps: float = 1e-5) -> Array:
    """Central differences."""
    steps = eps * np.eye(width)
    return np.stack([(f(e) - f(-e)) / (2.0 * eps) for e in steps], axis=-1)


def test_points_carried_to_other_keyframes_are_as_near_to_the_truth(drive: Drive, built: Problem) -> None:
    smoothed = smooth_backward(built, ekf(built))
    later = replace(built, t=built.t + 0.3)
    carried = carry_points(smoothed, built, later, anew=(TIME_OFFSET,))
    error = carried.states[:-1].minus(truth_states(drive[1], later.t[:-1], built.frame))[:, :9]
    # half a second of the IMU adds nothing to sigmas that hold at either side
    sigma = np.sqrt(smoothed.variance[:-1, :9])
    assert np.abs(error / sigma).max() < 5.0
    last, end = carried.states[-1:], smoothed.states[-1:]
    np.testing.assert_allclose(last.p, end.p + 0.3 * end.v)
    np.testing.assert_allclose(last.R_nb, end.R_nb, atol=1e-12)
    for chain in built.chains:
        name = chain.parameter.name
        value = split_values(later, carried)[name]
        known = split_values(built, smoothed)[name][pick_nearest(built.t, later.t)]
        np.testing.assert_array_equal(value, chain.mean[chain.node] if name == TIME_OFFSET else known)


def test_steps_and_rows_at_points_are_those_of_an_estimate_to_first_order(built: Problem) -> None:
    smoothed = smooth_backward(built, ekf(built))
    rng = np.random.default_rng(1)
    off = np.concatenate(
        [
            0.05 * rng.standard_normal((len(built.t), 3)),
            rng.standard_normal((len(built.t), 6)),
            1e-4 * rng.standard_normal((len(built.t), 6)),
        ],
        axis=1,
    )
    points = Points(smoothed.states.plus(off), smoothed.values)
    K, D = len(built.t), DIM + points.values.shape[1]
    stack, steps = Stack(built, K), advance(built, K)
    out = tuple(np.empty((K, *shape)) for shape in ((D,), (D, D), (D,), (D, D)))
    given = PointFilter(built, points, stack, steps, Linearisation.of(built, points, stack, steps), out)

    for k in (3, 60, 150):

        def ahead(e: Array, k: int = k) -> Array:
            at, to = slice(k - 1, k), slice(k, k + 1)
            values = points.values[at] + e[DIM:]
            scale = scale_at(built.columns, values)
            reached, _ = built.motion.propagate(at, points.states[at].plus(e[None, :DIM]), scale)
            return np.concatenate([reached.minus(points.states[to]), steps.predict(at, values) - points.values[to]], 1)[
                0
            ]

        np.testing.assert_allclose(given.gap[k - 1], ahead(np.zeros(D)), atol=1e-9)
        whole = move_columns(given.F[k - 1], steps.decay[k - 1], np.eye(D))
        np.testing.assert_allclose(whole, derivative(ahead, D), atol=2e-5, rtol=1e-4)
        for some in stack.stack_keyframe(k):
            own = [linearise(rows, points, built.columns, slice(lo, hi)) for rows, lo, hi in some.parts]
            np.testing.assert_allclose(
                given.r[some.at], np.concatenate([one.residual.ravel() for one in own]), atol=1e-12
            )
            np.testing.assert_allclose(
                given.H[some.at], np.concatenate([one.H.reshape(-1, D) for one in own]), atol=1e-12
            )


def test_rows_taken_together_are_those_taken_one_after_another(built: Problem) -> None:
    """A gate that nothing meets makes the filter decide on every kind by itself."""
    weight = np.where(np.arange(200) % 7 == 3, 0.0, 0.3 + 0.7 * (np.arange(200) % 3 == 0))
    some = tuple(
        replace(c, weight=np.resize(weight, len(c)) if c.name.startswith("gnss") else None) for c in built.constraints
    )
    together = replace(built, constraints=some)
    apart = replace(built, constraints=tuple(replace(c, gate=1e9) for c in some))
    points = smooth_backward(built, ekf(built))
    one, other = refilter(together, points), refilter(apart, points)
    sigma = np.sqrt(np.diagonal(other.P, axis1=1, axis2=2))
    np.testing.assert_allclose(one.errors / sigma, other.errors / sigma, atol=1e-6)
    np.testing.assert_allclose(one.P / (sigma[:, None] * sigma[:, :, None]),
                               other.P / (sigma[:, None] * sigma[:, :, None]), atol=1e-6)  # fmt: skip
    for name, mine in one.records.items():
        theirs = other.records[name]
        np.testing.assert_allclose(mine.residual / mine.sigma, theirs.residual / theirs.sigma, atol=1e-5)
        np.testing.assert_allclose(mine.sigma, theirs.sigma, rtol=1e-6)
        np.testing.assert_allclose(mine.nis, theirs.nis, rtol=1e-4, atol=1e-6)
        assert np.array_equal(mine.weight, theirs.weight)


def test_filtered_again_about_its_own_end_it_is_the_batch_solution(built: Problem) -> None:
    """Bell 1994: the iterated smoother is Gauss and Newton's method on the whole drive."""
    smoothed = smooth_backward(built, ekf(built))
    solved = batch(built, smoothed.states, smoothed.select_nodes(built), reintegrate=False)
    for _ in range(3):
        smoothed = smooth_backward(built, refilter(built, smoothed))
    apart = np.abs(smoothed.states.minus(solved.states)) / sigmas(solved)
    assert np.max(apart) < 0.02  # where batch stops
    mine = np.sqrt(np.diagonal(smoothed.P[:, :DIM, :DIM], axis1=1, axis2=2))
    np.testing.assert_allclose(mine, sigmas(solved), rtol=1e-3)


def test_points_that_lead_nowhere_are_given_up(built: Problem) -> None:
    """From anywhere at all the drive is found, if need be as a filter would."""
    plain = smooth_backward(built, ekf(built))
    found = smooth_near(built, scattered_points(built, 2))
    sigma = np.sqrt(np.diagonal(plain.P[:, :DIM, :DIM], axis1=1, axis2=2))
    assert np.max(np.abs(found.states.minus(plain.states)) / sigma) < 0.5


def test_a_stop_is_found_although_noisy_fixes_speak_of_motion() -> None:
    path = oracle.vehicle_path(duration=420, rate=50.0, seed=11)
    recording = oracle.drive(path, seed=3, gnss_velocity_sd=(0.05, 0.05, 0.05))[0].crop(60.0, 190.0)
    gnss, stops = recording.gnss, detect(recording).stationary
    long = stops[(stops[:, 0] > recording.start + 60.0) & (stops[:, 1] - stops[:, 0] > 4.0)][0]
    bad = (gnss.t > long[0] - 20.0) & (gnss.t < long[1] + 20.0)
    noise = np.random.default_rng(3).standard_normal((int(bad.sum()), 3))
    v = gnss.v.copy()
    v[bad] += 100.0 * gnss.sd_v[bad] * noise
    wrong = scattered(replace(recording, gnss=replace(gnss, v=v)), bad, 100.0, 4)

    def found(stationary: Array) -> bool:
        return bool(np.any((stationary[:, 0] < long[1]) & (stationary[:, 1] > long[0])))

    assert not found(detect(wrong).stationary)  # or the test would show nothing
    fused = {
        name: run(wrong, settings, ("ekf",))["ekf"].detections[-1] for name, settings in (("on", None), ("off", OFF))
    }
    assert found(fused["on"].intervals)
    assert not found(fused["off"].intervals)
