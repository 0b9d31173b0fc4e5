"""Li 2024 on simulated drives: the idling engine's lines, stops found by FFT, and zero velocity through them.

    python scripts/reproduce_li2024.py --seeds 5 -o build/li2024
    python scripts/reproduce_li2024.py --seeds 5 --fire fused,fft

Prints the paper's Tables 4, 5 and 6 beside ours, and what the paper does not give: false alarms while moving, and how
early or late stops begin and end. Each seed has an engine speed of its own. As in the paper every stop is run by
itself, from the start of the drive to the end of the stop, with GNSS gone from its first second. The paper's figures
are of a real drive with sensors of the same grade; ours are simulated. With `--fire` the same for other detectors,
each of which then decides by itself.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphnav.config import Settings, parse_settings
from graphnav.detectors import detect
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.estimation.solution import Solution
from graphnav.recording import Recording
from graphnav.simulation import Simulated, simulate

Array = np.ndarray
ENGINES = (12.49585, 8.0, 20.0, 30.0, 40.0)  # Hz, by seed
G = 9.80665
BANDS = ((0.0, 10.0), (10.0, 20.0), (20.0, 30.0))
# forward mg, up mg, pitch deg/s: (Hz, amplitude) in each band, mean of the three stops
TABLE_4 = (((3.106, 0.369), (3.404, 0.108), (4.198, 0.002)),
           ((12.495, 2.509), (12.495, 4.389), (12.495, 0.294)),
           ((24.991, 3.078), (24.991, 3.592), (24.991, 0.004)))  # fmt: skip
TABLE_5 = (99.9, 99.5, 99.7, 99.7)  # %
TABLE_6 = {"RMS": (1.09, 0.94, 1.30), "STD": (0.63, 0.66, 0.25), "Max": (2.51, 2.48, 1.89)}  # cm, mean of the stops
OFF = {"zero_velocity": False, "zero_rate": False, "held_position": False}


def stops_of(made: Simulated) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in made.facts["stop_edges"]]


def spectrum(made: Simulated) -> None:
    """Table 4: the highest line per band in the spectrum of each whole stop, averaged over the stops."""
    imu = made.recording.imu
    rate = 1.0 / float(np.median(np.diff(imu.t)))
    signals = (imu.accel[:, 1] / G * 1e3, imu.accel[:, 2] / G * 1e3, np.degrees(imu.gyro[:, 0]))
    found = np.zeros((len(BANDS), len(signals), 2))
    for a, b in stops_of(made):
        inside = (imu.t > a) & (imu.t <= b)
        for j, x in enumerate(signals):
            x = x[inside] - x[inside].mean()
            size = 2.0 / len(x) * np.abs(np.fft.rfft(x))
            hz = np.fft.rfftfreq(len(x), 1.0 / rate)
            for i, (lo, hi) in enumerate(BANDS):
                band = np.flatnonzero((hz > max(lo, 0.05)) & (hz <= hi))
                top = band[np.argmax(size[band])]
                found[i, j] += np.array([hz[top], size[top]]) / len(made.facts["stop_edges"])
    print("\nTable 4, mean of the stops: Hz and amplitude (paper | simulated, seed 0)\n")
    print("| band, Hz | forward, mg | up, mg | pitch rate, deg/s |\n| --- | --- | --- | --- |")
    for (lo, hi), paper, ours in zip(BANDS, TABLE_4, found, strict=True):
        cells = [f"{p[0]:.3f}: {p[1]:.3f} \\| {o[0]:.3f}: {o[1]:.3f}" for p, o in zip(paper, ours, strict=True)]
        print(f"| {lo:.0f}-{hi:.0f} | {' | '.join(cells)} |")


def share(spans: Array, seconds: Array) -> Array:
    """Whether each second (its middle) lies in a span."""
    return np.any([(seconds >= a) & (seconds <= b) for a, b in spans], axis=0) if len(spans) else seconds < -np.inf


def firing(fire: str) -> Settings:
    return parse_settings({"detectors": {"fire": [fire]}})


def detection(made: Simulated, fires: list[str]) -> dict[str, list[float]]:
    """Per detector, and per what decides: % of the seconds of each long stop, of all, false alarms, late by (s)."""
    # as in the paper the speed comes from GNSS or the filter, not from the wheels; GNSS is gone in the stops
    recording = without_gnss(made.recording, stops_of(made))
    truth, out = made.stops, {}
    t = np.arange(recording.start + 0.5, recording.end, 1.0)
    standing = share(truth, t)
    edge = share(np.stack([truth[:, 0] - 1.0, truth[:, 1] + 1.0], -1), t) & ~standing
    answers = {fire: detect(recording, firing(fire)) for fire in fires}
    spans = {one.name: one.intervals for one in answers["fused"].all if one.name in ("fft", "glrt")}
    for name, found in [*spans.items(), *((f"{fire} decides", one.stationary) for fire, one in answers.items())]:
        said = share(found, t)
        rates = [100.0 * np.mean(said[(t >= a) & (t <= b)]) for a, b in stops_of(made)]
        inside = share(np.array(stops_of(made)), t)
        begin, end = [], []
        for a, b in stops_of(made):
            own = found[(found[:, 1] > a) & (found[:, 0] < b)]
            if len(own):
                begin.append(own[0, 0] - a)
                end.append(own[-1, 1] - b)
        out[name] = [*rates, 100.0 * np.mean(said[inside]), 100.0 * np.mean(said[~standing & ~edge]),
                         float(np.mean(begin)), float(np.mean(end))]  # fmt: skip
    return out


def without_gnss(recording: Recording, spans: list[tuple[float, float]]) -> Recording:
    for a, b in spans:
        recording = recording.without("gnss", (a - recording.start, b - recording.start))
    return recording


def variation(solution: Solution, stop: tuple[float, float]) -> Array:
    """(3, 3): RMS, STD and largest change of position (east, north, up; cm) from the first epoch of a stop."""
    p = solution.states.p[(solution.t >= stop[0]) & (solution.t <= stop[1])]
    R = solution.frame.R_ln(p[:1])[0]
    d = 100.0 * (p - p[0]) @ R.T
    return np.stack([np.sqrt(np.mean(d**2, axis=0)), d.std(axis=0), np.abs(d).max(axis=0)])


def drifts(made: Simulated, fires: list[str]) -> tuple[dict[str, Array], float]:
    """Solver -> (3 stops, 3, 3) variations, and how far the unconstrained filter is away (km) after the first."""
    out: dict[str, list[Array]] = {f"{name}, {fire} decides": [] for fire in fires for name in SOLVERS}
    whole = made.recording
    far = 0.0
    for number, stop in enumerate(stops_of(made)):
        # a keyframe after the last motion, none after the stop: nothing later may help
        part = without_gnss(whole.crop(0.0, stop[1] - whole.start), [(stop[0] - 0.5, stop[1] + 1.0)])
        for fire in fires:
            for name, solution in run(replace(part, truth=None), firing(fire)).items():
                out[f"{name}, {fire} decides"].append(variation(solution, stop))
        if number == 0:
            free = parse_settings({"standstill": OFF, "vehicle": {"nhc": False, "odometer": False}})
            far = float(variation(run(part, free, ("ekf",))["ekf"], stop)[2].max() / 1e5)
    return {name: np.array(rows) for name, rows in out.items()}, far


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--short", action="store_true", help="stops of 60 to 120 s instead of 16 to 22 min")
    parser.add_argument("--fire", default="fused", help="fused, and detectors that decide alone, with commas between")
    parser.add_argument("-o", "--out", type=Path, default=Path("build/li2024"))
    options = parser.parse_args()
    fires = list(dict.fromkeys(["fused", *options.fire.split(",")]))
    rates: dict[str, list[list[float]]] = {}
    drift: dict[str, list[Array]] = {}
    free = []
    for seed in range(options.seeds):
        made = simulate("li2024", seed, short=options.short, engine_hz=ENGINES[seed % len(ENGINES)])
        if seed == 0:
            spectrum(made)
        for name, row in detection(made, fires).items():
            rates.setdefault(name, []).append(row)
        found, far = drifts(made, fires)
        free.append(far)
        for name, rows in found.items():
            drift.setdefault(name, []).append(rows)
    engines = ", ".join(f"{ENGINES[k % len(ENGINES)]:.1f}" for k in range(options.seeds))
    print(f"\nTable 5: % of stopped seconds found, {options.seeds} simulated drives, engines at {engines} Hz\n")
    print(
        "| detector | stop 1 | stop 2 | stop 3 | total | false alarms, % of moving s | begins late, s | ends late, s |"
    )
    print("|" + " --- |" * 8)
    print("| paper, FFT | " + " | ".join(f"{x:.1f}" for x in TABLE_5) + " | not given | | |")
    for name, rows in rates.items():
        for what, one in (("mean", np.mean(rows, axis=0)), ("worst seed", worst(np.array(rows)))):
            print(f"| {name}, {what} | " + " | ".join(f"{x:.2f}" for x in one) + " |")
    print("\nTable 6: change of position in the stops, cm, mean of the three (and of the seeds); worst seed\n")
    print("| solver | RMS e | n | u | STD e | n | u | max e | n | u |\n|" + " --- |" * 10)
    print("| paper | " + " | ".join(f"{x:.2f}" for rows in TABLE_6.values() for x in rows) + " |")
    for name, many in drift.items():
        per_seed = np.array(many).mean(axis=1)
        for what, one in (("mean", per_seed.mean(axis=0)), ("worst seed", per_seed.max(axis=0))):
            print(f"| {name}, {what} | " + " | ".join(f"{x:.2f}" for x in one.ravel()) + " |")
    print(f"\nwithout constraints the filter ends stop 1 {np.mean(free):.1f} km away ({max(free):.1f} at most)")
    options.out.mkdir(parents=True, exist_ok=True)
    np.savez(options.out / "li2024.npz", **{name: np.array(many) for name, many in drift.items()})


def worst(rows: Array) -> Array:
    """Least rates, most false alarms, largest delays."""
    return np.r_[rows[:, :4].min(axis=0), rows[:, 4:].max(axis=0)]


if __name__ == "__main__":
    main()
