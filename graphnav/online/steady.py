"""A smoother that continues whatever arrives: a clock that is set back, fixes elsewhere, a piece that fails."""

from __future__ import annotations

import traceback
from pathlib import Path

from graphnav.config import Settings, parse_settings
from graphnav.core.notes import Note, format_count, get_key
from graphnav.online.checks import check_counts
from graphnav.online.sensors import Row
from graphnav.online.smoother import Smoother
from graphnav.recording import Recording

_REPORTED_AFTER = 512  # rows after which unusable sensors are reported
_MOST_FAILURES = 100  # failures kept in memory


class Online(Smoother):
    """Smooths during the drive.

    Parameters
    ----------
    setup : a recording without rows (`graphnav.online.without_rows`): platform, noise figures, lever arms.
    settings : as for a recording; `solver.lag` is the span of later measurements that a settled state includes.
    engine : the smoother, "window" or "isam2"; `solver.engine` of the settings when None.
    """

    def __init__(self, setup: Recording, settings: Settings | None = None, engine: str | None = None) -> None:
        settings = settings or Settings()
        if engine is not None:
            settings = parse_settings(
                settings.model_dump() | {"solver": settings.solver.model_dump() | {"engine": engine}}
            )
        super().__init__(setup, settings)
        self.clocks = 1  # number of pieces; the times of each are independent
        self._rows = 0  # settled trajectories that were returned
        self.failures: list[str] = []  # reasons why pieces were abandoned

    def add(self, row: Row, released: bool = False) -> None:
        """Process one row.

        Parameters
        ----------
        row : sensor, time (s) and numbers, as `Fix`, `ImuSample`, `WheelSpeed` and `Reading` make them.
        released : whether it was held back before, until the IMU's clock was known.

        Raises
        ------
        RecordingError
            If it is no row of a known sensor with as many numbers as that has; nothing is done with it then.
        """
        sensors, rows = self.sensors, [(row, released)]
        sensors.check_form(row)
        if row[0] == "gnss" and not released:
            sensors.gnss.arrivals.add(row[1], row[2])
        self._rows += 1
        if self._rows >= _REPORTED_AFTER and not self._rows & (self._rows - 1):  # at powers of two
            self._tell_counts()
        while rows:
            try:
                super().add(*rows.pop(0))
            except Exception as error:  # no failure may end the session
                self._give_up(error)
            if sensors.set_back:
                rows += [(one, False) for one in self._go_back()]
            elif sensors.moved is not None:
                self._go_elsewhere(*sensors.moved)
            if sensors.released:
                rows += [(one, True) for one in sensors.released]
                sensors.released = []

    def finish(self) -> None:
        """End of the input: settle everything."""
        self.sensors.release()
        held, self.sensors.released = self.sensors.released, []
        for row in held:
            self.add(row, released=True)
        try:
            super().finish()
        except Exception as error:
            self._give_up(error)
        self._tell_counts()

    def explain_start(self) -> str:
        """Tell why nothing has settled yet.

        Returns
        -------
        str
            The newest reason among the notes.
        """
        why = [note for note in self.notes if get_key(note) in ("online.not_aligned", "online.failed")]
        return why[-1] if why else "too few rows to align with"

    def _tell_counts(self) -> None:
        """Note what the rows left out so far say of the sensors."""
        self._replace_notes("counts", check_counts(self.sensors.counts))
        self._take_findings(self.findings)

    def _restart(self, before: float, why: str) -> None:
        super()._restart(before, why)
        self._tell_counts()

    def _give_up(self, error: Exception) -> None:
        """Drop the piece that is being smoothed, and start anew with the next rows."""
        now = self.sensors.imu.newest
        at = traceback.extract_tb(error.__traceback__)[-1]
        failure = f"at {now:.3f} s: {type(error).__name__}: {error} in {Path(at.filename).name}:{at.lineno}"
        self.failures = [*self.failures[-_MOST_FAILURES:], failure]
        since = self._last_settled
        self.notes.append(
            Note(
                "online.failed",
                f"at {now:.3f} s the smoother failed ({type(error).__name__}); unsettled states"
                f"{f' since {since:.3f} s' if since > -1e300 else ''} are lost: aligning anew",
            )
        )
        self.tracker = None
        self._begin_anew(now)

    def _go_back(self) -> list[Row]:
        """End the piece of the old clock; returns the rows of the new one, which are to be processed."""
        sensors = self.sensors
        rows, sensors.set_back = sensors.set_back, []
        sensors.gnss.forget_arrivals()  # of the clock before
        first = next(t for sensor, t, _ in rows if sensor == "imu")
        before = sensors.imu.newest
        self.notes.append(
            Note(
                "online.clock_back",
                f"the clock of the IMU was set back from {before:.3f} to {first:.3f} s: aligning anew",
            )
        )
        self.finish()  # no more rows of the old clock will arrive
        self._faults = self.excluded
        self.clocks += 1
        self._begin_anew(float("-inf"))
        sensors.forget_time()
        self.late.clear()
        self._last_settled = float("-inf")
        return rows

    def _go_elsewhere(self, since: float, count: int) -> None:
        """End the piece whose fixes are out of reach of those that by now outnumber them."""
        sensors = self.sensors
        sensors.moved = None
        if self.tracker is None:
            return
        now = sensors.imu.newest
        try:
            self._restart(now, f"since {since:.3f} s out of reach of all before: {format_count(count, 'fix', 'fixes')}")
        except Exception as error:
            self._give_up(error)
        self.frame = None
