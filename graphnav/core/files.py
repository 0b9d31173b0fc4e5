"""Opening files within limits: regular files only, bounded in unpacked size and in line length.

Anything wrong with a file (a pipe or device, damaged compression, more bytes than allowed) is raised as one sentence in
the error class that the caller names. The limits are the environment variables `GRAPHNAV_MAX_FILE_MB` and
`GRAPHNAV_MAX_LINE_KB`; SECURITY.md states their defaults.

Files named inside other files are read only from the folder of the naming file or below, unless `allow_outside`
(`graphnav.core.complaints.resolve_beside`).
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import math
import os
import stat
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

from graphnav.core.errors import ConfigError, GraphnavError, RecordingError

MAX_FILE, MAX_LINE = "GRAPHNAV_MAX_FILE_MB", "GRAPHNAV_MAX_LINE_KB"
_DEFAULTS = {MAX_FILE: 2000, MAX_LINE: 1000}
_NOTHING = {
    "na",
    "n/a",
    "#n/a",
    "null",
    "none",
    "nil",
    "-",
    "--",
    "nan(ind)",
    "1.#ind",
    "1.#qnan",
    "1.#snan",
    "nan(snan)",
}
_WRITTEN = 64 << 20  # bytes at most of a file that is read as a whole: settings, descriptions, summaries
_RATIO, _SMALL = 200, 8 << 20  # the size check of a packed log matters only beyond this many bytes
_READ_SIZE = 1 << 16
_GZIP = b"\x1f\x8b"
ZIP, ARCHIVE = b"PK\3\4", "is a zip archive or a spreadsheet; unpack it, or save it as CSV"

Kind = type[GraphnavError]


def is_inside(path: Path, folder: Path, error: Kind = RecordingError) -> bool:
    """Whether a path lies in a folder or below it, symbolic links followed."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # too long, a null character, or a loop of links
        raise error(f"{shorten_path(path)}: is no path of a file", key="file.name") from None


def check_inside(files: Iterable[Path], source: Path) -> None:
    """Refuse files of a folder that are links to somewhere outside it.

    Raises
    ------
    RecordingError
        Naming the first.
    """
    folder = source if source.is_dir() else source.parent
    for file in files:
        if file.is_symlink() and not is_inside(file, folder):
            raise RecordingError(
                f"{file}: is a link to outside of {folder}; use --allow-outside if you trust who made it",
                key="file.outside",
            )


def exists(path: Path, error: Kind = RecordingError) -> bool:
    """Check whether a path exists.

    Raises
    ------
    GraphnavError
        Of the kind given, if it is no path of a file.
    """
    try:
        return path.exists()
    except (OSError, ValueError) as cause:
        raise error(
            f"{shorten_path(path)}: {getattr(cause, 'strerror', None) or 'is no path of a file'}", key="file.name"
        ) from None


def check_regular(path: Path, error: Kind = RecordingError) -> None:
    """Refuse pipes, devices, sockets and folders: only regular files have an end.

    Raises
    ------
    GraphnavError
        Of the kind given.
    """
    try:
        mode = os.stat(path).st_mode
    except OSError as cause:
        raise error(f"{shorten_path(path)}: cannot be read ({cause.strerror})", key="file.unreadable") from None
    except ValueError:
        raise error(f"{shorten_path(path)}: is no path of a file", key="file.name") from None
    if stat.S_ISDIR(mode):
        raise error(f"{path}: cannot be read (it is a folder)", key="file.folder")
    if not stat.S_ISREG(mode):
        raise error(
            f"{path}: cannot be read (it is a pipe or a device, not a file); write it to a file first", key="file.pipe"
        )


def open_file(
    path: Path, error: Kind = RecordingError, text: bool = True, limit: int | None = None, up_to_cut: bool = False
) -> Opened:
    """Open a file for reading bytes, unpacked if it is gzip-compressed; reading raises only `error`.

    Parameters
    ----------
    text : whether lines longer than the limit are refused.
    limit : bytes that it may hold unpacked; None: what `GRAPHNAV_MAX_FILE_MB` says.
    up_to_cut : whether a compressed file that is cut off, or goes on with something else, ends there, and says so,
        instead of being refused.
    """
    check_regular(path, error)
    most = _read_limit(MAX_FILE, 10**6) if limit is None else limit
    try:
        plain = path.open("rb")
        size = os.fstat(plain.fileno()).st_size
        magic = plain.read(2)
        plain.seek(0)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror})", key="file.unreadable") from None
    line = _read_limit(MAX_LINE, 1000) if text else None
    return Opened(_Bounded(path, plain, magic == _GZIP, size, most, line, error, up_to_cut), size, magic == _GZIP)


def read_bytes(path: Path, error: Kind = RecordingError, text: bool = True, limit: int | None = None) -> bytes:
    """All bytes of a file, as `open_file` reads them."""
    with open_file(path, error, text, limit) as file:
        return file.read()


def check_size(path: Path, count: int, error: Kind = RecordingError) -> None:
    """Refuse more bytes than a file may hold when another program has unpacked it.

    Raises
    ------
    GraphnavError
        Of the kind given.
    """
    if count > (most := _read_limit(MAX_FILE, 10**6)):
        raise error(_refuse_size(path, most, packed=True), key="file.large")


def read_text(path: Path, error: Kind = RecordingError) -> str:
    """The text of a file that is read as a whole: settings, a description.

    Raises
    ------
    GraphnavError
        Of the kind given, if it cannot be read, is larger than any of its kind, or is not UTF-8.
    """
    try:
        return read_bytes(path, error, text=False, limit=_WRITTEN).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: is not UTF-8 text; save it as UTF-8", key="file.text") from None


def parse_json(text: str) -> Any:
    """Parse JSON; everything that is wrong with it is a ValueError in a few words."""
    try:
        values = json.loads(text, parse_int=_parse_whole)
    except RecursionError:
        raise ValueError("nested too deep") from None
    return values


def is_blank(cell: str) -> bool:
    """Whether a cell of a table is empty, or holds one of the words that programs write for nothing."""
    return not cell or not _NOTHING.isdisjoint((cell.lower(), cell.lower().lstrip("+-")))


def parse_number(text: str) -> float:
    """Parse a number in ASCII digits, as C does; `float` would also take 1_000 and the digits of any script.

    Raises
    ------
    ValueError
        If it is none.
    """
    if "_" in text or not text.isascii():
        raise ValueError("not a number")
    return float(text)


def _parse_whole(digits: str) -> int:
    if len(digits) > 20:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _read_limit(name: str, unit: int) -> int:
    """A limit in bytes, from the environment or its default."""
    stated = os.environ.get(name, "")
    if not stated:
        return _DEFAULTS[name] * unit
    try:
        value = float(stated)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ConfigError(f"{name} = {stated!r}: must be a number above 0", key="environment.value")
    return int(value * unit)


def _refuse_size(path: Path, most: int, packed: bool) -> str:
    return f"{path}: holds more than {most / 1e6:g} MB{' unpacked' if packed else ''}; if that is right, set {MAX_FILE}"


def shorten_path(path: Path) -> str:
    """A path as it is quoted in a sentence, of at most 200 characters."""
    text = str(path)
    return text if len(text) <= 200 else f"{text[:100]}...{text[-40:]}"


class Opened(io.BufferedReader):
    """The bytes of a file, unpacked; `size` is that on disk, `packed` whether it is gzip-compressed."""

    def __init__(self, raw: _Bounded, size: int, packed: bool) -> None:
        super().__init__(raw, 4 * _READ_SIZE)
        self.size, self.packed, self._bounded = size, packed, raw

    @property
    def cut(self) -> str:
        """Why it has ended before or other than the compressed file should; empty where it has not."""
        return self._bounded.cut


class _Bounded(io.RawIOBase):
    """A stream that raises one sentence where the file exceeds a limit or is damaged."""

    def __init__(
        self,
        path: Path,
        plain: IO[bytes],
        packed: bool,
        size: int,
        most: int,
        line: int | None,
        error: Kind,
        up_to_cut: bool,
    ) -> None:
        self.cut, self._up_to_cut = "", up_to_cut
        self.path, self.error, self._plain = path, error, plain
        self._source: Any = gzip.GzipFile(fileobj=plain, mode="rb") if packed else plain
        self._size, self._most, self._longest, self._packed = size, most, line, packed
        self._count = self._run = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            chunk = self._source.read1(min(len(buffer), _READ_SIZE))  # `read` would lose what is before a cut
        except (EOFError, zlib.error, gzip.BadGzipFile) as cause:
            cut = isinstance(cause, EOFError)
            other = isinstance(cause, gzip.BadGzipFile) and str(cause).startswith("Not a gzipped file")
            if (cut or other) and self._up_to_cut and self._count:  # what is before has been checked, or cannot be
                self.cut = "is cut off" if cut else "goes on with something else"
                return 0
            why = "the compressed file is cut off" if cut else f"the compressed file is damaged ({cause})"
            raise self.error(f"{self.path}: {why}; copy it again", key="file.damaged") from None
        except OSError as cause:
            raise self.error(f"{self.path}: cannot be read ({cause.strerror})", key="file.unreadable") from None
        self._count += len(chunk)
        if self._count > self._most:
            raise self.error(_refuse_size(self.path, self._most, self._packed), key="file.large")
        if self._packed and self._count > _SMALL and self._count > _RATIO * self._size and not os.environ.get(MAX_FILE):
            raise self.error(
                f"{self.path}: unpacks to more than {_RATIO} times its size, which no log does; if that is right, "
                f"unpack it, or set {MAX_FILE}",
                key="file.unpacks",
            )
        if self._longest is not None:
            self._check_line(chunk)
        buffer[: len(chunk)] = chunk
        return len(chunk)

    def _check_line(self, chunk: bytes) -> None:
        last = max(chunk.rfind(b"\n"), chunk.rfind(b"\r"))
        self._run = self._run + len(chunk) if last < 0 else len(chunk) - last - 1
        if self._longest is not None and self._run > self._longest:
            raise self.error(
                f"{self.path}: has a line of more than {self._longest / 1000:g} kB, which no table has; if that is "
                f"right, set {MAX_LINE}",
                key="file.line_long",
            )

    def close(self) -> None:
        if not self.closed:
            self._source.close()
            self._plain.close()
        super().close()


def hash_file(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
