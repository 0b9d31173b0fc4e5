"""Carrier phases against a base station, with an ambiguity for each arc, and integer ambiguities.

With the quantities of `graphnav.constraints.raw_gnss`, and N the difference of rover's and base's ambiguity (cycles),

    r_phase   = |s - p_a| + b - m z + T - dt - lambda (phi - N) + g q - h sin(elevation)

b is the clock of the codes. There is one row per satellite and signal instead of double differences: sigmas are then
independent, a robust kernel concerns a single satellite, and no satellite is a reference. Receiver phase biases are
common to all ambiguities of one signal of a system; integers are therefore differences of two of them,

    r_integer = N_i - N_j - n_ij

(Teunissen and Montenbruck 2017, chapters 21, 23, 26). Rows exist only with a base station.

Multipath is time-correlated: residuals at correct integers are correlated over ten seconds to minutes and do not
average out like white noise. Float ambiguities draw the position from changes of millimetres while the directions to
the satellites turn, which white noise would tell to a centimetre. So each satellite has an error g q, q a process of
unit variance and g the size of the mean of its signals' multipath, independent from signal to signal; how signals
differ from that mean stays in the sigma of the rows.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from graphnav.config import Settings
from graphnav.constraints.ambiguities import CarrierRows, make_ambiguities, name_ambiguity
from graphnav.constraints.base import SAME_TIME, BuildContext, Constraint, Linearized
from graphnav.constraints.raw_gnss import (
    IONOSPHERE,
    list_common_fields,
    make_ionosphere_parameter,
    select_columns,
)
from graphnav.constraints.raw_rows import find_epoch_period, measure_gross
from graphnav.core.rotation import Array
from graphnav.core.state import Parameter, States
from graphnav.gnss.arcs import find_arcs
from graphnav.gnss.atmosphere import compute_obliquity
from graphnav.gnss.sigmas import REFLECTED, compute_carrier_sigma, compute_reflection_sigma
from graphnav.gnss.signals import GLONASS, L1, C
from graphnav.gnss.single_point import choose_coefficients, look
from graphnav.recording import Recording

REFLECTIONS = "gnss_reflections"
EXACT = 1e-3  # cycles, 1-sigma of an ambiguity difference fixed to an integer: a tenth of the phase noise


@dataclass(frozen=True)
class GnssPhase(CarrierRows):
    """Carrier phase of one satellite at the antenna, differenced with a base station's."""

    name: ClassVar[str] = "gnss_phase"
    unit: ClassVar[str] = "m"
    noise_axes: ClassVar[tuple[str, ...]] = ()

    slant: Array = field(default_factory=lambda: np.empty(0))  # (N,) ionospheric mapping function
    which: Array = field(default_factory=lambda: np.empty(0, dtype=int))  # (N,) satellite, index into their errors
    reflected: Array = field(default_factory=lambda: np.empty(0))  # (N,) m, of a unit of these

    def list_noise_groups(self) -> tuple[tuple[str, ...], Array]:
        return (), np.full((len(self), 1), -1)

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)  # those of the codes

    @classmethod
    def build(cls, scene: BuildContext) -> GnssPhase | None:
        s, raw = scene.settings.raw_gnss, scene.recording.raw_gnss
        found = scene.satellite_rows if s.carrier and s.code else None
        if found is None or raw is None or not np.isfinite(raw.carrier_difference).any():
            return None
        arcs = find_arcs(raw, base_arc=raw.base_arc)
        keyframe = scene.find_keyframes(raw.t)
        # the codes' epochs, with which the clocks are shared; all signals of a satellite
        used = (arcs.arc >= 0) & ~(raw.cn0 < s.cn0) & np.isin(keyframe, found.keyframe)
        used &= (raw.t >= scene.t[0] - SAME_TIME) & (raw.t <= scene.t[-1] + SAME_TIME)
        geometry = look(raw, raw.antenna, choose_coefficients(raw))
        used &= geometry.elevation >= np.radians(s.elevation)
        if not used.any():
            return None
        wavelength = C / raw.frequency
        code = raw.code + raw.difference
        code = code - measure_gross(raw, code, geometry)  # an arc begins with what the others predict
        guess = raw.carrier + (raw.carrier_difference - code) / wavelength
        guess = np.where(np.isfinite(guess), guess, 0.0)
        own = make_ambiguities(arcs, guess, wavelength)
        there = [k for k in sorted(own) if np.any(used & (arcs.slot == k))]
        place = np.full(len(arcs.names), -1)
        place[there] = np.arange(len(there))
        family = arcs.satellite[there].astype(int) // 100 * 1000 + arcs.signal[there]
        family[arcs.satellite[there] // 100 == GLONASS] = -1  # FDMA: each satellite has its own frequency
        frame, raw = scene.frame, raw.take(used)
        geometry = look(raw, raw.antenna, choose_coefficients(raw))
        common = list_common_fields(scene, found)
        if s.robust == "automatic":
            common["robust"] = "cauchy"  # for undetected cycle slips
        common |= {
            "keyframe": keyframe[used],
            "s_n": (geometry.s - frame.r_e) @ frame.R_ne.T,
            "R_ln": np.empty((int(used.sum()), 0, 0)),
            "satellite": raw.satellite,
            "azimuth": geometry.azimuth,
            "elevation": geometry.elevation,
            "level": np.zeros(int(used.sum()), dtype=int),
        }
        satellites, which = raw.satellites
        many = len(satellites)
        lasting = Parameter.centred(REFLECTIONS, many, 1.0, "1", correlation_time=REFLECTED, spacing=found.spacing)
        common["parameters"] += (make_ionosphere_parameter(found.raw, found.spacing), lasting, *(own[k] for k in there))
        # of two receivers; the mean of a satellite's signals, and their differences from it
        reflection = np.sqrt(2.0) * compute_reflection_sigma(geometry.elevation)
        share = 1.0 / _count_signals(keyframe[used], raw.satellite)
        apart = reflection * np.sqrt(1.0 - share)
        white = np.sqrt(2.0) * compute_carrier_sigma(raw.cn0, geometry.elevation, wavelength[used])
        known = geometry.distance + geometry.troposphere - geometry.ionosphere
        return cls(
            offset=known - wavelength[used] * raw.carrier - raw.carrier_difference - raw.clock,
            nominal=(raw.antenna - frame.r_e) @ frame.R_ne.T,
            which=which,
            reflected=reflection * np.sqrt(share),
            reflection=apart / wavelength[used],
            period=find_epoch_period(found.raw, s),
            slant=-compute_obliquity(geometry.elevation) * (L1 / raw.frequency) ** 2,
            wavelength=wavelength[used],
            half_slip=0.25 * wavelength[used],  # of half a cycle
            sigma=np.hypot(white, apart)[:, None],
            slot=place[arcs.slot[used]],
            begin=arcs.begin[used],
            whole=~raw.half,
            slots=tuple(name_ambiguity(arcs.names[k]) for k in there),
            family=family,
            **common,
        )

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        residual, J, _ = self._linearize_ranges(states, parameters, rows, IONOSPHERE, self.slant[rows])
        wavelength, slot = self.wavelength[rows], self.slot[rows]
        for k in np.unique(slot).tolist():
            name, own = self.slots[k], np.where(slot == k, wavelength, 0.0)
            residual = residual + own * parameters[name][:, 0]
            J[name] = own[:, None, None]
        own, chosen = select_columns(parameters[REFLECTIONS], self.which[rows])
        reflected = self.reflected[rows]
        residual, J[REFLECTIONS] = residual + reflected * own, reflected[:, None, None] * chosen
        return Linearized(residual[:, None], J, self.sigma[rows])


def compute_variance_left(duration: Array, period: float) -> Array:
    """Excess variance of the mean of unit-variance multipath over a time (s), beyond that of white noise.

    The variance of the mean of a Gauss-Markov sequence (Brockwell and Davis 1991, section 7.1) less 1 / n.
    """
    n, a = 1.0 + duration / period, np.exp(-period / REFLECTED)
    return np.asarray(2.0 * a / (n * (1.0 - a)) * (1.0 - (1.0 - a**n) / (n * (1.0 - a))))


def _count_signals(keyframe: Array, satellite: Array) -> Array:
    """(N,) number of signals of each row's satellite at its epoch."""
    _, of, many = np.unique(np.stack([keyframe, satellite]), axis=1, return_inverse=True, return_counts=True)
    return np.asarray(many[of.reshape(-1)])


@dataclass(frozen=True)
class WholeCycles(Constraint):
    """Difference of two ambiguities of a signal, fixed to an integer (`graphnav.gnss.integers`)."""

    name: ClassVar[str] = "gnss_integers"
    axes: ClassVar[tuple[str, ...]] = ("cycles",)
    unit: ClassVar[str] = "cycles"

    slots: tuple[str, ...] = ()
    pair: Array = field(default_factory=lambda: np.empty((0, 2), dtype=int))  # (N, 2) index of `slots`
    cycles: Array = field(default_factory=lambda: np.empty(0))  # (N,) first less second

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        return np.empty(0)

    @classmethod
    def build(cls, scene: BuildContext) -> WholeCycles | None:
        return None  # fixed from an estimate, not from a recording

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        pair, residual = self.pair[rows], -self.cycles[rows]
        J = {}
        for k in np.unique(pair).tolist():
            sign = (pair[:, 0] == k).astype(float) - (pair[:, 1] == k)
            residual = residual + sign * parameters[self.slots[k]][:, 0]
            J[self.slots[k]] = sign[:, None, None]
        return Linearized(residual[:, None], J, np.full((len(pair), 1), EXACT))
