"""Tables as text with the digits that C's ``%.kf`` and ``%.6g`` give, whole columns at a time.

Several times quicker than one cell after the other. Each cell is put into a few bytes of fixed width, out of tables of
three or four digits; bytes that stay zero are taken out at the end. A number is split into its whole part and the rest,
which is exact, and only the rest times a power of ten is rounded: where that product lies so close to a half that its
own rounding could decide, or is not finite, the cell is written by ``%``. The text is the same to the byte.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from graphnav.core.rotation import Array

_BLOCK = 4096  # rows handled at once: keeps the working arrays in the processor's cache
_AT_ONCE = 256  # of which are put together at once
_HALF = 0.5 - 2.0**-12  # further from a whole number than this is left to %; products here are off by 2^-16 at most
_FIELD = re.compile(r"%(?:\.(\d+)(f|g)|d)")
_MOST_PLACES = 11  # for which 10^k 2^-53 is far below that margin
_MOST_WHOLE = 1e15
_REACH = 3  # bytes that a word may reach beyond its cell
_TENS = 10.0 ** np.arange(23)  # exact


def rows_text(table: Array, row_format: str) -> str:
    """The rows of `table` (K, n) through one ``%`` format with n places, a line each; NaN becomes blank."""
    return rows_bytes(table, row_format).decode("ascii")


def rows_bytes(table: Array, row_format: str) -> bytes:
    """The same in ASCII."""
    table = np.asarray(table, dtype=float)
    blocks = (table[k : k + _BLOCK] for k in range(0, len(table), _BLOCK))
    return b"".join(_block(block, row_format + "\n") for block in blocks)


def _block(rows: Array, form: str) -> bytes:
    """A few rows."""
    fields = list(_FIELD.finditer(form))
    assert len(fields) == rows.shape[1], "a format of other columns"
    ends = [0, *(one.end() for one in fields)]
    between = [form[a : one.start()].encode("ascii") for a, one in zip(ends, fields, strict=False)]
    cells: list[_Cell] = []
    for k, one in enumerate(fields):
        cell = _cell(rows[:, k], one[2], int(one[1] or 0))
        if cell is None:
            return _plainly(rows, form)
        cells.append(cell)
    for k, cell in enumerate(cells):
        for row in np.flatnonzero(cell.doubtful):
            text = (fields[k][0] % rows[row, k]).encode()
            if len(text) > cell.width:
                return _plainly(rows, form)
            cell.by_hand[int(row)] = np.frombuffer(text.ljust(cell.width, b"\0"), np.uint8)
    tail = form[ends[-1] :].encode("ascii")
    parts = (slice(a, a + _AT_ONCE) for a in range(0, len(rows), _AT_ONCE))
    return b"".join(_put_together(cells, between, tail, part, len(rows)) for part in parts)


def _put_together(cells: list[_Cell], between: list[bytes], tail: bytes, part: slice, n: int) -> bytes:
    """The text of some of n rows: few enough that their bytes stay in the processor's cache."""
    rows = range(n)[part]
    width = sum(cell.width for cell in cells) + sum(map(len, between)) + len(tail) + _REACH
    out = np.zeros((len(rows), width), np.uint8)
    at = 0
    for text, cell in zip(between, cells, strict=True):
        if text:
            out[:, at : at + len(text)] = np.frombuffer(text, np.uint8)
            at += len(text)
        for offset, word in cell.words:
            np.ndarray((len(rows),), word.dtype, out, at + offset, (width,))[:] = word[part]
        for row, one in cell.by_hand.items():
            if row in rows:
                out[row - rows.start, at : at + cell.width] = one
        at += cell.width
    out[:, at:] = np.frombuffer(tail + b"\0" * _REACH, np.uint8)
    return out.tobytes().translate(None, b"\0")


def _plainly(rows: Array, form: str) -> bytes:
    text = form * len(rows) % tuple(rows.ravel().tolist())
    return (text.replace("nan", "") if np.isnan(rows).any() else text).encode("ascii")


@dataclass(frozen=True)
class _Cell:
    """A column as words at offsets in `width` bytes, from left to right; what reaches over is written over."""

    width: int
    words: list[tuple[int, Array]]
    doubtful: Array  # (n,) not settled
    by_hand: dict[int, Array] = field(default_factory=dict)  # those, as bytes


def _cell(x: Array, kind: str | None, places: int) -> _Cell | None:
    """A column in a format; None where that is not one of those known here."""
    if (places != 6) if kind == "g" else (places > _MOST_PLACES):
        return None
    # %d knows no negative zero
    cell = _general(x) if kind == "g" else _format_fixed(x if kind else np.trunc(x) + 0.0, places)
    blank = np.isnan(x)
    if not blank.any():
        return cell
    words = [(offset, np.where(blank, word.dtype.type(0), word)) for offset, word in cell.words]
    return _Cell(cell.width, words, cell.doubtful & ~blank)


def _format_fixed(x: Array, places: int) -> _Cell:
    """``%.kf``."""
    size = np.abs(x)
    with np.errstate(invalid="ignore"):
        doubtful = ~(size < _MOST_WHOLE)
    size[doubtful] = 0.0
    floor = np.floor(size)
    scaled = (size - floor) * _TENS[places]
    rounded = np.rint(scaled)
    doubtful |= np.abs(scaled - rounded) > _HALF
    up = rounded >= _TENS[places]
    whole = (floor + up).astype(np.int64)
    words: list[tuple[int, Array]] = [(0, np.signbit(x) * np.uint8(ord("-")))]
    groups = -(-len(str(int(whole.max(initial=0)))) // 4)
    higher = np.zeros_like(whole)
    for k in range(groups):
        now = whole // 10 ** (4 * (groups - 1 - k)) if k < groups - 1 else whole
        first = 20_000 if k < groups - 1 else 0
        words.append((1 + 4 * k, _fours().take(now - 10_000 * higher + np.where(higher > 0, 10_000, first))))
        higher = now
    begin = 1 + 4 * groups
    if places:
        part = np.where(up, 0.0, rounded).astype(np.int64)
        words.append((begin, np.full(len(x), ord("."), np.uint8)))
        begin += 1
        behind = -(-places // 4)
        part *= 10 ** (4 * behind - places)
        before = np.zeros_like(part)
        for k in range(behind):
            now = part // 10 ** (4 * (behind - 1 - k)) if k < behind - 1 else part
            words.append((begin + 4 * k, _fours().take(now - 10_000 * before + 10_000)))
            before = now
    return _Cell(begin + places, words, doubtful)


def _general(x: Array) -> _Cell:
    """``%.6g``."""
    size = np.abs(x)
    with np.errstate(invalid="ignore"):
        doubtful = ~((size > 1e-16) & (size < 1e5))
    size[doubtful] = 1.0
    exponent = np.floor(np.log10(size)).astype(np.int64)
    scaled = size * _TENS[5 - exponent]
    digits = np.rint(scaled)
    doubtful |= (np.abs(scaled - digits) > _HALF) | (scaled < 99_999.5) | (digits > 1_000_000)
    up = digits >= 1_000_000
    exponent += up
    number = np.clip(np.where(up, 100_000, digits), 100_000, 999_999).astype(np.int64)
    high = number // 1000
    low = number - 1000 * high
    small = exponent < -4
    # digits before the point; 0 where the point stands in what is written before the digits
    before = np.where(small, 1, np.maximum(exponent + 1, 0))
    heads, highs, lows, tails = _sixes()
    words = [
        (0, heads[np.where(small, 0, np.maximum(-exponent, 0)) + 5 * np.signbit(x)]),
        (6, highs[high + 1000 * (2 * before + (low > 0))]),
        (10, lows[low + 1000 * before]),
        (14, tails[np.where(small, -exponent, 0)]),
    ]
    return _Cell(18, words, doubtful)


def _table(texts: list[str], kind: str) -> Array:
    size = np.dtype(kind).itemsize
    return np.frombuffer(b"".join(text.encode().ljust(size, b"\0") for text in texts), kind)


@cache
def _fours() -> Array:
    """Four digits: of the leading group, of one behind others, and of a leading one that has others behind it."""
    first = [f"{k}" for k in range(10_000)]
    return _table([*first, *(f"{k:04d}" for k in range(10_000)), "", *first[1:]], "<u4")


@cache
def _sixes() -> tuple[Any, ...]:
    """What ``%.6g`` is put together of: the head, two times three digits with a point somewhere, the exponent."""
    heads = [sign + text for sign in ("", "-") for text in ("", "0.", "0.0", "0.00", "0.000")]
    highs, lows = [], []
    for before in range(7):
        for more in (False, True):
            for k in range(1000):
                text = f"{k:03d}"
                if before in (1, 2, 3):
                    text = f"{text[:before]}.{text[before:]}"
                    text = text if more else text.rstrip("0").rstrip(".")
                elif before == 0 and not more:
                    text = text.rstrip("0")
                highs.append(text)
        for k in range(1000):
            text = f"{k:03d}"
            if before <= 3:
                text = text.rstrip("0")
            elif before < 6:
                text = f"{text[: before - 3]}.{text[before - 3 :]}".rstrip("0").rstrip(".")
            lows.append(text)
    tails = ["" if k < 5 else f"e-{k:02d}" for k in range(18)]
    return _table(heads, "<u8"), _table(highs, "<u4"), _table(lows, "<u4"), _table(tails, "<u4")
