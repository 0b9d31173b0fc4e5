"""GTSAM's iSAM2 over a lag and over the whole drive, beside the window and the filter: ms a keyframe as it goes on.

    python scripts/compare_isam2.py --minutes 60
    python scripts/compare_isam2.py --minutes 600 --no-whole

The same rows of the same simulated drive, built beforehand with the noise model of the first hour and all vehicle
constraints at keyframes of 1 Hz; each solver in a process of its own, by blocks of ten minutes. Times are processor
time of the thread, so that other programs show in them only by what the caches lose. Memory is what the process has
grown by at the end of a block, with the states and covariances that it has found by then (4 kB a keyframe), and in the
last line with the whole solution. What settled is compared with the window's, in centimetres and sigmas.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle
from benchmark_online import LAP, RATE, build_with_noise, memory_mb
from replay import Replay, play_isam2, play_window

from graphnav.config import Settings
from graphnav.core.progress import Progress
from graphnav.estimation.problem import Problem
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf

LAG = 120.0
BLOCK = 600.0  # s


@dataclass(frozen=True)
class Run:
    """What a solver took: s of each keyframe, and MB by which its process had grown."""

    seconds: np.ndarray
    grown: np.ndarray  # (n, 2) share of the drive, MB
    end: float  # MB, with the solution put together
    found: Replay | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--no-whole", action="store_true", help="leave out what grows with the drive")
    options = parser.parse_args()
    seconds = 60.0 * options.minutes
    laps = max(1, round(seconds / LAP))
    path = oracle.vehicle_path(seconds / laps, RATE).tiled(laps)
    spans = oracle.moving_spans(path, 60.0, max(1, round(options.minutes / 20.0)))
    recording, _ = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0)
    del path
    problem = build_with_noise(recording, Settings(), LAP)
    runs: dict[str, Run] = {}
    solvers: dict[str, Callable[[Progress], Replay | np.ndarray]] = {
        "filter, means of 256": lambda progress: filtered(problem, progress),
        "window": lambda progress: play_window(problem, LAG, progress),
        "iSAM2": lambda progress: play_isam2(problem, LAG, progress),
    }
    if not options.no_whole:
        solvers["iSAM2, whole drive"] = lambda progress: play_isam2(problem, progress=progress)
    for name, solve in solvers.items():
        runs[name] = alone(solve)
        print(f"{name}: {of(runs[name].seconds)}", file=sys.stderr, flush=True)
    print("Processor time of the thread, ms a keyframe: median / 99 % / most; memory the process has grown by, MB\n")
    print("| until, min | " + " | ".join(f"{name} | MB" for name in runs) + " |")
    print("| ---: " + "| --- | ---: " * len(runs) + "|")
    parts = np.array_split(np.arange(len(problem.t)), max(1, round(seconds / BLOCK)))
    for part in parts:
        share = (part[-1] + 1) / len(problem.t)
        cells = [f"{of(run.seconds[part])} | {np.interp(share, *run.grown.T):.0f}" for run in runs.values()]
        print(f"| {(problem.t[part[-1]] - problem.t[0]) / 60:.0f} | " + " | ".join(cells) + " |")
    print("| all | " + " | ".join(f"{of(run.seconds)} | {run.end:.0f}" for run in runs.values()) + " |")
    tree, window = runs["iSAM2"].found, runs["window"].found
    for kind in ("settled", "live"):
        print(f"\niSAM2 and the window, {kind}: " + apart(getattr(tree, kind), getattr(window, kind)))


def filtered(problem: Problem, progress: Progress) -> np.ndarray:
    """Processor time of the filter at each keyframe (s), the mean of the 256 that it is one of."""
    met = [(0.0, time.thread_time())]

    def tell(solver: str, share: float) -> None:
        met.append((share, time.thread_time()))
        progress(solver, share)

    ekf(problem, tell)
    share, at = np.array([*met, (1.0, time.thread_time())]).T
    whole = np.arange(len(problem.t) + 1) / len(problem.t)
    return np.diff(np.interp(whole, share, at))


def alone(solve: Callable[[Progress], Replay | np.ndarray]) -> Run:
    """A solver in a process of its own."""
    here, there = multiprocessing.Pipe(duplex=False)

    def work() -> None:
        gc.collect()  # what building the problem left behind: its release took 0.3 s of a keyframe, and 120 MB
        before = memory_mb()
        grown = [(0.0, 0.0)]
        result = solve(lambda _, share: grown.append((share, memory_mb() - before)))
        found = result if isinstance(result, Replay) else None
        seconds = result if isinstance(result, np.ndarray) else result.seconds
        there.send(Run(seconds, np.array(grown), memory_mb() - before, found))

    process = multiprocessing.get_context("fork").Process(target=work)
    process.start()
    run: Run = here.recv()
    process.join()
    return run


def of(seconds: np.ndarray) -> str:
    return " / ".join(f"{1e3 * x:.1f}" for x in np.quantile(seconds, [0.5, 0.99, 1.0]))


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
