"""Ushaq on simulated drives: every scheme of Fig. 19, with its GNSS faults, and the solvers that resist them.

    python scripts/reproduce_ushaq.py --seeds 3 -o build/ushaq

An hour on a square, GNSS faults at 18-25 and 43-47 min: noise a hundred times larger, an error that grows by 1 m/s, or
no fixes. Prints position and velocity errors (RMS and largest, over the floor) inside and outside those spans, and the
time after them until the position error is back below 50 m, twice the noise of a fix (looked at for 300 s). `plain`
takes every fix as its sigma says, as the paper's filter does; `gate` refuses what is beyond 5 sigma of a whole
innovation, `kernel` weighs by Tukey's kernel from there (the filter by Cauchy's); `default` is what graphnav does
unasked; `by hand` is plain with the sigmas of what is wrong so large that it has no say. The paper prints no table:
what its figures show is in the rows marked so. All is simulated; means over the seeds, the worst seed in brackets.

Results are kept in the output folder, one file for each run: what is there already is not run again, and with `--kept`
nothing is run and the table is of what is there.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.config import Settings, parse_settings
from graphnav.core.errors import EstimationError
from graphnav.estimation.pipeline import run
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording
from graphnav.simulation import Simulated, simulate
from graphnav.simulation.scenarios.ushaq import FAULTS

Array = np.ndarray
BACK = 50.0  # m, below which a solution has recovered
SOLVERS = ("ekf", "rts", "incremental", "batch")
AFTER = 300.0  # s after a fault that still count as its consequence
# name: (options of the scenario, sources)
SCHEMES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "INS": ({}, ()),
    "INS/ZUPT, 10 min": ({"stops_every": 10.0}, ("stops",)),
    "INS/GNSS": ({}, ("gnss",)),
    "growing": ({"fault": "growing"}, ("gnss",)),
    "noise x100": ({"fault": "noise"}, ("gnss",)),
    "outage": ({"fault": "outage"}, ("gnss",)),
    "growing, in velocity too": ({"fault": "growing", "growth_in_velocity": True}, ("gnss",)),
    "growing, in velocity too/NHC": ({"fault": "growing", "growth_in_velocity": True}, ("gnss", "nhc")),
    "growing, in velocity too/wheels": (
        {"fault": "growing", "growth_in_velocity": True, "odometer": True}, ("gnss", "nhc", "odometer")),
    "growing/ZUPT, 20 min": ({"fault": "growing", "stops_every": 20.0}, ("gnss", "stops")),
    "noise x100/ZUPT, 20 min": ({"fault": "noise", "stops_every": 20.0}, ("gnss", "stops")),
    "outage/ZUPT, 20 min": ({"fault": "outage", "stops_every": 20.0}, ("gnss", "stops")),
}  # fmt: skip
PAPER = {
    "INS": "4 km in latitude, 10 km in longitude, vertical velocity to 150 m/s (Fig. 2-4)",
    "INS/ZUPT, 10 min": "grows between stops, better than INS (Fig. 13-15)",
    "INS/GNSS": "almost coincident with the ideal (Fig. 5-8)",
    "noise x100": "some deviation (Fig. 9-10)",
    "growing": "havoc, recovers only with GNSS (Fig. 11-12)",
    "growing/ZUPT, 20 min": "stays within bounds (Fig. 16-18)",
}
PLAIN = {"faults": "off", "robust": "off", "gate": "off", "time_offset_sigma": 0.0}  # and noise as stated
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": PLAIN,
    "gate": {**PLAIN, "gate": 5.0},
    "kernel": {**PLAIN, "robust": "tukey", "robust_scale": 5.0},
    "default": {},
    "by hand": PLAIN,
}
COLUMNS = ("inside, RMS m", "max m", "outside, RMS m", "max m", "inside, RMS m/s", "max m/s", "outside, RMS m/s",
           "max m/s", "recovers, s")  # fmt: skip


def settings_of(variant: str, sources: tuple[str, ...]) -> Settings:
    """The paper knows nothing of wheels; its stops give a velocity and no more; its INS starts aligned."""
    return parse_settings(
        {
            "alignment": {} if "gnss" in sources else {"heading": 90.0, "heading_sigma": 0.5},
            "vehicle": {"nhc": "nhc" in sources, "odometer": "odometer" in sources},
            "gnss": VARIANTS[variant],
            "noise": {"mode": "estimated" if variant == "default" else "stated"},
            "standstill": {"zero_velocity": "stops" in sources, "zero_rate": False, "held_position": False},
        }
    )


def by_hand(recording: Recording, options: dict[str, Any]) -> Recording:
    """The recording with sigmas of a thousand kilometres where positions are wrong, and likewise velocities."""
    gnss = recording.gnss
    assert gnss is not None
    assert gnss.sd_v is not None
    wrong = np.any([(gnss.t >= a) & (gnss.t <= b) for a, b in FAULTS], axis=0)[:, None]
    also = options["fault"] == "noise" or options.get("growth_in_velocity", False)
    sd, sd_v = np.where(wrong, 1e6, gnss.sd), np.where(wrong & also, 1e6, gnss.sd_v)
    return replace(recording, gnss=replace(gnss, sd=sd, sd_v=sd_v))


def figures(solution: Solution, made: Simulated) -> Array:
    """The columns' values."""
    mine, truth = solution.trajectory(), made.recording.truth
    assert truth is not None
    assert truth.llh is not None
    assert truth.v is not None
    assert mine.v is not None
    frame = solution.frame

    def at(x: Array) -> Array:
        return np.stack([np.interp(mine.t, truth.t, column) for column in x.T], -1)

    p = np.linalg.norm((frame.from_llh(mine.llh) - at(frame.from_llh(truth.llh)))[:, :2], axis=1)
    v = np.linalg.norm((mine.v - at(truth.v))[:, :2], axis=1)
    spans = [(a, b) for a, b in FAULTS if b < mine.t[-1]]
    inside = np.any([(mine.t >= a) & (mine.t <= b) for a, b in spans], axis=0)
    out: list[float] = []
    for error in (p, v):
        for mask in (inside, ~inside):
            out += [float(np.sqrt(np.mean(error[mask] ** 2))), float(error[mask].max())]
    late = []
    for _, b in spans:
        after = (mine.t > b) & (mine.t <= b + AFTER)
        bad = np.flatnonzero(p[after] > BACK)
        late.append(0.0 if not len(bad) else float(mine.t[after][bad[-1]] - b))
    return np.array([*out, max(late)])


def solved(
    name: str, variant: str, seed: int, solvers: tuple[str, ...], rate: float, kept: Path, only: bool
) -> dict[str, Array]:
    """The columns by solver, from the file of the run where it is there; with `only` from nowhere else."""
    words = f"{name} {variant} {seed} {rate:g}"
    file = kept / ("".join(c if c.isalnum() else "-" for c in words) + ".json")
    have = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    missing = tuple(solver for solver in solvers if solver not in have)
    if missing and not only:
        options, sources = SCHEMES[name]
        made = simulate("ushaq", seed, rate=rate, **options)
        recording = made.recording
        if "gnss" not in sources:
            # ten seconds of fixes give the start
            recording = recording.without("gnss", (10.0, recording.duration + 1.0))
        elif variant == "by hand":
            recording = by_hand(recording, options)
        for solver, solution in run(recording, settings_of(variant, sources), missing).items():
            have[solver] = figures(solution, made).tolist()
        file.write_text(json.dumps(have), encoding="utf-8")
    return {solver: np.array(have[solver]) for solver in solvers if solver in have}


def variants_of(name: str, asked: list[str]) -> list[str]:
    """Those that make a difference to a scheme."""
    options, sources = SCHEMES[name]
    known = [*VARIANTS] if options.get("fault", "outage") != "outage" else [v for v in VARIANTS if v != "by hand"]
    return [v for v in known if v in asked] if "gnss" in sources else ["plain"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rate", type=float, default=50.0, help="Hz, of the IMU")
    parser.add_argument("--schemes", nargs="*", default=list(SCHEMES), choices=list(SCHEMES))
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--solvers", nargs="*", default=list(SOLVERS), choices=list(SOLVERS))
    parser.add_argument("--kept", action="store_true", help="print what is in the output folder, run nothing")
    parser.add_argument("-o", "--out", type=Path, default=Path("build/ushaq"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    lines = ["Simulated: mean (worst) of so many seeds. Errors over the floor.", ""]
    lines += [f"| scheme | variant | solver | seeds | {' | '.join(COLUMNS)} |", "|" + " --- |" * (4 + len(COLUMNS))]
    print("\n".join(lines), flush=True)
    for name in options.schemes:
        if name in PAPER:
            lines.append(f"| {name} | paper | | | {PAPER[name]} |" + " |" * (len(COLUMNS) - 1))
            print(lines[-1], flush=True)
        for variant in variants_of(name, options.variants):
            found: dict[str, list[Array]] = {}
            for seed in range(options.seeds):
                try:
                    done = solved(name, variant, seed, tuple(options.solvers), options.rate, options.out, options.kept)
                except EstimationError as error:
                    print(f"{name}, {variant}, seed {seed}: {error}", flush=True)
                    continue
                for solver, values in done.items():
                    found.setdefault(solver, []).append(values)
            for solver, rows in found.items():
                x = np.array(rows)
                cells = [f"{m:.3g} ({w:.3g})" for m, w in zip(x.mean(axis=0), x.max(axis=0), strict=True)]
                lines.append(f"| {name} | {variant} | {solver} | {len(rows)} | {' | '.join(cells)} |")
                print(lines[-1], flush=True)
    (options.out / "ushaq.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
