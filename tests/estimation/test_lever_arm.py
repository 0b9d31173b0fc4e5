"""The antenna is found where it is, whatever the recording says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from helpers import refused

from graphnav.core.errors import EstimationError
from graphnav.estimation.antenna import find_antenna

ARM = np.array([0.3, -0.5, 1.2])


@pytest.fixture(scope="module")
def drive():
    """Three minutes with turns, of another simulator, fixes of 2 cm."""
    recording, _ = oracle.drive(oracle.vehicle_path(180.0, 50.0), seed=5, lever_arm=tuple(ARM))
    return recording


@pytest.mark.parametrize("stated", [ARM, -ARM, np.zeros(3)], ids=["right", "signs", "none"])
def test_the_antenna_is_found(drive, stated):
    found = find_antenna(replace(drive, gnss=replace(drive.gnss, lever_arm=stated)))
    assert (np.abs(found.found - ARM) < 4.0 * found.sigma).all()
    assert np.abs(found.found - ARM)[:2] == pytest.approx(0.0, abs=0.06)
    assert found.agrees is (stated is ARM)
    assert found.finding.severity == ("note" if stated is ARM else "warning")


def test_without_fixes_there_is_none_to_find(drive):
    with refused("antenna.no_gnss", EstimationError):
        find_antenna(drive.without("gnss"))
