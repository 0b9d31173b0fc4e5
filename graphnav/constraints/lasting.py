"""Time-correlated errors of a receiver's fixes, as Gauss-Markov processes.

Errors of one receiver's fixes seconds apart are nearly equal, so a thousand fixes are not a thousand independent
measurements. The error of a position is white noise and a sum of three processes in units of the stated sigma: one of
seconds (multipath), one of minutes (multipath as satellites move, changes of the satellites in view) and one of hours
(orbits, atmosphere, coordinates of the base). The stated sigma itself is that of the white part. The noise model
estimates the size of each (`graphnav.estimation.noise`), for each type of fix where there are several: errors of fixed
and of single-point solutions are unrelated. With stated noise there is only the white part.

These units are smooth in time. A lasting error in units that change from fix to fix would be observable by these
changes.

Where fixes state the rms of their pseudorange residuals, there is a fourth process, of multipath, in units of each
fix's stated sigma times the multipath in its pseudoranges (`graphnav.gnss.residuals`). This unit does change from fix
to fix: where satellites behind a corner come and go, right and wrong fixes follow each other within a second. With one
error in common, either would make the other wrong. What reflections add when the unit rises is independent of what was
there, and what is left when it falls again is a part of that: errors of variances a and b a moment apart have a
covariance of min(a, b), as in Tokyo's streets the true ones have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphnav.core.rotation import Array
from graphnav.core.running import run_median
from graphnav.core.state import NODE_SPACING, SECONDS, Parameter
from graphnav.gnss.sigmas import REFLECTED

TIMES = ("seconds", "minutes", "hours")  # correlation times of the processes of a position's error
ERRORS = tuple(f"gnss_error_of_{time}" for time in TIMES)
MULTIPATH = "multipath"  # the process whose size the residuals of each fix state
MULTIPATH_ERROR = f"gnss_error_of_{MULTIPATH}"
LASTING = (*TIMES, MULTIPATH)
_ROWS, _AXES = "gnss_position", ("horizontal", "horizontal", "up")
_MINUTE = 60.0  # s


def list_processes(types: Sequence[str], slow_times: tuple[float, float], spacing: float) -> tuple[Parameter, ...]:
    """The processes of a position's error in units that are smooth.

    Parameters
    ----------
    types
        Of the fixes, where there are several; each has processes of its own.
    slow_times
        s, correlation times of minutes and of hours.
    spacing
        s, of their nodes.

    Returns
    -------
    tuple of Parameter
        In units of a sigma.
    """
    lasts = dict(zip(TIMES, (SECONDS, *slow_times), strict=True))
    kinds = [f".{one}" for one in types] or [""]
    return tuple(_make_process(error, lasts[error], spacing, kind) for kind in kinds for error in lasts)


def make_multipath(t: Array, size: Array, spacing: float) -> Parameter:
    """The process of multipath of fixes at times t (N,), s, that is of a size (N,), m, in their pseudoranges."""
    return replace(_make_process(MULTIPATH, REFLECTED, spacing), sizes=(t, size))


def _make_process(error: str, lasts: float, spacing: float, kind: str = "") -> Parameter:
    return Parameter.centred(
        f"gnss_error_of_{error}{kind.replace('.', '_')}", 3, 1.0, "sd",
        correlation_time=lasts, spacing=spacing,
        noise_groups=tuple(f"{_ROWS}{kind}.{error}.{axis}" for axis in _AXES),
    )  # fmt: skip


def find_fix_period(t: Array) -> float:
    """Usual time between fixes, s."""
    return max(float(np.median(np.diff(t))), 1e-3) if len(t) > 1 else 1.0


def find_least_period(t: Array) -> float:
    """Least time between fixes, s: the spacing of nodes by which each fix has its own, since two fixes with one error
    in different units would contradict each other.
    """
    return min(float(np.diff(t).min()), NODE_SPACING) if len(t) > 1 else NODE_SPACING


def find_node_spacing(slow_times: tuple[float, ...], dt: float) -> float:
    """Spacing (s) of the nodes of time-correlated errors, between which the value is held.

    A process of seconds needs one node per fix, `dt` s apart, up to a fifth of its correlation time.
    """
    return max(dt, min(0.2 * SECONDS, *(0.01 * time for time in slow_times), NODE_SPACING))


def compute_running_median(t: Array, sigma: Array) -> Array:
    """Running median over a minute of sigmas (N, m) at times t (N,), s."""
    size = 2 * int(np.clip(_MINUTE / find_fix_period(t) / 2, 0, (len(t) - 1) // 2)) + 1
    return run_median(sigma, size)
