"""Requirements on the numbers of a result, such as ``h_rms<0.5``, for scripts that stop when one is not met."""

from __future__ import annotations

import difflib
import operator
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from graphnav.core.errors import ConfigError
from graphnav.evaluation.metrics import COMPONENTS

_REQUIREMENT = re.compile(r"(?:([\w-]+):)?\s*([A-Za-z]\w*)\s*(<=|>=|<|>)\s*(\S+)")
_COMPARE = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}
_SPAN_FIELDS = ("start_s", "end_s", "n", "distance_m", "end_h_m", "end_3d_m", "max_h_m", "max_up_m", "drift_mps",
         "drift_percent", "nees_p")  # fmt: skip
_UNIT_SUFFIXES = ("_m", "_mps", "_deg", "_s")  # suffixes that may be omitted


def list_names() -> tuple[str, ...]:
    """All numbers that can be required; those of spans begin with ``span_`` (every span) or ``span2_`` (the second)."""
    errors = [
        f"{key}_{what}_{unit}" for key, (_, unit, _) in COMPONENTS.items() for what in ("rms", "p95", "max", "mean")
    ]
    nees = [f"nees_{key}{what}" for key in ("p", "e", "n", "up", "v", "rph") for what in ("", "_inside_95")]
    closure = [f"closure_{what}" for what in ("h_m", "up_m", "distance_m", "percent")]
    own = ["n", "epochs", "duration_s", "distance_m", "sd_h_median_m", "sd_u_median_m", "sd_heading_median_deg",
           "keyframes", "iterations", "final_cost", "run_time_s"]  # fmt: skip
    return (*errors, *nees, *closure, *own, *(f"span_{name}" for name in _SPAN_FIELDS))


@dataclass(frozen=True)
class Requirement:
    """A number and its limit, for one solver or for all that run."""

    text: str  # as given
    name: str  # full name, of `list_names`, or span2_... for the second span
    sign: str  # <, <=, > or >=
    limit: float
    solver: str | None = None


@dataclass(frozen=True)
class Verdict:
    """Whether one solver meets a requirement; an unknown number meets none."""

    requirement: Requirement
    solver: str
    value: float | None

    @property
    def met(self) -> bool:
        """Whether the requirement is met."""
        return self.value is not None and bool(_COMPARE[self.requirement.sign](self.value, self.requirement.limit))

    @property
    def sentence(self) -> str:
        """The verdict as a sentence."""
        shown = "not known" if self.value is None else f"{self.value:g}"
        return f"{self.solver} has {self.requirement.name} {shown}, required {self.requirement.text}"


def parse_requirement(text: str, solvers: Sequence[str] = ()) -> Requirement:
    """Parse ``h_rms<0.5``, ``span_max_h<=1``, or ``batch:nees_p<2`` for one of the `solvers`.

    Raises
    ------
    ConfigError
        If it is not of that form, or names no number or no solver that there is, with the nearest that are.
    """
    found = _REQUIREMENT.fullmatch(text.strip())
    usage = "write NAME<NUMBER, such as h_rms<0.5, with <, <=, > or >="
    if found is None:
        raise ConfigError(f"--require {text}: {usage}", key="option.requirement")
    solver, name, sign, number = found.groups()
    if solver is not None and solver not in solvers:
        raise ConfigError(
            f"--require {text}: no solver '{solver}' runs; there are {', '.join(solvers) or 'none'}",
            key="option.requirement",
        )
    try:
        limit = float(number)
    except ValueError:
        raise ConfigError(f"--require {text}: '{number}' is not a number; {usage}", key="option.requirement") from None
    return Requirement(text, _complete_name(name, text), sign, limit, solver)


def _complete_name(name: str, text: str) -> str:
    """The name with its unit, and with the number of its span if it has one."""
    every = list_names()
    short = {full.removesuffix(unit): full for unit in _UNIT_SUFFIXES for full in every if full.endswith(unit)}
    known = {**short, **{full: full for full in every}}
    span = re.match(r"span(\d+)_", name)
    plain = re.sub(r"^span\d+_", "span_", name)
    if plain not in known:
        close = difflib.get_close_matches(plain, list(known), n=3, cutoff=0.5)
        hint = (
            f"did you mean {' or '.join(close)}?" if close else "known are h_rms, h_max, up_rms, nees_p, span_max_h ..."
        )
        raise ConfigError(f"--require {text}: no number is called '{name}'; {hint}", key="option.requirement")
    return known[plain].replace("span_", f"span{span[1]}_", 1) if span else known[plain]


def judge_all(requirements: Sequence[Requirement], rows: Sequence[Mapping[str, Any]]) -> list[Verdict]:
    """The verdicts on rows of numbers, one row per solver, as `metrics.tabulate` makes them."""
    verdicts = []
    for requirement in requirements:
        for row in rows:
            solver = str(row["solver"])
            if requirement.solver not in (None, solver):
                continue
            keys = [requirement.name]
            if requirement.name.startswith("span_"):
                keys = [key for key in row if re.sub(r"^span\d+_", "span_", key) == requirement.name] or keys
            verdicts += [Verdict(requirement, solver, row.get(key)) for key in keys]
    return verdicts


def format_verdicts(verdicts: Sequence[Verdict]) -> str:
    """The verdicts as lines of text; "" if there are none."""
    lines = [f"  {'met' if verdict.met else 'not met'}: {verdict.sentence}" for verdict in verdicts]
    return "\n".join(["\n", "required", *lines]) if lines else ""


def list_verdicts(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """The verdicts for JSON."""
    return [
        {"require": v.requirement.text, "solver": v.solver, "name": v.requirement.name, "value": v.value, "met": v.met}
        for v in verdicts
    ]
