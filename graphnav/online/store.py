"""Files of an online run, so that nothing that has settled is lost however the run ends.

    trajectory.csv    grows as keyframes settle, by whole rows, each time flushed to disk (fsync)
    checkpoint        the smoother as it was at most a minute ago, and how far the source was read; replaced in one step
    trajectory-2.csv  the same after the IMU's clock was set back, when times repeat
    journal-N         of a live source: the lines taken in since that checkpoint

To resume, trajectory.csv is cut to the length in the checkpoint and continued from there: the same rows in
the same order make the same trajectory.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
from collections import deque
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, BinaryIO

from graphnav.core.errors import ConfigError, GraphnavError
from graphnav.core.trajectory import Trajectory
from graphnav.online.lines import LineUnits
from graphnav.online.steady import Online
from graphnav.recording.exporters import csv

TRAJECTORY, CHECKPOINT, SUMMARY = "trajectory.csv", "checkpoint", "summary.json"
_MAGIC = b"graphnav checkpoint 16\n"
_DIGEST = hashlib.sha256

_PLAIN = {
    "array": ("_array_reconstructor", "array"),
    "builtins": ("complex", "frozenset", "range", "set", "slice"),
    "collections": ("Counter", "OrderedDict", "deque"),
    "numpy": ("dtype", "ndarray"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.numeric": ("_frombuffer",),
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy.core.numeric": ("_frombuffer",),
    "pathlib": ("Path", "PosixPath", "PurePosixPath", "WindowsPath"),
}
# these open files when they are created
_ACTING = {("graphnav.online.store", "Store"), ("graphnav.online.session", "Session")}


@dataclass(frozen=True)
class Checkpoint:
    """A smoother and its progress."""

    online: Online
    source: str  # the source of the rows
    counts: dict[str, int]  # numbers of rows processed, rows settled, and invalid lines
    length: int  # bytes of trajectory.csv
    journal: int  # number of the journal with the lines since
    done: bool  # end of the input was reached
    piece: int = 1  # number of the clock that the times are of
    units: LineUnits | None = None  # of the lines of a live source


class Store:
    """The folder of a run.

    Raises
    ------
    ConfigError
        If the folder holds a run and is not to be resumed, or the other way round.
    """

    def __init__(self, folder: Path, source: str, resume: bool, live: bool) -> None:
        self.folder, self.source, self.live = folder, source, live
        self.pending: deque[bytes] = deque()  # lines in the journal that have not been processed
        self._journal: FileIO | None = None
        self._number, self.piece = 0, 1
        self.units: LineUnits | None = None  # of the lines of a live source, once it has described its sensors
        path = folder / CHECKPOINT
        self.resumed: Checkpoint | None = None
        if resume:
            if not path.exists():
                raise ConfigError(f"--resume: {folder} holds no checkpoint to continue from", key="checkpoint.none")
            self.resumed = _read_checkpoint(path)
            if self.resumed.source != source:
                raise ConfigError(
                    f"--resume: {folder} was made from '{self.resumed.source}', not from '{source}'",
                    key="checkpoint.other_source",
                )
            self._length, self.units = self.resumed.length, self.resumed.units
            self._number, self.piece = self.resumed.journal, self.resumed.piece
        elif path.exists():
            raise ConfigError(
                f"-o {folder}: holds a run already; go on with --resume or name another folder", key="output.holds_run"
            )
        folder.mkdir(parents=True, exist_ok=True)
        for other in folder.glob("trajectory-*.csv"):  # later than the checkpoint, or of an earlier run
            if self.resumed is None or _read_number(other) > self.piece:
                other.unlink()
        for other in folder.glob("journal-*"):
            if self.resumed is None or _read_number(other) != self._number:
                other.unlink()
        path = self.trajectory
        if self.resumed is None:
            self._file = self._make_file()
        else:
            self._file = path.open("r+b" if path.exists() else "w+b", buffering=0)
            if self._file.seek(0, os.SEEK_END) < self._length:
                raise ConfigError(
                    f"--resume: {path} is shorter than its checkpoint states", key="checkpoint.journal_short"
                )
            self._file.truncate(self._length)
            self._file.seek(self._length)

    @property
    def trajectory(self) -> Path:
        """The growing trajectory file."""
        return self.folder / (TRAJECTORY if self.piece == 1 else f"trajectory-{self.piece}.csv")

    def begin_piece(self, number: int) -> None:
        """Continue in another file."""
        self._file.close()
        self.piece = number
        self._file = self._make_file()

    def _make_file(self) -> FileIO:
        """The trajectory file with nothing but its header."""
        head = (csv.HEADER + "\n").encode()
        self._length = 0
        self._file = self.trajectory.open("w+b", buffering=0)
        self._guard(lambda: self._file.write(head))
        self._length = len(head)
        return self._file

    def recall(self) -> None:
        """Make the complete lines that arrived after the resumed checkpoint pending again."""
        path = self._name_journal(self._number)
        if not path.exists():
            return
        whole, _, torn = path.read_bytes().rpartition(b"\n")
        if torn:
            with path.open("r+b") as file:
                file.truncate(path.stat().st_size - len(torn))
        self.pending.extend(whole.split(b"\n") if whole else [])

    def note(self, lines: list[bytes]) -> None:
        """Write lines of a live source to the journal before they are processed."""
        if self._journal is None:
            self._journal = self._name_journal(self._number).open("ab", buffering=0)
        journal = self._journal
        self._guard(lambda: journal.write(b"".join(line + b"\n" for line in lines)))
        self.pending.extend(lines)

    def append(self, tracks: list[Trajectory]) -> None:
        """Append settled rows."""
        rows = "".join(csv.format_trajectory(track) for track in tracks).encode()

        def write() -> None:
            done = 0
            while done < len(rows):
                done += self._file.write(rows[done:]) or 0
            os.fsync(self._file.fileno())

        self._guard(write)
        self._length += len(rows)

    def write_checkpoint(self, online: Online, counts: dict[str, int], done: bool = False) -> None:
        """Write a checkpoint of the smoother; lines of the journal before it are no longer needed."""
        number = self._number + 1
        now = Checkpoint(online, self.source, counts, self._length, number, done, self.piece, self.units)
        path, fresh = self.folder / CHECKPOINT, self.folder / (CHECKPOINT + ".new")

        def write() -> None:
            if self.pending:
                self._name_journal(number).write_bytes(b"".join(line + b"\n" for line in self.pending))
            with fresh.open("wb") as file:
                file.write(_MAGIC + bytes(_DIGEST().digest_size))
                body = _Digested(file)
                pickle.dump(now, body, protocol=5)
                file.seek(len(_MAGIC))
                file.write(body.digest.digest())
                file.flush()
                os.fsync(file.fileno())
            os.replace(fresh, path)
            _sync(self.folder)

        self._guard(write)
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        self._name_journal(self._number).unlink(missing_ok=True)
        self._number = number

    def summarise(self, text: str) -> None:
        """Write the summary at the end."""
        self._guard(lambda: (self.folder / SUMMARY).write_text(text, encoding="utf-8"))

    def close(self) -> None:
        """Close: nothing more will be written."""
        self._file.close()
        if self._journal is not None:
            self._journal.close()

    def _name_journal(self, number: int) -> Path:
        return self.folder / f"journal-{number:06d}"

    def _guard(self, write: Any) -> None:
        """Write; if that fails, the file on disk stays complete and the reason is one sentence."""
        try:
            write()
        except OSError as error:
            for mend in (lambda: self._file.truncate(self._length), lambda: self._file.seek(self._length)):
                with contextlib.suppress(OSError):
                    mend()
            started = (self.folder / CHECKPOINT).exists()
            how = (
                "what had settled is safe; remove the cause and continue with --resume"
                if started
                else "remove the cause and start again"
            )
            raise GraphnavError(
                f"{self.folder}: cannot be written ({error.strerror}); {how}", key="output.cannot_write"
            ) from None


class _Digested:
    """A file that is hashed while it is written, so that a checkpoint is never in memory as a whole."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.digest = file, _DIGEST()

    def write(self, data: bytes) -> int:
        self.digest.update(data)
        return self._file.write(data)


def _read_checkpoint(path: Path) -> Checkpoint:
    found = None
    with path.open("rb") as file:
        magic, told = file.read(len(_MAGIC)), file.read(_DIGEST().digest_size)
        start = file.tell()
        if magic == _MAGIC and hashlib.file_digest(file, _DIGEST).digest() == told:
            file.seek(start)
            try:
                found = _Unpickler(file).load()
            except Exception:  # whatever a forged pickle causes
                found = None
    if not isinstance(found, Checkpoint):
        raise ConfigError(f"--resume: {path} is no checkpoint of this version, or damaged", key="checkpoint.damaged")
    return found


class _Unpickler(pickle.Unpickler):
    """Creates graphnav's own objects and arrays only, and calls nothing else, whoever wrote the file."""

    def find_class(self, module: str, name: str) -> Any:
        if module.startswith("graphnav.") and "." not in name and (module, name) not in _ACTING:
            found = super().find_class(module, name)
            if isinstance(found, type) and found.__module__ == module:
                return found
        elif name in _PLAIN.get(module, ()):
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name}")


def _read_number(path: Path) -> int:
    number = path.stem.partition("-")[2]
    return int(number) if number.isdigit() else 0


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
