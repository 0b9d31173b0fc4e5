"""GTSAM's iSAM2 (Kaess et al. 2012) over error states: keyframes are added, relinearised and marginalised.

Each variable is the error e of a state or of parameters about a fixed anchor X0: X = X0 [+] e. Rows linearised
where the errors are d, A (X [-] (X0 [+] d)) = b, are rows of e to first order,

    A J (e - d) = b      J = J_r(d) in the columns of the attitude, else the identity

so that GTSAM has a linear problem without factors that call back into Python. Relinearisation is fluid as in iSAM2:
rows of a variable that has moved beyond a threshold from its linearisation point are linearised again, in NumPy and all
at once, and replace the old factors by their indices.

Constants are chains with a node every half minute: a single variable for the whole drive would involve all of it in
every update. Keyframes older than a lag are marginalised: variables are ordered along time, so they are leaves of the
tree, and their marginal becomes a factor on the variables they touched, which stays linear about the anchors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from graphnav.core.memory import return_memory
from graphnav.core.rotation import Array
from graphnav.core.state import DIM
from graphnav.estimation.factor_graph.tree_nodes import (
    LINK,
    ROWS,
    Block,
    Keyframe,
    Made,
    Nodes,
    Variable,
    are_leaves,
    compute_turns,
    fill_keys,
    find_node_limits,
    is_constant,
    make_factor,
    make_interval_factor,
    make_isam,
    make_row_factor,
    read_states,
    take_deltas,
    update_isam,
)
from graphnav.estimation.solvers.elimination import Predicted
from graphnav.estimation.solvers.linearise import Step, shift
from graphnav.estimation.solvers.revision import Relaxation, Renewed, linearise_runs
from graphnav.estimation.solvers.stages import (
    Measured,
    Message,
    Place,
    append_columns,
)
from graphnav.estimation.solvers.window import ALMOST

NODE_EVERY = 30.0  # s from one node of a constant to the next
_TIED = 1e-5  # of its prior sigma, by which a constant may differ from node to node: 0.03 % of it in ten hours
_UNIT = np.repeat([1e-3, 1.0, 0.1, 1e-3, 1e-5], 3)  # of a state's errors, so that one threshold fits them all
_TOGETHER, _GROWN = 16, 8  # keyframes that enter together, and what part of all of them if that is more


class Tree:
    """Keyframes in an iSAM2.

    They wait, as a filter knows them, and enter together when the tree is read, or has grown by an eighth: what changes
    at a keyframe is eliminated once for all of them, and `ISAM2.update` releases what it has eliminated clique by
    clique with all that hangs below, which over a whole drive takes longer than all else.

    Parameters
    ----------
    prior : message on the first keyframe before any measurement.
    turn : rad that an attitude may move before its rows are linearised anew.
    """

    def __init__(self, prior: Message, turn: float) -> None:
        self.isam: Any = make_isam()
        self.turn = turn
        # factors of the newest keyframes, and on their variables
        self._waiting: list[tuple[list[Made], list[Any]]] = []
        self._stale = False  # whether the tree knows more than was taken over from it
        self.keyframes: list[Keyframe] = []
        self._prior = prior
        self._number = self._key = 0
        self._in_force: Nodes = {}
        self.variables: dict[int, Variable] = {}
        self._first_sigma: dict[str, Array] = {}
        self._constant: set[str] = set()
        self.blocks: list[Block] = []  # of keyframes that nothing has changed since
        self.held = 0  # keyframes at the front that stay as they are: 1 where the first is behind the window

    def __len__(self) -> int:
        return len(self.keyframes)

    # --------------------------------------------------------------------------------------------------- entering
    def add(self, ahead: Predicted, rows: Sequence[Measured], found: Message) -> None:
        """Add a keyframe.

        Parameters
        ----------
        ahead : its prediction, from where the newest keyframe is now.
        rows : measurements, linearised there.
        found : what a filter makes of them, until the tree is read.
        """
        place, point, prior = ahead.stage.place, ahead.stage.message, self._prior
        if not self.keyframes and place.linked:
            self._add_first_keyframe(place)
        made, known = list[Made](), list[Any]()
        x, nodes = self._open(place, known)
        names = frozenset(one.name for one in rows)
        keyframe = Keyframe(self._number, place.t, x, point.state, point.columns, nodes, names)
        keyframe.put(point.state, point.values)
        for variable in keyframe.variables:
            variable.last = self._number
            if variable.first == self._number:
                variable.point = variable.delta.copy()
        if ahead.link is None:
            known.append(make_factor([(x, slice(0, DIM), prior.R[:, :DIM])], prior.z))
        else:
            turns = compute_turns([self.keyframes[-1], keyframe])
            made.append((keyframe, LINK, make_interval_factor(self.keyframes[-1], x, ahead.link, turns)))
        if rows:
            made.append((keyframe, ROWS, make_row_factor(keyframe, rows, np.eye(3))))
        keyframe.put(found.state, found.values)
        self._append(keyframe, made, known)

    def _append(self, keyframe: Keyframe, made: list[Made], known: list[Any]) -> None:
        self.keyframes.append(keyframe)
        self._waiting.append((made, known))
        self._number += 1
        if len(self._waiting) > max(_TOGETHER, len(self) // _GROWN):
            self._enter()

    def _add_first_keyframe(self, place: Place) -> None:
        """Add the initial message as a keyframe before the first."""
        prior, columns = self._prior, self._prior.columns
        x, nodes = self._add_variable(_UNIT, place.t), Nodes()
        parts = [(x, slice(0, DIM), prior.R[:, :DIM])]
        if columns:
            node = self._add_variable(np.ones(len(prior.values)), place.t)
            node.anchor[:] = prior.values
            node.limit = find_node_limits(columns, place)
            nodes = {name: (node, shift(at)) for name, at in columns.items()}
            parts.append((node, slice(0, len(prior.values)), prior.R[:, DIM:]))
        assert place.problem is not None
        for name, p in place.problem.parameters.items():
            if name in columns and p.constant:
                self._constant.add(name)
                self._first_sigma[name] = p.sigma
        self._in_force = nodes
        keyframe = Keyframe(self._number, place.t, x, prior.state, columns, nodes, frozenset())
        known = prior.move(prior.estimate)
        keyframe.put(known.state, known.values)
        self._append(keyframe, [], [make_factor(parts, prior.z)])
        self.held = 1

    def _add_variable(self, unit: Array, t: float) -> Variable:
        point, delta, anchor = np.zeros((3, len(unit)))
        out = Variable(self._key, unit, point, delta, anchor, self._number, self._number, t)
        self.variables[self._key] = out
        self._key += 1
        return out

    def _open(self, place: Place, known: list[Any]) -> tuple[Variable, Nodes]:
        """Begin the variable of a state, the nodes of parameters that step there, and the next ones of constants.

        A node is part of the state's variable where the one before it governed a single keyframe, as it will: each of
        two small eliminations in place of one would pass through all that both touch, and GTSAM would keep both.

        Returns the variable, and the nodes in force.
        """
        steps, before = list(place.steps), self._in_force
        self._constant |= {s.name for s in steps if is_constant(place, s.name)}
        for name in sorted(self._constant.intersection(before).difference(s.name for s in steps)):
            node, own = before[name]
            if place.t - node.t >= NODE_EVERY:
                value = node.anchor[own]
                steps.append(Step(name, value, _TIED * self._first_sigma[name], 1.0, value))
        beside, constant, rest = list[Step](), list[Step](), list[Step]()
        for s in steps:
            brief = s.name in before and before[s.name][0].first == self._number - 1
            (constant if s.name in self._constant else beside if brief else rest).append(s)
        self._in_force = in_force = dict(before) if steps else before
        x = self._begin_nodes(beside, place, before, known, _UNIT)
        for some in (constant, rest):
            if some:
                self._begin_nodes(some, place, before, known)
        return x, in_force

    def _begin_nodes(
        self, steps: Sequence[Step], place: Place, before: Nodes, known: list[Any], unit: Array = _UNIT[:0]
    ) -> Variable:
        """A variable of numbers in a `unit` and, behind them, nodes of parameters."""
        sigma = [self._first_sigma.setdefault(s.name, np.asarray(s.sigma, dtype=float)) for s in steps]
        x, begin = self._add_variable(np.concatenate([unit, *sigma]), place.t), len(unit)
        if not steps:
            return x
        x.limit = find_node_limits(append_columns({}, steps), place, begin)
        root = np.diag(1.0 / np.concatenate([s.sigma for s in steps]))
        parts, at = [(x, slice(begin, len(x.unit)), root)], begin
        for s in steps:
            own = slice(at, at + len(s.mean))
            x.anchor[own], at = s.mean, own.stop
            if s.name in before and s.decay:
                old, was = before[s.name]
                x.anchor[own] = s.predict(old.anchor[was])
                parts.append((old, was, -s.decay * root[:, own.start - begin : own.stop - begin]))
            self._in_force[s.name] = x, own
        known.append(make_factor(parts, np.zeros(len(root))))
        return x

    def _enter(self) -> None:
        """Take in the keyframes that wait."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            own = self.keyframes[-len(waiting) :]
            made, known = ([one for part in parts for one in part] for parts in zip(*waiting, strict=True))
            fresh = [x for k in own for x in k.variables if x.first == k.number]
            self._replace(made, [], own[0].number - 1, fresh, known)

    def _replace(
        self, made: Sequence[Made], gone: Sequence[int], first: int, fresh: Sequence[Variable] = (), known: Any = ()
    ) -> None:
        """Have factors in place of others, on keyframes from number `first` on."""
        # elimination order is that of time, in which those in force are the newest, though nothing new may touch them:
        # else what leaves would stand above them. With much to do, GTSAM rebuilds the whole tree. The keyframe before
        # the first may be in one clique with it, and would have no place in the order
        first = max(first - 1, self.keyframes[0].number)
        late = [v for v in self.variables.values() if v.last >= first]
        if 2 * len(late) > len(self.variables) and not fresh:
            late, first = list(self.variables.values()), self.keyframes[0].number
        order, new = [(v, v.last - first) for v in late], {v.key for v in fresh}
        again = [v for v in late if v.key not in new]
        self._stale = True
        update_isam(self.isam, self.keyframes[-1].t, made, gone, fresh, known, order, again)

    # ------------------------------------------------------------------------------------------ linearising again
    def read(self) -> None:
        """Bring all estimates up to date."""
        self._enter()
        if self._stale and self.isam is not None:
            take_deltas(self.isam, self.variables.values())
            self._stale = False

    def linearise(self, which: Iterable[int]) -> gtsam.GaussianFactorGraph:
        """The factors at some indices."""
        graph, factors = gtsam.NonlinearFactorGraph(), self.isam.getFactorsUnsafe()
        for one in map(factors.at, which):
            if one is not None:
                graph.push_back(one)
        return graph.linearize(self.isam.getLinearizationPoint())

    def find_moves(self) -> Array:
        """(K,) how far keyframes' estimates are from where their rows were linearised, 1 at the limit."""
        if len(self) <= self.held:
            return np.empty(0)
        off = np.array([k.state.delta[:3] - k.state.point[:3] for k in self.keyframes])
        moves = np.linalg.norm(off, axis=1) / self.turn
        before, first = self.keyframes[0].number, self.keyframes[self.held].number
        limited = [x for x in self.variables.values() if len(x.limit) and x.last >= first]
        if limited:
            far = np.concatenate([x.delta - x.point for x in limited]) / np.concatenate([x.limit for x in limited])
            edge = np.cumsum([0, *(len(x.limit) for x in limited[:-1])])
            for x, move in zip(limited, np.maximum.reduceat(np.abs(far), edge).tolist(), strict=True):
                own = slice(max(x.first - before, 0), x.last - before + 1)
                moves[own] = np.maximum(moves[own], move)
        moves[: self.held] = 0.0
        return moves

    def relinearise(self, share: float, renewed: Renewed, relaxation: Relaxation) -> int:
        """Relinearise keyframes that have moved beyond a share of the limits; returns their number."""
        self.read()
        moves = self.find_moves()
        if not (moves > share).any():
            return 0
        which = np.flatnonzero(moves > ALMOST * share)
        step = np.zeros((len(self), 3))
        own = [self.keyframes[i] for i in which]
        step[which] = [k.state.delta[:3] - k.state.point[:3] for k in own]
        part = relaxation.find_share(step)
        for x in {x.key: x for k in own for x in k.variables}.values() if part < 1.0 else ():
            x.delta = x.point + part * (x.delta - x.point)
        self.linearise_again(which, renewed)
        return len(which)

    def linearise_again(self, which: Iterable[int], renewed: Renewed) -> None:
        """Linearise keyframes, and the intervals on either side, where they are now.

        `renewed` returns the places of those from one index to another, which count from those held on.
        """
        rows = {i for i in map(int, which) if i >= self.held}
        if not rows:
            return
        self._enter()
        links = {k for i in rows for k in (i, i + 1) if k < len(self) and LINK in self.keyframes[k].slots}
        made: list[Made] = []
        wanted = np.array(sorted(rows | links))
        for run in np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1):
            first, own = int(run[0]), self.keyframes[run[0] : run[-1] + 1]
            places = renewed(first - self.held, first - self.held + len(own))
            # the interval before the oldest keyframe is gone
            places = [p if LINK in k.slots else replace(p, linked=False) for p, k in zip(places, own, strict=True)]
            around = [self.keyframes[max(first - 1, 0)], *own]
            values, columns, turns = [k.values for k in around], [k.columns for k in own], compute_turns(around)
            for k, linear in enumerate(linearise_runs(places, read_states(around), values, columns)):
                i, keyframe = first + k, own[k]
                if i in links:
                    assert linear.link is not None
                    made.append(
                        (keyframe, LINK, make_interval_factor(around[k], keyframe.state, linear.link, turns[k : k + 2]))
                    )
                if i in rows:
                    zero = np.zeros(DIM + len(values[k + 1]))
                    measured = [one.weigh(zero) for one in linear.measured if one.name in keyframe.names]
                    if measured and ROWS in keyframe.slots:
                        made.append((keyframe, ROWS, make_row_factor(keyframe, measured, turns[k + 1])))
        gone = [keyframe.slots.pop(name) for keyframe, name, _ in made]
        changed = {keyframe.number for keyframe, _, _ in made}
        self.blocks = [b for b in self.blocks if changed.isdisjoint(range(b.first + 1, b.last + 1))]
        for i in rows:
            for x in self.keyframes[i].variables:
                x.point = x.delta.copy()
        self._replace(made, gone, self.keyframes[min(rows)].number - 1)

    # ---------------------------------------------------------------------------------------------------- leaving
    def release(self) -> None:
        """Let go of GTSAM's tree, where all leave: of a whole drive it is larger than all else."""
        self.isam = None
        return_memory()

    def truncate(self, keep: int) -> None:
        """Remove all but the first keyframes, because something before the others has changed."""
        entered = len(self) - len(self._waiting)
        del self._waiting[max(keep - entered, 0) :], self.keyframes[keep:]
        last = self.keyframes[-1]
        self._number, self._in_force, self._stale = last.number + 1, last.nodes, True
        self.blocks = [block for block in self.blocks if block.last <= last.number]
        # factors on variables that began later are removed as well
        late = {x.key for x in self.variables.values() if x.first > last.number}
        for key in late:
            del self.variables[key]
        for x in self.variables.values():
            x.last = min(x.last, last.number)
        if keep < entered:
            factors = self.isam.getFactorsUnsafe()
            alive = ((i, factors.at(i)) for i in range(factors.size()))
            own = [i for i, one in alive if one is not None and not late.isdisjoint(one.keys())]
            self._replace([], own, last.number)

    def __getstate__(self) -> dict[str, Any]:
        """All but the tree itself, which is made again from its factors."""
        self._enter()
        return {**self.__dict__, "blocks": [], "isam": self.isam.getFactorsUnsafe().serialize()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        text, graph = state.pop("isam"), gtsam.NonlinearFactorGraph()
        self.__dict__.update(state)
        self.isam = make_isam()
        graph.deserialize(text)
        factors = {i: one for i in range(graph.size()) if (one := graph.at(i)) is not None}
        made = [(k, name, factors.pop(i)) for k in self.keyframes for name, i in k.slots.items()]
        if self.keyframes:
            self._replace(made, [], self.keyframes[0].number, list(self.variables.values()), list(factors.values()))

    def marginalise(self, count: int) -> None:
        """Marginalise the first keyframes, and the parameters' nodes that only they touch."""
        self._enter()
        first = self.keyframes[count].number
        gone = [x for x in self.variables.values() if x.last < first]
        stay = [x for x in self.variables.values() if x.last >= first]
        if not are_leaves(self.isam, gone, stay):  # GTSAM would drop what stands below them, too
            self._replace([], [], self.keyframes[0].number)
        left = set(self.isam.marginalizeLeavesWithIndices(fill_keys(gtsam.KeyList(), gone))[1])
        for x in gone:
            del self.variables[x.key]
        del self.keyframes[:count]
        for keyframe in self.keyframes:
            if not left.isdisjoint(keyframe.slots.values()):
                keyframe.slots = {name: i for name, i in keyframe.slots.items() if i not in left}
