"""Files as bytes, unpacked, compress (.Z) and compressed RINEX (.crx, .21d) by hatanaka; their columns and dates."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.core import files
from graphnav.core.errors import RecordingError
from graphnav.core.notes import Note
from graphnav.core.rotation import Array

_MOST_LINES = 100  # of an epoch of compressed RINEX: a satellite each
_FIRST_DATE, _LAST_DATE = (
    np.array([1980, 1, 1, 0, 0, 0.0]),
    np.array([2099, 12, 31, 24, 59, 61.0]),
)  # of GPS; a leap second


class Unpacked(bytes):
    """The content of a file; `remarks` say where it ends if the compressed file is cut off."""

    remarks: tuple[str, ...] = ()


def unpack_bytes(path: Path) -> Unpacked:
    """The content of a file, unpacked if it is compressed: of a file that is cut off, all whole lines before that.

    Raises
    ------
    RecordingError
        If it cannot be read or unpacked, or is empty.
    """
    with files.open_file(path, text=False, up_to_cut=True) as file:
        data, cut = file.read(), file.cut
    if data[:2] in (b"\x1f\x9d", b"PK", b"BZ") or b"COMPACT RINEX FORMAT" in data[:200]:
        try:
            hatanaka = importlib.import_module("hatanaka")
        except ImportError:
            raise RecordingError(
                f"{path}: compressed RINEX needs the package hatanaka: pip install -e '.[raw]' in the clone",
                key="package.missing",
            ) from None
        whole = data.splitlines(keepends=True) if cut else [data]
        for left in range(_MOST_LINES if cut else 1):  # an epoch that is cut is refused with all before it
            try:
                data = hatanaka.decompress(b"".join(whole[: len(whole) - left]))
                break
            except Exception as error:  # its own exceptions, and those of the decompressors it calls
                if left + 1 == (_MOST_LINES if cut else 1):
                    raise RecordingError(
                        f"{path}: cannot be unpacked ({str(error)[:80]})", key="file.damaged"
                    ) from None
        files.check_size(path, len(data))
    text = b"\0" not in data
    if cut and text:
        data = data[: data.rfind(b"\n") + 1]
    if not data.strip():
        raise RecordingError(f"{path}: is empty", key="file.empty")
    out = Unpacked(data)
    if cut:
        where = f"line {data.count(10)}" if text else f"{len(data)} bytes"
        sentence = f"the compressed file {cut} after {where} unpacked; everything before that is used"
        out.remarks = (Note("raw.cut", f"{path.name}: {sentence}"),)
    return out


def note_cut(name: str, what: str) -> Note:
    """Make the remark on a file that ends within a record."""
    return Note("raw.cut", f"{name}: ends in the middle of a {what}; everything before it is used")


def take_whole_lines(data: Unpacked, name: str, last: bytes = b"") -> tuple[bytes, tuple[str, ...]]:
    """Drop a line that is cut off, as half a number is another number; remarks say so.

    Parameters
    ----------
    last : what is in the last line of a whole file of this kind; if nothing is, a line break ends it.
    """
    if last and last in data.rstrip().rpartition(b"\n")[2]:
        return data, data.remarks
    whole = data[: data.rfind(b"\n") + 1]
    cut = bool(last) or len(whole) < len(data)
    return whole, data.remarks or ((note_cut(name, "record"),) if cut else ())


class Lines:
    """Text as an array of bytes, with the offsets and lengths of its lines."""

    def __init__(self, data: bytes) -> None:
        self.data = np.frombuffer(data, dtype=np.uint8)
        ends = np.flatnonzero(self.data == 10)
        if not len(ends) or ends[-1] != len(data) - 1:
            ends = np.append(ends, len(data))
        self.start = np.concatenate([[0], ends[:-1] + 1])
        last = self.data[np.maximum(ends - 1, 0)]
        self.length = np.maximum(ends - self.start - (last == 13), 0)
        self.whole = bool(data.endswith(b"\n"))  # the last line is not cut

    def __len__(self) -> int:
        return len(self.start)

    def get_text(self, k: int) -> str:
        """Line k."""
        return bytes(self.data[self.start[k] : self.start[k] + self.length[k]]).decode("latin-1")

    def list_first_bytes(self) -> NDArray[np.uint8]:
        """(L,) the first byte of each line, 0 of an empty one."""
        at = np.minimum(self.start, len(self.data) - 1)
        return np.where(self.length > 0, self.data[at], 0).astype(np.uint8)

    def take_block(self, which: NDArray[np.intp], begin: int, end: int) -> NDArray[np.uint8]:
        """(n, end - begin) bytes from column `begin` on of some lines, blanks where a line is shorter."""
        column = np.arange(begin, end)
        at = np.minimum(self.start[which][:, None] + column, len(self.data) - 1)
        return np.where(column < self.length[which][:, None], self.data[at], 32).astype(np.uint8)


def find_moved_points(block: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(n, m) whether the decimal point of a field (n, m, width) is not where most of its column have it.

    In a line with a missing or extra character, fields are parts of two numbers.
    """
    there = block == ord(".")
    at, told = there.argmax(axis=-1), there.any(axis=-1)
    typical = np.array([np.bincount(x[y]).argmax() if y.any() else 0 for x, y in zip(at.T, told.T, strict=True)])
    return np.asarray(told & (at != typical))


def parse_numbers(block: NDArray[np.uint8], width: int) -> Array:
    """(n, m) numbers of n rows of m fields of `width` bytes each; NaN for blanks.

    Raises
    ------
    ValueError
        If a field is no number.
    """
    n, total = block.shape
    if (block == ord("_")).any():  # which Python's float accepts
        raise ValueError
    cells = np.ascontiguousarray(block).view(f"S{width}").reshape(n, total // width)
    blank = np.all(block.reshape(n, -1, width) == 32, axis=-1)
    out = np.full(cells.shape, np.nan)
    if not blank.all():
        out[~blank] = cells[~blank].astype(float)
        if not np.isfinite(out[~blank]).all():
            raise ValueError
    return out


def count_days(fields: Array) -> tuple[NDArray[np.datetime64], NDArray[np.bool_]]:
    """(n,) day numbers of dates (n, 6), year to second, and a mask of plausible ones."""
    with np.errstate(invalid="ignore"):
        good = np.all((fields >= _FIRST_DATE) & (fields <= _LAST_DATE), axis=1)
        good &= np.all(fields[:, :5] == np.floor(fields[:, :5]), axis=1)
    year, month, day = np.where(good[:, None], fields, _FIRST_DATE).astype(int).T[:3]
    months = (year - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1)
    days = months.astype("datetime64[D]") + (day - 1)
    return days, good & (days.astype("datetime64[M]") == months)
