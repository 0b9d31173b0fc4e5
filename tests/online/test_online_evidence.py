"""Wrong fixes of a running drive: evidence decides, on the rows of a noise estimate, and on a window."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import at_rate

from graphnav import load
from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.estimation.faults.watch import Watch
from graphnav.online import Online, drop_rows, list_rows, smoother
from graphnav.online.judgement import WindowJudge
from graphnav.recording import Recording
from graphnav.recording.plausibility.filled import find_filled

_JUDGE = {"holds": WindowJudge.holds, "look": WindowJudge.look}


def without_filled_rows(recording: Recording) -> Recording:
    """As if the logger had lost rows of the IMU, and none of the fixes meanwhile."""
    imu = recording.imu
    measured = ~find_filled(imu.t, np.hstack([imu.gyro, imu.accel]).T)[0]
    return replace(recording, imu=replace(imu, t=imu.t[measured], gyro=imu.gyro[measured], accel=imu.accel[measured]))


def test_no_right_fix_is_left_out_that_the_noise_model_was_estimated_from() -> None:
    """Gaps of a second and a half in the IMU, and outages: the filter's tests by themselves leave out 27 fixes."""
    recording = load("kitti").crop(82.0, 262.0)
    for span in ((40.0, 60.0), (140.0, 160.0)):
        recording = recording.without("gnss", span)
    online = Online(drop_rows(recording))
    for row in list_rows(recording)[1]:
        online.add(row)
    online.finish()
    assert online.tracker is not None
    assert np.isfinite(online.tracker.judged)
    assert online.excluded == ()


def test_what_fills_a_gap_of_the_imu_is_not_taken_for_a_fault_of_the_fixes_behind_it() -> None:
    """The noise model of the first seconds, and a gap of a second and a half behind them, in which fixes are used."""
    recording = without_filled_rows(load("kitti")).crop(171.4, 222.4).without("gnss", (40.0, 60.0))
    online, left_out = Online(drop_rows(recording)), set()
    for row in list_rows(recording)[1]:
        online.add(row)
        left_out |= {span for span in online.excluded if span.count > 1}
    assert online.tracker is not None
    assert online.tracker.noise.figures
    assert not left_out


@pytest.mark.parametrize(("every", "lost"), [(13, 1), (100, 50)])
def test_wrong_fixes_are_found_where_the_imu_loses_rows(every: int, lost: int) -> None:
    """Several a second, as a motorbike's logger does, or half a second: what is filled in explains no 30 m."""
    recording = load("kitti").crop(309.8, 348.8)
    imu, gnss = recording.imu, recording.gnss
    assert gnss is not None
    kept = np.arange(len(imu.t)) % every >= lost
    imu = replace(imu, t=imu.t[kept], gyro=imu.gyro[kept], accel=imu.accel[kept])
    frame, off = LocalFrame(gnss.llh[0]), (gnss.t > recording.start + 36.0) & (gnss.t < recording.start + 38.0)
    gnss = replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + off[:, None] * np.array([10.0, 30.0, 0.0])))
    online = Online(drop_rows(recording))
    for row in list_rows(replace(recording, imu=imu, gnss=gnss))[1]:
        online.add(row)
    (fault,) = online.excluded
    assert (fault.kind, fault.t_start, fault.t_end) == ("gnss_position", gnss.t[off][0], gnss.t[off][-1])


def test_right_fixes_are_used_again_soon_that_wrong_ones_shut_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two wrong ones lead heading and speed astray."""
    recording = load("kitti").crop(309.8, 365.8)
    gnss = recording.gnss
    assert gnss is not None
    frame, off = LocalFrame(gnss.llh[0]), (gnss.t > recording.start + 36.0) & (gnss.t < recording.start + 38.0)
    wrong = replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + off[:, None] * np.array([10.0, 30.0, 0.0])))
    until, find = gnss.t[off][-1], Watch.find_onset
    monkeypatch.setattr(Watch, "find_onset", lambda self, name, t, *a: (None, find(self, name, t, *a))[int(t > until)])
    online, shut_out = Online(drop_rows(recording), parse_settings({"vehicle": {"nhc": True}})), 0
    for row in list_rows(replace(recording, gnss=wrong))[1]:
        online.add(row)
        if online.tracker is not None:
            shut_out = max([shut_out, *(fault.count for fault in online.excluded if fault.t_start > until)])
    online.finish()
    (fault,) = online.excluded
    assert shut_out >= 4
    assert (fault.t_start, fault.t_end) == (gnss.t[off][0], until)


@pytest.mark.parametrize("engine", ["window", "isam2"])
def test_sigmas_at_once_are_true_behind_a_gap_of_the_imu_in_an_outage(engine: str) -> None:
    """A second and a half in a turn: whole Gauss-Newton steps swing by degrees, and each makes sigmas smaller."""
    squares = collect_squares(load("kitti").crop(161.4, 230.5), (50.0, 70.0), 56.0, engine)
    assert len(squares) > 4
    assert np.mean(squares) < 10.0  # fixes are off, too; by whole steps 19


def test_sigmas_at_once_are_true_in_an_outage_soon_after_the_start() -> None:
    """Noise is estimated of 35 keyframes at 33 s, and that takes no quarter of a minute: as stated they are 16."""
    squares = collect_squares(load("kitti").crop(309.8, 358.8), (40.0, 60.0), 41.0)
    assert len(squares) > 4
    assert np.mean(squares) < 5.0


def collect_squares(whole: Recording, outage: tuple[float, float], since: float, engine: str = "window") -> list[float]:
    """Squared distances in sigmas, by number, of what is known at once from the fixes withheld, from `since` on, s."""
    recording, squares = whole.without("gnss", outage), []
    online, newest = Online(drop_rows(recording), parse_settings({"vehicle": {"nhc": True}}), engine), -np.inf
    assert whole.gnss is not None
    for row in list_rows(recording)[1]:
        online.add(row)
        tracker = online.tracker
        if tracker is None or tracker.newest <= newest:
            continue
        newest, message = tracker.newest, tracker.window.newest
        k = int(np.argmin(np.abs(whole.gnss.t - newest)))
        if newest > recording.start + since and abs(whole.gnss.t[k] - newest) < 0.02:
            off = message.state.p[0] - tracker.frame.from_llh(whole.gnss.llh[k][None])[0]
            squares.append(float(off @ np.linalg.solve(message.covariance[3:6, 3:6], off)) / 3.0)
    return squares


def play(recording: Recording) -> Online:
    """Without another estimate of the noise model than that from the rows of the alignment."""
    online = Online(drop_rows(recording), parse_settings({"gnss": {"velocity": False}, "solver": {"lag": 60.0}}))
    for row in list_rows(recording)[1]:
        online.add(row)
    online.finish()
    assert not online.failures
    return online


@pytest.fixture
def recording(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> Recording:
    monkeypatch.setattr(smoother, "are_enough", lambda *_: True)
    return at_rate(load(shared_data / "oracle_drive").crop(50.0, 230.0), 25.0)


def test_right_fixes_that_tests_leave_out_are_used_before_anything_settles_without_them(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin, end = recording.start + 100.5, recording.start + 110.5
    find = Watch.find_onset
    monkeypatch.setattr(
        Watch,
        "find_onset",
        lambda self, name, t, *a: begin if name == "gnss_position" and begin < t < end else find(self, name, t, *a),
    )
    monkeypatch.setattr(WindowJudge, "holds", lambda *_: False)
    monkeypatch.setattr(WindowJudge, "look", lambda *_, **__: None)
    assert sum(fault.count for fault in play(recording).excluded) >= 10
    for name in ("holds", "look"):
        monkeypatch.setattr(WindowJudge, name, _JUDGE[name])
    assert play(recording).excluded == ()


def test_wrong_fixes_stay_left_out(recording: Recording) -> None:
    gnss, wrong = recording.gnss, (100.5, 110.5)
    assert gnss is not None
    frame, t = LocalFrame(gnss.llh[0]), gnss.t - recording.start
    p = frame.from_llh(gnss.llh) + ((t > wrong[0]) & (t < wrong[1]))[:, None] * np.array([6.0, -3.0, 2.0])
    online = play(replace(recording, gnss=replace(gnss, llh=frame.to_llh(p))))
    (fault,) = online.excluded
    np.testing.assert_allclose([fault.t_start, fault.t_end], recording.start + np.array(wrong), atol=1.0)
