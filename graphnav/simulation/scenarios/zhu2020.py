"""Zhu 2020: odometer and motion constraints through the loss of GNSS, the odometer unplugged and back."""

from __future__ import annotations

import numpy as np

from graphnav.core.errors import ConfigError
from graphnav.simulation.aiding import GnssModel, OdometerModel
from graphnav.simulation.inertial import MIMU
from graphnav.simulation.kinematics import Mount
from graphnav.simulation.motion import Manoeuvre, make_path
from graphnav.simulation.result import Simulated, record
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import Engine, Idle, Shake, Springs, simulate_idle_floor, simulate_road_noise

_IDLE = Idle(((1.0, 2.0, 4.0), (0.3, 2.0, 3.0)), (0.25, 0.01))


def zhu2020(
    seed: int,
    *,
    gnss_s: float = 75.0,
    after_s: float = 150.0,
    unplugged: bool = True,
    odometer_scale: float = 0.01,
    pulse: float = 0.0,
    slip: float = 0.004,
    exact: bool = False,
    rate: float = 400.0,
) -> Simulated:
    """GNSS for `gnss_s` s and none for the `after_s` that follow, on corners, bends and slopes to 4 %.

    With `unplugged` the odometer gives nothing from 90 to 105 s after GNSS is lost: at 165 to 180 s with the
    defaults, as in figures 15 to 18. The 90-s cases of tables 2 and 3 are `unplugged=False, after_s=90`.
    `odometer_scale` is the 1-sigma of its scale error, `pulse` m of way per wheel pulse (0: not counted in pulses),
    `slip` rad of side-slip per m/s^2 (0: the constraints hold exactly). The IMU is mounted with a pitch and a
    heading of one to two degrees against the vehicle.
    """
    if gnss_s < 40.0 or after_s < 30.0:
        raise ConfigError("gnss_s must be at least 40 s and after_s at least 30 s", key="simulation.value")
    lost, end = float(gnss_s), float(gnss_s + after_s)
    rng = make_random(seed, "way")
    plan, t, v = [Manoeuvre(8.0, 0.0), Manoeuvre(6.0, 8.0)], 14.0, 8.0
    while end - t > 45.0:
        fast, slope = rng.uniform(9.0, 14.0), rng.uniform(0.01, 0.04) * rng.choice([-1.0, 1.0])
        plan += [
            Manoeuvre(4.0, fast, 0.0, slope), Manoeuvre(rng.uniform(5.0, 10.0), fast, rng.uniform(-25.0, 25.0)),
            Manoeuvre(4.0, 6.0, 0.0, 0.0), Manoeuvre(7.0, 6.0, rng.choice([-1.0, 1.0]) * rng.uniform(75.0, 100.0)),
        ]  # fmt: skip
        t, v = t + sum(m.duration for m in plan[-4:]), 6.0
    plan += [Manoeuvre(end - t - 10.0, v + 3.0, rng.uniform(-20.0, 20.0)), Manoeuvre(6.0, 0.0, 0.0, 0.0)]
    plan.append(Manoeuvre(4.0, 0.0))
    path = make_path(plan, heading=float(rng.uniform(0.0, 360.0)), slip_per_accel=slip)

    turn = make_random(seed, "mounting")
    pitch, heading = turn.uniform(1.0, 2.0, 2) * turn.choice([-1.0, 1.0], 2)
    mount = Mount(above_axle=(0.2, 1.1, 0.5), angles=(0.0, float(pitch), float(heading)))
    shake = Shake(
        (
            simulate_road_noise(path, make_random(seed, "road")),
            Springs(height=0.3).lean(path),
            Engine(_IDLE, 13.3, wander_hz=0.05).simulate_lines(path, rate, make_random(seed, "engine")),
            simulate_idle_floor(path, make_random(seed, "idling")),
        )
    )
    gap = (lost + 90.0, lost + 105.0)
    return record(
        "zhu2020", seed, path,
        origin=(32.03, 118.85, 20.0), imu=MIMU.change_rate(rate), mount=mount, shake=shake, exact=exact,
        gnss=GnssModel(
            white=(0.6, 0.6, 1.2), slow=(0.8, 0.8, 1.6), slow_time=60.0, velocity=(0.05, 0.05, 0.08),
            lever_arm=(0.1, -0.4, 0.9), outages=((lost, np.inf),),
        ),
        odometer=OdometerModel(
            rate=20.0, scale=odometer_scale, pulse=pulse, unplugged=(gap,) if unplugged and gap[0] < end else ()
        ),
        facts={"gnss_lost_s": lost, "odometer_unplugged_s": list(gap) if unplugged else []},
    )  # fmt: skip


SCENARIOS = [
    Scenario(
        "zhu2020",
        "75 s with GNSS and 150 s without, 400-Hz MIMU mounted askew, odometer unplugged for 15 s of it",
        zhu2020,
    )
]
