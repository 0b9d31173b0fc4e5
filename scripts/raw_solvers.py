"""One recording of raw observations through every solver, and as it comes, beside batch.

    python scripts/raw_solvers.py
    python scripts/raw_solvers.py --noise estimated
    python scripts/raw_solvers.py --width data/kamakura_rtk

Of each, horizontal errors against the truth (95 %, m), and places beside those of batch: the largest difference in
batch's sigmas (an axis at a time), and the mean square, horizontally and of height, of differences over those of the
covariances, where the solver knows less than batch: 1 if both are right. `--width`: the columns of the filter's error
state, and its processor time an epoch, with the carriers of some of the signals, and of parts of the drive.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphnav.config import Settings, parse_settings
from graphnav.constraints.ambiguities import name_ambiguity
from graphnav.constraints.raw_rows import CLOCK
from graphnav.core.earth import LocalFrame
from graphnav.core.state import DIM
from graphnav.detectors import detect
from graphnav.estimation.pipeline import choose_origin, run
from graphnav.estimation.preparation import begin_preparation, prepare
from graphnav.estimation.solution import Solution
from graphnav.estimation.solvers.ekf import ekf
from graphnav.online import Online, drop_rows, list_rows
from graphnav.recording import Recording
from graphnav.recording.formats import read

Array = np.ndarray
ROOT = Path(__file__).resolve().parents[1]
RECORDINGS = ("data/kamakura_rtk", "data/tokyo_raw")
SOLVERS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("batch", {}),
    ("ekf", {}),
    ("rts", {}),
    ("incremental", {"lag": 120.0}),
    ("isam2", {}),
    ("isam2", {"isam2_lag": 10.0}),
)
ONLINE = tuple((engine, lag) for lag in (1000.0, 10.0) for engine in ("window", "isam2"))
SIGNALS, LENGTHS = (0, 10, 20, 30, 40, 60), (40.0, 10.0)  # carriers, and s
_SAME = 1e-6  # s
_KNOWS_LESS = 0.01  # of batch's variance, by which a solver's is larger where differences are told by it


def play(recording: Recording, settings: Settings, engine: str) -> tuple[Array, Array, Array]:
    """Times, places (geodetic) and their variances (N, 3), as they settle online."""
    online, parts = Online(drop_rows(recording), settings, engine), []
    for row in list_rows(recording)[1]:
        online.add(row)
        parts += online.settled()
    online.finish()
    parts += online.settled()
    t, llh, sd = (np.concatenate([getattr(part, name) for part in parts]) for name in ("t", "llh", "sd_p"))
    return t, llh, sd**2


def compare(best: Solution, recording: Recording, t: Array, p: Array, variance: Array) -> str:
    """The columns of a solver whose places p (N, 3) at times t are known to variances (N, 3)."""
    truth, own = recording.truth, np.diagonal(best.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
    assert truth is not None
    assert truth.llh is not None
    used = (truth.t >= t[0]) & (truth.t <= t[-1])
    at = np.stack([np.interp(truth.t[used], t, x) for x in p.T], -1)
    h95 = np.percentile(np.linalg.norm((at - best.frame.from_llh(truth.llh[used]))[:, :2], axis=1), 95)
    k = np.clip(np.searchsorted(best.t, t - _SAME), 0, len(best.t) - 1)
    same = np.abs(best.t[k] - t) < _SAME
    k = k[same]
    off, more = p[same] - best.states.p[k], variance[same] - own[k]
    squares = np.where(more > _KNOWS_LESS * own[k], off**2 / np.maximum(more, 1e-12), np.nan)
    flat, up = (x[np.isfinite(x)].mean() if np.isfinite(x).any() else np.nan for x in (squares[:, :2], squares[:, 2]))
    return f"{h95:7.3f} {np.max(np.abs(off) / np.sqrt(own[k])):6.2f} {flat:7.2f} {up:6.2f}"


def measure_width(whole: Recording) -> None:
    """Print the filter's columns and its time a keyframe, the least of three, by carriers in use and the length."""
    raw, stated = whole.raw_gnss, parse_settings({"noise": {"mode": "stated"}})
    assert raw is not None
    slot = raw.satellite.astype(int) * 1000 + raw.signal
    there = np.isfinite(raw.carrier) & np.isfinite(raw.carrier_difference)
    slots = sorted(set(slot[there].tolist()), key=lambda one: -int(np.sum(there & (slot == one))))
    print(f"{'s':>4} {'ambiguities':>12} {'clock':>6} {'others':>7} {'keyframes':>10} {'ms each':>8}")
    for length, many in ((length, many) for length in LENGTHS for many in SIGNALS):
        carrier = np.where(np.isin(slot, slots[:many]), raw.carrier, np.nan)
        part = replace(whole, raw_gnss=replace(raw, carrier=carrier)).crop(0.0, length)
        frame = LocalFrame(choose_origin(part), part.start)
        found = prepare(begin_preparation(part, stated, frame, detect(part, stated)))
        problem, took = found.problem, []
        for _ in range(3):
            began = time.process_time()
            ekf(problem, opening=found.aligned.until)
            took.append(time.process_time() - began)
        columns = {name: own.stop - own.start for name, own in problem.columns.items()}
        own = sum(size for name, size in columns.items() if name.startswith(name_ambiguity("")))
        clock, n = columns.get(CLOCK, 0), len(problem.t)
        others = DIM + sum(columns.values()) - own - clock
        print(f"{length:4.0f} {own:12} {clock:6} {others:7} {n:10} {1e3 * min(took) / n:8.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path, default=[ROOT / name for name in RECORDINGS])
    parser.add_argument("--noise", choices=("stated", "estimated"), default="stated")
    parser.add_argument("--width", action="store_true")
    given = parser.parse_args()
    for path in given.recordings:
        if given.width:
            measure_width(read(path))
            continue
        recording, how = read(path), {"noise": {"mode": given.noise}}
        print(f"{path.name:26} {'H95':>7} {'most':>6} {'H':>7} {'U':>6}", flush=True)
        best = run(recording, parse_settings(how), ("batch",))["batch"]
        for solver, lags in SOLVERS:
            one = run(recording, parse_settings({**how, "solver": lags}), (solver,))[solver]
            name = f"{solver}{''.join(f', lag {lag:.0f} s' for lag in lags.values())}"
            variance = np.diagonal(one.covariance[:, 3:6, 3:6], axis1=1, axis2=2)
            print(f"{name:26} {compare(best, recording, one.t, one.states.p, variance)}", flush=True)
        for engine, lag in ONLINE:
            t, llh, variance = play(recording, parse_settings({**how, "solver": {"lag": lag}}), engine)
            name = f"online, {engine}, lag {lag:.0f} s"
            print(f"{name:26} {compare(best, recording, t, best.frame.from_llh(llh), variance)}", flush=True)


if __name__ == "__main__":
    main()
