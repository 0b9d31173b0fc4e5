"""Precise point positioning with float ambiguities: ionosphere-free codes and carrier phases.

With the models of `graphnav.gnss.ppp`, z the zenith wet delay (a random walk) and m its mapping function, q the code
biases of a satellite and N the ambiguity of a carrier-phase arc::

    r_code    = |s - p_a| + b + b_s + m z + q + [...] - dt - P
    r_carrier = |s - p_a| + b + b_s + m z + N + o + d + [...] - dt - Phi

o is the orbit error of a satellite over hours, d the errors over seconds: multipath, and the interpolation error of its
clock between two nodes of the product. Both are far larger than the white noise of a carrier phase, and float
ambiguities carry position information through changes of millimetres: without d a single satellite would shift the
position by decimetres. Clock b, lever arm and ambiguities are parameters as in `graphnav.constraints.raw_gnss`; the
inter-system bias is a constant.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from graphnav.config import Settings
from graphnav.constraints.ambiguities import CarrierRows, make_ambiguities, name_ambiguity
from graphnav.constraints.base import BuildContext, Linearized
from graphnav.constraints.raw_gnss import (
    BIASES,
    PER_ROW,
    SATELLITES,
    RangeConstraint,
    list_common_fields,
    select_columns,
)
from graphnav.constraints.raw_rows import PreparedRows
from graphnav.constraints.raw_selection import select_observations
from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.gnss.ppp import IonosphereFree, choose_second_signals, combine_ionosphere_free
from graphnav.gnss.series import RawGnss
from graphnav.gnss.sigmas import REFLECTED, compute_carrier_sigma, compute_code_sigma, compute_reflection_sigma
from graphnav.gnss.signals import C
from graphnav.gnss.single_point import group_signals
from graphnav.recording import Recording

WET = "gnss_wet_delay"
ORBITS = "gnss_satellite_orbits"
CARRIER_SLOW = "gnss_carrier_errors"
# m, about that of a standard atmosphere; m/sqrt(s): 1 cm in an hour (Kouba and Heroux 2001)
_WET, _WET_WALK = 0.1, 1.7e-4
_CODE_BIAS = 1.0  # m: differential code bias of half to two nanoseconds, in the combination
_BIAS_WALK = 1e-5  # m/sqrt(s), a millimetre in three hours
# m, orbit error along the line of sight, over hours: final orbits are good to 2.5 cm (IGS, "Products")
_ORBIT = 0.025


@dataclass(frozen=True)
class FreeRows:
    """Data common to both kinds of rows, computed once per scene."""

    found: PreparedRows
    rows: IonosphereFree
    satellites: int  # of the systems that are used
    which: NDArray[np.intp]  # (N,) satellite
    group: NDArray[np.intp]  # (N,) system index, 0 the one with most rows
    groups: int


def combine_rows(scene: BuildContext) -> FreeRows | None:
    if not scene.settings.raw_gnss.ppp:
        return None
    found, whole = scene.satellite_rows, scene.recording.raw_gnss
    if found is None or whole is None:
        return None
    require_precise(scene.recording.name, whole)
    rows = combine_ionosphere_free(found.raw, whole)
    if rows is None:
        return None
    every, of = found.raw.satellites
    used = {satellite // 100 for satellite in choose_second_signals(whole)}
    some = np.isin(every // 100, list(used))
    systems = [x for x in dict.fromkeys(system for system, _ in group_signals(found.raw)[0]) if x in used]
    group = np.array([systems.index(x) for x in (found.raw.satellite[rows.which] // 100).tolist()])
    return FreeRows(found, rows, int(some.sum()), (np.cumsum(some) - 1)[of[rows.which]], group, len(systems))


def require_precise(name: str, raw: RawGnss) -> None:
    """Check that a recording's series has what precise point positioning needs.

    Raises
    ------
    RecordingError
        If it lacks precise orbits and clocks, or second signals.
    """
    if not raw.precise:
        raise RecordingError(
            f"{name}: raw_gnss.ppp needs precise orbits and clocks; set sp3 and clk in the recording's [raw_gnss]",
            key="raw.ppp_orbits",
        )
    if not choose_second_signals(raw):
        raise RecordingError(
            f"{name}: raw_gnss.ppp needs two signals of a satellite (GPS L1 and L2, Galileo E1 and E5a); this receiver "
            "has one",
            key="raw.ppp_signals",
        )


@dataclass(frozen=True)
class _Ppp(RangeConstraint):
    """Ionosphere-free rows of single satellites."""

    wet: Array = field(default_factory=lambda: np.empty(0))  # (N,)
    group: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) system, 0 the reference
    which: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) satellite

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        raw = select_observations(recording, settings) if settings.raw_gnss.ppp else None
        return np.empty(0) if raw is None else np.unique(raw.t)

    @staticmethod
    def _collect_shared_fields(scene: BuildContext, free: FreeRows, used: NDArray[np.intp]) -> dict[str, Any]:
        rows, common = free.rows, list_common_fields(scene, free.found)
        at = rows.which[used]
        common |= {name: common[name][at] for name in PER_ROW}
        common["parameters"] += (Parameter.centred(WET, 1, _WET, "m", _WET_WALK, spacing=free.found.spacing),)
        if free.groups > 1:
            size, sigma, spacing = free.groups - 1, scene.settings.raw_gnss.bias_sigma, free.found.spacing
            common["parameters"] += (Parameter.centred(BIASES, size, sigma, "m", _BIAS_WALK, spacing=spacing),)
        return common | {
            "nominal": free.found.nominal[at],
            "wet": rows.wet[used],
            "group": free.group[used],
            "which": free.which[used],
        }

    def _linearize_free_ranges(
        self, states: States, parameters: dict[str, Array], rows: slice | Array
    ) -> tuple[Array, dict[str, Array]]:
        """Residuals (n,) without ambiguities and code biases, and Jacobians."""
        residual, J, _ = self._linearize_ranges(states, parameters, rows, WET, self.wet[rows])
        if BIASES in parameters:
            own, J[BIASES] = select_columns(parameters[BIASES], self.group[rows] - 1)
            residual = residual + own
        return residual, J


def _make_process(free: FreeRows, name: str, sigma: float, unit: str, time: float) -> Parameter:
    """A process with this correlation time (s) for each satellite."""
    spacing = free.found.spacing
    return Parameter.centred(name, free.satellites, sigma, unit, correlation_time=time, spacing=spacing)


@dataclass(frozen=True)
class GnssPppCode(_Ppp):
    """Ionosphere-free code of one satellite at the antenna."""

    name: ClassVar[str] = "gnss_ppp_code"
    unit: ClassVar[str] = "m"

    @classmethod
    def build(cls, scene: BuildContext) -> GnssPppCode | None:
        free = scene.ionosphere_free
        if free is None:
            return None
        rows, raw = free.rows, free.found.raw.take(free.rows.which)
        common = cls._collect_shared_fields(scene, free, np.arange(len(rows.which)))
        hours = scene.settings.gnss.slow_times[1]
        common["parameters"] += (_make_process(free, SATELLITES, _CODE_BIAS, "m", hours),)
        sigma = rows.growth * compute_code_sigma(raw.cn0, rows.geometry.elevation, np.zeros(len(raw)))
        return cls(offset=rows.known - rows.code, sigma=sigma[:, None], **common)

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        residual, J = self._linearize_free_ranges(states, parameters, rows)
        own, J[SATELLITES] = select_columns(parameters[SATELLITES], self.which[rows])
        return Linearized((residual + own)[:, None], J, self.sigma[rows])


@dataclass(frozen=True)
class GnssPppCarrier(CarrierRows, _Ppp):
    """Ionosphere-free carrier phase of one satellite at the antenna."""

    name: ClassVar[str] = "gnss_ppp_carrier"
    unit: ClassVar[str] = "m"

    lasting: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, 1-sigma of the errors over seconds

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # those of the codes

    @classmethod
    def build(cls, scene: BuildContext) -> GnssPppCarrier | None:
        free = scene.ionosphere_free
        if free is None:
            return None
        rows, arcs = free.rows, free.rows.arcs
        used = np.flatnonzero(arcs.arc >= 0)
        if not len(used):
            return None
        raw = free.found.raw.take(rows.which[used])
        common = cls._collect_shared_fields(scene, free, used)
        own = make_ambiguities(arcs, rows.carrier - rows.code, np.ones(len(arcs.arc)), "m")
        there = sorted(own)
        common["parameters"] += (
            *(own[k] for k in there),
            _make_process(free, ORBITS, _ORBIT, "m", scene.settings.gnss.slow_times[1]),
            _make_process(free, CARRIER_SLOW, 1.0, "1", REFLECTED),
        )
        noise = raw.clock_noise
        middle, apart = np.array([noise.get(s, (0.0, 1.0)) for s in raw.satellite.tolist()]).T
        between = np.mod(raw.t + raw.zero, apart) / apart  # nodes are at whole numbers of their spacing
        off_line = 2.0 * middle * np.sqrt(between * (1.0 - between))
        reflected = rows.growth[used] * compute_reflection_sigma(rows.geometry.elevation[used])
        if scene.settings.raw_gnss.robust == "automatic":  # a cycle slip is not an error that a variance can describe
            common["robust"] = "cauchy"
        sigma = rows.growth[used] * compute_carrier_sigma(raw.cn0, rows.geometry.elevation[used], C / raw.frequency)
        return cls(
            offset=(rows.known - rows.carrier)[used],
            sigma=sigma[:, None],
            slots=tuple(name_ambiguity(arcs.names[k]) for k in there),
            slot=np.searchsorted(there, arcs.slot[used]),
            begin=arcs.begin[used],
            wavelength=np.ones(len(used)),  # ambiguities are in m
            half_slip=0.5 * rows.lane[used],
            family=np.full(len(there), -1),
            whole=np.ones(len(used), dtype=bool),
            lasting=np.hypot(off_line, reflected),
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        residual, J = self._linearize_free_ranges(states, parameters, rows)
        own, J[ORBITS] = select_columns(parameters[ORBITS], self.which[rows])
        residual, slot = residual + own, self.slot[rows]
        own, J[CARRIER_SLOW] = select_columns(parameters[CARRIER_SLOW], self.which[rows])
        lasting = self.lasting[rows]
        residual, J[CARRIER_SLOW] = residual + lasting * own, lasting[:, None, None] * J[CARRIER_SLOW]
        for k, name in enumerate(self.slots):
            one = (slot == k).astype(float)
            residual = residual + one * parameters[name][:, 0]
            J[name] = one[:, None, None]
        return Linearized(residual[:, None], J, self.sigma[rows])
