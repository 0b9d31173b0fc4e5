"""GTSAM's iSAM2 over a lag and over the whole drive, beside the window and the filter: ms a keyframe as it goes on.

    python scripts/compare_isam2.py --minutes 60
    python scripts/compare_isam2.py --minutes 600 --no-whole

The same rows of the same simulated drive, posed beforehand, with all vehicle constraints at keyframes of 1 Hz. And how
far what settled is from the window's, in centimetres and sigmas.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle
from benchmark_online import posed

from graphnav.config import Settings
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.incremental import Replay, incremental
from graphnav.estimation.solvers.isam import isam2

LAG = 120.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--no-whole", action="store_true", help="leave out what grows with the drive")
    options = parser.parse_args()
    path = oracle.vehicle_path(60.0 * options.minutes, 200.0)
    spans = oracle.moving_spans(path, 60.0, max(1, round(options.minutes / 20.0)))
    recording, _ = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0)
    problem = posed(recording, Settings())
    began = time.process_time()
    ekf(problem)
    print(f"the filter takes {1e3 * (time.process_time() - began) / len(problem.t):.2f} ms a keyframe\n")
    found: dict[str, Replay] = {}
    count = max(1, round(options.minutes / 10.0))
    parts = np.array_split(np.arange(len(problem.t)), min(count, 6))
    ends = " | ".join(f"{(problem.t[p[-1]] - problem.t[0]) / 60:.0f} min" for p in parts)
    print(f"| ms a keyframe, median until | {ends} | all: median | 99 % | most | memory, MB |")
    print("| --- " * (len(parts) + 5) + "|")
    runs = {"window": lambda: incremental(problem, LAG), "iSAM2": lambda: isam2(problem, LAG)}
    if not options.no_whole:
        runs["iSAM2, whole drive"] = lambda: isam2(problem)
    for name, run in runs.items():
        found[name] = run()
        ms = 1e3 * found[name].seconds
        cells = [f"{np.median(ms[p]):.1f}" for p in parts] + [f"{x:.1f}" for x in np.quantile(ms, [0.5, 0.99, 1.0])]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"| {name} | " + " | ".join(cells) + f" | {memory:.0f} |", flush=True)
    for kind in ("settled", "live"):
        print(
            f"\niSAM2 and the window, {kind}: " + apart(getattr(found["iSAM2"], kind), getattr(found["window"], kind))
        )


def apart(a: Solution, b: Solution) -> str:
    sigma, own = (np.sqrt(np.diagonal(x.covariance, axis1=1, axis2=2)) for x in (b, a))
    off = np.abs(a.states.minus(b.states))
    cm = np.quantile(100.0 * np.linalg.norm(off[:, 3:6], axis=1), [0.5, 0.99, 1.0])
    in_sigmas = np.quantile((off / sigma).max(axis=1), [0.5, 0.99, 1.0])
    ratio = np.quantile(own / sigma, [0.0, 1.0])
    return (
        f"{cm[0]:.4f}, {cm[1]:.3f}, {cm[2]:.3f} cm, {in_sigmas[0]:.4f}, {in_sigmas[1]:.3f}, {in_sigmas[2]:.3f} "
        f"sigma (median, 99 %, most); sigmas {ratio[0]:.3f} to {ratio[1]:.3f} of its"
    )


if __name__ == "__main__":
    main()
