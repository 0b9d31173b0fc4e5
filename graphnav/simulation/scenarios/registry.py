"""Registration of scenarios."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from graphnav.simulation.result import Simulated


@dataclass(frozen=True)
class Scenario:
    """`run` takes a seed and keyword options, each with a default, and returns the simulated drive."""

    name: str
    about: str  # one sentence
    run: Callable[..., Simulated]
