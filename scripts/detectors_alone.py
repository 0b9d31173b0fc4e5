"""Every detector alone, and all fused: which stops it finds, and what these are worth where GNSS is missing.

    GRAPHNAV_DATA=../shared/data python scripts/detectors_alone.py

Shares of the standing and of the moving seconds that are called stationary, of what is called stationary the share
that stands (precision), and medians of how late stops begin and end; then the horizontal rms of every solver over six
minutes without GNSS, which are spread evenly over the drive. The noise model is estimated once for each drive, with all
fixes, so that nothing but the stops differs between the lines.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from withheld_spans import runs_of

from graphnav import load
from graphnav.app.scores import Withheld, score
from graphnav.config import Settings, parse_settings
from graphnav.config.detectors import FUSED
from graphnav.detectors import detect, list_detectors
from graphnav.detectors.base import drop_short, find_spans, mask_inside
from graphnav.estimation.noise.model import NoiseModel
from graphnav.estimation.pipeline import SOLVERS, run
from graphnav.recording import Recording
from graphnav.simulation import simulate

Array = np.ndarray
NOBODY = "no stop is used"
FIRE = ("fused", "low_band_glrt", "glrt", "acceleration_variance", "acceleration_magnitude", "angular_rate_energy",
        "fft", NOBODY)  # fmt: skip
MINUTE, COUNT = 60.0, 6  # s withheld at a time, and how many times
SLOW, EXACT = 0.1, 0.01  # m/s, below which a velocity is rest: a receiver's, and that of a simulated truth
STEP = 0.02  # s
SHORTEST = 2.0  # s; of what rolls through zero the truth's epochs do not tell whether it stands


@dataclass(frozen=True)
class Drive:
    name: str
    recording: Recording
    stops: Array  # (M, 2) s
    known: tuple[float, float]  # s, in which they are


def drives(folder: Path, names: list[str]) -> Iterator[Drive]:
    for name in names:
        if name == "li2024":
            made = simulate("li2024", 0, short=True)
            yield Drive(name, made.recording, made.stops, (made.recording.start, made.recording.end))
            continue
        recording = load(folder / name)
        meta = folder / name / "meta.json"
        stated = json.loads(meta.read_text(encoding="utf-8")).get("stops_s") if meta.exists() else None
        if stated is not None:  # told from the fixes, too
            assert recording.gnss is not None
            stops, t = np.array(stated), recording.gnss.t
        else:
            of = recording.truth or recording.gnss
            assert of is not None
            assert of.v is not None
            t, slow = of.t, np.hypot(of.v[:, 0], of.v[:, 1]) < (SLOW if recording.truth is None else EXACT)
            stops = drop_short(find_spans(slow, t), SHORTEST)
        known = max(recording.start, t[0]), min(recording.end, t[-1])
        yield Drive(name, recording, np.clip(stops, *known), known)


def settings_of(fire: str) -> Settings:
    if fire == NOBODY:
        return parse_settings({"standstill": {"zero_velocity": False, "zero_rate": False, "held_position": False}})
    return parse_settings({"detectors": {"fire": [fire]}})


def stationary(recording: Recording, fire: str) -> Array:
    """(M, 2) s, what a detector calls stationary, or at least so many of them, each by itself."""
    if not fire.isdigit():
        return detect(recording, settings_of(fire)).stationary
    t = np.arange(recording.start, recording.end, STEP)
    votes = [mask_inside(t, detect(recording, settings_of(name)).stationary) for name in list_detectors()]
    return drop_short(
        find_spans(np.sum(votes, axis=0) >= int(fire), t), settings_of(FUSED).detectors.fusion.min_duration
    )


def found_by(drive: Drive, recording: Recording, fire: str) -> list[str]:
    """Standing and moving seconds called stationary, precision (%), stops found, how late they begin and end (s)."""
    if fire == NOBODY:
        return ["-"] * 6
    found, t = stationary(recording, fire), np.arange(*drive.known, STEP)
    still, called = mask_inside(t, drive.stops), mask_inside(t, found)
    late = []
    for begin, end in drive.stops:
        own = found[(found[:, 1] > begin) & (found[:, 0] < end)]
        if len(own):
            late.append((own[0, 0] - begin, min(own[-1, 1], drive.known[1]) - end))
    middle = np.median(late, axis=0) if late else np.full(2, np.nan)
    return [
        f"{100.0 * called[still].mean():.1f}", f"{100.0 * called[~still].mean():.2f}",
        f"{100.0 * still[called].mean():.2f}" if called.any() else "-",
        f"{len(late)} of {len(drive.stops)}", f"{middle[0]:+.2f}", f"{middle[1]:+.2f}",
    ]  # fmt: skip


def minutes(drive: Drive) -> list[float]:
    """Starts of the minutes that are withheld, s from the recording's start: evenly, with a minute before the first."""
    gnss, start = drive.recording.gnss, drive.recording.start
    assert gnss is not None
    first, last = max(gnss.t[0], drive.recording.start), min(gnss.t[-1], drive.recording.end)
    return [round(float(s), 1) for s in np.linspace(first - start + MINUTE, last - start - 1.5 * MINUTE, COUNT)]


def rms(drive: Drive, fire: str, noise: NoiseModel) -> dict[str, float]:
    """Horizontal rms of each solver over all minutes withheld, m."""
    squares: dict[str, list[Array]] = {name: [] for name in SOLVERS}
    for starts in runs_of(minutes(drive), MINUTE):
        withheld: tuple[Withheld, ...] = tuple(("gnss", (s, s + MINUTE)) for s in starts)
        used = drive.recording
        for source, span in withheld:
            used = used.without(source, span)
        solutions = run(used, settings_of(fire), SOLVERS, noise=noise)
        for name, metrics in score(drive.recording, used, solutions, withheld)[0].items():
            assert metrics.errors is not None
            t = metrics.errors.t - drive.recording.start
            for s in starts:
                squares[name].append(np.sum(metrics.errors.p[(t >= s) & (t <= s + MINUTE), :2] ** 2, axis=1))
    return {name: float(np.sqrt(np.nanmean(np.concatenate(parts)))) for name, parts in squares.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", default="tokyo_20201105,boulder_drive_20250708,oracle_drive,li2024")
    parser.add_argument("--fire", default=",".join(FIRE), help="comma separated (%(default)s); 2: where two of them do")
    parser.add_argument("--without", choices=("odometer",), help="take a sensor away altogether")
    parser.add_argument("--no-solvers", action="store_true", help="what is found alone")
    options = parser.parse_args()
    assert set(list_detectors()) < set(FIRE)
    head = ["drive", "fires", "found, %", "false, %", "right, %", "stops", "begins late, s", "ends late, s"]
    head += ["IMU alone: found, %", "false, %", "right, %"]
    head += [] if options.no_solvers else [f"{name}, m" for name in SOLVERS]
    print(f"| {' | '.join(head)} |\n|{' --- |' * len(head)}", flush=True)
    for drive in drives(Path(os.environ["GRAPHNAV_DATA"]), options.drives.split(",")):
        if options.without and drive.recording.odometer is not None:
            drive = Drive(drive.name, drive.recording.without(options.without), drive.stops, drive.known)
        blind = drive.recording.without("gnss")
        blind = blind.without("odometer") if blind.odometer is not None else blind
        noise = None if options.no_solvers else run(drive.recording, solvers=("ekf",))["ekf"].noise
        for fire in options.fire.split(","):
            cells = [*found_by(drive, drive.recording, fire), *found_by(drive, blind, fire)[:3]]
            cells += [] if noise is None else [f"{error:.2f}" for error in rms(drive, fire, noise).values()]
            print(f"| {drive.name} | {fire} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
