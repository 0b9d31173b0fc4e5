"""Time and memory of the online smoother over a long drive, hour by hour, beside the Kalman filter on the same drive.

The drive is that of scripts/benchmark.py: exact laps of python-ins (the package's `dev` extra has it), a MEMS unit at
200 Hz, fixes at 1 Hz with three 60-s outages an hour, wheel speed at 20 Hz; every constraint of vehicles is on. Times
are of the thread, not of the clock on the wall; a busy machine shows in them by what its caches lose.

An update is everything that the row of the IMU sets off which makes a keyframe, until there is a new state; what is
done beside, at rows before and after it, is told by keyframe and by the longest that a row took. `all, s` is of the
whole process: rows that wait for nothing, and noise estimation in its own thread, are in it.

    python scripts/benchmark_online.py --hours 10

With `--foot` it is a simulated walk at 250 Hz without fixes, and told are all rows that did more than to be kept.

    python scripts/benchmark_online.py --foot --hours 0.5 --lag 60
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import oracle

from graphnav.config import Settings, parse_settings
from graphnav.core.earth import LocalFrame
from graphnav.detectors import detect
from graphnav.estimation.alignment import align
from graphnav.estimation.noise.apply import apply_noise
from graphnav.estimation.noise.estimate import NoiseEstimate, estimate_noise
from graphnav.estimation.pipeline import choose_origin
from graphnav.estimation.problem import Problem, build_problem
from graphnav.estimation.solvers.ekf import ekf
from graphnav.online import Online, Row, drop_rows, list_rows
from graphnav.recording import Recording
from graphnav.simulation import simulate

RATE, LAP = 200.0, 3600.0
WALK_RATE, EVERY = 250.0, 300.0  # Hz, s
PARTS = ("building", "solving")
A_ROW = 1e-4  # s; a row that takes longer did more than to be kept
PORTION = 600.0  # s of rows that are in memory as rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--lag", type=float, default=Settings().solver.lag, help="s (%(default)s)")
    parser.add_argument("--foot", action="store_true", help="a walk")
    parser.add_argument("--engine", choices=["window", "isam2"], default=Settings().solver.engine)
    options = parser.parse_args()
    settings = parse_settings({"solver": {"lag": options.lag, "engine": options.engine}})
    seconds = 3600.0 * options.hours
    if options.foot:
        walk(seconds, settings)
        return
    laps = max(1, round(seconds / LAP))
    path = oracle.vehicle_path(seconds / laps, RATE).tiled(laps)
    spans = oracle.moving_spans(path, 60.0, max(1, round(3 * options.hours)))
    recording, truth = oracle.drive(path, seed=1, outages=spans, odometer_rate=20.0)
    del path
    filtered = filter_seconds(recording.crop(0.0, min(seconds, 1800.0)), settings)
    print(f"the filter takes {1e3 * filtered:.2f} ms a keyframe with everything built beforehand", flush=True)
    online = Online(drop_rows(recording), settings)
    scale = np.array([6.378e6, 6.378e6 * np.cos(truth.llh[0, 0]), 1.0])
    found: list[list[float]] = []  # s of each update by part, all of it, beside it, and the longest row there
    beside = [0.0]
    errors: list[list[float]] = []  # squared ones of an hour
    hour, newest = 1, -np.inf
    began = time.process_time()
    head = "| hour | keyframes | " + " | ".join(f"{p}, ms: median, 99 %, most" for p in PARTS)
    head += " | update | over the filter: median, 99 % | beside | longest row there | together"
    head += " | all, s | memory, MB | rms, m | NEES | rows in buffers |"
    print(head + "\n" + "| --- " * 14 + "|", flush=True)
    for row in lazily(recording):
        before = time.thread_time()
        online.add(row)
        spent = time.thread_time() - before
        tracker = online.tracker
        if tracker is not None and tracker.newest > newest:
            if np.isfinite(newest):  # the first update catches up with all that was aligned over
                found.append([*(tracker.seconds[p] for p in PARTS), spent, sum(beside), max(beside)])
            newest, beside = tracker.newest, [0.0]
            for track in online.settled():
                i = np.clip(np.rint((track.t - truth.t[0]) * RATE).astype(int), 0, len(truth.t) - 1)
                assert track.sd_p is not None
                off = (track.llh - truth.llh[i]) * scale
                ratio = off[:, [1, 0, 2]] / track.sd_p
                errors += np.stack([(off**2).sum(axis=1), (ratio**2).mean(axis=1)], -1).tolist()
        elif spent > A_ROW:
            beside.append(spent)
        if row[1] >= 3600.0 * hour - 1e-6 or row[1] >= recording.end - 1e-6:
            cpu, rows = time.process_time() - began, len(online.sensors.imu)
            report(hour, np.array(found), filtered, np.array(errors), cpu, rows)
            hour, found, errors, began = hour + 1, [], [], time.process_time()
        if row[1] >= recording.end - 1e-6:
            break


def walk(seconds: float, settings: Settings) -> None:
    """Times of the rows of a walk, five minutes after five minutes."""
    recording = simulate("gait", 1, duration=seconds, rate=WALK_RATE).recording
    online, found = Online(drop_rows(recording), settings), []
    until, again, began = recording.start + EVERY, 0, time.process_time()
    print("| min | ms a row that does something: median, 99 %, most | of all rows | settled | linearised again", end="")
    print(" | heading, deg | all, s | memory, MB |\n" + "| --- " * 8 + "|", flush=True)
    for _, t, values in list_rows(recording)[1]:
        before = time.thread_time()
        online.add(("imu", t, values))
        found.append(time.thread_time() - before)
        if t < until and t < recording.end - 1e-6:
            continue
        tracker, spent = online.tracker, np.array(found)
        assert tracker is not None
        newest, window = tracker.window.newest, tracker.window
        up = newest.state.R_nb[0, 2]
        heading = np.degrees(np.sqrt(up @ newest.covariance[:3, :3] @ up))
        working = spent[spent > A_ROW]
        times = " / ".join(f"{1e3 * x:.1f}" for x in np.quantile(working, [0.5, 0.99, 1.0]))
        made = sum(len(track.t) for track in online.settled())
        print(
            f"| {(t - recording.start) / 60.0:.0f} | {times} | {100.0 * len(working) / len(spent):.0f} % | {made} | "
            f"{window.relinearized - again} | {heading:.1f} | {time.process_time() - began:.1f} | {memory_mb():.0f} |",
            flush=True,
        )
        until, again, found, began = until + EVERY, window.relinearized, [], time.process_time()


def lazily(recording: Recording) -> Iterator[Row]:
    """The rows in order, a portion at a time."""
    for begin in np.arange(recording.start, recording.end, PORTION):

        def part(sensor, begin=begin):
            keep = (sensor.t > begin + 1e-9) & (sensor.t <= begin + PORTION + 1e-9)
            names = ("t", "gyro", "accel", "llh", "sd", "speed")
            return replace(sensor, **{n: getattr(sensor, n)[keep] for n in names if hasattr(sensor, n)})

        parts = {name: part(getattr(recording, name)) for name in ("imu", "gnss", "odometer")}
        yield from list_rows(replace(recording, **parts))[1]


def filter_seconds(recording: Recording, settings: Settings) -> float:
    """Process time of the filter per keyframe."""
    problem = build_with_noise(recording, settings)
    began = time.process_time()
    ekf(problem)
    return (time.process_time() - began) / len(problem.t)


def build_with_noise(recording: Recording, settings: Settings, known_from: float = np.inf) -> Problem:
    """A recording aligned and built with its noise model, as for any solver."""
    base, found = estimate(recording, settings, known_from)
    return apply_noise(base, found.noise)


def estimate(recording: Recording, settings: Settings, known_from: float = np.inf) -> tuple[Problem, NoiseEstimate]:
    """A recording aligned and built with stated noise, and its noise model.

    `known_from` are the first seconds of it from which the noise model is estimated.
    """
    frame = LocalFrame(choose_origin(recording), recording.start)
    found = align(recording, settings, frame)

    def build(part: Recording) -> Problem:
        still = detect(part, settings).stationary
        return build_problem(part, settings, frame, found.state, found.sigma, still, parts_of_noise=True)

    base = build(recording)
    first = build(recording.crop(0.0, known_from)) if known_from < recording.end - recording.start else base
    return base, estimate_noise(first, found.until)


def report(hour: int, found: np.ndarray, filtered: float, errors: np.ndarray, cpu: float, rows: int) -> None:
    columns = [*found.T, found[:, 2] + found[:, 3]]
    *parts, update, beside, longest, together = (
        " / ".join(f"{1e3 * x:.1f}" for x in np.quantile(column, [0.5, 0.99, 1.0])) for column in columns
    )
    rms, nees = (np.sqrt(errors[:, 0].mean()), errors[:, 1].mean()) if len(errors) else (np.nan, np.nan)
    ratio = " / ".join(f"{x / filtered:.1f}" for x in np.quantile(found[:, 2], [0.5, 0.99]))
    more = f"{cpu:.1f} | {memory_mb():.0f} | {rms:.4f} | {nees:.2f} | {rows}"
    times = " | ".join([*parts, update, ratio, beside, longest, together])
    print(f"| {hour} | {len(found)} | {times} | {more} |", flush=True)


def memory_mb() -> float:
    """Memory held now (Linux), MB of 2^20 bytes."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * 4096 / 2**20


if __name__ == "__main__":
    main()
