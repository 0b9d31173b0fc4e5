"""Velocities from positions: beside SciPy's splines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from graphnav.core.interpolation import differentiate
from graphnav.core.trajectory import Trajectory


@pytest.mark.parametrize("rows", [2, 3, 4, 5, 300])
def test_slopes_are_those_of_a_cubic_spline(rows: int) -> None:
    rng = np.random.default_rng(rows)
    t, p = np.cumsum(rng.uniform(0.2, 2.0, rows)), rng.normal(0.0, 30.0, (rows, 3))
    found = differentiate(Trajectory(t, p, frame="local"), 3.0)
    assert found == pytest.approx(CubicSpline(t, p)(t, 1), rel=1e-9, abs=1e-9)
    assert np.isnan(differentiate(Trajectory(t, p, frame="local"), 0.1)).all()  # each row alone
