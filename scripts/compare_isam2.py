"""GTSAM's iSAM2 over a lag and over the whole drive, beside the window and the filter: ms a keyframe as it goes on.

    python scripts/compare_isam2.py --minutes 60
    python scripts/compare_isam2.py --minutes 600 --no-whole

The same rows of the same simulated drive, posed beforehand, with all vehicle constraints at keyframes of 1 Hz; each in
a process of its own, by blocks of ten minutes. And how
far what settled is from the window's, in centimetres and sigmas.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle
from benchmark_online import memory_mb, posed

from graphnav.config import Settings
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.estimation.solvers.incremental import Replay, incremental
from graphnav.estimation.solvers.isam import isam2

LAG = 120.0
BLOCKS = 60  # of ten minutes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--no-whole", action="store_true", help="leave out what grows with the drive")
    options = parser.parse_args()
    path = oracle.vehicle_path(60.0 * options.minutes, 200.0)
    spans = oracle.moving_spans(path, 60.0, max(1, round(options.minutes / 20.0)))
    recording, _ = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0)
    problem = posed(recording, Settings())
    count = min(max(1, round(options.minutes / 10.0)), BLOCKS)
    parts = np.array_split(np.arange(len(problem.t)), count)
    ends = " | ".join(f"{(problem.t[p[-1]] - problem.t[0]) / 60:.0f} min" for p in parts)
    print("ms a keyframe: median / 99 % / most\n")
    print(f"| until | {ends} | all | memory grows by, MB |")
    print("| --- " * (len(parts) + 3) + "|", flush=True)
    runs = {
        "filter, means of 256": lambda: filtered(problem),
        "window": lambda: incremental(problem, LAG),
        "iSAM2": lambda: isam2(problem, LAG),
    }
    if not options.no_whole:
        runs["iSAM2, whole drive"] = lambda: isam2(problem)
    found: dict[str, Replay] = {}
    for name, run in runs.items():
        seconds, memory, replayed = alone(run)
        if replayed is not None:
            found[name] = replayed
        cells = [of(1e3 * seconds[p]) for p in [*parts, slice(None)]]
        print(f"| {name} | " + " | ".join(cells) + f" | {memory:.0f} |", flush=True)
    for kind in ("settled", "live"):
        print(
            f"\niSAM2 and the window, {kind}: " + apart(getattr(found["iSAM2"], kind), getattr(found["window"], kind))
        )


def filtered(problem: Problem) -> np.ndarray:
    """Process time of the filter at each keyframe (s), the mean of the 256 that it is one of."""
    met = [(0.0, time.process_time())]
    ekf(problem, lambda _, share: met.append((share, time.process_time())))
    share, at = np.array([*met, (1.0, time.process_time())]).T
    whole = np.arange(len(problem.t) + 1) / len(problem.t)
    return np.diff(np.interp(whole, share, at))


def alone(run: Callable[[], Replay | np.ndarray]) -> tuple[np.ndarray, float, Replay | None]:
    """What a run gives in a process of its own: seconds of each keyframe, MB by which it grew, and the rest."""
    here, there = multiprocessing.Pipe(duplex=False)

    def work() -> None:
        before = memory_mb()
        result = run()
        there.send((result, memory_mb() - before))

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    result, memory = here.recv()
    process.join()
    return (result, memory, None) if isinstance(result, np.ndarray) else (result.seconds, memory, result)


def of(ms: np.ndarray) -> str:
    return " / ".join(f"{x:.1f}" for x in np.quantile(ms, [0.5, 0.99, 1.0]))


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
