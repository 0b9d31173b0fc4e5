"""Tables other than CSV of numbers: other separators, decimal commas, lines above the header, dates, times of day."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, time, timedelta
from pathlib import Path

import numpy as np

from graphnav.core.errors import RecordingError
from graphnav.core.files import is_blank, open_file, parse_number, read_bytes
from graphnav.core.rotation import Array
from graphnav.core.timescales import DAY
from graphnav.recording.draft.angles import read_angles
from graphnav.recording.draft.cells import MARKED, take_units_off, write_plainly
from graphnav.recording.formats.columns import NAMED_UNITS, match_columns, split_unit
from graphnav.recording.formats.text import NumberedLines

_START = 1 << 16  # bytes that contain the header
_MARKS = {"\t": "a tab", ";": "a semicolon", ",": "a comma", "|": "a bar", None: "blanks"}
_WIDE = (b"\xff\xfe", b"\xfe\xff")  # marks at the start of UTF-16
_COMMENT = re.compile(r"\s*(?:#|%|//)+\s?")
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")  # 08.07.2025
_MONTH_NAMED = re.compile(r"(\d{1,2})[- ]([A-Za-z]{3})[- ](\d{4})(.*)")  # 08-Jul-2025, as MATLAB writes it
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_YEAR_FIRST = re.compile(
    r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})(.*)|(\d{4})(\d{2})(\d{2})(T\d{6}.*)"
)  # 2025-07-08, 20250708T
_SLASHES = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{4})(.*)")  # 07/08/2025, where one number may identify the month
_TIME_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2})(?:[.,:](\d{1,9}))?\s*([AaPp][Mm])?")
_NANOSECONDS = re.compile(r"(.*?)n(?:ano)?_?sec(?:ond)?s?", re.IGNORECASE)


@dataclass(frozen=True)
class Plain:
    """The columns of a table as numbers, by the file's names, and notes on the conversion."""

    columns: dict[str, Array]
    words: str
    dated: str | None = None  # the column that was dates: Unix time, s
    daily: str | None = None  # the column that was times of day: s since midnight before the first row
    words_in: dict[str, str] = field(default_factory=dict)  # a cell of each column that holds no numbers


@dataclass(frozen=True)
class _Layout:
    """The layout of a table."""

    mark: str | None  # between fields; None for blanks
    names: list[str]
    above: list[str]  # lines before the header
    first: int  # index of the first row among the lines
    done: list[str] = field(default_factory=list)  # notes on deviations from a CSV file


def add_words(plain: Plain | None, words: str) -> Plain:
    """The same with words about what else was done to the columns."""
    return Plain({}, words) if plain is None else replace(plain, words=f"{plain.words}, {words}")


def read_plain(path: Path) -> Plain | None:
    """Read a table whose fields, numbers or times are written differently from a CSV file's; None for a CSV file.

    Parameters
    ----------
    path : a file of text.

    Returns
    -------
    Plain or None
        Columns that hold no numbers are left out, as is a table of no sensor whose rows differ in length; blanks are
        NaN. Dates without a zone are taken as UTC.

    Raises
    ------
    RecordingError
        If it cannot be read, or a row has more or fewer fields than the header, naming its line.
    """
    with open_file(path) as raw:
        start = raw.read(_START)
    start = start if start[:2] in _WIDE else start.rstrip(b"\0")
    if b"\0" in start and start[:2] not in _WIDE:
        return None
    if len(start) == _START:  # probably cut off within a line
        start = start[: start.rindex(b"\n")] if b"\n" in start else start
    begin, _ = _decode(start)
    head = _read_lines(begin.splitlines())
    layout = _lay_out(path, head)
    if layout is None:
        return None
    cells_of_first = _split(head[layout.first][1], layout.mark)
    plainly = layout.mark == "," and not layout.done and all(_parse_column([x]) is not None for x in cells_of_first)
    if path.suffix == ".gz" and plainly:  # what is packed is large
        return None
    text, encoding = _decode(read_bytes(path))
    lines = _read_lines(text.splitlines())
    rows = [_split(line, layout.mark) for _, line in lines[layout.first :]]
    names, done = layout.names, [*layout.done, *encoding]
    if len(rows[0]) == len(names) + 1 and not any(row[-1] for row in rows if len(row) > len(names)):
        rows = [row[: len(names)] for row in rows]
        done.append("an empty field at the end")
    if len(rows) > 1 and len(rows[-1]) < len(names) and not text.endswith(("\n", "\r")):
        del rows[-1]
        done.append("it ends within a line, which is left out")
    wrong = next((k for k, row in enumerate(rows) if len(row) != len(names)), None)
    if wrong is not None and (not done or match_columns(names, path.stem).sensor is None):
        return None  # a CSV file: its reader reports errors and notes
    if wrong is not None:
        raise RecordingError(
            f"{path}, line {lines[layout.first + wrong][0]}: has {len(rows[wrong])} fields where the header has "
            f"{len(names)}",
            key="table.fields",
        )
    cells = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    if layout.mark != "," or not {'"', "'", "\u2019"}.isdisjoint(text):  # else no number has another mark in it
        cells, style = write_plainly(cells, layout.mark)
        done += style
    cells, stated = take_units_off(cells)
    done += stated
    columns = {name: x for name, some in cells.items() if (x := _parse_column(some)) is not None}
    done += [*_add_nanoseconds(columns), *read_angles(cells, columns)]
    dated, daily, more = _parse_times(cells, columns, layout.above)
    words = {name: next(filter(None, some), "") for name, some in cells.items() if name not in columns}
    return Plain(columns, ", ".join([*done, *more]), dated, daily, words) if done or more else None


def _decode(data: bytes) -> tuple[str, list[str]]:
    """The text, and its encoding in words where it is not UTF-8."""
    if data[:2] in _WIDE:
        return data[: len(data) // 2 * 2].decode("utf-16", errors="replace"), ["UTF-16 text"]
    data, notes = data.rstrip(b"\0"), []
    try:
        text = data.decode("utf-8-sig").lstrip("\ufeff")
    except UnicodeDecodeError:
        text, notes = data.decode("cp1252", errors="replace"), ["text of Windows"]
    if "\u2212" in text:
        text, notes = text.replace("\u2212", "-"), [*notes, "minus signs as in print"]
    return text, notes


def _read_lines(text: Sequence[str]) -> NumberedLines:
    """Numbers and text of non-empty lines; after the first row without comments."""
    lines = [(k, line) for k, line in enumerate(text, 1) if line.strip()]
    first, _ = _find_first_row(lines)
    return [(k, line) for i, (k, line) in enumerate(lines) if i <= (first or 0) or line.lstrip()[0] not in "#%"]


def _split(line: str, mark: str | None) -> list[str]:
    """The fields of a line."""
    if mark is None:
        return line.split()
    cells = next(csv.reader([line], delimiter=mark)) if '"' in line else line.split(mark)
    return [cell.strip() for cell in cells]


def _read_values(line: str, mark: str | None) -> tuple[float, int]:
    """The share of a line's fields that are numbers, dates or times of day, and the number of fields."""
    cells = _split(line, mark)
    count = sum(_is_value(cell) for cell in cells)
    return count / max(sum(cell != "" for cell in cells), 1), count


def _is_value(cell: str) -> bool:
    return (
        _parse_column([cell]) is not None
        or MARKED.fullmatch(cell) is not None
        or _parse_clock(cell) is not None
        or bool(_parse_date(cell) or _SLASHES.fullmatch(cell))
    )


def _find_first_row(lines: NumberedLines) -> tuple[int | None, str | None]:
    """Index of the first row of a table, known by two in succession, and the separator of its fields."""
    for k in range(len(lines) - 1):
        if (mark := _find_mark([line for _, line in lines[k : k + 2]])) != "":
            width = len(_split(lines[k][1], mark))
            while k > 1 and _is_sparse(_split(lines[k - 1][1], mark), width):
                k -= 1
            return k, mark
    return None, ""


def _is_sparse(cells: Sequence[str], width: int) -> bool:
    """Whether fields of a line are a row of a table of that width in which little is known yet."""
    return len(cells) == width and _is_value(cells[0]) and all(is_blank(c) or _is_value(c) for c in cells)


def _find_mark(rows: Sequence[str]) -> str | None:
    """The separator of the fields of rows; "" where they are none: at least two fields, half of them values."""
    found = []
    for mark in _MARKS:
        some = [_read_values(row, mark) for row in rows]
        if (
            all(share >= 0.5 and count >= 2 for share, count in some)
            and len({len(_split(row, mark)) for row in rows}) == 1
        ):
            found.append((min(some), mark))
    return max(found, key=lambda one: one[0])[1] if found else ""


def _lay_out(path: Path, lines: NumberedLines) -> _Layout | None:
    """The layout of a table; None for a CSV file or no table with a header."""
    first, mark = _find_first_row(lines)
    if not first:  # none, or no line before it
        return None
    row = _split(lines[first][1], mark)
    head, units = first - 1, []
    two = [_split(_COMMENT.sub("", line), mark) for _, line in lines[max(first - 2, 0) : first]]
    if len(two) == 2 and len(two[0]) == len(two[1]) == len(row) and _are_units(two[1]):
        head, units = first - 2, two[1]
    names = _split(_COMMENT.sub("", lines[head][1]), mark)
    if mark is None and len(names) > len(row):  # names of several words are separated by wider gaps
        names = re.split(r"\s{2,}", _COMMENT.sub("", lines[head][1]).strip())
    commented = _COMMENT.match(lines[head][1])
    if len(names) == len(row) - 1 and _parse_date(row[0]) and _parse_clock(row[1]) is not None:
        names = ["date", *names]  # one name above a date and a time of day
    if len(names) not in (len(row), len(row) - 1):
        if commented or match_columns(names, path.stem).sensor is None:
            return None
        raise RecordingError(
            f"{path}, line {lines[head][0]}: names {len(names)} columns where the rows have {len(row)} fields apart by "
            f"{_MARKS[mark]}",
            key="table.fields",
        )
    if units:
        bare = [unit.strip("[]()") for unit in units]
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, bare, strict=True)]
    above = [line for _, line in lines[:head]]
    done = [f"fields apart by {_MARKS[mark]}"] if mark != "," else []
    done += ["a line of units"] if units else []
    done += ["a header in a comment"] if commented else []
    done += ["lines above the header"] if any(not _COMMENT.match(line) for line in above) else []
    return _Layout(mark, names, above, first, done)


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a line under the names holds units."""
    spelt = [split_unit(f"x [{cell.strip('[]()')}]")[1] for cell in cells if cell.strip("[]()-")]
    return sum(unit in NAMED_UNITS for unit in spelt) > 0.5 * len(spelt)


def _add_nanoseconds(columns: dict[str, Array]) -> list[str]:
    """Add a column of nanoseconds to that of whole seconds of the same name, as of a ROS stamp; returns a note."""
    for name in list(columns):
        found = _NANOSECONDS.fullmatch(name)
        if found is None:
            continue
        whole = re.compile(rf"{re.escape(found[1])}sec(?:ond)?s?", re.IGNORECASE)
        seconds = next((other for other in columns if whole.fullmatch(other)), None)
        if seconds is not None:
            columns[seconds] = columns[seconds] + 1e-9 * columns.pop(name)
            return [f"seconds of '{seconds}' and '{name}' together"]
    return []


def _parse_column(cells: Sequence[str]) -> Array | None:
    """A column as numbers, NaN where blank; None where it contains anything else, or only words for nothing."""
    if all(map(is_blank, cells)) and any(cells):
        return None
    try:
        return np.array([np.nan if is_blank(c) else parse_number(c.replace(",", ".")) for c in cells])
    except ValueError:
        return None


def _parse_times(
    cells: dict[str, list[str]], columns: dict[str, Array], above: Sequence[str]
) -> tuple[str | None, str | None, list[str]]:
    """Convert a column of dates, or one of times of day, to s; returns which is dated, which is daily, and notes.

    Dates alone may stand in a column beside times of day, or in a line above the header.
    """
    words = {name: some for name, some in cells.items() if name not in columns and any(some)}
    notes = []
    for name, some in words.items():
        if any(_SLASHES.fullmatch(cell) for cell in some):
            words[name], doubt = _put_year_first(some)
            notes += [doubt] if doubt else []
    daily = next(
        (name for name, some in words.items() if all(not c or _parse_clock(c) is not None for c in some)), None
    )
    days = next((some for name, some in words.items() if name != daily and _parse_date(some[0]) is not None), None)
    if days is not None and any(":" in cell or "T" in cell for cell in days):
        daily = next(name for name, some in words.items() if some is days)
        clocks = days
    elif daily is not None:
        if days is None:
            stated = [found for line in above for word in re.split(r"[\s,;|]+", line) if (found := _parse_date(word))]
            days = [f"{stated[0]:%Y-%m-%d}"] * len(words[daily]) if stated else None
        seconds = np.array([x if (x := _parse_clock(c)) is not None else np.nan for c in words[daily]])
        seconds += DAY * np.cumsum(np.diff(seconds, prepend=seconds[:1]) < -0.5 * DAY)  # over midnight
        if days is None or (begin := _parse_date(days[0])) is None:
            columns[daily] = seconds
            return None, daily, [*notes, f"times of day of '{daily}' as s since midnight"]
        midnight = begin.replace(tzinfo=UTC).timestamp()
        columns[daily] = midnight + seconds
        return daily, None, [*notes, f"dates and times of day of '{daily}' as Unix time in s; CHECK: taken as UTC"]
    else:
        return None, None, notes
    stamps = [_parse_date(text) for text in clocks]
    if any(x is None and not is_blank(text) for x, text in zip(stamps, clocks, strict=True)):
        return None, None, notes
    zone = stamps[0] is not None and stamps[0].tzinfo is not None
    columns[daily] = np.array(
        [np.nan if x is None else (x if x.tzinfo else x.replace(tzinfo=UTC)).timestamp() for x in stamps]
    )
    why = "" if zone else "; CHECK: they state no zone and are taken as UTC"
    return daily, None, [*notes, f"dates of '{daily}' as Unix time in s{why}"]


def _put_year_first(cells: list[str]) -> tuple[list[str], str]:
    """Dates with slashes rewritten year first; only their times of day where day and month are ambiguous."""
    parts = [found.groups() for cell in cells if (found := _SLASHES.fullmatch(cell))]
    day_first, month_first = (any(int(part[k]) > 12 for part in parts) for k in (0, 1))
    if day_first != month_first:
        a, b = (2, 1) if day_first else (1, 2)
        return [_SLASHES.sub(rf"\3-\{a}-\{b}\4", cell) for cell in cells], ""
    return [
        _SLASHES.sub(r"\4", cell).strip(" T") for cell in cells
    ], f"CHECK: {cells[0][:10]} may begin with the day or the month, so dates are left out"


def _parse_date(text: str) -> datetime | None:
    """A date with or without a time of day; None if it is none."""
    if len(text) < 8 or not text[:1].isdigit() or not text.isascii():
        return None
    if found := _DAY_FIRST.fullmatch(text) or _MONTH_NAMED.fullmatch(text):
        day, month, year, rest = found.groups()
    elif found := _YEAR_FIRST.fullmatch(text):
        year, month, day, rest = filter(lambda part: part is not None, found.groups())
    else:
        return None
    try:
        month = month if month.isdigit() else str(_MONTHS.index(month.lower()) + 1)
        start = datetime(int(year), int(month), int(day))
        rest = re.sub(r" *(?:UTC|GMT)$", "Z", rest.strip(" T").replace(",", "."))
        if (seconds := _parse_clock(rest.removesuffix("Z")) if rest else 0.0) is not None:
            start = start.replace(tzinfo=UTC) if rest.endswith("Z") else start
            return start + timedelta(seconds=seconds)
        return datetime.combine(start, time.fromisoformat(rest))
    except ValueError:
        return None


def _parse_clock(text: str) -> float | None:
    """A time of day, s since midnight; None if it is none."""
    found = _TIME_OF_DAY.fullmatch(text)
    if found is None:
        return None
    hours, minutes, seconds = (int(part) for part in found.groups()[:3])
    if half := found[5]:
        if not 1 <= hours <= 12:
            return None
        hours = hours % 12 + 12 * (half.lower() == "pm")
    if hours > 23 or minutes > 59 or seconds > 60:
        return None
    return 3600.0 * hours + 60.0 * minutes + seconds + float(f"0.{found[4] or 0}")
