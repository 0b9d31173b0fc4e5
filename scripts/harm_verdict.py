"""What the rows of do_no_harm.py come to: pairs of stated and estimated noise, pooled errors, bounds, tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from graphnav.estimation.pipeline import SOLVERS

Row = dict[str, Any]
Group = tuple[str, str, str]  # drive, sensor set, solver

ONLINE = ("at once", "settled")  # in place of a filter and a smoother
FILTERS = (SOLVERS[0], ONLINE[0])

FLOOR = 0.05  # m; below it neither the truths nor the fixes withheld tell one error from another
COLUMNS = (
    "drive", "sensors", "solver", "windows", "h s, m", "h e, m", "up s, m", "up e, m", "worst h", "worst up",
    "median h", "NEES s", "NEES e", "left out, %", "confirmed left out, %", "of filter h", "of filter up", "time",
)  # fmt: skip
BOUNDS = {
    "solved": 0,  # windows that only the estimating makes unsolvable
    "worst": 1.3,  # estimated over stated error of any window
    "median": 0.9,  # the same in the median over all windows of real drives: the estimating has to be worth it
    "confirmed": 0.01,  # share of the fixes of a window that the truth confirms and that are left out
    "smoother": 1.1,  # a smoother's pooled error over its filter's
    "time": 3.0,  # processor time estimated over stated
}
OF_ESTIMATED = "confirmed", "smoother"  # the bounds that need no rows with stated noise


def key_of(row: Row) -> tuple[str, ...]:
    return tuple(row[name] for name in ("drive", "window", "sensors", "variant", "solver"))


@dataclass(frozen=True)
class Pair:
    """The same window with the same solver, stated and estimated; `stated` may be lacking."""

    stated: Row | None
    estimated: Row

    @property
    def solved(self) -> bool:
        return self.stated is not None and "error" not in self.stated and "error" not in self.estimated

    def ratio(self, axis: str) -> float | None:
        """Estimated over stated; None where neither is large enough, or one is not known."""
        if not self.solved or self.stated is None or self.stated[axis] is None or self.estimated[axis] is None:
            return None
        if max(self.stated[axis], self.estimated[axis]) <= FLOOR:
            return None
        return float(self.estimated[axis] / max(self.stated[axis], 1e-9))

    @property
    def lost(self) -> float | None:
        """Share of the confirmed fixes that is left out; None where none is, or the window cannot be solved."""
        confirmed = self.estimated.get("confirmed") if self.solved or self.stated is None else None
        return None if not confirmed else self.estimated["confirmed_left_out"] / confirmed

    @property
    def name(self) -> str:
        drive, window, sensors, _, solver = key_of(self.estimated)
        return f"{drive} {window} {sensors} {solver}"


def pairs_of(rows: Iterable[Row]) -> dict[Group, list[Pair]]:
    """The pairs by drive, sensor set and solver, in the rows' order."""
    by_key = {key_of(row): row for row in rows}
    groups: dict[Group, list[Pair]] = {}
    for (drive, window, sensors, variant, solver), row in by_key.items():
        if variant == "estimated":
            stated = by_key.get((drive, window, sensors, "stated", solver))
            groups.setdefault((drive, sensors, solver), []).append(Pair(stated, row))
    return groups


def pooled(rows: Iterable[Row | None], axis: str) -> float:
    """Root mean square over the windows that have the error; NaN without any."""
    squares = [row[axis] ** 2 for row in rows if row is not None and row.get(axis) is not None]
    return math.sqrt(sum(squares) / len(squares)) if squares else math.nan


def counted(pairs: list[Pair]) -> list[Pair]:
    """Those solved both ways; where nothing was solved as stated, those solved at all."""
    both = [p for p in pairs if p.solved]
    return both or [p for p in pairs if p.stated is None and "error" not in p.estimated]


def against_filter(groups: dict[Group, list[Pair]], group: Group, axis: str) -> float:
    """A solver's pooled error over its filter's, estimated; NaN where not known, neither is large enough, or there is
    one window alone: an error that all its fixes share is no smoother's.
    """
    if len(pairs := groups[group]) == 1 and pairs[0].estimated["window"] != "whole":
        return math.nan
    of = FILTERS[group[2] in ONLINE]
    own, of_filter = (
        pooled((p.estimated for p in counted(groups.get(g, []))), axis) for g in (group, (*group[:2], of))
    )
    return own / of_filter if of_filter > 0 and max(own, of_filter) > FLOOR else math.nan


def slower(pairs: list[Pair]) -> float:
    """Processor time estimated over stated, of the windows solved both ways."""
    stated = sum(p.stated["seconds"] for p in pairs if p.solved and p.stated is not None)
    return sum(p.estimated["seconds"] for p in pairs if p.solved) / stated if stated > 0 else math.nan


@dataclass(frozen=True)
class Breach:
    """A bound of `BOUNDS` and what breaks it."""

    bound: str
    name: str  # of the window or group; empty for a bound on all
    value: float  # that the bound is for; NaN where a window is not solved
    detail: str

    def __str__(self) -> str:
        value = f"{self.value:.3g}" if math.isfinite(self.value) else ""
        return f"{self.name}: {value} {self.detail}" if self.name else f"{value} {self.detail}"


def broken(rows: list[Row]) -> list[Breach]:
    """Every breach of a bound."""
    groups, ratios = pairs_of(rows), []
    out: list[Breach] = []
    for group, pairs in groups.items():
        name, (drive, sensors, solver) = " ".join(group), group
        for p in pairs:
            if p.stated is not None and "error" not in p.stated and "error" in p.estimated:
                out.append(Breach("solved", p.name, math.nan, p.estimated["error"]))
            for axis in ("h", "up"):
                ratio = p.ratio(axis)
                if ratio is not None and p.stated is not None and ratio > BOUNDS["worst"]:
                    detail = f"({metres(p.stated[axis])} -> {metres(p.estimated[axis])} m)"
                    out.append(Breach("worst", f"{p.name}, {axis}", ratio, detail))
            if p.lost is not None and p.lost > BOUNDS["confirmed"]:
                detail = f"({p.estimated['confirmed_left_out']} of {p.estimated['confirmed']})"
                out.append(Breach("confirmed", p.name, p.lost, detail))
        if not pairs[0].estimated["simulated"]:
            ratios += [r for p in pairs if (r := p.ratio("h")) is not None]
        for axis in ("h", "up"):
            if (ratio := against_filter(groups, group, axis)) > BOUNDS["smoother"]:
                out.append(Breach("smoother", f"{name}, {axis}", ratio, "of its filter's"))
        if solver in FILTERS and (ratio := slower(pairs)) > BOUNDS["time"]:
            out.append(Breach("time", f"{drive} {sensors}", ratio, "times"))
    if ratios and np.median(ratios) >= BOUNDS["median"]:
        detail = f"over {len(ratios)} horizontal errors of real drives"
        out.append(Breach("median", "", float(np.median(ratios)), detail))
    return out


def metres(x: float | None) -> str:
    return "-" if x is None or not math.isfinite(x) else f"{x:.3f}" if x < 10 else f"{x:.3g}"


def middle(values: Iterable[float | None]) -> str:
    known = [x for x in values if x is not None and math.isfinite(x)]
    return f"{np.median(known):.2f}" if known else "-"


def most(values: Iterable[float | None], unit: float = 1.0) -> str:
    known = [x for x in values if x is not None]
    return f"{unit * max(known):.2f}" if known else "-"


def table(rows: list[Row]) -> Iterator[str]:
    """Per drive, sensor set and solver; s stated, e estimated noise; of the left out the worst window."""
    groups = pairs_of(rows)
    yield f"| {' | '.join(COLUMNS)} |"
    yield "|" + " --- |" * len(COLUMNS)
    for group, pairs in groups.items():
        good = counted(pairs)
        both, estimated = [p.stated for p in good], [p.estimated for p in good]
        cells = [group[0] + " (simulated)" * pairs[0].estimated["simulated"], *group[1:]]
        cells.append(f"{len(good)}" + f"/{len(pairs)}" * (len(good) < len(pairs)))
        cells += [metres(pooled(side, axis)) for axis in ("h", "up") for side in (both, estimated)]
        cells += [most(p.ratio("h") for p in good), most(p.ratio("up") for p in good)]
        cells += [middle(p.ratio("h") for p in good)]
        cells += [middle(row.get("nees") for row in side if row is not None) for side in (both, estimated)]
        cells += [most((r["left_out"] / max(r["fixes"], 1) for r in estimated), 100), most((p.lost for p in good), 100)]
        cells += [middle([against_filter(groups, group, axis)]) for axis in ("h", "up")] + [middle([slower(pairs)])]
        yield "| " + " | ".join(cells) + " |"


def failures(rows: list[Row]) -> Iterator[str]:
    for row in rows:
        if "error" in row and row["solver"] in FILTERS:
            yield f"not solved: {' '.join(key_of(row)[:4])}: {row['error']}"


def compared(rows: list[Row], old: list[Row]) -> Iterator[str]:
    """Pooled estimated errors of two runs over the windows that both have."""
    before = {key_of(row): row for row in old if row["variant"] == "estimated" and "error" not in row}
    groups: dict[tuple[str, ...], list[tuple[Row, Row]]] = {}
    for row in rows:
        if row["variant"] == "estimated" and "error" not in row and key_of(row) in before:
            groups.setdefault((row["drive"], row["sensors"], row["solver"]), []).append((before[key_of(row)], row))
    yield "| drive | sensors | solver | windows | h old, m | h new, m | up old, m | up new, m | horizontally |"
    yield "|" + " --- |" * 9
    for group, both in groups.items():
        values = [pooled((pair[k] for pair in both), axis) for axis in ("h", "up") for k in (0, 1)]
        same = abs(values[1] - values[0]) <= 0.01 * values[0]
        word = "same to 1 %" if same else "better" if values[1] < values[0] else "worse"
        yield "| " + " | ".join([*group, str(len(both)), *map(metres, values), word]) + " |"
