"""A `graphnav.estimation.factor_graph.tree.Tree` of a whole drive, which takes in a keyframe in constant time.

GTSAM's `ISAM2.update` eliminates few variables anew, but walks the whole tree: what was eliminated is a tree for a
moment, and is released clique by clique with all that hangs below it. With 900 keyframes that takes longer than all
else, and with 15,000 sixteen times as long. So a keyframe enters a copy of the tree of all, in which everything before
the newest keyframes is marginalised. The tree of all takes in what has come since when it is asked for; the copy is
made anew where factors of it were replaced meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
        self._all = make_isam(reuses_slots=False)
        self._newest: gtsam.ISAM2 | None = self.isam  # `isam` is this one or that of all; None where it holds no more
        self._begun = 0  # the keyframe that it begins at
        self._gathered = 0  # keyframes in the other, and what has come since
        self._made: dict[tuple[int, str], Made] = {}
        self._fresh: list[Fresh] = []

    def add(self, place: Place, ahead: Predicted | None = None, rows: Sequence[Measured] = ()) -> float:
        """As of `Tree`."""
        if self._newest is None:
            self._newest, self._begun = gtsam.ISAM2(self._all), 0
            self._begin_at_last(self._newest)
        elif len(self) - self._begun > _NEWEST:
            self._begin_at_last(self._newest)
        self.isam = self._newest
        return super().add(place, ahead, rows)

    def _begin_at_last(self, isam: gtsam.ISAM2) -> None:
        """Marginalise all but the last keyframe in a tree."""
        last = self.keyframes[-2:]
        own = {x.key: x for k in last for x in k.variables}.values()
        # its variables become the root: rows of the newest keyframes need not have touched all of them, and GTSAM would
        # drop what stands below others; besides, a copy shares its cliques, and of these some are to change
        update_isam(isam, last[-1].place.t, order=[(x, x.last - last[0].number) for x in own], anew=own)
        inside = {x.key: x for k in self.keyframes[self._begun :] for x in k.variables}
        for x in last[-1].variables:
            del inside[x.key]
        isam.marginalizeLeaves(fill_keys(gtsam.KeyList(), inside.values()))
        self._begun = len(self) - 1

    def read(self) -> None:
        """Bring all estimates up to date."""
        self.isam = self._all
        if self._gathered < len(self):
            made, fresh, first = list(self._made.values()), self._fresh, max(self._gathered - 1, 0)
            self._made, self._fresh, self._gathered = {}, [], len(self)
            self._replace(made, [], first, fresh)
        super().read()

    def _update(
        self, made: Sequence[Made] = (), gone: Sequence[int] = (), fresh: Sequence[Fresh] = (), **how: Any
    ) -> None:
        super()._update(made, gone, fresh, **how)
        if self.isam is not self._all:
            self._made.update(((keyframe.number, name), (keyframe, name, one)) for keyframe, name, one in made)
            self._fresh += fresh
        elif gone:
            self._newest = None

    def _find_recent(self) -> Iterable[Variable]:
        return (x for x in super()._find_recent() if x.last >= self._begun)
