"""Values that several functions derive from one object, computed once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self, TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class Shared:
    """An object that keeps what functions of it have returned: a base class for frozen dataclasses."""

    _returned: dict[Callable[..., Any], Any] = field(
        default_factory=dict, init=False, repr=False, compare=False, kw_only=True
    )

    def share(self, make: Callable[[Self], T]) -> T:
        """``make(self)``, computed once for all callers; `make` must be a function of this object and nothing else."""
        if make not in self._returned:
            self._returned[make] = make(self)
        found: T = self._returned[make]
        return found
