"""Files of a run: trajectories, calibration, summary and report per solver, and the comparison."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from graphnav.app import stored
from graphnav.app.scores import find_outages
from graphnav.app.stored import write_outcome
from graphnav.app.summary import gather_provenance, list_noise_figures, summarise_solver, tabulate_comparison
from graphnav.app.workflow import Outcome
from graphnav.core.beside import begin_beside
from graphnav.core.errors import ConfigError, PartlyWrittenError
from graphnav.core.files import exists
from graphnav.core.jsonable import write_json
from graphnav.core.timescales import gps_to_utc
from graphnav.estimation.solution import ParameterEstimate
from graphnav.estimation.stops import format_detections
from graphnav.evaluation.against import select_own

if TYPE_CHECKING:
    from markupsafe import Markup

    from graphnav.evaluation.metrics import Metrics


FILES = (
    "trajectory.csv", "trajectory.kml", "trajectory.gpx", "trajectory.tum", "calibration.json", "detections.csv",
    "summary.json", "report.html", "comparison.csv", "comparison.html",
)  # fmt: skip


def check_output_folder(path: str | Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Path:
    """`path`, checked to be a folder that can be created or written to; it is not created yet.

    Parameters
    ----------
    files, folders : what is to be written there: nothing of another kind may be in the way.

    Raises
    ------
    ConfigError
        If it cannot.
    """
    folder = Path(path)
    there = folder
    while not exists(there, ConfigError) and there != there.parent:
        there = there.parent
    broken = next((place for place in (folder, *folder.parents) if place.is_symlink() and not place.exists()), None)
    if broken is not None:
        raise ConfigError(f"-o {folder}: {broken} is a broken link", key="output.cannot_write")
    if not there.is_dir():
        what = "is a file; name a folder to write into" if there == folder else f"cannot be made, {there} is a file"
        raise ConfigError(f"-o {folder}: {what}", key="output.cannot_write")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"-o {folder}: no permission to write into {there}", key="output.cannot_write")
    try:  # a read-only file system, a name that is too long or invalid: found by trying
        (folder / max(FILES, key=len)).resolve().exists()
        os.rmdir(tempfile.mkdtemp(prefix=".graphnav-", dir=there))
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"-o {folder}: nothing can be written into {there} ({why})", key="output.cannot_write"
        ) from None
    for name in files:
        if (folder / name).is_dir():
            raise ConfigError(
                f"-o {folder}: {name} is a folder there, and a file of that name is to be written",
                key="output.cannot_write",
            )
    for name in folders:
        if exists(folder / name, ConfigError) and not (folder / name).is_dir():
            raise ConfigError(
                f"-o {folder}: {name} is a file there, and a folder of that name is to be written",
                key="output.cannot_write",
            )
    return folder


def list_results(folders: Sequence[str]) -> tuple[str, ...]:
    """The names of the files that a run writes: of each solver's folder, or of the run's if there are none."""
    return (*FILES, stored.RUN_FILE, *(f"{folder}/{name}" for folder in folders for name in FILES))


def write_run(outcome: Outcome, folder: Path, pages: bool = True) -> list[Path]:
    """Write all files of a run with a single solver into `folder`; returns the files to look at first.

    Without `pages` none is drawn; `draw_again` can do that later.
    """
    (name,) = select_own(outcome.solutions)
    provenance = gather_provenance(outcome)
    failed = write_solver(outcome, name, folder, provenance, pages=pages)
    kept = replace(outcome, alone=True)
    failed |= _attempt(lambda path: write_outcome(kept, provenance, path), folder / stored.RUN_FILE)
    _insist(failed)
    return [*([folder / "report.html"] if pages else []), folder / "trajectory.csv", folder / "summary.json"]


def write_comparison_files(outcome: Outcome, folder: Path, pages: bool = True) -> list[Path]:
    """Write all files of each solver under its name, and the table and page that compare them; `pages` as in
    `write_run`.
    """
    from graphnav.evaluation.metrics import write_comparison_csv

    detectors = None
    with ThreadPoolExecutor(1) as beside:
        if pages:
            from graphnav.report import documents as report
            from graphnav.report.page import read_library

            library = beside.submit(read_library)  # once, before there are two processes
            detectors = report.draw_detectors(outcome.recording, next(iter(outcome.solutions.values())))
        provenance = gather_provenance(outcome)  # which reads the files again
        if pages:
            with suppress(ConfigError):  # each page says what is missing
                library.result()
    first, *others = select_own(outcome.solutions)

    def write(names: Sequence[str]) -> dict[Path, str]:
        each = (write_solver(outcome, name, folder / name, provenance, detectors, pages) for name in names)
        return {path: why for failed in each for path, why in failed.items()}

    writing = begin_beside(partial(write, others))
    failed = write([first])
    write_comparison_csv(folder / "comparison.csv", tabulate_comparison(outcome))
    if pages:
        failed |= _attempt(lambda path: _draw_comparison(outcome, path.parent, provenance), folder / "comparison.html")
    failed |= _attempt(lambda path: write_outcome(outcome, provenance, path), folder / stored.RUN_FILE)
    _insist(failed | writing.get_result())
    return [*([folder / "comparison.html"] if pages else []), folder / "comparison.csv"]


def remove_pages(folder: Path, solvers: Sequence[str] = ()) -> None:
    """Remove the pages of an earlier run whose results have been replaced without new pages."""
    for page in ("comparison.html", "report.html", *(f"{name}/report.html" for name in solvers)):
        (folder / page).unlink(missing_ok=True)


def draw_again(folder: Path, part: Path) -> list[Path]:
    """Draw the pages of a run stored in `folder` into `part`, without solving.

    Raises
    ------
    GraphnavError
        If there is none.
    """
    outcome, provenance = stored.read_outcome(folder / stored.RUN_FILE)
    try:
        return _draw_pages(outcome, provenance, part, outcome.alone)  # the folder may contain an earlier comparison
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ConfigError(
            f"{folder / stored.RUN_FILE}: its parts do not fit together ({type(error).__name__}: {error}); solve again",
            key="results.unfit",
        ) from error


def _draw_pages(outcome: Outcome, provenance: Mapping[str, Any], part: Path, alone: bool) -> list[Path]:
    from graphnav.report import documents as report

    detectors = report.draw_detectors(outcome.recording, next(iter(outcome.solutions.values())))
    files = []
    for name in select_own(outcome.solutions):
        place = part if alone else part / name
        place.mkdir(parents=True, exist_ok=True)
        _draw_solver(outcome, name, place, provenance, detectors)
        files.append(place / "report.html")
    if not alone:
        _draw_comparison(outcome, part, provenance)
        files = [part / "comparison.html", *files]
    return files


def _draw_comparison(outcome: Outcome, folder: Path, provenance: Mapping[str, Any]) -> None:
    from graphnav.evaluation.metrics import summarise
    from graphnav.report import documents as report

    report.write_comparison(
        folder / "comparison.html",
        outcome.recording,
        outcome.solutions,
        settings=outcome.request.settings.model_dump(),
        metrics={name: summarise(m) for name, m in outcome.metrics.items()},
        errors={name: m.errors for name, m in outcome.metrics.items() if m.errors is not None},
        withheld=outcome.used_withheld,
        outages=find_outages(outcome.recording),
        findings=_list_findings(outcome),
        defects=outcome.defects,
        provenance=provenance,
        noise=list_noise_figures(outcome, next(iter(outcome.solutions.values()))),
        beside=[f"{name}/report.html" for name in select_own(outcome.solutions)],
    )


def write_solver(
    outcome: Outcome,
    name: str,
    folder: Path,
    provenance: Mapping[str, Any],
    detectors: Sequence[Markup] | None = None,
    pages: bool = True,
) -> dict[Path, str]:
    """Write the files of one solver; older files of the same names are removed.

    Returns
    -------
    dict
        What could not be written, and why: a failing picture does not prevent the numbers.
    """
    from graphnav.recording.exporters import write_parts

    solution = outcome.solutions[name]
    began = time.perf_counter()
    targets = {one: folder / f"trajectory.{one}" for one in ("csv", "kml", "tum", "gpx")}
    zero, title = outcome.recording.gps_zero, f"{outcome.recording.name}, {name}"
    folder.mkdir(parents=True, exist_ok=True)
    utc = None if zero is None else lambda t: gps_to_utc(t + zero)
    write_parts(solution.blocks(outcome.request.rate), targets, title, utc)
    write_json(folder / "calibration.json", {key: _list_calibration(key, p) for key, p in solution.parameters.items()})
    text = format_detections(solution.detections, solution.records)
    (folder / "detections.csv").write_text(text, encoding="utf-8")
    done = time.perf_counter()
    report = folder / "report.html"
    failed = _attempt(lambda _: _draw_solver(outcome, name, folder, provenance, detectors), report) if pages else {}
    seconds = {"writing": done - began, "report": time.perf_counter() - done}
    write_json(folder / "summary.json", summarise_solver(outcome, name, seconds, provenance))
    return failed


def _draw_solver(
    outcome: Outcome, name: str, folder: Path, provenance: Mapping[str, Any], detectors: Sequence[Markup] | None
) -> None:
    from graphnav.evaluation.metrics import summarise
    from graphnav.report import documents as report
    from graphnav.report.doubts import find_departures

    solution, metrics = outcome.solutions[name], outcome.metrics.get(name)
    contradicted = find_departures(outcome.solutions).get(name)
    report.write_report(
        folder / "report.html",
        outcome.recording,
        solution,
        settings=outcome.request.select_settings(name).model_dump(),
        metrics=None if metrics is None else summarise(metrics),
        errors=None if metrics is None else metrics.errors,
        withheld=outcome.used_withheld,
        outages=find_outages(outcome.recording),
        findings=_list_findings(outcome),
        defects=outcome.defects,
        contradicted=contradicted,
        provenance=provenance,
        detectors=detectors,
        noise=list_noise_figures(outcome, solution),
        beside=(*(("trajectory.kml", "trajectory.gpx") if outcome.recording.placed else ()), "trajectory.csv"),
    )


def _attempt(write: Callable[[Path], object], path: Path) -> dict[Path, str]:
    """Write a file; returns the reason if that fails, and then leaves no file."""
    try:
        write(path)
    except Exception as error:
        path.unlink(missing_ok=True)
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        return {path: f"{path.name} could not be written ({why})"}
    return {}


def _insist(failed: Mapping[Path, str]) -> None:
    if failed:
        sentence = f"{'; '.join(failed.values())}; all other files are there"
        raise PartlyWrittenError(sentence, key="output.partly_written", missing=failed)


def write_evaluation(folder: Path, values: Mapping[str, Any], metrics: Metrics) -> None:
    """evaluation.json, and errors.csv with a row per compared epoch where there are any."""
    from graphnav.recording.exporters.digits import format_rows

    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "evaluation.json", values)
    e = metrics.errors
    if e is None:
        return
    columns = [e.t[:, None], e.p, e.track, e.v, np.degrees(e.rph), e.sd_p]
    head = "t,east,north,up,along,across,ve,vn,vu,roll,pitch,heading,sd_e,sd_n,sd_u\n"
    body = format_rows(np.concatenate(columns, axis=1), "%.6f" + 14 * ",%.6g")
    (folder / "errors.csv").write_text(head + body, encoding="utf-8")


def _list_calibration(name: str, p: ParameterEstimate) -> dict[str, Any]:
    """A constant as its value, a time-varying parameter as its nodes, with the digits of trajectory.csv."""
    from graphnav.estimation.names import name_components
    from graphnav.recording.exporters.digits import format_json_rows

    nodes: dict[str, Any] = {"value": p.value[0], "sigma": p.sigma[0]}
    if len(p.t) > 1 and np.isfinite(p.value).all() and np.isfinite(p.sigma).all():
        nodes = {"t": partial(format_json_rows, p.t, "%.6f")}
        nodes |= {key: partial(format_json_rows, x, "%.6g") for key, x in (("value", p.value), ("sigma", p.sigma))}
    elif len(p.t) > 1:
        nodes = {"t": p.t, "value": p.value, "sigma": p.sigma}
    names = [one.words for one in name_components(name, p.value.shape[1], p.unit)]
    return {"names": names, "unit": p.unit, **nodes, "prior_sigma": p.prior_sigma, "seen_by_the_data": p.observable}


def _list_findings(outcome: Outcome) -> list[str]:
    """The findings listed in the report."""
    lines = list(outcome.findings)
    if outcome.zero:
        lines.append(f"only a part is used: times here count from {outcome.zero:.3f} s after the recording's start")
    return lines
