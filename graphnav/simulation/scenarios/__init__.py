"""The scenarios, found automatically: a module here defines `SCENARIOS`, a list of `Scenario`."""

from __future__ import annotations

import importlib
import pkgutil

from graphnav.simulation.scenarios.registry import Scenario

__all__ = ["Scenario", "list_scenarios"]


def list_scenarios() -> dict[str, Scenario]:
    """Every scenario by name."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    found = [one for m in modules for one in getattr(m, "SCENARIOS", ())]
    return {one.name: one for one in sorted(found, key=lambda one: one.name)}
