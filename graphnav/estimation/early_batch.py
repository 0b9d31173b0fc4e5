"""The batch solution of a problem beside its filter, from points near the optimum that are known before."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from graphnav.core.beside import begin_beside
from graphnav.estimation.problem import Problem
from graphnav.estimation.relinearisation import step_ahead
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.linearise import Points, scale_at
from graphnav.estimation.solvers.passes import LINEAR_ATTITUDE, are_near

if TYPE_CHECKING:
    from graphnav.estimation.factor_graph.batch import Optimum


class EarlyBatch:
    """The batch solution of a problem, begun from points near its optimum.

    The noise in what scale errors multiply is that at these points.
    """

    def __init__(self, problem: Problem, near: Points) -> None:
        self._problem = problem.with_input_noise(near.states, scale_at(problem.columns, near.values))
        self._near = near
        self._work = begin_beside(partial(_find_optimum, self._problem, near))

    def get_solution(self, problem: Problem, points: Points) -> Solution | None:
        """The solution; None where the problem of the other solvers has other rows, or the smoother has led them to
        points far from those.
        """
        same = problem.constraints is self._problem.constraints and problem.prior is self._problem.prior
        if not same or not are_near(points, self._near, LINEAR_ATTITUDE):
            return None
        from graphnav.estimation.factor_graph.batch import describe_optimum

        return describe_optimum(self._problem, self._work.get_result())


def _find_optimum(problem: Problem, near: Points) -> Optimum:
    from graphnav.estimation.factor_graph.batch import find_optimum

    start = step_ahead(problem, near)
    return find_optimum(problem, start.states, start.select_nodes(problem))
