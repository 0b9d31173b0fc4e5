"""How well drives are solved that are damaged at random: each draw is a window of a drive with several faults at once.

    python scripts/damage_draws.py -o draws.json --draws 40 --seed 1
    python scripts/damage_draws.py -o draws.json --draws 40 --seed 1 --only 17

What is drawn, and how large, is in `FAULTS`: errors of fixes as in street canyons, wrong sigmas, stamps and lever arms,
outages, a worse IMU, wheels that lag, slip or stand below walking pace. Every draw is solved as stated with every fix
used, with the defaults, and undamaged with the defaults; errors are against the drive's own truth, or against fixes
that are withheld. Rows go to the file as they come.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from damage import STATED, moved
from do_no_harm import DRIVES, HERE, load, placed, withheld_of

import graphnav
from graphnav.app.scores import score
from graphnav.config import settings_from
from graphnav.evaluation.metrics import summary
from graphnav.recording import Gnss, Imu, Odometer, Recording

SOLVERS = ("ekf", "rts", "batch")
LENGTHS = 120.0, 300.0  # s, of a window
NAMES = ("tokyo", "tokyo_no_doppler", "boulder", "kitti", "comma", "dresden", "tokyo_clone", "oracle", "circles_2024")

Rng = np.random.Generator


@dataclass(frozen=True)
class Fault:
    """One way for a sensor to go wrong, and how often a draw has it."""

    sensor: str
    chance: float
    damage: Callable[[Any, Rng], tuple[Any, str]]  # the sensor as it comes, and what was done to it


def spans(t: np.ndarray, rng: Rng, most: int, shortest: float, longest: float) -> list[tuple[float, float]]:
    """Up to `most` spans (s) within times t (N,)."""
    out = []
    for _ in range(int(rng.integers(1, most + 1))):
        length = float(np.exp(rng.uniform(np.log(shortest), np.log(longest))))
        begin = float(rng.uniform(t[0], max(t[-1] - length, t[0])))
        out.append((begin, begin + length))
    return out


def wrong_sigmas(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by = float(np.exp(rng.uniform(np.log(0.2), np.log(15.0))))
    sd_v = None if gnss.sd_v is None else gnss.sd_v * by
    return replace(gnss, sd=gnss.sd * by, sd_v=sd_v), f"sigmas x {by:.2f}"


def outliers(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    share, size = rng.uniform(0.01, 0.1), np.exp(rng.uniform(np.log(5.0), np.log(100.0)))
    wrong = rng.random(len(gnss.t)) < share
    by = size * wrong[:, None] * rng.standard_normal((len(gnss.t), 3))
    return moved(gnss, by), f"{100 * share:.0f} % off by {size:.0f} m"


def bursts(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by, said = np.zeros((len(gnss.t), 3)), []
    for begin, end in spans(gnss.t, rng, 3, 3.0, 60.0):
        error = rng.standard_normal(3) * np.exp(rng.uniform(np.log(3.0), np.log(30.0)))
        inside = (gnss.t >= begin) & (gnss.t < end)
        ramp = (gnss.t[inside] - begin) / (end - begin) if rng.random() < 0.4 else np.ones(int(inside.sum()))
        by[inside] += ramp[:, None] * error
        said.append(f"{begin - gnss.t[0]:.0f}-{end - gnss.t[0]:.0f} s by {np.linalg.norm(error):.0f} m")
    return moved(gnss, by), "bursts " + ", ".join(said)


def canyons(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    """Errors that last for ten to thirty seconds, of which the sigmas know nothing."""
    by, said = np.zeros((len(gnss.t), 3)), []
    for begin, end in spans(gnss.t, rng, 3, 20.0, 90.0):
        inside = np.flatnonzero((gnss.t >= begin) & (gnss.t < end))
        tau, size = rng.uniform(10.0, 30.0), np.exp(rng.uniform(np.log(1.0), np.log(8.0)))
        error = size * rng.standard_normal(3)
        for k in inside:
            a = np.exp(-(gnss.t[k] - gnss.t[max(k - 1, 0)]) / tau)
            error = a * error + size * np.sqrt(1.0 - a * a) * rng.standard_normal(3)
            by[k] = error
        said.append(f"{begin - gnss.t[0]:.0f}-{end - gnss.t[0]:.0f} s of {size:.1f} m")
    return moved(gnss, by), "canyons " + ", ".join(said)


def outages(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    keep, some = np.ones(len(gnss.t), dtype=bool), spans(gnss.t, rng, 2, 15.0, 60.0)
    for begin, end in some:
        keep &= (gnss.t < begin) | (gnss.t > end)
    per_row = {
        name: value[keep]
        for name in ("t", "llh", "sd", "v", "sd_v", "type", "satellites")
        if (value := getattr(gnss, name)) is not None
    }
    return replace(gnss, **per_row), "none " + ", ".join(f"{a - gnss.t[0]:.0f}-{b - gnss.t[0]:.0f} s" for a, b in some)


def late_stamps(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    late, jitter = rng.uniform(-0.1, 0.3), rng.choice([0.0, 0.2, 0.5])
    t = np.sort(gnss.t + late + rng.uniform(0.0, 1.0, len(gnss.t)) * jitter)
    return replace(gnss, t=t + np.arange(len(t)) * 1e-7), f"stamps late by {late:.2f} s and up to {jitter} more"


def wrong_arm(gnss: Gnss, rng: Rng) -> tuple[Gnss, str]:
    by = rng.uniform(-0.8, 0.8, 3)
    return replace(gnss, lever_arm=gnss.lever_arm + by), f"lever arm off by {np.linalg.norm(by):.1f} m"


def worse_noise(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    by, root = rng.uniform(2.0, 10.0), np.sqrt(1.0 / imu.period)
    gyro = imu.gyro + by * imu.noise.gyro_noise_density * root * rng.standard_normal(imu.gyro.shape)
    accel = imu.accel + by * imu.noise.accel_noise_density * root * rng.standard_normal(imu.accel.shape)
    return replace(imu, gyro=gyro, accel=accel), f"IMU noise x {by:.1f}"


def own_errors(imu: Imu, rng: Rng) -> tuple[Imu, str]:
    """Scale errors and misalignments of a consumer IMU."""
    of_gyro, of_accel = (np.eye(3) + 0.01 * rng.standard_normal((3, 3)) for _ in range(2))
    return replace(imu, gyro=imu.gyro @ of_gyro.T, accel=imu.accel @ of_accel.T), "IMU scale and axes 1 %"


def dead_zone(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    below = rng.uniform(0.5, 2.0)
    speed = np.where(np.abs(odometer.speed) < below, 0.0, odometer.speed)
    return replace(odometer, speed=speed, wheels=None, counted=None), f"wheels stand below {below:.1f} m/s"


def lag(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    late = rng.uniform(0.1, 0.6)
    return replace(odometer, t=odometer.t + late), f"wheels late by {late:.2f} s"


def slip(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    speed, some = odometer.speed.copy(), spans(odometer.t, rng, 3, 1.0, 15.0)
    for begin, end in some:
        speed[(odometer.t >= begin) & (odometer.t < end)] *= rng.uniform(0.5, 1.4)
    return replace(odometer, speed=speed, wheels=None, counted=None), f"wheels slip {len(some)} times"


def wrong_scale(odometer: Odometer, rng: Rng) -> tuple[Odometer, str]:
    by = 1.0 + rng.uniform(-0.06, 0.06)
    return replace(odometer, speed=by * odometer.speed, wheels=None, counted=None), f"wheels x {by:.3f}"


FAULTS = (
    Fault("gnss", 0.5, wrong_sigmas),
    Fault("gnss", 0.3, outliers),
    Fault("gnss", 0.4, bursts),
    Fault("gnss", 0.3, canyons),
    Fault("gnss", 0.2, wrong_arm),
    Fault("gnss", 0.25, late_stamps),
    Fault("gnss", 0.3, outages),
    Fault("imu", 0.25, worse_noise),
    Fault("imu", 0.25, own_errors),
    Fault("odometer", 0.3, dead_zone),
    Fault("odometer", 0.3, lag),
    Fault("odometer", 0.3, slip),
    Fault("odometer", 0.3, wrong_scale),
)


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
    used, done = clean, []
    for fault in FAULTS:
        sensor = getattr(used, fault.sensor)
        if rng.random() < fault.chance and sensor is not None:
            changed, said = fault.damage(sensor, rng)
            used = replace(used, **{fault.sensor: changed})
            done.append(said)
    row = {"draw": number, "drive": name, "window": f"{begin:.0f}-{begin + length:.0f}", "damage": done}
    return row | {"odometer": clean.odometer is not None}, clean, used, DRIVES[name].doppler


def solve(number: int, options: argparse.Namespace) -> dict[str, Any]:
    row, clean, used, doppler = draw(number, options)
    withheld = withheld_of(clean, clean.duration) if clean.truth is None else ()
    estimated: dict[str, dict[str, Any]] = {"gnss": {"velocity": doppler}}
    stated = {"noise": STATED["noise"], "gnss": STATED["gnss"] | estimated["gnss"]}
    for variant, part, values in (
        ("stated", used, stated),
        ("estimated", used, estimated),
        ("clean", clean, estimated),
    ):
        for source, span in withheld:
            part = part.without(source, span)
        began = time.process_time()
        try:
            solutions = graphnav.run(part, settings_from(values), SOLVERS)
            row[f"{variant} s"] = round(time.process_time() - began, 2)
            metrics = score(clean, part, solutions, withheld)[0]
        except graphnav.GraphnavError as error:
            row[variant] = {"error": str(error).split("\n")[0]}
            continue
        found = {solver: summary(metrics[solver]) for solver in SOLVERS}
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
