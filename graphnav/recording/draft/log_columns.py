"""The columns of one sensor of a log, on their way to the units of a recording."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from graphnav.core.rotation import Array
from graphnav.recording.draft.plain import Plain, add_words
from graphnav.recording.formats.table import Selection, Table


@dataclass(eq=False)
class LogColumns:
    """What each step of a conversion changes."""

    table: Table  # the columns by our names
    names: dict[str, str]  # our name -> the file's, ours where a column was converted
    units: dict[str, str]  # our name -> the unit that the file's name states
    plain: Plain | None  # notes, where the file is to be written anew

    @property
    def values(self) -> dict[str, Array]:
        """The columns (N,) by our names."""
        return self.table.columns

    def take(self, rows: Selection) -> None:
        """Keep some of the rows."""
        self.table = self.table.take(rows)

    def change(self, name: str, values: Array) -> None:
        """Set a column (N,)."""
        self.table = self.table.with_column(name, values)

    def convert(self, name: str, values: Array) -> None:
        """Set a column (N,) that is no longer as it is in the file."""
        self.change(name, values)
        self.names[name] = name

    def forget_units(self, names: Collection[str]) -> None:
        """Columns that are no longer in the units that the file's names state."""
        self.units = {ours: unit for ours, unit in self.units.items() if ours not in names}

    def drop(self, *names: str) -> None:
        """Leave out columns."""
        self.names = {ours: theirs for ours, theirs in self.names.items() if ours not in names}
        self.table = self.table.drop(*names)

    def say(self, words: str) -> None:
        """Note what was done."""
        self.plain = add_words(self.plain, words)
