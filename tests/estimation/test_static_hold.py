"""Receivers that hold a position while they take a slow vehicle to stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import graphnav
from graphnav.app.scores import score
from graphnav.core.earth import LocalFrame
from graphnav.estimation.noise.copies import drop_copies, mark_copies
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Recording

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
    assert drop_copies(drive) == (drive, ())
    assert not mark_copies(coarse).any()
