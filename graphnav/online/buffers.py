"""Rows of one sensor in order of time, with the oldest dropped."""

from __future__ import annotations

from typing import Any

import numpy as np

from graphnav.core.rotation import Array

SAME = 1e-9  # s; rows closer together than this are the same row


class Buffer:
    """Rows (t, values), kept in order of time whatever order they arrive in; appending at the end copies nothing."""

    def __init__(self, columns: int) -> None:
        self._data = np.empty((256, 1 + columns))
        self._begin = self._end = 0

    def __len__(self) -> int:
        return self._end - self._begin

    @property
    def rows(self) -> Array:
        """(N, 1 + columns), the time first; a view."""
        return self._data[self._begin : self._end]

    @property
    def t(self) -> Array:
        """(N,) s"""
        return self._data[self._begin : self._end, 0]

    @property
    def newest(self) -> float:
        """Newest time, minus infinity without rows."""
        return float(self._data[self._end - 1, 0]) if self._end > self._begin else -np.inf

    def append(self, t: float, values: tuple[float, ...]) -> None:
        """Append a row that is newer than all others."""
        if self._end == len(self._data):
            self._make_room()
        self._data[self._end] = (t, *values)
        self._end += 1

    def add(self, t: float, values: tuple[float, ...]) -> bool:
        """Insert a row by its time; returns False if there already is one at that time, which stays."""
        if t > self.newest + SAME:
            self.append(t, values)
            return True
        if self._end == len(self._data):
            self._make_room()
        at = self._end
        if at > self._begin:
            at = self._begin + int(np.searchsorted(self.t, t))
            near = self._data[max(at - 1, self._begin) : min(at + 1, self._end), 0]
            if np.abs(near - t).min() <= SAME:
                return False
        self._data[at + 1 : self._end + 1] = self._data[at : self._end]
        self._data[at, 0], self._data[at, 1:] = t, values
        self._end += 1
        return True

    def list_after(self, t: float) -> list[tuple[float, tuple[float, ...]]]:
        """The rows after a time, as they were added."""
        return [(float(row[0]), tuple(row[1:].tolist())) for row in self.rows[self.t > t]]

    def drop_before(self, t: float) -> None:
        """Drop the rows before a time."""
        self._begin += int(np.searchsorted(self.t, t))

    def drop_after(self, t: float) -> None:
        """Drop the rows after a time."""
        self._end = self._begin + int(np.searchsorted(self.t, t, side="right"))

    def drop(self, t: float) -> None:
        """Drop the row at a time."""
        at = self._begin + int(np.searchsorted(self.t, t))
        self._data[at : self._end - 1] = self._data[at + 1 : self._end]
        self._end -= 1

    def copy_between(self, begin: float, end: float) -> Array:
        """A copy of the rows from `begin` to `end`, both included."""
        lo, hi = np.searchsorted(self.t, begin, side="left"), np.searchsorted(self.t, end, side="right")
        return self.rows[lo:hi].copy()

    def _make_room(self) -> None:
        rows = self.rows
        if len(rows) > len(self._data) // 2:
            grown = np.empty((2 * len(self._data), self._data.shape[1]))
            grown[: len(rows)] = rows
            self._data = grown
        else:
            self._data[: len(rows)] = rows.copy()
        self._begin, self._end = 0, len(rows)

    def __getstate__(self) -> dict[str, Any]:
        more = {k: v for k, v in self.__dict__.items() if k not in ("_data", "_begin", "_end")}
        return more | {"rows": self.rows.copy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        rows = state.pop("rows")
        self.__dict__.update(state)
        self._data = np.empty((max(256, len(rows)), rows.shape[1]))
        self._data[: len(rows)] = rows
        self._begin, self._end = 0, len(rows)
