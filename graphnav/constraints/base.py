"""The interface of all constraints: written once, used by every solver.

A constraint is N rows of m numbers, each row tied to one keyframe. `linearize` gives, at the states and parameter
values of some rows, the residual (predicted minus measured), its derivatives with respect to the blocks of the error
state and the parameters it depends on, and the measurement's sigma. It contains no filter or graph, and no weights,
gates or robust kernels: those belong to the solvers, which read `robust`, `robust_scale`, `gate`, `watched` and
`weight`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import pick_nearest
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, DIM, Parameter, States
from graphnav.imu.preintegration import Intervals
from graphnav.recording import Recording
from graphnav.recording.odometer import MeanSpeed
from graphnav.sensors import Series

if TYPE_CHECKING:
    from graphnav.constraints.raw_carrier import CarrierPairs
    from graphnav.constraints.raw_ppp import FreeRows
    from graphnav.constraints.raw_rows import PreparedRows
    from graphnav.constraints.vehicle import IntervalMotion


@dataclass(frozen=True)
class Linearized:
    """Rows at one point: residual (N, m), {block or parameter: (N, m, k)}, sigma (N, m)."""

    residual: Array
    jacobians: dict[str, Array]
    sigma: Array


@dataclass(frozen=True)
class BuildContext:
    """Everything from which a constraint builds its rows."""

    recording: Recording
    settings: Settings
    frame: LocalFrame
    t: Array  # (K,) keyframe times, s
    stationary: Array  # (M, 2) spans in which the platform is stationary, s
    intervals: Intervals  # (K-1) intervals between the keyframes
    speed: MeanSpeed | None = None  # preintegrated odometer, where it is available
    typical_sigmas: Array | None = None  # (M, 3) m, typical sigma stated by the fixes, where it is available

    # what several constraints are made of, derived once; their files import this one

    @cached_property
    def moving_rows(self) -> Array:
        """Intervals in which the vehicle moves, as `vehicle.find_moving_rows` says."""
        from graphnav.constraints.vehicle import find_moving_rows

        return find_moving_rows(self)

    @cached_property
    def interval_motion(self) -> IntervalMotion:
        """Mean motion over these intervals."""
        from graphnav.constraints.vehicle import IntervalMotion

        return IntervalMotion.of(self.intervals, self.moving_rows, self.frame)

    @cached_property
    def satellites(self) -> PreparedRows | None:
        """Rows of raw observations, those of epochs without a keyframe too, as `raw_rows.prepare_every` says."""
        from graphnav.constraints.raw_rows import prepare_every

        return prepare_every(self)

    @cached_property
    def satellite_rows(self) -> PreparedRows | None:
        """Those of epochs that have keyframes."""
        from graphnav.constraints.raw_rows import select_rows

        return select_rows(self.satellites)

    @cached_property
    def carrier_pairs(self) -> tuple[PreparedRows, CarrierPairs] | None:
        """Carriers of an arc at one epoch and the next, as `raw_carrier.pair_rows` says."""
        from graphnav.constraints.raw_carrier import pair_rows

        return pair_rows(self)

    @cached_property
    def ionosphere_free(self) -> FreeRows | None:
        """Rows of two signals without the ionosphere, as `raw_ppp.combine_rows` says."""
        from graphnav.constraints.raw_ppp import combine_rows

        return combine_rows(self)

    def get_series(self, name: str) -> Series | None:
        """The rows of a sensor of `graphnav.sensors`.

        Parameters
        ----------
        name
            Of the sensor.

        Returns
        -------
        Series or None
            None where there are none, or the settings exclude it.
        """
        series = self.recording.sensors.get(name)
        return series if series is not None and len(series) and self.settings.get_sensor(name).use else None

    def find_keyframes(self, t: Array) -> Array:
        """Index of the keyframe at each time.

        Parameters
        ----------
        t
            (n,) s.

        Returns
        -------
        array
            (n,) int, -1 where there is none within a microsecond.
        """
        best = pick_nearest(self.t, t)
        return np.where(np.abs(self.t[best] - t) < SAME_TIME, best, -1)


SAME_TIME = 1e-6  # s; measurements closer together than this share a keyframe


@dataclass(frozen=True)
class TypicalSigmas:
    """Typical sigmas stated by the fixes of a running drive: the units of their time-correlated errors."""

    overall: Callable[[], Array]  # (3,) m, of positions
    around: Callable[[Array], Array]  # keyframes (N,) -> (N, 6) m and m/s, of position and velocity
    spacing: float  # s, between the nodes of these errors


@dataclass(frozen=True)
class Constraint(ABC):
    """N rows of one kind of measurement. Subclasses add their arrays and `linearize`."""

    name: ClassVar[str]
    axes: ClassVar[tuple[str, ...]]
    unit: ClassVar[str]
    # True: its rows constrain how the vehicle rolls, given how the IMU is mounted in it
    of_wheels: ClassVar[bool] = False
    # False: rows can be built only once the intervals and the odometer are available
    looks_ahead: ClassVar[bool] = True
    of_stops: ClassVar[bool] = False  # True: its rows exist because the platform is stationary
    turns: ClassVar[bool] = False  # True: a turn of all states about the vertical changes nothing but what the Earth's
    # rate does, neither of the residuals nor of their sigmas
    iterated: ClassVar[bool] = False  # a filter linearises rows where they lead: they are strongly nonlinear
    # blocks for numerical differentiation, where `linearize` gives no Jacobians
    depends_on: ClassVar[tuple[str, ...]] = tuple(BLOCKS)
    words: ClassVar[Mapping[str, tuple[tuple[str, str, float], ...]]] = {}  # of its parameters' numbers, for people:
    # what it is, a unit, and how many of these are one of the parameter's own
    noise_axes: ClassVar[tuple[str, ...]] = ()  # variance component of each axis; none: its sigmas are taken as stated

    sensor: ClassVar[str] = ""  # name of the sensor of `graphnav.sensors` that the rows come from
    fix_of: ClassVar[str] = ""  # for fixes of a receiver: the block of the state that each measures, "p" or "v"

    keyframe: Array  # (N,) int, ascending
    parameters: tuple[Parameter, ...] = ()
    processes: tuple[
        Parameter, ...
    ] = ()  # parameters of its time-correlated errors, where a noise model has them (`graphnav.estimation.noise`)
    robust: str = "none"
    robust_scale: float | Array = 3.0  # or (N,)
    graduation: float = np.inf  # mu of graduated non-convexity; infinite once it has converged
    gate: float | None = None
    watched: bool = False  # for errors that last
    unscaled: Array | None = None  # (N, m) part of the sigmas that no variance factor scales: known geometry
    weight: Array | None = None  # (N,) weight of each row's information, 0 = not used; None: 1 for all
    notes: tuple[str, ...] = ()  # notes to be reported with the result

    def __len__(self) -> int:
        return len(self.keyframe)

    @property
    def labels(self) -> dict[str, Array]:
        """Names, azimuths and elevations of the satellites of the rows, (N,) each, for records; empty for other
        rows.
        """
        return {}

    def list_noise_groups(self) -> tuple[tuple[str, ...], Array]:
        """The variance components of the rows.

        Returns
        -------
        names : tuple of str
        component : array
            (N, m) number of that of each number, -1 for none.
        """
        names = tuple(dict.fromkeys(self.noise_axes))
        index = [names.index(axis) for axis in self.noise_axes] or [-1] * len(self.axes)
        return tuple(f"{self.name}.{name}" for name in names), np.broadcast_to(index, (len(self), len(index)))

    def compute_typical_error(self) -> Array:
        """Typical error of watched rows.

        Returns
        -------
        array
            (m,) 1-sigma of the whole error, white and time-correlated.
        """
        raise NotImplementedError(f"{self.name}: rows that are watched say what their errors usually are")

    def convert_units(self, typical: TypicalSigmas) -> Self:
        """Rows of a part of a drive with time-correlated errors in the units of the whole; fixes only.

        Parameters
        ----------
        typical
            Typical sigmas of the drive.

        Returns
        -------
        Constraint
            These rows, where they are none of fixes.
        """
        return self

    def scale_of(self, rows: slice | Array) -> float | Array:
        """Scale of the robust kernel.

        Parameters
        ----------
        rows
            Which of the N rows.

        Returns
        -------
        float or array
            One for all, or (n,).
        """
        return self.robust_scale[rows] if isinstance(self.robust_scale, np.ndarray) else self.robust_scale

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        """Times at which the constraint needs keyframes.

        Parameters
        ----------
        recording, settings
            Of the run.
        stationary
            (M, 2) s, spans in which the platform is stationary.

        Returns
        -------
        array
            (n,) s on the recording's clock, in any order; none by default.
        """
        return np.empty(0)

    @classmethod
    @abstractmethod
    def build(cls, scene: BuildContext) -> Constraint | None:
        """Build the rows for a recording.

        Parameters
        ----------
        scene
            Recording, settings, keyframes, stops and intervals.

        Returns
        -------
        Constraint or None
            Rows with ascending keyframes; None when the recording has no data for this constraint.
        """

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        """Linearise some rows.

        A constraint without Jacobians defines `residual` and a field `sigma` (N, m) instead, and is differentiated
        numerically.

        Parameters
        ----------
        states
            n states, that of the keyframe of each row.
        parameters
            By name, (n, k) values at each row.
        rows
            Which of the N rows these n are.

        Returns
        -------
        Linearized
            Residuals, Jacobians and sigmas of the n rows.
        """

        jacobians = {}
        for block in self.depends_on:

            def move_block(step: Array, at: slice = BLOCKS[block]) -> Array:
                delta = np.zeros((len(states), DIM))
                delta[:, at] = step
                return self.residual(states.plus(delta), parameters, rows)

            jacobians[block] = _differentiate(move_block, np.full(3, _DIFFERENCE_STEPS[block]))
        for p in self.parameters:

            def move_parameter(step: Array, name: str = p.name) -> Array:
                return self.residual(states, parameters | {name: parameters[name] + step}, rows)

            jacobians[p.name] = _differentiate(move_parameter, 1e-3 * np.atleast_2d(p.sigma)[0])
        sigma: Array = self.sigma  # type: ignore[attr-defined]
        return Linearized(self.residual(states, parameters, rows), jacobians, sigma[rows])

    def residual(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Array:
        """Residuals of some rows, for a constraint that is differentiated numerically.

        Parameters
        ----------
        states, parameters, rows
            As of `linearize`.

        Returns
        -------
        array
            (n, m) predicted minus measured.
        """
        raise NotImplementedError(f"{self.name}: has neither linearize nor residual")


# rad, m, m/s, m/s^2, rad/s: balance truncation error against rounding error of central differences
_DIFFERENCE_STEPS = {"theta": 1e-5, "p": 1e-1, "v": 1e-2, "ba": 1e-3, "bg": 1e-5}


def _differentiate(f: Callable[[Array], Array], steps: Array) -> Array:
    """(n, m, k) central differences about zero of f, (n, m), a function of a vector (k,)."""
    ways = np.diag(steps)
    return np.stack([(f(d) - f(-d)) / (2.0 * h) for d, h in zip(ways, steps, strict=True)], -1)


def assemble(linearized: Linearized, parameters: dict[str, slice] | None = None, width: int = DIM) -> Array:
    """Assemble the Jacobian over a whole error state.

    Parameters
    ----------
    linearized
        N rows of m numbers.
    parameters
        Columns of each parameter; they are left out when None.
    width
        Of the error state with its parameters.

    Returns
    -------
    array
        (N, m, width), zero where a block is not touched.
    """
    n, m = linearized.residual.shape
    H = np.zeros((n, m, width))
    for key, J in linearized.jacobians.items():
        if key in BLOCKS:
            H[:, :, BLOCKS[key]] = J
        elif parameters is not None and key in parameters:
            H[:, :, parameters[key]] = J
    return H


def weigh_sigma(rows: Constraint, sigma: Array, which: slice | Array = slice(None)) -> Array:
    """Sigmas that include the weights of their rows.

    Parameters
    ----------
    rows
        The constraint, whose `weight` is used.
    sigma
        (n, m) as stated.
    which
        The n rows that they are of.

    Returns
    -------
    array
        (n, m), infinite where the weight is 0.
    """
    if rows.weight is None:
        return sigma
    with np.errstate(divide="ignore"):
        return sigma / np.sqrt(rows.weight[which])[:, None]
