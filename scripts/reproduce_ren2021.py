"""Ren 2021 on simulated walks: inertial alone, zero velocity in stance, and no sideways speed in swing as well.

    python scripts/reproduce_ren2021.py --seeds 5 -o build/ren2021

Prints table 2 beside the end-point errors of EKF, RTS and batch, as shares of the distance: means over the seeds and
the worst seed. The paper's walks are real, with a sensor of the same grade; ours are simulated. A smoother's last state
is its filter's, so a second table has the error along the whole way, from the true start and heading. `--compensated`
reads the IMU as one that takes care of coning itself; without it, samples are means over a hundredth of a second and
the program makes up for it. ZUPT holds the pivot of the foot; as the paper has it, it is the IMU itself that stands
still: `--cases "zero velocity of the IMU,zero velocity of the IMU + lateral,lateral alone"`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from graphnav.config import Settings, parse_settings
from graphnav.core import rotation
from graphnav.core.earth import LocalFrame
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.estimation.solution import Solution
from graphnav.simulation import Simulated, simulate

Array = np.ndarray
CASES = {
    "inertial alone": (False, False), "ZUPT": (True, False), "ZUPT + lateral": (True, True),
    "zero velocity of the IMU": (True, False), "zero velocity of the IMU + lateral": (True, True),
    "lateral alone": (False, True),
}  # fmt: skip
USUAL = "inertial alone,ZUPT,ZUPT + lateral"
AS_WRITTEN = {"pivot_sigma": 1e-6, "travel_sigma": 1e-6, "pattern": 0.0}  # of the foot: no pivot but the IMU itself
# Table 2: distance (m), duration (s), end-point error with and without the foot's constraints (% of the distance)
PAPER = (
    (30, 38, 1.23, 223.34), (58, 68, 1.24, 81.52), (58, 67, 1.30, 175.06), (86, 94, 1.36, 316.71),
    (86, 92, 1.27, 284.23), (172, 159, 3.32, 691.39), (172, 176, 1.16, 324.46), (258, 248, 0.87, 518.77),
    (258, 255, 2.76, 745.19), (258, 278, 1.09, 755.57), (344, 365, 1.14, 859.32), (344, 355, 1.93, 395.11),
    (344, 353, 0.99, 1072.86),
)  # fmt: skip


def settings_of(case: str, compensated: bool) -> Settings:
    stance, lateral = CASES[case]
    return parse_settings(
        {
            "foot": {"stance": stance, "lateral": lateral, **(AS_WRITTEN if "IMU" in case else {})},
            "detectors": {"fire": ["glrt"]},
            "standstill": {"zero_rate": stance},
            "imu": {"coning": not compensated},
        }
    )


def ways(solution: Solution, made: Simulated) -> tuple[Array, Array]:
    """(solved, true) places (K, 3), m, from the start, with the solved way turned to the true first heading.

    Without GNSS a walk's heading counts from its start.
    """
    mine, truth = solution.trajectory(), made.truth
    assert mine.rph is not None
    assert truth.rph is not None
    i = np.searchsorted(truth.t, mine.t - 1e-6)
    first = np.interp(mine.t[0], truth.t, np.unwrap(truth.rph[:, 2])) - mine.rph[0, 2]
    p = LocalFrame(mine.llh[0]).from_llh(mine.llh) @ rotation.from_rph(np.array([0.0, 0.0, first])).T
    return p, LocalFrame(truth.llh[0]).from_llh(truth.llh)[np.minimum(i, len(truth) - 1)]


def errors(solution: Solution, made: Simulated) -> tuple[float, float, float]:
    """(end-point error over the floor, in height, RMS over the floor along the way), m."""
    p, true = ways(solution, made)
    off = p - true
    floor = np.hypot(off[:, 0], off[:, 1])
    return float(floor[-1]), float(abs(off[-1, 2])), float(np.sqrt(np.mean(floor**2)))


def solve(made: Simulated, case: str, compensated: bool) -> dict[str, Solution]:
    # without a constraint there is nothing to smooth
    return run(made.recording, settings_of(case, compensated), SOLVERS if any(CASES[case]) else ("ekf",))


def line(head: str, values: list[float], digits: int = 2) -> str:
    return f"| {head} | " + " | ".join(f"{x:.{digits}f}" for x in values) + " |"


def tables(seeds: range, compensated: bool, cases: list[str], walks: list[int]) -> None:
    found: dict[tuple[str, str], Array] = {}
    chosen = [PAPER[number - 1] for number in walks]
    for row, (number, (distance, *_)) in enumerate(zip(walks, chosen, strict=True)):
        for seed in seeds:
            made = simulate("ren2021", seed, walk=number, compensated=compensated)
            for case in cases:
                for name, solution in solve(made, case, compensated).items():
                    store = found.setdefault((case, name), np.zeros((len(walks), len(seeds), 3)))
                    store[row, seed] = np.array(errors(solution, made)) * [100 / distance, 100 / distance, 1.0]
    columns = list(found)
    heads = [f"{case}, {name}" for case, name in columns]
    print(f"\nEnd-point error over the floor, % of the distance; ours simulated, {len(seeds)} seeds: mean (worst)\n")
    print(f"| walk | m | s | paper, alone | paper, constrained | {' | '.join(heads)} |")
    print("|" + " --- |" * (5 + len(heads)))
    for row, (number, (distance, duration, with_, without)) in enumerate(zip(walks, chosen, strict=True)):
        cells = [f"{found[c][row, :, 0].mean():.2f} ({found[c][row, :, 0].max():.2f})" for c in columns]
        print(f"| {number} | {distance} | {duration} | {without:.2f} | {with_:.2f} | {' | '.join(cells)} |")
    cells = [f"{found[c][..., 0].mean():.2f} ({found[c][..., 0].max():.2f})" for c in columns]
    paper = np.array(chosen).mean(axis=0)
    print(f"| mean | | | {paper[3]:.2f} | {paper[2]:.2f} | {' | '.join(cells)} |")
    print("\nMeans over all walks and seeds, and the worst of them\n")
    print("| | end point over the floor, % | worst | height, % | worst | RMS along the way, m | worst |")
    print("|" + " --- |" * 7)
    for c, head in zip(columns, heads, strict=True):
        x = found[c].reshape(-1, 3)
        print(line(head, [value for k in range(3) for value in (x[:, k].mean(), x[:, k].max())]))
    for name in SOLVERS if {"ZUPT", "ZUPT + lateral"} <= set(cases) else ():
        gain = found["ZUPT + lateral", name][..., 2] - found["ZUPT", name][..., 2]
        better = np.mean(gain < 0.0)
        print(f"\n{name}: with the lateral constraint the RMS changes by {gain.mean():+.3f} m on average, {better:.0%}")
        print(f"of the walks are better ({gain.min():+.3f} to {gain.max():+.3f} m)")


def picture(seed: int, folder: Path, compensated: bool) -> None:
    """Fig. 9: walk 10 from above."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    made = simulate("ren2021", seed, walk=10, compensated=compensated)
    figure, axes = plt.subplots(1, 2, figsize=(11, 6), layout="constrained", sharex=True, sharey=True)
    for axis, case in zip(axes, ("ZUPT", "ZUPT + lateral"), strict=True):
        solutions = solve(made, case, compensated)
        axis.plot(*ways(solutions["batch"], made)[1][:, :2].T, color="0.7", lw=3, label="truth")
        for name, solution in solutions.items():
            axis.plot(*ways(solution, made)[0][:, :2].T, lw=0.8, label=name)
        axis.set_title(f"{case}: walk 10 of Ren 2021, simulated (seed {seed})")
        axis.set_aspect("equal")
        axis.grid(alpha=0.3)
        axis.set_xlabel("east, m")
    axes[0].set_ylabel("north, m")
    axes[0].legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "ren2021.png", dpi=110)
    print(f"\n{folder / 'ren2021.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--compensated", action="store_true")
    parser.add_argument("--cases", default=USUAL, help=f"with commas between, some of {', '.join(CASES)}")
    parser.add_argument("--walks", type=int, nargs="+", default=range(1, len(PAPER) + 1), help="by their numbers")
    parser.add_argument("-o", "--out", type=Path, default=Path("build/ren2021"))
    options = parser.parse_args()
    tables(range(options.seeds), options.compensated, options.cases.split(","), list(options.walks))
    if options.cases == USUAL:
        picture(0, options.out, options.compensated)


if __name__ == "__main__":
    main()
