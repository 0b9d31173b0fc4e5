"""Whether the sigmas of the online smoother are true, beside those of filter and smoother offline.

Simulated drives (that of scripts/benchmark.py, ten minutes) have fixes with white errors of the stated sigmas alone, or
with lasting ones besides: Gauss-Markov processes of the sizes and times at which the noise model's priors have their
medians, drawn anew for each seed. Then recordings with a truth, of GRAPHNAV_DATA. A row is a mean over the seeds.

    python scripts/online_sigmas.py --seeds 3 --recordings oracle_drive tokyo_20201105

With `--profile` it prints instead what the innovations' log-likelihood gains as the part of the fixes' errors that
lasts for hours is given other sizes, in stated variances, than none; all else is as estimated.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle
from benchmark_online import estimate
from online_tracks import run_online

from graphnav import load, run
from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.core.trajectory import Trajectory
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.solvers.ekf import refilter
from graphnav.evaluation.against import find_antenna_lever_arm
from graphnav.evaluation.evaluate import find_truth
from graphnav.evaluation.scoring import compute_errors
from graphnav.recording import Recording

LASTING = ((0.25, 3.0), (0.5, 100.0), (0.5, 3600.0))  # share of the stated variance, and correlation time, s
SECONDS = 600.0
DENSE = 0.25  # s between rows of a truth that are interpolated


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of each drive (%(default)s)")
    parser.add_argument("--recordings", nargs="*", default=[])
    parser.add_argument("--profile", action="store_true", help="the likelihood of errors that last for hours")
    options = parser.parse_args()
    if options.profile:
        profile([simulated("white", seed, options.seconds) for seed in range(options.seeds)])
        return
    print("| drive | errors of fixes | noise | solver | hor. rms, m | up rms, m | NEES hor. | NEES up |")
    print("|" + " --- |" * 4 + " ---: |" * 4, flush=True)
    for kind in ("white", "lasting") if options.seeds else ():
        drives = [simulated(kind, seed, options.seconds) for seed in range(options.seeds)]
        for mode in ("stated", "estimated"):
            tabulate("simulated", kind, mode, drives)
    for name in options.recordings:
        recording = load(Path(os.environ["GRAPHNAV_DATA"]) / name)
        tabulate(name, "as recorded", "estimated", [recording.crop(0.0, min(options.seconds, recording.duration))])


def simulated(kind: str, seed: int, seconds: float) -> Recording:
    path = oracle.vehicle_path(seconds, 200.0)
    recording, _ = oracle.drive(path, seed=seed, outages=oracle.moving_spans(path, 60.0, 1), odometer_rate=20.0)
    gnss, rng = recording.gnss, np.random.default_rng([seed, 99])
    assert gnss is not None
    if kind == "white":
        return recording
    error = np.zeros((len(gnss.t), 3))
    for share, time in LASTING:
        x = rng.standard_normal(3)
        for k, step in enumerate(np.diff(gnss.t, prepend=gnss.t[:1])):
            decay = np.exp(-step / time)
            x = decay * x + np.sqrt(1.0 - decay**2) * rng.standard_normal(3)
            error[k] += np.sqrt(share) * gnss.sd[k] * x
    frame = LocalFrame(gnss.llh[0])
    return replace(recording, gnss=replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + error)))


def tabulate(name: str, kind: str, mode: str, drives: list[Recording]) -> None:
    found: dict[str, list[np.ndarray]] = {}
    for recording in drives:
        for solver, whole, arms in solve(recording, mode):
            found.setdefault(solver, []).append(measure(whole, arms, recording))
    for solver, some in found.items():
        h, up, nees_h, nees_up = np.mean(some, axis=0)
        print(
            f"| {name} | {kind} | {mode} | {solver} | {h**0.5:.4f} | {up**0.5:.4f} | {nees_h:.2f} | {nees_up:.2f} |",
            flush=True,
        )


def solve(recording: Recording, mode: str) -> Iterator[tuple[str, Trajectory, np.ndarray]]:
    """Filter and smoother offline, window and iSAM2 online, as they settle and at once; and the antenna's arms."""
    solutions = run(recording, parse_settings({"noise": {"mode": mode}}), ("ekf", "rts"))
    for solver, solution in solutions.items():
        arm = find_antenna_lever_arm(recording, solution)
        assert arm is not None
        yield f"{solver}, offline", solution.trajectory(), arm
    for engine in ("window", "isam2"):
        _, tracks = run_online(recording, parse_settings({"noise": {"mode": mode}, "solver": {"engine": engine}}))
        for name, track in tracks.items():
            whole, antenna = track.join()
            assert antenna.lever_arm is not None
            yield f"{engine}, {name}", whole, antenna.lever_arm


def measure(whole: Trajectory, arms: np.ndarray, recording: Recording) -> np.ndarray:
    """(4,) mean squares of horizontal and upward errors, and NEES of both per degree of freedom."""
    truth, of = find_truth(recording) or (None, None)
    assert truth is not None
    k = np.clip(np.searchsorted(truth.t, whole.t), 1, len(truth.t) - 1)
    near = whole.t[(whole.t <= truth.t[-1]) & (truth.t[k] - truth.t[k - 1] < DENSE)]
    found = compute_errors(whole, truth, lever_arm=None if of is None else arms, at=near)
    e = np.nanmean(np.column_stack([found.p**2, found.nees_axis]), axis=0)
    return np.array([e[0] + e[1], e[2], 0.5 * (e[3] + e[4]), e[5]])


def profile(drives: list[Recording]) -> None:
    factors = (1e-6, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0)
    print("| seed | " + " | ".join(f"{factor:g}" for factor in factors) + " |\n" + "| ---: " * (1 + len(factors)) + "|")
    for seed, recording in enumerate(drives):
        base, found = estimate(recording, Settings())
        found_so = []
        for factor in factors:
            lasting = {
                n: replace(f, log_factor=np.log(factor)) for n, f in found.noise.figures.items() if ".hours." in n
            }
            used = apply_noise(base, replace(found.noise, figures={**found.noise.figures, **lasting}))
            found_so.append(refilter(used, found.carry_points(base, used), whole=False).log_likelihood.sum())
        print(f"| {seed} | " + " | ".join(f"{x - found_so[0]:.2f}" for x in found_so) + " |", flush=True)


if __name__ == "__main__":
    main()
