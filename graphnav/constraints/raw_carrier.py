"""What carriers of single satellites change by from one epoch to the next: range differences to millimetres.

A carrier counts cycles from an unknown number on; between two epochs without a slip that number stays and the change is
a range change (van Graas and Soloviev 2004, "Precise velocity estimation using a stand-alone GPS receiver"). With a the
place of the antenna at the epoch before and p_a = p + R_nb l that of now::

    r = |s - p_a| - |s' - a| + w + [T - I - dt] - [m] z + (h - e_l.g) (t - t') - lambda [phi]

[x] is the change of x, w that of the receiver's clock, which is anew at every epoch, z what the model of the ionosphere
is wrong by at the zenith, the same as in the codes. g is what the atmosphere, satellites' clocks and orbits do to all
of them together over minutes, as a velocity in east, north, up, and h what they do to one satellite for hours. Without
h and z the sum of changes over minutes would be known to centimetres, and so would the place: directions to satellites
turn by a hundredth in a minute, so a place a metre off changes ranges by a centimetre, and so do these errors.

Errors of single changes are white here. What a carrier is off by at one epoch cancels in the sum of two changes, but
reflections and the ionosphere add up like a random walk of 2 mm in the root of a second over 20 to 300 s (measured on
ucr_riverside_20200712), which is what white changes make.

The place a is a parameter that begins anew at every other epoch, two of them in turn, and is tied to the state of its
own epoch by rows of its own (stochastic cloning: Roumeliotis and Burdick 2002), so that a row knows both places, both
attitudes through the lever arm and how far each is certain, in every solver.

Slips end an arc (`graphnav.gnss.arcs`), by the receiver's flags and by the other satellites of the epoch; one that
neither tells meets the kernel, which judges it by what all other rows and the IMU say.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from graphnav.config import Settings
from graphnav.constraints.base import BuildContext, Constraint, Linearized
from graphnav.constraints.gnss import LEVER_ARM
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
from graphnav.gnss.atmosphere import obliquity
from graphnav.gnss.carrier import number_epochs, pair_consecutive
from graphnav.gnss.series import compute_epoch_medians
from graphnav.gnss.sigmas import compute_carrier_sigma
from graphnav.gnss.signals import L1, C
from graphnav.recording import Recording

CHANGE = "receiver_clock_change"
CLONES = ("gnss_antenna_of_even_epochs", "gnss_antenna_of_odd_epochs")
DRIFT = "gnss_carrier_drift"
RATES = "gnss_satellite_rates"
_CHANGE_SIGMA = 100.0  # m, about the median over the satellites at places that may be that far off
_ANYWHERE = 1e3  # m, 1-sigma of an antenna's place before its tie: nothing known
_TIE = 5e-4  # m, a tenth of what a carrier's change is good to
# m/s, 1-sigma, of the ionosphere and broadcast clocks: Klobuchar's delay goes from 1.5 to 10 m in six hours
_DRIFT = np.array([5e-4, 5e-4, 1e-3])


@dataclass(frozen=True)
class CarrierPairs:
    """Rows of one satellite and signal at two epochs next to each other, made once for a scene."""

    before: NDArray[np.intp]  # (N,) of the prepared rows
    after: NDArray[np.intp]
    number: NDArray[np.intp]  # (E,) of the epochs, -1 for one that changes are not counted to
    epochs: Array  # (E,) s
    first: NDArray[np.intp]  # (E,) a prepared row of each epoch
    change: Array  # (N,) m, all that does not depend on the estimate
    clock: Array  # (E,) m, of the receiver since the epoch before, roughly


def _list_epochs(recording: Recording, settings: Settings) -> Array:
    raw = select_observations(recording, settings) if _use_differences(recording, settings) else None
    return np.empty(0) if raw is None else np.unique(raw.t[np.isfinite(raw.carrier)])


def _use_differences(recording: Recording, settings: Settings) -> bool:
    """Not where the carriers are used with their ambiguities: both kinds of rows are of the same numbers."""
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
    # of a phase the ionosphere's delay is negative
    level = found.known - 2.0 * found.ionosphere - raw.clock - raw.carrier * C / raw.frequency
    change = level[after] - level[before]
    clock = np.zeros(len(epochs))
    clock[of[after]] = -compute_epoch_medians(raw.t[after], change)
    some = found.keyframe[after] >= 0  # of a piece, changes to the epoch before it are there already
    number = number_epochs(raw)[first]
    return found, CarrierPairs(before[some], after[some], number, epochs, first, change[some], clock)


def _clone_antennas(found: PreparedRows, pairs: CarrierPairs) -> tuple[Parameter, ...]:
    out = []
    for k, name in enumerate(CLONES):
        own = np.flatnonzero((pairs.number >= 0) & (pairs.number % 2 == k))
        own = own if len(own) else np.zeros(1, dtype=int)  # a piece may have none: any begin will do
        sigma = np.full((len(own), 3), _ANYWHERE)
        out.append(Parameter(name, found.nominal[pairs.first[own]], sigma, "m", begins=pairs.epochs[own]))
    return tuple(out)


@dataclass(frozen=True)
class GnssAntennaClone(Constraint):
    """The antenna's place at an epoch, kept for the next."""

    name: ClassVar[str] = "gnss_antenna_clone"
    axes: ClassVar[tuple[str, ...]] = ("east", "north", "up")
    unit: ClassVar[str] = "m"

    lever_arm: Array = field(default_factory=lambda: np.zeros(3))
    odd: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) which of `CLONES`

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
    """A satellite's carrier has counted on since the epoch before."""

    name: ClassVar[str] = "gnss_carrier"
    unit: ClassVar[str] = "m"

    change: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, all that does not depend on the estimate
    nominal: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m, antenna
    s_before: Array = field(default_factory=lambda: np.empty((0, 3)))  # (N, 3) m, satellite at the epoch before
    nominal_before: Array = field(default_factory=lambda: np.empty((0, 3)))
    time: Array = field(default_factory=lambda: np.empty(0))  # (N,) s since the epoch before
    odd: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) which of `CLONES` is of that epoch
    which: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) satellite, in the order of their rates
    slant: Array = field(default_factory=lambda: np.empty(0))  # (N,) change of the ionosphere's delay over the zenith's

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
        if scene.settings.raw_gnss.robust == "automatic":  # a slip is no error that a variance can describe
            common["robust"] = "cauchy"
        E = len(pairs.epochs)
        satellites, which = raw.take(k).satellites
        many = len(satellites)
        minutes, hours = scene.settings.gnss.slow_times
        common["parameters"] = (
            Parameter(CHANGE, pairs.clock[:, None], np.full((E, 1), _CHANGE_SIGMA), "m", begins=pairs.epochs),
            # what has a size and a correlation time changes by the one in the other
            Parameter(
                RATES, np.zeros(many), np.full(many, ONE / hours), "m/s", correlation_time=hours, spacing=found.spacing
            ),
            make_ionosphere_parameter(raw, found.spacing),
            *_clone_antennas(found, pairs),
        )
        # of a phase the delay is negative; against a base the parameter is what lies between the two receivers
        delay = -obliquity(found.elevation) * (0.0 if raw.differenced else (L1 / raw.frequency) ** 2)
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
