"""Raw GNSS coupled tightly beside fixes coupled loosely, on tokyo_20201105: 863 s of codes and Doppler shifts on L1.

    python scripts/reproduce_tight.py ../shared/data/tokyo_20201105 -o build/tight

Prints horizontal errors (50 %, 95 %, largest, rms), that of height (95 %) and NEES per degree of freedom against the
trusted RTK epochs, of the antenna, for filter, smoother and batch; and the time and memory that a coupling takes.
`receiver` is the u-blox' own real-time fixes, which are RTK for the most part; `single` and `base` are without and with
the base station 0.3 km away, `loose` the single-point fixes that the same observations make, `tight` the observations
themselves. With `--without-odometer` wheel speeds are left out, with `--end` only the first seconds are used.

Recordings are written into the output folder: they name the files of the data, which stay where they are.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.config import parse_settings
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.evaluation.against import find_antenna_lever_arm
from graphnav.recording import Recording
from graphnav.recording.formats import read

Array = np.ndarray
LAST = 863.0  # s, where the raw observations end
SOLVERS = ("ekf", "rts", "batch")
RAW = """
[raw_gnss]
rover = "{data}/raw/rover_gps_qzss_L1.csv.gz"
nav = "{data}/raw/base.nav.gz"{base}
corrected = ["clock", "troposphere"]
stamps = "nominal"
lever_arm = [0.0, 0.0, 0.6]

[raw_gnss.columns]
t = "t_s"
qzss = "is_qzss"
code = "pr_corrected_m"
range_rate = "doppler_range_rate_mps"
cn0 = "cn0_dbhz"
"""
BASE = """
base = "{data}/raw/base_GQ_L1.obs.gz"
base_position = [-3961905.0100, 3348993.7800, 3698211.8200]"""
# name: (with raw observations, with a base, settings of [raw_gnss])
COUPLINGS: dict[str, tuple[bool, bool, dict[str, Any]]] = {
    "receiver, loose": (False, False, {}),
    "single, loose": (True, False, {"coupling": "loose"}),
    "single, tight: code": (True, False, {"coupling": "tight", "doppler": False}),
    "single, tight: code, Doppler": (True, False, {"coupling": "tight"}),
    "base, loose": (True, True, {"coupling": "loose"}),
    "base, tight: code, Doppler": (True, True, {"coupling": "tight"}),
}


def recording_of(data: Path, folder: Path, raw: bool, base: bool) -> Recording:
    """The drive with its raw observations in place of its fixes, or as it is."""
    if not raw:
        return read(data)
    text = (data / "recording.toml").read_text(encoding="utf-8")
    head, _, rest = text.partition("[gnss]")
    rest = rest[rest.index("[odometer]") :]
    text = head.replace("[imu]", 'clock = "2020-11-05T05:14:42Z"\n\n[imu]', 1)
    text += RAW.format(data=data, base=BASE.format(data=data) if base else "") + "\n" + rest
    for name in ("imu.csv.gz", "odo.csv.gz", "truth.csv.gz"):
        text = text.replace(f'"{name}"', f'"{data}/{name}"')
    path = folder / f"{'base' if base else 'single'}.toml"
    path.write_text(text, encoding="utf-8")
    return read(path, allow_outside=True)


def score(solution: Solution, recording: Recording) -> tuple[float, ...]:
    """H50, H95, Hmax, H rms, U95 (m) and NEES of the horizontal and of all, at the truth's epochs."""
    truth, frame = recording.truth, solution.frame
    assert truth is not None
    assert truth.llh is not None
    arm = find_antenna_lever_arm(recording, solution)
    assert arm is not None
    used = (truth.t >= solution.t[0]) & (truth.t <= min(solution.t[-1], LAST))
    t = truth.t[used]
    k = np.clip(np.searchsorted(solution.t, t), 0, len(solution.t) - 1)
    p = np.stack([np.interp(t, solution.t, solution.states.p[:, i]) for i in range(3)], -1)
    e = p + solution.states.R_nb[k] @ arm - frame.from_llh(truth.llh[used])
    P = solution.covariance[k][:, 3:6, 3:6]
    h = np.hypot(e[:, 0], e[:, 1])
    whole = np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e) / 3.0
    flat = np.einsum("ni,nij,nj->n", e[:, :2], np.linalg.inv(P[:, :2, :2]), e[:, :2]) / 2.0
    size = (*np.percentile(h, [50, 95, 100]), np.sqrt(np.mean(h**2)), np.percentile(np.abs(e[:, 2]), 95))
    return *map(float, size), float(flat.mean()), float(whole.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--end", type=float, default=LAST)
    parser.add_argument("--only", action="append", help="couplings whose name begins so; repeatable")
    parser.add_argument("--without-odometer", action="store_true")
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    print(
        f"{'coupling':30} {'solver':6} {'H50':>6} {'H95':>6} {'max':>7} {'rms':>6} {'U95':>6} {'NEES H':>7} {'NEES':>6}"
    )
    for name, (raw, base, chosen) in COUPLINGS.items():
        if given.only and not any(name.startswith(one) for one in given.only):
            continue
        recording = recording_of(given.data.resolve(), given.output.resolve(), raw, base).crop(0.0, given.end)
        if given.without_odometer:
            recording = recording.without("odometer")
        began = time.process_time()
        solutions = run(recording, parse_settings({"raw_gnss": chosen}), SOLVERS)
        seconds = time.process_time() - began
        for solver, one in solutions.items():
            h50, h95, most, rms, up, flat, whole = score(one, recording)
            print(
                f"{name:30} {solver:6} {h50:6.2f} {h95:6.2f} {most:7.2f} {rms:6.2f} {up:6.2f} {flat:7.2f} {whole:6.2f}"
            )
        hours = recording.duration / 3600.0
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        print(
            f"{'':30} {seconds:.0f} s of processor time, {seconds / hours:.0f} s per hour of data; {peak:.0f} MB so far"
        )


if __name__ == "__main__":
    main()
