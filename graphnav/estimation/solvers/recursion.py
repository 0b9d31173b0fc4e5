"""The linear recursions of filter and smoother, on arrays alone: compiled where Numba is there.

A step moves the D error states by a matrix of which F (15, w) are the rows of the fifteen states, which depend on
themselves and on the scale errors of the IMU behind them; each parameter beyond shrinks by a factor of its own, `decay`
(D-15). Rows of a keyframe are stacked and processed block by block, block b from `begin[b]` to
`end[b]`, those of keyframe k being `first[k]` to `first[k+1]`. Covariances are symmetric and C-contiguous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.core.state import DIM, MOVING

STRETCH = 256  # keyframes between progress reports
PASSES = 4  # iterations of reweighting at the first use of a measurement
UNUSED = 1e-12  # weight of a row that is not used beside others of its keyframe
HUBER, CAUCHY = 1, 2
Arrays = tuple[Array, ...]
_LOSSY = 1e4  # times R that H P H^T may be for P - W^T W to keep twelve digits


@dataclass(frozen=True)
class RowBlocks:
    """Rows of joint updates: those of keyframe k are the blocks `first[k]` to `first[k+1]`."""

    first: Array  # (K+1,)
    begin: Array  # (B,) place in the keyframe of the first number, and behind the last
    end: Array
    used: Array  # (B,) rows of weight 0 are not
    gate: Array  # (B,) normalised innovation squared beyond which it is rejected
    kernel: Array  # (B,) 0, `HUBER` or `CAUCHY`
    size: Array  # (B,) numbers of one row
    part: Array  # (B+1,) the first of the parts that each is made of
    k: Array  # (B,) keyframe
    kind: Array  # (B,) number of the constraint, of the first where several are taken in together

    @property
    def arrays(self) -> Arrays:
        """Arguments of `filter_rows`: compiled code on disk must not depend on classes."""
        return self.first, self.begin, self.end, self.gate, self.kernel, self.size


@compile_once
def move_columns(F: Array, decay: Array, X: Array) -> Array:
    """A step of columns X (D, n)."""
    out = np.empty(X.shape)
    np.dot(F, X[: F.shape[1]], out[:DIM])
    np.multiply(decay.reshape(-1, 1), X[DIM:], out[DIM:])
    return out


@compile_once
def predict_covariance(P: Array, F: Array, decay: Array, Q: Array, added: Array, out: Array) -> None:
    """The covariance (D, D) after a step, in `out`: with Q (15, 15) of the states and `added` (D-15) of parameters."""
    w, D = F.shape[1], len(P)
    top = np.dot(F[:MOVING], P[:w])
    own = np.dot(np.ascontiguousarray(top[:, :w]), F[:MOVING].T)
    # row by row, in loops that become vector instructions
    for i in range(MOVING):
        row, values, more = out[i], top[i], Q[i]
        for j in range(i + 1):
            row[j] = out[j, i] = own[i, j] + more[j]
        for j in range(MOVING, DIM):
            row[j] = values[j] + more[j]
        behind, shrunk = row[DIM:], values[DIM:]
        for j in range(D - DIM):
            behind[j] = shrunk[j] * decay[j]
    for i in range(MOVING, D):
        row, values = out[i], P[i]
        for j in range(MOVING):
            row[j] = out[j, i]
        d = 1.0 if i < DIM else decay[i - DIM]
        for j in range(MOVING, DIM):
            row[j] = values[j] * d
        behind, shrunk = row[DIM:], values[DIM:]
        for j in range(D - DIM):
            behind[j] = shrunk[j] * (d * decay[j])
        if i < DIM:
            more = Q[i]
            for j in range(MOVING, DIM):
                row[j] += more[j]
        else:
            row[i] += added[i - DIM]


@compile_once
def invert_root(L: Array) -> Array:
    """L^-1 of a lower root (m, m)."""
    m = len(L)
    out = np.zeros((m, m))
    for i in range(m):
        for j in range(i):
            x = L[i, j]
            for c in range(j + 1):
                out[i, c] -= x * out[j, c]
        x = 1.0 / L[i, i]
        for c in range(i):
            out[i, c] *= x
        out[i, i] = x
    return out


@compile_once
def invert_sum(HPHt: Array, variance: Array) -> tuple[Array, Array]:
    """The lower root L (m, m) of S = H P H^T + R, and L^-1."""
    S = HPHt.copy()
    for i in range(len(S)):
        S[i, i] += variance[i]
    L = np.linalg.cholesky(S)
    return L, invert_root(L)


@compile_once
def halve_sum(A: Array, out: Array) -> None:
    """(A + A^T) / 2, in `out`: restores the symmetry lost by rounding."""
    np.add(A, A.T, out)
    np.multiply(0.5, out, out)


@compile_once
def update_covariance(P: Array, HP: Array, H: Array, Kt: Array, variance: Array) -> Array:
    """The covariance after an update, by Joseph's form: (I - KH) P first, then that (I - KH)^T + K R K^T."""
    one = np.dot(Kt.T, HP)
    np.subtract(P, one, one)
    left = np.dot(H, one.T)
    left -= variance.reshape(-1, 1) * Kt
    two = np.dot(left.T, Kt)
    np.subtract(one, two, two)
    # asymmetry from rounding would grow beyond the covariance between state and held place at a stop
    halve_sum(two, one)
    return one


@compile_once
def reduce(P: Array, W: Array) -> Array:
    """The covariance after an update, as P - W^T W with W = L^-1 H P: half of the work, and fewer digits."""
    out = np.dot(W.T, W)
    for i in range(len(P)):
        for j in range(i + 1):
            out[i, j] = out[j, i] = P[i, j] - out[i, j]
    return out


@compile_once
def weigh_robustly(
    HPHt: Array, variance: Array, r: Array, solved: Array, kernel: int, scale: Array, size: int
) -> Array:
    """Weights (m,) of a kernel for rows of `size` numbers, by the residuals after the update, starting unweighted."""
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
            _, inverse = invert_sum(HPHt, variance / weight)
            solved = np.dot(inverse.T, np.dot(inverse, r))
    return weight


@compile_once
def filter_rows(
    k0: int, k1: int, e: Array, P: Array, steps: Arrays, rows: Arrays, blocks: Arrays, used: Array,
    filtered: Arrays, innovations: Arrays, updates: Arrays, at: Array,
) -> None:  # fmt: skip
    """Filter keyframes k0 to k1, linearised throughout, from errors e (D,) and P before them.

    Parameters
    ----------
    steps : F (n-1, 15, w), decay (n-1, D-15); gap (n-1, D) where a step leads from a point, less the next point;
        Q (n-1, 15, 15) and added (n-1, D-15) as for `predict_covariance`.
    rows : r (n, M), H (n, M, D) and variance (n, M) at the points, and the scale (n, M) of their kernels.
    blocks : `RowBlocks.arrays`.
    used : (B,) whether a block is taken in; of one that is not there is an innovation only.
    filtered : errors and P predicted, errors and P filtered, to be filled; of fewer than n, but two at least that are
        predicted, those of the last keyframes are left.
    innovations : root (n, M, M) and solved (n, M), filled with roots of S and S^-1 (r + H e), before any kernel; bent
        (n, M), filled with weights of kernels, 0 of rows that a gate refuses.
    updates : Kt (n, M, D), H, w (n, M) and inverse (n, M, M), all but H filled with gains transposed, S^-1 nu and
        S^-1, without a row if nobody will ask; taken and lossy (B,), filled with whether a block was taken in, and
        whether P - W^T W would have lost digits.
    at : (1,), the block that is taken in.
    """
    F, decay, gap, Q, added = steps
    r, H, variance, scale = rows
    first, begin, end, gate, kernel, size = blocks
    errors_predicted, P_predicted, errors, P_filtered = filtered
    root, solved, bent = innovations
    Kt, _, w, inverse, taken, lossy = updates
    gains, told = len(Kt) > 0, len(inverse) > 0
    for k in range(k0, k1):
        ahead = k % len(P_predicted)
        if k:
            e = gap[k - 1] + move_columns(F[k - 1], decay[k - 1], e.reshape(-1, 1)).ravel()
            predict_covariance(P, F[k - 1], decay[k - 1], Q[k - 1], added[k - 1], P_predicted[ahead])
        else:
            np.positive(P, P_predicted[ahead])
        P = P_predicted[ahead]
        np.positive(e, errors_predicted[k % len(errors_predicted)])
        for b in range(first[k], first[k + 1]):
            at[0] = b
            lo, hi = begin[b], end[b]
            own, R = H[k, lo:hi], variance[k, lo:hi]
            HP = np.dot(own, P)
            HPHt = np.dot(HP, own.T)
            left = r[k, lo:hi] + np.dot(own, e)
            L, one = invert_sum(HPHt, R)
            white = np.dot(one, left)
            refused = np.dot(white, white) > gate[b]
            taken[b] = used[b] and not refused
            bent[k, lo:hi] = 0.0 if refused else 1.0
            w_b = np.dot(one.T, white)
            np.positive(w_b, solved[k, lo:hi])
            np.positive(L, root[k, lo:hi, lo:hi])
            if taken[b]:
                if kernel[b]:
                    weight = weigh_robustly(HPHt, R, left, w_b, kernel[b], scale[k, lo:hi], size[b])
                    np.positive(weight, bent[k, lo:hi])
                    R = R / weight
                    L, one = invert_sum(HPHt, R)
                    white = np.dot(one, left)
                    w_b = np.dot(one.T, white)
                W = np.dot(one, HP)
                lossy[b] = False
                for i in range(hi - lo):
                    lossy[b] |= HPHt[i, i] > _LOSSY * R[i]
                Kt_b = np.dot(one.T, W) if gains or lossy[b] else W
                if gains:
                    np.positive(Kt_b, Kt[k, lo:hi])
                    np.negative(w_b, w[k, lo:hi])
                if told:
                    np.positive(np.dot(one.T, one), inverse[k, lo:hi, lo:hi])
                e = e - np.dot(white, W)
                P = update_covariance(P, HP, own, Kt_b, R) if lossy[b] else reduce(P, W)
        np.positive(e, errors[k % len(errors)])
        np.positive(P, P_filtered[k % len(P_filtered)])


@compile_once
def follow_blocks(first: Array, end: Array, root: Array, solved: Array, Kt: Array, y: Array) -> None:
    """Errors y (points, D) after each block of rows, in place, from the predicted ones of each keyframe before them.

    By the root L of all numbers' covariance, number i adds row i of L^T K^T times that of L^-1 nu.

    Parameters
    ----------
    first, end : of blocks that each have a point, as of `RowBlocks`, of these n keyframes.
    root, solved, Kt : (n, M, M), (n, M) and (n, M, D) of the updates, as `filter_rows` has them.
    """
    at, D = 0, y.shape[1]
    for k in range(len(Kt)):
        lo, last = 0, end[first[k + 1] - 1] if first[k] < first[k + 1] else 0
        for b in range(first[k], first[k + 1]):
            now, before = y[at + 1], y[at]
            for c in range(D):
                now[c] = before[c]
            for i in range(lo, end[b]):
                white = 0.0
                for j in range(i, last):
                    white += root[k, j, i] * solved[k, j]
                for j in range(i, last):
                    x, gain = white * root[k, j, i], Kt[k, j]
                    for c in range(D):
                        now[c] -= x * gain[c]
            lo = end[b]
            at += 1
        at += 1


@compile_once
def divide_covariance(P: Array, X: Array) -> None:
    """X (D, n) <- P^-1 X by Cholesky's root of P (D, D).

    Rows are taken off in their order, four in one pass over the row that they are taken off.
    """
    L = np.linalg.cholesky(P)
    D, n = X.shape
    for i in range(D):
        row, fours = X[i], i - i % 4
        for j in range(0, fours, 4):
            a, b, c, d = L[i, j], L[i, j + 1], L[i, j + 2], L[i, j + 3]
            one, two, three, four = X[j], X[j + 1], X[j + 2], X[j + 3]
            for k in range(n):
                row[k] = row[k] - a * one[k] - b * two[k] - c * three[k] - d * four[k]
        for j in range(fours, i):
            a, one = L[i, j], X[j]
            for k in range(n):
                row[k] -= a * one[k]
        a = L[i, i]
        for k in range(n):
            row[k] /= a
    for i in range(D - 1, -1, -1):
        row, fours = X[i], D - (D - i - 1) % 4
        for j in range(i + 1, fours, 4):
            a, b, c, d = L[j, i], L[j + 1, i], L[j + 2, i], L[j + 3, i]
            one, two, three, four = X[j], X[j + 1], X[j + 2], X[j + 3]
            for k in range(n):
                row[k] = row[k] - a * one[k] - b * two[k] - c * three[k] - d * four[k]
        for j in range(fours, D):
            a, one = L[j, i], X[j]
            for k in range(n):
                row[k] -= a * one[k]
        a = L[i, i]
        for k in range(n):
            row[k] /= a


@compile_once
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


@compile_once
def smooth_filtered(
    k0: int, k1: int, moved: Array, turned: Array, steps: Arrays, P_predicted: Array, P: Array,
    P_smoothed: Array, errors: Array, at: Array,
) -> None:  # fmt: skip
    """Smoothed errors (n, D) about filtered states, and covariances, of keyframes k1 - 1 down to k0, from those of k1.

    C = P F^T P-^-1     e = C (x^s - x-) of the next     P^s = P + C (P^s - P-) C^T

    Parameters
    ----------
    moved : (n, D) filtered states less predicted ones; `turned` (n, 4) the quaternions of their rotations.
    steps : F (n-1, 15, w) and decay (n-1, D-15).
    P_smoothed : without any keyframes where covariances are not wanted.
    at : (1,), the keyframe that is smoothed.
    """
    F, decay = steps
    for k in range(k1 - 1, k0 - 1, -1):
        at[0] = k
        ahead = P_predicted[k + 1]
        away = moved[k + 1] + errors[k + 1]
        away[0], away[1], away[2] = compose_turns(turned[k + 1], errors[k + 1])
        Ct = move_columns(F[k], decay[k], P[k])
        if len(P_smoothed) == 0:
            divide_covariance(ahead, away.reshape(-1, 1))
            np.dot(away, Ct, errors[k])
            continue
        divide_covariance(ahead, Ct)
        np.dot(away, Ct, errors[k])
        two = P[k] + np.dot(Ct.T, np.dot(P_smoothed[k + 1] - ahead, Ct))
        halve_sum(two, P_smoothed[k])
