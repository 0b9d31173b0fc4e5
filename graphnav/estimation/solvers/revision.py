"""Relinearisation: stages of a window rebuilt about the smoothed states, in portions if need be.

A window of some hundred keyframes takes a tenth of a second, in which others may arrive. So the rebuilt stages are kept
beside the window until they have caught up with the newest keyframe, and replace the old ones in one step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.solvers.elimination import predict_message, update_late
from graphnav.estimation.solvers.stages import (
    Columns,
    Linear,
    Place,
    Stage,
    add_error,
    linearise_keyframes,
)

if TYPE_CHECKING:
    from graphnav.estimation.solvers.window import Window

_SWING = 0.5  # of a step, by which the next goes back

Renewed = Callable[[int, int], Sequence[Place]]
Renewing = Callable[[int, int], Sequence[Place] | None]  # None where it wants to be asked again at the next step


class Relaxation:
    """How much of each step of Gauss and Newton to take, so that they do not swing around the optimum.

    Steps e, e' from points that are d apart tell how much of e' is too much: with s = (e - e') d / d^2 it ends at 1/s
    of it (Aitken's method: Irons and Tuck 1969). What swings to less than `_SWING` of what it was is left to whole
    steps, which end at once where nothing swings. The first step tells nothing: its rows were linearised elsewhere.
    """

    def __init__(self) -> None:
        self._last: Array | None = None
        self._share = 1.0

    def find_share(self, step: Array) -> float:
        """The share of a step to take, by its turns of n attitudes (n, 3)."""
        if self._last is None:
            self._last = step[:0]
            return 1.0
        n = min(len(step), len(self._last))
        gone = self._share * self._last[:n]
        square = float(np.sum(gone**2))
        slope = float(np.sum((self._last[:n] - step[:n]) * gone)) / square if square > 0.0 else 1.0
        self._last, self._share = step, 1.0 / slope if slope > 1.0 + _SWING else 1.0
        return self._share


class Revision:
    """The stages of a window from `first` on.

    Parameters
    ----------
    means : where they are to be linearised, error states as of `Window.compute_means`, which has the smoothed ones.
    share : of these, to go.
    """

    def __init__(self, window: Window, first: int, means: Sequence[Array] | None = None, share: float = 1.0) -> None:
        self.window, self.first, self._means, self._share = window, first, means, share
        e = self._list_means()[first]
        self._was = window.stages[first - 1] if first else None
        self._stage = None if self._was is None else self._was.move(e)  # the one before, where it is in the window
        self._before = window.head.move(e) if self._stage is None else self._stage.message
        self._old: list[Stage] = []
        self.made: list[Stage] = []  # their replacements

    def _list_means(self) -> Sequence[Array]:
        means = self.window.compute_means() if self._means is None else self._means
        return means if self._share == 1.0 else [self._share * e for e in means]

    def step(self, count: int, renewed: Renewing | None) -> bool:
        """Rebuild at most so many stages; True once they are in place, or no longer wanted.

        Parameters
        ----------
        renewed : gives the places of stages, from an index to another, if not where their rows came from before.
        """
        window, made = self.window, self.made
        if self._was is not None and not _is(window.stages, self.first - 1, self._was):
            return True
        while made and not _is(window.stages, self.first + len(made) - 1, self._old[-1]):
            made.pop(), self._old.pop()
        begin = self.first + len(made)
        end = min(begin + count, len(window))
        if begin < end:
            old = window.stages[begin:end]
            places = [stage.place for stage in old] if renewed is None else renewed(begin, end)
            if places is None:
                return False
            made += self._smooth_again(old, self._list_means()[begin + 1 : end + 1], places)
            self._old += old
        if end < len(window):
            return False
        # the effect of an error of the fixes on the estimate is the same to first order
        stages = [
            new if now.message.tests is None else replace(new, message=replace(new.message, tests=now.message.tests))
            for now, new in zip(window.stages[self.first :], made, strict=True)
        ]
        window.replace_from(self.first, self._before, self._stage, stages)
        return True

    def _smooth_again(self, old: Sequence[Stage], means: Sequence[Array], places: Sequence[Place]) -> list[Stage]:
        """The stages about their smoothed means, each from the one before."""
        before = self.made[-1].message if self.made else self._before
        around = [before, *(stage.message for stage in old)]
        moves = [np.zeros(len(before.z)), *means]
        states = add_error(States.stack([m.state for m in around]), np.array([e[:DIM] for e in moves]), before.turns)
        if not places[0].linked:  # the same state as in the message before
            apart = states[1:2].minus(states[:1])[0]
            before = self._before = before.move(np.append(apart, np.zeros(len(before.values))))
            states = States.stack([before.state, before.state, states[2:]])
        values = [m.values + e[DIM:] for m, e in zip(around, moves, strict=True)]
        columns = [stage.message.columns for stage in old]
        before = replace(before, tests=None)
        out: list[Stage] = []
        for k, linear in enumerate(linearise_runs(places, states, values, columns)):
            plain, bent = (tuple(m for m in linear.measured if (m.kernel == "none") == one) for one in (True, False))
            point = states[k + 1 : k + 2], values[k + 1], columns[k]
            stage, _ = update_late(predict_message(before, places[k], linear.link, plain, *point), bent, weighted=True)
            before = stage.message
            out.append(stage)
        return out


def linearise_runs(
    places: Sequence[Place], states: States, values: Sequence[Array], columns: Sequence[Columns]
) -> Iterator[Linear]:
    """The rows of consecutive keyframes, of as many at once as follow each other in one problem.

    Parameters
    ----------
    places, columns : of n keyframes.
    states, values : of the keyframe before them, and of them: n + 1.
    """

    keys = [(id(place.problem), place.k - i, place.linked) for i, place in enumerate(places)]
    ends = [i for i in range(1, len(places)) if keys[i] != keys[i - 1] or columns[i] != columns[i - 1]]
    for begin, end in pairwise([0, *ends, len(places)]):
        linked = places[begin].linked
        points = slice(begin if linked else begin + 1, end + 1)
        yield from linearise_keyframes(places[begin:end], states[points], values[points], columns[begin], linked)


def _is(stages: Sequence[Stage], k: int, was: Stage) -> bool:
    """Whether stage k is still the one that was there, perhaps about another point."""
    return k < len(stages) and stages[k].lost is was.lost
