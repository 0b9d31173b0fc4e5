"""The disturbance smoother of a filter linearised at given points, on arrays alone: compiled where Numba is there.

With K the gain and N that behind an update, what an update leaves of a residual e, u = S^-1 nu - K^T r, has the
covariance D = S^-1 + K^T N K (de Jong 1989; Koopman 1993): the smoothed e is R u, and H P^s H^T = R - R D R. So the
covariances of residuals, which variances are estimated by, are known without those of the states. Steps and rows are as
in `graphnav.estimation.solvers.recursion`.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.compiled import compiled
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.solvers.recursion import MOVING


@compiled
def step_back(F: Array, decay: Array, N: Array) -> Array:
    """N (D, D) before a step from that behind it."""
    w, D = F.shape[1], len(N)
    moving, one, out = F[:MOVING], np.empty((D, D)), np.empty((D, D))
    top = np.dot(moving.T, N[:MOVING])
    for i in range(D):
        d = 1.0 if i < DIM else decay[i - DIM]
        for j in range(D):
            one[i, j] = d * N[i, j] if i >= MOVING else 0.0
        if i < w:
            for j in range(D):
                one[i, j] += top[i, j]
    left = np.dot(np.ascontiguousarray(one[:, :MOVING]), moving)
    for j in range(D):
        d = 0.0 if j < MOVING else 1.0 if j < DIM else decay[j - DIM]
        for i in range(j, D):
            x = d * one[i, j]
            if j < w:
                x += left[i, j]
            out[i, j] = out[j, i] = x
    return out


@compiled
def step_vector_back(F: Array, decay: Array, r: Array) -> Array:
    """r (D,) likewise."""
    out = np.empty(len(r))
    out[:MOVING] = 0.0
    out[MOVING:DIM] = r[MOVING:DIM]
    out[DIM:] = decay * r[DIM:]
    out[: F.shape[1]] += np.dot(r[:MOVING], F[:MOVING])
    return out


@compiled
def take_back(N: Array, H: Array, Kt: Array, inverse: Array, lossy: bool) -> tuple[Array, Array]:
    """N (D, D) before an update from that behind it, and D = S^-1 + K^T N K (m, m)."""
    G = np.dot(Kt, N)
    D = inverse + np.dot(G, Kt.T)
    if lossy:
        # from one side after the other: after a first fix what is left of N is smaller by ten orders each time
        out = N - np.dot(G.T, H)
        out += np.dot(H.T, np.dot(inverse, H) - np.dot(Kt, out))
        return 0.5 * (out + out.T), D
    out = np.dot(H.T, G - 0.5 * np.dot(D, H))
    for i in range(len(N)):
        for j in range(i + 1):
            out[i, j] = out[j, i] = N[i, j] - out[i, j] - out[j, i]
    return out, D


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
    inverse: Array,
    spread: Array,
    first: Array,
    begin: Array,
    end: Array,
    taken: Array,
    lossy: Array,
    errors_predicted: Array,
    P_predicted: Array,
    errors: Array,
    P: Array,
    wanted: Array,
    first_wanted: Array,
    r: Array,
    N: Array,
    N_diagonal: Array,
    smoothed: Array,
    P_smoothed: Array,
    variance: Array,
    of_rows: Array,
) -> tuple[Array, Array]:
    """r (n, D), and of N the states' part (n, 15, 15) and the diagonal (n, D), of keyframes k1 - 1 down to k0.

    From those of k1, zero where there is none; returns those of k0. And errors (n, D) of the smoother there: from the
    filtered ones, since those predicted, of a place that only the first fix tells, are larger by ten orders than what
    is left of them.

    Parameters
    ----------
    Kt, H, w, inverse, spread : of the updates: gains transposed, rows, S^-1 nu, S^-1, and the variances of the rows.
    taken, lossy : (B,) whether a block was taken in, and whether with a loss of digits.
    P_smoothed : (n, D, D), filled with covariances of the smoother, if it has any keyframes. If it has none,
    variance, of_rows : (n, D), (n, M, M), filled with variances and with H P^s H^T.
    wanted, first_wanted : columns of which variances are wanted, those of keyframe k from `first_wanted[k]` on.
    """
    whole = len(P_smoothed) > 0
    for k in range(k1 - 1, k0 - 1, -1):
        ahead = k < len(F)  # of the last of all the filtered covariance is of errors about the estimate already
        if ahead:
            r_k = step_vector_back(F[k], decay[k], r_k)
            N_k = step_back(F[k], decay[k], N_k)
            np.add(errors[k], np.dot(P[k], r_k), smoothed[k])
            N_behind, P_behind = N_k, P[k]
            if whole:
                cover(P[k], N_k, P_smoothed[k])
            else:
                vary(P[k], N_k, wanted[first_wanted[k] : first_wanted[k + 1]], variance[k])
        else:
            N_behind, P_behind = N_k, P[k]
        for b in range(first[k + 1] - 1, first[k] - 1, -1):
            lo, hi = begin[b], end[b]
            own = H[k, lo:hi]
            if taken[b]:
                gain = Kt[k, lo:hi]
                r_k = r_k + np.dot(w[k, lo:hi] - np.dot(gain, r_k), own)
                inverse_b = np.ascontiguousarray(inverse[k, lo:hi, lo:hi])
                N_k, D = take_back(N_k, own, gain, inverse_b, lossy[b])
                if not whole:
                    R = spread[k, lo:hi]
                    for i in range(hi - lo):
                        for j in range(hi - lo):
                            of_rows[k, lo + i, lo + j] = -R[i] * D[i, j] * R[j]
                        of_rows[k, lo + i, lo + i] += R[i]
            elif not whole:
                HP = np.dot(own, P_behind)
                of_rows[k, lo:hi, lo:hi] = np.dot(HP, own.T) - np.dot(np.dot(HP, N_behind), HP.T)
        np.positive(r_k, r[k])
        np.positive(N_k[:DIM, :DIM], N[k])
        for i in range(len(r_k)):
            N_diagonal[k, i] = N_k[i, i]
        if not ahead:
            ahead_P = P_predicted[k % len(P_predicted)]
            np.add(errors_predicted[k], np.dot(ahead_P, r_k), smoothed[k])
            if whole:
                cover(ahead_P, N_k, P_smoothed[k])
            else:
                vary(ahead_P, N_k, wanted[first_wanted[k] : first_wanted[k + 1]], variance[k])
    return r_k, N_k


@compiled
def cover(P: Array, N: Array, out: Array) -> None:
    """P - P N P, in `out`."""
    one = np.dot(np.dot(P, N), P)
    np.subtract(P, one, one)
    np.add(one, one.T, out)
    np.multiply(0.5, out, out)


@compiled
def vary(P: Array, N: Array, columns: Array, out: Array) -> None:
    """The diagonal of P - P N P at some columns, in `out` (D,)."""
    own = P[columns]
    PN = np.dot(own, N)
    for i in range(len(columns)):
        out[columns[i]] = own[i, columns[i]] - np.dot(PN[i], own[i])


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
