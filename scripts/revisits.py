"""Heights at places that a drive passes twice: what they differ by, of solutions and of the fixes.

    GRAPHNAV_DATA=... python scripts/revisits.py kitti boulder

The road is as high as the time before, whatever satellites say. Pairs are within 1.5 m of each other horizontally, 20 s
apart or more, and not standing; one pair in 2 s of the way.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np
from do_no_harm import DRIVES, load, placed, settings_of
from scipy.spatial import cKDTree

import graphnav

Array = np.ndarray
NEAR, APART, MOVING, SPACING = 1.5, 20.0, 2.0, 2.0  # m, s, m/s, s


def find_revisits(solution: graphnav.Solution) -> Array:
    """(n, 2) indices of keyframes at the same place."""
    t, p, v = solution.t, solution.states.p, solution.states.v
    pairs = np.sort(cKDTree(p[:, :2]).query_pairs(NEAR, output_type="ndarray"), axis=1)
    moving = np.linalg.norm(v[:, :2], axis=1) > MOVING
    i, j = pairs.T
    pairs = pairs[(t[j] - t[i] > APART) & moving[i] & moving[j]]
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    _, first = np.unique(np.floor(t[pairs[:, 0]] / SPACING), return_index=True)
    return np.asarray(pairs[first])


def describe(name: str, difference: Array) -> str:
    size = np.abs(difference)
    figures = np.sqrt(np.mean(difference**2)), np.median(size), np.quantile(size, 0.9)
    return f"| {name} | {len(size)} | " + " | ".join(f"{x:.3f}" for x in figures) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", choices=DRIVES)
    for drive in parser.parse_args().drives:
        recording = load(placed(DRIVES[drive], Path(os.environ["GRAPHNAV_DATA"])))
        assert recording.gnss is not None
        recording = recording.crop(*(recording.gnss.t[[0, -1]] - recording.start))
        assert recording.gnss is not None
        found = {}
        for sensors in ("gnss", "+nhc"):
            used = recording if recording.odometer is None else recording.without("odometer")
            for noise in ("stated", "estimated"):
                settings = settings_of(noise, sensors, DRIVES[drive].doppler)
                found[f"{sensors}, {noise}"] = graphnav.run(used, settings, "rts")["rts"]
        last = list(found.values())[-1]
        i, j = find_revisits(last).T
        if not len(i):
            print(f"{drive}: no place twice\n")
            continue
        print(f"{drive}: {np.min(last.t[j] - last.t[i]):.0f} to {np.max(last.t[j] - last.t[i]):.0f} s apart\n")
        print("| heights of | pairs | rms, m | median, m | 90 %, m |\n| --- | --- | --- | --- | --- |")
        fixes = np.interp(last.t, recording.gnss.t, recording.gnss.llh[:, 2])
        print(describe("fixes", fixes[j] - fixes[i]))
        for name, one in found.items():
            height = np.interp(last.t, one.t, one.trajectory(joint=False).llh[:, 2])
            print(describe(name, height[j] - height[i]), flush=True)
        print()


if __name__ == "__main__":
    main()
