"""The linear recursions of filter and smoother, on arrays alone: compiled where Numba is there.

A step moves the D error states by a matrix of which F (15, w) are the rows of the fifteen states, which depend on
themselves and on the scale errors of the IMU behind them; each parameter beyond shrinks by a factor of its own, `decay`
(D-15). Rows of a keyframe stand one behind the other and are taken in block by block, block b from `begin[b]` to
`end[b]`, those of keyframe k being `first[k]` to `first[k+1]`. Covariances are symmetric and C-contiguous.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphnav.core.compiled import compiled
from graphnav.core.rotation import Array
from graphnav.core.state import DIM

STRETCH = 256  # keyframes from one word of how far it has come to the next
PASSES = 4  # of re-weighting where a measurement is met for the first time
UNUSED = 1e-12  # weight of a row that is not used beside others of its keyframe
HUBER, CAUCHY = 1, 2


class Blocks(NamedTuple):
    """Rows that are taken in at once: those of keyframe k are the blocks `first[k]` to `first[k+1]`."""

    first: Array  # (K+1,)
    begin: Array  # (B,) place in the keyframe of the first number, and behind the last
    end: Array
    used: Array  # (B,) rows of weight 0 are not
    gate: Array  # (B,) normalised innovation squared beyond which it is refused
    kernel: Array  # (B,) 0, `HUBER` or `CAUCHY`
    size: Array  # (B,) numbers of one row
    part: Array  # (B+1,) the first of the parts that each is made of
    k: Array  # (B,) keyframe
    kind: Array  # (B,) number of the constraint, of the first where several are taken in together


@compiled
def move(F: Array, decay: Array, X: Array) -> Array:
    """A step of columns X (D, n)."""
    out = np.empty(X.shape)
    np.dot(F, X[: F.shape[1]], out[:DIM])
    np.multiply(decay.reshape(-1, 1), X[DIM:], out[DIM:])
    return out


@compiled
def move_back(F: Array, decay: Array, X: Array) -> Array:
    """X (n, D) times the matrix of a step."""
    w = F.shape[1]
    out = np.empty(X.shape)
    top = np.dot(np.ascontiguousarray(X[:, :DIM]), F)
    np.positive(top[:, :DIM], out[:, :DIM])
    np.multiply(X[:, DIM:], decay, out[:, DIM:])
    np.add(out[:, DIM:w], top[:, DIM:], out[:, DIM:w])
    return out


@compiled
def predict(P: Array, F: Array, decay: Array, Q: Array, added: Array, out: Array) -> None:
    """The covariance (D, D) after a step, in `out`: with Q (15, 15) of the states and `added` (D-15) of parameters."""
    w = F.shape[1]
    top = np.dot(F, P[:w])
    np.add(np.dot(np.ascontiguousarray(top[:, :w]), F.T), Q, out[:DIM, :DIM])
    for i in range(DIM):
        np.multiply(top[i, DIM:], decay, out[i, DIM:])
    np.positive(out[:DIM, DIM:].T, out[DIM:, :DIM])
    for i in range(len(decay)):
        np.multiply(P[DIM + i, DIM:], decay[i] * decay, out[DIM + i, DIM:])
        out[DIM + i, DIM + i] += added[i]


@compiled
def invert_root(L: Array) -> Array:
    """L^-1 of a lower root (m, m)."""
    out = np.zeros(L.shape)
    for i in range(len(L)):
        own = out[i]
        own[i] = 1.0
        for j in range(i):
            own -= L[i, j] * out[j]
        own /= L[i, i]
    return out


@compiled
def solve(L: Array, X: Array) -> None:
    """X (m, n) <- S^-1 X for S = L L^T."""
    inverse = invert_root(L)
    np.dot(inverse.T, np.dot(inverse, X), X)


@compiled
def compute_gain(HP: Array, HPHt: Array, variance: Array, r: Array) -> tuple[Array, Array, Array]:
    """The lower root (m, m) of S = H P H^T + R, S^-1 r, and the gain transposed (m, D)."""
    S = HPHt.copy()
    for i in range(len(S)):
        S[i, i] += variance[i]
    L = np.linalg.cholesky(S)
    inverse = invert_root(L)
    return L, np.dot(inverse.T, np.dot(inverse, r)), np.dot(inverse.T, np.dot(inverse, HP))


@compiled
def halve_sum(A: Array, out: Array) -> None:
    """(A + A^T) / 2, in `out`: what rounding has made of a symmetric matrix."""
    np.add(A, A.T, out)
    np.multiply(0.5, out, out)


@compiled
def update(P: Array, HP: Array, H: Array, Kt: Array, variance: Array) -> Array:
    """The covariance after an update, by Joseph's form: (I - KH) P first, then that (I - KH)^T + K R K^T."""
    one = np.dot(Kt.T, HP)
    np.subtract(P, one, one)
    left = np.dot(H, one.T)
    left -= variance.reshape(-1, 1) * Kt
    two = np.dot(left.T, Kt)
    np.subtract(one, two, two)
    # rounding's asymmetry would grow, past what a stop leaves between its place and the state
    halve_sum(two, one)
    return one


@compiled
def weigh_robustly(
    HP: Array, HPHt: Array, variance: Array, r: Array, solved: Array, kernel: int, scale: Array, size: int
) -> Array:
    """Weights (m,) of a kernel for rows of `size` numbers, by what the update leaves: none at first."""
    weight, sigma = np.ones(len(r)), np.sqrt(variance)
    for last in range(PASSES - 1):
        left = (r - np.dot(HPHt, solved)) / sigma
        for lo in range(0, len(r), size):
            s, k = np.sqrt(np.sum(left[lo : lo + size] ** 2)), scale[lo]
            own = 1.0 / (1.0 + (s / k) ** 2)
            if kernel == HUBER:
                own = k / s if s > k else 1.0
            weight[lo : lo + size] = max(own, UNUSED)
        if last < PASSES - 2:
            solved = compute_gain(HP, HPHt, variance / weight, r)[1]
    return weight


@compiled
def filter_rows(
    k0: int,
    k1: int,
    e: Array,
    P: Array,
    F: Array,
    decay: Array,
    gap: Array,
    Q: Array,
    added: Array,
    r: Array,
    H: Array,
    variance: Array,
    scale: Array,
    blocks: Blocks,
    used: Array,
    errors_predicted: Array,
    P_predicted: Array,
    errors: Array,
    P_filtered: Array,
    root: Array,
    solved: Array,
    bent: Array,
    Kt: Array,
    w: Array,
    SH: Array,
    taken: Array,
    at: Array,
) -> None:
    """Filter keyframes k0 to k1, linearised throughout, from errors e (D,) and P before them.

    Parameters
    ----------
    gap : (n-1, D) where a step leads from a point, less the next point.
    Q, added : (n-1, 15, 15) and (n-1, D-15) as for `predict`.
    r, H, variance, scale : (n, M), (n, M, D), (n, M), (n, M) of the rows at the points, and of their kernels.
    used : (B,) whether a block is taken in; of one that is not there is an innovation only.
    root, solved : (n, M, M), (n, M), filled with roots of S and S^-1 (r + H e), before any kernel.
    bent : (n, M), filled with weights of kernels, 0 of rows that a gate refuses.
    Kt, w, SH : (n, M, D), (n, M), (n, M, D), filled with gains transposed, S^-1 nu and S^-1 H.
    taken : (B,), filled with whether a block was taken in.
    at : (1,), the block that is taken in.
    """
    for k in range(k0, k1):
        if k:
            e = gap[k - 1] + move(F[k - 1], decay[k - 1], e.reshape(-1, 1)).ravel()
            predict(P, F[k - 1], decay[k - 1], Q[k - 1], added[k - 1], P_predicted[k])
        else:
            np.positive(P, P_predicted[k])
        P = P_predicted[k]
        np.positive(e, errors_predicted[k])
        for b in range(blocks.first[k], blocks.first[k + 1]):
            at[0] = b
            lo, hi = blocks.begin[b], blocks.end[b]
            own, R = H[k, lo:hi], variance[k, lo:hi]
            HP = np.dot(own, P)
            HPHt = np.dot(HP, own.T)
            left = r[k, lo:hi] + np.dot(own, e)
            L, w_b, Kt_b = compute_gain(HP, HPHt, R, left)
            np.positive(w_b, solved[k, lo:hi])
            np.positive(L, root[k, lo:hi, lo:hi])
            refused = np.dot(left, w_b) > blocks.gate[b]
            taken[b] = used[b] and not refused
            bent[k, lo:hi] = 0.0 if refused else 1.0
            if taken[b]:
                if blocks.kernel[b]:
                    weight = weigh_robustly(HP, HPHt, R, left, w_b, blocks.kernel[b], scale[k, lo:hi], blocks.size[b])
                    np.positive(weight, bent[k, lo:hi])
                    R = R / weight
                    L, w_b, Kt_b = compute_gain(HP, HPHt, R, left)
                np.positive(Kt_b, Kt[k, lo:hi])
                np.negative(w_b, w[k, lo:hi])
                np.positive(own, SH[k, lo:hi])
                solve(L, SH[k, lo:hi])
                e = e - np.dot(left, Kt_b)
                P = update(P, HP, own, Kt_b, R)
        np.positive(e, errors[k])
        np.positive(P, P_filtered[k])


@compiled
def smooth_point(e: Array, P: Array, r: Array, N: Array, smoothed: Array, P_smoothed: Array) -> None:
    """Errors (D,) and covariance (D, D) of the smoother, from those of the filter and the disturbance behind them."""
    np.add(e, np.dot(P, r), smoothed)
    one = np.dot(np.dot(P, N), P)
    np.subtract(P, one, one)
    halve_sum(one, P_smoothed)


@compiled
def smooth_rows(
    k0: int,
    k1: int,
    r_k: Array,
    N_k: Array,
    F: Array,
    decay: Array,
    Kt: Array,
    H: Array,
    w: Array,
    SH: Array,
    first: Array,
    begin: Array,
    end: Array,
    taken: Array,
    errors_predicted: Array,
    P_predicted: Array,
    errors: Array,
    P: Array,
    r: Array,
    N: Array,
    smoothed: Array,
    P_smoothed: Array,
) -> None:
    """r (n, D) and N (n, D, D) of keyframes k1 - 1 down to k0, from those of k1, zero where there is none.

    And errors (n, D) and covariances of the smoother there: from the filtered ones, since those predicted, of a place
    that only the first fix tells, are larger by ten orders than what is left of them.

    Parameters
    ----------
    Kt, H, w, SH : of the updates: gains transposed, rows, S^-1 nu and S^-1 H.
    taken : (B,) whether a block was taken in.
    """
    for k in range(k1 - 1, k0 - 1, -1):
        if k < len(F):
            r_k = move_back(F[k], decay[k], r_k.reshape(1, -1)).ravel()
            N_k = move_back(F[k], decay[k], N_k)
            N_k = move_back(F[k], decay[k], np.ascontiguousarray(N_k.T))
            smooth_point(errors[k], P[k], r_k, N_k, smoothed[k], P_smoothed[k])
        for b in range(first[k + 1] - 1, first[k] - 1, -1):
            if taken[b]:
                lo, hi = begin[b], end[b]
                own, gain = H[k, lo:hi], Kt[k, lo:hi]
                r_k = r_k + np.dot(w[k, lo:hi] - np.dot(gain, r_k), own)
                # from one side after the other: after a first fix what is left of N is smaller by ten orders each time
                N_k = N_k - np.dot(np.dot(N_k, gain.T), own)
                N_k += np.dot(own.T, SH[k, lo:hi] - np.dot(gain, N_k))
        np.positive(r_k, r[k])
        halve_sum(N_k, N[k])
        N_k = N[k]
        if k == len(F):  # the last of all: its filtered covariance is of errors about the estimate already
            smooth_point(errors_predicted[k], P_predicted[k], r_k, N_k, smoothed[k], P_smoothed[k])


@compiled
def divide_covariance(P: Array, X: Array) -> None:
    """X (D, n) <- P^-1 X by Cholesky's root of P (D, D)."""
    L = np.linalg.cholesky(P)
    D = len(L)
    for i in range(D):
        own = X[i]
        for j in range(i):
            own -= L[i, j] * X[j]
        own /= L[i, i]
    for i in range(D - 1, -1, -1):
        own = X[i]
        for j in range(i + 1, D):
            own -= L[j, i] * X[j]
        own /= L[i, i]


@compiled
def compose_turns(q: Array, v: Array) -> tuple[float, float, float]:
    """The rotation vector of the rotation of a quaternion q (4,) and, after it, that of a rotation vector v (3,)."""
    n = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    w0, s = np.cos(0.5 * n), 0.5
    if n > 0.0:
        s = np.sin(0.5 * n) / n
    x0, y0, z0 = s * v[0], s * v[1], s * v[2]
    w = q[0] * w0 - q[1] * x0 - q[2] * y0 - q[3] * z0
    x = q[0] * x0 + q[1] * w0 + q[2] * z0 - q[3] * y0
    y = q[0] * y0 - q[1] * z0 + q[2] * w0 + q[3] * x0
    z = q[0] * z0 + q[1] * y0 - q[2] * x0 + q[3] * w0
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    half = np.sqrt(x * x + y * y + z * z)
    a = 2.0
    if half > 0.0:
        a = 2.0 * np.arctan2(half, w) / half
    return a * x, a * y, a * z


@compiled
def smooth_filtered(
    k0: int,
    k1: int,
    moved: Array,
    turned: Array,
    F: Array,
    decay: Array,
    P_predicted: Array,
    P: Array,
    P_smoothed: Array,
    errors: Array,
    at: Array,
) -> None:
    """Smoothed errors (n, D) about filtered states, and covariances, of keyframes k1 - 1 down to k0, from those of k1.

    C = P F^T P-^-1     e = C (x^s - x-) of the next     P^s = P + C (P^s - P-) C^T

    Parameters
    ----------
    moved : (n, D) filtered states less predicted ones; `turned` (n, 4) the quaternions of their rotations.
    at : (1,), the keyframe that is smoothed.
    """
    for k in range(k1 - 1, k0 - 1, -1):
        at[0] = k
        ahead = P_predicted[k + 1]
        away = moved[k + 1] + errors[k + 1]
        away[0], away[1], away[2] = compose_turns(turned[k + 1], errors[k + 1])
        Ct = move(F[k], decay[k], P[k])
        divide_covariance(ahead, Ct)
        np.dot(away, Ct, errors[k])
        two = P[k] + np.dot(Ct.T, np.dot(P_smoothed[k + 1] - ahead, Ct))
        halve_sum(two, P_smoothed[k])


@compiled
def row_covariances(H: Array, P: Array, k: Array) -> Array:
    """(n, m, m) H P_k H^T of rows H (n, m, D) at keyframes k (n,)."""
    n, m, _ = H.shape
    out = np.empty((n, m, m))
    for i in range(n):
        HP = np.dot(H[i], P[k[i]])
        for j in range(m):
            for c in range(j + 1):
                out[i, j, c] = out[i, c, j] = np.dot(HP[j], H[i, c])
    return out
