"""Does estimating noise and leaving fixes out make drives worse? Stated beside estimated noise, over many windows.

    python scripts/do_no_harm.py -o harm.json --windows 3 --no-whole
    python scripts/do_no_harm.py -o harm.json --share 0.25 --seed 7 --compare before.json

Every drive is solved whole and in windows at random starts, with one sensor set after the other, once with the noise
that the recording states and every fix used, once with the defaults. Errors are against the drive's own truth; where
it has none, against spans of fixes that are withheld. Rows go to the file as they come, and those that are there
already are not solved again. Exit code 1 where a bound of `BOUNDS` is broken.

With `--changed backwards`, or another of `drive_changes.CHANGES`, each window is changed first: drives that nobody has
seen, with the errors of real sensors. Errors are against the drive as it was.

With `--online window` or `--online isam2` each recording comes row by row instead: what is known at once takes the
filter's place, what settles the smoother's.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import random
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from drive_changes import CHANGES, ELSEWHERE
from harm_verdict import BOUNDS, FLOOR, OF_ESTIMATED, ONLINE, Row, broken, compared, failures, key_of, metres, table
from online_tracks import Track, run_online
from scipy.stats import chi2

import graphnav
from graphnav.app.scores import Span, Withheld, score
from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.interpolation import interpolate
from graphnav.estimation.pipeline import SOLVERS
from graphnav.estimation.solution import ConstraintRecord, ExcludedSpan
from graphnav.evaluation.evaluate import evaluate_recording, find_truth
from graphnav.evaluation.metrics import Metrics, summarise
from graphnav.recording import Recording

HERE = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Drive:
    """Where a drive is, relative to the folder of recordings."""

    source: str
    doppler: bool = True
    simulated: bool = False


# The most telling first: an interrupted run has seen those.
DRIVES = {
    "tokyo_no_doppler": Drive("tokyo_20201105/recording.toml", doppler=False),
    "tokyo": Drive("tokyo_20201105/recording.toml"),
    "tokyo_spp": Drive("tokyo_20201105/recording_spp.toml"),
    "boulder": Drive("boulder_drive_20250708"),
    "kitti": Drive("kitti"),
    "comma": Drive("comma_highway_20180802"),
    "dresden": Drive("dresden_car_20140326"),
    "circles_2024": Drive("car_circles_boston_20241021"),
    "circles_2025": Drive("car_circles_boston_20251119"),
    "canada_rover": Drive("canada_rover"),
    "motorbike": Drive("motorbike_dresden_20160809"),
    "tokyo_clone": Drive(str(HERE / "data" / "tokyo")),
    "oracle": Drive("oracle_drive/recording.toml", simulated=True),
    "oracle_spp": Drive("oracle_drive/recording_spp.toml", simulated=True),
}
SENSORS = ("gnss", "+nhc", "+odometer")  # each with all before it
VARIANTS = ("stated", "estimated")
WINDOW, SHORT = 300.0, 120.0  # s; a usual window, and a drive too short for any
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
SURE = chi2.isf(math.erfc(3.0 / math.sqrt(2.0)), 3)  # of three axes together, as rare as three sigma of one
TRUTH_GAP = 0.5  # s; between rows further apart braking at 3 m/s^2 bends the way by more than 3 * 0.5^2 / 8 = 0.1 m


def settings_of(variant: str, sensors: str, doppler: bool = True, engine: str | None = None) -> graphnav.Settings:
    """The settings of one cell of the table."""
    values: dict[str, dict[str, Any]] = {"gnss": {"velocity": doppler}}
    if sensors == "gnss":
        values["standstill"] = {"zero_velocity": False, "zero_rate": False, "held_position": False}
    values["vehicle"] = {"nhc": sensors != "gnss", "odometer": sensors == "+odometer"}
    values["noise"] = {"mode": variant}
    if engine is not None:
        values["solver"] = {"engine": engine}
    return parse_settings(values)


# ------------------------------------------------------------------------------------------------------- what is solved
@dataclass(frozen=True)
class Job:
    """One window of one drive with one sensor set and one variant of noise: a row of each solver."""

    drive: str
    source: str
    window: str  # "whole" or "from-to", s from the recording's start
    span: Span
    sensors: str
    variant: str
    engine: str | None = None  # online
    change: str | None = None  # of `drive_changes.CHANGES`

    @property
    def solvers(self) -> tuple[str, ...]:
        return ONLINE if self.engine else SOLVERS

    def key(self, solver: str) -> tuple[str, ...]:
        drive = f"{self.drive} {self.change}" if self.change else self.drive
        return drive, self.window, self.sensors, self.variant, solver


@lru_cache(maxsize=1)
def load(source: str) -> Recording:
    return graphnav.load(source)


@lru_cache(maxsize=2)
def cut(source: str, span: Span, change: str | None) -> Recording:
    """A window of a drive, changed."""
    part = load(source).crop(*span)
    return CHANGES[change](part) if change else part


def placed(drive: Drive, folder: Path) -> str:
    """The path of a drive, or its built-in name."""
    return drive.source if drive.source == "kitti" else str(folder / drive.source)


def windows(recording: Recording, source: str, options: argparse.Namespace) -> Iterator[tuple[str, Span]]:
    """Names and spans: the drive as far as it has fixes, unless only parts are wanted, and windows in it.

    The first starts anywhere, each of the others further by the golden ratio of all there is: so many or few lie spread
    evenly, and the first of many are those of few. Fewer than asked for where the drive is shorter than two windows.
    """
    gnss = recording.gnss
    assert gnss is not None
    first, last = max(gnss.t[0] - recording.start, 0.0), min(gnss.t[-1] - recording.start, recording.duration)
    length = last - first
    if options.whole or length < SHORT:
        yield "whole", (0.0, last)
    if length < SHORT:
        return
    size = min(options.length, 0.5 * length)
    place = random.Random(f"{options.seed} {Path(source).name}").random()
    for k in range(math.ceil(options.windows * min(1.0, length / (2.0 * options.length)))):
        start = round(first + (place + k * GOLDEN) % 1.0 * (length - size), 1)
        end = round(start + size, 1)
        yield f"{start:g}-{end:g}", (start, end)


def plan(options: argparse.Namespace) -> list[Job]:
    """Every job asked for, by drive, window by window; a share of them is drawn cell by cell, to see more drives."""
    cells: list[list[Job]] = []
    for name in options.drives:
        source = placed(DRIVES[name], options.data)
        recording = load(source)
        for window, span in windows(recording, DRIVES[name].source, options):
            sets = SENSORS if recording.odometer is not None or options.changed == "obd" else SENSORS[:2]
            cells += [
                [Job(name, source, window, span, sensors, v, options.online, options.changed) for v in VARIANTS]
                for sensors in sets
            ]
    if options.share < 1.0:
        picked = random.Random(options.seed).sample(range(len(cells)), max(1, round(options.share * len(cells))))
        cells = [cells[k] for k in sorted(picked)]
    return [job for cell in cells for job in cell]


def withheld_of(part: Recording, length: float) -> tuple[Withheld, ...]:
    """Spans of fixes to score on: 20 s every 100 s from 40 s on; of a drive shorter than `SHORT`, or a window that has
    none of these, two of 10 s.
    """
    starts, size = list(np.arange(40.0, part.duration - 20.0, 100.0)), 20.0
    if length < SHORT or not starts:
        # the first after the motion that the attitude is found from, the last with fixes behind it
        starts, size = [0.4 * part.duration, 0.75 * part.duration], 10.0
    return tuple(("gnss", (round(float(s), 1), round(float(s) + size, 1))) for s in starts)


def solve(job: Job) -> list[Row]:
    """The rows of a job, by solver; with what went wrong in place of numbers where it cannot be solved."""
    drive = DRIVES[job.drive]
    names = ("drive", "window", "sensors", "variant", "solver")
    rows: list[Row] = [
        {**dict(zip(names, job.key(solver), strict=True)), "simulated": drive.simulated} for solver in job.solvers
    ]
    began = time.process_time()
    try:
        part, as_was = (cut(job.source, job.span, change) for change in (job.change, None))
        reference = part if job.change in ELSEWHERE else as_was
        if job.sensors != "+odometer" and part.odometer is not None:
            part = part.without("odometer")
        withheld = withheld_of(reference, load(job.source).duration) if part.truth is None else ()
        used = part
        for source, span in withheld:
            used = used.without(source, span)
        settings = settings_of(job.variant, job.sensors, drive.doppler, job.engine)
        began = time.process_time()
        if job.engine is None:
            solutions = graphnav.run(used, settings, SOLVERS)
            seconds = time.process_time() - began
            metrics = score(reference, used, solutions, withheld)[0]
            out = {
                name: {**left_out(used, one.excluded, one.records.get("gnss_position")), "seconds": round(seconds, 2)}
                for name, one in solutions.items()
            }
        else:
            online, tracks = run_online(used, settings)
            seconds = time.process_time() - began
            metrics, unknown = {}, {}
            for name, track in tracks.items():
                try:
                    metrics[name] = evaluate_online(track, reference, withheld)
                except graphnav.GraphnavError as error:  # of what is known at once there may be nothing to compare
                    unknown[name] = {"error": str(error)}
            false_stops = 0 if online.tracker is None else len(online.tracker.noise.false_stops)
            more = {"seconds": round(seconds, 2), "false_stops": false_stops, "notes": online.notes}
            common = left_out(used, online.excluded) | more
            out = {name: common | unknown.get(name, {}) for name in tracks}
        for row in rows:
            said = summarise(metrics[row["solver"]]) if row["solver"] in metrics else {}
            row |= {"h": said.get("h_rms_m"), "up": said.get("up_rms_m"), "nees": said.get("nees_p")}
            row |= out[row["solver"]]
    except Exception as error:  # another kind than GraphnavError is a bug; the table shows it and goes on
        words = str(error) if isinstance(error, graphnav.GraphnavError) else f"{type(error).__name__}: {error}"
        words = " ".join(words.split("\n\n")[0].split())
        rows = [row | {"error": words, "seconds": round(time.process_time() - began, 2)} for row in rows]
    return rows


def evaluate_online(track: Track, recording: Recording, withheld: tuple[Withheld, ...]) -> Metrics:
    """Errors of a trajectory that came out online.

    Raises
    ------
    GraphnavError
        If there is nothing to compare.
    """
    if not track.pieces:
        raise graphnav.GraphnavError("nothing was known before the end")
    whole, antenna = track.join()
    metrics = evaluate_recording(whole, recording, withheld=withheld, antenna=antenna)
    assert metrics is not None
    return metrics


def left_out(recording: Recording, excluded: Iterable[ExcludedSpan], record: ConstraintRecord | None = None) -> Row:
    """How many fixes there are and are left out, and the same of those that the truth confirms (None without truth)."""
    gnss = recording.gnss
    assert gnss is not None
    there = np.isfinite(gnss.llh).all(axis=1)
    out = np.zeros(len(gnss.t), dtype=bool)
    for t in record.t[record.weight == 0.0] if record is not None else ():
        out |= np.abs(gnss.t - t) < 1e-5
    for fault in excluded:
        if fault.kind == "gnss_position":
            out |= (gnss.t >= fault.t_start - 1e-5) & (gnss.t <= fault.t_end + 1e-5)
    out &= there
    velocities = sum(fault.count for fault in excluded if fault.kind == "gnss_velocity")
    found: Row = {"fixes": int(there.sum()), "left_out": int(out.sum()), "left_out_velocities": velocities}
    reference = find_truth(recording)
    if reference is None or not there.any():
        return found | {"confirmed": None, "confirmed_left_out": None}
    truth, of_antenna = reference[0], reference[1] is not None
    arm = None if of_antenna or not gnss.lever_arm.any() else gnss.lever_arm
    at, reached = interpolate(truth, gnss.t, max_gap=TRUTH_GAP, lever_arm=arm)
    frame = LocalFrame(gnss.llh[0])
    away = np.full(gnss.llh.shape, np.nan)
    away[reached] = frame.from_llh(gnss.llh[reached]) - frame.from_llh(at.llh)
    sigma = gnss.sd * np.maximum(1.0, FLOOR / np.linalg.norm(gnss.sd, axis=1))[:, None]  # a truth has errors of its own
    confirmed = np.sum((away / sigma) ** 2, axis=1) < SURE  # false where the truth says nothing
    return found | {"confirmed": int(confirmed.sum()), "confirmed_left_out": int((confirmed & out).sum())}


def run(jobs: list[Job], path: Path, rows: list[Row], processes: int) -> list[Row]:
    """All rows: those that are there, and those of the jobs that are not, written as they come."""
    have = {key_of(row) for row in rows}
    todo = [job for job in jobs if job.key(job.solvers[0]) not in have]
    pool = multiprocessing.get_context("spawn").Pool(processes) if processes > 1 and len(todo) > 1 else None
    try:
        for k, new in enumerate(pool.imap(solve, todo) if pool else map(solve, todo), 1):
            rows = [*rows, *new]
            beside = path.with_suffix(".part")
            beside.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")
            beside.replace(path)  # whole at any time
            one = new[-1]
            said = one.get("error") or " / ".join(f"{metres(r['h'])}, {metres(r['up'])}" for r in new)
            print(
                f"{k}/{len(todo)} {' '.join(key_of(one)[:4])}: {said}; {one['seconds']} s", file=sys.stderr, flush=True
            )
    finally:
        if pool:
            pool.terminate()
    return rows


def options_of(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="the rows, JSON; those there are kept")
    parser.add_argument("--data", type=Path, default=os.environ.get("GRAPHNAV_DATA", HERE.parent / "shared" / "data"))
    parser.add_argument("--drives", default=",".join(DRIVES), help="some of %(default)s")
    parser.add_argument("--windows", type=int, default=8, help="of each drive that is long enough")
    parser.add_argument("--length", type=float, default=WINDOW, help="of a window, s (%(default)g)")
    parser.add_argument("--whole", action=argparse.BooleanOptionalAction, default=True, help="whole drives as well")
    parser.add_argument("--share", type=float, default=1.0, help="of all cells, drawn by the seed")
    parser.add_argument("--seed", type=int, default=1, help="of where windows start, and of the share")
    parser.add_argument("--only", choices=VARIANTS, help="solve with one noise only")
    parser.add_argument("--changed", choices=tuple(CHANGES), help="each window in this way")
    parser.add_argument("--online", choices=("window", "isam2"), help="row by row, with this engine")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--compare", type=Path, metavar="OLD.json", help="the rows of an earlier run")
    options = parser.parse_args(arguments)
    options.data, options.drives = Path(options.data), options.drives.split(",")
    if unknown := [name for name in options.drives if name not in DRIVES]:
        parser.error(f"--drives: no drive '{unknown[0]}'; known: {', '.join(DRIVES)}")
    if not 0.0 < options.share <= 1.0:
        parser.error(f"--share {options.share:g}: must be above 0 and at most 1")
    return options


def rows_in(path: Path) -> list[Row]:
    """The rows of a file."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
        list(map(key_of, rows))
    except OSError as error:
        raise graphnav.GraphnavError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise graphnav.GraphnavError(f"{path}: holds no rows of this script; name another file") from None
    return list(rows)


def main(arguments: list[str] | None = None) -> int:
    """The exit code: 1 where a bound is broken, 2 where there is nothing to work with."""
    options = options_of(arguments)
    try:
        rows = rows_in(options.output) if options.output.exists() else []
        old = rows_in(options.compare) if options.compare else []
        jobs = plan(options)
    except graphnav.GraphnavError as error:
        print(error, file=sys.stderr)
        return 2
    wanted = {job.key(solver) for job in jobs for solver in job.solvers}
    todo = [job for job in jobs if options.only in (None, job.variant)]
    rows = [row for row in run(todo, options.output, rows, options.jobs) if key_of(row) in wanted]
    print("\n".join(table(rows)))
    print("\n".join(["", *failures(rows)]))
    if options.compare:
        print("\n".join(["", *compared(rows, old)]))
    found, both = broken(rows), len({row["variant"] for row in rows}) == 2
    for name, bound in BOUNDS.items():
        own = [one for one in found if one.bound == name]
        kept = "holds" if both or name in OF_ESTIMATED else "not told: it takes rows with stated noise too"
        print(f"\n{name} ({bound:g}): " + (f"broken {len(own)} times" if own else kept))
        print("".join(f"  {one}\n" for one in own), end="")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
