"""The outcome of a run, stored beside its results, so that its pages can be drawn again without solving.

`run.npz` holds the arrays and, as JSON, their structure: nested dataclasses of this package by name, and plain values.
Of the IMU it holds the rows that are drawn. States between keyframes are not stored; they are drawn as straight lines.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np

from graphnav.app.workflow import Outcome
from graphnav.config import Settings
from graphnav.core import rotation
from graphnav.core.errors import ConfigError
from graphnav.core.files import check_regular, check_size, exists, parse_json
from graphnav.core.notes import Note
from graphnav.core.rotation import Array
from graphnav.core.state import States, split_covariance
from graphnav.estimation.dense import AtKeyframes
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording, take_rows
from graphnav.report.plots.detections import select_drawn_rows
from graphnav.report.plots.thinning import BINS
from graphnav.sensors import Series, list_sensors

RUN_FILE = "run.npz"
_RUN_FORMAT = "graphnav-run/3"
_ANEW = ("between", "graphs", "own")  # available only by solving again, and classes of a script
_PACKAGE = __name__.partition(".")[0]


@dataclass(frozen=True)
class Straight(AtKeyframes):
    """States between keyframes by linear interpolation, for one piece of a recording."""

    def interpolate_blocks(self, t: Array) -> tuple[States, dict[str, Array]]:
        """States, with covariances (6, M) of position, velocity and attitude each by itself."""
        states, P = self(t)
        return states, split_covariance(P)

    def __call__(self, t: Array) -> tuple[States, Array]:
        """States and covariances at times within it."""
        k = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = ((t - self.t[k]) / (self.t[k + 1] - self.t[k]))[:, None]
        a, b = self.states[k], self.states[k + 1]
        turn = rotation.exp(s * rotation.log(np.swapaxes(a.R_nb, -1, -2) @ b.R_nb))
        p, v, ba, bg = (x + s * (y - x) for x, y in ((a.p, b.p), (a.v, b.v), (a.ba, b.ba), (a.bg, b.bg)))
        P, Q = self.covariance[k], self.covariance[k + 1]
        return States(a.R_nb @ turn, p, v, ba, bg), P + s[:, :, None] * (Q - P)


def write_outcome(outcome: Outcome, provenance: Mapping[str, Any], path: Path) -> None:
    """Store everything of an outcome that its pages show, with the provenance of the run."""
    arrays: list[Array] = []
    outcome = replace(outcome, recording=_thin_recording(outcome.recording))
    plain = json.dumps(
        {"form": _RUN_FORMAT, "outcome": _pack(outcome, arrays), "provenance": _pack(provenance, arrays)}
    )
    text = np.frombuffer(plain.encode(), dtype=np.uint8)
    named: dict[str, Any] = {f"a{k}": a for k, a in enumerate(arrays)}
    np.savez(path, text=text, **named)  # uncompressed: compression takes a second per hour of a drive and saves a third


def read_outcome(path: Path) -> tuple[Outcome, dict[str, Any]]:
    """Read an outcome, with what its pages show of the recording, and the provenance of its run.

    Raises
    ------
    ConfigError
        If there is no such file, or it is none of this version's.
    """
    if not exists(path, ConfigError):
        raise ConfigError(
            f"{path.parent}: holds no {path.name}: not the results of smooth or compare", key="results.none"
        )
    check_regular(path, ConfigError)
    try:
        with ZipFile(path) as packed:
            check_size(path, sum(one.file_size for one in packed.infolist()), ConfigError)
        with np.load(path, allow_pickle=False) as file:
            values = parse_json(file["text"].tobytes().decode())
            arrays = [file[f"a{k}"] for k in range(len(file.files) - 1)]
    except (OSError, ValueError, KeyError, BadZipFile, zlib.error, EOFError, RuntimeError, MemoryError) as error:
        why = "is damaged" if isinstance(error, BadZipFile) else "is none that smooth or compare wrote, or damaged"
        raise ConfigError(f"{path}: {why}; solve again", key="file.unreadable") from None
    if not isinstance(values, dict) or values.get("form") != _RUN_FORMAT:
        raise ConfigError(f"{path}: is of another version of graphnav; solve again", key="results.other_version")
    try:
        outcome, provenance = _unpack(values["outcome"], arrays), _unpack(values["provenance"], arrays)
        names = [name for name in outcome.solutions if name != Path(name).name or name in ("", "..")]
        if names or not isinstance(outcome, Outcome):
            raise TypeError(f"a solver called '{names[0]}'" if names else "no outcome")
        return outcome, dict(provenance)
    except (AttributeError, ImportError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"{path}: is of another version of graphnav ({error}); solve again", key="results.other_version"
        ) from None


def _thin_recording(recording: Recording) -> Recording:
    """The part of a recording that the pages show."""
    imu = recording.imu
    shown = np.zeros(len(imu.t), dtype=bool)
    shown[: 4 * BINS + 1] = True  # enough to determine the period, and more than is drawn without thinning
    shown[select_drawn_rows(imu)] = True
    return replace(recording, imu=take_rows(imu, shown), raw_gnss=None)


def _pack(value: Any, arrays: list[Array]) -> Any:
    """A value as JSON can hold it, with a key that states its type; arrays are appended to the list."""
    if isinstance(value, Note):
        return {"note": [value.key, str(value)]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _pack(value.item(), arrays)
    if isinstance(value, np.ndarray):
        known = next((k for k, one in enumerate(arrays) if one is value), None)  # solvers share detections
        if known is None:
            arrays.append(value)
        return {"array": len(arrays) - 1 if known is None else known}
    if isinstance(value, Settings):
        return {"settings": value.model_dump(mode="json")}
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, Series):
        return {"series": value.sensor.name, "rows": _pack([value.t, value.values], arrays)}
    if isinstance(value, Mapping):
        return {"map": [[_pack(k, arrays), _pack(v, arrays)] for k, v in value.items()]}
    if isinstance(value, tuple | list):
        return {"tuple" if isinstance(value, tuple) else "list": [_pack(one, arrays) for one in value]}
    if not is_dataclass(value):
        raise TypeError(f"{type(value).__name__} cannot be kept")
    kept = {f.name: getattr(value, f.name) for f in fields(value) if f.init and f.name not in _ANEW}
    out = {"class": f"{type(value).__module__}.{type(value).__qualname__}", "of": _pack(kept, arrays)}
    if isinstance(value, Solution):
        out["pieces"] = [[piece.start, piece.end] for piece in value.between]
    return out


def _unpack(value: Any, arrays: list[Array]) -> Any:
    """The inverse of `_pack`."""
    if not isinstance(value, dict):
        return value
    if "note" in value:
        return Note(*value["note"])
    if "array" in value:
        return arrays[value["array"]]
    if "settings" in value:
        return Settings.model_validate(value["settings"])
    if "path" in value:
        return Path(value["path"])
    if "series" in value:
        sensor = list_sensors()[value["series"]]
        t, rows = _unpack(value["rows"], arrays)
        return Series(sensor, t, rows, sensor.figures.model_construct())
    if "map" in value:
        return {_unpack(k, arrays): _unpack(v, arrays) for k, v in value["map"]}
    if "tuple" in value:
        return tuple(_unpack(one, arrays) for one in value["tuple"])
    if "list" in value:
        return [_unpack(one, arrays) for one in value["list"]]
    module, _, name = value["class"].rpartition(".")
    if module.partition(".")[0] != _PACKAGE:
        raise LookupError(f"{value['class']} is not of {_PACKAGE}")
    kind: Any = getattr(import_module(module), name)
    if not (isinstance(kind, type) and hasattr(kind, "__dataclass_fields__")):
        raise LookupError(f"{value['class']} holds no values")
    found = kind(**_unpack(value["of"], arrays))
    if isinstance(found, Solution):
        pieces = [(found.t >= a) & (found.t <= b) for a, b in value["pieces"]]
        straight = tuple(Straight(found.t[p], found.states[p], found.covariance[p]) for p in pieces if p.sum() > 1)
        return replace(found, between=straight)
    return found
