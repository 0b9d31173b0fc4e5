"""The rooms: packages that import one way, and heavy libraries that stay in theirs."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from helpers import parse_code

PACKAGE = Path(__file__).resolve().parents[1] / "graphnav"

# The packages, and those that each may import from. What is not named here is not a room.
ROOMS = {
    "core": [],
    "sensors": ["core"],
    "config": ["core", "sensors"],
    "gnss": ["core"],
    "recording": ["core", "sensors", "config", "gnss"],
    "imu": ["core", "config", "recording"],
    "detectors": ["core", "config", "recording"],
    "simulation": ["core", "sensors", "recording"],
    "constraints": ["core", "sensors", "config", "gnss", "recording", "imu"],
    "estimation": ["core", "config", "gnss", "recording", "imu", "detectors", "constraints"],
    "online": ["core", "sensors", "config", "gnss", "recording", "imu", "detectors", "constraints", "estimation"],
    "evaluation": ["core", "recording", "estimation"],
    "report": ["core", "recording", "detectors", "estimation", "evaluation"],
    "app": [
        "core", "sensors", "config", "recording", "imu", "detectors", "simulation", "constraints", "estimation",
        "online", "evaluation", "report",
    ],
    "__main__": ["app"],
}  # fmt: skip

GTSAM_ROOMS = {"estimation/factor_graph"}
MATPLOTLIB_ROOMS: set[str] = set()  # pictures are drawn in the reader's browser
PRINTING = {"app/talk.py"}

FILES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The first part of the path inside the package; '' for the package's own __init__."""
    first = path.relative_to(PACKAGE).parts[0]
    return "" if first == "__init__.py" else first.removesuffix(".py")


@cache
def read_code(path: Path) -> tuple[set[str], bool]:
    """Dotted names of everything a file imports, at its top or inside functions; and whether it prints."""
    names, prints = set[str](), False
    for node in parse_code(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import; name the module in full"
            assert node.module is not None
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call):
            prints |= isinstance(node.func, ast.Name) and node.func.id == "print"
    return names, prints


def rooms_used(path: Path) -> set[str]:
    """Rooms of graphnav that a file imports from."""
    own = {name.split(".")[1] for name in read_code(path)[0] if name.startswith("graphnav.")}
    return {room for room in own if (PACKAGE / room).is_dir() or (PACKAGE / f"{room}.py").exists()}


def test_every_room_is_named_and_imports_go_one_way():
    assert {room_of(path) for path in FILES} - {""} == set(ROOMS)
    seen: set[str] = set()
    for room, others in ROOMS.items():
        assert set(others) <= seen, f"{room} imports from a room that comes after it"
        seen.add(room)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_from_what_it_names(room):
    used = {other for path in FILES if room_of(path) == room for other in rooms_used(path)} - {room}
    assert used == set(ROOMS[room])


@pytest.mark.parametrize(("library", "rooms"), [("gtsam", GTSAM_ROOMS), ("matplotlib", MATPLOTLIB_ROOMS)])
def test_heavy_libraries_stay_in_their_rooms(library, rooms):
    users = [path for path in FILES if any(name.split(".")[0] == library for name in read_code(path)[0])]
    assert {path.parent.relative_to(PACKAGE).as_posix() for path in users} == rooms


def test_solvers_know_nothing_of_the_factor_graph():
    users = [path for path in FILES if path.parent == PACKAGE / "estimation" / "solvers"]
    assert users
    assert not [path for path in users for name in read_code(path)[0] if "factor_graph" in name]


def test_only_the_command_line_prints():
    assert {str(path.relative_to(PACKAGE)) for path in FILES if read_code(path)[1]} == PRINTING


def loaded(*arguments: str) -> set[str]:
    """The modules there after the program has run on some arguments."""
    code = (
        f"import sys; import graphnav.app.cli as c; assert c.run({list(arguments)!r}) == 0; print(sorted(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = set(ast.literal_eval(run.stdout.splitlines()[-1]))
    assert "graphnav.app.cli" in names
    return names


@pytest.mark.parametrize(
    ("arguments", "more"),
    [(("--help",), {"pydantic"}), (("smooth", "--help"), set())],  # typer looks for pydantic itself
)
def test_help_loads_nothing_heavy(arguments, more):
    heavy = {"gtsam", "matplotlib", "numpy", "plotly", "pyarrow", "rich", "scipy", "yaml"} | more
    assert not heavy & loaded(*arguments)


def test_a_run_loads_only_what_it_needs(tmp_path, shared_data):
    # that draws nothing, of a filter, on a recording that needs no alignment in motion
    found = loaded(
        "smooth", str(shared_data / "openshoe_loops" / "run02.toml"), "--solver", "ekf", "--end", "20", "--no-report",
        "--quiet", "-o", str(tmp_path / "out"),
    )  # fmt: skip
    # yaml is not among them: Numba reads its own settings with it
    rare = {"distributed", "matplotlib", "plotly", "pyarrow", "pynmeagps", "pyubx2", "rich", "rosbags"}
    parts = {f"scipy.{part}" for part in ("interpolate", "optimize", "signal", "sparse", "spatial", "stats")}
    own = {
        f"graphnav.{name}"
        for name in (
            "recording.draft",
            "gnss.load",
            "report.documents",
            "online",
            "estimation.antenna",
            "simulation",
            "app.fleet",
        )
    }
    assert not (rare | parts | own | {"gtsam"}) & found


def test_constraints_are_linearised_in_one_place_and_solvers_know_none_of_them() -> None:
    """Beside `linearise` only a constraint that is made of another asks it for its rows."""
    callers, known, typed = set(), set(), set()
    for path in FILES:
        name = path.relative_to(PACKAGE).as_posix()
        calls = [node for node in parse_code(path) if isinstance(node, ast.Call)]
        if any(isinstance(c.func, ast.Attribute) and c.func.attr == "linearize" and len(c.args) > 1 for c in calls):
            callers.add(name)
        if name.startswith(("estimation/solvers/", "estimation/factor_graph/")):
            known |= {one for one in read_code(path)[0] if one.startswith("graphnav.constraints.")}
            typed |= {name for c in calls if isinstance(c.func, ast.Name) and c.func.id == "isinstance"}
    assert callers == {"estimation/solvers/linearise.py", "estimation/noise/explanations.py"}
    base = "graphnav.constraints.base."
    assert known == {base + one for one in ("Constraint", "Linearized", "assemble", "weigh_sigma")}
    assert not typed
