"""Fixes that are wrong where a drive begins: at rest, in the first motion, from before the first fix on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import at_rate
from test_faults import left_out, moved

from graphnav import load
from graphnav.config import Settings
from graphnav.constraints.vehicle import MOUNTING
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.notes import get_key
from graphnav.core.state import States
from graphnav.core.trajectory import Trajectory
from graphnav.detectors import detect
from graphnav.estimation import joint_estimate
from graphnav.estimation.alignment import Alignment, align
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.alignment.motion import drop_implausible, find_motion_span
from graphnav.estimation.faults.verdicts import Verdicts
from graphnav.estimation.noise.words import describe_turned_axes
from graphnav.estimation.pipeline import choose_origin, run
from graphnav.estimation.solvers.linearise import Points
from graphnav.evaluation.scoring import Errors, compute_errors
from graphnav.online import Online, drop_rows, list_rows
from graphnav.recording import Recording
from graphnav.recording.formats.axes import parse_axes_letters

HERE = Path(__file__).resolve().parents[2]
STATED = Settings.model_validate({"noise": {"mode": "stated"}})


@pytest.fixture(scope="module")
def drive(shared_data: Path) -> Recording:
    """It stands for 39 s, and again from 79 to 104 s; fixes of 2 cm."""
    return at_rate(load(shared_data / "oracle_drive").crop(50.0, 165.0), 25.0)


def shifted(recording: Recording, begin: float, end: float, by: float, each: float = 0.0) -> Recording:
    """The recording with the fixes between two times `by` m too far north, and `each` m more every second."""
    assert recording.gnss is not None
    t = recording.gnss.t - recording.start
    bad = (t > begin) & (t < end)
    return moved(recording, bad, np.outer(by + each * (t[bad] - begin), [0.0, 1.0, 0.0]))


def against_truth(track: Trajectory, recording: Recording) -> Errors:
    truth = recording.truth
    assert truth is not None
    return compute_errors(track, Trajectory(truth.t, truth.llh, v=truth.v, rph=truth.rph))


@pytest.mark.parametrize(
    ("begin", "end", "by"),
    [
        (10.0, 30.0, 40.0),
        (-1.0, 20.0, 40.0),
        (35.0, 60.0, 200.0),
    ],
    ids=["at rest", "from the first fix on", "in the first motion"],
)
def test_a_start_rests_on_no_fix_that_is_wrong(drive: Recording, begin: float, end: float, by: float) -> None:
    wrong = shifted(drive, begin, end, by)
    solution = run(wrong, None, ("batch",))["batch"]
    found = against_truth(solution.trajectory(), drive)
    assert found.horizontal.max() < 0.15  # 0.03 m without the fault
    assert np.nanmean(found.nees_p) / 3.0 < 2.0
    assert wrong.gnss is not None
    t = wrong.gnss.t - wrong.start
    bad, out = (t > begin) & (t < end), left_out(solution, wrong)
    assert np.array_equal(out, bad)


def test_fixes_that_jump_at_rest_are_no_motion(drive: Recording) -> None:
    """The attitude comes from the same stretch as without the jump, and is the same."""
    settings, frame = Settings(), LocalFrame(choose_origin(drive))

    def aligned(recording: Recording) -> Alignment:
        return align(recording, settings, frame, detect(recording, settings).stationary)

    plain, jumped = aligned(drive), aligned(shifted(drive, 10.0, 30.0, 40.0))
    assert jumped.motion == plain.motion
    np.testing.assert_allclose(jumped.rph, plain.rph, atol=1e-9)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_what_grows_in_the_midst_of_a_stop_is_no_motion(drive: Recording, speed: float) -> None:
    grown = detect(shifted(drive, 10.0, 30.0, 0.0, speed)).stationary
    np.testing.assert_allclose(grown, detect(drive).stationary, atol=0.2)


def test_a_filter_that_began_with_wrong_fixes_gives_them_up() -> None:
    t = np.arange(100.0)
    used = np.ones(100)
    verdicts = Verdicts({"p": t}, {"p": used})
    for k in range(20, 100):  # twenty agree with each other, and none of the others with them
        at = verdicts.settle("p", t[k], t[k])
        if at != t[k]:
            break
    assert t[k] == 81.0  # once that has lasted for more than a minute
    assert at == 0.0
    assert not used[:20].any()
    assert used[20:].all()


@pytest.mark.parametrize(("right", "first"), [(20, True), (30, False)])
def test_at_the_end_what_is_refused_is_tried_if_it_is_more(right: int, first: bool) -> None:
    t, used = np.arange(50.0), np.ones(50)
    used[right:] = 0.0
    verdicts = Verdicts({"p": t}, {"p": used})
    assert verdicts.set_ended() == (0.0 if first else None)
    assert used[:right].any() != first
    assert verdicts.set_ended() is None  # once


def test_as_it_drives_a_jump_at_rest_is_no_motion(drive: Recording) -> None:
    wrong = shifted(drive.crop(0.0, 80.0), 10.0, 30.0, 40.0)
    online = Online(drop_rows(wrong), Settings())
    for row in list_rows(wrong)[1]:
        online.add(row)
    online.finish()
    found = [against_truth(part, drive) for part in online.settled() if len(part) > 1]
    assert max(one.horizontal.max() for one in found) < 0.1


def test_a_filter_that_would_diverge_without_fixes_begins_with_them() -> None:
    part = load("kitti").crop(195.5, 429.5)  # by figures not estimated yet, tests leave out a quarter of right fixes
    settings = Settings.model_validate(
        {"vehicle": {"nhc": False}, "standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False}}
    )
    solution = run(part, settings, ("rts",))["rts"]
    assert left_out(solution, part).mean() < 0.05


def test_what_breaks_down_while_noise_is_estimated_is_solved_as_stated(
    drive: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_down(*_: object, **__: object) -> None:
        raise EstimationError("the filter's covariance broke down", key="solver.breakdown")

    plain = {"noise": {"mode": "stated"}, "standstill": {"held_position": False}}
    stated = run(drive, Settings.model_validate(plain), ("ekf",))["ekf"]
    monkeypatch.setattr(joint_estimate, "estimate_without_faults", break_down)
    solution = run(drive, None, ("ekf",))["ekf"]
    assert "noise.not_estimated" in map(get_key, solution.notes)
    np.testing.assert_array_equal(solution.covariance, stated.covariance)


def test_axes_that_are_a_quarter_turn_off_are_told(shared_data: Path) -> None:
    slow = load(shared_data / "canada_rover").crop(0.0, 200.0)  # its accelerations are felt to the left of its course
    assert slow.gnss is not None
    slow = replace(slow, gnss=pick_fixes(slow.gnss, np.arange(0, len(slow.gnss.t), 20)))  # one a second
    solution = run(slow, STATED, ("rts",))["rts"]
    (told,) = (note for note in solution.notes if get_key(note) == "doubt.axes")
    assert '"RBD"' in told  # of FRD, as its description has it
    quarter = parse_axes_letters("RBD") @ parse_axes_letters("FRD").T
    imu = replace(slow.imu, gyro=slow.imu.gyro @ quarter.T, accel=slow.imu.accel @ quarter.T)
    turned = run(replace(slow, imu=imu), STATED, ("rts",))["rts"]
    assert "doubt.axes" not in map(get_key, turned.notes)
    assert slow.truth is not None
    assert slow.truth.rph is not None
    track = turned.trajectory()
    off = np.interp(slow.truth.t, track.t, np.unwrap(track.rph[:, 2])) - np.unwrap(slow.truth.rph[:, 2])
    assert abs(np.degrees(np.angle(np.mean(np.exp(1j * off))))) < 10.0


@pytest.mark.parametrize(("side_slip", "told"), [(0.1, True), (1.0, False)])
def test_axes_are_no_matter_of_what_drifts(side_slip: float, told: bool) -> None:
    """A mounting found a quarter turn off, of a car that travels along those axes, and of a boat that does not."""
    mounting = SimpleNamespace(
        parameter=SimpleNamespace(name=MOUNTING), mean=np.zeros((1, 2)), sigma=np.full((1, 2), np.radians(6.0))
    )
    imu = SimpleNamespace(R_bs=np.eye(3))
    problem = SimpleNamespace(chains=[mounting], columns={MOUNTING: slice(15, 17)}, recording=SimpleNamespace(imu=imu))
    rng, n = np.random.default_rng(1), 500
    v = np.stack([3.0 + 0.5 * rng.standard_normal(n), 3.0 * side_slip * rng.standard_normal(n), np.zeros(n)], axis=-1)
    states = States(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), v, np.zeros((n, 3)), np.zeros((n, 3)))
    smoothed = Points(states, np.tile([0.0, -0.5 * np.pi], (n, 1)))
    found = describe_turned_axes(problem, smoothed)  # type: ignore[arg-type]
    assert (found is not None) == told


def test_fixes_thousands_of_sigmas_off_leave_a_start() -> None:
    """A tenth of the fixes off by 100 m at centimetres stated: a filter that uses them ends in overflow."""
    clean = load(HERE / "data" / "tokyo").crop(0.0, 60.0)
    assert clean.gnss is not None
    rng, frame = np.random.default_rng(3), LocalFrame(clean.gnss.llh[0])
    wrong = rng.random(len(clean.gnss.t)) < 0.1
    moved = frame.from_llh(clean.gnss.llh) + 100.0 * wrong[:, None] * rng.standard_normal((len(wrong), 3))
    gnss = replace(clean.gnss, llh=frame.to_llh(moved), sd=0.3 * clean.gnss.sd)
    tracks = [run(one, solvers=("rts",))["rts"].trajectory() for one in (replace(clean, gnss=gnss), clean)]
    _, damaged, undamaged = np.intersect1d(*(np.round(track.t, 3) for track in tracks), return_indices=True)
    apart = frame.from_llh(tracks[0].llh[damaged]) - frame.from_llh(tracks[1].llh[undamaged])
    assert np.max(np.linalg.norm(apart, axis=1)) < 0.2  # as far as the nine tenths place it


@pytest.mark.parametrize("end", [0, -1])
def test_the_first_and_the_last_fix_can_be_outliers(end: int) -> None:
    """A car that pulls away at 4 m/s^2 keeps all of its fixes, but for one at the end that is 50 m off."""
    drive = load(HERE / "data" / "tokyo").crop(0.0, 20.0)
    gnss = drive.gnss
    assert gnss is not None
    gnss = pick_fixes(gnss, np.arange(0, len(gnss.t), 5))
    frame, s = LocalFrame(gnss.llh[0]), 2.0 * (gnss.t - gnss.t[0]) ** 2
    straight = np.outer(s, [0.6, 0.8, 0.0])
    some = drop_implausible(replace(drive, gnss=replace(gnss, llh=frame.to_llh(straight)))).gnss
    straight[end, 1] += 50.0
    fewer = drop_implausible(replace(drive, gnss=replace(gnss, llh=frame.to_llh(straight)))).gnss
    assert some is not None
    assert fewer is not None
    assert some.t[end] == gnss.t[end]
    assert fewer.t[end] != gnss.t[end]


@pytest.mark.parametrize("vague", [slice(0, 4), slice(0, None, 9)])
def test_vague_fixes_do_not_hide_the_motion(vague: slice) -> None:
    """The first ones of a receiver, or a mark for no fix among the others."""
    drive = load(HERE / "data" / "tokyo").crop(0.0, 40.0)
    gnss = drive.gnss
    assert gnss is not None
    sd = gnss.sd.copy()
    sd[vague] = 9999.0
    span = find_motion_span(drop_implausible(drive), Settings())
    found = find_motion_span(drop_implausible(replace(drive, gnss=replace(gnss, sd=sd))), Settings())
    assert span is not None
    assert found is not None
    assert abs(found[0] - span[0]) < 1.0
