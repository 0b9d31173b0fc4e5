"""Fixed-lag window over the newest keyframes: exact smoothing with bounded time and memory.

Keyframes enter one by one (`graphnav.estimation.solvers.stages`); the newest message corresponds to a filter's
estimate. Means and covariances are smoothed backwards through the stages (Rauch, Tung, Striebel in information form). A
keyframe older than the lag is marginalised: its state is settled, and the message after it is the marginal of all the
past. Where a state has moved too far from its linearisation point, the stages from there on are rebuilt about the
smoothed states: Gauss-Newton on the window. A late measurement does the same from its own time on. With a lag longer
than the drive this is the batch solution.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.faults.watch import Watch
from graphnav.estimation.solvers.elimination import Predicted, predict_message, update_late
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.points import move_covariance
from graphnav.estimation.solvers.revision import Relaxation, Renewed, Renewing, Revision
from graphnav.estimation.solvers.stages import (
    Columns,
    Message,
    Place,
    Stage,
    add_error,
    count_columns,
    forget_rows,
    linearise_keyframes,
    pad,
    predict_stage,
)
from graphnav.estimation.solvers.turning import split_turn, turn_covariance
from graphnav.recording import ImuNoise

# share of the noise of a second's force that a neglected turn may cause: as it is systematic, it accumulates
_NOISE_SHARE = 0.01
_G = 9.8  # m/s^2
_DELAY = 0.02  # s, of a delay: 1 mm where speed is known to 5 cm/s
_MAX_RELINEARISATIONS = 5
ALMOST = 0.3  # share of the limits from which stages are relinearised along with those beyond them
_LIMITS = {"rad": 1e-2, "s": _DELAY}


@dataclass(frozen=True)
class SettledStates:
    """Settled keyframes: smoothed states, covariances, and parameters."""

    t: Array  # (n,)
    states: States
    covariance: Array  # (n, 15, 15)
    columns: tuple[Columns, ...]
    values: tuple[Array, ...]  # (D-15,) each
    sigma: tuple[Array, ...]  # (D-15,) each

    def __len__(self) -> int:
        return len(self.t)


class Leaving(Protocol):
    """The first `count` stages of a window, to be settled: their covariances come in portions."""

    count: int

    def step(self, most: int) -> bool:
        """Go on, over at most so many stages; True once all covariances are known."""

    def settle(self) -> SettledStates:
        """As they are known now, with what is left of the covariances all at once."""


class _Covariances:
    """The first stages of a window, with covariances smoothed back from the newest one."""

    def __init__(self, window: Window, count: int) -> None:
        self.count, self._window, self._stages = count, window, list(window.stages)
        self._P = window.newest.covariance
        self._found: list[Array] = []  # (D, D), the last first

    def step(self, most: int) -> bool:
        """As of `Leaving`."""
        for _ in range(most):
            if len(self._found) == self.count:
                break
            stage = self._stages.pop()
            if len(self._stages) < self.count:
                self._found.append(self._P)
            if self._stages:
                self._P = stage.predict_before(self._P)
        return len(self._found) == self.count

    def settle(self) -> SettledStates:
        """As of `Leaving`."""
        self.step(len(self._stages))
        gone, means = self._window.stages[: self.count], self._window.compute_means()[1 : self.count + 1]
        states, turns = States.stack([stage.message.state for stage in gone]), gone[-1].message.turns
        moved, found = np.array([e[:DIM] for e in means]), self._found[::-1]
        covariance = np.array([P[:DIM, :DIM] for P in found])
        return SettledStates(
            t=np.array([stage.place.t for stage in gone]),
            states=add_error(states, moved, turns),
            covariance=turn_covariance(covariance, states, moved) if turns else move_covariance(covariance, moved),
            columns=tuple(stage.message.columns for stage in gone),
            values=tuple(stage.message.values + e[DIM:] for stage, e in zip(gone, means, strict=True)),
            sigma=tuple(np.sqrt(np.maximum(np.diagonal(P)[DIM:], 0.0)) for P in found),
        )


class Window:
    """The newest keyframes of a drive.

    Parameters
    ----------
    prior : message on the first keyframe before any measurement, from `make_first_message`.
    turn : rad that an attitude may move before rows are linearised anew, from `compute_turn_limit`.
    """

    solver: ClassVar[str] = "incremental"  # of a recording's keyframes, by this window
    smoothed: ClassVar[int] = sys.maxsize  # stages over which covariances are smoothed at once, at most

    def __init__(self, prior: Message, turn: float) -> None:
        self.turn = turn
        self.head = prior  # information before the first stage
        self.stages: list[Stage] = []
        self.relinearized = 0  # stages made anew
        self._limit: tuple[Columns, Array] = {}, np.empty(0)
        self._leaving: Leaving | None = None  # stages to be settled
        self._means: list[Array] | None = None
        self._revision: Revision | None = None
        self._rounds = 0  # of it
        self._relaxation = Relaxation()  # of these, and of earlier ones while they do not converge

    def __len__(self) -> int:
        return len(self.stages)

    @property
    def newest(self) -> Message:
        """The message of the newest keyframe: the live estimate is its point."""
        return self.stages[-1].message if self.stages else self.head

    @property
    def t(self) -> Array:
        """Times of the keyframes in the window, s."""
        return np.array([stage.place.t for stage in self.stages])

    def select_since(self, t: float) -> list[Stage]:
        """The stages from a time on."""
        first = len(self.stages)
        while first and self.stages[first - 1].place.t >= t:
            first -= 1
        return self.stages[first:]

    def expect(self, place: Place) -> Predicted:
        """Predict a keyframe, linearised at its prediction, with the rows that are available already."""
        state, values, columns, link = predict_stage(self.newest, place)
        rows = linearise_keyframes([place], state, [values], columns, linked=False, late=False)[0].measured
        return predict_message(self.newest, place, link, rows, state, values, columns)

    def push(self, place: Place, ahead: Predicted | None = None) -> float:
        """Add a keyframe; returns by how much its measurements turned it, rad.

        `ahead` is its prediction after the newest keyframe, if prepared already: only late rows are then added.
        """
        ahead = self.expect(place) if ahead is None else replace(ahead, stage=replace(ahead.stage, place=place))
        message = ahead.stage.message
        point = [place], message.state, [message.values], message.columns
        stage, e = update_late(ahead, linearise_keyframes(*point, linked=False, late=True)[0].measured)
        self._append(ahead, stage, e)
        turn = split_turn(stage.message.state, e[None])[1][0] if stage.message.turns else e
        return float(np.linalg.norm(turn[:3]))

    def _append(self, ahead: Predicted, stage: Stage, e: Array) -> None:
        """Append a keyframe with all its rows, about its prediction, and moved by the most likely error state (D,)."""
        self.stages.append(stage.move(e))
        self._means = None
        columns = stage.message.columns
        if columns != self._limit[0]:
            self._limit = columns, find_parameter_limits(columns, stage.place)

    def watch(self, tests: Watch) -> None:
        """Start testing fixes, from the next keyframe on."""
        if self.stages:
            newest = self.stages[-1]
            self.stages[-1] = replace(newest, message=replace(newest.message, tests=tests))
        else:
            self.head = replace(self.head, tests=tests)

    def forget_tests(self) -> None:
        """Clear the tests' memory of fixes before the window, which is no longer valid."""
        if self.head.tests is not None:
            self.head = replace(self.head, tests=self.head.tests.forget_onsets())

    def truncate(self, keep: int) -> None:
        """Remove all but the first `keep` stages, because something before the others has changed."""
        if keep >= len(self.stages):
            return
        del self.stages[keep:]
        self._means = self._leaving = None
        self._centre_newest()

    def _centre_newest(self) -> None:
        """Have the newest message about what is most likely."""
        if self.stages:
            self.stages[-1] = self.stages[-1].move(self.newest.estimate)
        else:
            self.head = self.head.move(self.head.estimate)

    def replace_from(self, first: int, before: Message, stage: Stage | None, stages: Sequence[Stage]) -> None:
        """Replace the stages from one on, the message before them, and its stage if it has one."""
        if stage is None:
            self.head = replace(before, tests=self.head.tests)
        else:
            tests = self.stages[first - 1].message.tests
            self.stages[first - 1] = replace(stage, message=replace(before, tests=tests))
        self.stages[first:] = stages
        if stages:
            self._centre_newest()
        self._means = self._leaving = None
        self.relinearized += len(stages)

    def compute_means(self) -> list[Array]:
        """Smoothed error states, one of the message before the window and one of each stage."""
        if self._means is None:
            e = self.newest.estimate
            out = [e]
            for stage in reversed(self.stages):
                e = stage.smooth_back(e)
                e += stage.g
                out.append(e)
            self._means = out[::-1]
        return self._means

    def read_states(self) -> States:
        """Smoothed states, one of each stage."""
        points, e = States.stack([stage.message.state for stage in self.stages]), self.compute_means()[1:]
        return add_error(points, np.array([one[:DIM] for one in e]), self.newest.turns)

    def smooth_back(self, count: int, most: int) -> bool:
        """A portion of `settle` for the first stages, over at most so many; True once it is done.

        Keyframes that arrive meanwhile do not count; when some are removed, it starts again.
        """
        if self._leaving is None:
            self._leaving = self._begin_leaving(count)
        return self._leaving.step(min(most, self.smoothed))

    def _begin_leaving(self, count: int) -> Leaving:
        return _Covariances(self, count)

    @property
    def leaving(self) -> int:
        """Number of stages that `smooth_back` is working on, 0 if it has not started."""
        return 0 if self._leaving is None else self._leaving.count

    def settle(self, count: int) -> SettledStates:
        """Smooth the window and marginalise its first `count` stages, 1 or more."""
        started = self._leaving
        settled = (started if started and started.count == count else self._begin_leaving(count)).settle()
        self._revision, self._leaving, self._means, self._rounds = None, None, None, 0
        self._relaxation = Relaxation()
        self.head = self.stages[count - 1].message
        del self.stages[:count]
        self._marginalise(count)
        return settled

    def _marginalise(self, count: int) -> None:
        if not self.stages:
            self._centre_newest()

    # ------------------------------------------------------------------------------------------ linearising again
    def find_first_moved(self, share: float = 1.0, almost: float = 1.0) -> int | None:
        """The first stage whose point is `almost` as far from the smoothed state as a share of its limit, if any is
        further than that; else None.
        """
        moves = self._find_moves()
        return int(np.argmax(moves > almost * share)) if np.any(moves > share) else None

    def needs_revision(self, share: float, count: int) -> bool:
        """Whether `revise`, with that share of the limits, is to do anything before the first `count` stages settle."""
        return self.find_first_moved(share) is not None

    def _find_moves(self) -> Array:
        """(n,) how far the smoothed states are from their points, 1 at the limit."""
        means, limit = self.compute_means()[1:], self._limit[1]
        if not means:
            return np.empty(0)
        e = pad(means, max(len(x) for x in means))
        turn = self._measure_turns(e) / self.turn
        return np.maximum(turn, np.abs(e[:, DIM:] / limit[: e.shape[1] - DIM]).max(axis=1, initial=0.0))

    def _measure_turns(self, e: Array) -> Array:
        """(n,) rad, how far attitudes move by e (n, D) from where their rows are linearised.

        Of rotations about the vertical only the change since the previous keyframe counts, where the heading is
        unobservable.
        """
        if not self.newest.turns:
            return np.asarray(np.linalg.norm(e[:, :3], axis=1))
        psi, left = split_turn(States.stack([stage.message.state for stage in self.stages]), e)
        before = split_turn(self.head.state, self.compute_means()[0][None])[0]
        beside = psi + [stage.psi for stage in self.stages] - np.concatenate([before, psi[:-1]])
        return np.hypot(np.linalg.norm(left[:, :3], axis=1), beside)

    def converge(self, share: float = 1.0, always: bool = False, renewed: Renewed | None = None) -> None:
        """Relinearise until nothing has moved.

        Parameters
        ----------
        share : of the usual limits.
        always : once at least.
        renewed : returns the places of stages between two indices, where these no longer hold their rows.
        """
        self._revision, self._rounds = None, 0
        while self.revise(len(self), renewed, always, share):
            pass

    def linearise_at(self, means: Sequence[Array]) -> None:
        """Have `revise` begin with error states that are given, one of each stage: where filter and smoother may have
        gone astray, another estimate knows better.
        """
        self._revision, self._rounds = Revision(self, 0, [np.zeros(len(self.head.z)), *means]), 0

    @property
    def revising(self) -> bool:
        """Whether `revise` is in progress."""
        return self._revision is not None or self._rounds > 0

    def revise(self, count: int, renewed: Renewing | None, always: bool = False, share: float = 1.0) -> bool:
        """A portion of `converge`, of at most so many stages; False once there is nothing left to do.

        Keyframes may be added and removed before the next portion; rebuilt stages of removed ones are discarded.
        """
        if self._revision is None:
            first = 0 if always and not self._rounds else self.find_first_moved(share, ALMOST)
            if first is None or self._rounds == _MAX_RELINEARISATIONS:
                if first is None:
                    self._relaxation = Relaxation()
                self._rounds = 0
                return False
            step = np.array([e[:3] for e in self.compute_means()[1:]])
            step[:first] = 0.0
            self._rounds += 1
            self._revision = Revision(self, first, share=self._relaxation.find_share(step))
        if self._revision.step(count, renewed):
            self._revision = None
        else:
            forget_rows(self._revision.made)
        return True


def compute_turn_limit(noise: ImuNoise) -> float:
    """How far an attitude may move (rad) before rows are linearised anew.

    The neglected second-order term of a turn a is a^2/2 of the force: a^2/2 g in a second, compared with the noise.
    """
    return float(np.clip(np.sqrt(2.0 * _NOISE_SHARE * noise.accel_noise_density / _G), 3e-4, 1e-2))


def make_first_message(state: States, sigma: Array, turns: bool = False) -> Message:
    """A prior: one state and its fifteen sigmas; `turns` as of `Message`."""
    return Message(state, np.zeros(0), {}, np.diag(1.0 / sigma), np.zeros(DIM), turns=turns)


def find_parameter_limits(columns: Columns, place: Place) -> Array:
    """(D-15,) how far each parameter may move before rows are linearised anew; infinite where nothing limits it."""
    assert place.problem is not None
    parameters, limit = place.problem.parameters, np.full(count_columns(columns) - DIM, np.inf)
    for name, at in columns.items():
        if name in parameters:
            limit[shift(at)] = _LIMITS.get(parameters[name].unit, np.inf)
    return limit
