"""Declaration of a sensor: one object that all code for reading, cutting, checking, streaming and writing uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import create_model

from graphnav.core.errors import RecordingError
from graphnav.core.rotation import Array
from graphnav.sensors.tables import SensorTable, TimeUnit, TomlTable


@dataclass(frozen=True)
class Column:
    """One column of a sensor's file.

    `units` are those that files may use, each with its size in SI; the first is the default, which recordings are
    written in. A value outside `lowest` to `highest` (SI) is treated as missing.
    """

    name: str
    units: Mapping[str, float]
    lowest: float
    highest: float


@dataclass(frozen=True)
class Sensor:
    """A sensor beside IMU, GNSS and odometer: each row is a time and some numbers.

    `needs` are sets of columns; a row must be complete in one of them, other columns are optional. `figures` are the
    keys of its table in recording.toml beside the common ones. With `keyframes`, a state is placed at each row.
    """

    name: str
    about: str  # one sentence
    columns: tuple[Column, ...]
    needs: tuple[tuple[str, ...], ...]
    figures: type[TomlTable] = TomlTable
    keyframes: bool = False

    def __post_init__(self) -> None:
        names = {c.name for c in self.columns}
        if not self.name.isidentifier():
            raise RecordingError(
                f"sensor '{self.name}': its name is to be one word of letters, digits and _", key="sensor.name"
            )
        if not self.needs or not all(set(some) <= names for some in self.needs):
            raise RecordingError(f"sensor '{self.name}': needs names columns that it does not have", key="sensor.needs")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, without t."""
        return tuple(c.name for c in self.columns)

    @cached_property
    def table(self) -> type[SensorTable]:
        """The model of its table in recording.toml."""
        make: Any = create_model  # whose fields are not known statically
        kinds: dict[str, Any] = {c.name: (Literal[tuple(c.units)], next(iter(c.units))) for c in self.columns}
        units = make(f"{self.name}_units", __base__=TomlTable, t=(TimeUnit, "s"), **kinds)
        bases = (SensorTable,) if self.figures is TomlTable else (self.figures, SensorTable)
        made = make(f"{self.name}_table", __base__=bases, units=(units, units()))
        made.required, made.optional = ("t",), self.names
        return made  # type: ignore[no-any-return]

    def __getstate__(self) -> dict[str, Any]:
        """What is stored: not the model, which is made of the rest."""
        return {name: value for name, value in self.__dict__.items() if name != "table"}

    def mask_usable(self, values: Array) -> NDArray[np.bool_]:
        """(N,) whether rows (N, k) are complete in one of the sets of columns that `needs` lists."""
        there, out = np.isfinite(values), np.zeros(len(values), dtype=bool)
        for some in self.needs:
            out |= there[:, [self.names.index(name) for name in some]].all(axis=1)
        return out

    def mask_outside_bounds(self, values: Array) -> Array:
        """Rows (N, k) with NaN in place of values outside the bounds."""
        lowest, highest = np.array([(c.lowest, c.highest) for c in self.columns]).T
        with np.errstate(invalid="ignore"):
            return np.where((values >= lowest) & (values <= highest), values, np.nan)

    def make_series(self, t: Array, columns: Mapping[str, Array], **figures: Any) -> Series:
        """Make a series of arrays, as a script does.

        Parameters
        ----------
        t : (N,) s, ascending.
        columns : (N,) each, in SI; NaN where a row has none.
        figures : keys of its table in recording.toml, such as ``sigma=0.3``.

        Raises
        ------
        RecordingError
            For columns it does not have, of another length, or times that do not ascend.
        """
        t = np.asarray(t, dtype=float)
        for name, values in columns.items():
            if name not in self.names:
                raise RecordingError(
                    f"{self.name}: no column '{name}'; known: {', '.join(self.names)}", key="sensor.column"
                )
            if np.shape(values) != t.shape:
                raise RecordingError(f"{self.name}: column '{name}' has not the length of t", key="sensor.lengths")
        if np.any(np.diff(t) <= 0.0):
            raise RecordingError(f"{self.name}: t does not ascend", key="sensor.not_ascending")
        absent = np.full(len(t), np.nan)
        values = np.stack([np.asarray(columns.get(name, absent), dtype=float) for name in self.names], -1)
        return Series(self, t, values, self.figures(**figures))


@dataclass(frozen=True)
class Series:
    """The rows of one sensor: numbers in SI, NaN where a row has none."""

    sensor: Sensor
    t: Array  # (N,) s, strictly increasing
    values: Array  # (N, k), in the order of the sensor's columns
    figures: Any = field(default_factory=TomlTable)  # a `Sensor.figures`

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, column: str) -> Array:
        """(N,) values of one column."""
        return np.asarray(self.values[:, self.sensor.names.index(column)])

    def get_sigma(self, column: str, otherwise: float) -> Array:
        """(N,) 1-sigma from the column ``sd_...``, `otherwise` where a row states none."""
        stated = self[f"sd_{column}"]
        return np.where(np.isfinite(stated), stated, otherwise)
