"""Formatting of rows of numbers on arrays alone: compiled with Numba, and far slower than ``%`` without.

A number is split into its whole part and the rest, which is exact, and only the rest times a power of ten is rounded.
Where that product is so close to a half that its own rounding could decide, or is not finite, nothing is written and
the row is left to the caller.
"""

from __future__ import annotations

import numpy as np

from graphnav.core.compiled import compile_once
from graphnav.core.rotation import Array
from graphnav.recording.exporters.digits import GENERAL, WORD

_ROUNDING_UNIT = 2.0**-52  # of a product, which may be off by half of that
_MOST_WHOLE = 1e15
_FLOAT_TENS = 10.0 ** np.arange(23)  # exact
_WHOLE_TENS = 10 ** np.arange(17)
_FALLING = 10.0 ** np.arange(4, -18, -1.0)
_TEN = np.uint64(10)
_DIGITS = np.frombuffer(b"0123456789", np.uint8)
_MINUS, _POINT, _ZERO, _E = 45, 46, 48, 101


@compile_once
def write_digits(number: int, count: int, out: Array, at: int) -> int:
    """Write the last `count` digits of a whole number into `out` from `at` on; returns where they end."""
    left = np.uint64(number)  # division of signed numbers takes twice as long
    for i in range(at + count - 1, at - 1, -1):
        rest = left // _TEN
        out[i] = _DIGITS[left - rest * _TEN]
        left = rest
    return at + count


@compile_once
def write_fixed(x: float, places: int, out: Array, at: int) -> int:
    """Write ``%.kf``; NaN is blank; -1 where the rounding is undecided."""
    if np.isnan(x):
        return at
    size = abs(x)
    if not size < _MOST_WHOLE:
        return -1
    whole = int(size)
    scaled = (size - whole) * _FLOAT_TENS[places]
    rest = int(scaled + 0.5)
    if abs(scaled - rest) >= 0.5 - _ROUNDING_UNIT * scaled:
        return -1
    if rest >= _WHOLE_TENS[places]:
        whole, rest = whole + 1, 0
    if np.signbit(x):
        out[at] = _MINUS
        at += 1
    count = 1
    while whole >= _WHOLE_TENS[count]:
        count += 1
    at = write_digits(whole, count, out, at)
    if places > 0:
        out[at] = _POINT
        at = write_digits(rest, places, out, at + 1)
    return at


@compile_once
def write_general(x: float, out: Array, at: int) -> int:
    """Write ``%.6g``; NaN is blank; -1 where the rounding is undecided."""
    if np.isnan(x):
        return at
    size = abs(x)
    if size != 0.0 and not (1e-16 < size < 1e5):
        return -1
    exponent, number = 0, 0
    if size > 0.0:
        exponent = 4
        while size < _FALLING[4 - exponent]:
            exponent -= 1
        scaled = size * _FLOAT_TENS[5 - exponent]
        number = int(scaled + 0.5)
        if abs(scaled - number) >= 0.5 - _ROUNDING_UNIT * scaled or scaled < 99_999.5 or number > 1_000_000:
            return -1
    if number == 1_000_000:
        number, exponent = 100_000, exponent + 1
    count = 6 if number > 0 else 1
    if np.signbit(x):
        out[at] = _MINUS
        at += 1
    begin, before = at, 1 if exponent < -4 else exponent + 1  # digits before the decimal point
    if before <= 0:
        out[at], out[at + 1] = _ZERO, _POINT
        at = write_digits(0, -before, out, at + 2)
        at = write_digits(number, count, out, at)
    else:
        write_digits(number, count, out, at)
        for i in range(at + count, at + before, -1):  # room for the point
            out[i] = out[i - 1]
        out[at + before] = _POINT
        at += count + 1
    while out[at - 1] == _ZERO and at > begin + before:  # after the decimal point
        at -= 1
    if out[at - 1] == _POINT:
        at -= 1
    if exponent < -4:
        out[at], out[at + 1] = _E, _MINUS
        at = write_digits(-exponent, 2, out, at + 2)
    return at


@compile_once
def write_rows(
    table: Array, row: int, kinds: Array, words: Array, literal: Array, ends: Array, out: Array
) -> tuple[int, int]:
    """Write lines into `out` for the rows of a table from `row` on; returns the first undecided row, and the number of
    bytes.

    Parameters
    ----------
    table : (K, n) numbers.
    kinds : (m,) of the fields of a line.
    words : (K, w) bytes of the field that is no number, if there is one; zeros are left out.
    literal, ends : what stands before each field and after the last, (m + 2,) ends of each.
    """
    at = 0
    while row < len(table):
        begin, column = at, 0
        for k in range(len(kinds)):
            for i in range(ends[k], ends[k + 1]):
                out[at] = literal[i]
                at += 1
            if kinds[k] == WORD:
                for one in words[row]:
                    if one > 0:
                        out[at] = one
                        at += 1
                continue
            if kinds[k] == GENERAL:
                at = write_general(table[row, column], out, at)
            else:
                at = write_fixed(table[row, column], kinds[k], out, at)
            if at < 0:
                return row, begin
            column += 1
        for i in range(ends[len(kinds)], ends[len(kinds) + 1]):
            out[at] = literal[i]
            at += 1
        row += 1
    return row, at
