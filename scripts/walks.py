"""All real walks through every solver, with and without the lateral constraint, in one table.

    GRAPHNAV_DATA=... python scripts/walks.py

Errors are the closure of loops, else the rms after yaw and offset are fitted to the truth; NEES per degree of freedom.
"in stance": the same over the epochs in a stance only. "stances once": over the means of stances, so that rests count
no more than steps. "point fitted": with the place on the foot fitted that the truth is of, which no recording states;
so is the NEES of a dense truth, the noise of which is how heights scatter over the floor. "bias before": with the gyro
bias as the walk before on the same sensor and day had it. "plain filter": what a nine-state zero-velocity filter of the
usual kind reached on the same recordings, in stance (`plain_filter.py`).
"s per min": processor time of all three solvers, alignment and detection per minute of walk.

    python scripts/walks.py --gaps 3

Instead: so many times without six pieces of the IMU's log, of 15 to 300 ms, as a radio loses them; rms of the errors
and means of the NEES over the times.

    python scripts/walks.py --scatter 0.003

Instead: with stamps of the IMU that scatter by so many seconds, in order.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from graphnav import load
from graphnav.config import parse_settings
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.evaluation.strides import WalkErrors, compute_walk_errors, estimate_floor_sigma
from graphnav.recording import Recording, take_rows

# m: how far a coordinate of the truth may be off. None: measured. Points taken by hand where the shoe stood, of a place
# on it that is not stated; the footprint that a loop ends in
SETS = {"openshoe_loops": 0.0, "pyshoe_vicon": None, "gcp_walks": 0.03, "xio_loops": 0.0}
PLAIN = {
    "openshoe_loops": (0.68, 0.48, 0.40, 0.28, 0.43, 0.17, 0.30, 0.34),
    "pyshoe_vicon": (0.024, 0.026, 0.030, 0.027, 0.047, 0.036),
    "gcp_walks": (0.31, 0.32, 0.65, 0.41, 0.63, 2.98),
    "xio_loops": (0.32, 0.04),
}
CASES = {"without": False, "with": True}
BETWEEN = 5e-4  # rad/s, 1-sigma by which a gyro's bias changes from one walk to the next


@dataclass(frozen=True)
class Before:
    """What the walk before tells of the gyro's bias, in the sensor's own axes."""

    day: str
    bias: np.ndarray  # (3,) rad/s
    covariance: np.ndarray  # (3, 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", default=",".join(SETS), help="folders, comma separated (%(default)s)")
    parser.add_argument("--gaps", type=int, default=0, help="times without pieces of the log (%(default)s)")
    parser.add_argument("--scatter", type=float, default=0.0, help="s, 1-sigma of the stamps (%(default)s)")
    options = parser.parse_args()
    folder = Path(os.environ["GRAPHNAV_DATA"])
    if options.gaps or options.scatter:
        damage = lose_pieces if options.gaps else partial(scatter_stamps, options.scatter)
        list_damaged(folder, options.sets.split(","), damage, options.gaps or 1)
        return
    print("| walk | s | plain filter | " + " | ".join(f"{s}, {c} lateral" for c in CASES for s in SOLVERS), end="")
    print(" | batch, in stance | batch, stances once | batch, point fitted | batch, bias before", end="")
    print(f" | up, m: {', '.join(SOLVERS)} | stride | NEES hor. | NEES up | s per min |")
    print("|" + " --- |" * (3 + len(CASES) * len(SOLVERS) + 9))
    for name in options.sets.split(","):
        rows, before = [], None
        for plain, path in zip(PLAIN[name], sorted((folder / name).glob("*.toml")), strict=True):
            row, before = one(path, plain, SETS[name], before)
            rows.append(row)
        median = [f"{np.median([row[k] for row in rows]):.3f}" for k in range(len(rows[0]))]
        print(f"| **{name}, median** | | {' | '.join(median)} |" + " |" * 5)


def list_damaged(
    folder: Path, sets: list[str], damage: Callable[[Recording, np.random.Generator], Recording], draws: int
) -> None:
    columns = [f"{what}, {solver}" for what in ("m", "NEES hor.") for solver in SOLVERS]
    print(f"| walk | {' | '.join(columns)} |\n|{' --- |' * (1 + len(columns))}")
    for name in sets:
        rows = []
        for path in sorted((folder / name).glob("*.toml")):
            recording, errors = load(path), []
            for draw in range(draws):
                solutions = run(damage(recording, np.random.default_rng(draw)))
                stated = SETS[name]
                sigma = estimate_floor_sigma(recording, solutions["batch"]) if stated is None else stated
                found = [compute_walk_errors(recording, solutions[solver], sigma) for solver in SOLVERS]
                errors.append([*(one.horizontal for one in found), *(one.nees_h for one in found)])
            off, nees = np.hsplit(np.array(errors), 2)
            rows.append([*np.sqrt((off**2).mean(axis=0)), *nees.mean(axis=0)])
            print(f"| {recording.name} | {format_row(rows[-1])} |", flush=True)
        print(f"| **{name}, median** | {format_row(np.median(rows, axis=0))} |", flush=True)


def format_row(row: Iterable[float]) -> str:
    return " | ".join(f"{x:.{3 if k < len(SOLVERS) else 2}f}" for k, x in enumerate(row))


def lose_pieces(recording: Recording, rng: np.random.Generator) -> Recording:
    """The recording without six pieces of the IMU's rows after the first quarter."""
    t = recording.imu.t
    keep = np.ones(len(t), dtype=bool)
    for _ in range(6):
        begin = t[rng.integers(len(t) // 4, len(t) - 200)]
        keep &= (t <= begin) | (t > begin + rng.uniform(0.015, 0.3))
    return replace(recording, imu=take_rows(recording.imu, keep))


def scatter_stamps(scatter: float, recording: Recording, rng: np.random.Generator) -> Recording:
    """The recording with IMU stamps that scatter by so much (s), in order."""
    t = np.sort(recording.imu.t + scatter * rng.standard_normal(len(recording.imu.t)))
    return replace(recording, imu=replace(recording.imu, t=t + 1e-9 * np.arange(len(t))))


def shown(x: float, digits: int = 3) -> str:
    return f"{x:.{digits}f}" if np.isfinite(x) else "-"


def known_bias(recording: Recording, before: Before | None) -> dict[str, dict[str, object]]:
    """Settings with the gyro bias of the walk before, if that was on the same day."""
    if before is None or before.day != recording.name[:-9]:
        return {}
    R = recording.imu.R_bs
    sigma = np.sqrt(np.max(np.diag(R @ before.covariance @ R.T)) + BETWEEN**2)
    return {"alignment": {"gyro_bias": (R @ before.bias).tolist(), "gyro_bias_sigma": float(sigma)}}


def one(path: Path, plain: float, stated: float | None, before: Before | None) -> tuple[list[float], Before]:
    recording = load(path)
    found: dict[tuple[str, str], WalkErrors] = {}
    spent = 0.0
    for case, lateral in CASES.items():
        began = time.process_time()
        solutions = run(recording, parse_settings({"foot": {"lateral": lateral}}))
        spent = spent or time.process_time() - began
        truth_sigma = estimate_floor_sigma(recording, solutions["batch"]) if stated is None else stated
        for solver, solution in solutions.items():
            found[case, solver] = compute_walk_errors(recording, solution, truth_sigma)
    horizontal = [found[case, solver].horizontal for case in CASES for solver in SOLVERS]
    b = found["without", "batch"]
    chained = run(recording, parse_settings(known_bias(recording, before)), ("batch",))["batch"]
    helped = compute_walk_errors(recording, chained, truth_sigma).horizontal
    R = recording.imu.R_bs
    now = Before(recording.name[:-9], R.T @ chained.states.bg[-1], R.T @ chained.covariance[-1][12:15, 12:15] @ R)
    rate = 60.0 * spent / recording.duration
    up = ", ".join(shown(found["without", solver].up) for solver in SOLVERS)
    print(
        f"| {recording.name} | {recording.duration:.0f} | {plain:g} | "
        + " | ".join(f"{x:.3f}" for x in horizontal)
        + f" | {b.in_stance:.3f} | {b.of_steps:.3f} | {b.of_point:.3f} | {helped:.3f} | {up} | "
        f"{shown(b.stride)} | {b.nees_h:.2f} | {shown(b.nees_up, 2)} | {rate:.2f} |",
        flush=True,
    )
    return [plain, *horizontal, b.in_stance, b.of_steps, b.of_point, helped], now


if __name__ == "__main__":
    main()
