"""The documentation does what it says: its commands and its Python run, its links lead somewhere."""

from __future__ import annotations

import argparse
import ast
import inspect
import multiprocessing
import pkgutil
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import traceback
import types
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import matplotlib
import numpy as np
import oracle
import pytest
from helpers import STEPS, difference, random_states

import graphnav
from graphnav.app import cli
from graphnav.config import Settings, read_settings
from graphnav.constraints import list_constraints
from graphnav.constraints.base import BuildContext, assemble
from graphnav.core.earth import LocalFrame
from graphnav.core.notes import get_key
from graphnav.detectors import detect
from graphnav.detectors import list_detectors as known_detectors
from graphnav.detectors.scene import Scene
from graphnav.estimation.pipeline import SOLVERS
from graphnav.imu.preintegration import preintegrate
from graphnav.imu.samples import bridge_gaps
from graphnav.recording.formats import read

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "data").rglob("*.md"))]
# a fence may be indented, as in a list
FENCE = re.compile(r"^( *)```(\w+)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)
EXAMPLE = re.compile(r"^--8<--\n(docs/examples/\w+\.py)\n--8<--\n", re.MULTILINE)


def text_without(indent, text):
    """Lines without what they are indented by."""
    return re.sub(rf"^{indent}", "", text, flags=re.MULTILINE)


def blocks(kind):
    """(page, text) of every fenced block of a kind, with the examples that it names in their places."""
    return [
        (page, EXAMPLE.sub(lambda found: (ROOT / found[1]).read_text(encoding="utf-8"), text_without(indent, text)))
        for page in PAGES
        for indent, found, text in FENCE.findall(page.read_text(encoding="utf-8"))
        if found == kind
    ]


# the commands of a block belong together: one may need what another wrote
BLOCKS = {
    lines
    for _, text in blocks("console")
    if (lines := "\n".join(line for line in text.splitlines() if not line.startswith("make ")))
}
# what another block begins with is run there
COMMANDS = sorted(lines for lines in BLOCKS if not any(other.startswith(f"{lines}\n") for other in BLOCKS))
PYTHON = blocks("python")


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder that looks like the clone from inside, to run in: the recordings are there."""
    shutil.copytree(ROOT / "data", tmp_path / "data")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_pages_show_commands_and_python():
    assert any("graphnav compare " in lines for lines in COMMANDS)
    assert any(page.name == "README.md" for page, _ in PYTHON)


@pytest.mark.parametrize("lines", COMMANDS)
def test_commands_run(lines, clone, capsys):
    if lines.startswith("graphnav fleet "):  # whose drives are solved by commands of their own
        shutil.rmtree(clone / "data" / "kamakura_rtk")
    for line in lines.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "graphnav", "a console block holds commands of graphnav and make; use another kind for others"
        assert cli.run(arguments) == 0, capsys.readouterr().err


SHOWN = [text for _, text in blocks("text") if text.startswith("$ graphnav ")]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]\d+)?")


@pytest.mark.parametrize("text", SHOWN, ids=lambda text: text.splitlines()[0])
def test_what_a_page_shows_of_a_command_is_what_it_prints(text, clone, capsys):
    """Word for word; numbers nearly, but for run times; a line of dots stands for some."""
    command, *shown = text.splitlines()
    _, *arguments = shlex.split(command.removeprefix("$ "))
    capsys.readouterr()
    assert cli.run(arguments) == 0
    printed = capsys.readouterr().out.splitlines()
    if "  ..." in shown:
        k = shown.index("  ...")
        rest = len(shown) - k - 1
        shown, printed = shown[:k] + shown[-rest:], printed[:k] + printed[-rest:]
    assert [NUMBER.sub("#", " ".join(line.split())) for line in shown] == [
        NUMBER.sub("#", " ".join(line.split())) for line in printed
    ]
    timed = False
    for one, other in zip(shown, printed, strict=True):
        timed = one.endswith("seconds") or (timed and one.startswith("  "))
        numbers = [[float(x) for x in NUMBER.findall(line)] for line in (one, other)]
        last = -1 if timed and numbers[0] else None
        assert numbers[0][:last] == pytest.approx(numbers[1][:last], rel=0.05, abs=0.02)


def run_alone(text, said):
    """Run Python as a program would, in a copy of this process: nothing that it registers or draws stays here."""
    with said.open("w", encoding="utf-8") as file, redirect_stdout(file), redirect_stderr(file):
        matplotlib.use("Agg", force=True)
        warnings.resetwarnings()
        warnings.filterwarnings("error", category=DeprecationWarning, module="__main__")
        sys.modules["__main__"] = module = types.ModuleType("__main__")
        try:
            exec(compile(text, "<page>", "exec"), module.__dict__)
        except BaseException:
            traceback.print_exc(file=file)
            raise


@pytest.mark.parametrize(("page", "text"), PYTHON, ids=[f"{page.stem}-{k}" for k, (page, _) in enumerate(PYTHON)])
def test_python_runs(page, text, clone):
    said = clone / "said.txt"
    process = multiprocessing.get_context("fork").Process(target=run_alone, args=(text, said))
    process.start()
    process.join(300)
    assert process.exitcode == 0, said.read_text(encoding="utf-8")
    for name in re.findall(r'savefig\("(.+?)"\)', text):
        assert (clone / name).stat().st_size > 5000


def test_the_readme_goes_from_a_recording_to_a_plot_in_five_lines():
    (text,) = [text for page, text in PYTHON if page.name == "README.md"]
    assert len([line for line in text.splitlines() if line.strip()]) == 5


def test_make_demo_is_what_the_readme_shows():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (demo,) = re.findall(
        r"^\t\$\(BIN\)/(graphnav compare .*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert any(page.name == "README.md" and text.startswith(f"$ {demo}\n") for page, text in blocks("text"))
    assert "source .venv/bin/activate" in readme


def test_the_picture_is_what_its_command_draws():
    """Of data in the clone: the command is kept in it."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"`python (scripts/picture\.py [^`]+)`", readme)
    _, recording, *_ = shlex.split(command)
    assert (ROOT / recording / "recording.toml").exists()
    assert f"Description\0{command}: ".encode() in (ROOT / "docs" / "outage.png").read_bytes()


def test_the_example_of_a_constraint_keeps_the_contract():
    module = example()
    recording, _ = oracle.drive(oracle.vehicle_path(120.0, 50.0))
    t = np.arange(recording.start, recording.end, 5.0)
    intervals = preintegrate(bridge_gaps(recording.imu), recording.imu, t, np.zeros(3), np.zeros(3))
    frame = LocalFrame(recording.gnss.llh[0])
    rows = module.NotSteep.build(BuildContext(recording, Settings(), frame, t, np.empty((0, 2)), intervals))
    states = random_states(np.random.default_rng(0), len(rows))
    found = rows.linearize(states, {}, slice(None))
    assert found.residual.shape == found.sigma.shape == (len(t), 1)
    assert found.residual[:, 0] == pytest.approx(states.v[:, 2])

    def moved(delta):
        return rows.linearize(states.plus(np.tile(delta, (len(rows), 1))), {}, slice(None)).residual

    assert assemble(found) == pytest.approx(difference(moved, STEPS), abs=1e-8)


def example():
    """The classes that the example of a constraint and a detector defines, without what it then runs."""
    path = ROOT / "docs" / "examples" / "own.py"
    module = types.ModuleType("own")
    sys.modules[module.__name__] = module
    defined, _, _ = path.read_text(encoding="utf-8").partition("\n\n\nrecording = ")
    exec(compile(defined, path, "exec"), module.__dict__)
    return module


def test_the_example_of_a_detector_finds_the_stops():
    module = example()
    recording, settings = read(ROOT / "data" / "tokyo"), Settings().detectors
    found, known = module.Steady.detect(Scene(recording, settings)), detect(recording).stationary
    assert len(found.t) == len(found.statistic) == len(found.mask)
    middle = known.mean(axis=1)[:, None]
    inside = (found.intervals[:, 0] < middle) & (middle < found.intervals[:, 1])
    assert inside.any(axis=1).all()
    nothing = module.Steady.detect(Scene(recording.crop(0.0, 1.0), settings))
    assert len(nothing.intervals) == 0


def test_own_constraints_and_detectors_are_used_together():
    constraint, detector = example().NotSteep, example().Steady
    recording = read(ROOT / "data" / "tokyo").crop(0.0, 60.0)
    stated = Settings(noise={"mode": "stated"})
    solution = graphnav.run(recording, stated, ("ekf",), constraints=[constraint], detectors=[detector])["ekf"]
    assert solution.counts["not_steep"] == len(solution.t)
    assert "steady" in [found.name for found in solution.detections]
    assert "constraint.differences" in map(get_key, solution.notes)


def test_the_site_builds_and_every_link_in_it_leads_somewhere(tmp_path):
    """Strict: a page that is in no menu, a link, an anchor or a name that is not there fails it."""
    command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", tmp_path / "site"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stderr
    reference = (tmp_path / "site" / "api.html").read_text(encoding="utf-8")
    for name in (
        "graphnav.estimation.pipeline.run",
        "graphnav.recording.Imu.gyro",
        "graphnav.core.errors.GraphnavError",
    ):
        assert f'id="{name}"' in reference
    assert "(K, 3) latitude, longitude (rad), ellipsoidal height (m)" in reference  # units of the fields


LISTED = re.findall(r"^::: ([\w.]+)", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("name", LISTED)
def test_the_reference_says_what_goes_in_and_comes_out(name):
    """Of every function: each parameter by its name, and what is returned; of every class and field: something."""
    found = pkgutil.resolve_name(name)
    own = [v for k, v in vars(found).items() if not k.startswith("_") and getattr(v, "__module__", "") == name]
    own = own if inspect.ismodule(found) else [found]
    methods = [getattr(c, k) for c in own if inspect.isclass(c) for k in vars(c) if not k.startswith("_")]
    for one in (*own, *(m for m in methods if inspect.isfunction(m) or inspect.ismethod(m))):
        text = inspect.getdoc(one) or ""
        assert text, one
        if inspect.isfunction(one) or inspect.ismethod(one):
            signature = inspect.signature(one)
            given = [p for p in signature.parameters if p not in ("self", "cls")]
            missing = [p for p in given if not re.search(rf"^\*?\*?(?:\w+, )*{p}\b", text, re.MULTILINE)]
            assert not missing, f"{one.__name__}: {missing}"
            assert "Returns\n-------" in text or signature.return_annotation == "None", one.__name__


def test_every_table_of_an_experiment_names_its_command_and_commit():
    for page in sorted((ROOT / "docs" / "experiments").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        runs = re.findall(
            r"^```sh\npython (scripts/\w+\.py)\b.*\n```\n\n(?:Printed|Entered) by commits? `[0-9a-f]{7,}`",
            text,
            re.MULTILINE,
        )
        assert len(runs) == text.count("```sh") > 0, page.name
        assert all((ROOT / script).exists() for script in runs), page.name
        before, _, _ = text.partition("```sh")
        assert "| --- " not in before, f"{page.name}: a table that no command printed"


SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))
PRINTED = sorted({line for _, text in blocks("sh") for line in text.splitlines() if line.startswith("python scripts/")})


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_uses_only_options_that_it_has(script):
    names, known = set(), {"get"}
    tree = ast.parse(script.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        called = node.func.attr if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else None
        if called in ("add_argument", "add_subparsers"):
            known |= {word.value.lstrip("-").replace("-", "_") for word in node.args if isinstance(word, ast.Constant)}
            known |= {word.value.value for word in node.keywords if word.arg == "dest"}
        if isinstance(node, ast.Assign) and ".parse_args(" in ast.unparse(node.value):
            names |= {ast.unparse(target) for target in node.targets}
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and ast.unparse(node.value) in names]
    known |= {node.attr for node in found if isinstance(node.ctx, ast.Store)}
    used = {node.attr for node in found}
    assert used <= known


@pytest.mark.parametrize("line", PRINTED)
def test_the_commands_of_experiments_are_understood(line, monkeypatch):
    """As far as their options, by their own parsers: the runs take hours."""
    _, script, *arguments = shlex.split(line)
    understood = argparse.ArgumentParser.parse_args

    def parse(parser, *words, **how):
        understood(parser, *words, **how)
        raise StopIteration  # before it runs

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    monkeypatch.syspath_prepend(ROOT / "scripts")
    monkeypatch.chdir(ROOT)
    if "argparse" in (ROOT / script).read_text(encoding="utf-8"):
        with pytest.raises(StopIteration):
            runpy.run_path(script, run_name="__main__")
    else:
        assert not arguments


def test_toml_examples_are_valid(tmp_path):
    shown = [text for _, text in blocks("toml")]
    settings = [text for text in shown if "format = " not in text]
    assert settings
    for text in settings:
        (tmp_path / "settings.toml").write_text(text, encoding="utf-8")
        read_settings(tmp_path / "settings.toml")
    recordings = [text for text in shown if "format = " in text]
    assert recordings
    t = np.arange(1, 3001) / 100.0
    columns = {
        "imu": ("t,gx,gy,gz,ax,ay,az", [t, *np.zeros((5, len(t))), np.full(len(t), -9.8)]),
        "gnss": ("t,lat,lon,h", [t[99::100], np.full(30, 48.0), np.full(30, 11.0), np.full(30, 500.0)]),
        "odometer": ("t,speed", [t[9::10], np.zeros(300)]),
        "truth": ("t,lat,lon,h", [t[99::100], np.full(30, 48.0), np.full(30, 11.0), np.full(30, 500.0)]),
    }
    for name, (header, values) in columns.items():
        np.savetxt(tmp_path / f"{name}.csv", np.column_stack(values), delimiter=",", header=header, comments="")
    for text in recordings:
        (tmp_path / "recording.toml").write_text(text, encoding="utf-8")
        found = read(tmp_path)
        if 'axes = "FRD"' in text:
            assert found.imu.accel[0] == pytest.approx([0.0, 0.0, 9.8])  # at rest, turned to RFU
            assert found.gnss.lever_arm == pytest.approx([0.3, 0.5, 1.2])


def test_every_constraint_detector_and_solver_has_its_line():
    constraints = (ROOT / "docs" / "constraints.md").read_text(encoding="utf-8")
    solvers = (ROOT / "docs" / "solvers.md").read_text(encoding="utf-8")
    for cls in list_constraints():
        if cls.sensor:  # told in its own file, so that a sensor is that, the sensor's file and a test
            assert re.search(r"^    \S", sys.modules[cls.__module__].__doc__ or "", re.MULTILINE), f"{cls}: no residual"
        else:
            assert re.search(rf"^\| `{cls.name}` \|", constraints, re.MULTILINE), f"docs: no row {cls.name}"
    detectors = (ROOT / "docs" / "detectors.md").read_text(encoding="utf-8")
    for name in known_detectors():
        assert re.search(rf"^\| `{name}` \|", detectors, re.MULTILINE), f"docs/detectors.md: no row {name}"
    for name in SOLVERS:
        assert re.search(rf"^\| `{name}` \|", solvers, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_named_exist(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name}: {target}"
    for name in re.findall(r"`((?:graphnav|scripts|tests|docs)/[\w/]+\.\w+)", text):
        assert (ROOT / name).exists(), f"{page.name}: {name}"
