"""A solved problem as GTSAM's own, and classes of a script."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
import oracle
import pytest
from helpers import random_states, refused

from graphnav.config import parse_settings
from graphnav.constraints.base import Constraint, assemble
from graphnav.constraints.standstill import ZeroVelocity
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import ConfigError, EstimationError
from graphnav.core.notes import get_key
from graphnav.core.rotation import Array, mv
from graphnav.core.state import DIM, States
from graphnav.detectors import detect
from graphnav.detectors.base import Detection
from graphnav.detectors.scene import Detector
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.factor_graph.nonlinear import get_state, make_graph
from graphnav.estimation.pipeline import add_own, run
from graphnav.estimation.problem import build_problem
from graphnav.estimation.solvers.passes import make_points
from graphnav.estimation.solvers.rows import Layout, compute_cost_at, whiten
from graphnav.recording import Recording
from graphnav.sensors import list_sensors

STATED = {"noise": {"mode": "stated"}, "gnss": {"faults": "off", "lever_arm_sigma": 0.1}}


@pytest.fixture(scope="module")
def drive() -> Recording:
    made, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0), seed=3, odometer_rate=10.0)
    made = made.crop(0.0, 30.0)
    t = np.arange(made.start + 0.2, made.end, 0.5)
    height = made.gnss.llh[0, 2] + 0.5 * np.random.default_rng(1).standard_normal(len(t))
    return replace(made, sensors={"barometer": list_sensors()["barometer"].make_series(t, {"height": height})})


def test_its_optimum_is_that_of_the_batch_solver(drive):
    solution = run(drive.crop(0.0, 16.0), parse_settings(STATED), ("batch",))["batch"]
    graph, values = solution.to_gtsam()
    assert graph.error(values) == pytest.approx(solution.cost, rel=1e-9)
    rng, away = np.random.default_rng(2), gtsam.VectorValues()
    step = graph.linearize(values).optimize()
    for key in values.keys():  # noqa: SIM118 it is no dict
        away.insert(key, 1e-3 * rng.standard_normal(step.at(key).size))
    start = values.retract(away)
    assert graph.error(start) > 2.0 * solution.cost
    found = gtsam.GaussNewtonOptimizer(graph, start).optimize()
    sigma = np.sqrt(np.diagonal(solution.covariance, axis1=1, axis2=2))
    off = [get_state(found, k).minus(solution.states[k : k + 1])[0] / sigma[k] for k in range(len(solution.t))]
    assert np.max(np.abs(off)) < 1e-3
    with refused("pieces.none_such", EstimationError):
        solution.to_gtsam(1)


@pytest.mark.parametrize("kernel", ["huber", "cauchy", "geman-mcclure", "tukey", "welsch"])
def test_kernels_are_those_of_gtsam(drive, kernel):
    frame, start = LocalFrame(drive.gnss.llh[0]), random_states(np.random.default_rng(3), 1)
    settings = parse_settings(STATED | {"gnss": STATED["gnss"] | {"robust": kernel}})
    problem = build_problem(drive.crop(0.0, 5.0), settings, frame, start, np.ones(DIM))
    states = random_states(np.random.default_rng(5), len(problem.t), span=2.0)
    values = {c.parameter.name: c.mean for c in problem.chains}
    graph, at = make_graph(problem, states, values)
    _, expected = whiten(problem, make_points(problem, states, {}), Layout(problem))
    assert graph.error(at) == pytest.approx(expected, rel=1e-9)


@dataclass(frozen=True)
class Differenced(Constraint):
    """`zero_velocity` as somebody would write it who knows no Jacobians."""

    name, axes, unit = "differenced", ("right", "forward", "up"), "m/s"
    sigma: Array = field(default_factory=lambda: np.empty((0, 3)))

    @classmethod
    def build(cls, scene):
        rows = ZeroVelocity.build(scene)
        return None if rows is None else cls(keyframe=rows.keyframe, sigma=np.array(rows.sigma))

    def residual(self, states, parameters, rows):
        return mv(np.swapaxes(states.R_nb, -1, -2), states.v)


class Beginning(Detector):
    """Ten seconds from the start, whatever the sensors say."""

    name, edge = "beginning", 1.0

    @classmethod
    def detect(cls, scene, labels=None, shown=True):
        t = np.arange(scene.recording.start + 0.5, scene.recording.end, 1.0)
        spans = scene.recording.start + np.array([[0.0, 10.0]])
        return Detection(cls.name, t, t, 10.0, t < spans[0, 1], spans)


def test_differences_do_what_jacobians_do(drive):
    settings, standing = parse_settings(STATED), np.array([[1.0, 3.0]])
    frame = LocalFrame(drive.gnss.llh[0])
    states = random_states(np.random.default_rng(3), 1)
    own = add_own(drive.crop(0.0, 5.0), [Differenced])
    problem = build_problem(own, settings, frame, states, np.ones(DIM), standing)
    rows = {c.name: c for c in problem.constraints}
    assert len(rows["differenced"]) == len(rows["zero_velocity"]) > 1
    at = random_states(np.random.default_rng(4), len(rows["differenced"]))
    found, exact = (rows[name].linearize(at, {}, slice(None)) for name in ("differenced", "zero_velocity"))
    np.testing.assert_allclose(assemble(found), assemble(exact), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(found.residual, exact.residual)
    assert "constraint.differences" in map(get_key, problem.notes)


@dataclass(frozen=True)
class Bowl(Constraint):
    """Heights in a cost of which the rows tell half of the curvature: (x^2 + (100 + 0.0095 x^2 / 2)^2) / 2."""

    name, axes, unit = "bowl", ("height", "depth"), "m"
    sigma: Array = field(default_factory=lambda: np.empty((0, 2)))

    @classmethod
    def build(cls, scene):
        keyframe = np.arange(len(scene.t))
        return cls(keyframe=keyframe, sigma=np.ones((len(keyframe), 2)))

    def residual(self, states, parameters, rows):
        x = states.p[:, 2]
        return np.stack([x, 100.0 + 0.0095 * x**2 / 2.0], axis=1)


def test_batch_ends_where_the_cost_is_least_though_full_steps_go_nearly_twice_as_far(drive):
    start = States(np.eye(3)[None], *np.zeros((4, 1, 3)))
    sigma = np.repeat([1.0, 1e3, 1.0, 1e-2, 1e-3], 3)
    problem = build_problem(
        add_own(drive.crop(0.0, 10.0), [Bowl]), parse_settings(STATED), LocalFrame(drive.gnss.llh[0]), start, sigma
    )
    problem = replace(problem, constraints=tuple(c for c in problem.constraints if c.name == "bowl"))
    states = problem.motion.advance_through(slice(0, len(problem.t) - 1), start, None)
    solution = batch(problem, States.stack([start, states]).plus(np.eye(DIM)[[5] * len(problem.t)]), wanted=())
    shift = np.linspace(-0.5, 0.5, 101)[:, None] * np.eye(DIM)[5]
    costs = [
        compute_cost_at(problem, make_points(problem, solution.states.plus(np.tile(e, (len(problem.t), 1))), {}))
        for e in shift
    ]
    assert min(costs) > solution.cost - problem.settings.solver.tolerance


def test_an_own_detector_suffices_by_itself(drive):
    # a threshold that no window is below leaves the other without a stop
    settings = parse_settings({"detectors": {"fire": ["glrt"], "glrt": {"threshold": 1e-12}}})
    assert not len(detect(drive, settings).stationary)
    found = detect(add_own(drive, detectors=[Beginning]), settings)
    assert len(found.stationary)
    assert found.stationary[-1, 1] <= drive.start + 11.0
    assert {"glrt", "beginning"} <= {d.name for d in found.all}


@pytest.mark.parametrize(
    ("constraints", "detectors", "key", "name"),
    [
        ([dict], [], "kind", "Constraint"),
        ([], [Differenced], "kind", "Detector"),
        ([Differenced, Differenced], [], "name_taken", "differenced"),
        ([type("Nameless", (Differenced,), {"name": "nhc"})], [], "name_taken", "nhc"),
        ([type("Unfinished", (Constraint,), {"name": "u", "axes": ("x",), "unit": "m"})], [], "incomplete", "build"),
        ([type("Silent", (Differenced,), {"name": "s", "watched": True})], [], "incomplete", "compute_typical_error"),
    ],
)
def test_what_is_not_complete_is_refused(drive, constraints, detectors, key, name):
    with refused(f"class.{key}", ConfigError, name):
        run(drive, constraints=constraints, detectors=detectors)
