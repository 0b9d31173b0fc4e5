"""All real walks through every solver, with and without the lateral constraint, in one table.

    GRAPHNAV_DATA=... python scripts/walks.py

Errors are the closure of loops, else the rms after yaw and offset are fitted to the truth; NEES per degree of freedom.
"point fitted": the same with the place on the foot fitted that the truth is of, which no recording states.
"plain filter" is what a nine-state zero-velocity filter of the usual kind reached on the same recordings.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import numpy as np

from graphnav import load
from graphnav.config import settings_from
from graphnav.pipeline import SOLVERS, run
from graphnav.strides import WalkErrors, walk_errors

# m: how far a coordinate of the truth may be off. Markers 2 to 6 cm from the IMU on a foot that pitches, and their
# noise; points measured by hand where the shoe stood; the footprint that a loop ends in
SETS = {"openshoe_loops": 0.0, "pyshoe_vicon": 0.03, "gcp_walks": 0.03, "xio_loops": 0.0}
PLAIN = {
    "openshoe_loops": (0.68, 0.48, 0.40, 0.28, 0.43, 0.17, 0.30, 0.34),
    "pyshoe_vicon": (0.024, 0.026, 0.030, 0.027, 0.047, 0.036),
    "gcp_walks": (0.31, 0.32, 0.65, 0.41, 0.63, 2.98),
    "xio_loops": (0.30, 0.04),
}
CASES = {"without": False, "with": True}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", default=",".join(SETS), help="folders, comma separated (%(default)s)")
    options = parser.parse_args()
    folder = Path(os.environ["GRAPHNAV_DATA"])
    print("| walk | s | plain filter | " + " | ".join(f"{s}, {c} lateral" for c in CASES for s in SOLVERS), end="")
    print(f" | batch, point fitted | up, m: {', '.join(SOLVERS)} | stride | NEES hor. | NEES up | s per min |")
    print("|" + " --- |" * (3 + len(CASES) * len(SOLVERS) + 6))
    for name in options.sets.split(","):
        rows = []
        for plain, path in zip(PLAIN[name], sorted((folder / name).glob("*.toml")), strict=True):
            rows.append(one(path, plain, SETS[name]))
        median = [f"{np.median([row[k] for row in rows]):.3f}" for k in range(len(rows[0]))]
        print(f"| **{name}, median** | | {' | '.join(median)} |" + " |" * 6)


def shown(x: float, digits: int = 3) -> str:
    return f"{x:.{digits}f}" if np.isfinite(x) else "-"


def one(path: Path, plain: float, truth_sigma: float) -> list[float]:
    recording = load(path)
    found: dict[tuple[str, str], WalkErrors] = {}
    spent = 0.0
    for case, lateral in CASES.items():
        began = time.perf_counter()
        solutions = run(recording, settings_from({"foot": {"lateral": lateral}}))
        spent = spent or time.perf_counter() - began
        for solver, solution in solutions.items():
            found[case, solver] = walk_errors(recording, solution, truth_sigma)
    horizontal = [found[case, solver].horizontal for case in CASES for solver in SOLVERS]
    b = found["without", "batch"]
    rate = 60.0 * spent / recording.duration
    up = ", ".join(shown(found["without", solver].up) for solver in SOLVERS)
    print(
        f"| {recording.name} | {recording.duration:.0f} | {plain:g} | "
        + " | ".join(f"{x:.3f}" for x in horizontal)
        + f" | {b.of_point:.3f} | {up} | {shown(b.stride)} | {b.nees_h:.2f} | "
        f"{shown(b.nees_up, 2)} | {rate:.2f} |",
        flush=True,
    )
    return [plain, *horizontal]


if __name__ == "__main__":
    main()
