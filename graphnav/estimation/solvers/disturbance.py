"""The disturbance smoother of a filter linearised at given points, on arrays alone: compiled where Numba is there.

Bryson and Frazier (1963); de Jong (1989); Koopman (1993). Steps and rows are as in
`graphnav.estimation.solvers.recursion`.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, MOVING
from graphnav.estimation.solvers.recursion import Arrays, filter_rows, smooth_filtered


@compile_once
def step_back(F: Array, decay: Array, N: Array) -> Array:
    """N (D, D) before a step from that behind it.

    With M the rows of F for what moves, d the factors of everything else, and X = M N_mm / 2 + N_m. d:
    M^T X + X^T M, and d N d of everything else.
    """
    w, D = F.shape[1], len(N)
    moving, out = F[:MOVING], np.empty((D, D))
    X = np.zeros((MOVING, D))
    np.multiply(0.5, np.dot(np.ascontiguousarray(N[:MOVING, :MOVING]), moving), X[:, :w])
    for i in range(MOVING):
        row, values = X[i], N[i]
        for j in range(MOVING, DIM):
            row[j] += values[j]
        behind, shrunk = row[DIM:], values[DIM:]
        for j in range(D - DIM):
            behind[j] += shrunk[j] * decay[j]
    Y = np.dot(moving.T, X)
    for i in range(D):
        row, values = out[i], N[i]
        if i < MOVING:
            row[:] = 0.0
        else:
            d = 1.0 if i < DIM else decay[i - DIM]
            for j in range(MOVING):
                row[j] = 0.0
            for j in range(MOVING, DIM):
                row[j] = d * values[j]
            behind, shrunk = row[DIM:], values[DIM:]
            for j in range(D - DIM):
                behind[j] = shrunk[j] * (d * decay[j])
        if i < w:
            own = Y[i]
            for j in range(w):
                row[j] += own[j] + Y[j, i]
            for j in range(w, D):
                row[j] += own[j]
        else:
            for j in range(w):
                row[j] += Y[j, i]
    return out


@compile_once
def step_vector_back(F: Array, decay: Array, r: Array) -> Array:
    """r (D,) likewise."""
    out, moving = np.empty(len(r)), np.dot(r[:MOVING], F[:MOVING])
    for i in range(len(r)):
        out[i] = 0.0 if i < MOVING else r[i] if i < DIM else decay[i - DIM] * r[i]
        if i < len(moving):
            out[i] += moving[i]
    return out


@compile_once
def take_back(N: Array, H: Array, Kt: Array, inverse: Array, lossy: bool) -> Array:
    """N (D, D) before an update from that behind it."""
    G = np.dot(Kt, N)
    if lossy:
        # from one side after the other: after a first fix the result is smaller by ten orders each time
        out = N - np.dot(G.T, H)
        out += np.dot(H.T, np.dot(inverse, H) - np.dot(Kt, out))
        return 0.5 * (out + out.T)
    G -= 0.5 * np.dot(inverse + np.dot(G, Kt.T), H)
    out = np.dot(H.T, G)
    for i in range(len(N)):
        for j in range(i + 1):
            out[i, j] = out[j, i] = N[i, j] - out[i, j] - out[j, i]
    return out


@compile_once
def smooth_rows(
    k0: int, k1: int, r_k: Array, N_k: Array, steps: Arrays, updates: Arrays, blocks: Arrays, filtered: Arrays,
    found: Arrays, covered: Arrays, asked: Array, wanted: Array, first_wanted: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Errors (n, D) of the smoother, r (n, D), and of N the states' part (n, 15, 15) and the diagonal (n, D), of
    keyframes k1 - 1 down to k0.

    From r_k (D,) and N_k (D, D) of k1, zero where there is none; returns those of k0. Without N_k (0, 0) there is
    nothing of N, nor covariances. Errors are from the filtered ones, because predicted errors of a position that only
    the first fix determines are larger by ten orders than their smoothed values.

    Parameters
    ----------
    steps : F (n-1, 15, w) and decay (n-1, D-15).
    updates, blocks, filtered : as of `graphnav.estimation.solvers.recursion.filter_rows`.
    found : filled with errors, r, N and the diagonal of N.
    covered : filled with covariances (n, D, D) of the smoother, if it has any keyframes. If it has none, with variances
        (n, D), and H P^s H^T (n, M, M) of rows `asked` (n, M, D).
    wanted, first_wanted : columns of which variances are wanted, those of keyframe k from `first_wanted[k]` on.
    """
    F, decay = steps
    Kt, H, w, inverse, taken, lossy = updates
    first, begin, end, _, _, _ = blocks
    errors_predicted, P_predicted, errors, P = filtered
    smoothed, r, N, N_diagonal = found
    informed = len(N_k) > 0
    for k in range(k1 - 1, k0 - 1, -1):
        rows = end[first[k + 1] - 1] if first[k] < first[k + 1] else 0
        ahead = k < len(F)  # at the last keyframe the filtered covariance already is of errors about the estimate
        if ahead:
            r_k = step_vector_back(F[k], decay[k], r_k)
            np.add(errors[k], np.dot(P[k], r_k), smoothed[k])
            if informed:
                N_k = step_back(F[k], decay[k], N_k)
                fill_covariances(k, P[k], N_k, rows, wanted, first_wanted, asked, covered)
        for b in range(first[k + 1] - 1, first[k] - 1, -1):
            if taken[b]:
                lo, hi = begin[b], end[b]
                own, gain = H[k, lo:hi], Kt[k, lo:hi]
                r_k = r_k + np.dot(w[k, lo:hi] - np.dot(gain, r_k), own)
                if informed:
                    N_k = take_back(N_k, own, gain, np.ascontiguousarray(inverse[k, lo:hi, lo:hi]), lossy[b])
        np.positive(r_k, r[k])
        if informed:
            np.positive(N_k[:DIM, :DIM], N[k])
            for i in range(len(r_k)):
                N_diagonal[k, i] = N_k[i, i]
        if not ahead:
            ahead_P = P_predicted[k % len(P_predicted)]
            np.add(errors_predicted[k], np.dot(ahead_P, r_k), smoothed[k])
            if informed:
                fill_covariances(k, ahead_P, N_k, rows, wanted, first_wanted, asked, covered)
    return r_k, N_k


@compile_once
def fill_covariances(
    k: int, P: Array, N: Array, rows: int, wanted: Array, first_wanted: Array, asked: Array, covered: Arrays
) -> None:
    """What `smooth_rows` is to fill in of P - P N P at keyframe k, the first of `asked` being as many as `rows`."""
    P_smoothed, variance, of_rows = covered
    if len(P_smoothed) > 0:
        cover(P, N, P_smoothed[k])
        return
    vary(P, N, wanted[first_wanted[k] : first_wanted[k + 1]], variance[k])
    if rows > 0:
        cover_rows(P, N, asked[k, :rows], of_rows[k])


@compile_once
def cover(P: Array, N: Array, out: Array) -> None:
    """P - P N P, in `out`."""
    one = np.dot(np.dot(P, N), P)
    np.subtract(P, one, one)
    np.add(one, one.T, out)
    np.multiply(0.5, out, out)


@compile_once
def vary(P: Array, N: Array, columns: Array, out: Array) -> None:
    """The diagonal of P - P N P at some columns, in `out` (D,)."""
    own = P[columns]
    PN = np.dot(own, N)
    for i in range(len(columns)):
        out[columns[i]] = own[i, columns[i]] - np.dot(PN[i], own[i])


@compile_once
def cover_rows(P: Array, N: Array, H: Array, out: Array) -> None:
    """H (P - P N P) H^T of rows H (m, D), in the first of `out` (M, M)."""
    m, HP = len(H), np.dot(H, P)
    found = np.dot(H - np.dot(HP, N), HP.T)
    for i in range(m):
        for j in range(m):
            out[i, j] = found[i, j]


@compile_once
def compare_disturbances(
    steps: Arrays, updates: Arrays, blocks: Arrays, common: Array, driven: Array, of_driven: Array, errors: Array,
    of_errors: Array, out: Array,
) -> None:  # fmt: skip
    """Fill `out` (J, J) with u_i^T S^-1 u_j, u_j (n, M, J) the innovations of the j-th of J kinds of disturbances.

    Parameters
    ----------
    steps, updates, blocks : as of `smooth_rows`, with gains.
    common : (n, 15, c) disturbances of the states before each keyframe, of the first c kinds.
    driven, of_driven : (n, D-15) those of the parameters, and the kind (D-15,) of each, -1 for none.
    errors, of_errors : (n, M) those of the rows, and the kind (n, M) of each, -1 for none.
    """
    F, decay = steps
    Kt, H, _, inverse, taken, _ = updates
    first, begin, end, _, _, _ = blocks
    n, c, J, w, D = len(common), common.shape[2], len(out), F.shape[2], H.shape[2]
    moved = np.zeros((D, J))
    for k in range(n):
        if k:
            moved[:MOVING] = np.dot(F[k - 1, :MOVING], moved[:w])
            for i in range(D - DIM):
                for j in range(J):
                    moved[DIM + i, j] *= decay[k - 1, i]
        for i in range(DIM):
            for j in range(c):
                moved[i, j] += common[k, i, j]
        for i in range(D - DIM):
            if of_driven[i] >= 0:
                moved[DIM + i, of_driven[i]] += driven[k, i]
        for b in range(first[k], first[k + 1]):
            if taken[b]:
                lo, hi = begin[b], end[b]
                u = np.dot(H[k, lo:hi], moved)
                for i in range(lo, hi):
                    if of_errors[k, i] >= 0:
                        u[i - lo, of_errors[k, i]] += errors[k, i]
                out += np.dot(u.T, np.dot(np.ascontiguousarray(inverse[k, lo:hi, lo:hi]), u))
                moved -= np.dot(Kt[k, lo:hi].T, u)


def load_compiled() -> None:
    """Load the recursions that every solver needs, and Numba's own modules with them, by calls for no keyframes."""
    v, m, c = (np.empty((0,) * n) for n in (1, 2, 3))
    which, flags = np.empty(0, dtype=int), np.empty(0, dtype=bool)
    blocks, updates, errors = (which, which, which, v, which, which), (c, c, m, c, flags, flags), (m, c, m, c)
    filter_rows(0, 0, v, m, (c, m, m, c, m), (m, c, m, m), blocks, flags, errors, (c, m, m), updates, which)
    smooth_rows(0, 0, v, m, (c, m), updates, blocks, errors, (m, m, c, m), (c, m, c), c, which, which)
    smooth_filtered(0, 0, m, m, (c, m), c, c, c, m, which)
    compare_disturbances((c, m), (c, c, m, c, flags, flags), blocks, c, m, which, m, which.reshape(0, 0), m)
