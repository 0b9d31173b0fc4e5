"""Multipath in pseudoranges by the residuals of fixes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from graphnav.gnss.residuals import compute_multipath_sigma


def test_the_size_by_residuals_is_true_whatever_it_is() -> None:
    """Least squares of pseudoranges whose variance is drawn from the prior: among fixes of a like result the precision
    is the inverse square of it and of the usual error, on average.
    """
    rng, many = np.random.default_rng(5), 40_000
    n = rng.integers(5, 12, many)
    s = 1.0 / np.sqrt(rng.chisquare(1, many))
    rms = np.empty(many)
    for k in range(many):
        H = np.column_stack([rng.standard_normal((n[k], 3)), np.ones(n[k])])
        y = s[k] * rng.standard_normal(n[k])
        rms[k] = np.sqrt(np.mean((y - H @ np.linalg.lstsq(H, y, rcond=None)[0]) ** 2))
    found = np.hypot(compute_multipath_sigma(rms, n.astype(float)), 1.0)
    for few in (n < 7, n >= 7):
        seen = few & (found > 1.001)
        for low, high in pairwise(np.quantile(found[seen], [0.0, 0.25, 0.5, 0.75, 1.0])):
            some = seen & (found >= low) & (found <= high)
            assert abs(np.mean((found[some] / s[some]) ** 2) - 1.0) < 5.0 / np.sqrt(some.sum())


def test_what_nothing_checks_may_be_as_wrong_as_usual() -> None:
    rms = np.array([np.nan, 3.0, 3.0, 1e-9, -1.0, 0.5])
    found = compute_multipath_sigma(rms, np.array([9.0, np.nan, 4.0, 4.0, 9.0, 12.0]))
    assert found[[0, 2, 3, 4]].tolist() == [1.0] * 4
    assert found[1] == compute_multipath_sigma(rms[1:2], np.array([5.0]))[0] == compute_multipath_sigma(rms, None)[1]
    assert found[5] < 0.1 < 4.0 < found[1]
