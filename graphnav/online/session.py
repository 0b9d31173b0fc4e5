"""An online run from a source to a folder: rows in, settled rows and checkpoints out."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from graphnav.config import Settings
from graphnav.core.errors import ConfigError, RecordingError
from graphnav.core.notes import get_key
from graphnav.core.trajectory import Trajectory
from graphnav.online.lines import END, LineUnits, parse_row, read_setup
from graphnav.online.replay import drop_rows, list_rows
from graphnav.online.sensors import Row
from graphnav.online.start import let_clocks_drift
from graphnav.online.steady import Online
from graphnav.online.store import Store
from graphnav.recording import Recording

CHECKPOINTS = 60.0  # s of IMU time between checkpoints, each of tens of MB: the time that a resumed run has to redo
_REPORTED_LINES = 5  # invalid lines that are reported


class Session:
    """A run that can be ended at any time and resumed.

    Parameters
    ----------
    folder : where it writes; None to keep nothing.
    source : what the rows come from, remembered to tell a wrong --resume.
    recording : replayed, or None where lines come from a live source.
    """

    def __init__(
        self,
        settings: Settings,
        source: str,
        folder: Path | None = None,
        resume: bool = False,
        recording: Recording | None = None,
    ) -> None:
        self.settings, self.folder = settings, folder
        self.store = None if folder is None else Store(folder, source, resume, live=recording is None)
        self.online: Online | None = None
        self.units: LineUnits | None = None if self.store is None else self.store.units
        self.taken = self.bad = self.rows_settled = 0
        self.done = False
        self.complaints: list[str] = []
        self._kept = float("-inf")
        self.rows: list[Row] = list_rows(recording)[1] if recording is not None else []
        resumed = self.store.resumed if self.store is not None else None
        if resumed is not None:
            self.online, self.done = resumed.online, resumed.done
            self.settings = self._require_same(settings)
            self.taken, self.rows_settled, self.bad = (resumed.counts[k] for k in ("taken", "settled", "bad"))
            self._kept = self.online.sensors.imu.newest
        elif recording is not None:
            self._begin(Online(drop_rows(recording), settings))
        if self.store is not None and resumed is not None and recording is None:
            self.store.recall()
            self._take_pending(self.store)

    def _require_same(self, stated: Settings) -> Settings:
        """The settings that a resumed run goes on with: those it was made with.

        Raises
        ------
        ConfigError
            If others are stated; the default ones state nothing.
        """
        assert self.online is not None
        made = self.online.settings
        for table, theirs in let_clocks_drift(stated).model_dump().items():
            ours, default = (one.model_dump()[table] for one in (made, let_clocks_drift(Settings())))
            if theirs not in (ours, default):
                raise ConfigError(
                    f"--resume: {self.folder} was made with other settings of [{table}]; leave them out to go on with "
                    "its own, or name another folder",
                    key="checkpoint.other_settings",
                )
        return made

    def add(self, row: Row) -> None:
        """Process one row."""
        assert self.online is not None
        self.online.add(row)
        self.taken += 1
        self._save()

    def add_lines(self, lines: list[str], asked: Callable[[], bool] = bool) -> None:
        """Process lines of a live source; they are in the journal before they count.

        Once `asked` to end, the rest stays there.
        """
        if self.store is None:
            for line in lines:
                self._take_line(line)
        elif lines:
            self.store.note([line.encode() for line in lines])
            self._take_pending(self.store, asked)

    def finish(self) -> None:
        """End of the input: settle everything and write the summary."""
        if self.online is None:
            return
        if not self.done:
            self.online.finish()
            self.done = True
            self._save(last=True)
        if self.store is not None:  # again where a finished run is resumed: its summary may have been missing
            self.store.summarise(json.dumps(self.summarise(), indent=2) + "\n")

    def require_result(self) -> None:
        """Refuse a finished run that has no result, or one of rows that are refused of a recording.

        Raises
        ------
        RecordingError
            Saying why.
        """
        if self.rows_settled:
            for finding in self.online.findings if self.online is not None else ():
                if finding.severity == "refused":
                    raise RecordingError(f"what has settled is wrong: {finding.sentence}", key=finding.key)
            return
        if self.online is None:
            raise RecordingError("the source ended before the line that describes its sensors", key="online.no_setup")
        counts, why = self.online.sensors.counts, self.online.explain_start()
        if not counts["imu"]:
            odd = [f"{n} {key}" for key, n in counts.items() if key.startswith("imu:")]
            why = "; ".join(["no row of the IMU was taken in", *odd, *self.complaints[:1]])
        raise RecordingError(f"nothing could be smoothed: {why}", key="online.nothing")

    def list_doubts(self) -> list[str]:
        """Reasons why what has settled cannot be trusted."""
        if self.online is None:
            return []
        found = [f"unreliable: {f.sentence}" for f in self.online.findings if f.severity == "unreliable"]
        return found + [f"warning: {n}" for n in self.online.notes if get_key(n).startswith("doubt.")]

    def stop(self) -> None:
        """End before the source does: write a checkpoint."""
        if self.store is not None and self.online is not None and not self.done:
            self.store.write_checkpoint(self.online, self._list_counts())

    def close(self) -> None:
        """Close the files."""
        if self.store is not None:
            self.store.close()

    def summarise(self) -> dict[str, object]:
        """Counts of rows, and notes."""
        assert self.online is not None
        online = self.online
        more: dict[str, object] = {}
        if online.tracker is not None and online.tracker.epochs:  # of the last piece
            tracker = online.tracker
            more["ambiguities"] = {"epochs": tracker.epochs, "fixed": tracker.fixed}
        return more | {
            "source": "online",
            "settled": self.rows_settled,
            "rows": dict(+online.sensors.counts),
            "late_and_used": dict(online.late),
            "bad_lines": self.bad,
            "clocks": online.clocks,
            "failures": online.failures,
            "first_bad_lines": self.complaints,
            "excluded": [
                {"kind": f.kind, "from_s": f.t_start, "to_s": f.t_end, "count": f.count} for f in online.excluded
            ],
            "findings": [finding.to_dict() for finding in online.findings],
            "notes": online.notes,
            "messages": [{"key": get_key(note), "sentence": note} for note in online.notes],
            "lag_s": self.settings.solver.lag,
        }

    def _begin_piece(self, store: Store, online: Online, tracks: list[Trajectory]) -> None:
        """Begin a new file: the settled states so far are of an earlier clock."""
        self.rows_settled += sum(len(track) for track in tracks)
        if tracks:
            store.append(tracks)
        store.begin_piece(online.clocks)
        store.write_checkpoint(online, self._list_counts())
        self._kept = online.sensors.imu.newest

    def _take_pending(self, store: Store, asked: Callable[[], bool] = bool) -> None:
        while store.pending and not asked():
            self._take_line(store.pending.popleft().decode("utf-8", "replace"))

    def _list_counts(self) -> dict[str, int]:
        return {"taken": self.taken, "settled": self.rows_settled, "bad": self.bad}

    def _begin(self, online: Online) -> None:
        self.online = online
        if self.store is not None:
            self.store.write_checkpoint(online, self._list_counts())

    def _take_line(self, line: str) -> None:
        if self.online is None:
            if line.strip() and not line.startswith("#"):
                setup, self.units = read_setup(line)
                if self.store is not None:
                    self.store.units = self.units
                self._begin(Online(setup, self.settings))
            return
        if line.strip() == END:
            self.finish()
            return
        if self.done or line.startswith("graphnav-online/"):
            return  # a sender that restarts
        try:
            row = parse_row(line, self.units)
        except ValueError as error:
            self.bad += 1
            if len(self.complaints) < _REPORTED_LINES:
                self.complaints.append(str(error))
            return
        if row is not None:
            self.add(row)

    def _save(self, last: bool = False) -> None:
        assert self.online is not None
        tracks = self.online.settled()
        if self.store is not None and self.online.clocks > self.store.piece:
            self._begin_piece(self.store, self.online, tracks)
            return
        self.rows_settled += sum(len(track) for track in tracks)
        if self.store is None:
            return
        newest = self.online.sensors.imu.newest
        if tracks:
            self.store.append(tracks)
        if last or newest - self._kept > CHECKPOINTS:  # rows settled since are cut off and computed again on resume
            self.store.write_checkpoint(self.online, self._list_counts(), self.done)
            self._kept = newest
