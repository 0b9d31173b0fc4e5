"""iSAM2's states and covariances beside the batch solver's over the whole drive, and beside the window's within a lag.

    GRAPHNAV_DATA=../shared/data python scripts/isam2_beside_batch.py

All settings are the defaults; the noise model is estimated once for each recording. A state that has settled with two
minutes of the future knows less than batch does: a third line has what that makes of it. The keyframes of the last two
minutes have seen as much as batch has, and of what came before what was marginalised: the last line is of them.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from graphnav import load
from graphnav.config import Settings, settings_from
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution

RECORDINGS = ("kitti", "gcp_walks/walk31.toml", "oracle_drive", "tokyo_20201105")
LONGEST = 600.0  # s that are used of a recording
LAG = 120.0  # s


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--recordings", nargs="+", default=RECORDINGS, help="among the recordings, or built in (%(default)s)"
    )
    options = parser.parse_args()
    data = Path(os.environ.get("GRAPHNAV_DATA", "../shared/data"))
    print("Median / 99 % / most over the keyframes\n")
    print("| recording | beside | apart, cm | apart, sigmas of that | sigmas, of those: least, most |")
    print("| --- | --- | --- | --- | --- |", flush=True)
    for name in options.recordings:
        recording = load(data / name if (data / name).exists() else name).crop(0.0, LONGEST)
        found = run(recording, Settings(), ("batch", "isam2"))
        best = found["batch"]
        tell(name, "batch", found["isam2"], best)
        lag = settings_from({"solver": {"isam2_lag": LAG, "lag": LAG}})
        settled = run(recording, lag, ("incremental", "isam2"), noise=best.noise)
        tell(name, f"window, both {LAG:.0f} s", settled["isam2"], settled["incremental"])
        tell(name, f"batch, {LAG:.0f} s", settled["isam2"], best)
        tell(name, f"batch, {LAG:.0f} s, at the end", settled["isam2"], best, LAG)


def tell(name: str, beside: str, found: Solution, best: Solution, last: float = np.inf) -> None:
    some = best.t >= best.t[-1] - last
    sigma, own = (np.sqrt(np.diagonal(x.covariance[some], axis1=1, axis2=2)) for x in (best, found))
    off = np.abs(found.states.minus(best.states))[some]
    cm = np.quantile(100.0 * np.linalg.norm(off[:, 3:6], axis=1), [0.5, 0.99, 1.0])
    sigmas = np.quantile((off / sigma).max(axis=1), [0.5, 0.99, 1.0])
    ratio = own / sigma
    cells = [" / ".join(f"{x:.4f}" for x in some) for some in (cm, sigmas)]
    print(f"| {name} | {beside} | {' | '.join(cells)} | {ratio.min():.3f}, {ratio.max():.3f} |", flush=True)


if __name__ == "__main__":
    main()
