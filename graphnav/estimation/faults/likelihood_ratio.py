"""The tests of `graphnav.estimation.faults.watch`, on arrays alone: compiled where Numba is there.

The state of all tests of a filter is one vector, so that it is saved and restored by copying: X (D, C), followed by the
memory of each kind of rows, with L slots of c numbers:

    first (L,)     score (L, c)     info (L, c, c)     how many fixes have been seen

A layout is of one kind: where its memory begins, its first column in X, L, the numbers m of a fix, and c, which is m,
or 2 m where errors may grow. Its scale is 1 / W^2 and the seconds in which an error grows by one.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.estimation.solvers.recursion import Arrays, move_columns


def count_remembered(L: int, c: int) -> int:
    """Numbers that a kind remembers."""
    return L * (1 + c + c * c) + 1


@compile_once
def begin_slot(memory: Array, t: float, L: int, c: int, prior: float) -> int:
    """Begin the slot whose turn it is at a fix; which one that is."""
    memory[-1] += 1.0
    slot, seen = 0, int(memory[-1])
    while seen % 2 == 0 and slot < L - 1:
        seen //= 2
        slot += 1
    score, info = L + c * slot, L * (1 + c) + c * c * slot
    memory[slot] = t
    memory[score : score + c] = 0.0
    memory[info : info + c * c] = 0.0
    for i in range(c):
        memory[info + i * (c + 1)] = prior
    return slot


@compile_once
def add_row(memory: Array, rho: Array, Gamma: Array, L: int, c: int, errors: Array, T: Array) -> None:
    """Add whitened rows (n,) and their signatures (n, L c) to score and info.

    Parameters
    ----------
    errors, T : (L, c) and (L,), filled with the errors most likely and how much more likely they make all rows.
    """
    n = len(rho)
    root = np.empty((c, c))
    for slot in range(L):
        own = Gamma[:, c * slot : c * slot + c]
        score = memory[L + c * slot : L + c * slot + c]
        at = L * (1 + c) + c * c * slot
        for i in range(c):
            for row in range(n):
                score[i] += own[row, i] * rho[row]
                for j in range(c):
                    memory[at + c * i + j] += own[row, i] * own[row, j]
        # info = root root^T
        b = errors[slot]
        for i in range(c):
            for j in range(i + 1):
                x = memory[at + c * i + j]
                for h in range(j):
                    x -= root[i, h] * root[j, h]
                root[i, j] = np.sqrt(x) if i == j else x / root[j, j]
            b[i] = score[i]
            for h in range(i):
                b[i] -= root[i, h] * b[h]
            b[i] /= root[i, i]
        T[slot] = 0.0
        for i in range(c):
            T[slot] += b[i] * b[i]
        for i in range(c - 1, -1, -1):
            for h in range(i + 1, c):
                b[i] -= root[h, i] * b[h]
            b[i] /= root[i, i]


@compile_once
def respond(H: Array, Kt: Array, X: Array, G: Array) -> None:
    """G (m, n) <- U - H X and X (D, n) <- X + K G: an update with rows that have the errors G = U themselves."""
    G -= np.dot(H, X)
    X += np.dot(Kt.T, G)


@compile_once
def update_tests(
    X: Array, memory: Array, layout: Array, scale: Array, t: float, H: Array, Kt: Array, root: Array, solved: Array,
    errors: Array, T: Array,
) -> None:  # fmt: skip
    """A fix of a tested kind has been taken in at time t, s, by the gain transposed.

    Parameters
    ----------
    root, solved : the lower root of S and S^-1 nu.
    errors, T : as for `add_row`.
    """
    column, L, m, c = layout[1], layout[2], layout[3], layout[4]
    slot, n = begin_slot(memory, t, L, c, scale[0]), len(H)
    X[:, column + c * slot : column + c * (slot + 1)] = 0.0
    G = np.zeros((n, X.shape[1]))
    for one in range(L):
        if not np.isnan(memory[one]):  # a fix itself has the error
            for i in range(n):
                at = column + c * one + i % m
                G[i, at] += 1.0
                if c > m:
                    G[i, at + m] += (t - memory[one]) / scale[1]
    respond(H, Kt, X, G)
    own = G[:, column : column + L * c].copy()
    for i in range(n):
        for j in range(i):
            np.subtract(own[i], root[i, j] * own[j], own[i])
        np.divide(own[i], root[i, i], own[i])
    add_row(memory, np.dot(root.T, solved), own, L, c, errors, T)


@compile_once
def remember(k: int, state: Array, before: Array, keys: Array, ends: Array) -> None:
    """Keep the state before keyframe k in a ring `before` (n, size), which holds rows ends[0] to ends[1] of all."""
    n = len(before)
    at = ends[1] % n
    np.positive(state, before[at])
    keys[at] = k
    ends[1] += 1
    ends[0] = max(ends[0], ends[1] - n)


@compile_once
def follow_filter(
    k0: int, k1: int, b0: int, t: Array, steps: Arrays, updates: Arrays, root: Array, blocks: Arrays, tests: Arrays,
    memory: Arrays, found: Arrays,
) -> tuple[int, int]:  # fmt: skip
    """Follow a filter (`graphnav.estimation.solvers.recursion.filter_rows`) from block b0 of keyframe k0 to k1.

    Returns the keyframe and the block at which the first T is above its limit, or k1 and the block there.

    Parameters
    ----------
    steps : F and decay; `updates` and `blocks` as the filter has them, `root` (n, M, M) of S, weighted.
    tests : the kind (B,) of each block, -1 where it is not tested; the limit (B,) of its T; whether there are fixes
        (K,) at a keyframe, before which the state is remembered; layouts and scales of each kind.
    memory : the state, and the ring of `remember`.
    found : of each kind errors and T, as for `add_row`.
    """
    F, decay = steps
    Kt, H, solved, _, taken, _ = updates
    first, begin, end, _, _, _ = blocks
    kind, limit, met, layouts, scales = tests
    state, before, keys, ends = memory
    errors, T = found
    X = state[: layouts[0, 0]].reshape(H.shape[2], -1)
    for k in range(k0, k1):
        if b0 <= first[k]:
            if met[k]:
                remember(k, state, before, keys, ends)
            if k:
                np.positive(move_columns(F[k - 1], decay[k - 1], X), X)
        for b in range(max(first[k], b0), first[k + 1]):
            if not taken[b]:
                continue
            lo, hi, i = begin[b], end[b], kind[b]
            own, gain = H[k, lo:hi], Kt[k, lo:hi]
            if i < 0:
                respond(own, gain, X, np.zeros((hi - lo, X.shape[1])))
                continue
            layout, S = layouts[i], np.ascontiguousarray(root[k, lo:hi, lo:hi])
            own_memory = state[layout[0] : layout[0] + layout[2] * (1 + layout[4] * (1 + layout[4])) + 1]
            update_tests(X, own_memory, layout, scales[i], t[k], own, gain, S, solved[k, lo:hi], errors[i], T[i])
            if np.max(T[i, : layout[2]]) > limit[b]:
                return k, b
    return k1, first[k1]
