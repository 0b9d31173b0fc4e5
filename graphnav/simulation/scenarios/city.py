"""Towns: lights, corners, hills, tunnels and parking; with an engine, and electric."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphnav.core.errors import ConfigError
from graphnav.core.rotation import Array
from graphnav.simulation.aiding import GnssModel, OdometerModel, Span
from graphnav.simulation.inertial import MEMS
from graphnav.simulation.kinematics import Mount
from graphnav.simulation.motion import Manoeuvre, Path, make_path
from graphnav.simulation.passengers import Boarding, Fidget, simulate_movement
from graphnav.simulation.result import Simulated, record
from graphnav.simulation.scenarios.registry import Scenario
from graphnav.simulation.scenarios.town import choose_manoeuvres
from graphnav.simulation.series import BarometerModel, DualAntennaModel
from graphnav.simulation.splines import make_random
from graphnav.simulation.vibration import Engine, Idle, Shake, Springs, simulate_idle_floor, simulate_road_noise

# a four-cylinder engine: its second order is the strongest
FOUR_CYLINDERS = Idle(((0.4, 0.5, 0.8), (1.5, 3.0, 6.0), (0.5, 1.0, 2.0)), (0.02, 0.15, 0.02))
ORDERS = (1.0, 2.0, 4.0)
RTK = GnssModel(white=(0.01, 0.01, 0.02), slow=(0.008, 0.008, 0.015), lever_arm=(0.1, -0.3, 0.8))
SINGLE = GnssModel(
    white=(0.5, 0.5, 1.0), slow=(1.5, 1.5, 3.0), slow_time=100.0, velocity=(0.1, 0.1, 0.15), lever_arm=(0.1, -0.3, 0.8)
)
PULSE = 2.0 * np.pi * 0.31 / 48.0 / 4.0  # m of way: 48 teeth on each of four wheels of 0.31 m


def urban(
    seed: int, *, duration: float = 1200.0, tunnels: int = 2, gnss: str = "rtk", odometer: bool = True,
    engine: bool = True, idle_hz: float = 13.3, barometer: bool = False, antennas: bool = False, exact: bool = False,
    rate: float = 100.0,
) -> Simulated:  # fmt: skip
    """A consumer IMU through a town of `duration` s with `tunnels` gaps in GNSS, and backwards into a parking place.

    `gnss` is "rtk" or "single"; the odometer counts wheel pulses; `idle_hz` is the crankshaft's, whose strong line is
    at twice this. `antennas` adds a second antenna.
    """
    idle = idle_hz if engine else 0.0
    return _build_town("urban", seed, duration, tunnels, gnss, odometer, idle, barometer, antennas, exact, rate)


def electric(
    seed: int, *, duration: float = 900.0, tunnels: int = 1, gnss: str = "rtk", odometer: bool = True,
    barometer: bool = False, antennas: bool = False, exact: bool = False, rate: float = 100.0,
) -> Simulated:  # fmt: skip
    """A similar town in a car without engine vibration at stops."""
    return _build_town("electric", seed, duration, tunnels, gnss, odometer, 0.0, barometer, antennas, exact, rate)


def _build_town(
    name: str, seed: int, duration: float, tunnels: int, gnss: str, odometer: bool, idle_hz: float,
    barometer: bool, antennas: bool, exact: bool, rate: float,
) -> Simulated:  # fmt: skip
    if duration < 240.0:
        raise ConfigError(f"duration = {duration:g}: a town takes at least 240 s", key="simulation.value")
    if gnss not in ("rtk", "single"):
        raise ConfigError(f"gnss = '{gnss}': must be rtk or single", key="simulation.value")
    rng = make_random(seed, "way")
    parking = [
        Manoeuvre(4.0, 4.0), Manoeuvre(4.0, 0.0, 15.0), Manoeuvre(3.0, 0.0),
        Manoeuvre(2.0, -1.2), Manoeuvre(4.0, -1.2, 50.0), Manoeuvre(4.0, -1.0, -65.0), Manoeuvre(2.0, 0.0),
        Manoeuvre(2.0, 0.0), Manoeuvre(2.0, 0.5), Manoeuvre(1.0, 0.0), Manoeuvre(15.0, 0.0),
    ]  # fmt: skip
    length = duration - 20.0 - sum(m.duration for m in parking)
    plan = [Manoeuvre(20.0, 0.0), *choose_manoeuvres(length, rng, hills=0.06, pause=0.5), *parking]
    path = make_path(plan, heading=float(rng.uniform(0.0, 360.0)), slip_per_accel=0.005)
    mount = Mount(above_axle=(0.1, 1.4, 0.6), angles=(0.8, -1.2, 1.5))
    parts = [
        simulate_road_noise(path, make_random(seed, "road")),
        Springs(height=0.4).lean(path),
        simulate_movement(path, _seat_passengers(path, seed), (0.0, 0.0, 0.4), make_random(seed, "passengers")),
    ]
    if idle_hz:
        motor = Engine(FOUR_CYLINDERS, idle_hz, ORDERS, wander_hz=0.06)
        parts += [
            motor.simulate_lines(path, rate, make_random(seed, "engine")),
            simulate_idle_floor(path, make_random(seed, "idling")),
        ]
    gaps = spread_gaps(path, tunnels, (20.0, 45.0), make_random(seed, "tunnels"))
    receiver = replace(RTK if gnss == "rtk" else SINGLE, outages=gaps, dropouts=0.01)
    return record(
        name, seed, path,
        origin=(45.46, 9.19, 20.0), imu=MEMS.change_rate(rate), mount=mount, shake=Shake(tuple(parts)), exact=exact,
        gnss=receiver, odometer=OdometerModel(rate=10.0, scale=0.01, white=0.0, pulse=PULSE) if odometer else None,
        barometer=BarometerModel() if barometer else None,
        antennas=DualAntennaModel(outages=gaps) if antennas else None,
        facts={"tunnels_s": [list(gap) for gap in gaps], "engine_hz": idle_hz},
    )  # fmt: skip


def _seat_passengers(path: Path, seed: int) -> list[Boarding | Fidget]:
    """Passengers on their seats throughout, and the driver getting out at the end."""
    rng = make_random(seed, "events")
    times = np.sort(rng.uniform(path.start, path.end, rng.poisson((path.end - path.start) / 60.0)))
    fidgets = [Fidget(float(t), float(rng.uniform(0.02, 0.15))) for t in times]
    return [*fidgets, Boarding(path.end - 9.0, -1.0, -1.0, 1.0)]


def spread_gaps(path: Path, count: int, length: Span, rng: np.random.Generator) -> tuple[Span, ...]:
    """`count` gaps over the drive, each where the vehicle moves most, of a length between the two given, s."""
    t = np.arange(path.start, path.end)
    moved: Array = np.abs(path.compute_speed(t))
    gaps = []
    for part in np.array_split(np.arange(len(t))[90:], max(count, 1))[:count]:
        seconds = int(rng.uniform(*length))
        share = np.convolve(moved[part], np.ones(seconds), "valid")
        first = float(t[part[int(np.argmax(share))]])
        gaps.append((first + 0.5, first + seconds + 0.5))
    return tuple(gaps)


SCENARIOS = [
    Scenario("urban", "20 min of town: lights, corners, slopes, two tunnels, parking backwards, wheel pulses", urban),
    Scenario("electric", "a quarter of an hour of town in an electric car: no engine vibration at stops", electric),
]
