"""Zhu 2020 on simulated drives: inertial alone, with constraints (M-C), with the odometer (MO), with both (MO-C).

    python scripts/reproduce_zhu2020.py --seeds 5 -o build/zhu2020

Prints the paper's Tables 2 and 3 beside the errors of EKF, RTS and batch over 90 s without GNSS, then the calibration
found, then the sequence of Fig. 15-18: GNSS for 75 s, none after, the odometer unplugged from 165 to 180 s. The
paper's figures are of real drives with sensors of the same grade; ours are simulated. Errors are of the IMU's
position, means over the seeds and the worst seed.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.estimation.solution import Solution
from graphnav.simulation import Simulated, simulate

Array = np.ndarray
CASES = {"MIMU": (False, False), "M-C": (True, False), "MO": (False, True), "MO-C": (True, True)}  # NHC, odometer
AXES = ("north", "east", "height", "v east", "v north", "v up")
# Tables 2 (post-processed) and 3 (real time): latitude, longitude, height, velocity east, north, up; at 90 s and RMSE
PAPER = {
    "MIMU": {"Table 2, 90 s": (480.1, -150.6, -95.37, -1.189, 7.144, -2.544),
             "Table 2, RMSE": (234.56, 81.31, 40.36, 0.715, 6.121, 1.365)},
    "M-C": {"Table 3, 90 s": (-25.85, -28.80, -3.06, -0.91, 0.27, -0.38),
            "Table 3, RMSE": (16.662, 18.761, 4.931, 0.686, 0.567, 0.367)},
    "MO": {"Table 2, 90 s": (-5.55, -7.30, 18.06, -0.152, -0.225, 0.931),
           "Table 2, RMSE": (8.59, 7.01, 10.34, None, None, None),
           "Table 3, 90 s": (1.74, 4.73, -13.35, 0.03, -0.06, -0.85),
           "Table 3, RMSE": (0.876, 2.910, 7.301, 0.162, 0.060, 0.503)},
    "MO-C": {"Table 2, RMSE": (8.54, 6.93, 2.08, None, None, None),
             "Table 3, 90 s": (1.72, -1.36, -4.38, 0.02, -0.04, -0.23),
             "Table 3, RMSE": (1.911, 2.112, 5.487, 0.142, 0.077, 0.168)},
}  # fmt: skip


def settings_of(case: str) -> Settings:
    """What a case uses; stops are not in the paper."""
    nhc, odometer = CASES[case]
    still = {"zero_velocity": False, "zero_rate": False, "held_position": False}
    return parse_settings({"vehicle": {"nhc": nhc, "odometer": odometer}, "standstill": still})


def errors(solution: Solution, made: Simulated) -> tuple[Array, Array]:
    """Times (K,) and errors (K, 6) in the order of the tables, at the keyframes."""
    truth = made.recording.truth
    assert truth is not None
    assert truth.llh is not None
    assert truth.v is not None
    frame = LocalFrame(solution.frame.origin)
    t = solution.t

    def at(x: Array) -> Array:
        return np.stack([np.interp(t, truth.t, column) for column in x.T], -1)

    C = frame.R_ln(solution.states.p)
    p = np.einsum("kij,kj->ki", C, solution.states.p - at(frame.from_llh(truth.llh)))
    v = np.einsum("kij,kj->ki", C, solution.states.v) - at(truth.v)
    return t, np.concatenate([p[:, [1, 0, 2]], v], axis=1)


def row(head: str, values: Array | tuple[float | None, ...]) -> str:
    return f"| {head} | " + " | ".join("" if x is None else f"{x:.2f}" for x in values) + " |"


def tables(seeds: range) -> None:
    found: dict[tuple[str, str], list[tuple[Array, Array]]] = {}
    calibration: dict[str, list[Array]] = {name: [] for name in SOLVERS}
    for seed in seeds:
        made = simulate("zhu2020", seed, unplugged=False, after_s=90.0)
        lost = made.facts["gnss_lost_s"] + made.recording.start
        for case in CASES:
            for name, solution in run(made.recording, settings_of(case)).items():
                t, e = errors(solution, made)
                dark = t > lost
                rmse = np.sqrt(np.mean(e[dark] ** 2, axis=0))
                found.setdefault((case, name), []).append((np.abs(e[-1]), rmse))
                if case == "MO-C":
                    calibration[name].append(calibrated(solution, made))
    print(
        f"\nErrors over 90 s without GNSS, m and m/s; ours simulated, {len(seeds)} seeds: mean (of sizes) and worst\n"
    )
    print(f"| case | {' | '.join(AXES)} |\n|{' --- |' * 7}")
    for case in CASES:
        for head, values in PAPER[case].items():
            print(row(f"{case}, paper, {head}", values))
        for name in SOLVERS:
            for k, what in enumerate(("90 s", "RMSE")):
                size = np.array([x[k] for x in found[case, name]])
                print(row(f"{case}, {name}, {what}, mean", size.mean(axis=0)))
                print(row(f"{case}, {name}, {what}, worst", size.max(axis=0)))
    print("\nCalibration found in MO-C less truth, and its sigma\n")
    print("| solver | mounting pitch, deg | sigma | heading, deg | sigma | scale, % | sigma |\n|" + " --- |" * 7)
    for name, rows in calibration.items():
        size = np.abs(np.array(rows))
        print(row(f"{name}, mean size", size.mean(axis=0)))
        print(row(f"{name}, worst", size.max(axis=0)))
    claims = {case: [float(np.hypot(*x[1][:2])) for x in found[case, "batch"]] for case in CASES}
    height = {case: [float(x[1][2]) for x in found[case, "batch"]] for case in CASES}
    print("\nThe paper's claims, batch RMSE, m, mean over the seeds:")
    for case in CASES:
        print(f"  {case:5} horizontal {np.mean(claims[case]):8.2f}   height {np.mean(height[case]):7.2f}")


def calibrated(solution: Solution, made: Simulated) -> Array:
    """Pitch, heading (deg) and scale (%) less the truth, each with its sigma."""
    mounting, scale = solution.parameters["mounting"], solution.parameters["odometer_scale"]
    pitch, heading = (made.facts["mounting_deg"][name] for name in ("pitch", "heading"))
    true_scale = 1.0 / (1.0 + made.facts["odometer_scale_error"]) - 1.0
    off = np.degrees(mounting.value[-1]) - [pitch, heading]
    sigma = np.degrees(mounting.sigma[-1])
    k = 100.0 * (scale.value[-1, 0] - true_scale), 100.0 * scale.sigma[-1, 0]
    return np.array([off[0], sigma[0], off[1], sigma[1], *k])


def sequence(seed: int, folder: Path) -> None:
    """Fig. 15-18."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    made = simulate("zhu2020", seed)
    solutions = run(made.recording, settings_of("MO-C"))
    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    lost, (out, back) = made.facts["gnss_lost_s"], made.facts["odometer_unplugged_s"]
    print(f"\nGNSS until {lost:.0f} s, odometer unplugged {out:.0f} to {back:.0f} s (seed {seed}): error, m")
    heads = [f"horizontal, max to {out:.0f} s", *(f"at {x:.0f} s" for x in (out, back, back + 5)), "max after"]
    heads += [f"speed at {back:.0f} s", f"at {back + 5:.0f} s"]
    print(f"\n| solver | {' | '.join(heads)} |\n|" + " --- |" * (len(heads) + 1))
    for name, solution in solutions.items():
        t, e = errors(solution, made)
        t = t - made.recording.start
        h, v = np.hypot(e[:, 0], e[:, 1]), np.hypot(e[:, 3], e[:, 4])
        at = [int(np.argmin(np.abs(t - x))) for x in (out, back, back + 5.0)]
        values = [h[t <= out].max(), h[at[0]], h[at[1]], h[at[2]], h[t >= back].max(), v[at[1]], v[at[2]]]
        print(row(name, np.array(values)))
        for axis, column, label in zip(
            axes, (h, e[:, 2], v), ("horizontal, m", "height, m", "speed, m/s"), strict=True
        ):
            axis.plot(t, column, label=name)
            axis.set_ylabel(label)
    for axis in axes:
        axis.axvspan(lost, t[-1], color="0.93", zorder=0)
        axis.axvspan(out, back, color="0.8", zorder=0)
        axis.grid(alpha=0.3)
    axes[0].legend()
    axes[0].set_title("Simulated after Zhu 2020, Fig. 15-18: no GNSS (light), odometer unplugged (dark)")
    axes[-1].set_xlabel("s")
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "zhu2020.png", dpi=110)
    print(f"\n{folder / 'zhu2020.png'}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("-o", "--out", type=Path, default=Path("build/zhu2020"))
    options = parser.parse_args()
    tables(range(options.seeds))
    sequence(0, options.out)


if __name__ == "__main__":
    main()
