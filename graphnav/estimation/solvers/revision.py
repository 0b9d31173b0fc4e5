"""Linearising again: stages of a window made anew about the smoothed states, a portion at a time if need be.

A window of some hundred keyframes takes a tenth of a second, in which others may have come. So what is made anew stands
beside the window until it has caught up with the newest keyframe, and takes the place of what was there in one step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.solvers.elimination import predict, update
from graphnav.estimation.solvers.stages import Columns, Message, Place, Stage, at_points, follows, group_runs, plus

if TYPE_CHECKING:
    from graphnav.estimation.solvers.window import Window

Renewed = Callable[[int, int], Sequence[Place]]
Renewing = Callable[[int, int], Sequence[Place] | None]  # None where it wants to be asked again at the next step


class Revision:
    """The stages of a window from `first` on."""

    def __init__(self, window: Window, first: int) -> None:
        self.window, self.first = window, first
        before = window.stages[first - 1] if first else window.head
        self._was = before
        self._before: Stage | Message = before.moved(window.means()[first])
        self._made: list[tuple[Stage, Stage]] = []  # what was there, and what is instead

    def step(self, count: int, renewed: Renewing | None) -> bool:
        """Make at most so many stages; True once they are in their place, or are not wanted any more.

        Parameters
        ----------
        renewed : gives the places of stages, from an index to another, if not where their rows came from before.
        """
        window, made = self.window, self._made
        if self.first and not _is(window.stages, self.first - 1, self._was):
            return True
        while made and not _is(window.stages, self.first + len(made) - 1, made[-1][0]):
            made.pop()
        begin = self.first + len(made)
        end = min(begin + count, len(window))
        if begin < end:
            old = window.stages[begin:end]
            places = [stage.place for stage in old] if renewed is None else renewed(begin, end)
            if places is None:
                return False
            made += zip(old, self._again(old, window.means()[begin + 1 : end + 1], places), strict=True)
        if end < len(window):
            return False
        # what an error of the fixes does to the estimate is the same to first order
        stages = [
            new if now.message.tests is None else replace(new, message=replace(new.message, tests=now.message.tests))
            for now, (_, new) in zip(window.stages[self.first :], made, strict=True)
        ]
        window.replace_from(self.first, self._before, stages)
        return True

    def forget(self) -> None:
        """Stages made so far need not know where their rows came from: each would keep the rows of all around it."""
        for k in range(len(self._made) - 1, -1, -1):
            was, stage = self._made[k]
            if stage.place.problem is None:
                break  # nor do those before it
            self._made[k] = was, replace(stage, place=replace(stage.place, problem=None))

    def _again(self, old: Sequence[Stage], means: Sequence[Array], places: Sequence[Place]) -> list[Stage]:
        before = self._made[-1][1] if self._made else self._before
        message = before.message if isinstance(before, Stage) else before
        around = [message, *(stage.message for stage in old)]
        moves = [np.zeros(len(message.z)), *means]
        states = plus(States.stack([m.state for m in around]), np.array([e[:DIM] for e in moves]), message.turns)
        points = [
            LinearisationPoint(states[k : k + 1], m.values + e[DIM:], m.columns)
            for k, (m, e) in enumerate(zip(around, moves, strict=True))
        ]
        return remake(replace(message, tests=None), points, places)


def _is(stages: Sequence[Stage], k: int, was: Stage | Message) -> bool:
    """Whether stage k is still the one that was there, perhaps about another point."""
    return isinstance(was, Stage) and k < len(stages) and stages[k].lost is was.lost


@dataclass(frozen=True)
class LinearisationPoint:
    """Where rows are linearised: one state, parameter values and where they stand."""

    state: States
    values: Array
    columns: Columns


def remake(before: Message, points: Sequence[LinearisationPoint], places: Sequence[Place]) -> list[Stage]:
    """Stages about given points; `points[0]` is that of the message before them."""

    def alike(last: int, k: int) -> bool:
        same = places[k].linked == places[last].linked and points[k + 1].columns == points[last + 1].columns
        return same and follows(places[k], places[last])

    out: list[Stage] = []
    for run in group_runs(range(len(places)), alike):
        linked, own = places[run[0]].linked, [places[k] for k in run]
        part = [points[k + 1] for k in run]
        around = [points[run[0]], *part] if linked else part
        states, values = States.stack([point.state for point in around]), [point.values for point in around]
        linears = at_points(own, states, values, part[-1].columns, linked)
        for place, point, linear in zip(own, part, linears, strict=True):
            plain, bent = (tuple(m for m in linear.measured if (m.kernel == "none") == one) for one in (True, False))
            ahead = predict(before, place, linear.link, plain, point.state, point.values, point.columns)
            stage, _ = update(ahead, bent, weighted=True)
            before = stage.message
            out.append(stage)
    return out
