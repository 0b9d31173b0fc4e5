"""Checks of a recording, beside the loading of the solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import is_dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from graphnav.core.beside import Beside, Done, begin_beside
from graphnav.core.findings import Finding
from graphnav.core.memory import pause_collector
from graphnav.recording import Recording

if TYPE_CHECKING:
    from graphnav.recording.plausibility.screening import Screened

    Checked = tuple[Screened, tuple[Finding, ...]]


def begin_checks(recording: Recording) -> Beside[Checked] | Done[Checked]:
    """Begin to screen and check a recording: what `screen` makes of it, and all findings."""
    return begin_beside(partial(_check, recording), _list_parts(recording))


def _check(recording: Recording) -> tuple[Screened, tuple[Finding, ...]]:
    from graphnav.recording.checks.overview import inspect
    from graphnav.recording.plausibility.screening import screen

    screened = screen(recording)
    return screened, inspect(recording, screened).findings


def _list_parts(recording: Recording) -> list[object]:
    """Sensors and their arrays, of which most are sound and stay as they are."""
    sensors = [one for one in vars(recording).values() if is_dataclass(one)]
    return [*sensors, *(value for one in sensors for value in vars(one).values() if isinstance(value, np.ndarray))]


def load_solvers(solvers: Sequence[str]) -> None:
    """Import what solvers need, and load what is compiled; it takes as long as the checks."""
    with pause_collector():
        import graphnav.estimation.pipeline
        from graphnav.estimation.solvers.recursion import load_compiled

        if "batch" in solvers:
            import graphnav.estimation.factor_graph.batch  # noqa: F401
        load_compiled()
