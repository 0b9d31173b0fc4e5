"""A motorway, and crawling traffic."""

from __future__ import annotations

from dataclasses import replace

from graphnav.core.errors import ConfigError
from graphnav.simulation.aiding import OdometerModel
from graphnav.simulation.inertial import MEMS
from graphnav.simulation.kinematics import Mount
from graphnav.simulation.motion import Manoeuvre, Path, make_path
from graphnav.simulation.result import Simulated, record
from graphnav.simulation.scenarios.city import FOUR_CYLINDERS, ORDERS, RTK, SINGLE, spread_gaps
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import Engine, Shake, Springs, simulate_idle_floor, simulate_road_noise

_MOUNT = Mount(above_axle=(0.1, 1.4, 0.6), angles=(0.8, -1.2, 1.5))


def _shake(path: Path, seed: int, rate: float, road: float) -> Shake:
    return Shake(
        (
            simulate_road_noise(path, make_random(seed, "road"), road),
            Springs(height=0.4).lean(path),
            Engine(FOUR_CYLINDERS, 12.1, ORDERS, wander_hz=0.05).simulate_lines(
                path, rate, make_random(seed, "engine")
            ),
            simulate_idle_floor(path, make_random(seed, "idling")),
        )
    )


def motorway(seed: int, *, duration: float = 1500.0, exact: bool = False, rate: float = 100.0) -> Simulated:
    """Up to 36 m/s for `duration` s: long bends, lane changes, a jam without a stop, two bridges, and a rest area."""
    if duration < 300.0:
        raise ConfigError(f"duration = {duration:g}: a motorway takes at least 300 s", key="simulation.value")
    rng = make_random(seed, "way")
    plan = [Manoeuvre(20.0, 0.0), Manoeuvre(10.0, 12.0), Manoeuvre(12.0, 14.0, 100.0, 0.02), Manoeuvre(15.0, 30.0)]
    left, v = duration - 57.0 - 65.0, 30.0
    while left > 150.0:
        speed, slope = (8.0 if rng.random() < 0.12 else rng.uniform(25.0, 36.0)), rng.uniform(-0.035, 0.035)
        part = [
            Manoeuvre(abs(speed - v) / 1.0 + 5.0, speed, 0.0, slope),
            Manoeuvre(rng.uniform(15.0, 45.0), speed, rng.uniform(-25.0, 25.0)),
        ]
        side = rng.choice([-1.0, 1.0]) * 100.0 / (speed * 3.5)  # deg: a lane is 3.5 m, covered in some 5 s
        part += [Manoeuvre(2.5, speed, side), Manoeuvre(2.5, speed, -side), Manoeuvre(rng.uniform(5.0, 15.0), speed)]
        plan, v, left = plan + part, speed, left - sum(m.duration for m in part)
    plan += [Manoeuvre(left, 28.0, 0.0, 0.0), Manoeuvre(15.0, 13.0), Manoeuvre(10.0, 10.0, -70.0)]
    plan += [Manoeuvre(10.0, 0.0), Manoeuvre(30.0, 0.0)]
    path = make_path(plan, heading=float(rng.uniform(0.0, 360.0)), slip_per_accel=0.005)
    gaps = spread_gaps(path, 2, (8.0, 25.0), make_random(seed, "tunnels"))
    return record(
        "motorway", seed, path,
        origin=(48.35, 11.79, 20.0), imu=MEMS.change_rate(rate), mount=_MOUNT, shake=_shake(path, seed, rate, 1.0),
        exact=exact,
        gnss=replace(SINGLE, rate=5.0, outages=gaps),
        odometer=OdometerModel(rate=50.0, scale=0.01, white=0.05, delay=0.04, signed=False),
        facts={"tunnels_s": [list(gap) for gap in gaps], "odometer_delay_s": 0.04},
    )  # fmt: skip


def crawl(
    seed: int, *, jam: float = 600.0, slowest: float = 0.1, fastest: float = 0.3, exact: bool = False,
    rate: float = 100.0,
) -> Simulated:  # fmt: skip
    """Two minutes of driving, `jam` s of creeping at `slowest` to `fastest` m/s with true stops between, and on.

    The road is smooth: creeping hardly differs from standing.
    """
    if not 0.0 < slowest <= fastest <= 3.0:
        raise ConfigError(
            "slowest and fastest must be above 0, in this order, and at most 3 m/s", key="simulation.value"
        )
    if jam < 120.0:
        raise ConfigError(f"jam = {jam:g}: must be at least 120 s", key="simulation.value")
    rng = make_random(seed, "way")

    def drive_on() -> list[Manoeuvre]:
        return [
            Manoeuvre(8.0, 11.0), Manoeuvre(15.0, 12.0, 20.0), Manoeuvre(5.0, 6.0),
            Manoeuvre(8.0, 6.0, rng.choice([-1.0, 1.0]) * 90.0), Manoeuvre(6.0, 12.0), Manoeuvre(15.0, 12.0, -25.0),
        ]  # fmt: skip

    plan, left = [Manoeuvre(20.0, 0.0), *drive_on(), *drive_on(), Manoeuvre(8.0, 0.0)], jam
    creeping = []
    t = sum(m.duration for m in plan)
    while left > 0.0:
        halt, creep, speed = rng.uniform(8.0, 35.0), rng.uniform(10.0, 50.0), rng.uniform(slowest, fastest)
        plan += [Manoeuvre(halt, 0.0), Manoeuvre(2.0, speed), Manoeuvre(creep, rng.uniform(0.8, 1.2) * speed)]
        plan.append(Manoeuvre(1.5, 0.0))
        creeping.append([round(t + halt, 3), round(t + halt + creep + 3.5, 3)])
        used = sum(m.duration for m in plan[-4:])
        t, left = t + used, left - used
    plan += [Manoeuvre(10.0, 0.0), *drive_on(), Manoeuvre(8.0, 0.0), Manoeuvre(15.0, 0.0)]
    path = make_path(plan, heading=float(rng.uniform(0.0, 360.0)), slip_per_accel=0.005)
    return record(
        "crawl", seed, path,
        origin=(50.08, 14.43, 20.0), imu=MEMS.change_rate(rate), mount=_MOUNT, shake=_shake(path, seed, rate, 0.5),
        exact=exact,
        gnss=RTK, odometer=OdometerModel(rate=20.0, scale=0.01, white=0.02),
        facts={"creeping_s": creeping},
    )  # fmt: skip


SCENARIOS = [
    Scenario("motorway", "25 min at up to 36 m/s: bends, lane changes, two gaps in GNSS, a late odometer", motorway),
    Scenario("crawl", "ten minutes of traffic creeping at 0.1 to 0.3 m/s with true stops between", crawl),
]
