"""CSV files of numbers, parsed with whole-array arithmetic; line by line for error messages."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import IO, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from graphnav.core.errors import RecordingError
from graphnav.core.files import ARCHIVE, ZIP, exists, is_blank, open_file, parse_number
from graphnav.core.notes import format_count
from graphnav.core.rotation import Array
from graphnav.recording.formats.decimals import drop_cut_line, read_decimals

_BLANK_CELL = re.compile(r"(?m)(?:(?<=,)|^(?=[ \t]*,))[ \t]*(?=,|$)")  # an empty cell of a line that is not empty
# to the end of the line from #, unless it begins a cell (#N/A) or is in a NaN of Windows (1.#IND); whole lines from %,
# which units hold as well
_COMMENT = re.compile(r"(?m)(^|[^,\s])(?<!1\.)[ \t]*#.*|^[ \t]*%.*")
_EMPTY = "is empty, or holds comments (#) alone; copy the log again, or leave this file out"
_OTHERS = {  # by how the first line begins
    "version https://git-lfs": "a pointer of Git LFS (git lfs pull fetches the file)",
    "<!": "a web page",
    "<html": "a web page",
    "<?xml": "XML",
    "{": "JSON",
}
_TIME_OF_DAY = re.compile(
    r"(?:\d+-\d+-\d+[T ])?\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d*)?)?\s*(?:Z|UTC|GMT|[+-]\d\d:?\d\d|([A-Z]{2,5}))?"
)
_MARKS = {";": "a semicolon", "\t": "a tab", " ": "blanks"}  # separators, in the order of their tests


Selection = Any  # an array of bool, or of row numbers


@dataclass(frozen=True)
class Table:
    """The requested columns of one file, by our names, NaN where a cell is blank."""

    path: Path
    columns: dict[str, Array]  # each (N,)
    file_names: dict[str, str]  # our name -> the file's
    rows: NDArray[np.intp]  # (N,) row numbers in the file
    cut: bool = False  # whether the file ends within a line, which is left out

    KEEP: ClassVar[str] = "keep"  # name of the column of `keep`

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def get(self, name: str, default: Array) -> Array:
        """A column, or the default if it is missing."""
        return self.columns.get(name, default)

    def stack(self, *names: str) -> Array:
        """Columns side by side, (N, len(names))."""
        return np.stack([self.columns[n] for n in names], -1)

    def release(self, *names: str) -> None:
        """Release columns that are no longer needed: for a day of an IMU each is 140 MB."""
        for name in names:
            del self.columns[name]

    def take(self, mask: Selection) -> Table:
        """Select rows by a mask or an index array."""
        return replace(self, columns={n: c[mask] for n, c in self.columns.items()}, rows=self.rows[mask])

    def with_column(self, name: str, values: Array) -> Table:
        """The table with one column replaced."""
        return replace(self, columns={**self.columns, name: values})

    def drop(self, *names: str) -> Table:
        """The table without some columns."""
        return replace(self, columns={name: column for name, column in self.columns.items() if name not in names})

    def describe_place(self, row: int, name: str) -> str:
        """'file, line 12, column lat' for an error about one cell."""
        with _open(self.path) as file:
            for k, (number, _) in enumerate(_list_lines(file)):
                if k == self.rows[row]:
                    return f"{self.path}, line {number}, column '{self.file_names[name]}'"
        return f"{self.path}, column '{self.file_names[name]}'"


def read_table(
    path: Path,
    required: Sequence[str],
    optional: Sequence[str] = (),
    renamed: Mapping[str, str] | None = None,
    keep: str | None = None,
) -> Table:
    """Read columns of a .csv or .csv.gz by name, in any order; other columns are not looked at.

    Parameters
    ----------
    required, optional
        Our names. A missing optional column is simply not in the result.
    renamed
        Our name -> the file's name, for those that differ; what is listed must be there.
    keep
        The file's name of one more column, found in the result as `Table.KEEP`.

    Raises
    ------
    RecordingError
        Naming file, line, column and cell, for anything that is not a table of numbers.
    """
    renamed = dict(renamed or {})
    skip, header = _find_header(path)
    if keep is not None:
        required, renamed = (*required, Table.KEEP), {**renamed, Table.KEEP: keep}
    file_names = {}
    for name in (*required, *optional):
        theirs = renamed.get(name, name)
        if header.count(theirs) > 1:
            raise RecordingError(
                f"{path}: {header.count(theirs)} columns are called '{theirs}'; give them their own names",
                key="table.column_twice",
            )
        if theirs in header:
            file_names[name] = theirs
        elif name in required or name in renamed:
            hint = "" if name in renamed else f'; if it has another name, set columns = {{ {name} = "..." }}'
            raise RecordingError(
                f"{path}: no column '{theirs}' (there are: {_list_names(header)}){hint}", key="table.column"
            )
    use = [header.index(theirs) for theirs in file_names.values()]
    values, cut = _parse(path, skip, header, use)
    if not len(values[0]):
        raise RecordingError(
            f"{path}: holds a header and no rows; copy the log again, or leave this file out", key="file.no_rows"
        )
    return Table(path, dict(zip(file_names, values, strict=True)), file_names, np.arange(len(values[0])), cut)


def _list_names(header: list[str]) -> str:
    """The names of columns, shortened to a readable number."""
    names = [name[:40] for name in header[:30]]
    return ", ".join(names if len(names) == len(header) else [*names, "..."])


def read_column_names(path: Path) -> list[str]:
    """The column names of a .csv or .csv.gz.

    Raises
    ------
    RecordingError
        If the file is none.
    """
    return _find_header(path)[1]


def read_first_rows(path: Path, count: int) -> list[list[str]]:
    """The cells of the first rows of a .csv or .csv.gz, as text.

    Raises
    ------
    RecordingError
        If the file cannot be read.
    """
    try:
        with _open(path) as file:
            lines = [line for _, line in islice(_list_lines(file), count)]
    except UnicodeDecodeError:
        raise RecordingError(
            f"{path}: holds bytes that are not UTF-8 text; save it as UTF-8", key="file.text"
        ) from None
    return [_split(line) for line in lines]


def _open(path: Path) -> IO[str]:
    """Text of a plain or gzip file."""
    return io.TextIOWrapper(_open_bytes(path), encoding="utf-8-sig")


def _open_bytes(path: Path) -> IO[bytes]:
    if not exists(path):
        other = path.with_suffix("") if path.suffix == ".gz" else path.with_name(path.name + ".gz")
        like = (
            (one for one in path.parent.iterdir() if one.name.lower() == path.name.lower())
            if exists(path.parent)
            else ()
        )
        other = next(iter(like), other)
        hint = f"; there is {other.name}" if exists(other) else ""
        raise RecordingError(f"{path}: no such file{hint}", key="file.missing")
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder where a CSV file is wanted", key="file.folder")
    file = open_file(path)
    why, key = None, "file.gzip"
    if not file.size:
        why, key = _EMPTY, "file.empty"
    elif file.packed != (path.suffix == ".gz"):
        why = "is gzip-compressed; its name must end in .gz"
        if not file.packed:
            why = "is not gzip-compressed although its name ends in .gz; rename it, or compress it"
    if why is not None:
        file.close()
        raise RecordingError(f"{path}: {why}", key=key)
    return file


def _find_header(path: Path) -> tuple[int, list[str]]:
    """Number of lines before the data, and the column names."""
    with _open_bytes(path) as raw:
        start = raw.read(1 << 16)
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise RecordingError(f"{path}: is UTF-16 text; save it as UTF-8", key="file.text")
    if start[:4] == ZIP:
        raise RecordingError(f"{path}: {ARCHIVE}", key="file.archive")
    if b"\0" in start.partition(b"\n")[0]:  # later ones a loss of power leaves
        raise RecordingError(f"{path}: is a binary file, not a CSV table; save it as CSV", key="file.binary")
    text = start.decode("utf-8-sig", errors="replace")
    for number, line in enumerate(text.splitlines(), 1):
        line = _COMMENT.sub(r"\1", line).strip()
        if not line:
            continue
        names = _split(line.lstrip("\ufeff"))
        if "\ufffd" in line:
            raise RecordingError(f"{path}, line {number}: is not UTF-8 text; save it as UTF-8", key="file.text")
        if other := next((words for start, words in _OTHERS.items() if line.startswith(start)), None):
            raise RecordingError(f"{path}: is {other}, not a CSV table", key="file.no_table")
        mark = next((words for one, words in _MARKS.items() if one in line), None)
        if len(names) == 1 and mark is not None:
            raise RecordingError(
                f"{path}, line {number}: fields are separated by {mark}; they must be by commas, numbers written with "
                "points (graphnav init makes such a file of it)",
                key="table.separator",
            )
        if all(_is_number(name) for name in names):
            raise RecordingError(
                f"{path}, line {number}: the first line must name the columns, and it holds numbers",
                key="table.no_header",
            )
        return number, names
    raise RecordingError(f"{path}: {_EMPTY}", key="file.empty")


def _split(line: str) -> list[str]:
    """The cells of a line; a comma within quotes does not separate two."""
    cells = next(csv.reader([line], skipinitialspace=True)) if '"' in line else line.split(",")
    return [cell.strip().strip('"') for cell in cells]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parse(path: Path, skip: int, header: list[str], use: list[int]) -> tuple[list[Array], bool]:
    """The requested columns, (N,) each: plain numbers, else as NumPy parses them, else cell by cell; if it was cut."""
    try:
        with _open_bytes(path) as raw:
            head = b"".join(raw.readline() for _ in range(skip))
            if len(head.splitlines()) == skip:  # otherwise lines end in an unusual way
                return read_decimals(raw, len(header), use)
    except ValueError:
        pass
    cut = False
    try:
        with _open_bytes(path) as raw:
            data = raw.read()
        if not data.endswith(b"\n"):
            data, cut = drop_cut_line(data, len(header))
        text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig").read()
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: is not UTF-8 text; save it as UTF-8", key="file.text") from None
    try:
        values = _load_text(text, skip, header, use)
    except ValueError:
        values = _parse_cells(path, text, header, use)
    return list(np.ascontiguousarray(values.T)), cut


def _load_text(text: str, skip: int, header: list[str], use: list[int]) -> Array:
    if "#" in text or "%" in text:
        text = _COMMENT.sub(r"\1", text)
    # with usecols NumPy checks only that no row is too short for those
    for line in text.splitlines()[skip:]:
        cells = line.strip()
        if cells and cells.count(",") != len(header) - 1:
            raise ValueError("rows and header differ in length")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no rows: reported by the caller
        values = np.loadtxt(
            io.StringIO(_BLANK_CELL.sub("nan", text)),
            delimiter=",",
            comments=None,
            skiprows=skip,
            usecols=use,
            ndmin=2,
            encoding="utf-8",
        )
    return values.reshape(-1, len(use))


def _list_lines(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    """(line number, text) of every non-empty line after the header."""
    seen_header = False
    for number, line in enumerate(lines, 1):
        line = _COMMENT.sub(r"\1", line).strip()
        if line and seen_header:
            yield number, line
        seen_header = seen_header or bool(line)


def _suggest_cause(cell: str, cells: list[str], header: list[str], use: list[int]) -> str:
    """The likely meaning of a cell that is not a number, and what to do."""
    if cells == header:
        return "; the header is there again: cut the file in two there, or take the line out"
    if sorted(cells) == sorted(header):
        return "; the header is there again, in another order: cut the file in two there"
    if found := _TIME_OF_DAY.fullmatch(cell):
        zone = f", and {found[1]} as its offset, such as +09:00" if found[1] else ""
        return f"; it is a time of day: write seconds, or let graphnav init do it{zone}"
    if re.match(r"\d+[-/.]\d+[-/.]\d+\b", cell):
        return "; it is a date: write seconds, or year-month-day, of which graphnav init makes them"
    if _is_number(re.sub("['\u2019\u2212\u00a0\u202f ]", "", cell)):  # marks between thousands, a minus as in print
        return "; write it with ASCII digits and - alone, or let graphnav init do it"
    if not any(_is_number(cells[k]) for k in use):
        return "; if the line holds units, take it out, or let graphnav init do it"
    if re.fullmatch(r"[-+]?\d+(\.\d*)?([eE][-+]?\d+)?\s*[A-Za-z%°][\w/²^]*", cell):
        return "; write the number alone, and its unit in units, or let graphnav init do it"
    return ""


def _parse_cells(path: Path, text: str, header: list[str], use: list[int]) -> Array:
    """The slow parser, which reports what is wrong and where."""
    rows = []
    for number, line in _list_lines(text.splitlines()):
        cells = _split(line)
        if "\0" in line:
            raise RecordingError(
                f"{path}, line {number}: holds bytes that are 0, as after a loss of power: take the line out",
                key="table.fields",
            )
        if len(cells) != len(header):
            many = format_count(len(cells), "field")
            raise RecordingError(
                f"{path}, line {number}: has {many} where the header has {len(header)}", key="table.fields"
            )
        row = []
        for column in use:
            cell = cells[column]
            try:
                row.append(np.nan if is_blank(cell) else parse_number(cell))
            except ValueError:
                raise RecordingError(
                    f"{path}, line {number}, column '{header[column]}': '{cell[:40]}' is not a number"
                    f"{_suggest_cause(cell, cells, header, use)}",
                    key="table.cell",
                ) from None
        rows.append(row)
    return np.array(rows, dtype=float).reshape(-1, len(use))
