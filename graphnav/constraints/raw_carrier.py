"""Time-differenced carrier phases: range changes of single satellites between epochs, to millimetres.

A carrier phase is a range plus an ambiguity that is constant between two epochs without a cycle slip, so its change is
a range change (van Graas and Soloviev 2004, "Precise velocity estimation using a stand-alone GPS receiver"). With a the
antenna position at the previous epoch and p_a = p + R_nb l the current one::

    r = |s - p_a| - |s' - a| + w + [T - I - dt] - [m] z + (h - e_l.g) (t - t') - lambda [phi]

[x] is the change of x, w the change of the receiver clock (independent at every epoch), z the zenith error of the
ionosphere model, the same parameter as for the codes, and m its mapping function. g is the drift of atmosphere and
satellite clock and orbit errors common to all satellites, over minutes, as a velocity in east, north, up; h is that of
a single satellite, over hours. Without h and z the sum of the changes over minutes would be stated to centimetres, and
so would the position: directions to satellites turn by a hundredth of a radian in a minute, so a position error of a
metre changes ranges by a centimetre, as much as these errors do.

The remaining error of a single change is modelled as white. White phase noise would cancel in the sum of two changes;
multipath and ionosphere, however, accumulate like a random walk of 2 mm/sqrt(s) over 20 to 300 s (measured on
ucr_riverside_20200712), which is what white changes amount to.

The position a is a clone (stochastic cloning: Roumeliotis and Burdick 2002): a parameter that is reset at every other
epoch, two of them alternating, and tied to the state of its own epoch by separate rows. So every solver accounts for
both positions, both attitudes through the lever arm, and their correlation.

Arcs end at cycle slips found by the receiver's flags or by comparison with the other satellites of the epoch
(`graphnav.gnss.arcs`); the robust kernel handles slips that neither of them finds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from graphnav.config import Settings
from graphnav.constraints.antenna_motion import LEVER_ARM
from graphnav.constraints.base import BuildContext, Constraint, Linearized
from graphnav.constraints.raw_gnss import (
    AXES,
    IONOSPHERE,
    ONE,
    PER_ROW,
    SatelliteConstraint,
    compute_range_change,
    list_common_fields,
    make_ionosphere_parameter,
    select_columns,
)
from graphnav.constraints.raw_rows import PreparedRows, find_epoch_period
from graphnav.constraints.raw_selection import select_observations
from graphnav.core import rotation
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.gnss.atmosphere import compute_obliquity
from graphnav.gnss.carrier import number_epochs, pair_consecutive
from graphnav.gnss.series import compute_medians
from graphnav.gnss.sigmas import compute_carrier_sigma
from graphnav.gnss.signals import L1, C
from graphnav.recording import Recording

CHANGE = "receiver_clock_change"
CLONES = ("gnss_antenna_of_even_epochs", "gnss_antenna_of_odd_epochs")
DRIFT = "gnss_carrier_drift"
RATES = "gnss_satellite_rates"
_CHANGE_SIGMA = 100.0  # m, about the median over the satellites, computed at positions with errors of this size
_ANYWHERE = 1e3  # m, prior 1-sigma of a cloned antenna position: uninformative
_TIE = 5e-4  # m, 1-sigma of a tie: a tenth of that of a carrier-phase change
# m/s, 1-sigma of the drift by ionosphere and broadcast clocks: Klobuchar's delay rises from 1.5 to 10 m in six hours
_DRIFT = np.array([5e-4, 5e-4, 1e-3])


@dataclass(frozen=True)
class CarrierPairs:
    """Pairs of rows of one satellite and signal at successive epochs, computed once per scene."""

    before: NDArray[np.intp]  # (N,) indices into the prepared rows
    after: NDArray[np.intp]
    number: NDArray[np.intp]  # (E,) number of each epoch, -1 for epochs that are not differenced
    epochs: Array  # (E,) s
    first: NDArray[np.intp]  # (E,) index of a prepared row of each epoch
    change: Array  # (N,) m, the part that does not depend on the estimate
    clock: Array  # (E,) m, approximate receiver clock change since the previous epoch


def _list_epochs(recording: Recording, settings: Settings) -> Array:
    raw = select_observations(recording, settings) if _use_differences(recording, settings) else None
    return np.empty(0) if raw is None else np.unique(raw.t[np.isfinite(raw.carrier)])


def _use_differences(recording: Recording, settings: Settings) -> bool:
    """Whether changes are used: not beside ambiguities, for both kinds of rows come from the same observations."""
    s, raw = settings.raw_gnss, recording.raw_gnss
    if raw is None or not s.differences:
        return False
    based = np.isfinite(raw.carrier_difference).any() if raw.catalogue is None else raw.differenced
    return not (s.carrier and s.code and based)


def pair_rows(scene: BuildContext) -> tuple[PreparedRows, CarrierPairs] | None:
    if not _use_differences(scene.recording, scene.settings):
        return None
    found, whole = scene.satellites, scene.recording.raw_gnss
    if found is None or whole is None or not np.isfinite(found.raw.carrier).any():
        return None
    raw = found.raw
    before, after = pair_consecutive(raw, whole, find_epoch_period(raw, scene.settings.raw_gnss))
    if not len(after) and raw.catalogue is None:
        return None
    epochs, first, of = np.unique(raw.t, return_index=True, return_inverse=True)
    # the ionosphere advances the carrier phase
    level = found.known - 2.0 * found.ionosphere - raw.clock - raw.carrier * C / raw.frequency
    change = level[after] - level[before]
    clock = np.zeros(len(epochs))
    clock[of[after]] = -compute_medians(raw.t[after], change)
    some = found.keyframe[after] >= 0  # in a piece, changes at earlier epochs are in use already
    number = number_epochs(raw)[first]
    return found, CarrierPairs(before[some], after[some], number, epochs, first, change[some], clock)


def _clone_antennas(found: PreparedRows, pairs: CarrierPairs) -> tuple[Parameter, ...]:
    out = []
    for k, name in enumerate(CLONES):
        own = np.flatnonzero((pairs.number >= 0) & (pairs.number % 2 == k))
        own = own if len(own) else np.zeros(1, dtype=int)  # a piece may have none: any start serves
        sigma = np.full((len(own), 3), _ANYWHERE)
        out.append(Parameter(name, found.nominal[pairs.first[own]], sigma, "m", begins=pairs.epochs[own]))
    return tuple(out)


@dataclass(frozen=True)
class GnssAntennaClone(Constraint):
    """Tie of a cloned antenna position to the state of its epoch."""

    name: ClassVar[str] = "gnss_antenna_clone"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m"

    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    odd: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) index into `CLONES`

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return _list_epochs(recording, settings)

    @classmethod
    def build(cls, scene: BuildContext) -> GnssAntennaClone | None:
        both = scene.carrier_pairs
        if both is None:
            return None
        found, pairs = both
        own = np.flatnonzero((found.keyframe[pairs.first] >= 0) & (pairs.number >= 0))
        if not len(own):
            return None
        parameters = [p for p in list_common_fields(scene, found)["parameters"] if p.name == LEVER_ARM]
        return cls(
            keyframe=found.keyframe[pairs.first[own]],
            lever_arm=found.raw.lever_arm,
            odd=pairs.number[own] % 2,
            parameters=(*parameters, *_clone_antennas(found, pairs)),
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        lever = parameters.get(LEVER_ARM, self.lever_arm)
        odd = self.odd[rows][:, None]
        kept = np.where(odd == 0, parameters[CLONES[0]], parameters[CLONES[1]])
        I3 = np.broadcast_to(np.eye(3), (len(states), 3, 3))
        J = {
            "theta": -states.R_nb @ rotation.skew(lever),
            "p": I3,
            CLONES[0]: -I3 * (odd == 0)[..., None],
            CLONES[1]: -I3 * (odd == 1)[..., None],
        }
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = states.R_nb
        antenna = states.p + rotation.mv(states.R_nb, lever)
        return Linearized(antenna - kept, J, np.full((len(states), 3), _TIE))


@dataclass(frozen=True)
class GnssCarrier(SatelliteConstraint):
    """Change of a satellite's carrier phase since the previous epoch."""

    name: ClassVar[str] = "gnss_carrier"
    unit: ClassVar[str] = "m"

    change: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, the part that does not depend on the estimate
    nominal: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m, antenna
    s_before: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m, satellite at the previous epoch
    nominal_before: Array = field(default_factory=lambda: np.empty((0, 3)))
    time: Array = field(default_factory=lambda: np.empty(0))  # (N,) s since the previous epoch
    odd: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) index into `CLONES`, of that epoch
    which: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) satellite, index into their rates
    slant: Array = field(default_factory=lambda: np.empty(0))  # (N,) change of the ionospheric mapping function

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return _list_epochs(recording, settings)

    @classmethod
    def build(cls, scene: BuildContext) -> GnssCarrier | None:
        both = scene.carrier_pairs
        if both is None:
            return None
        found, pairs = both
        raw, j, k = found.raw, pairs.before, pairs.after
        if not len(k):
            return None
        common: dict[str, Any] = list_common_fields(scene, found)
        common |= {name: common[name][k] for name in PER_ROW}
        if scene.settings.raw_gnss.robust == "automatic":  # a cycle slip is not an error that a variance can describe
            common["robust"] = "cauchy"
        E = len(pairs.epochs)
        satellites, which = raw.take(k).satellites
        many = len(satellites)
        minutes, hours = scene.settings.gnss.slow_times
        common["parameters"] = (
            Parameter(CHANGE, pairs.clock[:, None], np.full((E, 1), _CHANGE_SIGMA), "m", begins=pairs.epochs),
            # a Gauss-Markov error changes by about its sigma within its correlation time
            Parameter.centred(RATES, many, ONE / hours, "m/s", correlation_time=hours, spacing=found.spacing),
            make_ionosphere_parameter(raw, found.spacing),
            *_clone_antennas(found, pairs),
        )
        # a phase is advanced, not delayed; against a base the parameter is the difference between the two receivers
        delay = -compute_obliquity(found.elevation) * (0.0 if raw.differenced else (L1 / raw.frequency) ** 2)
        drift = Parameter(
            DRIFT, np.zeros(3), _DRIFT, "m/s", correlation_time=minutes, spacing=found.spacing,
            noise_groups=tuple(f"{cls.name}.minutes.{axis}" for axis in AXES),
        )  # fmt: skip
        sigma = np.hypot(
            compute_carrier_sigma(raw.cn0[j], found.elevation[j], C / raw.frequency[j]),
            compute_carrier_sigma(raw.cn0[k], found.elevation[k], C / raw.frequency[k]),
        )
        return cls(
            change=pairs.change,
            nominal=found.nominal[k],
            s_before=found.s_n[j],
            nominal_before=found.nominal[j],
            time=raw.t[k] - raw.t[j],
            odd=number_epochs(raw)[j] % 2,
            which=which,
            slant=delay[k] - delay[j],
            sigma=sigma[:, None],
            processes=(drift,),
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        antenna, lever = self._place_antenna(states, parameters)
        odd = self.odd[rows]
        before = np.where(odd[:, None] == 0, parameters[CLONES[0]], parameters[CLONES[1]])
        nearer, e = compute_range_change(self.s_n[rows], antenna, self.nominal[rows])
        nearer_before, e_before = compute_range_change(self.s_before[rows], before, self.nominal_before[rows])
        residual = nearer - nearer_before + self.change[rows] + parameters[CHANGE][:, 0]
        J = {
            "theta": (e[:, None] @ states.R_nb) @ rotation.skew(lever),
            "p": -e[:, None],
            CLONES[0]: (e_before * (odd == 0)[:, None])[:, None],
            CLONES[1]: (e_before * (odd == 1)[:, None])[:, None],
            CHANGE: np.ones((len(e), 1, 1)),
        }
        if LEVER_ARM in parameters:
            J[LEVER_ARM] = -e[:, None] @ states.R_nb
        time = self.time[rows]
        own, chosen = select_columns(parameters[RATES], self.which[rows])
        shift, more = self._sum_lasting_errors(parameters, (DRIFT,), rows, e)
        residual = residual + self.slant[rows] * parameters[IONOSPHERE][:, 0] + (own + shift) * time
        J |= {IONOSPHERE: self.slant[rows, None, None], RATES: chosen * time[:, None, None]}
        J |= {name: by * time[:, None, None] for name, by in more.items()}
        return Linearized(residual[:, None], J, self.sigma[rows])
