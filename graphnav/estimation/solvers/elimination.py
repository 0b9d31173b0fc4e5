"""A keyframe enters the window in two steps, as in any filter: prediction, and update with late rows.

Prediction stacks the rows of the interval, of stepping parameters, and of measurements given by the interval itself
under the message of the previous keyframe; QR eliminates the variables that only they touch (see
`graphnav.estimation.solvers.stages`). The smoothing gains are final then, because no later row touches the previous
keyframe. A triangle remains, under which a fix adds a few rows: a QR of that shape (LAPACK's tpqrt) costs a fraction of
the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.linalg.lapack import dgeqrf, dtpmqrt, dtpqrt, dtrtri, dtrtrs

from graphnav.core.rotation import Array
from graphnav.core.state import DIM, States
from graphnav.estimation.faults.watch import Watch
from graphnav.estimation.solvers.breakdown import explain_smoother
from graphnav.estimation.solvers.linearise import shift
from graphnav.estimation.solvers.recursion import PASSES
from graphnav.estimation.solvers.stages import Columns, Measured, Message, Place, Stage, count_columns

_BLOCK = 8  # reflectors that tpqrt applies at once


@dataclass(frozen=True)
class Predicted:
    """A keyframe that lacks only its late rows, about a point of its own."""

    before: Message  # the message it was predicted from
    link: Array | None  # whitened rows of the interval
    stage: Stage  # without those rows, and without R z of its message
    top: Array  # (D, D + 1 + tests) which are here, and what tests have beside them


def predict_message(
    before: Message,
    place: Place,
    link: Array | None,
    rows: Sequence[Measured],
    state: States,
    values: Array,
    columns: Columns,
) -> Predicted:
    """Predict the next keyframe from a message, linearised at a point of its own.

    Parameters
    ----------
    link : whitened rows of the interval, as `graphnav.estimation.solvers.stages.Linear` has them.
    rows : measurements without kernels to take in as well.

    Raises
    ------
    EstimationError
        If the rows do not determine what is eliminated: sigmas or units are wrong.
    """
    D0, D, R0 = len(before.z), count_columns(columns), before.R
    gone = [before.columns[s.name] for s in place.steps if s.name in before.columns]
    lost = np.arange(DIM if place.linked else 0)
    if gone:
        lost = np.concatenate([lost, *(np.arange(at.start, at.stop) for at in gone)])
    E = len(lost)
    # where each column of the message goes: to the eliminated ones in front, or to its own place behind them
    to = np.arange(E, E + D0)
    to[lost] = np.arange(E)
    steps, tests = sum(len(s.mean) for s in place.steps), before.tests
    C = 0 if tests is None else tests.X.shape[1]
    linked = 0 if link is None else DIM
    A = np.zeros((D0 + steps + linked + sum(one.b.size for one in rows), E + D + 1 + C), order="F")
    head = A[:, : E + D + 1]
    head[:D0, to], head[:D0, -1] = R0, before.z
    if tests is not None:
        A[:D0, E + D + 1 :] = R0 @ tests.X
    moved = values[: D0 - DIM] - before.values
    for at in gone:
        moved[shift(at)] = 0.0
    if np.any(moved):  # parameters that stay are about the new point's values
        head[:D0, -1] -= R0[:, DIM:] @ moved
    row = D0
    for step in place.steps:
        at = columns[step.name]
        k = len(step.mean)
        own, diagonal, value = np.arange(row, row + k), 1.0 / step.sigma, values[shift(at)]
        head[own, E + np.arange(at.start, at.stop)] = diagonal
        expected = step.mean
        if step.name in before.columns and step.decay:
            old = before.columns[step.name]
            head[own, to[old.start : old.stop]] = -step.decay * diagonal
            expected = step.predict(before.get_value(step.name))
        head[own, -1] = (expected - value) * diagonal
        row += k
    if link is not None:
        head[row : row + DIM, :DIM], head[row : row + DIM, E:] = link[:, :DIM], link[:, DIM:]
        row += DIM
    _fill_rows(head[row:, E:], rows)
    R = dgeqrf(A, overwrite_a=1)[0]
    top = np.asfortranarray(R[E : E + D, E:])
    top[:, :D] *= _mask_upper(D)
    root, info = dtrtri(R[:E, :E]) if E else (np.zeros((0, 0)), 0)
    if info:
        raise explain_smoother(place.t)
    root = root * _mask_upper(E)
    g = np.zeros(D0)
    g[DIM:] = values[: D0 - DIM] - before.values
    G, g[lost], noise = -root @ R[:E, E : E + D], root @ R[:E, E + D], root @ root.T
    if not place.linked:  # no part of the state is eliminated, but it may be about another point later
        G, lost, noise = np.vstack([np.eye(DIM, D), G]), np.append(np.arange(DIM), lost), np.pad(noise, (DIM, 0))
    message = Message(state, values, columns, R[:0, :0], R[0, :0])
    return Predicted(before, link, Stage(place, message, G, g, lost, noise, tuple(rows)), top)


def update_late(ahead: Predicted, rows: Sequence[Measured], weighted: bool = False) -> tuple[Stage, Array]:
    """The stage with its late rows, and the most likely error state (D,).

    Robust rows are weighted at the point if that is an estimate from all data already (`weighted`); otherwise they are
    unweighted at first, then reweighted a few times.

    Raises
    ------
    EstimationError
        If the rows do not determine the state.
    """
    stage, tests, D = ahead.stage, ahead.before.tests, len(ahead.top)
    t = stage.place.t
    robust = any(one.kernel != "none" for one in rows)
    y, first = np.zeros(D), 1 if weighted else 0
    for passes in range(first, first + 1 if weighted or not robust else PASSES):
        top, beside, fault = ahead.top, None, None
        own = [one.weigh(y) for one in rows] if passes else rows
        plain = [one for one in own if tests is None or one.name not in tests]
        if plain:
            tail = np.zeros((sum(one.b.size for one in plain), top.shape[1]))
            _fill_rows(tail[:, : D + 1], plain)
            top, _ = _append_rows(top, tail)
        if tests is not None:
            top, beside, fault = _add_tested_rows(top, tests.copy(), own, t, stage.message.state)
        y, info = dtrtrs(top[:, :D], top[:, D])
        if info:
            raise explain_smoother(t)
    measured = (*stage.measured, *own)
    turns = ahead.before.turns and all(one.turns for one in measured)
    R, z = np.ascontiguousarray(top[:, :D]), top[:, D].copy()
    message = replace(stage.message, R=R, z=z, tests=beside, turns=turns)
    return replace(stage, message=message, measured=measured, fault=fault), y


def _add_tested_rows(
    top: Array, tests: Watch, rows: Sequence[Measured], t: float, state: States
) -> tuple[Array, Watch, tuple[str, float] | None]:
    """Add the measurements that have tests to the rows [R z Z] of a message, Z = R X (D, C)."""
    fault, D, speed = None, len(top), float(np.linalg.norm(state.v))
    for one in rows:
        if one.name not in tests or not one.H.any():  # none of those that are left out
            continue
        own, columns, errors = tests.begin(one.name, t, one.sigma)
        tail = np.zeros((len(errors), top.shape[1]))
        _fill_rows(tail[:, : D + 1], [one])
        tail[:, D + 1 :][:, columns] = errors
        top = top.copy(order="F")
        top[:, D + 1 :][:, own] = 0.0
        top, left = _append_rows(top, tail)
        since = tests.find_onset(one.name, t, left[:, 0], left[:, 1:][:, columns], speed)
        if since is not None and fault is None:
            fault = one.name, since
    tests.take_message(top[:, :D], top[:, D + 1 :])
    return top, tests, fault


def _fill_rows(out: Array, rows: Sequence[Measured]) -> None:
    """Rows of measurements [H b] one below the other, in the first of `out` (n, D + 1)."""
    row, D = 0, out.shape[1] - 1
    for one in rows:
        k = one.b.size
        out[row : row + k, :D], out[row : row + k, D] = one.H.reshape(k, D), one.b.ravel()
        row += k


def _append_rows(top: Array, tail: Array) -> tuple[Array, Array]:
    """Take rows (m, D + n) in under a triangle with columns beside it (D, D + n): the same again, and what is left.

    Left are (m, n) that the states can do nothing about.
    """
    D = len(top)
    out = np.empty(top.shape, order="F")
    out[:, :D], reflectors, T, _ = dtpqrt(0, min(_BLOCK, D), top[:, :D], tail[:, :D])
    out[:, D:], left, _ = dtpmqrt(0, reflectors, T, top[:, D:], tail[:, D:], trans="T")
    return out, left


@cache
def _mask_upper(n: int) -> Array:
    """(n, n) 1 in the upper triangle."""
    return np.asfortranarray(np.triu(np.ones((n, n))))
