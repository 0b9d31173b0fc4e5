"""A noise model as JSON, and back, to the last digit: a run can use the noise model of another.

Under the key "noise", in a file of its own or in the summary.json of a run::

    mode                what `noise.mode` was: a walk whose figures are estimated has its own noise densities first
    figures             by variance component: log_factor (natural, of the variance), its sigma, the prior, freedom
    correlation_times   s, by the parameter of a process
    weights             by constraint: t (s) and weight of rows with less information; by imu.gyro and imu.accel: end
                        (s) of intervals between keyframes with more white noise, and 1 over its variance's factor
    tails               by constraint: degrees of freedom of the tails of its rows' errors
    excluded            by constraint: [begin, end] (s) of spans of faulty rows
    rivals              what may be wrong instead, if anything: each with its probability and what is excluded by it
    span_weights        by constraint: [begin, end, weight] of those that are used after all, with less information
    false_stops         [begin, end] (s) of spans that are no stops, whatever the detectors say, if there are any
    spacing             s between the fixes that are used, 0 for all
    remountings         [begin, end] (s) of when the device was turned in its holder, the rotation vector (rad) that
                        turns what it measured after that back, and its sigma, if it was
    stamps              s, offsets of the stamps of positions, velocities and odometer about which rows are linearised
    lever_arm           m, only where the antenna's is not used as stated: value (right, forward, up) and its sigma

    pieces              how many pieces the recording was cut into, the figures being those of the first; for people

Other values beside a figure (the stated one, the one used) are for people. Numbers are written with all digits.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np

from graphnav.config.settings import NoiseSettings
from graphnav.constraints import list_constraints
from graphnav.constraints.gnss import CLOCK_RATE, LEVER_ARM, TIME_OFFSET, VELOCITY_TIME_OFFSET
from graphnav.constraints.odometer import LONGEST_DELAY, ODOMETER_DELAY
from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import ConfigError
from graphnav.core.files import parse_json, read_text
from graphnav.core.notes import format_count
from graphnav.estimation.noise.groups import list_all_processes, list_groups
from graphnav.estimation.noise.model import (
    INTERVALS,
    FreedConstant,
    NoiseModel,
    Remounting,
    Rival,
    RowWeights,
    StampOffsets,
    VarianceComponent,
)
from graphnav.recording.checks.crosschecks import LARGEST_SHIFT

MODES: tuple[str, ...] = get_args(NoiseSettings.model_fields["mode"].annotation)
_LEAST_WEIGHT = 1e-15  # least weight of an interval: zero would mean infinite noise
_PRIOR = tuple(one.name for one in fields(FreedConstant))
_STAMPS = tuple(one.name for one in fields(StampOffsets))
_LARGEST_OFFSET = 2.0 * LARGEST_SHIFT  # s; estimates go on from what is searched
_LARGEST_RATE = 0.1  # s/s; larger clock rates are invalid
_LONGEST_ARM = 100.0  # m
# by the key: parameter, how many numbers, how large they are at most, and what they are
_FREED = {
    "lever_arm": (LEVER_ARM, 3, _LONGEST_ARM, "m: right, forward, up"),
    "time_offset": (TIME_OFFSET, 1, _LARGEST_OFFSET, "s to be added to stamps"),
    "velocity_time_offset": (VELOCITY_TIME_OFFSET, 1, _LARGEST_OFFSET, "s to be added to stamps"),
    "odometer_delay": (ODOMETER_DELAY, 1, LONGEST_DELAY, "s by which readings are late"),
    "clock_rate": (CLOCK_RATE, 1, _LARGEST_RATE, "s/s, of the clocks of IMU and receiver"),
}
_KEYS = (
    "mode", "pieces", "figures", "correlation_times", "weights", "tails", "excluded", "rivals", "span_weights",
    "false_stops", "searched", "remountings", "spacing", "stamps", *_FREED,
)  # fmt: skip
_LEAST_SIGMA = 1e-9  # of what is the most: nothing is better known
_FIGURE_KEYS = {"log_factor": "log_factor", "sigma": "sigma", "prior": "prior", "prior_sigma": "prior_sigma",
           "degrees_of_freedom": "freedom"}  # fmt: skip
_BESIDE = ("variance_factor", "stated", "used", "unit", "correlation_time")
_TINY, _HUGE = -100.0, 100.0  # of a logarithm: e^100 is beyond any sensor's error


def list_noise(noise: NoiseModel, mode: str = "estimated") -> dict[str, Any]:
    """A noise model as plain values, those under the key "noise" of a file.

    Parameters
    ----------
    mode : what `noise.mode` of the settings was.
    """
    rivals = [{"probability": float(x.probability), "excluded": _list_spans(x.excluded)} for x in noise.rivals]
    return {
        "mode": mode,
        "figures": {
            group: {
                "variance_factor": figure.factor,
                **{key: float(getattr(figure, field)) for key, field in _FIGURE_KEYS.items()},
            }
            for group, figure in noise.figures.items()
        },
        "correlation_times": {name: float(time) for name, time in noise.times.items()},
        "weights": {
            name: {"t": some.t.tolist(), "weight": some.weight.tolist()}
            for name, some in noise.weights.items()
            if len(some.t)
        },
        "tails": {name: float(index) for name, index in noise.tails.items()},
        "excluded": _list_spans(noise.excluded),
        "spacing": float(noise.spacing),
        "stamps": {name: float(getattr(noise.stamps, name)) for name in _STAMPS},
        "span_weights": {name: [[*map(float, one)] for one in spans] for name, spans in noise.span_weights.items()},
        **({"false_stops": [[float(a), float(b)] for a, b in noise.false_stops]} if noise.false_stops else {}),
        **({"searched": True} if noise.searched else {}),
        **({"rivals": rivals} if rivals else {}),
        **(
            {"remountings": [[x.begin, x.end, *x.rotation, x.sigma] for x in noise.remountings]}
            if noise.remountings
            else {}
        ),
    } | {
        key: {of: list(getattr(noise.freed[name], of)) for of in _PRIOR}
        for key, (name, *_) in _FREED.items()
        if name in noise.freed
    }


def _list_spans(excluded: Mapping[str, tuple[tuple[float, float], ...]]) -> dict[str, list[list[float]]]:
    return {name: [[float(a), float(b)] for a, b in spans] for name, spans in excluded.items() if spans}


def write_noise(path: str | Path, noise: NoiseModel, mode: str = "estimated") -> Path:
    """Write a noise model as a file that `read_noise` reads.

    Parameters
    ----------
    path
        The file, replaced if it is there.
    noise
        As of `Solution.noise`.
    mode
        What the settings called for, "estimated" or "stated"; kept for `--noise`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OSError
        If it cannot be written.
    """
    path = Path(path)
    path.write_text(json.dumps({"noise": list_noise(noise, mode)}, indent=2) + "\n", encoding="utf-8")
    return path


def read_noise(path: str | Path) -> NoiseModel:
    """The noise model of a file that `write_noise` wrote, or of the summary.json of a run.

    Parameters
    ----------
    path
        The file, JSON.

    Returns
    -------
    NoiseModel
        To be given to `graphnav.run` as `noise`.

    Raises
    ------
    ConfigError
        In one sentence that names the file and the key, if it cannot be read or holds no noise model.
    """
    return read_noise_and_mode(path)[0]


def read_noise_and_mode(path: str | Path) -> tuple[NoiseModel, str]:
    """A noise model, and the `noise.mode` of the settings that it was found with; raises as `read_noise`."""
    path = Path(path)
    what = "name a file that holds a noise model, or the summary.json of a run"
    try:
        values = parse_json(read_text(path, ConfigError))
    except json.JSONDecodeError as error:
        raise ConfigError(
            f"{path}, line {error.lineno}: not valid JSON ({error.msg}); {what}", key="json.syntax"
        ) from None
    except ValueError as error:
        raise ConfigError(f"{path}: not valid JSON ({error}); {what}", key="json.syntax") from None
    if not isinstance(values, Mapping) or not isinstance(values.get("noise"), Mapping):
        raise ConfigError(f"{path}: holds no table 'noise'; {what}", key="noise.no_model")
    return _Reader(path).read_model(values["noise"])


class _Reader:
    """Plain values checked one by one; complaints name the file and the key."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read_model(self, values: Mapping[str, Any]) -> tuple[NoiseModel, str]:
        self.read_names(values, _KEYS, "noise")
        mode = values.get("mode", "estimated")
        if mode not in MODES:
            raise self.make_error("noise.mode", mode, f"must be one of {', '.join(MODES)}")
        constraints = [cls.name for cls in list_constraints()]
        return NoiseModel(
            self.read_each(values, "figures", list_groups(), self.read_figure),
            self.read_each(values, "correlation_times", list_all_processes(), self.read_time),
            self.read_each(values, "weights", [*constraints, *INTERVALS], self.read_weights),
            self.read_each(values, "excluded", constraints, self.read_spans),
            self.read_each(values, "span_weights", constraints, self.read_weighted_spans),
            self.read_number("noise.spacing", values.get("spacing", 0.0), 0.0, 60.0, "s between fixes"),
            StampOffsets(**self.read_each(values, "stamps", _STAMPS, self.read_offset)),
            {name: self.read_constant(key, values) for key, (name, *_) in _FREED.items() if key in values},
            self.read_each(values, "tails", constraints, self.read_tail),
            self.read_spans("noise.false_stops", values.get("false_stops", [])),
            self.read_flag("noise.searched", values.get("searched", False)),
            self.read_rivals("noise.rivals", values.get("rivals", []), constraints),
            self.read_remountings("noise.remountings", values.get("remountings", [])),
        ), mode

    def read_rivals(self, key: str, value: Any, constraints: list[str]) -> tuple[Rival, ...]:
        if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
            raise self.make_error(key, value, "must be a list of tables")
        out = []
        for one in value:
            self.read_names(one, ("probability", "excluded"), key)
            p = self.read_number(f"{key}.probability", one.get("probability"), 0.0, 1.0, "a probability")
            out.append(Rival(p, self.read_each(one, "excluded", constraints, self.read_spans)))
        return tuple(out)

    def read_flag(self, key: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise self.make_error(key, value, "must be true or false")
        return value

    def make_error(self, key: str, value: Any, why: str) -> ConfigError:
        shown = json.dumps(value)
        sentence = f"{self.path}: '{key}' = {shown if len(shown) <= 40 else shown[:37] + '...'}: {why}"
        return ConfigError(sentence, key="key.value")

    def read_names(self, values: Mapping[str, Any], known: Sequence[str], at: str) -> None:
        for name in values:
            if name not in known:
                raise ConfigError(
                    f"{self.path}: unknown key '{at}.{name}'; {suggest_nearest(name, known)}", key="key.unknown"
                )

    def read_each(
        self, values: Mapping[str, Any], key: str, known: Sequence[str], read: Callable[[str, Any], Any]
    ) -> dict[str, Any]:
        table = values.get(key, {})
        if not isinstance(table, Mapping):
            raise self.make_error(f"noise.{key}", table, "must be a table by name")
        self.read_names(table, known, f"noise.{key}")
        return {name: read(f"noise.{key}.{name}", value) for name, value in table.items()}

    def read_number(self, key: str, value: Any, low: float, high: float, what: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.make_error(key, value, f"must be a number: {what}")
        if not low <= value <= high:
            raise self.make_error(key, value, f"must be between {low:g} and {high:g}: {what}")
        return float(value)

    def read_figure(self, key: str, value: Any) -> VarianceComponent:
        if not isinstance(value, Mapping):
            raise self.make_error(key, value, "must be a table with log_factor or variance_factor")
        self.read_names(value, (*_FIGURE_KEYS, *_BESIDE), key)
        what = "the natural logarithm of a variance factor"
        if "log_factor" not in value and "variance_factor" not in value:
            raise ConfigError(
                f"{self.path}: '{key}' has neither log_factor nor variance_factor; give one", key="key.missing"
            )
        given = None
        if "variance_factor" in value:
            given = math.log(
                self.read_number(f"{key}.variance_factor", value["variance_factor"], math.exp(_TINY), math.exp(_HUGE),
                            "on the stated variance")
            )  # fmt: skip
        log = given
        if "log_factor" in value:
            log = self.read_number(f"{key}.log_factor", value["log_factor"], _TINY, _HUGE, what)
            if given is not None and abs(given - log) > 1e-9:
                raise ConfigError(
                    f"{self.path}: '{key}': log_factor and variance_factor disagree; leave one of them out",
                    key="noise.disagree",
                )
        assert log is not None
        return VarianceComponent(
            log,
            self.read_number(f"{key}.sigma", value.get("sigma", 0.0), 0.0, _HUGE, f"1-sigma of {what}"),
            self.read_number(f"{key}.prior", value.get("prior", 0.0), _TINY, _HUGE, f"the prior's median, {what}"),
            self.read_number(f"{key}.prior_sigma", value.get("prior_sigma", 0.0), 0.0, _HUGE, f"1-sigma of {what}"),
            self.read_number(
                f"{key}.degrees_of_freedom", value.get("degrees_of_freedom", 0.0), 0.0, math.inf, "a count"
            ),
        )

    def read_tail(self, key: str, value: Any) -> float:
        return self.read_number(key, value, 0.01, 1e9, "degrees of freedom of the tails of errors")

    def read_time(self, key: str, value: Any) -> float:
        return self.read_number(key, value, 1e-3, 1e9, "s, a correlation time")

    def read_offset(self, key: str, value: Any) -> float:
        if key.endswith(".since"):
            return self.read_number(key, value, -math.inf, math.inf, "s, a stamp")
        if key.endswith(".rate"):
            return self.read_number(key, value, -_LARGEST_RATE, _LARGEST_RATE, "s/s, of the clocks of IMU and receiver")
        return self.read_number(key, value, -_LARGEST_OFFSET, _LARGEST_OFFSET, "s to be added to stamps")

    def read_constant(self, key: str, values: Mapping[str, Any]) -> FreedConstant:
        _, count, most, what = _FREED[key]

        def read_numbers(key: str, value: Any) -> tuple[float, ...]:
            if not isinstance(value, list) or len(value) != count:
                raise self.make_error(key, value, f"must be a list of {format_count(count, 'number')}, {what}")
            low = _LEAST_SIGMA * most if key.endswith("sigma") else -most
            return tuple(self.read_number(key, x, low, most, what) for x in value)

        found = self.read_each(values, key, _PRIOR, read_numbers)
        missing = next((name for name in _PRIOR if name not in found), None)
        if missing:
            raise ConfigError(f"{self.path}: 'noise.{key}' has no {missing}; give it", key="key.missing")
        return FreedConstant(**found)

    def read_weights(self, key: str, value: Any) -> RowWeights:
        if not isinstance(value, Mapping) or set(value) != {"t", "weight"}:
            raise self.make_error(key, value, "must be a table with the lists t and weight")
        lists = {}
        least = _LEAST_WEIGHT if key.endswith(INTERVALS) else 0.0
        for name, what, low, high in (("t", "s", -math.inf, math.inf), ("weight", "of information", least, 1.0)):
            some = value[name]
            if not isinstance(some, list):
                raise self.make_error(f"{key}.{name}", some, "must be a list of numbers")
            lists[name] = np.array([self.read_number(f"{key}.{name}", x, low, high, what) for x in some], dtype=float)
        t, weight = lists["t"], lists["weight"]
        if len(t) != len(weight):
            raise ConfigError(
                f"{self.path}: '{key}' has {len(t)} times and {len(weight)} weights; give one for each",
                key="noise.lengths",
            )
        if np.any(np.diff(t) < 0.0):
            raise ConfigError(
                f"{self.path}: '{key}.t' is not ascending; sort its rows by time", key="noise.not_ascending"
            )
        return RowWeights(t, weight)

    def read_spans(self, key: str, value: Any) -> tuple[tuple[float, float], ...]:
        return self._read_spans(key, value, "[begin, end], s", 2)

    def read_remountings(self, key: str, value: Any) -> tuple[Remounting, ...]:
        found = self._read_spans(key, value, "[begin, end, right, forward, up, sigma], s and rad", 6)
        return tuple(Remounting(begin, end, tuple(turn), sigma) for begin, end, *turn, sigma in found)

    def read_weighted_spans(self, key: str, value: Any) -> tuple[tuple[float, float, float], ...]:
        found = self._read_spans(key, value, "[begin, end, weight], s and of information", 3)
        for _, _, weight in found:
            self.read_number(key, weight, 0.0, 1.0, "of information")
        return found

    def _read_spans(self, key: str, value: Any, each: str, count: int) -> tuple[Any, ...]:
        if not isinstance(value, list):
            raise self.make_error(key, value, f"must be a list of {each}")
        out = []
        for one in value:
            if not isinstance(one, list) or len(one) != count:
                raise self.make_error(key, one, f"must be {each}")
            numbers = tuple(self.read_number(key, x, -math.inf, math.inf, "s") for x in one)
            if numbers[1] < numbers[0]:
                raise self.make_error(key, one, "ends before it begins")
            out.append(numbers)
        return tuple(out)
