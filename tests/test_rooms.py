"""The order of the rooms: a module imports only from rooms to its left, heavy libraries stay in theirs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "graphnav"

# Modules and packages of graphnav, left to right. A new one needs a place here, as far left as it can stand.
ROOMS = [
    "errors", "files", "complaints", "plain", "progress", "rotation", "timescales", "earth", "raw", "state", "config",
    "recording", "trajectory", "findings", "sample_size", "formats", "allan", "lags", "crosschecks", "clock", "draft",
    "simulation", "wheels", "checks_imu", "checks_stated", "checks_aiding", "checks_raw", "plausibility_gnss",
    "plausibility_odometer", "plausibility", "checks", "detectors", "samples", "noise_model",
    "preintegration", "own_noise", "unresolved", "clipping", "dynamics", "constraints", "problem", "solution", "stops",
    "long_drives",
    "alignment", "dense", "solvers", "faults", "noise", "onboard_offset", "preparation", "pipeline", "lever_arm",
    "interpolation", "metrics", "sigmas", "gates", "fitted", "scoring", "strides", "evaluation", "against", "exporters",
    "online",
    "plots", "page", "report_names", "segments", "report_tables", "report_words", "report_pictures", "report_summary",
    "report_provenance", "report",
    "workflow", "stored", "staging", "outputs", "convert", "fleet", "terminal", "detection_report",
    "talk", "cli_options", "cli_fleet", "cli_logs", "cli_online", "cli_solve", "cli", "__main__",
]  # fmt: skip

GTSAM_ROOMS = {"solvers"}
MATPLOTLIB_ROOMS = {"allan"}
PRINTING_ROOMS = {"talk"}

FILES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    """The first part of the path inside the package; '' for the package's own __init__."""
    first = path.relative_to(PACKAGE).parts[0]
    return "" if first == "__init__.py" else first.removesuffix(".py")


def imported(path: Path) -> set[str]:
    """Dotted names of everything a file imports, at its top or inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import; name the module in full"
            assert node.module is not None
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def rooms_used(path: Path) -> set[str]:
    """Rooms of graphnav that a file imports from."""
    own = {name.split(".")[1] for name in imported(path) if name.startswith("graphnav.")}
    return {room for room in own if (PACKAGE / room).is_dir() or (PACKAGE / f"{room}.py").exists()}


def test_every_room_has_its_place_and_every_place_its_room():
    assert {room_of(path) for path in FILES} - {""} == set(ROOMS)
    assert len(set(ROOMS)) == len(ROOMS)


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_come_from_the_left(path):
    room = room_of(path)
    if not room:
        return  # the package's own names are found when first used, see test_help_loads_nothing_heavy
    place = ROOMS.index(room)
    to_the_right = {other for other in rooms_used(path) if other != room and ROOMS.index(other) > place}
    assert not to_the_right, f"{room} stands left of {', '.join(sorted(to_the_right))}"


@pytest.mark.parametrize(("library", "rooms"), [("gtsam", GTSAM_ROOMS), ("matplotlib", MATPLOTLIB_ROOMS)])
def test_heavy_libraries_stay_in_their_rooms(library, rooms):
    users = {room_of(path) for path in FILES if any(name.split(".")[0] == library for name in imported(path))}
    assert users == rooms


def test_only_the_command_line_prints():
    printing = {
        room_of(path)
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    }
    assert printing == PRINTING_ROOMS


def loaded(*arguments: str) -> set[str]:
    """The modules there after the program has run on some arguments."""
    code = (
        f"import sys; import graphnav.app.cli as c; assert c.run({list(arguments)!r}) == 0; print(sorted(sys.modules))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = set(ast.literal_eval(run.stdout.splitlines()[-1]))
    assert "graphnav.app.cli" in names
    return names


@pytest.mark.parametrize("arguments", [("--help",), ("smooth", "--help")])
def test_help_loads_nothing_heavy(arguments):
    heavy = {"gtsam", "matplotlib", "numpy", "plotly", "pyarrow", "rich", "scipy", "yaml"}
    assert not heavy & loaded(*arguments)


def test_a_run_loads_only_what_it_needs(tmp_path, shared_data):
    # that draws nothing, of a filter, on a recording that needs no alignment in motion
    found = loaded(
        "smooth", str(shared_data / "openshoe_loops" / "run02.toml"), "--solver", "ekf", "--end", "20", "--no-report",
        "--quiet", "-o", str(tmp_path / "out"),
    )  # fmt: skip
    rare = {"distributed", "matplotlib", "plotly", "pyarrow", "pynmeagps", "pyubx2", "rich", "rosbags", "yaml"}
    parts = {f"scipy.{part}" for part in ("interpolate", "optimize", "signal", "sparse", "spatial", "stats")}
    own = {f"graphnav.{name}" for name in ("draft", "raw.load", "report", "online", "lever_arm", "simulation", "fleet")}
    assert not (rare | parts | own | {"gtsam"}) & found
