"""Fixes as they arrive: their typical sigmas, and which of them are used."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from graphnav.constraints.lasting import find_fix_period
from graphnav.core.rotation import Array
from graphnav.estimation.alignment.first import pick_fixes
from graphnav.estimation.noise.spacing import find_grid_start, select_best_fixes
from graphnav.estimation.noise.unmeasured import mark_copies
from graphnav.online.buffers import SAME, Buffer
from graphnav.recording import Gnss
from graphnav.recording.formats.stamps import RUN, find_set_back

_WIDTH = 21  # after a fix's values six typical sigmas, whether it is used, rms of its residuals and satellites
_USED, _RESIDUALS = 19, 20
_VOID = -1.0  # no measurement: a copy of the fix before, or filled in
_NEAR = 8  # rows either side of a new one among which copies are sought
_AVERAGED_OVER = 60.0  # s over which the typical sigma of fixes is averaged


class Arrivals:
    """The newest fixes in the order in which they came, used or not, and where the receiver's clock was set back."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []  # s; latitude and longitude
        self.set_back: tuple[float, float] | None = None  # s, after which fix, and by how much

    def add(self, t: float, place: tuple[float, ...]) -> None:
        """A fix has come."""
        self._rows = [*self._rows[-2 * RUN - 1 :], (t, place[0], place[1])]
        if (
            self.set_back is None
            and len(self._rows) == 2 * RUN + 2
            and self._rows[-RUN - 1][0] <= self._rows[-RUN - 2][0]
        ):
            rows = np.array(self._rows)
            if (found := find_set_back(rows[:, 0], rows[:, 1:])) is not None:
                self.set_back = float(rows[found[0], 0]), found[1]


class Fixes(Buffer):
    """Rows of fixes with their typical sigmas and whether they are used.

    Parameters
    ----------
    setup : without rows; None where there are none.
    """

    def __init__(self, setup: Gnss | None) -> None:
        super().__init__(_WIDTH)
        self.arrivals = Arrivals()
        self.left: list[float] = []  # s, fixes that were used until better ones of their span, or another copy, arrived
        self._states_residuals = False  # whether a fix has had an rms of its residuals
        self._selects = False  # whether not all fixes are used
        self._setup = setup
        # begin and duration of the spans, s, of which the best fix is used
        self._grid: tuple[float, float] | None = None
        self._unit: Array | None = None  # `unit`, once determined
        self._filled: list[tuple[float, float]] = []  # s, stretches that a logger has filled in
        self._means: dict[str, tuple[float, tuple[float, ...]]] = {}  # typical sigmas, and since when

    @property
    def used(self) -> Array:
        """(N,) s, times of the fixes in use."""
        return self.rows[self.rows[:, _USED] > 0.0, 0]

    def complete(self, t: float, values: tuple[float, ...]) -> tuple[float, ...]:
        """The row of a fix at a time (s): its values, typical sigmas, and the mark that it is used."""
        position, velocity = (self._track_sigma(kind, t, values[k : k + 3]) for kind, k in (("p", 3), ("v", 9)))
        of_residuals = values[12:] or (math.nan, math.nan)
        self._states_residuals |= math.isfinite(of_residuals[0])
        used = _VOID if self._is_filled(t) else 1.0
        return (*values[:12], *position, *velocity, used, *of_residuals)

    def leave_out_filled(self, t: float, measured: Array) -> None:
        """Leave out the fixes, there or to come, between the IMU's measured rows (N,) before and after a time, s.

        What was logged of the IMU there was filled in, and a logger that stalls fills in all that it logs.
        """
        at = int(np.searchsorted(measured, t))
        begin, end = measured[max(at - 1, 0)], measured[min(at, len(measured) - 1)]
        if self._filled and self._filled[-1][0] == begin:  # which has gone on
            self._filled.pop()
        self._filled.append((float(begin), float(end)))
        self._mark_filled()

    def _mark_filled(self) -> None:
        for begin, end in self._filled:
            self.rows[slice(*np.searchsorted(self.t, [begin + SAME, end - SAME])), _USED] = _VOID

    def _is_filled(self, t: float) -> bool:
        return any(begin + SAME < t < end - SAME for begin, end in self._filled)

    def drop_before(self, t: float) -> None:
        """Drop the rows before a time."""
        super().drop_before(t)
        self._filled = [one for one in self._filled if one[1] > t]

    def forget_arrivals(self) -> None:
        """Forget in which order fixes came: another clock begins."""
        self.arrivals = Arrivals()

    def forget_typical(self) -> None:
        """Reset the typical sigmas: what follows is of another receiver or clock."""
        self._means = {}

    def space(self, spacing: float | None) -> None:
        """Use the best fix of every span of `spacing` (s), 0 for each of them, but no copies; None: use all."""
        self.rows[:, _USED], self._grid, self.left = 1.0, None, []
        self._selects = spacing is not None
        gnss = self.select_as_gnss(-np.inf, np.inf)
        self._mark_filled()
        if spacing is None or gnss is None or len(gnss.t) < 2:
            return
        self.rows[mark_copies(gnss), _USED] = _VOID
        if find_fix_period(gnss.t) > 0.5 * spacing:
            return
        begin = find_grid_start(gnss)
        self._grid = begin, spacing
        own = np.flatnonzero(self.rows[:, _USED] != _VOID)
        gnss = pick_fixes(gnss, own)
        self.rows[own, _USED] = 0.0
        self.rows[own[select_best_fixes(gnss, np.floor((gnss.t - begin) / spacing))], _USED] = 1.0

    def choose(self, t: float) -> bool:
        """Whether a new fix is no copy and among the best of its span; those that no longer are go to `left`."""
        if self._is_filled(t) or (self._selects and self._is_copy(t)):
            return False
        if self._grid is None:
            return True
        begin, spacing = self._grid
        span = np.floor((t - begin) / spacing)
        near = self.rows[slice(*np.searchsorted(self.t, [t - 1.1 * spacing, t + 1.1 * spacing]))]
        rows = np.flatnonzero((np.floor((near[:, 0] - begin) / spacing) == span) & (near[:, _USED] != _VOID))
        gnss = self._make_gnss(near[rows])
        assert gnss is not None
        best = rows[select_best_fixes(gnss, np.zeros(len(rows)))]
        others = np.setdiff1d(rows, best)
        self.left += [float(x) for x in near[others[near[others, _USED] > 0.0], 0] if x != t]
        near[rows, _USED] = 0.0
        near[best, _USED] = 1.0
        return bool(np.any(near[best, 0] == t))

    def _is_copy(self, t: float) -> bool:
        """Whether the fix at a time is a copy; those near it that turn out to be go to `left`."""
        at = int(np.searchsorted(self.t, t))
        first = max(at - _NEAR, 0)
        near = self.rows[first : at + _NEAR + 1]
        gnss = self._make_gnss(near)
        assert gnss is not None
        copied = mark_copies(gnss)
        self.left += [float(x) for x in near[copied & (near[:, _USED] > 0.0), 0] if x != t]
        near[copied, _USED] = _VOID
        return bool(copied[at - first])

    def compute_typical_sigmas(self, t: Array) -> Array:
        """(N, 6) typical sigmas of the fixes at some times, m and m/s: the units of time-correlated errors."""
        return self.rows[np.searchsorted(self.t, t - 1e-6), 13:19]

    def compute_unit(self) -> Array:
        """(3,) m, unit of errors that last for minutes and hours; constant from the first call on."""
        if self._unit is None:
            self._unit = compute_unit(self.rows[self.rows[:, _USED] > 0.0, 4:7])
        return self._unit

    def select_as_gnss(self, begin: float, end: float, every: bool = False) -> Gnss | None:
        """The used fixes between two times (s), both included, or with `every` all of them; None if there are none."""
        rows = self.copy_between(begin, end)
        return self._make_gnss(rows if every else rows[rows[:, _USED] > 0.0])

    def find_fix_before(self, t: float) -> float:
        """The time (s) of the last fix in use up to a time, of whose reflections those behind it may have a part; the
        same time where fixes state no residuals.
        """
        if not self._states_residuals:
            return t
        used = self.used
        before = used[: np.searchsorted(used, t, side="right")]
        return float(before[-1]) if len(before) else t

    def _make_gnss(self, rows: Array) -> Gnss | None:
        if self._setup is None or not len(rows):
            return None
        v = sd_v = None
        if np.isfinite(rows[:, 7:13]).all(axis=1).any():
            v, sd_v = rows[:, 7:10], rows[:, 10:13]
        rms, satellites = rows[:, _RESIDUALS:].T if self._states_residuals else (None, None)
        return replace(
            self._setup, t=rows[:, 0], llh=rows[:, 1:4], sd=rows[:, 4:7], v=v, sd_v=sd_v,
            residual_rms=rms, satellites=satellites,
        )  # fmt: skip

    def _track_sigma(self, kind: str, t: float, sd: tuple[float, ...]) -> tuple[float, ...]:
        """A causal mean, which does not change after a fix has been built.

        The median over a minute in `graphnav.constraints.gnss` would change with every following row, and a slow error
        in a changing unit would be observable.
        """
        last, mean = self._means.get(kind, (-np.inf, sd))
        if not math.isfinite(sum(sd)):
            return mean  # a fix without velocity
        gain = -np.expm1(-max(t - last, 0.0) / _AVERAGED_OVER) if np.isfinite(last) else 1.0
        mean = tuple(float(m + gain * (s - m)) for m, s in zip(mean, sd, strict=True))
        self._means[kind] = max(t, last), mean
        return mean


def compute_unit(sd: Array) -> Array:
    """(3,) median of stated sigmas (N, 3), one for both horizontal axes, whose errors share one variance component."""
    east, north, up = np.median(sd, axis=0)
    level = np.sqrt(0.5 * (east**2 + north**2))
    return np.array([level, level, up])
