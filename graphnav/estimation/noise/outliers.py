"""Which rows are outliers, by their squared errors, and what weight they have."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri

from graphnav.core.rotation import Array
from graphnav.estimation.noise.model import RowWeights

CHANCE = 1e-3  # below which a squared residual is taken for an outlier


def limit_squares(squared: Array, m: int) -> Array:
    """(N,) weights by which squared errors (N,) of m degrees of freedom are no larger than `CHANCE` allows."""
    return np.asarray(np.minimum(1.0, float(chdtri(m, CHANCE)) / np.maximum(squared, 1e-30)))


def limit_scaled(squared: Array, m: int, used: Array) -> Array:
    """The same, where errors are as large as those of half of the rows that are used (N,), if those are too large.

    What half of the rows do is no error of rows: the figures have not come to what they are yet.
    """
    some = squared[used]
    usual = float(np.median(some)) / float(chdtri(m, 0.5)) if len(some) else 1.0
    return limit_squares(squared / max(usual, 1.0), m)


def list_reduced(t: Array, weight: Array, used: Array) -> RowWeights:
    """Those of the weights (N,) of used rows at times t (N,), s, that are less than 1."""
    less = (weight < 1.0) & used
    less |= np.isin(t, t[less])  # with all rows of their times, so that each is known by its number among them
    return RowWeights(t[less], weight[less])


def cost_of_outliers(weights: Mapping[str, RowWeights]) -> float:
    """Log-probability that as many rows and intervals have less weight than others by chance."""
    return float(np.log(CHANCE)) * sum(int(np.sum(some.weight < 1.0)) for some in weights.values())
