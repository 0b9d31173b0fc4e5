"""Withhold GNSS for a while, many times over, with and without each constraint, and see how far each solver is off.

    python scripts/withheld_spans.py ../shared/data/tokyo_20201105 --spans 6 --length 60
    python scripts/withheld_spans.py ../shared/data/tokyo_20201105 --length 300 --with none,zupt,nhc,odometer,all

The spans are spread evenly over the time in which the vehicle moves (for `--moving` of the span at least), and
withheld in as few runs as leave each as long with fixes before and after it; the errors are against the recording's
truth, or against the withheld fixes where it has none.
"""

from __future__ import annotations

import argparse
import json

import numpy as np

import graphnav
from graphnav.app.workflow import Request, run_request
from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.estimation.pipeline import SOLVERS

STOPS = ("zero_velocity", "zero_rate", "held_position")
SETS = {
    "none": (),
    "zupt": ("zero_velocity",),
    "zaru": ("zero_rate",),
    "held": ("held_position",),
    "stops": STOPS,
    "nhc": ("nhc",),
    "odometer": ("odometer",),
    "mo-c": ("nhc", "odometer"),
    "all": (*STOPS, "nhc", "odometer"),
}


def moving_spans(recording: graphnav.Recording, count: int, length: float, share: float = 0.8) -> list[float]:
    """Starts (s from the recording's start) of spans in which the fixes move for most of the time."""
    gnss = recording.gnss
    assert gnss is not None
    t = np.arange(recording.start + 60.0, recording.end - length - 30.0, 1.0)
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)[:, :2]
    grid = np.arange(recording.start, recording.end, 1.0)
    track = np.stack([np.interp(grid, gnss.t, p[:, k]) for k in range(2)], -1)
    moves = np.linalg.norm(np.gradient(track, grid, axis=0), axis=1) > 1.5
    good = [float(s - recording.start) for s in t if np.mean(moves[(grid >= s) & (grid < s + length)]) >= share]
    if len(good) < count:
        raise SystemExit(f"only {len(good)} starts of {length:g}-s spans move for {100 * share:.0f} % of the time")
    return [good[i] for i in np.linspace(0, len(good) - 1, count).round().astype(int)]


def runs_of(starts: list[float], length: float) -> list[list[float]]:
    """The starts shared out to runs, in each of which a span's length lies between spans."""
    runs: list[list[float]] = []
    for start in starts:
        for run in runs:
            if start - run[-1] >= 2.0 * length + 30.0:
                run.append(start)
                break
        else:
            runs.append([start])
    return runs


def only(used: tuple[str, ...]) -> dict[str, dict[str, bool]]:
    """Settings with these constraints on and the other vehicle constraints off."""
    return {
        "standstill": {name: name in used for name in STOPS},
        "vehicle": {name: name in used for name in ("nhc", "odometer")},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--spans", type=int, default=6)
    parser.add_argument("--length", type=float, default=60.0, help="s")
    parser.add_argument("--moving", type=float, default=0.8, help="least share of a span in motion")
    parser.add_argument("--with", dest="sets", default="all", help=f"constraints, some of {', '.join(SETS)}")
    parser.add_argument("--settings", default="{}", help='more settings as JSON, for example \'{"gnss": {"gate": 5}}\'')
    parser.add_argument("--each", action="store_true", help="print every span")
    options = parser.parse_args()
    recording = graphnav.load(options.recording)
    starts = moving_spans(recording, options.spans, options.length, options.moving)
    print("| with | solver | end, m: median | worst | max, m: median | worst | drift, % of way | NEES |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in options.sets.split(","):
        settings = parse_settings({**only(SETS[name]), **json.loads(options.settings)})
        table: dict[str, list[list[float]]] = {}
        for run in runs_of(starts, options.length):
            withheld = tuple(("gnss", (s, s + options.length)) for s in run)
            outcome = run_request(Request(options.recording, SOLVERS, settings, withheld=withheld))
            for solver, metrics in outcome.metrics.items():
                for start in run:
                    one = next(s for s in metrics.spans if abs(s.start - start) < 1.0)
                    row = [one.end_h, one.max_h, one.drift_percent, one.nees]
                    table.setdefault(solver, []).append(row)
                    if options.each:
                        said = " | ".join(f"{v:.2f}" for v in row)
                        print(f"| {name}, {start:.0f} s | {solver} | {said} |", flush=True)
        for solver, rows in table.items():
            middle, worst = np.nanmedian(rows, axis=0), np.nanmax(rows, axis=0)
            row = [middle[0], worst[0], middle[1], worst[1], middle[2], middle[3]]
            print(f"| {name} | {solver} | " + " | ".join(f"{v:.2f}" for v in row) + " |", flush=True)


if __name__ == "__main__":
    main()
