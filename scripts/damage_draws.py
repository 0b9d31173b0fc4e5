"""How well drives are solved that are damaged at random: each draw is a window of a drive with several faults at once.

    python scripts/damage_draws.py -o draws.json --draws 40 --seed 1
    python scripts/damage_draws.py -o draws.json --draws 40 --seed 1 --only 17

What is drawn, and how large, is in `damage_kinds`. Faults: errors of fixes as in street canyons, wrong sigmas, stamps
and lever arms, outages, a worse IMU, wheels that lag, slip or stand below walking pace. Habits of receivers and
loggers: rare, interpolated, rounded, smoothed or held fixes, one sigma for all, an IMU that is slow, coarse, or loses
rows. Every draw is solved as stated with every fix used, with the defaults, and undamaged with the defaults; errors are
against the drive's own truth, or against fixes that are withheld. Rows go to the file as they come.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from damage import STATED
from damage_kinds import FAMILIES
from do_no_harm import DRIVES, HERE, load, placed, withheld_of

import graphnav
from graphnav.app.scores import score
from graphnav.config import parse_settings
from graphnav.constraints.gnss import CLOCK_RATE, TIME_OFFSET
from graphnav.estimation.solution import Solution
from graphnav.evaluation.metrics import summarise
from graphnav.recording import Recording
from graphnav.recording.plausibility.screening import drop_filled

SOLVERS = ("ekf", "rts", "batch")
LENGTHS = 120.0, 300.0  # s, of a window
NAMES = ("tokyo", "tokyo_no_doppler", "boulder", "kitti", "comma", "dresden", "tokyo_clone", "oracle", "circles_2024")


def draw(number: int, options: argparse.Namespace) -> tuple[dict[str, Any], Recording, Recording, bool]:
    """A window and the same damaged, what it is, and whether velocities of fixes are used."""
    rng = np.random.default_rng([options.seed, number])
    name = str(rng.choice(options.drives))
    whole = load(placed(DRIVES[name], options.data))
    assert whole.gnss is not None
    length = min(rng.uniform(*LENGTHS), whole.duration)
    first = max(float(whole.gnss.t[0]) - whole.start, 0.0)
    begin = rng.uniform(first, max(whole.duration - length, first))
    clean = whole.crop(begin, begin + length)
    if clean.odometer is not None and rng.random() < 0.4:
        clean = clean.without("odometer")
    # what damage adds to rows that were filled in would make measurements of them
    used, done = replace(clean, imu=drop_filled(clean.imu, clean.start)[0]), list[str]()
    for fault in FAMILIES[options.family]:
        sensor = getattr(used, fault.sensor)
        if rng.random() < fault.chance and sensor is not None:
            changed, said = fault.damage(sensor, rng)
            used = replace(used, **{fault.sensor: changed})
            done.append(said)
    row = {"draw": number, "drive": name, "window": f"{begin:.0f}-{begin + length:.0f}", "damage": done}
    return row | {"odometer": clean.odometer is not None}, clean, used, DRIVES[name].doppler


def time_as(solution: Solution, undamaged: Solution) -> Solution:
    """The solution with the stamps of the undamaged fixes, which it is compared with."""
    parameters = dict(solution.parameters)
    for name in (TIME_OFFSET, CLOCK_RATE):
        parameters.pop(name, None)
        if name in undamaged.parameters:
            parameters[name] = undamaged.parameters[name]
    return replace(solution, parameters=parameters, noise=replace(solution.noise, stamps=undamaged.noise.stamps))


def solve(number: int, options: argparse.Namespace) -> dict[str, Any]:
    row, clean, used, doppler = draw(number, options)
    withheld = withheld_of(clean, clean.duration) if clean.truth is None else ()
    estimated: dict[str, dict[str, Any]] = {"gnss": {"velocity": doppler}}
    stated = {"noise": STATED["noise"], "gnss": STATED["gnss"] | estimated["gnss"]}
    undamaged: dict[str, Solution] = {}
    for variant, part, values in (
        ("clean", clean, estimated),
        ("stated", used, stated),
        ("estimated", used, estimated),
    ):
        for source, span in withheld:
            part = part.without(source, span)
        began = time.process_time()
        try:
            solutions = graphnav.run(part, parse_settings(values), SOLVERS)
            row[f"{variant} s"] = round(time.process_time() - began, 2)
            undamaged = undamaged or dict(solutions)
            timed = {name: time_as(found, undamaged[name]) for name, found in solutions.items()}
            metrics = score(clean, part, timed, withheld)[0]
        except graphnav.GraphnavError as error:
            row[variant] = {"error": str(error).split("\n")[0]}
            continue
        found = {solver: summarise(metrics[solver]) for solver in SOLVERS}
        row[variant] = {
            solver: {"h": x.get("h_rms_m"), "up": x.get("up_rms_m"), "nees": x.get("nees_p")}
            for solver, x in found.items()
        }
    return row


def tell(row: dict[str, Any]) -> str:
    """A row in a line or two."""

    def one(variant: str) -> str:
        found = row[variant]
        if "error" in found:
            return str(found["error"])
        return " / ".join(f"{found[s]['h']:.3f}" for s in SOLVERS) + f" ({found['batch']['nees']:.1f})"

    cells = " | ".join(f"{variant} {one(variant)}" for variant in ("stated", "estimated", "clean"))
    wheels = "" if row["odometer"] else " no wheels"
    return f"{row['draw']} {row['drive']} {row['window']}{wheels}: {'; '.join(row['damage'])}\n    {cells}"


def report(rows: list[dict[str, Any]]) -> None:
    """Ratios, consistency and time over all draws that are solved."""
    solved = [r for r in rows if not any("error" in r[v] for v in ("stated", "estimated", "clean"))]
    print(f"{len(rows)} draws, {len(solved)} solved in all variants")
    for solver in SOLVERS:
        h = {v: np.array([r[v][solver]["h"] for r in solved]) for v in ("stated", "estimated", "clean")}
        nees = np.array([r["estimated"][solver]["nees"] for r in solved])
        for other in ("stated", "clean"):
            q = np.quantile(h["estimated"] / h[other], [0.1, 0.5, 0.9])
            print(f"{solver}: estimated / {other}: {q[0]:.2f} {q[1]:.2f} {q[2]:.2f} (10, 50, 90 %)")
        print(f"{solver}: NEES estimated {np.round(np.quantile(nees, [0.1, 0.5, 0.9]), 2)}")
    seconds = np.array([r["estimated s"] / r["stated s"] for r in solved])
    print(f"time estimated / stated {np.round(np.quantile(seconds, [0.1, 0.5, 0.9]), 2)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, required=True, help="the rows, JSON; those there are kept")
    parser.add_argument("--data", type=Path, default=os.environ.get("GRAPHNAV_DATA", HERE.parent / "shared" / "data"))
    parser.add_argument("--drives", type=lambda text: text.split(","), default=list(NAMES))
    parser.add_argument("--family", choices=FAMILIES, default="faults", help="what the drives are damaged by")
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--only", type=int, help="this draw alone")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rows = json.loads(options.output.read_text()) if options.output.exists() else []
    have = {row["draw"] for row in rows}
    for number in range(options.draws) if options.only is None else [options.only]:
        if number in have:
            continue
        rows.append(solve(number, options))
        options.output.write_text(json.dumps(rows, indent=1))
        print(tell(rows[-1]), file=sys.stderr, flush=True)
    report(rows)


if __name__ == "__main__":
    main()
