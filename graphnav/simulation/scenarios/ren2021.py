"""Ren 2021: thirteen closed walks with an IMU on the foot; and any other walk."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import ConfigError
from graphnav.simulation.footsteps import Cadence, list_rectangle, make_footsteps, make_route
from graphnav.simulation.gait import Sole, Style
from graphnav.simulation.gait import walk as walk_over
from graphnav.simulation.inertial import DEG_H, DEG_SQRT_H, SimulatedImu, Triad, make_accelerometer, make_gyroscope
from graphnav.simulation.pedestrian import record_walk
from graphnav.simulation.result import Simulated
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.splines import make_random

DEG = np.pi / 180.0
# Table 2: perimeter (m), laps, duration (s)
WALKS = (
    (30.0, 1, 38.0), (58.0, 1, 68.0), (58.0, 1, 67.0), (86.0, 1, 94.0), (86.0, 1, 92.0), (86.0, 2, 159.0),
    (86.0, 2, 176.0), (86.0, 3, 248.0), (86.0, 3, 255.0), (86.0, 3, 278.0), (86.0, 4, 365.0), (86.0, 4, 355.0),
    (86.0, 4, 353.0),
)  # fmt: skip
# Table 1 as printed; what it does not give is of the size usual for the sensor: 2 mg and 0.02 deg/s at turn-on,
# scale errors of 500 ppm.
ELLIPSE2 = SimulatedImu(
    "SBG Ellipse2 of Ren 2021, table 1", 100.0,
    Triad(0.15 * DEG_SQRT_H, 72.0 * DEG_H, 7.0 * DEG_H, scale=5e-4, misalignment=5e-4, limit=450.0 * DEG),
    Triad(5.7e-5, 0.02, 1.4e-5, scale=5e-4, misalignment=5e-4, limit=160.0),
)  # fmt: skip
# Of the noise that the recordings of OpenShoe (3DM-GX2) and x-io (NGIMU) have at rest.
SHOE = SimulatedImu(
    "MEMS in a shoe", 200.0,
    make_gyroscope(1.0, 1800.0, instability_deg_h=20.0, scale_ppm=3000.0, misalignment_mrad=3.0, range_deg_s=1200.0),
    make_accelerometer(100.0, 6.0, instability_mg=0.05, scale_ppm=3000.0, misalignment_mrad=3.0, range_g=18.0),
)  # fmt: skip
PRESETS = {"ellipse2": ELLIPSE2, "shoe": SHOE}
PACES = {"slow": 0.8, "normal": 1.2, "fast": 1.75}  # m/s
_ORIGIN = (32.06, 118.79, 20.0)


def ren2021(
    seed: int, *, walk: int = 10, exact: bool = False, compensated: bool = False, rate: float = 100.0
) -> Simulated:
    """Walk `walk` (1 to 13) of table 2: laps to the left around a rectangle, back onto the first footprint."""
    if not (isinstance(walk, int) and 1 <= walk <= len(WALKS)):
        raise ConfigError(f"walk = {walk}: must be from 1 to {len(WALKS)}", key="simulation.value")
    perimeter, laps, duration = WALKS[walk - 1]
    parts, imu = list_rectangle(perimeter, laps), ELLIPSE2.change_rate(_check_rate(rate))
    return _walk(
        "ren2021", seed, duration, parts, imu, exact, compensated, True, {"walk": walk, "laps": laps}
    )  # fmt: skip


def free(
    seed: int, *, pace: str = "normal", duration: float = 60.0, imu: str = "shoe", course: str = "laps",
    exact: bool = False, compensated: bool = False, rate: float = 200.0,
) -> Simulated:  # fmt: skip
    """A walk of `duration` s at a `pace` (slow, normal, fast) with an `imu` (shoe, ellipse2).

    `course` is "laps" (to the left around a rectangle of some 40 m, closed), "bends" (to and fro, with corners and
    turning round) or "straight".
    """
    for key, value, known in (("pace", pace, PACES), ("imu", imu, PRESETS)):
        if value not in known:
            raise ConfigError(f"{key} = '{value}': must be {', '.join(known)}", key="simulation.value")
    if not 20.0 <= duration <= 7200.0:
        raise ConfigError(f"duration = {duration:g}: must be from 20 to 7200 s", key="simulation.value")
    length = PACES[pace] * (duration - _draw_rest(seed).sum())
    rng = make_random(seed, "course")
    if course == "laps":
        laps = max(1, round(length / 40.0))
        parts = list_rectangle(length / laps, laps)
    elif course == "straight":
        parts = [(length, 0.0)]
    elif course == "bends":
        parts, left = [], length
        while left > 12.0:
            side, turn = rng.uniform(3.0, 9.0), rng.choice([-180.0, -90.0, -90.0, -45.0, 45.0, 90.0, 90.0, 180.0])
            parts += [(side, 0.0), (0.6 * abs(turn) * DEG, turn)]
            left -= side + parts[-1][0]
        parts.append((left, 0.0))
    else:
        raise ConfigError(f"course = '{course}': must be laps, bends or straight", key="simulation.value")
    sensor = PRESETS[imu].change_rate(_check_rate(rate))
    return _walk(
        "gait", seed, duration, parts, sensor, exact, compensated, course == "laps", {"pace": pace, "course": course}
    )


def _check_rate(rate: float) -> float:
    if not 50.0 <= rate <= 2000.0:
        raise ConfigError(f"rate = {rate:g}: must be from 50 to 2000 Hz", key="simulation.value")
    return rate


def _draw_rest(seed: int) -> np.ndarray:
    """s at rest before and after the walk."""
    return make_random(seed, "rest").uniform([2.0, 1.5], [6.0, 4.0])


def _walk(
    name: str, seed: int, duration: float, parts: list[tuple[float, float]], imu: SimulatedImu, exact: bool,
    compensated: bool, closed: bool, facts: dict[str, object],
) -> Simulated:  # fmt: skip
    rest = _draw_rest(seed)
    rng = make_random(seed, "course")
    along = make_route(parts, float(rng.uniform(0.0, 360.0)))
    walked = duration - float(rest.sum())
    speed = along.length / walked
    steps = make_footsteps(
        along, Cadence.of(speed), float(rest[0]), walked, duration, make_random(seed, "steps"), closed=closed
    )
    foot = walk_over(steps, Style.of(speed), Sole(), duration, make_random(seed, "gait"))
    angles = make_random(seed, "mounting").normal(0.0, [3.0, 4.0, 4.0])
    mounting = (float(angles[0]), float(angles[1]), float(angles[2]))
    return record_walk(
        name, seed, foot, origin=_ORIGIN, imu=imu, mounting=mounting, exact=exact, compensated=compensated,
        facts={**facts, "distance_m": round(along.length, 3), "closed": closed},
    )  # fmt: skip


SCENARIOS = [
    Scenario("ren2021", "walks of 30 to 344 m around a rectangle, an IMU on the foot at 100 Hz, no GNSS", ren2021),
    Scenario("gait", "a foot's walk at a slow, normal or fast pace, no GNSS", free),
]
