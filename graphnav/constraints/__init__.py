"""One file per constraint; every concrete `Constraint` in this folder is found automatically."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Sequence
from functools import cache

from graphnav.constraints.base import Constraint
from graphnav.core.errors import ConfigError
from graphnav.recording import Recording


@cache
def list_constraints() -> tuple[type[Constraint], ...]:
    """All constraint classes, sorted by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        for member in vars(importlib.import_module(f"{__name__}.{module.name}")).values():
            if isinstance(member, type) and issubclass(member, Constraint) and not inspect.isabstract(member):
                found[member.name] = member
    return tuple(found[name] for name in sorted(found))


def list_kinds(recording: Recording) -> tuple[type[Constraint], ...]:
    """The constraint classes for a recording: graphnav's own and those that a script adds."""
    return (*list_constraints(), *recording.own.constraints)


def check_own(kinds: Sequence[type[Constraint]]) -> tuple[type[Constraint], ...]:
    """Check the constraints of a script and sort them by name.

    Raises
    ------
    ConfigError
        If one is no complete constraint, or has a name that is taken.
    """
    taken = {kind.name for kind in list_constraints()}
    for kind in kinds:
        if not (isinstance(kind, type) and issubclass(kind, Constraint)):
            raise ConfigError(
                f"constraints: {kind!r} is no class derived from graphnav.constraints.base.Constraint", key="class.kind"
            )
        what = f"constraints: {kind.__name__}"
        missing = [name for name in ("name", "axes", "unit") if not hasattr(kind, name)]
        missing += sorted(kind.__abstractmethods__)
        if kind.linearize is Constraint.linearize and kind.residual is Constraint.residual:
            missing.append("residual (or linearize)")
        if kind.watched and kind.compute_typical_error is Constraint.compute_typical_error:
            missing.append("compute_typical_error (it is watched)")
        if missing:
            raise ConfigError(f"{what} lacks {', '.join(missing)}", key="class.incomplete")
        if kind.name in taken:
            raise ConfigError(
                f"{what}: there is a constraint '{kind.name}' already; choose another name", key="class.name_taken"
            )
        taken.add(kind.name)
    return tuple(sorted(kinds, key=lambda kind: kind.name))
