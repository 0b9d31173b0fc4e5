"""Running filters are SciPy's."""

import numpy as np
import pytest
from scipy.ndimage import maximum_filter1d, median_filter, uniform_filter1d

from graphnav.core import running
from graphnav.core.running import run_maximum, run_mean, run_median


@pytest.mark.parametrize("many", [running._MANY_NUMBERS, 0])
@pytest.mark.parametrize("shape", [(40,), (40, 3), (2, 2)])
@pytest.mark.parametrize("size", [1, 2, 5, 8, 31])
def test_as_scipys(shape, size, many, monkeypatch):
    monkeypatch.setattr(running, "_MANY_NUMBERS", many)
    x, size = np.random.default_rng(size).standard_normal(shape), min(size, shape[0])
    along = (size, *(1,) * (len(shape) - 1))
    np.testing.assert_array_equal(run_median(x, size), median_filter(x, size=along, mode="nearest"))
    np.testing.assert_array_equal(run_maximum(x, size), maximum_filter1d(x, size, axis=0, mode="nearest"))
    np.testing.assert_allclose(run_mean(x, size), uniform_filter1d(x, size, axis=0, mode="nearest"), atol=1e-14)
