"""Tables as text with the digits that C's ``%.kf`` and ``%.6g`` give.

Few rows are formatted with ``%``. Many are formatted by `graphnav.recording.exporters.rows` where that is compiled,
twenty times as fast; rows it cannot decide are formatted with ``%`` again. The text is identical to the byte.
"""

from __future__ import annotations

import re
import sys
from functools import cache

import numpy as np

from graphnav.core.compiled import can_compile
from graphnav.core.rotation import Array

GENERAL, WORD = -1, -2  # kinds of fields: %.6g and %s; others are the decimals of %.kf
_FIELD = re.compile(r"%(?:\.(\d+)(f|g)|d|s)")
_MOST_PLACES = 11  # for which 10^k 2^-53 is far below a half
_WIDEST_NUMBER = 28  # bytes of a number: a sign, 15 digits, a point and eleven more
_ROWS_AT_ONCE = 512  # rows at once: their text stays in the processor's cache
_COMPILED = "graphnav.recording.exporters.rows"
_FEW, _SOME, _MANY = 500, 20_000, 2_000_000  # numbers above which loading and calling compiled code pays off


def format_rows(table: Array, row_format: str) -> str:
    """The rows of `table` (K, n) in one ``%`` format with n fields, one line each; NaN becomes blank."""
    return encode_rows(table, row_format).decode("ascii")


def format_json_rows(table: Array, number_format: str, line: str) -> str:
    """Numbers (K,) or (K, n) for `graphnav.core.jsonable`: several times as fast as all digits of each."""
    rows = format_rows(np.reshape(table, (len(table), -1)), ", ".join([number_format] * np.size(table[0])))
    if np.ndim(table) == 1:
        return f"[{', '.join(rows.splitlines())}]"
    between = f"],{line}  ["
    return f"[{between[2:]}{between.join(rows.splitlines())}]{line}]"


def encode_rows(table: Array, row_format: str, last: Array | None = None) -> bytes:
    """The same as ASCII bytes.

    Parameters
    ----------
    table : (K, n)
    row_format : of ``%.kf``, ``%.6g`` and ``%d``; with `last` a ``%s`` behind them.
    last : (K,) words of ASCII, of type S.
    """
    table, form = np.asarray(table, dtype=float), row_format + "\n"
    assert len(_FIELD.findall(form)) == table.shape[1] + (last is not None), "a format of other columns"
    least = _FEW if _COMPILED in sys.modules else _SOME if "numba" in sys.modules else _MANY
    if table.size >= least and None not in _list_kinds(form) and can_compile():
        return b"".join(
            _write_compiled(table[k : k + _ROWS_AT_ONCE], form, None if last is None else last[k : k + _ROWS_AT_ONCE])
            for k in range(0, len(table), _ROWS_AT_ONCE)
        )
    return _write_plainly(table, form, last)


def _write_plainly(table: Array, form: str, last: Array | None) -> bytes:
    if last is None:
        text = form * len(table) % tuple(table.ravel().tolist())
    else:
        words = np.char.decode(last, "ascii").tolist()
        text = "".join(form % (*row, word) for row, word in zip(table.tolist(), words, strict=True))
    return (text.replace("nan", "") if np.isnan(table).any() else text).encode("ascii")


def _write_compiled(table: Array, form: str, last: Array | None) -> bytes:
    from graphnav.recording.exporters import rows  # which imports Numba

    kinds = np.array(_list_kinds(form))
    whole = [k for k, one in enumerate(_FIELD.finditer(form)) if one[0] == "%d"]
    if whole:
        table = table.copy()
        table[:, whole] = np.trunc(table[:, whole]) + 0.0  # %d has no negative zero
    table = np.ascontiguousarray(table)  # other layouts would be compiled anew
    between = _FIELD.split(form)[:: _FIELD.groups + 1]
    literal = np.frombuffer("".join(between).encode("ascii"), np.uint8)
    ends = np.cumsum([0, *map(len, between)])
    words = np.empty((len(table), 0), np.uint8)
    if last is not None:
        words = np.ascontiguousarray(last).view(np.uint8).reshape(len(table), -1)
    out = np.empty(len(table) * (len(literal) + _WIDEST_NUMBER * table.shape[1] + words.shape[1]), np.uint8)
    parts, row = [], 0
    while row < len(table):
        row, size = rows.write_rows(table, row, kinds, words, literal, ends, out)
        parts.append(out[:size].tobytes())
        if row < len(table):
            one = slice(row, row + 1)
            parts.append(_write_plainly(table[one], form, None if last is None else last[one]))
            row += 1
    return b"".join(parts)


@cache
def _list_kinds(form: str) -> tuple[int | None, ...]:
    """The kinds of a format's fields for `graphnav.recording.exporters.rows`, None for a format that it cannot
    write.
    """

    def choose_kind(one: re.Match[str]) -> int | None:
        if one[2] is None:
            return WORD if one[0] == "%s" else 0
        places = int(one[1])
        if one[2] == "g":
            return GENERAL if places == 6 else None
        return places if places <= _MOST_PLACES else None

    return tuple(choose_kind(one) for one in _FIELD.finditer(form))
