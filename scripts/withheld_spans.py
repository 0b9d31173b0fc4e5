"""Withhold GNSS for a minute, many times over, and see how far each solver is off in it.

    python scripts/withheld_spans.py ../shared/data/tokyo_20201105 --spans 8 --length 60

The spans are spread evenly over the time in which the vehicle moves. Each is withheld in a run of its own; the
errors are against the recording's truth, or against the withheld fixes where it has none.
"""

from __future__ import annotations

import argparse
import json

import numpy as np

import graphnav
from graphnav.config import settings_from
from graphnav.earth import LocalFrame
from graphnav.pipeline import SOLVERS
from graphnav.workflow import Request, run_request


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--spans", type=int, default=8)
    parser.add_argument("--length", type=float, default=60.0, help="s")
    parser.add_argument("--settings", default="{}", help='settings as JSON, for example \'{"gnss": {"gate": 5}}\'')
    options = parser.parse_args()
    recording = graphnav.load(options.recording)
    settings = settings_from(json.loads(options.settings))
    table: dict[str, list[list[float]]] = {}
    print("| span, s | solver | end, m | max, m | drift, % of way | NEES |\n| --- | --- | --- | --- | --- | --- |")
    for start in moving_spans(recording, options.spans, options.length):
        span = (start, start + options.length)
        outcome = run_request(Request(options.recording, SOLVERS, settings, withheld=(("gnss", span),)))
        for name, metrics in outcome.metrics.items():
            one = metrics.spans[0]
            row = [one.end_h, one.max_h, one.drift_percent, one.nees]
            table.setdefault(name, []).append(row)
            print(f"| {span[0]:.0f}-{span[1]:.0f} | {name} | " + " | ".join(f"{v:.2f}" for v in row) + " |", flush=True)
    for name, rows in table.items():
        middle, worst = np.nanmedian(rows, axis=0), np.nanmax(rows, axis=0)
        print(f"| median | {name} | " + " | ".join(f"{v:.2f}" for v in middle) + " |")
        print(f"| worst | {name} | " + " | ".join(f"{v:.2f}" for v in worst) + " |")


if __name__ == "__main__":
    main()
