"""A `graphnav.estimation.factor_graph.tree.Tree` of a whole drive, which takes in a keyframe in constant time.

GTSAM's `ISAM2.update` eliminates few variables anew, but walks the whole tree: what was eliminated is a tree for a
moment, and is released clique by clique with all that hangs below it. With 900 keyframes that takes longer than all
else, and with 15,000 sixteen times as long. So a keyframe enters a tree of the newest ones, at the root of which is the
marginal of all before, which one elimination after the other finds. The tree of all takes in what has come since when
it is asked for. Errors are about anchors that stay, and so the marginals stay until factors behind them are replaced.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import gtsam

from graphnav.estimation.factor_graph.tree import Tree
from graphnav.estimation.factor_graph.tree_nodes import Fresh, Made, Variable, fill_keys, make_isam, update_isam
from graphnav.estimation.solvers.elimination import Predicted
from graphnav.estimation.solvers.stages import Measured, Message, Place

_NEWEST = 48  # keyframes in a tree of their own


class WholeTree(Tree):
    """Keyframes of which none is marginalised; parameters as of `Tree`."""

    def __init__(self, prior: Message, turn: float) -> None:
        super().__init__(prior, turn)
        self._all = make_isam(reuses_slots=False)  # `isam` is this one, or that of the newest
        self._gathered = 0  # keyframes in it
        self._begun = 0  # the keyframe that the other begins at
        self._factors: list[dict[str, Any]] = []  # of each keyframe, by the name of the constraint
        self._fresh: list[Sequence[Fresh]] = []
        self._marginals: dict[int, Any] = {}  # factor on a keyframe and its parameters, of all rows up to it

    def add(self, place: Place, ahead: Predicted | None = None, rows: Sequence[Measured] = ()) -> float:
        """As of `Tree`."""
        last = len(self) - 1
        known = self._find_marginal(last) if len(self) else None  # a little at each, not all where it is needed
        if self.isam is self._all or last - self._begun >= _NEWEST:
            variables, self.isam, self._begun = self._list_variables(last), make_isam(), last
            update_isam(self.isam, place.t, fresh=[*((x, None) for x in variables[1:]), (variables[0], known)])
        self._factors.append({})
        self._fresh.append(())
        return super().add(place, ahead, rows)

    def read(self) -> None:
        """Bring all estimates up to date."""
        first, self._gathered, self.isam = self._gathered, len(self), self._all
        if first < len(self):
            some = zip(self.keyframes[first:], self._factors[first:], strict=True)
            made = [(k, name, one) for k, factors in some for name, one in factors.items()]
            self._replace(made, [], first, [one for fresh in self._fresh[first:] for one in fresh])
        super().read()

    def _update(
        self,
        made: Sequence[Made] = (),
        order: Iterable[tuple[Variable, int]] | None = None,
        gone: Sequence[int] = (),
        fresh: Sequence[Fresh] = (),
        anew: Iterable[Variable] | None = None,
    ) -> None:
        super()._update(made, order, gone, fresh, anew)
        for keyframe, name, one in made:
            self._factors[keyframe.number][name] = one
        if self.isam is not self._all and fresh:
            self._fresh[-1] = fresh
        if gone:
            first = min(keyframe.number for keyframe, _, _ in made)
            self._marginals = {k: one for k, one in self._marginals.items() if k < first}

    def _find_recent(self) -> Iterable[Variable]:
        return (x for x in super()._find_recent() if x.last >= self._begun)

    def _list_variables(self, k: int) -> list[Variable]:
        """A keyframe's, its state first."""
        own = self.keyframes[k]
        return list({x.key: x for x in (own.state, *(node for node, _ in own.nodes.values()))}.values())

    def _find_marginal(self, last: int) -> Any:
        """A factor of what a keyframe and all before it say of its variables."""
        begin = max(self._marginals, default=-1)
        for before, k in pairwise([begin, *(k for k in range(begin + 1, last) if k % _NEWEST == 0), last]):
            inside = {x.key: x for i in range(max(before, 0), k + 1) for x in self._list_variables(i)}
            graph = gtsam.GaussianFactorGraph()
            for i in range(before + 1, k + 1):
                for one in (*self._factors[i].values(), *(prior for _, prior in self._fresh[i] if prior is not None)):
                    graph.push_back(one.factor())
            if before in self._marginals:
                graph.push_back(self._marginals[before].factor())
            stay = {x.key for x in self._list_variables(k)}
            gone = sorted((x for x in inside.values() if x.key not in stay), key=lambda x: x.last)
            left = graph.eliminatePartialSequential(fill_keys(gtsam.Ordering(), gone), gtsam.EliminateQR)[1]
            self._marginals[k] = gtsam.LinearContainerFactor(gtsam.JacobianFactor(left))
            if before % _NEWEST:
                self._marginals.pop(before, None)
        return self._marginals[last]
