"""Simulated recordings with exact truth: `simulate("li2024", seed=1)`.

A scenario is a function of a seed and a few options; see `list_scenarios()`. All results are labelled as simulated,
also in the recording's name.
"""

from __future__ import annotations

import inspect
import tomllib
from collections.abc import Sequence
from typing import Any

from graphnav.core.complaints import suggest_nearest
from graphnav.core.errors import ConfigError
from graphnav.simulation.result import Simulated
from graphnav.simulation.scenarios import Scenario, list_scenarios

__all__ = ["Scenario", "Simulated", "describe_scenarios", "get_scenario", "list_scenarios", "parse_options", "simulate"]

_LONGEST = 86400.0  # s


def get_scenario(name: str) -> Scenario:
    """The scenario of that name.

    Raises
    ------
    ConfigError
        If there is none.
    """
    known = list_scenarios()
    if name not in known:
        raise ConfigError(f"no scenario '{name}'; {suggest_nearest(name, list(known))}", key="simulation.unknown")
    return known[name]


def simulate(name: str, seed: int = 0, **options: Any) -> Simulated:
    """Run a scenario; the same name, seed and options give the same recording.

    Parameters
    ----------
    name
        Name of the scenario; `graphnav simulate --list` lists them.
    seed
        Seed of all random numbers.
    options
        The scenario's own.

    Returns
    -------
    Simulated
        The recording, the truth at every sample, the stops and the parameters of the simulation.

    Raises
    ------
    ConfigError
        For an unknown scenario or option, or an invalid value of an option.
    """
    one = get_scenario(name)
    known = list_defaults(one)
    for key, value in options.items():
        if key not in known:
            raise ConfigError(
                f"scenario '{name}' has no option '{key}'; {suggest_nearest(key, list(known))}", key="simulation.option"
            )
        if not _fits_default(value, known[key]):
            raise ConfigError(
                f"scenario '{name}': {key} = {value!r} is not of the kind of its default {known[key]!r}",
                key="simulation.value",
            )
    if not options.get("duration", 0.0) <= _LONGEST:
        raise ConfigError(
            f"duration = {options['duration']:g}: must be at most {_LONGEST:g} s, a day", key="simulation.value"
        )
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed {seed}: must be from 0 to {2**32 - 1}", key="simulation.value")
    return one.run(seed, **options)


def list_defaults(one: Scenario) -> dict[str, Any]:
    """A scenario's options and their defaults."""
    return {p.name: p.default for p in inspect.signature(one.run).parameters.values() if p.name != "seed"}


def _fits_default(value: Any, default: Any) -> bool:
    """Whether a value has the type of a default: a number for a number, which True is not."""
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float | int):
        return isinstance(value, float | int) and value == value and abs(value) != float("inf")
    return isinstance(value, type(default))


def parse_options(name: str, settings: Sequence[str]) -> dict[str, Any]:
    """Parse options KEY=VALUE of the command line; values are written as in TOML, text without quotes.

    Raises
    ------
    ConfigError
        If one is not of that form, or its value is no value.
    """
    known = list_defaults(get_scenario(name))
    out: dict[str, Any] = {}
    for setting in settings:
        key, sign, text = (part.strip() for part in setting.partition("="))
        if not sign or not key:
            raise ConfigError(f"--set {setting}: must be KEY=VALUE", key="option.value")
        if isinstance(known.get(key), str):
            out[key] = text.strip('"')
            continue
        try:
            out[key] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            raise ConfigError(f"--set {setting}: '{text}' is not a number, true or false", key="option.value") from None
    return out


def describe_scenarios() -> str:
    """Every scenario with its description and options."""
    lines = []
    for name, one in list_scenarios().items():
        options = ", ".join(f"{key}={str(value).lower()}" for key, value in list_defaults(one).items())
        lines += [f"{name:<9} {one.about}", f"{'':<9}   --set {options}"]
    return "\n".join(lines)
