"""Rows of fixes that are no measurements: positions that a receiver holds, and lines between fixes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphnav
from graphnav.app.scores import score
from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import Note
from graphnav.estimation.noise.unmeasured import UnmeasuredRows, drop_unmeasured, mark_copies, mark_interpolated
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Gnss, Recording

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def drive() -> Recording:
    return graphnav.load(ROOT / "data" / "tokyo").crop(20.0, 110.0)


def held(recording: Recording, below: float = 0.9) -> Recording:
    """The recording with fixes of one sigma, without velocities, held below a speed, m/s."""
    gnss = recording.gnss
    assert gnss is not None
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)
    speed = np.linalg.norm(np.gradient(p[:, :2], gnss.t, axis=0), axis=1)
    row = np.arange(len(p))
    for k in range(1, len(p)):
        row[k] = row[k - 1] if speed[k] < below else k
    some = replace(gnss, llh=gnss.llh[row], v=None, sd_v=None, sd=np.ones_like(gnss.sd))
    return replace(recording, gnss=some)


def test_what_a_receiver_holds_is_left_out(drive: Recording) -> None:
    used = held(drive)
    error = {}
    for noise in ("stated", None):
        solutions = graphnav.run(used, solvers=("batch",), **({} if noise is None else {"noise": noise}))
        error[noise] = summarise(score(drive, used, solutions, ())[0]["batch"])
    assert error[None]["h_rms_m"] < 0.5 * error["stated"]["h_rms_m"]
    assert error[None]["nees_p"] < 3.0


def test_a_lever_arm_is_not_bent_to_what_a_receiver_holds(drive: Recording) -> None:
    """At a stop it holds where the vehicle was at this speed, a metre behind, and says that it stands."""
    used = held(drive, 1.4)
    gnss, before = used.gnss, drive.gnss
    assert gnss is not None
    assert before is not None
    assert before.v is not None
    copied = mark_copies(gnss)
    exact = replace(gnss, v=np.where(copied[:, None], 0.0, before.v), sd_v=before.sd_v, sd=before.sd)
    error = {
        name: summarise(score(drive, one, graphnav.run(one, solvers=("rts",)), ())[0]["rts"])
        for name, one in {"all": drive, "held": replace(used, gnss=exact)}.items()
    }
    assert error["held"]["h_rms_m"] < 2.0 * error["all"]["h_rms_m"]
    assert error["held"]["nees_p"] < 2.0


def test_repeats_that_digits_explain_are_no_copies(drive: Recording) -> None:
    used = held(drive)
    gnss = used.gnss
    assert gnss is not None
    coarse = replace(gnss, rounding=(0.3, 0.3, 0.3), sd=np.full_like(gnss.sd, 0.1))
    assert mark_copies(gnss).any()
    assert drop_unmeasured(drive) == (drive, UnmeasuredRows())
    assert not mark_copies(coarse).any()


def test_copies_that_last_are_excluded_and_single_ones_beside_their_fix_are_not(drive: Recording) -> None:
    part = drive.crop(0.0, 50.0)
    gnss = part.gnss
    assert gnss is not None
    row = np.arange(len(gnss.t))
    row[100] = 99  # 0.2 s behind
    row[200:220] = 199
    used = replace(part, gnss=replace(gnss, llh=gnss.llh[row]))
    for mode, expected in (({}, [(200, 219)]), ({"noise": {"spacing": 0.0}}, [(100, 100), (200, 219)])):
        (solution,) = graphnav.run(used, parse_settings(mode), ("ekf",)).values()
        spans = [(one.t_start, one.t_end) for one in solution.excluded if one.kind == "gnss_position"]
        assert [(gnss.t[a], gnss.t[b]) for a, b in expected] == spans
        keys = [note.key for note in solution.notes if isinstance(note, Note)]
        assert "gnss.copies" in keys
        assert ("gnss.spaced" in keys) == (mode == {})


def interpolate(gnss: Gnss, more: float) -> Gnss:
    """Rows on the lines between every fifth fix, at a multiple of their rate."""
    fixes = np.arange(0, len(gnss.t), 5)
    t = np.interp(np.arange(0.0, len(fixes) - 1 + 1e-9, 1.0 / more), np.arange(len(fixes)), gnss.t[fixes])
    llh = np.stack([np.interp(t, gnss.t[fixes], x) for x in gnss.llh[fixes].T], axis=-1)
    return Gnss(t, llh, np.full_like(llh, 3.0), lever_arm=gnss.lever_arm, rounding=gnss.rounding)


@pytest.mark.parametrize("more", [4.0, 10.0, 7.3])
def test_interpolated_rows_are_known_from_fixes(drive: Recording, more: float) -> None:
    assert drive.gnss is not None
    gnss = interpolate(drive.gnss, more)
    between = mark_interpolated(gnss)
    fixes = drive.gnss.t[::5]
    off_fix = np.abs(gnss.t[:, None] - fixes).min(axis=1) > 0.99 * np.diff(gnss.t).max()
    moving = np.linalg.norm(np.gradient(LocalFrame(gnss.llh[0]).from_llh(gnss.llh), gnss.t, axis=0), axis=1) > 1.0
    assert between[off_fix][1:-1].all()  # what is farther from a fix than the next row
    assert not between[~off_fix & moving][1:-1].all()


def test_measured_rows_are_not_taken_for_interpolated(drive: Recording) -> None:
    assert drive.gnss is not None
    assert not mark_interpolated(drive.gnss).any()
    coarse = replace(drive.gnss, llh=np.round(drive.gnss.llh, 7), rounding=(0.2, 0.2, 0.0))
    assert not mark_interpolated(coarse).any()


def test_a_log_of_interpolated_rows_is_solved_as_one_of_its_fixes(drive: Recording) -> None:
    assert drive.gnss is not None
    error = {}
    for name, used in {
        "fixes": replace(drive, gnss=interpolate(drive.gnss, 1.0)),
        "rows": replace(drive, gnss=interpolate(drive.gnss, 10.0)),
    }.items():
        error[name] = summarise(score(drive, used, graphnav.run(used, solvers=("rts",)), ())[0]["rts"])
    assert error["rows"]["h_rms_m"] < 1.1 * error["fixes"]["h_rms_m"]
