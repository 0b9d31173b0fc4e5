"""One file per constraint; every concrete `Constraint` in this folder is found by itself."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from functools import cache

from graphnav.constraints.base import Constraint


@cache
def list_constraints() -> tuple[type[Constraint], ...]:
    """All constraint classes, in the order of their names."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        for member in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            if isinstance(member, type) and issubclass(member, Constraint) and not inspect.isabstract(member):
                found[member.name] = member
    return tuple(found[name] for name in sorted(found))
