"""Cells of numbers that are written otherwise: decimal commas, marks between thousands, units behind the numbers."""

from __future__ import annotations

import re

from graphnav.core.files import is_blank
from graphnav.recording.formats.columns import NAMED_UNITS, split_unit

MARKED = re.compile(r"[+-]?\d[\d.,'\u2019\u00a0\u202f ]*(?:[eE][+-]?\d+)?")  # a number in some country
_WITH_UNIT = re.compile(r"([+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s*([A-Za-z°][\w/²^]*)")
_SPACED = re.compile(r"(?<=\d)['\u2019\u00a0\u202f ](?=\d{3}(?!\d))")  # marks that are only ever between thousands
_GROUPED = {
    mark: re.compile(rf"[+-]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}})+(?:\{other}\d+)?") for mark, other in (",.", ".,")
}


def write_plainly(cells: dict[str, list[str]], mark: str | None) -> tuple[dict[str, list[str]], list[str]]:
    """Numbers with decimal commas or marks between thousands written with a decimal point alone, and notes.

    A table has one decimal mark throughout: that of numbers which are no grouping by three; where there are none, the
    point if commas separate the fields.
    """
    marked = [cell for some in cells.values() for cell in some if MARKED.fullmatch(cell)]
    if not any("," in cell or cell.count(".") > 1 or _SPACED.search(cell) for cell in marked):
        return cells, []
    bare = [_SPACED.sub("", cell) for cell in marked]
    commas, points = (
        sum(cell.count(x) == 1 and cell.rfind(x) > cell.rfind(y) and not _GROUPED[x].fullmatch(cell) for cell in bare)
        for x, y in (",.", ".,")
    )
    between = "." if commas > points or (commas == points and mark != ",") else ","
    grouped = bare != marked or any(_GROUPED[between].fullmatch(cell) for cell in bare)

    def rewrite(cell: str) -> str:
        if not MARKED.fullmatch(cell):
            return cell
        cell = _SPACED.sub("", cell)
        return (cell.replace(between, "") if _GROUPED[between].fullmatch(cell) else cell).replace(",", ".")

    notes = ["decimal commas"] if between == "." else []
    notes += ["marks between thousands"] if grouped else []
    return {name: [rewrite(cell) for cell in some] for name, some in cells.items()}, notes


def take_units_off(cells: dict[str, list[str]]) -> tuple[dict[str, list[str]], list[str]]:
    """Numbers with the same known unit behind each as numbers, the unit in the column's name, and notes."""
    out: dict[str, list[str]] = {}
    notes = []
    for name, some in cells.items():
        found = [_WITH_UNIT.fullmatch(cell) for cell in some if not is_blank(cell)]
        unit = found[0][2] if found and found[0] is not None else ""
        known = split_unit(f"x [{unit}]")[1] in NAMED_UNITS and unit != "S"  # which is south
        if not known or any(one is None or one[2] != unit for one in found):
            out[name] = some
            continue
        out[f"{name} [{unit}]"] = [cell if is_blank(cell) else cell[: -len(unit)].strip() for cell in some]
        notes.append(f"'{name}' in {unit}")
    return out, notes
