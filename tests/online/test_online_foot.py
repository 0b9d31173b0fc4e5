"""A walk as it goes on: the work of a step is spread over rows of the IMU, and what comes out is as if it were not."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from test_online import joined, same

from graphnav.config import parse_settings
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.online import Online, Row, drop_rows, list_rows, steps, walker
from graphnav.online.walker import Walker
from graphnav.recording import Recording
from graphnav.simulation import simulate

QUICK = parse_settings({"solver": {"lag": 4.0}})


@pytest.fixture(scope="module")
def walk() -> Recording:
    return simulate("gait", 1, duration=20.0, rate=100.0).recording


@pytest.fixture(scope="module")
def rows(walk: Recording) -> list[Row]:
    return list_rows(walk)[1]


@pytest.fixture(scope="module")
def undisturbed(walk: Recording, rows: list[Row]) -> Callable[[frozenset[int]], Trajectory]:
    """What comes of the rows in order, without some of them, at as much work a row as is set now."""
    known: dict[tuple[int, frozenset[int]], Trajectory] = {}

    def solve(left: frozenset[int] = frozenset()) -> Trajectory:
        key = Walker.at_a_row, left
        if key not in known:
            known[key] = walked(walk, [row for k, row in enumerate(rows) if k not in left])
        return known[key]

    return solve


def walked(walk: Recording, rows: list[Row]) -> Trajectory:
    online = Online(drop_rows(walk), QUICK)
    for row in rows:
        online.add(row)
    online.finish()
    return joined(online.settled())


def test_a_step_is_spread_over_rows_and_nothing_else_changes(
    walk: Recording, rows: list[Row], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Through a checkpoint while keyframes enter, too; and the state now never goes back to an older keyframe."""
    online, entered, parts, kept, keyframe = Online(drop_rows(walk), QUICK), [], [], False, -np.inf
    for row in rows:
        running, before = online.tracker, 0 if online.tracker is None else online.tracker.newest
        made = 0 if running is None else len(running.window)
        online.add(row)
        tracker = online.tracker
        if running is tracker and isinstance(tracker, Walker):
            if tracker.newest > before and len(tracker.window) > made:
                entered.append(len(tracker.window) - made)
            if tracker.busy:
                now = online.live()
                assert now is not None
                assert now.t == row[1]
                assert now.keyframe >= keyframe
                keyframe = now.keyframe
                if not kept and tracker.settled == [] and len(entered) > 20:
                    online, kept = pickle.loads(pickle.dumps(online)), True
        parts += online.settled()
    online.finish()
    assert kept
    assert max(entered) <= walker._ENTERING
    monkeypatch.setattr(walker, "_ENTERING", 1000)
    same(joined([*parts, *online.settled()]), walked(walk, rows))


def test_rows_that_are_left_out_leave_no_trace(
    walk: Recording, rows: list[Row], undisturbed: Callable[..., Trajectory]
) -> None:
    """Not even of which row does what: linearised again at others, a window whose heading is open ends elsewhere."""
    spoilt: list[Row] = []
    for k, row in enumerate(rows):
        t = row[1]
        spoilt.append(row)
        if k % 7 == 3:
            spoilt.append(row)
        elif k % 50 == 20:
            spoilt.append(("imu", t + 0.003, (0.0, 0.0, (1e6, 1e300, -80.0)[k // 50 % 3], 0.0, 0.0, 9.8)))
        elif k % 50 == 45:
            spoilt.append(("imu", t + 1e6, (0.0,) * 6))
        elif k % 50 == 5:
            spoilt.append(("odometer", t, ((1e300, 1.5)[k // 50 % 2], *(float("nan"),) * 5)))  # of none that it has
    one, other = walked(walk, spoilt), undisturbed()
    for name in ("t", "llh", "v", "rph", "sd_p"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("by", [3, 90])
def test_rows_of_the_imu_that_come_late_leave_no_trace(
    walk: Recording,
    rows: list[Row],
    undisturbed: Callable[..., Trajectory],
    by: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The very first, too, and those at which a look is due, as long as none of the keyframes needed them.

    There is work to do at every row, and which is done at which does not change.
    """
    monkeypatch.setattr(Walker, "at_a_row", 1)
    late = list(range(0 if by == 3 else 700, len(rows) - by, 97 if by == 3 else 151))
    late += [k for k, row in enumerate(rows) if round(row[1], 6) in (10.0, 12.5)]
    order = sorted(range(len(rows)), key=lambda k: k + by + 0.5 if k in late else k)
    assert order != sorted(order)
    one, other = walked(walk, [rows[k] for k in order]), undisturbed()
    for name in ("t", "llh", "v", "rph", "sd_p"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("side", [-1, 1])
def test_a_row_beside_a_gap_that_comes_late_leaves_no_trace(
    walk: Recording,
    rows: list[Row],
    undisturbed: Callable[..., Trajectory],
    side: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A gap is longer by a row until that comes: as much is done in it, and looks that fall into it are made."""
    monkeypatch.setattr(Walker, "at_a_row", 1)
    gaps = [(700 + 161 * k, 9 + 20 * (k % 3)) for k in range(7)]  # of a tenth to half a second
    left = frozenset(k for first, count in gaps for k in range(first, first + count))
    late = {first - 1 if side < 0 else first + count for first, count in gaps}
    kept = [k for k in range(len(rows)) if k not in left]
    order = sorted(kept, key=lambda k: k + 60.5 * (k in late))
    assert order != kept
    one, other = walked(walk, [rows[k] for k in order]), undisturbed(left)
    for name in ("t", "llh", "v", "rph", "sd_p"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_what_is_over_is_not_searched_for_slides_and_the_rest_is_as_it_was(walk: Recording) -> None:
    spans = detect(walk).stationary
    since = walk.start + 10.0
    late = detect(walk, since=since).stationary
    np.testing.assert_array_equal(late[late[:, 1] > since], spans[spans[:, 1] > since])
    assert len(late) == len(spans)


def test_a_row_that_comes_late_has_the_steps_redone_that_are_seen_otherwise_with_it(
    walk: Recording, rows: list[Row], undisturbed: Callable[..., Trajectory], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stances of a second before it rest on it, too: by a threshold that is told by all rows."""
    seen, real = [], steps.detect

    def detect_otherwise(recording: Recording, *more: object) -> SimpleNamespace:
        spans = real(recording, *more).stationary.copy()
        if np.diff(recording.imu.t).max() > 0.015:  # of 0.01 s between rows
            seen.append(recording.end)
            spans[-1, 0] -= 0.01
        return SimpleNamespace(stationary=spans)

    monkeypatch.setattr(steps, "detect", detect_otherwise)
    late = list(rows)
    for k in range(711, 1700, 133):
        late.insert(k + 59, late.pop(k))
    track = walked(walk, late)
    plain = undisturbed()
    assert seen
    np.testing.assert_array_equal(track.t, plain.t)
    np.testing.assert_allclose((track.llh - plain.llh) * [6.4e6, 6.4e6, 1.0], 0.0, atol=1e-4)  # solved again
