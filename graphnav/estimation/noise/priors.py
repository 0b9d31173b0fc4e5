"""Priors of the variance factors: log-normal, with a median and a 1-sigma of the logarithm.

A stated figure holds within a factor of three either way (1-sigma): data sheets give the sensor on a bench and not in a
car, receivers print sigmas for the whole of an error or for its noise alone. It is the same for all sensors, so that
none is favoured; with tens of degrees of freedom in the data the prior has no weight, with none it is used as it is.

A receiver's sigma is meant to hold for the whole of its error. What part of that is white is not stated: the medians
of the processes give it half to hours, half to minutes, and a quarter to seconds, in units of the stated variance, and
the white part starts at all of it; the data separate them. None makes fixes worse than a fault can (`SIZES`): larger
errors of all fixes would explain any trajectory.
"""

from __future__ import annotations

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.rotation import Array
from graphnav.estimation.faults.watch import SIZES

WITHIN = 2.0 * np.log(3.0)  # 1-sigma of the logarithm of a variance: a factor of three in sigma
_SHARES = {"seconds": 0.25, "minutes": 0.5, "hours": 0.5, "multipath": 0.25}  # of a GNSS sensor's stated variance
_OF_RECEIVER = "gnss", "dual_antenna"
TIME_WITHIN = np.log(3.0)  # 1-sigma of the logarithm of a correlation time


def get_prior(group: str) -> tuple[float, float]:
    """Median and 1-sigma of the logarithm of a group's variance factor."""
    parts = group.split(".")
    shares = _SHARES if parts[0].startswith(_OF_RECEIVER) else {}
    share = next((shares[part] for part in parts if part in shares), 1.0)
    return float(np.log(share)), WITHIN


def list_largest(rows: Constraint) -> dict[str, float]:
    """The largest logarithms of variance factors of a constraint on fixes, by group: at most as large as faults get."""
    groups, component = rows.list_noise_groups()
    sigma: Array = rows.sigma  # type: ignore[attr-defined]
    medians = {
        group: float(np.median(sigma[component == i])) for i, group in enumerate(groups) if (component == i).any()
    }
    return {group: max(0.0, 2.0 * float(np.log(SIZES[rows.unit] / median))) for group, median in medians.items()}
