"""Ushaq: an hour on a square with GNSS faults and stops of a minute."""

from __future__ import annotations

from graphnav.core.errors import ConfigError
from graphnav.simulation.aiding import GnssModel, OdometerModel, SimulatedFault, Span
from graphnav.simulation.inertial import SimulatedImu, make_accelerometer, make_gyroscope
from graphnav.simulation.kinematics import Mount
from graphnav.simulation.motion import Manoeuvre, make_path
from graphnav.simulation.result import Simulated, record
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import Engine, Idle, Shake, simulate_idle_floor, simulate_road_noise

# The paper gives the biases only; noise and instability are those usual of such sensors.
IMU = SimulatedImu(
    "IMU of Ushaq", 100.0,
    make_gyroscope(0.1, 5.0, instability_deg_h=1.0), make_accelerometer(50.0, 0.2, instability_mg=0.02),
)  # fmt: skip
FAULTS: tuple[Span, ...] = ((1080.0, 1500.0), (2580.0, 2820.0))  # 18-25 and 43-47 min
_SPEED, _TURN, _GAIN = 10.0, 12.0, 10.0  # m/s; s of a corner; s to gain or lose the speed
_IDLE = Idle(((0.3, 0.4, 0.6), (1.0, 2.0, 4.0)), (0.02, 0.15))


def ushaq(
    seed: int,
    *,
    fault: str = "none",
    growth: float = 1.0,
    growth_in_velocity: bool = False,
    stops_every: float = 0.0,
    odometer: bool = False,
    exact: bool = False,
    rate: float = 100.0,
) -> Simulated:
    """Ten minutes still, ten east at 10 m/s, left, north, left, west, left, south back to the start, ten still.

    `fault` is what GNSS does in 18-25 and 43-47 min: "none", "noise" (errors 100 times larger), "growing" (a
    position error that grows by `growth` m/s to the north-east, in the velocities too if `growth_in_velocity`) or
    "outage". `stops_every` min the vehicle stops for a minute, from the 20th on while it drives; 0 is never.
    `odometer` adds wheel speeds, which the paper has not.
    """
    outages: tuple[Span, ...] = ()
    faults: tuple[SimulatedFault, ...] = ()
    if fault == "outage":
        outages = FAULTS
    elif fault == "noise":
        faults = tuple(SimulatedFault(a, b, noise=100.0) for a, b in FAULTS)
    elif fault == "growing":
        rise = (0.7071 * growth, 0.7071 * growth, 0.0)
        drift = rise if growth_in_velocity else (0.0, 0.0, 0.0)
        faults = tuple(SimulatedFault(a, b, growth=rise, velocity=drift) for a, b in FAULTS)
    elif fault != "none":
        raise ConfigError(f"fault = '{fault}': must be none, noise, growing or outage", key="simulation.value")
    if stops_every and stops_every < 4.0:
        raise ConfigError(f"stops_every = {stops_every:g}: must be 0 or at least 4 min", key="simulation.value")

    plan = _drive_square(60.0 * stops_every)
    path = make_path(plan, heading=90.0)
    shake = Shake(
        (
            simulate_road_noise(path, make_random(seed, "road"), 0.5),
            Engine(_IDLE, 13.0, wander_hz=0.03).simulate_lines(path, rate, make_random(seed, "engine")),
            simulate_idle_floor(path, make_random(seed, "idling")),
        )
    )
    return record(
        "ushaq", seed, path,
        origin=(33.7, 73.1, 20.0), imu=IMU.change_rate(rate), mount=Mount((0.0, 1.2, 0.5)), shake=shake, exact=exact,
        gnss=GnssModel(white=(25.0, 25.0, 25.0), velocity=(0.1, 0.1, 0.1), outages=outages, faults=faults,
                       lever_arm=(0.0, -0.3, 1.0)),
        odometer=OdometerModel(rate=10.0) if odometer else None,
        facts={"fault": fault, "fault_spans": [list(span) for span in FAULTS] if fault != "none" else []},
    )  # fmt: skip


def _drive_square(every: float) -> list[Manoeuvre]:
    """The manoeuvres, with stops of a minute at multiples of `every` s from the 20th minute on."""
    plan, t = [Manoeuvre(600.0, 0.0), Manoeuvre(_GAIN, _SPEED)], 600.0 + _GAIN
    due = every * max(1.0, -(-1200.0 // every)) if every else float("inf")
    # a corner covers 12 s of way, so the later sides are shorter or longer by its 7.6 s along them
    corner = _TURN * 2.0 / 3.1416
    sides = (600.0 - 0.5 * _GAIN + corner, 600.0, 600.0, 600.0 + corner - 0.5 * _GAIN)
    for k, side in enumerate(sides):
        left = side
        while due - _GAIN < t + left + 30.0 and k < 3:
            before = min(max(due - _GAIN - t, 1.0), left - 2.0 * _GAIN)
            plan += [Manoeuvre(before, _SPEED), Manoeuvre(_GAIN, 0.0), Manoeuvre(60.0, 0.0), Manoeuvre(_GAIN, _SPEED)]
            t, left, due = t + before + 60.0 + 2.0 * _GAIN, left - before - _GAIN, due + every
        plan.append(Manoeuvre(left, _SPEED))
        t += left
        if k < 3:
            plan.append(Manoeuvre(_TURN, _SPEED, -90.0))
            t += _TURN
    return [*plan, Manoeuvre(_GAIN, 0.0), Manoeuvre(max(3600.0 - t - _GAIN, 300.0), 0.0)]


SCENARIOS = [
    Scenario("ushaq", "an hour on a square of 6 km: GNSS of 25 m with faults, stops of a minute, 5 deg/h", ushaq)
]
