"""Errors in TOML files as one plain sentence: file, line, key, value, unit and the nearest known key."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphnav.core.errors import ConfigError, GraphnavError, RecordingError
from graphnav.core.files import exists, is_inside, read_text, shorten_path
from graphnav.core.notes import Note

if TYPE_CHECKING:
    from pydantic import BaseModel, ValidationError  # a tenth of a second, which help need not wait for

_TABLE_HEAD = re.compile(r"\[([^\[\]]+)\]")
_MAX_NAMES = 30  # names listed in one sentence at most
_MAX_QUOTED = 60  # characters of a value quoted in a sentence at most
_TOML_PLACE = re.compile(r" \(at line (\d+), column (\d+)\)$")  # of tomllib's errors
_LONG = re.compile(rf"\S{{{2 * _MAX_QUOTED},}}")  # a quoted value, as no sentence of graphnav has a word of this length
_DEEPEST = 50  # levels of nested tables at most; graphnav's own files have four
# keys of recording.toml that are put into a file of settings
_OF_RECORDINGS = {"file", "axes", "columns", "units", "lever_arm", "sd", "sd_v", "time_offset", "noise", "platform"}
_CURLY = "\u201c\u201d\u201e\u2018\u2019"  # quotes, as word processors write them
_KEY = re.compile(r"([\w\-.\"']+)\s*=")


def read_toml(path: Path, error: type[GraphnavError]) -> tuple[dict[str, Any], str]:
    """Read a TOML file.

    Returns
    -------
    values : dict
    text : str
        Of the file, for line numbers.

    Raises
    ------
    GraphnavError
        Of the kind given, if it cannot be read or is not TOML.
    """
    text = read_text(path, error)
    try:
        # the parser takes minutes for keys of thousands of parts
        if any(line.partition("=")[0].count(".") > 2 * _DEEPEST for line in text.splitlines()):
            raise RecursionError
        values = tomllib.loads(text)
        check_whole_numbers(values)
        return values, text
    except RecursionError:
        raise error(f"{path}: not valid TOML (nested too deep)", key="toml.syntax") from None
    except ValueError as cause:  # tomllib's own error is one; so is that for an integer of thousands of digits
        where, what = f"{path}", str(cause)
        if place := _TOML_PLACE.search(what):
            where, what = f"{path}, line {place[1]}, column {place[2]}", what[: place.start()]
            if not set(_CURLY).isdisjoint(text.splitlines()[int(place[1]) - 1]):
                what = f"quotes are curly: write {chr(34)}"
        what = _rephrase_toml(f"{what[:1].lower()}{what[1:]}")
        raise error(f"{where}: not valid TOML: {what}", key="toml.syntax") from None


def _rephrase_toml(what: str) -> str:
    """What to do about an error of tomllib."""
    if found := re.match(r"cannot (?:declare|mutate immutable namespace) \((.*?),?\)", what):
        return (
            f"[{'.'.join(re.findall(r'[^ ,]+', found[1])).replace(chr(39), '')}] is there twice: make one table of both"
        )
    if what == "cannot overwrite a value":
        return "the key is there twice: take one out"
    return f"{what}: write / in paths" if what.startswith("unescaped '\\'") else what


def check_whole_numbers(values: Any) -> None:
    """Refuse integers of more than 64 bits; hexadecimal ones may have any number of digits.

    Raises
    ------
    ValueError
        Saying which key of nested tables and lists has one.
    RecursionError
        If they are nested deeper than any file of settings.
    """
    for key, value in _leaves(values):
        if isinstance(value, int) and not -(2**63) <= value < 2**63:
            raise ValueError(f"'{key}' is a whole number of more than 64 bits")


def _leaves(value: Any, key: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Every value of nested tables and lists, with its key."""
    if depth > _DEEPEST:
        raise RecursionError
    if isinstance(value, dict | list):
        inner = value.items() if isinstance(value, dict) else ((key, one) for one in value)
        for name, one in inner:
            yield from _leaves(one, str(name), depth + 1)
    else:
        yield key, value


def describe_invalid(source: str | Path, error: ValidationError, model: type[BaseModel], text: str = "") -> Note:
    """Describe the first error that pydantic reports; an unknown key before the missing key it may stand for.

    `text` is the file's content, for the line number.
    """
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    loc = tuple(str(part) for part in first["loc"])
    where = describe_place(source, text, loc)
    described = _describe_error(first, loc, model)
    return Note(described.key, where + _LONG.sub(lambda word: f"{word[0][:_MAX_QUOTED]}...", described))


def describe_place(source: str | Path, text: str, loc: tuple[str, ...]) -> str:
    """'file, line 12: ' of a key in a file's `text`, where it is found there."""
    line = _find_line(text, loc)
    return f"{source}, line {line}: " if line else f"{source}: "


def resolve_beside(source: Path, name: str, key: str, allow_outside: bool) -> Path:
    """The path of a file that is named under `key` in the .toml `source`.

    Raises
    ------
    RecordingError
        If it is no path at all, or lies outside the folder of `source`, symbolic links followed, and may not.
    """
    path = source.parent / name
    if not is_inside(path, source.parent) and not allow_outside:
        where = describe_place(source, read_text(source, RecordingError), tuple(key.split(".")))
        raise RecordingError(
            f"{where}'{key}' = '{shorten_path(Path(name))}' lies outside its folder; move it there, or use "
            "--allow-outside if you trust who wrote this",
            key="file.outside",
        )
    exists(path)
    return path


def _describe_error(first: Any, loc: tuple[str, ...], model: type[BaseModel]) -> Note:
    key = ".".join(loc)
    if first["type"] == "extra_forbidden":
        return Note("key.unknown", f"unknown key '{key}'{_suggest(loc, model)}")
    if first["type"] == "missing":
        return Note("key.missing", f"'{key}' is missing{_describe_key(loc, model)}")
    if first["type"] == "value_error":  # raised by a validator of graphnav
        what = str(first["ctx"]["error"])
        return Note("key.value", f"'{key}': {what}{_describe_key(loc, model)}" if key else what)
    if first["type"] in ("model_type", "model_attributes_type"):
        return Note("key.table", f"'{key}' must be a table: [{key}]")
    what = f"{rephrase(first['msg'])}{_describe_key(loc, model)}"
    return Note("key.value", f"'{key}' = {shorten(first['input'])}: {what}")


def rephrase(message: str) -> str:
    """Rephrase Pydantic's "should be" as "must be"."""
    words = re.sub(r"Input should (.*?)(, (unable to|got) .*)?$", r"must \1", message)
    return (
        words.replace("a valid string", "a text in quotes")
        .replace("a valid integer", "a whole number")
        .replace("a valid ", "a ")
    )


def shorten(value: Any) -> str:
    """Quote a value of a file, shortened if it is long."""
    text = repr(value)
    return text if len(text) <= _MAX_QUOTED else f"{text[:_MAX_QUOTED]}..."


def suggest_nearest(name: str, known: Sequence[str]) -> str:
    """The known name nearest to `name`, or the only one that it begins, as a question; or a list of all known names."""
    close = difflib.get_close_matches(name, known, n=1)
    longer = [one for one in known if name and one.startswith(name)]
    if close or len(longer) == 1:
        return f"did you mean '{(close or longer)[0]}'?"
    return f"known: {', '.join(known[:_MAX_NAMES]) or 'none'}{', ...' * (len(known) > _MAX_NAMES)}"


def split_names(text: str, known: Sequence[str], option: str, what: str) -> tuple[str, ...]:
    """Split the value of an option at its commas; each name once.

    Raises
    ------
    ConfigError
        If one is not known, or there is none.
    """
    names = tuple(dict.fromkeys(name.strip().lstrip(".") for name in text.split(",") if name.strip()))
    for name in names:
        if name not in known:
            raise ConfigError(
                f"{option} {text}: no {what} '{name}'; known: {', '.join(known)}", key="option.unknown_name"
            )
    if not names:
        raise ConfigError(f"{option}: names no {what}; known: {', '.join(known)}", key="option.no_name")
    return names


def _list_tables(model: type[BaseModel], at: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], type[BaseModel]]]:
    """Every table of a file by its place, the file's top level first."""
    from pydantic import BaseModel

    yield at, model
    for name, field in model.model_fields.items():
        options = (field.annotation, *getattr(field.annotation, "__args__", ()))
        for inner in options:
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                yield from _list_tables(inner, (*at, name))


def _suggest(loc: tuple[str, ...], model: type[BaseModel]) -> str:
    """'; did you mean ...' with the nearest key of the table that `loc` is in, else of any table."""
    tables = dict(_list_tables(model))
    here = loc[:-1]
    while here not in tables:
        here = here[:-1]
    known = list(tables[here].model_fields)
    elsewhere: dict[str, tuple[str, ...]] = {}
    for at, table in tables.items():
        for name in table.model_fields if at else ():
            elsewhere.setdefault(name, at)
    if loc[-1] in elsewhere:
        return f"; did you mean '{loc[-1]}' in [{'.'.join(elsewhere[loc[-1]])}]?"
    if model.__name__ == "Settings" and loc[-1] in _OF_RECORDINGS:
        return "; it is a key of recording.toml"
    if close := difflib.get_close_matches(loc[-1], known, n=1, cutoff=0.5):
        return f"; did you mean '{close[0]}'?"
    if close := difflib.get_close_matches(loc[-1], list(elsewhere), n=1, cutoff=0.8):
        return f"; did you mean '{close[0]}' in [{'.'.join(elsewhere[close[0]])}]?"
    return f"; known keys: {', '.join(known)}"


def _describe_key(loc: tuple[str, ...], model: type[BaseModel]) -> str:
    """The unit and description of a key, in brackets."""
    tables = dict(_list_tables(model))
    for n in range(len(loc), 0, -1):  # an entry of a tuple is described by the key of the tuple
        field = tables[loc[: n - 1]].model_fields.get(loc[n - 1]) if loc[: n - 1] in tables else None
        if field is not None:
            return f" ({field.description})" if field.description else ""
    return ""


def _find_line(text: str, loc: tuple[str, ...]) -> int | None:
    """The line (1-based) of a key, or of the header of its table if the key is absent."""
    table: tuple[str, ...] = ()
    found, depth = None, 0
    for number, line in enumerate(text.splitlines(), 1):
        at: tuple[str, ...] = ()
        if opening := _TABLE_HEAD.match(line.strip()):
            at = table = tuple(part.strip(" \"'") for part in opening[1].split("."))
        elif key := _KEY.match(line.strip()):
            at = (*table, *(part.strip("\"'") for part in key[1].split(".")))
        if len(at) > depth and at == loc[: len(at)]:
            found, depth = number, len(at)
    return found
