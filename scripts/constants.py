"""On which drive does a chosen constant hang? Each halved and doubled over windows of all drives, one left out in turn.

    python scripts/constants.py --data ../shared/data
    python scripts/constants.py --data ../shared/data --only CHANCE,SIZES --length 300
    python scripts/constants.py --data ../shared/data --of remounting --changed turned-imu --drives tokyo,oracle,boulder

The figures that are estimated from a recording rest on some that are not: probabilities, priors, physics, and how long
the computing may take. The table shows for each of these the horizontal errors of filter and smoother (the geometric
mean over drives, each counted once) against those with the constant as it is, and the range of that if one drive is
left out. A constant that was fitted to a drive is one whose gain is gone without it.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from damage import DAMAGES
from do_no_harm import DRIVES, HERE, load, placed, settings_of, windows, withheld_of
from drive_changes import CHANGES
from harm_verdict import FLOOR

import graphnav
from graphnav.app.scores import Withheld, score
from graphnav.recording import Recording

NOISE, FAULTS = "graphnav.estimation.noise", "graphnav.estimation.faults"
TURNED = "graphnav.estimation.remounting"
SOLVED = ("ekf", "rts")
DAMAGED = ("bursts", "drifting")


@dataclass(frozen=True)
class Constant:
    """A number of a module, and the times by which it is made smaller and larger."""

    module: str
    name: str
    why: str  # where it comes from
    times: float = 2.0
    whole: bool = False

    def values(self, usual: Any) -> Iterator[tuple[str, Any]]:
        """What is tried, with a word for it."""
        for factor in (1.0 / self.times, self.times):

            def scale(x: float, factor: float = factor) -> float:
                return max(1, round(x * factor)) if self.whole else x * factor

            if isinstance(usual, dict):
                value: Any = {key: scale(x) for key, x in usual.items()}
            else:
                value = tuple(map(scale, usual)) if isinstance(usual, tuple) else scale(usual)
            yield f"x {factor:g}", value


CONSTANTS = (
    Constant(f"{NOISE}.priors", "WITHIN", "data sheets and receivers: right within a factor of three"),
    Constant(f"{NOISE}.priors", "TIME_WITHIN", "the same of correlation times"),
    Constant(f"{NOISE}.priors", "_SHARES", "lasting parts of a stated variance: as much as the whole, all together"),
    Constant(f"{NOISE}.tails", "CHANCE", "probability of an outlier", 10.0),
    Constant(f"{NOISE}.tails", "_WITHIN", "tail indices: a factor of three about that of a Gaussian, as other figures"),
    Constant(f"{NOISE}.estimate", "_TIME_RANGE", "a correlation time between a tenth of a second and an hour"),
    Constant(
        f"{NOISE}.estimate", "_MANOEUVRE", "what a vehicle turns and accelerates by at most while samples are lost"
    ),
    Constant(
        f"{NOISE}.estimate",
        "_FIRST_KEYFRAMES",
        "computing: figures from so many keyframes are good to a twentieth",
        2.0,
        whole=True,
    ),
    Constant(
        f"{NOISE}.moments", "_CONTROLLED", "redundancy that controls a row: the square of a tenth of a sigma", 3.0
    ),
    Constant(f"{NOISE}.components", "_LONGEST", "computing: longest step of a logarithm", 1.5),
    Constant(f"{NOISE}.estimate", "_SETTLED", "computing: gain of a pass at convergence", 3.0),
    Constant(f"{NOISE}.estimate", "_RELAXATION", "computing: steps of correlation times", 1.3),
    Constant(
        f"{NOISE}.initial_points", "_COOLING", "computing: by how much the sigmas of an annealing fall in a round"
    ),
    Constant(
        f"{NOISE}.exclusion",
        "_REFINEMENTS",
        "computing: estimates without what is suspected, the second by figures that are free of it",
        2.0,
        whole=True,
    ),
    Constant(
        f"{FAULTS}.watch", "FALSE_ALARM", "probability: one drive in a hundred of an hour, of Gaussian errors", 100.0
    ),
    Constant(f"{FAULTS}.watch", "_ONSET", "95 % of chi-square of one degree of freedom"),
    Constant(f"{FAULTS}.watch", "SIZES", "m, m/s: reflections in a city, and speeds in one"),
    Constant(f"{FAULTS}.watch", "MINUTE", "s, in which an error may grow by as much as it can be"),
    Constant(f"{FAULTS}.watch", "OLDEST", "s: what inertial sensors knew before says little"),
    Constant(f"{FAULTS}.watch", "PATIENCE", "s, after which inertial sensors of any grade have lost a position"),
    Constant(f"{FAULTS}.watch", "LARGE", "sigmas: less is no fault, however certain"),
    Constant(f"{FAULTS}.watch", "_CLOCKS", "s, between the stamps of IMU and receiver"),
    Constant(f"{FAULTS}.watch", "_BRAKING", "m/s^2, of a usual manoeuvre"),
    Constant(
        f"{NOISE}.unmeasured", "_KINK", "steps of rounding: the bound of chance beside a row is by three sigmas", 3.0
    ),
    Constant(f"{FAULTS}.verdicts", "_FEWEST_AGREEING", "fixes that agree by chance", 2.0, whole=True),
    Constant(f"{NOISE}.rivals", "_STRONG", "odds: less is no strong evidence (Kass and Raftery 1995)"),
    Constant(f"{NOISE}.rivals", "_JUMPS", "computing: disturbed intervals at which fixes may step", 2.0, whole=True),
    Constant(f"{NOISE}.rivals", "_NEAR", "fixes: the median of fewer is that of one outlier", 3.0, whole=True),
    Constant("graphnav.estimation.spread", "_CHANCE", "probability: three sigmas", 10.0),
    Constant("graphnav.estimation.alignment.back", "_CERTAIN", "prior: one drive in a hundred begins in reverse"),
    Constant("graphnav.estimation.building", "_FAR_AWAY", "m, single fixes in a city"),
    Constant(
        "graphnav.estimation.solvers.passes",
        "LINEAR_ATTITUDE",
        "rad: half its square is the share of a vector that linearising loses",
    ),
    Constant("graphnav.estimation.solvers.ekf", "_PASSES", "computing: passes about points", 2.0, whole=True),
    Constant(
        "graphnav.estimation.relinearisation",
        "_LINEAR",
        "sigmas of a step: a quarter more mean square of errors over sigmas",
    ),
    Constant("graphnav.estimation.relinearisation", "CLEARLY_BETTER", "half chi-square: a likelihood ratio of 22,000"),
    Constant(
        "graphnav.estimation.contradictions", "_WIDER", "sigmas: a drive's own estimate counts a quarter too much"
    ),
    Constant(TURNED, "_MEANS", "keyframes: enough for a mean of mountings", 2.0, whole=True),
    Constant(TURNED, "_MOVING", "of the usual speed, and m/s: slower, the course is uncertain"),
    Constant(TURNED, "_OUTSTANDING", "computing: less is not looked into", 1.5),
    Constant(TURNED, "_LEAST", "rad, as slip in a turn may seem"),
    Constant(TURNED, "_BEGUN", "share of the turn by which its begin is found"),
    Constant(TURNED, "_DONE", "share of the turn by which its end is found", 1.2),
    Constant(TURNED, "_BEYOND", "of the time between these: the rest, and slow ends"),
    Constant(TURNED, "_SIGMAS", "sigmas that a turn is larger than"),
    Constant(TURNED, "_LONGEST", "s that a hand takes to turn a device"),
    Constant(TURNED, "_MOSTLY", "share of the change that is to come about within these", 1.5),
    Constant(TURNED, "_RATE", "s beside it in which the vehicle's turn rate is measured"),
    Constant(TURNED, "_SEARCHED", "computing: s about the keyframes between which it is"),
    Constant(TURNED, "_BESIDE", "s before and after in which the wheels tell its angle"),
    Constant(TURNED, "_SETTLED", "computing: rad of a step at convergence", 3.0),
    Constant(TURNED, "_STEPS", "computing: steps to the angle", 2.0, whole=True),
    Constant(TURNED, "_MOST", "computing: turns of a drive", 2.0, whole=True),
    Constant("graphnav.recording", "ACROSS", "data sheets: axes square to 0.05 deg beside scales good to 0.3 %"),
)
DERIVED = {
    "CHANCE": ("OUTLIER_COST", lambda x: -float(np.log(x))),
    "FALSE_ALARM": ("FAULT_COST", lambda x: -float(np.log(x))),
}


@contextmanager
def changed(constant: Constant, value: Any) -> Iterator[None]:
    """Every module that has the constant, by its own name or another's, with another value."""
    usual = getattr(importlib.import_module(constant.module), constant.name)
    names = [module for module in sys.modules if module.startswith("graphnav")]
    if constant.name.startswith("_"):
        names = [constant.module]
    places = [
        (vars(sys.modules[module]), constant.name, usual, value)
        for module in names
        if vars(sys.modules[module]).get(constant.name) is usual
    ]
    if constant.name in DERIVED:
        name, of = DERIVED[constant.name]
        for module in [module for module in sys.modules if module.startswith("graphnav")]:
            place = vars(sys.modules[module])
            if name in place:
                places.append((place, name, place[name], of(value)))
    try:
        for place, name, _, new in places:
            place[name] = new
        yield
    finally:
        for place, name, old, _ in places:
            place[name] = old


@dataclass(frozen=True)
class Cell:
    """A part of a drive, what is used of it, and what it is scored on."""

    drive: str
    part: Recording
    used: Recording
    settings: graphnav.Settings
    withheld: tuple[Withheld, ...]

    def errors(self) -> list[float]:
        """m, horizontal rms of each solver; no less than what is worth a look."""
        try:
            solutions = graphnav.run(self.used, self.settings, SOLVED)
        except graphnav.GraphnavError:
            return [float("inf")] * len(SOLVED)
        metrics = score(self.part, self.used, solutions, self.withheld)[0]
        return [max(metrics[name].components["h"].rms, FLOOR) for name in SOLVED]


def cells(options: argparse.Namespace) -> Iterator[Cell]:
    """A window of each drive with all its sensors, and one with damaged fixes in one way after the other."""
    chosen = options.drives.split(",") if options.drives else list(DRIVES)
    for name, drive in ((name, DRIVES[name]) for name in chosen):
        source = placed(drive, options.data)
        whole = load(source)
        for _, span in windows(whole, drive.source, options):
            part = whole.crop(*span)
            part = CHANGES[options.changed](part) if options.changed else part
            withheld = withheld_of(part, part.duration) if part.truth is None else ()
            used = part
            for sensor, some in withheld:
                used = used.without(sensor, some)
            sensors = "+odometer" if part.odometer is not None else "+nhc"
            yield Cell(name, part, used, settings_of("estimated", sensors, drive.doppler), withheld)
    if options.changed:
        return
    clone = graphnav.load(HERE / "data" / "tokyo")
    assert clone.gnss is not None
    for kind in DAMAGED:
        gnss = DAMAGES[kind](clone, clone.gnss, np.random.default_rng(options.seed))
        yield Cell("tokyo_clone", clone, replace(clone, gnss=gnss), settings_of("estimated", "+odometer"), ())


def by_drive(drives: list[str], ratio: np.ndarray) -> dict[str, float]:
    """Mean logarithm of ratios (cells, solvers) of each drive."""
    return {
        name: float(np.mean(ratio[[k for k, d in enumerate(drives) if d == name]])) for name in dict.fromkeys(drives)
    }


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=HERE.parent / "shared" / "data")
    parser.add_argument("--length", type=float, default=120.0, help="s, of a window (120)")
    parser.add_argument("--windows", type=int, default=1, help="of a drive (1)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--drives", help="names, with commas between (all)")
    parser.add_argument("--only", help="names of constants, with commas between")
    parser.add_argument("--of", help="name of a module, all of whose constants are wanted")
    parser.add_argument(
        "--changed", choices=CHANGES, help="drives changed as by do_no_harm.py, instead of damaged fixes"
    )
    options = parser.parse_args(arguments)
    options.whole = False
    every = list(cells(options))
    drives = [cell.drive for cell in every]
    usual = np.log([cell.errors() for cell in every])
    print("| constant | is | where it comes from | tried | errors, all drives | one drive left out | most by | there |")
    print("| --- | ---: | --- | ---: | ---: | ---: | --- | ---: |")
    for constant in CONSTANTS:
        if options.only and constant.name not in options.only.split(","):
            continue
        if options.of and constant.module.rsplit(".", 1)[1] != options.of:
            continue
        here = getattr(importlib.import_module(constant.module), constant.name)
        for word, value in constant.values(here):
            with changed(constant, value):
                ratio = np.log([cell.errors() for cell in every]) - usual
            one = by_drive(drives, ratio)
            all_, n = sum(one.values()), len(one)
            without = {name: (all_ - x) / (n - 1) for name, x in one.items()}
            most = max(one, key=lambda name: abs(one[name]))
            mean, low, high, there = np.exp([all_ / n, min(without.values()), max(without.values()), one[most]])
            where = f"`{constant.module.rsplit('.', 1)[1]}.{constant.name}`"
            row = [
                where,
                describe(here),
                constant.why,
                word,
                f"{mean:.3f}",
                f"{low:.3f} to {high:.3f}",
                most,
                f"{there:.2f}",
            ]
            print(f"| {' | '.join(row)} |", flush=True)


def describe(value: Any) -> str:
    """A number, or several."""
    numbers = value.values() if isinstance(value, dict) else value if isinstance(value, tuple) else (value,)
    return ", ".join(f"{x:.3g}" for x in numbers)


if __name__ == "__main__":
    main()
