"""Files as bytes, unpacked: gzip by Python, compress (.Z) and compressed RINEX (.crx, .21d) by hatanaka."""

from __future__ import annotations

import gzip
import importlib
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from graphnav.errors import RecordingError
from graphnav.rotation import Array


def read_bytes(path: Path) -> bytes:
    """The content of a file, whatever it is packed with.

    Raises
    ------
    RecordingError
        If it cannot be read or unpacked, or is empty.
    """
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except EOFError:
        raise RecordingError(f"{path}: the compressed file is cut off; copy it again") from None
    except (OSError, zlib.error) as error:
        raise RecordingError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    if data[:2] in (b"\x1f\x9d", b"PK", b"BZ") or b"COMPACT RINEX FORMAT" in data[:200]:
        try:
            hatanaka = importlib.import_module("hatanaka")
        except ImportError:
            raise RecordingError(
                f"{path}: compressed RINEX needs the package hatanaka: pip install -e '.[raw]' in the clone"
            ) from None
        try:
            data = hatanaka.decompress(data)
        except Exception as error:  # its own kinds, and those of the packers it calls
            raise RecordingError(f"{path}: cannot be unpacked ({str(error).splitlines()[0][:80]})") from None
    if not data.strip():
        raise RecordingError(f"{path}: is empty")
    return data


class Lines:
    """Text as an array of bytes, with where its lines begin and how long they are."""

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

    def text(self, k: int) -> str:
        """Line k."""
        return bytes(self.data[self.start[k] : self.start[k] + self.length[k]]).decode("latin-1")

    def first(self) -> NDArray[np.uint8]:
        """(L,) the first byte of each line, 0 of an empty one."""
        at = np.minimum(self.start, len(self.data) - 1)
        return np.where(self.length > 0, self.data[at], 0).astype(np.uint8)

    def block(self, which: NDArray[np.intp], begin: int, end: int) -> NDArray[np.uint8]:
        """(n, end - begin) bytes from column `begin` on of some lines, blanks where a line is shorter."""
        column = np.arange(begin, end)
        at = np.minimum(self.start[which][:, None] + column, len(self.data) - 1)
        return np.where(column < self.length[which][:, None], self.data[at], 32).astype(np.uint8)


def numbers(block: NDArray[np.uint8], width: int) -> Array:
    """(n, m) numbers of n rows of m fields of `width` bytes each; NaN for blanks.

    Raises
    ------
    ValueError
        If a field is no number.
    """
    n, total = block.shape
    cells = np.ascontiguousarray(block).view(f"S{width}").reshape(n, total // width)
    blank = np.all(block.reshape(n, -1, width) == 32, axis=-1)
    out = np.full(cells.shape, np.nan)
    if not blank.all():
        out[~blank] = cells[~blank].astype(float)
    return out
