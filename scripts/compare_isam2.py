"""The window of the incremental solver beside GTSAM's iSAM2: the same rows of the same drive, ms a keyframe as it goes.

python scripts/compare_isam2.py --minutes 60
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle
from benchmark_online import posed

from graphnav.config import Settings
from graphnav.solvers.incremental import incremental
from graphnav.solvers.isam import isam2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    options = parser.parse_args()
    path = oracle.vehicle_path(60.0 * options.minutes, 200.0)
    spans = oracle.moving_spans(path, 60.0, max(1, round(options.minutes / 20.0)))
    recording, _ = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0)
    problem = posed(recording, Settings())
    found = {
        "window, lag 120 s": incremental(problem, lag=120.0),
        "window, whole drive": incremental(problem, lag=1e9),
        "iSAM2, whole drive": isam2(problem),
    }
    parts = np.array_split(np.arange(len(problem.t)), 6)
    print(
        "| minutes | " + " | ".join(f"{(problem.t[p[-1]] - problem.t[0]) / 60:.0f}" for p in parts) + " | 99 % | most |"
    )
    print("| --- " * 9 + "|")
    for name, one in found.items():
        ms = 1e3 * one.seconds
        cells = [f"{np.median(ms[p]):.1f}" for p in parts] + [f"{x:.1f}" for x in np.quantile(ms, [0.99, 1.0])]
        print(f"| {name} | " + " | ".join(cells) + " |")
    live = [one.live for one in found.values()]
    sigma = np.sqrt(np.diagonal(live[1].covariance, axis1=1, axis2=2))
    apart = np.abs(live[2].states.minus(live[1].states)) / sigma
    print(f"live estimates apart by {np.median(apart):.4f} sigma (median), {apart.max():.2f} (most)")


if __name__ == "__main__":
    main()
