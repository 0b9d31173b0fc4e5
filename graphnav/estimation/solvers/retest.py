"""The tests for errors that last, of a pass at given points that has run without them.

Tests change nothing about a filter until one of them finds something. So where most drives have nothing to be found,
the compiled pass comes first, and the tests follow by the gains and innovations that it left.
"""

from __future__ import annotations

from graphnav.core.rotation import Array
from graphnav.estimation.solvers.passes import Updates
from graphnav.estimation.solvers.points import AtPoints
from graphnav.estimation.solvers.stack import Stack
from graphnav.estimation.solvers.watch import Bank


def finds_fault(bank: Bank, given: AtPoints, decay: Array, stack: Stack, updates: Updates) -> bool:
    """Whether a test finds something, up to which the bank is used.

    Parameters
    ----------
    decay : (K-1, D-15) of the parameters' steps.
    """
    for k in range(len(given.r)):
        if k:
            bank.predicted(given.F[k - 1], decay[k - 1])
        for some in stack.together(k):
            at, name, taken = some.at, some.parts[0][0].name, bool(updates.taken[some.number])
            H, solved, root = given.H[at], stack.solved[at], stack.root[k, at[1], at[1]].copy()
            r = root @ (root.T @ solved)
            bank.seen(name, k, float(r @ solved), taken)
            if taken and bank.updated(name, k, H, updates.Kt[at].T, r, root, given.speed(k)) is not None:
                return True
    return False
