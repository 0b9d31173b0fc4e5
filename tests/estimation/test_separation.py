"""Filter and later measurements are apart by as much as their sigmas say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest

from graphnav.config import Settings
from graphnav.estimation.pipeline import run

STATED = Settings.model_validate({"noise": {"mode": "stated"}})


@pytest.fixture(scope="module")
def drive():
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0))
    return replace(recording, odometer=None)


def test_it_is_what_the_smoother_combines_and_has_the_size_of_its_sigma(drive):
    found = run(drive, STATED, ("ekf", "rts"))
    one = found["rts"].separation
    forward, smoothed = (found[name].trajectory() for name in ("ekf", "rts"))
    known = np.isfinite(one.value).all(axis=1)
    assert known.mean() > 0.9
    assert not known[-1]  # nothing comes after
    # x_f less the gain times the separation is x_s, with the gain of the later measurements
    gain = 1.0 - smoothed.sd_p**2 / forward.sd_p**2
    R_ln = found["rts"].frame.R_ln(found["rts"].states.p)
    apart = np.einsum("kij,kj->ki", R_ln, found["ekf"].states.p - found["rts"].states.p)
    assert apart[known] == pytest.approx((gain * one.value)[known], abs=1e-6)
    size = np.sqrt(np.nanmean((one.value / one.sigma) ** 2))
    assert 0.6 < size < 1.6


def test_sigmas_that_are_too_large_show(drive):
    gnss = drive.gnss
    vague = replace(drive, gnss=replace(gnss, sd=8.0 * gnss.sd, sd_v=None if gnss.v is None else 8.0 * gnss.sd_v))
    one = run(vague, STATED, ("rts",))["rts"].separation
    assert np.sqrt(np.nanmean((one.value / one.sigma) ** 2)) < 0.4
