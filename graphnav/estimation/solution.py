"""The result of a solver: states, covariances, parameters, residuals and a record of the solution."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.core.errors import EstimationError
from graphnav.core.rotation import Array
from graphnav.core.state import BLOCKS, States, split_covariance
from graphnav.core.trajectory import Trajectory
from graphnav.detectors.base import Detection
from graphnav.estimation.noise.model import STATED, NoiseModel, RowWeights

KNOWN = ("ekf", "rts", "incremental", "isam2", "batch")  # solvers
_OUT = 9  # errors of attitude, position, velocity, which are those of a trajectory
_BLOCK_ROWS = 4096  # rows of a block: 25 MB while it is processed


class Between(Protocol):
    """States between the keyframes of one piece of a recording."""

    @property
    def start(self) -> float:
        """First time, s."""
        ...

    @property
    def end(self) -> float:
        """Last time, s."""
        ...

    def list_times(self, rate: float) -> Array:
        """Times at a rate, ends included."""
        ...

    def __call__(self, t: Array) -> tuple[States, Array]:
        """States and covariances (M, 15, 15) at times within it."""
        ...

    def interpolate_blocks(self, t: Array) -> tuple[States, dict[str, Array]]:
        """The same with covariances (6, M) of position, velocity and attitude each by itself."""
        ...


@dataclass(frozen=True)
class ConstraintRecord:
    """Rows of one constraint in one solver: innovations of a filter, residuals of a smoother."""

    kind: str  # "innovation" or "residual"
    t: Array  # (N,) s
    residual: Array  # (N, m) predicted minus measured
    sigma: Array  # (N, m) of the innovation (state and measurement) or of the measurement
    nis: Array  # (N,) normalised squared innovation, as weighted, or residual, at the full weight; chi-square with m
    # degrees of freedom for a filter
    weight: Array  # (N,) robust weight, 1 = Gaussian, 0 = rejected
    axes: tuple[str, ...]  # names of the m components
    unit: str
    satellite: Array = field(default_factory=lambda: np.empty(0, dtype=str))  # (N,) names, for rows of satellites
    azimuth: Array = field(default_factory=lambda: np.empty(0))  # (N,) rad from north to the east, of these
    elevation: Array = field(default_factory=lambda: np.empty(0))  # (N,) rad, of these


@dataclass(frozen=True)
class ParameterEstimate:
    """A constant or time-varying parameter: `t` holds its nodes, one for a constant."""

    t: Array  # (n,) s
    value: Array  # (n, k)
    sigma: Array  # (n, k)
    prior_sigma: Array  # (k,)
    unit: str

    @property
    def observable(self) -> Array:
        """(k,) whether the data removed more than half of the prior uncertainty."""
        return self.sigma[-1] < 0.5 * self.prior_sigma


@dataclass(frozen=True)
class CarrierArcs:
    """Spans of continuous carrier tracking, split where the ambiguity became an integer or ceased to be one."""

    name: Array = field(default_factory=lambda: np.empty(0, dtype=str))  # (S,) satellite and signal: "G05.1C"
    begin: Array = field(default_factory=lambda: np.empty(0))  # (S,) s, first epoch of the stretch
    end: Array = field(default_factory=lambda: np.empty(0))  # (S,) s, last epoch
    integer: Array = field(default_factory=lambda: np.empty(0, dtype=bool))  # (S,)

    @classmethod
    def from_rows(cls, t: Array, slot: Array, arc: Array, integer: Array, names: Sequence[str]) -> CarrierArcs:
        """Make the spans of N rows.

        Parameters
        ----------
        t : (N,) s, of the epochs.
        slot : (N,) index of `names`.
        arc : (N,) s, when each row's arc begins.
        integer : (N,) whether its ambiguity is held as an integer.
        """
        order = np.lexsort((t, slot))
        key = np.stack([slot[order], arc[order], integer[order]], -1)
        first = np.flatnonzero(np.any(np.diff(key, axis=0, prepend=np.nan) != 0.0, axis=1))
        last = np.append(first[1:], len(order))[: len(first)] - 1
        of = order[first]
        return cls(np.array(names, dtype=str)[slot[of]], t[of], t[order[last]], integer[of].astype(bool))


@dataclass(frozen=True)
class ExcludedSpan:
    """Consecutive rows of one constraint that are wrong: not used, or with the variance that their errors show."""

    kind: str  # name of the constraint
    t_start: float  # s, of the first row
    t_end: float  # s, of the last
    count: int
    reason: str = ""
    sigma_factor: float = np.inf  # by which their sigmas are multiplied; infinite where no solver uses them


@dataclass(frozen=True)
class Separation:
    """Position of the forward filter minus that by the information after each keyframe
    (`graphnav.estimation.separation`).
    """

    t: Array  # (K,) s
    value: Array  # (K, 3) m, east, north, up; NaN where there is no information after it
    sigma: Array  # (K, 3) m, 1-sigma of `value`


@dataclass(frozen=True)
class Solution:
    """The solution of one solver. Covariance blocks are of the error state of `graphnav.core.state`, (K, 15, 15)."""

    solver: str
    frame: LocalFrame
    t: Array  # (K,) s
    states: States
    covariance: Array
    parameters: dict[str, ParameterEstimate] = field(default_factory=dict)
    records: dict[str, ConstraintRecord] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)  # number of factors or updates by kind
    iterations: int = 0
    cost: float = float("nan")  # half the sum of squared whitened residuals at the end
    stopped: str = ""  # why it stopped, a sentence
    timings: dict[str, float] = field(default_factory=dict)  # s by stage
    notes: tuple[str, ...] = ()
    detections: tuple[Detection, ...] = ()  # detections of stationary intervals, the fused one last
    excluded: tuple[ExcludedSpan, ...] = ()  # excluded spans of measurements, the same for all solvers
    noise: NoiseModel = STATED  # noise model, the same for all solvers
    passes: Mapping[str, int] = field(default_factory=dict)  # factors over all keyframes, apart from the solver's own
    # functions that make the result of `to_gtsam`, one for each piece
    graphs: tuple[Callable[[], tuple[Any, Any]], ...] = ()
    separation: Separation | None = None  # of filter and smoother, the same for all solvers
    # s of epochs with carriers, and 1 where they have integers
    fixed: Array = field(default_factory=lambda: np.empty((0, 2)))
    arcs: CarrierArcs = field(default_factory=CarrierArcs)  # of carriers with ambiguities
    between: tuple[Between, ...] = ()  # give states between keyframes, one for each piece of the recording

    @property
    def stationary(self) -> Array:
        """(M, 2) s, spans in which the platform is stationary."""
        spans = [d.intervals for d in self.detections if d.name == "fused"]
        return np.concatenate([np.empty((0, 2)), *spans])

    def to_gtsam(self, piece: int = 0) -> tuple[Any, Any]:
        """The problem as GTSAM's `NonlinearFactorGraph` and this solution as its `Values`.

        Variables are X(k) Pose3, V(k) velocity, B(k) imuBias.ConstantBias of keyframe k, and Q(j) nodes of parameters
        (`graphnav.estimation.factor_graph.nonlinear`). Sigmas and weights are those that were used.

        Parameters
        ----------
        piece : of a recording that was cut where its IMU was silent for too long. One that was solved in parts because
            of its length has none.

        Returns
        -------
        graph : gtsam.NonlinearFactorGraph
            Of `CustomFactor`s, one for each row, interval and parameter step.
        values : gtsam.Values
            The solution.

        Raises
        ------
        EstimationError
            If there is no such piece.
        """
        if not 0 <= piece < len(self.graphs):
            raise EstimationError(
                f"to_gtsam: no piece {piece}; the solution has {len(self.graphs)}"
                + ("" if self.graphs else ": it was solved in parts; solve one hour of it"),
                key="pieces.none_such",
            )
        return self.graphs[piece]()

    def trajectory(self, rate: float | None = None, joint: bool = True) -> Trajectory:
        """The solution in geodetic coordinates and local axes.

        Parameters
        ----------
        rate
            Hz, from the IMU's samples between the keyframes; at the keyframes when None.
        joint
            With (K, 9, 9) covariances of position (m), velocity (m/s) and roll, pitch, heading (rad) beside the sigmas.

        Returns
        -------
        Trajectory
            Of the IMU.
        """
        t, states, covariance = self.t, self.states, self.covariance
        if rate is not None:
            t, states, covariance = self.at(np.concatenate([b.list_times(rate) for b in self.between]))
        return make_trajectory(
            self.solver, self.frame, t, states, covariance if joint else split_covariance(covariance)
        )

    def blocks(self, rate: float | None = None) -> Iterator[Trajectory]:
        """`trajectory` in successive parts, only one of which need be in memory.

        Parameters
        ----------
        rate
            As for `trajectory`.

        Returns
        -------
        iterator of Trajectory
            Of 4096 rows at most each; a single part at the keyframes.
        """
        if rate is None:
            yield self.trajectory(joint=False)
            return
        for piece in self.between:
            times = piece.list_times(rate)
            for k in range(0, len(times), _BLOCK_ROWS):
                t = times[k : k + _BLOCK_ROWS]
                yield make_trajectory(self.solver, self.frame, t, *piece.interpolate_blocks(t))

    def __repr__(self) -> str:
        return f"Solution({self.solver!r}, {len(self.t)} keyframes)"

    def at(self, t: ArrayLike) -> tuple[Array, States, Array]:
        """States between the keyframes.

        Parameters
        ----------
        t
            (N,) s, or one time.

        Returns
        -------
        times : array
            (M,) s, those of `t` that lie in a piece of the recording, ascending.
        states : States
            M states in the navigation frame.
        covariance : array
            (M, 15, 15) of the error state of `graphnav.core.state`.
        """
        t, parts = np.sort(np.atleast_1d(np.asarray(t, dtype=float))), []
        for piece in self.between:
            inside = t[(t >= piece.start) & (t <= piece.end)]
            if len(inside):
                parts.append((inside, *piece(inside)))
        if not parts:
            return t[:0], self.states[:0], self.covariance[:0]
        times, states, covariances = zip(*parts, strict=True)
        return np.concatenate(times), States.stack(list(states)), np.concatenate(covariances)


def make_trajectory(
    name: str, frame: LocalFrame, t: Array, states: States, covariance: Array | Mapping[str, Array]
) -> Trajectory:
    """States in the fixed navigation frame, in the local ENU at each point.

    Without joint covariances where `covariance` has those of position, velocity and attitude apart; sigmas need a
    third of the work.
    """
    llh, R_ln = frame.level(states.p)
    rph, by_theta = rotation.find_rph(rotation.move_components_first(states.R_nb), R_ln)
    turns = {"p": R_ln, "v": R_ln, "theta": by_theta}  # from the error state to local axes
    cov = None
    if isinstance(covariance, np.ndarray):
        J = np.zeros((len(t), 9, 9))
        for k, (block, turn) in enumerate(turns.items()):
            J[:, 3 * k : 3 * k + 3, BLOCKS[block]] = np.moveaxis(turn, -1, 0)
        cov = np.empty((len(t), _OUT, _OUT))
        for some in (slice(k, k + _BLOCK_ROWS) for k in range(0, len(t), _BLOCK_ROWS)):
            cov[some] = J[some] @ covariance[some, :_OUT, :_OUT] @ np.swapaxes(J[some], -1, -2)
        covariance = split_covariance(covariance)
    sd_p, sd_v, sd_rph = (_find_sigmas(turn, covariance[block]) for block, turn in turns.items())
    return Trajectory(
        t=t,
        llh=llh,
        v=np.einsum("ijn,nj->ni", R_ln, states.v),
        rph=rph,
        sd_p=sd_p,
        sd_v=sd_v,
        sd_rph=sd_rph,
        gyro_bias=states.bg,
        accel_bias=states.ba,
        covariance=cov,
        name=name,
    )


def _find_sigmas(turn: Array, P: Array) -> Array:
    """(n, 3) sigmas of what `turn` (3, 3, n) makes of covariances P (6, n)."""
    x, y, z = turn[:, 0], turn[:, 1], turn[:, 2]
    variance = x * x * P[0] + y * y * P[1] + z * z * P[2]
    variance += 2.0 * (x * y * P[3] + x * z * P[4] + y * z * P[5])
    return np.sqrt(np.maximum(variance, 0.0)).T


def join_solutions(parts: list[Solution], notes: tuple[str, ...] = ()) -> Solution:
    """Join the solutions of the pieces of one recording in one frame."""
    first = parts[0]
    if len(parts) == 1:
        return replace(first, notes=(*notes, *first.notes))

    def join_rows(name: str) -> ConstraintRecord:
        have = [part.records[name] for part in parts if name in part.records]
        arrays: dict[str, Any] = {
            key: np.concatenate([getattr(r, key) for r in have])
            for key in ("t", "residual", "sigma", "nis", "weight", "satellite", "azimuth", "elevation")
        }
        return replace(have[0], **arrays)

    parameters = {}
    for name in dict.fromkeys(key for part in parts for key in part.parameters):
        own = [part.parameters[name] for part in parts if name in part.parameters]
        nodes: dict[str, Any] = {key: np.concatenate([getattr(p, key) for p in own]) for key in ("t", "value", "sigma")}
        parameters[name] = replace(own[0], **nodes)
    return replace(
        first,
        t=np.concatenate([p.t for p in parts]),
        states=States.stack([p.states for p in parts]),
        covariance=np.concatenate([p.covariance for p in parts]),
        parameters=parameters,
        records={name: join_rows(name) for name in dict.fromkeys(key for part in parts for key in part.records)},
        counts=_add_counts([p.counts for p in parts]),
        timings=_add_counts([p.timings for p in parts]),
        iterations=sum(p.iterations for p in parts),
        cost=sum(p.cost for p in parts),
        stopped="; ".join(dict.fromkeys(p.stopped for p in parts)),
        notes=(*notes, *dict.fromkeys(note for part in parts for note in part.notes)),
        detections=tuple(d for p in parts for d in p.detections),
        excluded=tuple(f for p in parts for f in p.excluded),
        noise=_join_noise([p.noise for p in parts]),
        passes=_add_counts([dict(p.passes) for p in parts]),
        graphs=tuple(g for p in parts for g in p.graphs),
        separation=_join_separations([p.separation for p in parts]),
        fixed=np.concatenate([p.fixed for p in parts]),
        arcs=CarrierArcs(*(np.concatenate([getattr(p.arcs, f.name) for p in parts]) for f in fields(CarrierArcs))),
        between=tuple(b for p in parts for b in p.between),
    )


def _join_noise(parts: list[NoiseModel]) -> NoiseModel:
    """Weights and spans of all pieces, and the figures of the first: each piece has its own."""
    weights = {}
    for name in dict.fromkeys(key for part in parts for key in part.weights):
        own = [part.weights[name] for part in parts if name in part.weights]
        weights[name] = RowWeights(np.concatenate([w.t for w in own]), np.concatenate([w.weight for w in own]))
    return replace(
        parts[0],
        weights=weights,
        excluded=_join_spans([part.excluded for part in parts]),
        span_weights=_join_spans([part.span_weights for part in parts]),
        rivals=tuple(
            replace(one, excluded=_join_spans([one.excluded if p is part else p.excluded for p in parts]))
            for part in parts
            for one in part.rivals
        ),
        false_stops=tuple(span for part in parts for span in part.false_stops),
        remountings=tuple(one for part in parts for one in part.remountings),
    )


def _join_spans(parts: list[Mapping[str, tuple[Any, ...]]]) -> dict[str, tuple[Any, ...]]:
    names = dict.fromkeys(key for part in parts for key in part)
    return {name: tuple(span for part in parts for span in part.get(name, ())) for name in names}


def _join_separations(parts: list[Separation | None]) -> Separation | None:
    known = [part for part in parts if part is not None]
    if not known:
        return None
    return Separation(*(np.concatenate([getattr(part, name) for part in known]) for name in ("t", "value", "sigma")))


def _add_counts(tables: list[dict[str, Any]]) -> dict[str, Any]:
    return {key: sum(table.get(key, 0) for table in tables) for key in dict.fromkeys(k for t in tables for k in t)}
