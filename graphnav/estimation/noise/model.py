"""The noise model: variance factors, correlation times, and weights of rows.

A variance component is a group of numbers whose stated variances are wrong by one common factor:

    imu.gyro_noise_density ...            the four figures of `ImuNoise` that drive the intervals between keyframes
    gnss_position.horizontal, .up         white part of the fixes, `gnss_position.fixed.up` where types differ
    gnss_position.minutes.up ...          a Gauss-Markov process beside it, of seconds, minutes or hours
    nhc.right, odometer.forward ...       and the same of wheels and of the receiver's velocities

Factors are in units of what is stated; that of a process is in units of the stated white variance of its fixes, or of
the process that the settings of the wheels state. A process with factor 0 does not exist: with `STATED`, all factors
are 1 and no process exists, so a problem is as recording and settings state.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from graphnav.core.rotation import Array

INTERVALS = ("imu.gyro", "imu.accel")  # white noise of the IMU, of which single intervals can have more than usual
TABULATED = ("noise.imu", "noise.rows")  # keys of notes whose figures a report has as a table


@dataclass(frozen=True)
class VarianceComponent:
    """A variance component: natural logarithm of its variance factor, with its uncertainty and its prior."""

    log_factor: float
    sigma: float = 0.0  # 1-sigma of `log_factor`
    prior: float = 0.0  # median of the prior, log
    prior_sigma: float = 0.0
    freedom: float = 0.0  # degrees of freedom: of as many squares alone, its factor would be as uncertain

    @property
    def factor(self) -> float:
        """On the variance."""
        return float(np.exp(self.log_factor))


@dataclass(frozen=True)
class RowWeights:
    """Rows of a constraint, or intervals of an IMU, with less information than their sigmas state."""

    t: Array  # (n,) s, ascending; where a time has several rows, all of them; of an interval its end
    weight: Array  # (n,) in (0, 1]


@dataclass(frozen=True)
class StampOffsets:
    """Offsets of stamps about which rows are linearised, s, to be added (`graphnav.estimation.stamps`)."""

    positions: float = 0.0
    velocities: float = 0.0
    odometer: float = 0.0
    rate: float = 0.0  # s/s, of those of positions and velocities
    since: float = 0.0  # s, the stamp from which on the rate is counted


@dataclass(frozen=True)
class FreedConstant:
    """Value and prior sigma of a parameter that replaces a stated constant (`graphnav.estimation.contradictions`)."""

    value: tuple[float, ...]
    sigma: tuple[float, ...]  # 1-sigma of its prior


@dataclass(frozen=True)
class Remounting:
    """The device was turned in its holder (`graphnav.estimation.remounting`)."""

    begin: float  # s
    end: float  # s
    rotation: tuple[float, ...]  # rad, (3,) rotation vector that turns what it measured after that back
    sigma: float  # rad, 1-sigma about each axis


@dataclass(frozen=True)
class Rival:
    """Spans of fixes that may be wrong instead of those that a noise model excludes."""

    probability: float  # that these are
    excluded: Mapping[str, tuple[tuple[float, float], ...]]  # spans (s) by constraint


@dataclass(frozen=True)
class NoiseModel:
    """Noise model of all sensors; whatever it does not name is as stated."""

    figures: Mapping[str, VarianceComponent] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)  # s, correlation time of a process by its parameter
    weights: Mapping[str, RowWeights] = field(default_factory=dict)  # by constraint, and by `INTERVALS`
    excluded: Mapping[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)  # spans (s) by constraint
    # weights, by constraint and span, of what is excluded (`graphnav.estimation.noise.span_variances`)
    span_weights: Mapping[str, tuple[tuple[float, float, float], ...]] = field(default_factory=dict)
    spacing: float = 0.0  # s, at least, between the fixes that are used (`graphnav.estimation.noise.spacing`)
    stamps: StampOffsets = StampOffsets()
    freed: Mapping[str, FreedConstant] = field(default_factory=dict)  # by the parameter's name
    # index of the errors of a constraint's rows (`graphnav.estimation.noise.tails`)
    tails: Mapping[str, float] = field(default_factory=dict)
    false_stops: tuple[tuple[float, float], ...] = ()  # spans (s) in which the platform moves, whatever detectors say
    searched: bool = False  # whether initial points are searched for, because the filter's lead to a worse optimum
    rivals: tuple[Rival, ...] = ()  # of `excluded`, nearly as likely (`graphnav.estimation.noise.rivals`)

    remountings: tuple[Remounting, ...] = ()  # in the order in which they are undone

    def get_factor(self, group: str, missing: float) -> float:
        """The factor on the variance of a group.

        Parameters
        ----------
        group
            Name of a variance component.
        missing
            What is returned where the model has no figure of it.

        Returns
        -------
        float
            Estimated over stated variance.
        """
        return self.figures[group].factor if group in self.figures else missing


STATED = NoiseModel()
