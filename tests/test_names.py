"""Names: functions are verbs, and a name that modules share means one thing."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "graphnav"
# words that no function begins with; methods may return a changed copy (`without`) or convert (`to_dict`)
NO_VERBS = {
    "about", "again", "ahead", "along", "always", "as", "at", "before", "between", "beyond", "by", "found", "in",
    "judged", "moved", "near", "new", "next", "no", "none", "of", "on", "other", "over", "own", "posed", "since",
    "some", "through", "under", "until", "whole", "with", "within", "without", "worst",
}  # fmt: skip
# what has the same name in several modules: the interfaces of formats and sensors, a command and what it runs
SHARED = {
    "FORMAT", "SCENARIOS", "SENSOR", "Index", "Span", "check_own", "detect", "evaluate", "free", "load", "main",
    "open_writer", "recognises", "run", "simulate",
}  # fmt: skip


def read_definitions() -> list[tuple[Path, ast.stmt]]:
    """Every statement at the top of a module."""
    return [(path, node) for path in sorted(PACKAGE.rglob("*.py")) for node in ast.parse(path.read_text()).body]


def test_no_function_begins_with_a_preposition_or_an_adjective() -> None:
    functions = [node for _, node in read_definitions() if isinstance(node, ast.FunctionDef)]
    assert len(functions) > 1000
    assert not [f.name for f in functions if f.name.strip("_").split("_")[0] in NO_VERBS]
    assert not [f.name for f in functions if f.name.endswith("_of")]


def test_a_public_name_is_defined_once() -> None:
    places = defaultdict(set)
    for path, node in read_definitions():
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            places[node.name].add(path)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                if isinstance(target, ast.Name):
                    places[target.id].add(path)
    several = {name for name, where in places.items() if len(where) > 1 and not name.startswith("_")}
    assert several - {"commands"} == SHARED
