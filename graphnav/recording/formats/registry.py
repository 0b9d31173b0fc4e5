"""Registration of log formats: the module of a format in this package defines one `FORMAT`.

A log need not contain every sensor: it is read into a `Log`, and becomes a recording by itself, or with others through
the ``file`` keys of a recording.toml.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from graphnav.core.errors import RecordingError
from graphnav.core.files import check_regular, exists
from graphnav.core.notes import Note, format_count
from graphnav.recording import Gnss, Imu, Odometer, Recording, Truth, take_rows
from graphnav.sensors import Series


@dataclass(frozen=True)
class Log:
    """The contents of a log, with the fields of a `Recording`; missing sensors are None."""

    name: str
    imu: Imu | None = None
    gnss: Gnss | None = None
    odometer: Odometer | None = None
    truth: Truth | None = None
    platform: str = "vehicle"
    gps_zero: float | None = None  # s since the GPS epoch at t = 0 of the log, where it is known
    mount_known: bool = True  # whether the IMU's axes are by definition those of the vehicle
    files: tuple[Path, ...] = ()
    remarks: tuple[str, ...] = ()  # notes on assumptions
    sensors: Mapping[str, Series] = field(default_factory=dict)  # other sensors, by name
    topics: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # sensor -> topic used, then the alternatives

    def make_recording(self, source: str | Path) -> Recording:
        """The log as a recording.

        Raises
        ------
        RecordingError
            If it holds no IMU.
        """
        if self.imu is None:
            held = [name for name in ("gnss", "odometer", "truth") if getattr(self, name) is not None]
            raise RecordingError(
                f"{source}: holds no IMU, only {' and '.join(held)}; 'graphnav init IMU-LOG {Path(source).name}' "
                "drafts a recording.toml that joins both",
                key="log.no_imu",
            )
        return Recording(
            self.name, self.platform, self.imu, self.gnss, self.odometer, self.truth,
            Path(source), self.files, self.gps_zero, self.remarks, sensors=self.sensors,
        )  # fmt: skip


@dataclass(frozen=True)
class Format:
    """A format in which a recording, or a part of one, is stored.

    `recognises` must be fast and must not raise; `read` and `load` raise RecordingError for anything they cannot use.
    Both are also told whether files that the source names may lie outside its folder.
    """

    name: str
    about: str  # one sentence
    recognises: Callable[[str | Path], bool]
    read: Callable[[str | Path, bool], Recording]
    builtin: bool = False  # a name that is always available, such as "kitti", rather than a path
    load: Callable[[str | Path, bool], Log] | None = None  # for logs of other programs
    # `load` with named topics, for logs that have topics
    choose: Callable[[str | Path, Sequence[str]], Log] | None = None


def log_format(
    name: str,
    about: str,
    recognises: Callable[[Path], bool],
    load: Callable[[Path, bool], Log],
    choose: Callable[[Path, Sequence[str]], Log] | None = None,
) -> Format:
    """Make the `Format` of another program's log; parameters as of `Format`."""

    def can_read(source: str | Path) -> bool:
        try:
            return recognises(Path(source))
        except (OSError, RecordingError):
            return False

    def check_and_load(source: str | Path, load_path: Callable[[Path], Log]) -> Log:
        path = Path(source)
        if not exists(path):
            raise RecordingError(f"{path}: no such file or folder", key="file.missing")
        if not path.is_dir():
            check_regular(path)
        from graphnav.recording.formats.soundness import drop_unsound_rows  # which imports this module

        log = load_path(path)
        return replace(_drop_nowhere(drop_unsound_rows(log, path)), files=log.files or _list_files(path))

    def load_log(source: str | Path, allow_outside: bool) -> Log:
        return check_and_load(source, lambda path: load(path, allow_outside))

    def read_log(source: str | Path, allow_outside: bool) -> Recording:
        return load_log(source, allow_outside).make_recording(source)

    def load_topics(source: str | Path, topics: Sequence[str]) -> Log:
        assert choose is not None
        return check_and_load(source, lambda path: choose(path, topics))

    return Format(name, about, can_read, read_log, load=load_log, choose=None if choose is None else load_topics)


def _drop_nowhere(log: Log) -> Log:
    """The log without fixes at latitude and longitude 0, which receivers write when they have none."""
    gnss = log.gnss
    if gnss is None or not (nowhere := (gnss.llh[:, :2] == 0.0).all(axis=1)).any() or nowhere.all():
        return log
    many = format_count(nowhere.sum(), "fix", "fixes")
    return replace(
        log,
        gnss=take_rows(gnss, ~nowhere),
        remarks=(*log.remarks, Note("gnss.nowhere", f"{many} at 0, 0 (no fix) left out")),
    )


def _list_files(path: Path) -> tuple[Path, ...]:
    """The file itself, or the files of a folder."""
    return tuple(sorted(file for file in path.iterdir() if file.is_file())) if path.is_dir() else (path,)


def read_first_bytes(path: Path, count: int = 4096) -> bytes:
    """The beginning of a file; empty for a folder or an unreadable file."""
    if not path.is_file():
        return b""
    with path.open("rb") as file:
        return file.read(count)
