"""Logs of one sensor that a logger wrote one after the other, put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphnav.recording.draft.plain import Plain
from graphnav.recording.draft.tables import Source


def join_parts(some: Sequence[Source]) -> Source | None:
    """Join logs with the same columns, each beginning after the end of the one before; None if they are not such."""
    first, *rest = parts = sorted(some, key=lambda s: 0.0 if s.log is not None else float(s.t[0]))
    alike = all(s.log is None and _describe(s) == _describe(first) for s in parts)
    if not alike or any(after.t[0] <= before.t[-1] for before, after in zip(parts, rest, strict=False)):
        return None
    values = {name: np.concatenate([s.values[name] for s in parts]) for name in first.values}
    added = f"{', '.join(s.path.name for s in rest)} after its end"
    plain = Plain({}, ", ".join(words for words in (first.plain.words if first.plain else "", added) if words))
    return replace(first, values=values, plain=plain)


def _describe(source: Source) -> tuple[object, ...]:
    """Properties common to the parts of one log; times of day restart and so do not define the order."""
    daily = source.path if source.plain is not None and source.plain.daily else None
    return source.columns.names, source.columns.units, source.t_unit.value, source.week, daily
