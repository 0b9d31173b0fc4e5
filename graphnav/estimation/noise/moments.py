"""Smoothed moments of every variance component and every row.

The innovation log-likelihood L of a linear Gaussian problem has, by the logarithm of the variance factor f of a
component that adds the covariance f Q_i to a step or to rows, the derivative

    dL / d ln f = (A - B) / 2      A = sum r^T f Q_i r      B = sum tr(f Q_i N)

with r and N of the disturbance smoother (Koopman 1993, "Disturbance smoother for state space models"), at a step

    r = P-^-1 (x^s - x-)           N = P-^-1 (P- - P^s) P-^-1

and at rows with Jacobian H, and residual e of the smoothed state, r = R^-1 e and N = R^-1 - R^-1 H P^s H^T R^-1. B is
the component's redundancy, its degrees of freedom in the data (Foerstner 1979; MacKay 1992 calls it the number of
well-determined parameters), and E[A] = B where f is right.

Bryson and Frazier, "Smoothing for linear and nonlinear dynamic systems" (1963); Foerstner, Allgemeine
Vermessungs-Nachrichten 86 (1979); de Jong, JASA 84 (1989); Koopman, Biometrika 80 (1993); MacKay, Neural Computation 4
(1992); Satterthwaite, Biometrics Bulletin 2 (1946).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from graphnav.constraints.base import Constraint
from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.problem import ParameterChain, Problem
from graphnav.estimation.solvers.linearise import find_stepping, shift
from graphnav.estimation.solvers.passes import MomentPass, SmoothedRows

Process = tuple[Array, Array, Array]  # keyframes (n,), A and B (n, k)

# redundancy below which nothing can tell whether a row is wrong: what linearisation leaves in a residual, a tenth of a
# sigma, would look like an error of a whole one
_CONTROLLED = 0.01
_FORGOTTEN = 1e-6  # relative remainder of a difference below which it is rounding error


@dataclass(frozen=True)
class RowMoments:
    """Rows of a constraint as a smoothed solution has them."""

    A: Array  # (N, m) w e^2 / R
    B: Array  # (N, m) redundancy
    left_out: Array  # (N,) squared residual over its covariance, predicted without the row, at weight 1
    error: Array  # (N, m) the component's share in the residual e


@dataclass(frozen=True)
class ImuMoments:
    """White noise and bias walks of intervals at a smoothed solution."""

    A: Array  # (n, 4) of `NOISE_FIGURES`
    B: Array  # (n, 4)
    Q: Array  # (n, 4, 15, 15) what each adds to a step, as stated
    N: Array  # (n, 15, 15)
    factors: Array  # (n, 4) of these
    disturbance: Array  # (n, 4, 15) what each adds to the error behind a step

    @property
    def squared(self) -> Array:
        """(n, 4) nearly chi-square variables of `freedom` where f is right."""
        return self.A / np.maximum(self.B, 1e-30) * self.freedom

    @cached_property
    def freedom(self) -> Array:
        """(n, 4) of the chi-square variable that A freedom / B is near to where f is right."""
        QN = self.Q @ self.N[:, None]
        squared = np.einsum("nfij,nfji->nf", QN, QN)
        freedom = np.where(self.B > 0.0, (self.B / self.factors) ** 2 / np.maximum(squared, 1e-300), 1.0)
        return np.maximum(freedom, 1.0)


@dataclass(frozen=True)
class Moments:
    """Of all variance components, over the first keyframes of a problem."""

    imu: ImuMoments
    processes: dict[str, Process]  # by parameter
    rows: dict[str, RowMoments]  # by constraint


def collect_moments(problem: Problem, attitudes: Array, smoothed: MomentPass) -> Moments:
    """Of all components over the keyframes of a smoothed solution, with the attitudes R_nb (n, 3, 3) it is about."""
    n = len(attitudes)
    chains = [chain for chain in problem.chains if chain.parameter.noise_groups]
    grouped = [rows for rows in problem.constraints if rows.list_noise_groups()[0]]
    return Moments(
        collect_imu_moments(problem, attitudes[:-1], smoothed),
        {chain.parameter.name: collect_process_moments(problem, chain, smoothed, n) for chain in chains},
        {rows.name: collect_row_moments(rows, smoothed.take_rows(rows)) for rows in grouped},
    )


def collect_imu_moments(problem: Problem, start: Array, smoothed: MomentPass) -> ImuMoments:
    """Moments of the intervals, by the attitudes R_nb (n, 3, 3) at their starts.

    A = |s|^2 with s of covariance M, trace(M) = B, is near to a chi-square variable of B^2 / trace(M^2) degrees of
    freedom times B over these (Satterthwaite 1946, "An approximate distribution of estimates of variance components").
    """
    L = problem.motion.compute_frames(slice(0, len(start)), start)
    Lt = np.swapaxes(L, -1, -2)
    r = (Lt @ smoothed.r[1:, :DIM, None])[..., 0]
    N = Lt @ smoothed.N[1:] @ L
    Q, factors = problem.intervals.parts[: len(r)], problem.intervals.factors[: len(r)]
    Qr, B = sum_parts(Q, r, N)
    disturbance = factors[..., None] * Qr
    return ImuMoments(
        np.sum(disturbance * r[:, None], axis=2), factors * np.maximum(B, 0.0), Q, N, factors, disturbance
    )


@compile_once
def sum_parts(Q: Array, r: Array, N: Array) -> tuple[Array, Array]:
    """Q r (n, f, D) and tr(Q N) (n, f) of parts Q (n, f, D, D), by r (n, D) and symmetric N (n, D, D)."""
    n, f, D, _ = Q.shape
    Qr, B = np.empty((n, f, D)), np.empty((n, f))
    for k in range(n):
        Qr[k] = np.dot(Q[k].reshape((f * D, D)), r[k]).reshape((f, D))
        B[k] = np.dot(Q[k].reshape((f, D * D)), N[k].ravel())
    return Qr, B


def collect_process_moments(problem: Problem, chain: ParameterChain, smoothed: MomentPass, end: int) -> Process:
    """Keyframes (n,) at which a process is driven, and A and B (n, k) there; the first is its steady variance."""
    at = problem.columns[chain.parameter.name]
    k = np.concatenate([[0], find_stepping(chain, end)])
    q = chain.sigma[chain.node[k]] ** 2
    N = smoothed.N_diagonal[k, at]
    return k, q * smoothed.r[k, at] ** 2, q * np.maximum(N, 0.0)


def predict_errors(rows: Constraint, smoothed: MomentPass) -> tuple[Array, Array]:
    """Errors (N, m) of the rows of a constraint, each number predicted by a smoother without it, and sigmas (N, m)."""
    one = smoothed.take_rows(rows)
    return one.residual / _compute_redundancies(rows, one)[1], one.sigma


def _compute_redundancies(rows: Constraint, one: SmoothedRows) -> tuple[Array, Array]:
    """Weights (n, 1) of the first n rows, and redundancies (n, m) of their numbers."""
    n = len(one.residual)
    w = np.ones((n, 1)) if rows.weight is None else rows.weight[:n, None]
    return w, np.clip(1.0 - w * one.variance / one.sigma**2, 1e-6, 1.0)


def compute_expected_squares(one: SmoothedRows) -> Array:
    """(n,) E[|e / sigma|^2] of the errors of rows: their residuals', and what is uncertain of these."""
    return np.asarray(np.sum((one.residual**2 + one.variance) / one.sigma**2, axis=1))


def collect_row_moments(rows: Constraint, one: SmoothedRows) -> RowMoments:
    """Of the first n rows of a constraint."""
    n = len(one.residual)
    R = one.sigma**2
    w, B = _compute_redundancies(rows, one)
    # in axes that diagonalise the whitened covariance: a stamp error affects all components together
    each, axes = np.linalg.eigh(one.covariance / (one.sigma[:, :, None] * one.sigma[:, None]))
    free = np.clip(1.0 - w * each, _CONTROLLED, 1.0)
    predicted = np.einsum("nji,nj->ni", axes, one.residual / one.sigma) / free
    left_out = np.sum(predicted**2 / (1.0 + np.maximum(each, 0.0) / free), axis=1)
    # of the component that a factor scales
    share = 1.0 if rows.unscaled is None else 1.0 - rows.unscaled[:n] ** 2 / R
    A = share * w * one.residual**2 / R
    return RowMoments(A, share * np.where(w > 0.0, B, 0.0), left_out, share * one.residual)


def lag_moments(problem: Problem, chain: ParameterChain, smoothed: MomentPass, moments: Process) -> tuple[Array, ...]:
    """Of a process, from node to node: times between (n,), the correlation (n,) that a change of its size leaves, and
    E[c' c'], E[c' c] and E[c c] (n, k), c' the later.

    As c' = a c + w, E[c' c] is half of (E[c' c'] + a^2 E[c c] - E[w w]) / a. Where the correlation is negligible
    (`_FORGOTTEN`), the two are taken as independent.
    """
    at = problem.columns[chain.parameter.name]
    own = shift(at)
    k, A, B = moments
    k, j = k[1:], chain.node[k[1:]]
    driven = chain.sigma[j] ** 2 * (1.0 + A[1:] - B[1:])
    c0, c1 = smoothed.values[k - 1, own], smoothed.values[k, own]
    before, later = c0 * c0 + smoothed.variance[k - 1, at], c1 * c1 + smoothed.variance[k, at]
    a = np.maximum(chain.decay[j], _FORGOTTEN)[:, None]
    cross = np.where(a > _FORGOTTEN, 0.5 * (later + a * a * before - driven) / a, c1 * c0)
    left = chain.parameter.compare_sizes(chain.t[j - 1], chain.t[j])
    return np.diff(chain.t)[j - 1], left, later, cross, before
