"""iSAM2's states and covariances beside the batch solver's over the whole drive, and beside others' within a lag.

    GRAPHNAV_DATA=../shared/data python scripts/isam2_beside_batch.py

All settings are the defaults; the noise model is estimated once for each recording. A state that has settled with two
minutes of the future knows less than batch does of the whole drive: a third line has what that makes of it. The last
line is beside batch of what had come when each state settled: every measurement after that has no weight.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphnav import load
from graphnav.config import Settings
from graphnav.core.earth import LocalFrame
from graphnav.core.rotation import Array
from graphnav.core.state import States
from graphnav.detectors import detect
from graphnav.estimation.factor_graph.batch import batch
from graphnav.estimation.factor_graph.tree_window import isam2
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.preparation import begin_preparation, prepare
from graphnav.estimation.problem import Problem
from graphnav.estimation.solvers.incremental import are_due, incremental

RECORDINGS = ("kitti", "gcp_walks/walk31.toml", "oracle_drive", "tokyo_20201105")
LONGEST = 600.0  # s that are used of a recording
LAG = 120.0  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--recordings", nargs="+", default=RECORDINGS, help="among the recordings, or built in (%(default)s)"
    )
    parser.add_argument("--lag", type=float, default=LAG, help="s (%(default)s)")
    parser.add_argument("--groups", type=int, default=8, help="settled together, that are compared (%(default)s)")
    options = parser.parse_args()
    data, lag = Path(os.environ.get("GRAPHNAV_DATA", "../shared/data")), options.lag
    print("Median / 99 % / most over the keyframes\n")
    print("| recording | beside | apart, cm | apart, sigmas of that | sigmas, of those: least, most |")
    print("| --- | --- | --- | --- | --- |", flush=True)
    for name in options.recordings:
        recording = load(data / name if (data / name).exists() else name).crop(0.0, LONGEST)
        settings, frame = Settings(), LocalFrame(choose_origin(recording), recording.start)
        found = prepare(begin_preparation(recording, settings, frame, detect(recording, settings)))
        problem, start, nodes = found.problem, found.smoothed.states, found.smoothed.select_nodes(found.problem)
        best = batch(problem, start, nodes)
        whole = isam2(problem)
        tell(name, "batch", (whole.states, whole.covariance), (best.states, best.covariance))
        settled, window = isam2(problem, lag), incremental(problem, lag)
        own = settled.states, settled.covariance
        tell(name, f"window, both {lag:.0f} s", own, (window.states, window.covariance))
        tell(name, f"batch, {lag:.0f} s", own, (best.states, best.covariance))
        of_lag, of_batch = [], []
        every = groups(problem, lag)
        for k in np.unique(np.linspace(0, len(every) - 1, options.groups).astype(int)):
            first, end, seen = every[k]
            then = batch(so_far(problem, seen), best.states, nodes, wanted=tuple(range(first, end)))
            of_lag.append((settled.states[first:end], settled.covariance[first:end]))
            of_batch.append((then.states[first:end], then.covariance[first:end]))
        tell(name, f"batch so far, {lag:.0f} s", together(of_lag), together(of_batch))


def groups(problem: Problem, lag: float) -> list[tuple[int, int, int]]:
    """Keyframes that settle together, from one to another, and how many had come then."""
    out, first, t = [], 0, problem.t
    for k in range(len(t)):
        if are_due(t[first], t[k], lag):
            end = int(np.searchsorted(t[:k], t[k] - lag))
            out.append((first, end, k + 1))
            first = end
    return [*out, (first, len(t), len(t))]


def so_far(problem: Problem, n: int) -> Problem:
    """A problem in which nothing is measured after the first n keyframes."""
    rows = (
        replace(c, weight=np.where(c.keyframe < n, 1.0 if c.weight is None else c.weight, 0.0))
        for c in problem.constraints
    )
    return replace(problem, constraints=tuple(rows))


def together(parts: list[tuple[States, Array]]) -> tuple[States, Array]:
    return States.stack([states for states, _ in parts]), np.concatenate([P for _, P in parts])


def tell(name: str, beside: str, found: tuple[States, Array], best: tuple[States, Array]) -> None:
    sigma, own = (np.sqrt(np.diagonal(P, axis1=1, axis2=2)) for _, P in (best, found))
    off = np.abs(found[0].minus(best[0]))
    cm = np.quantile(100.0 * np.linalg.norm(off[:, 3:6], axis=1), [0.5, 0.99, 1.0])
    sigmas = np.quantile((off / sigma).max(axis=1), [0.5, 0.99, 1.0])
    ratio = own / sigma
    cells = [" / ".join(f"{x:.4f}" for x in some) for some in (cm, sigmas)]
    print(f"| {name} | {beside} | {' | '.join(cells)} | {ratio.min():.3f}, {ratio.max():.3f} |", flush=True)


if __name__ == "__main__":
    main()
