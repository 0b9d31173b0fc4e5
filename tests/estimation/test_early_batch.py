"""The batch solution that is begun beside the filter."""

from __future__ import annotations

import os
import sys
from dataclasses import replace

import numpy as np
import oracle
import pytest

from graphnav import run
from graphnav.core import beside
from graphnav.estimation.early_batch import EarlyBatch
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.linearise import Points


@pytest.fixture(scope="module")
def drive() -> oracle.Recording:
    return oracle.drive(oracle.vehicle_path(duration=150, rate=50.0, seed=6), seed=5)[0]


@pytest.mark.skipif(sys.platform != "linux", reason="a second process is begun on Linux only")
def test_it_is_the_same_in_a_second_process(drive: oracle.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = run(drive, None, ("batch",), noise="estimated")["batch"]
    monkeypatch.setattr(beside, "_allowed", True)
    monkeypatch.setattr(beside, "read_peak_memory_mb", lambda: 100.0)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    both = run(drive, None, ("batch",), noise="estimated")["batch"]
    np.testing.assert_array_equal(both.states.p, alone.states.p)
    np.testing.assert_array_equal(both.covariance, alone.covariance)
    assert both.cost == alone.cost


def test_it_is_the_optimum_found_from_elsewhere(drive: oracle.Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    early = run(drive, None, ("batch",), noise="estimated")["batch"]
    taken: list[Solution | None] = []
    get_solution = EarlyBatch.get_solution

    def watch(self: EarlyBatch, problem: Problem, points: Points) -> Solution | None:
        other = replace(problem, constraints=(*problem.constraints,)[:-1])
        taken.extend([get_solution(self, problem, points), get_solution(self, other, points)])
        return None

    monkeypatch.setattr(EarlyBatch, "get_solution", watch)
    late = run(drive, None, ("batch",), noise="estimated")["batch"]
    found, of_another = taken
    assert found is not None
    assert of_another is None
    sigma = np.sqrt(np.diagonal(early.covariance, axis1=1, axis2=2))
    assert np.max(np.abs(late.states.minus(early.states)) / sigma) < 0.01
    np.testing.assert_array_equal(found.states.p, early.states.p)
