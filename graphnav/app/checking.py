"""Checks of a recording beside the first stages of solving, and the loading of the solvers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from graphnav.core.beside import begin_beside
from graphnav.core.findings import Finding
from graphnav.core.memory import pause_collector
from graphnav.core.progress import Progress
from graphnav.recording import Recording

if TYPE_CHECKING:
    from graphnav.recording.plausibility.screening import ScreenedRows


class Checks:
    """All checks of a recording whose rows were screened, begun beside what follows."""

    def __init__(self, recording: Recording, rows: ScreenedRows) -> None:
        self._recording, self.seconds = recording, 0.0  # that were waited for them
        self._work, self._awaited = begin_beside(partial(_check, recording, rows)), False

    def get_findings(self) -> tuple[Finding, ...]:
        """Wait for all findings.

        Raises
        ------
        RecordingError
            If the recording cannot be solved.
        """
        from graphnav.recording.plausibility.screening import refuse

        began = time.perf_counter()
        findings = self._work.get_result()
        self.seconds += time.perf_counter() - began
        self._awaited = True
        refuse(self._recording, findings)
        return findings

    def await_before(self, stage: str, progress: Progress | None) -> Progress:
        """`progress`, and a recording that cannot be solved is refused at this stage at the latest."""

        def listen(now: str, share: float) -> None:
            if now == stage and not self._awaited:
                self.get_findings()
            if progress is not None:
                progress(now, share)

        return listen


def _check(recording: Recording, rows: ScreenedRows) -> tuple[Finding, ...]:
    from graphnav.recording.checks.overview import inspect
    from graphnav.recording.plausibility.screening import screen

    screened = screen(recording, rows)
    if any(one.severity == "refused" for one in screened.findings):
        return screened.findings
    return inspect(recording, screened).findings


def load_solvers(solvers: Sequence[str]) -> None:
    """Import what solvers need, and load what is compiled; it takes as long as reading an hour."""
    with pause_collector():
        import graphnav.estimation.pipeline
        from graphnav.estimation.solvers.disturbance import load_compiled

        if "batch" in solvers:
            import graphnav.estimation.factor_graph.batch  # noqa: F401
        load_compiled()
