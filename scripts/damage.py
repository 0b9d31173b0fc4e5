"""What wrong measurements cost: a drive with its own truth, damaged in one way after the other.

    python scripts/damage.py ../shared/data/tokyo_20201105 --span 266-466
    python scripts/damage.py data/tokyo --only frozen,bursts

Each line is one kind of damage; errors of ekf and batch are horizontal rms over the whole span, with the noise that is
stated and every fix used, and with the defaults.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import graphnav
from graphnav.app.scores import score
from graphnav.config import parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.recording import Gnss, Recording

WRONG = np.array([0.5, -0.5, 0.0])  # m
Damage = Callable[[Recording, Gnss, np.random.Generator], Gnss]
SOLVERS = ("ekf", "batch")
STATED = {"noise": {"mode": "stated"}, "gnss": {"faults": "off"}}
BURSTS = ((0.3, 8.0, 15.0), (0.6, 20.0, 5.0), (0.9, 4.0, 40.0))  # where in the drive, s, m east
SHARES = np.array([1.0, 0.5, 0.3])  # of a burst's error east that go north and up


def moved(gnss: Gnss, by: np.ndarray) -> Gnss:
    """Fixes moved by (N, 3) m east, north and up."""
    frame = LocalFrame(gnss.llh[np.isfinite(gnss.llh).all(axis=1)][0])
    return replace(gnss, llh=frame.to_llh(frame.from_llh(gnss.llh) + by))


def outliers(recording: Recording, gnss: Gnss, rng: np.random.Generator) -> Gnss:
    wrong = rng.random(len(gnss.t)) < 0.1
    return moved(gnss, 20.0 * wrong[:, None] * rng.standard_normal((len(gnss.t), 3)))


def bursts(recording: Recording, gnss: Gnss, rng: np.random.Generator) -> Gnss:
    by = np.zeros((len(gnss.t), 3))
    for share, length, error in BURSTS:
        begin = recording.start + share * recording.duration
        by[(gnss.t >= begin) & (gnss.t < begin + length)] = error * SHARES
    return moved(gnss, by)


def drifting(recording: Recording, gnss: Gnss, rng: np.random.Generator) -> Gnss:
    """East by 0.3 m/s for a minute from two fifths of the drive on, then right again."""
    since = gnss.t - recording.start - 0.4 * recording.duration
    return moved(gnss, np.outer(np.where((since >= 0.0) & (since < 60.0), 0.3 * since, 0.0), [1.0, 0.0, 0.0]))


def frozen(recording: Recording, gnss: Gnss, rng: np.random.Generator) -> Gnss:
    """Twelve seconds of one place, where the drive goes furthest in them."""
    p = LocalFrame(gnss.llh[0]).from_llh(gnss.llh)
    later = np.minimum(np.searchsorted(gnss.t, gnss.t + 12.0), len(gnss.t) - 1)
    first = int(np.argmax(np.linalg.norm(p[later] - p, axis=1)))
    llh = gnss.llh.copy()
    llh[first : later[first]] = llh[first]
    return replace(gnss, llh=llh)


def stamped_on_arrival(recording: Recording, gnss: Gnss, rng: np.random.Generator) -> Gnss:
    return replace(gnss, t=np.sort(gnss.t + rng.uniform(0.0, 0.2, len(gnss.t))))


DAMAGES: dict[str, Damage] = {
    "none": lambda recording, gnss, rng: gnss,
    "sigmas a fifth": lambda recording, gnss, rng: replace(gnss, sd=gnss.sd / 5.0),
    "sigmas ten times": lambda recording, gnss, rng: replace(gnss, sd=gnss.sd * 10.0),
    "stamps 0.2 s late": lambda recording, gnss, rng: replace(gnss, t=gnss.t + 0.2),
    "stamped on arrival": stamped_on_arrival,
    "clocks 500 ppm apart": lambda recording, gnss, rng: replace(gnss, t=gnss.t + 5e-4 * (gnss.t - recording.start)),
    "lever arm 0.7 m off": lambda recording, gnss, rng: replace(gnss, lever_arm=gnss.lever_arm + WRONG),
    "one in ten off by 20 m": outliers,
    "bursts": bursts,
    "frozen": frozen,
    "drifting": drifting,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", help="with a truth of its own")
    parser.add_argument("--span", help="from-to, s from its start (all of it)")
    parser.add_argument("--only", help="some words of the kinds of damage, with commas between")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    recording = graphnav.load(options.recording)
    if options.span:
        recording = recording.crop(*map(float, options.span.split("-")))
    if recording.gnss is None or recording.truth is None:
        parser.error("a recording with fixes and a truth is needed")
    print("| damage | stated: ekf, m | batch, m | NEES | estimated: ekf, m | batch, m | NEES | left out |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, damage in DAMAGES.items():
        if options.only and not any(word in name for word in options.only.split(",")):
            continue
        used = replace(recording, gnss=damage(recording, recording.gnss, np.random.default_rng(options.seed)))
        cells = []
        for values in (STATED, {}):
            solutions = graphnav.run(used, parse_settings(values), SOLVERS)
            metrics = score(recording, used, solutions, ())[0]
            cells += [f"{metrics[solver].components['h'].rms:.3f}" for solver in SOLVERS]
            cells.append(f"{metrics['batch'].nees['p'].mean:.1f}")
        out = sum(span.count for span in solutions["batch"].excluded if span.kind == "gnss_position")
        print(f"| {name} | {' | '.join(cells)} | {out} |", flush=True)


if __name__ == "__main__":
    main()
