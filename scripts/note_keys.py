"""The page docs/keys.md: the keys of all notes, findings and errors, read off the code.

python scripts/note_keys.py > docs/keys.md
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAD = """\
# Keys of notes, findings and errors

What a run says of a recording and of itself is in `messages` of `summary.json` and `findings` of `graphnav info
--json`: a `key` that stays the same, a `severity` and a `sentence`. In a report the key is the `data-key` of the
sentence's element. `*` stands for the name of a sensor or of what a row is about. `python scripts/note_keys.py` makes
this list from the code.

"""
ERRORS = """
Errors have keys as well, `key` of a `graphnav.GraphnavError`:

"""
TABLE = "| what | keys |\n| --- | --- |\n"


def _text(node: ast.expr) -> str | None:
    """A string of the code, with * for what is filled in; None of anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else "*" for v in node.values)
    return None


def _key(call: ast.Call) -> str | None:
    """The key that a call gives to a note or a finding."""
    name = call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
    if name == "Note" or (name == "add" and ast.unparse(call.func).endswith(("notes.add", "remarks.add"))):
        return _text(call.args[0])
    if name == "Finding" and len(call.args) > 2:
        return _text(call.args[2])
    if name == "Finding" and (named := [k.value for k in call.keywords if k.arg == "key"]):
        return _text(named[0])
    return None


def _error_key(call: ast.Call) -> str | None:
    """The key that a call gives to an error, whose class may be an argument called `error`."""
    name = call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
    named = [k.value for k in call.keywords if k.arg == "key"]
    return _text(named[0]) if named and name.lower().endswith("error") else None


def list_calls() -> list[ast.Call]:
    """All calls of the code."""
    return [
        node
        for path in sorted((ROOT / "graphnav").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
    ]


def list_keys(calls: list[ast.Call], key_of: Callable[[ast.Call], str | None]) -> list[str]:
    """The keys that calls give, sorted."""
    return sorted({key for call in calls if (key := key_of(call))})


def _table(keys: list[str]) -> str:
    """A row for each first part of the keys."""
    groups = defaultdict(list)
    for key in keys:
        first, _, rest = key.partition(".")
        groups[first].append(f"`{rest}`")
    return TABLE + "".join(f"| `{name}.` | {', '.join(some)} |\n" for name, some in groups.items())


def page() -> str:
    """docs/keys.md."""
    calls = list_calls()
    return HEAD + _table(list_keys(calls, _key)) + ERRORS + _table(list_keys(calls, _error_key))


if __name__ == "__main__":
    print(page(), end="")
