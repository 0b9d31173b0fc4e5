"""The contract of every constraint: written once, used by every solver.

A constraint is N rows of m numbers, each row tied to one keyframe. `linearize` gives, at the states and
parameter values of some rows, the residual (predicted minus measured), its derivative with respect to
the error-state blocks and parameters it depends on, and the measurement's sigma. It knows nothing of
filters or graphs, and no weights, gates or robust kernels: those belong to the solvers, which read
`robust`, `robust_scale`, `gate`, `watched` and `weight`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.shared import Shared
from graphnav.core.state import BLOCKS, DIM, Parameter, States
from graphnav.imu.preintegration import Intervals
from graphnav.recording import Recording
from graphnav.recording.odometer import MeanSpeed
from graphnav.sensors import Series


@dataclass(frozen=True)
class Linearized:
    """Rows at one point: residual (N, m), {block or parameter: (N, m, k)}, sigma (N, m)."""

    residual: Array
    jacobians: dict[str, Array]
    sigma: Array


@dataclass(frozen=True)
class BuildContext(Shared):
    """What a constraint may look at to build its rows."""

    recording: Recording
    settings: Settings
    frame: LocalFrame
    t: Array  # (K,) keyframe times, s
    stationary: Array  # (M, 2) spans in which the platform stands still, s
    intervals: Intervals  # (K-1) between the keyframes
    speed: MeanSpeed | None = None  # of the odometer, where it is known already
    typical_sigmas: Array | None = None  # (M, 3) m, sigma that the fixes usually state, where it is known already

    def series(self, name: str) -> Series | None:
        """The rows of a sensor of `graphnav.sensors`; None where there are none, or the settings do not use it."""
        series = self.recording.sensors.get(name)
        return series if series is not None and len(series) and self.settings.sensor(name).use else None

    def keyframe_at(self, t: Array) -> Array:
        """Index of the keyframe at each time, -1 where there is none."""
        right = np.clip(np.searchsorted(self.t, t), 0, len(self.t) - 1)
        left = np.maximum(right - 1, 0)
        best = np.where(np.abs(self.t[left] - t) < np.abs(self.t[right] - t), left, right)
        return np.where(np.abs(self.t[best] - t) < SAME_TIME, best, -1)


SAME_TIME = 1e-6  # s; measurements closer than this share a keyframe


@dataclass(frozen=True)
class UsualSigmas:
    """What the fixes of a running drive usually state: the units of their errors that last."""

    overall: Callable[[], Array]  # (3,) m, of positions
    around: Callable[[Array], Array]  # keyframes (N,) -> (N, 6) m and m/s, of position and velocity
    spacing: float  # s, of the nodes of these errors


@dataclass(frozen=True)
class Constraint(ABC):
    """N rows of one kind of measurement. Subclasses add their arrays and `linearize`."""

    name: ClassVar[str]
    axes: ClassVar[tuple[str, ...]]
    unit: ClassVar[str]
    of_wheels: ClassVar[bool] = False  # True: its rows tell how the vehicle rolls, by how the IMU is mounted in it
    looks_ahead: ClassVar[bool] = True  # False: once the intervals and the odometer are there, rows can be built
    of_stops: ClassVar[bool] = False  # True: its rows are there because the platform stands
    turns: ClassVar[bool] = False  # True: a turn of all states about the vertical changes nothing but what the Earth's
    # rate does, neither of the residuals nor of their sigmas
    passes: ClassVar[int] = 1  # of a filter's update; more for rows that are far from linear over its uncertainty
    depends_on: ClassVar[tuple[str, ...]] = tuple(BLOCKS)  # blocks to differentiate by, where `linearize` does not say
    words: ClassVar[Mapping[str, tuple[tuple[str, str, float], ...]]] = {}  # of its parameters' numbers, for people:
    # what it is, a unit, and how many of these are one of the parameter's own
    noise_axes: ClassVar[tuple[str, ...]] = ()  # variance component of each axis; none: its sigmas are taken as stated

    sensor: ClassVar[str] = ""  # of `graphnav.sensors` whose rows they are
    fix_of: ClassVar[str] = ""  # of a receiver's fixes: the block of the state that each gives, "p" or "v"

    keyframe: Array  # (N,) int, ascending
    parameters: tuple[Parameter, ...] = ()
    processes: tuple[
        Parameter, ...
    ] = ()  # of its errors; parameters where a noise model has them (`graphnav.estimation.noise`)
    robust: str = "none"
    robust_scale: float | Array = 3.0  # or (N,)
    graduation: float = np.inf  # mu of graduated non-convexity; infinite at its end
    gate: float | None = None
    watched: bool = False  # for errors that last
    unscaled: Array | None = None  # (N, m) part of the sigmas that no variance factor scales: known geometry
    weight: Array | None = None  # (N,) of each row's information, 0 = not used; all 1 when None
    notes: tuple[str, ...] = ()  # sentences that belong with the result

    def __len__(self) -> int:
        return len(self.keyframe)

    @property
    def labels(self) -> dict[str, Array]:
        """What a record of rows of satellites has beside them: their names, azimuths and elevations, (N,) each."""
        return {}

    def noise_groups(self) -> tuple[tuple[str, ...], Array]:
        """Names of the variance components of the rows, and which of them each number (N, m) has; -1 for none."""
        names = tuple(dict.fromkeys(self.noise_axes))
        index = [names.index(axis) for axis in self.noise_axes] or [-1] * len(self.axes)
        return tuple(f"{self.name}.{name}" for name in names), np.tile(index, (len(self), 1))

    def typical_error(self) -> Array:
        """(m,) typical 1-sigma of a whole error, white part and what lasts, of rows that are watched."""
        raise NotImplementedError(f"{self.name}: rows that are watched say what their errors usually are")

    def in_units_of(self, usual: UsualSigmas) -> Self:
        """The same rows, errors that last told in the units of a drive of which they are a part; of fixes alone."""
        return self

    def scale_of(self, rows: slice | Array) -> float | Array:
        """Scale of the kernel for some rows."""
        return self.robust_scale[rows] if isinstance(self.robust_scale, np.ndarray) else self.robust_scale

    @classmethod
    def epochs(cls, recording: Recording, settings: Settings, stationary: Array) -> Array:
        """Times (s) at which this constraint wants keyframes; none unless it says so."""
        return np.empty(0)

    @classmethod
    @abstractmethod
    def build(cls, scene: BuildContext) -> Constraint | None:
        """The rows for a recording, or None when it has nothing for this constraint."""

    def linearize(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Linearized:
        """Rows `rows` at `states` (one per row) and parameter values (n, k), one per row.

        One that gives no Jacobians has `residual` and a field `sigma` (N, m), and is differentiated numerically.
        """

        jacobians = {}
        for block in self.depends_on:

            def residual_at(step: Array, at: slice = BLOCKS[block]) -> Array:
                delta = np.zeros((len(states), DIM))
                delta[:, at] = step
                return self.residual(states.plus(delta), parameters, rows)

            jacobians[block] = _differentiate(residual_at, np.full(3, _STEPS[block]))
        for p in self.parameters:

            def along(step: Array, name: str = p.name) -> Array:
                return self.residual(states, parameters | {name: parameters[name] + step}, rows)

            jacobians[p.name] = _differentiate(along, 1e-3 * np.atleast_2d(p.sigma)[0])
        sigma: Array = self.sigma  # type: ignore[attr-defined]
        return Linearized(self.residual(states, parameters, rows), jacobians, sigma[rows])

    def residual(self, states: States, parameters: dict[str, Array], rows: slice | Array) -> Array:
        """(n, m) predicted minus measured, of a constraint that leaves its Jacobians to differences."""
        raise NotImplementedError(f"{self.name}: has neither linearize nor residual")


# rad, m, m/s, m/s^2, rad/s: central differences lose the square of a step and the digits of a residual over it
_STEPS = {"theta": 1e-5, "p": 1e-1, "v": 1e-2, "ba": 1e-3, "bg": 1e-5}


def _differentiate(f: Callable[[Array], Array], steps: Array) -> Array:
    """(n, m, k) central differences of f (n, m) of a vector (k,) about zero."""
    ways = np.diag(steps)
    return np.stack([(f(d) - f(-d)) / (2.0 * h) for d, h in zip(ways, steps, strict=True)], -1)


def assemble(linearized: Linearized, parameters: dict[str, slice] | None = None, width: int = DIM) -> Array:
    """The Jacobian over a whole error state.

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
    """Sigmas with the weights of their rows in them.

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
